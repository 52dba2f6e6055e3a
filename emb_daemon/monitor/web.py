"""The monitor for a browser, for Prometheus and for PlotJuggler: one thread receives, others send its last state."""

import collections
import contextlib
import html
import json
import socket
import threading
import time
from collections.abc import Callable, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Protocol

from emb_daemon.errors import Unavailable
from emb_daemon.estimator.status import TABLE, names
from emb_daemon.monitor.listener import HISTORY_S, Listener
from emb_daemon.monitor.metrics import exposition
from emb_daemon.runtime.bus import Bus
from emb_daemon.runtime.shared import PresentEstimates

#: Period of taking frames and sending datagrams, s; period for browsers, which draw a minute on some hundred pixels, s.
_HEAR_S, _SHOW_S = 0.02, 0.1
_PAGE = Path(__file__).with_name("page.html")
#: Forces of the last minute, kept so that a page that is opened later can draw them too.
_HISTORY = round(HISTORY_S / _SHOW_S)


def state(listener: Listener, now_ns: int) -> dict[str, Any]:
    """State of all corners; times in s, on the machine's clock."""
    return {"timestamp": time.time(), "corners": listener.states(now_ns)}


class Web:
    """Serves one page, its events and metrics, to this machine only. Port 0 is any that is free; it is then the attribute
    `port`. ``title``: name of the bus on the page."""

    def __init__(self, port: int, title: str):
        """Raises Unavailable if the port is taken."""
        self._page = _PAGE.read_text(encoding="utf-8").replace("{title}", html.escape(title))
        self._state, self._metrics = b"{}", b""
        self._shown_s, self._news = 0.0, threading.Condition()
        self._history: collections.deque = collections.deque(maxlen=_HISTORY)
        web = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                web._serve(self)

            def log_message(self, *_):
                pass

        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except OSError as error:
            raise Unavailable(f"--web {port}: {error.strerror}") from None
        self._server.daemon_threads = True
        self.port: int = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def show(self, listener: Listener, now_ns: int) -> None:
        """Publish the present state, ten times a second at most."""
        if time.monotonic() - self._shown_s < _SHOW_S:
            return
        with self._news:
            self._shown_s = time.monotonic()
            current = state(listener, now_ns)
            # The part that a plot draws.
            forces = {name: [now["clamp_force_kN"], now["clamp_force_sigma_kN"]] for name, now in current["corners"].items()}
            self._history.append([current["timestamp"], forces])
            self._state, self._metrics = json.dumps(current).encode(), exposition(listener, now_ns).encode()
            self._news.notify_all()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def _serve(self, request: BaseHTTPRequestHandler) -> None:
        content = {
            "/": ("text/html; charset=utf-8", lambda: self._page.replace("{state}", self._everything().decode()).encode()),
            "/metrics": ("text/plain; version=0.0.4; charset=utf-8", lambda: self._metrics),
            "/state.json": ("application/json", lambda: self._state),
        }.get(request.path)
        # A page from another site, under a host name that resolves to this machine, gets nothing (DNS rebinding).
        host = request.headers.get("Host", "").rpartition(":")[0]
        if host not in ("127.0.0.1", "localhost"):
            request.send_error(403)
        elif request.path == "/events":
            self._stream(request)
        elif content is None:
            request.send_error(404)
        else:
            kind, make = content
            body = make()
            request.send_response(200)
            request.send_header("Content-Type", kind)
            request.send_header("Content-Length", str(len(body)))
            request.end_headers()
            request.wfile.write(body)

    def _everything(self) -> bytes:
        """The state, and the forces of the last minute for the plot."""
        with self._news:
            return json.dumps({"history": list(self._history)} | json.loads(self._state)).encode()

    def _stream(self, request: BaseHTTPRequestHandler) -> None:
        """Events until the browser has gone."""
        request.send_response(200)
        request.send_header("Content-Type", "text/event-stream")
        request.end_headers()
        event = self._everything()
        while True:
            try:
                request.wfile.write(b"data: " + event + b"\n\n")
                request.wfile.flush()
            except OSError:
                return
            with self._news:
                self._news.wait(5.0)
                event = self._state


class Datagrams:
    """JSON over UDP for PlotJuggler's UDP server. It works without a receiver, too."""

    def __init__(self, host: str, port: int):
        """Raises Unavailable for an unknown host."""
        try:
            [(family, kind, *_, self._address), *_] = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise Unavailable(f"--udp {host}:{port}: {error.strerror}") from None
        self._socket = socket.socket(family, kind)
        self._socket.setblocking(False)

    def show(self, listener: Listener, now_ns: int) -> None:
        # A lost datagram does not matter: the next one follows at once.
        with contextlib.suppress(OSError):
            self._socket.sendto(json.dumps(state(listener, now_ns)).encode(), self._address)

    def close(self) -> None:
        self._socket.close()


class Receiver(Protocol):
    """Shows or sends the bus's state."""

    def show(self, listener: Listener, now_ns: int) -> None: ...


def hand_out(bus: Bus, receivers: Sequence[Receiver], stopped: Callable[[], bool], shared: PresentEstimates | None) -> None:
    """Receive a bus, and what the daemon ``shared`` of it, for ``receivers``, until ``stopped()``."""
    listener = Listener()
    bus.drain()
    while not stopped():
        bus.wait(_HEAR_S)
        # Pause after the first frame, to take all frames of a period together.
        time.sleep(_HEAR_S)
        listener.receive(bus.drain())
        now = time.monotonic_ns()
        if shared:
            shared.follow(now)
            for row, corner in enumerate(listener.corners):
                estimate = shared.of(row)
                corner.facts = None if estimate is None else [TABLE[name].sentence for name in names(estimate["facts"])]
        for receiver in receivers:
            receiver.show(listener, now)
