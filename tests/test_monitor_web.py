"""The monitor for a browser, for Prometheus and for PlotJuggler: what was broadcast is what they get, and nobody else does."""

import contextlib
import http.client
import json
import re
import shutil
import socket
import subprocess
import threading
import time
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest
import wirekit

from emb_daemon.cli.main import main
from emb_daemon.estimator.status import BEYOND_RANGE, DISC_UNEVEN, sentences
from emb_daemon.monitor.listener import SECOND_NS, Listener, broadcast_ids
from emb_daemon.monitor.metrics import exposition
from emb_daemon.monitor.web import Datagrams, Web, hand_out
from emb_daemon.runtime.bus import open_bus
from emb_daemon.wire.layout import CORNERS

_SAMPLE = re.compile(r"(\w+)\{([^}]*)\} (-?[\d.e+-]+)")


def _broadcasts(now_ns: int, counter: int, force_kN=5.0, status=0, reasons=0, corner="FL") -> np.ndarray:
    return np.concatenate([
        wirekit.frame(f"EMB_{corner}_ClampForce", now_ns, counter, status, ClampForce=force_kN, ClampForceSigma=0.12,
                      ForceSource=1),
        wirekit.frame(f"EMB_{corner}_PadTemp", now_ns, counter, 0, InnerSurfaceTemp=301.25, InnerMeanTemp=200.0,
                      OuterSurfaceTemp=290.0, OuterMeanTemp=150.0),
        wirekit.frame(f"EMB_{corner}_EstimatorStatus", now_ns, counter, 0, Mode=3, StiffnessFactor=0.912, ContactAngle=-73.1,
                      DegradedReasons=reasons),
        wirekit.frame(f"EMB_{corner}_AdaptRequest", now_ns, counter),
    ])  # fmt: skip


def _heard(**what) -> Listener:
    listener = Listener()
    listener.receive(_broadcasts(100 * SECOND_NS, 0, **what))
    return listener


def _samples(text: str) -> dict[tuple[str, str], float]:
    return {(name, labels): float(value) for name, labels, value in _SAMPLE.findall(text)}


def test_metrics_are_in_si_units_with_a_type_each():
    text = exposition(_heard(reasons=0b10), 100 * SECOND_NS)
    found = _samples(text)
    assert found["emb_clamp_force_newtons", 'corner="FL"'] == 5000.0
    assert found["emb_clamp_force_sigma_newtons", 'corner="FL"'] == 120.0
    assert found["emb_pad_temperature_celsius", 'corner="FL",place="inner_surface"'] == 301.25
    assert found["emb_mode", 'corner="FL",mode="degraded"'] == 1.0 and found["emb_mode", 'corner="FL",mode="running"'] == 0.0
    assert found["emb_reason", 'corner="FL",reason="current lost"'] == 1.0
    assert found["emb_reason", 'corner="FL",reason="resolver lost"'] == 0.0
    assert found["emb_frames_received_total", 'corner="FL"'] == 4.0
    assert (
        {name for name, _ in found}
        == set(re.findall(r"(?m)^# TYPE (\w+)", text))
        == set(re.findall(r"(?m)^# HELP (\w+)", text))
    )
    assert all(line.startswith("# ") or _SAMPLE.fullmatch(line) for line in text.splitlines())


def test_a_force_that_is_not_to_be_used_is_no_metric():
    found = _samples(exposition(_heard(status=2), 100 * SECOND_NS))
    assert ("emb_clamp_force_newtons", 'corner="FL"') not in found
    assert found["emb_status", 'corner="FL",status="fault"'] == 1.0


def test_lost_and_damaged_frames_are_counted_apart():
    listener = _heard()
    late = _broadcasts(100 * SECOND_NS, 4)
    late["data"][1] ^= 1 << 60
    listener.receive(late)
    found = _samples(exposition(listener, 100 * SECOND_NS))
    # Three of each of the other kinds of message were lost before these, and one came with a wrong CRC.
    assert found["emb_frames_missing_total", 'corner="FL"'] == 9.0
    assert found["emb_frames_damaged_total", 'corner="FL"'] == 1.0
    assert found["emb_frames_received_total", 'corner="FL"'] == 7.0


def _get(port: int, path: str, host: str = "127.0.0.1"):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request("GET", path, headers={"Host": f"{host}:{port}"})
    return connection.getresponse()


@pytest.fixture
def web():
    server = Web(0, "can<0>")
    server.show(_heard(reasons=1), 100 * SECOND_NS)
    yield server
    server.close()


def test_page_state_and_metrics_are_served(web):
    page = _get(web.port, "/").read().decode()
    assert "can&lt;0&gt;" in page and "{title}" not in page and "{state}" not in page and not re.search(r"https?://", page), (
        "fetches something from elsewhere"
    )
    said = json.loads(_get(web.port, "/state.json").read())
    assert said["corners"]["FL"]["clamp_force_kN"] == 5.0 and said["corners"]["FL"]["reasons"] == ["resolver lost"]
    assert b'emb_clamp_force_newtons{corner="FL"} 5000' in _get(web.port, "/metrics").read()
    assert _get(web.port, "/etc/passwd").status == 404


def test_a_request_under_a_foreign_host_name_is_refused(web):
    assert _get(web.port, "/state.json", host="rebound.example").status == 403
    assert _get(web.port, "/state.json", host="localhost").status == 200


def test_it_is_served_on_one_address_alone(web):
    """Who reaches the machine under another address, of the same network card even, reaches no page."""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", web.port), timeout=5.0)


def test_a_taken_port_is_reported(web, capsys):
    assert main(["monitor", "-i", "virtual", "-c", "web-taken", "--web", str(web.port)]) == 1
    assert capsys.readouterr().err == f"--web {web.port}: Address already in use\n"
    for nowhere in ("nowhere", "127.0.0.1:65536"):
        assert main(["monitor", "-i", "virtual", "-c", "web-taken", "--udp", nowhere]) == 2
        assert "expected HOST:PORT" in capsys.readouterr().err


@contextlib.contextmanager
def _live(receivers, channel, corners=CORNERS, shared=None):
    """A daemon's broadcasts on a bus inside the process, handed out."""
    bus, daemon, stop = open_bus("virtual", channel, broadcast_ids()), open_bus("virtual", channel, []), threading.Event()

    def broadcast():
        counter = 0
        while not stop.wait(0.02):
            for row, corner in enumerate(corners):
                force = 6.0 + row + 4.0 * np.sin(0.2 * counter + row)
                usable = row != 2 or counter % 40 < 25
                daemon.send(
                    _broadcasts(time.monotonic_ns(), counter % 15, force, 1 if usable else 2, 1 << row if row else 0, corner)
                )
            counter += 1

    heard = (bus, receivers, stop.is_set, shared)
    threads = [threading.Thread(target=broadcast), threading.Thread(target=hand_out, args=heard)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        bus.close(), daemon.close()
        for receiver in receivers:
            receiver.close()


def test_datagrams_and_events_follow_the_broadcasts():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as plotjuggler:
        plotjuggler.bind(("127.0.0.1", 0))
        plotjuggler.settimeout(10)
        server = Web(0, "virtual")
        with _live([Datagrams(*plotjuggler.getsockname()), server], "web-follow", ("FL",)):
            events = _get(server.port, "/events")
            seen = set()
            while len(seen) < 5:
                said = json.loads(plotjuggler.recv(65536))
                if said["corners"]:
                    seen.add(said["corners"]["FL"]["clamp_force_kN"])
            lines = [events.readline() for _ in range(6)]
            later = _get(server.port, "/events").readline()
    assert abs(said["timestamp"] - time.time()) < 30
    assert [line[:6] for line in lines[::2]] == [b"data: "] * 3 and lines[1] == b"\n"
    history = json.loads(later.removeprefix(b"data: "))["history"]
    assert len(history) >= 2 and set(history[-1][1]) == {"FL"} and history[0][0] < history[-1][0]


def test_received_broadcasts_are_recorded(tmp_path):
    pytest.importorskip("mcap", reason="NOT RUN: mcap is not installed")
    from mcap.reader import make_reader

    from emb_daemon.monitor.recording import Recording

    recording, listener = Recording(tmp_path / "drive.mcap"), Listener()
    for counter in range(3):
        listener.receive(_broadcasts(100 * SECOND_NS, counter, 5.0 + counter, reasons=1))
        listener.corners[0].facts = [None, [], ["the disc is uneven"]][counter]
        for _ in range(2):  # Nothing new the second time.
            recording.show(listener, 100 * SECOND_NS)
    recording.close()
    with open(tmp_path / "drive.mcap", "rb") as file:
        rows = [(schema, channel, message) for schema, channel, message in make_reader(file).iter_messages()]
    assert [json.loads(message.data)["clamp_force_kN"] for _, _, message in rows] == [5.0, 6.0, 7.0]
    schema, channel, message = rows[0]
    assert (channel.topic, channel.message_encoding, schema.encoding) == ("/FL", "json", "jsonschema")
    assert abs(message.log_time - time.time_ns()) < 60 * SECOND_NS
    assert [json.loads(message.data)["facts"] for _, _, message in rows] == [None, [], ["the disc is uneven"]]
    described, said = json.loads(schema.data)["properties"], json.loads(message.data)
    assert described.keys() == said.keys() and described["facts"]["type"] == ["array", "null"]
    kinds = {str: "string", float: "number", int: "number", type(None): "null", list: "array", dict: "object"}
    assert all(kinds[type(value)] in described[name]["type"] for name, value in said.items())


def test_monitor_passes_the_shared_file_to_page_and_recording(tmp_path, monkeypatch, capsys):
    taken = []
    monkeypatch.setattr("emb_daemon.monitor.web.hand_out", lambda *given: taken.append(given))
    bus, path = ["-i", "virtual", "-c", "web-shared"], tmp_path / "estimates"
    for share, record in (([], True), (["--share", str(path)], True), (["--share", str(path)], False)):
        main(["monitor", *bus, *share, *(["--udp", "127.0.0.1:9"] if record else ["--once"])])
    assert [given[3] and given[3]._reader.path for given in taken] == [None, path]
    assert capsys.readouterr().err == "--share: expected together with --web, --record or --udp\n"


@pytest.mark.skipif(not shutil.which("chromium"), reason="NOT RUN: no Chromium here (Debian: apt-get install chromium)")
def test_the_page_draws_four_corners_in_a_browser(tmp_path):
    """Without script errors: words and plots stand there as a reader sees them."""
    server = Web(0, "virtual")
    uneven, followed = {"facts": DISC_UNEVEN | BEYOND_RANGE}, []
    shared = SimpleNamespace(follow=followed.append, of=lambda row: uneven if row == 1 else None)
    with _live([server], "web-browser", shared=shared):
        time.sleep(2.0)
        browser = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1200,760", "--timeout=6000",
                   f"--user-data-dir={tmp_path}/profile", "--enable-logging=stderr"]  # fmt: skip
        page = f"http://127.0.0.1:{server.port}/"
        written, drawn = (
            subprocess.run([*browser, what, page], capture_output=True, text=True, timeout=90)
            for what in ("--dump-dom", f"--screenshot={tmp_path}/page.png")
        )
        said = json.loads(_get(server.port, "/state.json").read())["corners"]
    assert "CONSOLE" not in written.stderr + drawn.stderr, written.stderr
    assert re.findall("<h2>(..)</h2>", written.stdout) == list(CORNERS)
    assert "wheel speed lost" in written.stdout and "stiffness 0.912" in written.stdout
    assert f"current lost: {sentences(DISC_UNEVEN | BEYOND_RANGE)}</div>" in written.stdout, "reasons, and why"
    assert said["FL"]["facts"] is None and len(said["FR"]["facts"]) == 2, "nothing known is not nothing found"
    assert abs(followed[-1] - time.monotonic_ns()) < 60 * SECOND_NS
    # The plots' line, at the right ends of all four.
    picture = matplotlib.image.imread(tmp_path / "page.png")[:, :, :3]
    line = np.abs(picture - np.array([0x0B, 0x5C, 0xAD]) / 255.0).max(axis=2) < 0.05
    height, width = line.shape
    for rows in (slice(0, height // 2), slice(height // 2, height)):
        for columns in (slice(0, width // 2), slice(width // 2, width)):
            assert line[rows, columns].sum() > 30, "a plot without a line"
