"""Another rig's bus, live: its frames become our samples as they would out of a log."""

import can
import cantools
import foreignkit
import numpy as np
import pytest

from emb_daemon.cli.main import main
from emb_daemon.errors import InputError
from emb_daemon.logs.live import MappedBus
from emb_daemon.logs.mapping import Mapping
from emb_daemon.offline.log import log_of
from emb_daemon.wire.frames import FRAME


class _Silent:
    """A bus on which nothing happens."""

    def fileno(self):
        raise NotImplementedError


def _heard(folder, columns: dict) -> np.ndarray:
    """FRAME rows that a mapped bus makes of the rig's frames, one after the other."""
    database = cantools.database.load_string(foreignkit.DBC, "dbc")
    drive, bench = (database.get_message_by_name(name) for name in ("Drive", "Bench"))
    bus, rows = MappedBus(_Silent(), Mapping(folder / "mapping.yaml")), []
    for row, time_s in enumerate(columns["time_s"]):
        time_ns = 1_000_000_000 + round(1e9 * time_s)
        of = {
            bench: {"Load": 1e-3 * columns["force_N"][row], "Plate": columns["plate_C"][row] + 273.15},
            drive: {
                "Position": np.degrees(columns["angle_rad"][row]),
                "Speed": columns["speed_rad_per_s"][row] * 30.0 / np.pi,
                "Iq": -1e3 * columns["current_A"][row],
            },
        }
        for message, values in of.items():
            frame = can.Message(
                arbitration_id=message.frame_id, is_extended_id=True, is_fd=True, data=message.encode(values, strict=False)
            )
            rows += bus.heard(frame, time_ns)
    return np.array(rows, FRAME)


@pytest.mark.parametrize("rate_Hz", [250, 500, 1000])
def test_frames_of_another_rig_become_samples_at_our_rate(tmp_path, rate_Hz):
    foreignkit.write_rig(tmp_path)
    motion = foreignkit.truth(foreignkit.random(seconds=3.0))
    columns = foreignkit.sampled(motion, rate_Hz)
    log = log_of(_heard(tmp_path, columns))
    samples, at = log.samples, 1e-9 * log.time_ns - 1.0
    assert np.all(samples["dt"][1:] == 0.004) and len(samples) == pytest.approx(750, abs=2)
    assert np.abs(samples["angle"] - np.interp(at, motion.time_s, motion.angle)).max() < 0.01
    # Means over the cycle that ends at the sample.
    total = np.concatenate([[0.0], np.cumsum(motion.current)]) * foreignkit.FINE_S
    grid = np.arange(len(total)) * foreignkit.FINE_S
    mean = (np.interp(at + foreignkit.FINE_S, grid, total) - np.interp(at + foreignkit.FINE_S - 0.004, grid, total)) / 0.004
    assert np.std((samples["current_q"] - mean)[5:]) < 1.2 and abs(np.mean((samples["current_q"] - mean)[5:])) < 0.1
    assert samples["has_thermocouple"][100]
    for place in ("inner_backplate", "outer_backplate", "caliper"):
        assert samples[place][100] == pytest.approx(22.0, abs=0.1), "one plate stands for what is not measured"
    assert samples["has_status"][100] and not np.isfinite(log.force_N).any(), "the estimator never sees a reference"


def test_a_period_is_the_same_live_as_in_a_log(tmp_path):
    """A current of 16 bits without its sign, of 20 A to and fro, and an angle within one turn that begins at 359 degrees."""
    message = (
        'VERSION ""\nBU_: T\nBO_ 33 M: 4 T\n SG_ A : 0|16@1+ (0.01,0) [0|0] "deg" T\n SG_ I : 16|16@1+ (1,0) [0|0] "mA" T\n'
    )
    (tmp_path / "m.dbc").write_text(message)
    (tmp_path / "mapping.yaml").write_text(
        "format: 1\ndbc: m.dbc\nsignals:\n  EMB_FL_Resolver.MotorAngle: {signal: M.A, period: 360}\n"
        "  EMB_FL_Current.CurrentQ: {signal: M.I, period: 65536, mean_ms: 0}\n"
    )
    mapping, live, lines = Mapping(tmp_path / "mapping.yaml"), [], []
    bus = MappedBus(_Silent(), mapping)
    for tick in range(250):
        degree, current_mA = (359.0 + 3.0 * tick) % 360.0, (20000 if tick // 50 % 2 else -20000) % 65536
        data = round(100.0 * degree).to_bytes(2, "little") + current_mA.to_bytes(2, "little")
        live += bus.heard(can.Message(arbitration_id=33, is_extended_id=False, data=data), 1_000_000_000 + 4_000_000 * tick)
        lines.append(f"({1.0 + 0.004 * tick:.6f}) can0 021#{data.hex().upper()}\n")
    (tmp_path / "a.log").write_text("".join(lines))
    heard, read = log_of(np.array(live, FRAME)).samples, log_of(mapping.read(tmp_path / "a.log")).samples
    for samples in (heard, read):
        assert samples["angle"][0] == pytest.approx(np.radians(-1.0), abs=1e-3)
        assert np.ptp(samples["angle"]) == pytest.approx(np.radians(747.0), abs=0.15)
        assert np.quantile(samples["current_q"], (0.1, 0.9)) == pytest.approx([-20.0, 20.0], abs=0.1)


def test_a_j1939_group_is_heard_of_its_first_sender(tmp_path):
    """800 rpm of one engine's controller, which another's 900 do not change; 0xFFFF is no speed."""
    message = 'VERSION ""\nBU_: T\nBO_ 2364540158 EEC1: 8 T\n SG_ EngineSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" T\n'
    (tmp_path / "truck.dbc").write_text(message)
    signals = "signals:\n  EMB_FL_Resolver.MotorSpeed: {signal: EEC1.EngineSpeed}\n"
    (tmp_path / "mapping.yaml").write_text("format: 1\ndbc: truck.dbc\n" + signals)
    bus, rows = MappedBus(_Silent(), Mapping(tmp_path / "mapping.yaml")), []
    for tick in range(1, 101):
        for sender, raw in ((0x00, 6400 if tick % 10 else 0xFFFF), (0x21, 7200)):
            data = bytes(3) + raw.to_bytes(2, "little") + bytes(3)
            frame = can.Message(arbitration_id=0xCF00400 | sender, is_extended_id=True, data=data)
            rows += bus.heard(frame, tick * 10_000_000)
    samples = log_of(np.array(rows, FRAME)).samples
    assert len(samples) > 80 and samples["speed"] == pytest.approx(800.0 * np.pi / 30.0, abs=0.03)


def test_a_speed_adds_no_way_while_the_bus_is_silent_live_as_in_a_log(tmp_path):
    """A motor that turns at 60 rpm for two seconds, a minute without a frame, and two seconds at 60 rpm."""
    (tmp_path / "m.dbc").write_text('VERSION ""\nBU_: T\nBO_ 33 M: 2 T\n SG_ S : 0|16@1- (0.01,0) [0|0] "rpm" T\n')
    (tmp_path / "mapping.yaml").write_text("format: 1\ndbc: m.dbc\nsignals:\n  EMB_FL_Resolver.MotorSpeed: {signal: M.S}\n")
    mapping, live, lines = Mapping(tmp_path / "mapping.yaml"), [], []
    bus, data = MappedBus(_Silent(), mapping), (6000).to_bytes(2, "little")
    for begins_ms in (1000, 63000):
        for time_ms in range(begins_ms, begins_ms + 2004, 4):
            live += bus.heard(can.Message(arbitration_id=33, is_extended_id=False, data=data), time_ms * 1_000_000)
            lines.append(f"({1e-3 * time_ms:.6f}) can0 021#{data.hex()}\n")
    (tmp_path / "a.log").write_text("".join(lines))
    for rows in (np.array(live, FRAME), mapping.read(tmp_path / "a.log")):
        assert np.ptp(log_of(rows).samples["angle"]) == pytest.approx(4.0 * 2.0 * np.pi, abs=0.1)


def test_a_mapping_of_columns_is_no_bus(tmp_path):
    with pytest.raises(InputError, match="expected one with `dbc` for a live bus"):
        MappedBus(_Silent(), Mapping(foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)))


def test_check_lists_the_faults_of_mapping_and_configuration_together(tmp_path, capsys):
    foreignkit.write_rig(tmp_path)
    mapping, config = tmp_path / "mapping.yaml", tmp_path / "emb.yaml"
    assert main(["check", "--mapping", str(mapping)]) == 0
    mapping.write_text(mapping.read_text().replace("Drive.Iq", "Drive.Nothing").replace("Drive.Speed", "Drive.Missing"))
    config.write_text("format: 1\ncorners: {XX: {calibration: c.yaml}}\n")
    capsys.readouterr()
    assert main(["check", "--mapping", str(mapping), "--config", str(config)]) == 2
    said = capsys.readouterr().err
    assert "Drive.Nothing" in said and "Drive.Missing" in said and "XX" in said
    assert main(["check"]) == 2
