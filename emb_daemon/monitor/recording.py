"""The received broadcasts as an MCAP file, for PlotJuggler and similar tools: a topic for each corner, JSON with a schema."""

import json
import time
from pathlib import Path

from emb_daemon.monitor.listener import Listener

#: Bytes after which a chunk is written: at most some seconds of four corners are lost if the recorder is killed.
_CHUNK = 1 << 16


def _schema(value) -> dict:
    """JSON schema of `Corner.state`. Each value may also be null, if it is not to be used."""
    if isinstance(value, dict):
        return {"type": "object", "properties": {name: _schema(inner) for name, inner in value.items()}}
    if isinstance(value, list):
        return {"type": ["array", "null"], "items": {"type": "string"}}
    return {"type": ["string", "null"] if isinstance(value, str) else ["number", "null"]}


class Recording:
    """A file to which the monitor appends what it receives."""

    def __init__(self, path: Path):
        """Raises ImportError without mcap, OSError if the file cannot be written."""
        from mcap.writer import Writer

        self._file = open(path, "wb")  # noqa: SIM115 - closed by close()
        self._writer = Writer(self._file, chunk_size=_CHUNK)
        self._writer.start(library="emb_daemon")
        self._channels: dict[str, int] = {}
        self._received: dict[str, int] = {}

    def show(self, listener: Listener, now_ns: int) -> None:
        """Write each corner from which something new was received; times on the machine's clock."""
        stamp = time.time_ns()
        for name, state in listener.states(now_ns).items():
            if self._received.get(name) != state["received"]:
                self._received[name] = state["received"]
                self._writer.add_message(self._channel(name, state), stamp, json.dumps(state).encode(), stamp)

    def _channel(self, corner: str, state: dict) -> int:
        if corner not in self._channels:
            words = {name: state[name] or "" for name in ("status", "source", "mode")}
            words |= {"facts": [], "adaptation": {"request": "", "progress_percent": 0, "result": ""}}
            schema = self._writer.register_schema(
                "emb_daemon.Corner", "jsonschema", json.dumps(_schema(state | words)).encode()
            )
            self._channels[corner] = self._writer.register_channel(f"/{corner}", "json", schema)
        return self._channels[corner]

    def close(self) -> None:
        self._writer.finish()
        self._file.close()
