"""The simulated car on another rig's bus: our frames are sent as the rig's messages, by the mapping that reads them."""

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.logs.mapping import Mapping
from emb_daemon.logs.mapping_file import Source
from emb_daemon.logs.resample import our_messages
from emb_daemon.runtime.bus import PythonCan, PythonCanBus
from emb_daemon.wire.layout import signal_columns, unpack


class _Theirs:
    """One message of the rig, and the values of its signals that are mapped; others, checksums too, stay raw zero."""

    def __init__(self, message, channel: str | None):
        self.message, self.channel = message, channel
        self.values = {signal.name: signal.offset for signal in message.signals}
        self.missing: set[str] = set()
        self._bounds = {signal.name: _bounds(signal) for signal in message.signals}

    def set(self, name: str, value: float) -> None:
        low, high = self._bounds[name]
        self.values[name] = min(max(value, low), high)
        self.missing.discard(name)

    def frame(self):
        import can

        data = self.message.encode(self.values, strict=False)
        kind = {"is_extended_id": self.message.is_extended_frame, "is_fd": self.message.is_fd}
        return can.Message(arbitration_id=self.message.frame_id, data=data, channel=self.channel, **kind)


def _bounds(signal) -> tuple[float, float]:
    """Range of a cantools signal."""
    if signal.is_float:
        return -np.inf, np.inf
    least = -(1 << signal.length - 1) if signal.is_signed else 0
    ends = [raw * signal.scale + signal.offset for raw in (least, least + (1 << signal.length) - 1)]
    return min(ends), max(ends)


class SimulatedRig(PythonCanBus):
    """A bus that sends our frames as the rig's messages, on python-can's, opened for CAN FD where these need it, and receives
    frames of ``ids`` unchanged. Raises InputError: a mapping of tables has no frames, and one signal cannot select what else
    its message holds."""

    def __init__(self, bus: PythonCan, mapping: Mapping, ids: list[int]):
        super().__init__(bus, ids)
        self._theirs: dict[tuple, _Theirs] = {}
        self._readers: dict[int, list[tuple]] = {}
        for name, signals in mapping.messages.items():
            ours, database = our_messages()[name]
            for signal, source in signals.items():
                if isinstance(source, Source):
                    [column] = signal_columns(database, name, (signal,))
                    self._readers.setdefault(ours.frame_id, []).append((column, source, self._their(mapping, source)))

    def _their(self, mapping: Mapping, source: Source) -> _Theirs:
        message = mapping.message_of(source)
        if message.is_multiplexed():
            raise InputError(
                f"{mapping.path}: {message.name} is multiplexed, and which part to send is not known; expected another"
            )
        theirs = self._theirs.setdefault((source.bus, message.name), _Theirs(message, mapping.channels[source.bus]))
        theirs.missing.add(source.signal)
        return theirs

    def send(self, frames: np.ndarray) -> None:
        changed = {}
        for frame in frames:
            for column, source, theirs in self._readers.get(int(frame["can_id"]), ()):
                value = (float(unpack(frame["data"], column)) - source.offset) / source.scale
                theirs.set(source.signal, value if source.period is None else value % source.period)
                changed[id(theirs)] = theirs
        for theirs in changed.values():
            if not theirs.missing:
                self._hand_over(theirs.frame())
