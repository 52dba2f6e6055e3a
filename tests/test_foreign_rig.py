"""A rig that nobody here built, through every command that reads its logs: see `foreignkit`."""

import json
import math
import zipfile
from pathlib import Path

import foreignkit
import numpy as np
import pyarrow.feather
import pyarrow.parquet
import pytest
from foreignkit import columns_of, load_mapped, read, write_mapping
from scipy.io import savemat

import emb_daemon
from emb_daemon.cli.main import main
from emb_daemon.errors import InputError, InputErrors
from emb_daemon.logs.columns import Decoder
from emb_daemon.logs.mapping import Mapping
from emb_daemon.logs.read import read_frames
from emb_daemon.logs.resample import at_our_rate
from emb_daemon.logs.write import write_frames
from emb_daemon.offline import Log, load_log
from emb_daemon.wire.contract import E2E_ERROR


@pytest.fixture(scope="module")
def truth():
    return foreignkit.truth()


@pytest.fixture
def columns(truth):
    return foreignkit.sampled(truth, 250.0)


def _replay(folder, log, capsys, *options):
    arguments = ["replay", log, "--mapping", folder / "mapping.yaml", "--calibration", folder / "calibration.yaml", *options]
    assert main([*map(str, arguments), "--json"]) == 0
    said = capsys.readouterr()
    return json.loads(said.out)["logs"][0], said.err


def _options(bus) -> list[str]:
    return ["--mapping", str(bus.parent / "mapping.yaml"), "--calibration", str(bus.parent / "calibration.yaml")]


@pytest.fixture(scope="module")
def bus(truth, tmp_path_factory):
    """The rig's CAN FD log at 500 Hz."""
    folder = tmp_path_factory.mktemp("foreign")
    foreignkit.write_rig(folder)
    return foreignkit.write_log(folder / "stops.log", foreignkit.sampled(truth, 500.0))


def test_long_frames_with_long_ids_are_decoded_whole(bus, truth):
    log = load_log(bus, read=Mapping(bus.parent / "mapping.yaml").read)
    at = log.time_ns * 1e-9 - foreignkit.START_S
    inside = at > 0.01
    for name, true in (("angle", truth.angle), ("speed", truth.speed), ("current_q", truth.current)):
        error = log.samples[name] - np.interp(at, truth.time_s, true)
        assert np.abs(np.mean(error[inside])) < 0.05 and np.std(error[inside]) < 0.6, name
    assert np.nanstd(log.force_N - np.interp(at, truth.time_s, truth.force)) < 25.0
    assert log.samples["inner_backplate"][100] == pytest.approx(22.0, abs=0.1)


@pytest.mark.parametrize("name", ["cut.log", "cut.asc"])
def test_every_format_keeps_payloads_beyond_eight_octets(bus, truth, name):
    columns = {key: values[740:780] for key, values in foreignkit.sampled(truth, 500.0).items()}
    mapping = Mapping(bus.parent / "mapping.yaml")
    log = load_log(foreignkit.write_log(bus.parent / name, columns), read=mapping.read)
    expected = load_log(foreignkit.write_log(bus.parent / "cut.blf", columns), read=mapping.read)
    for key in ("angle", "speed", "current_q"):
        assert np.ptp(log.samples[key]) > 1.0, "the brake stands still"
        assert np.abs(log.samples[key] - expected.samples[key]).max() < 0.03


def test_a_bus_of_other_people_is_replayed_and_says_what_it_lacks(bus, capsys):
    figures, said = _replay(bus.parent, bus, capsys)
    assert figures["force_N"]["fused"]["rmse"] < 40.0 and figures["force_N"]["inside_two_sigma"] > 0.93
    assert figures["temperature_K"] == {} and figures["invalid"] == 0.0
    assert "OuterBackplateTemp is not measured: it is taken to be the inner one's" in said
    assert main(["replay", str(bus), *_options(bus)]) == 0
    assert "of the samples" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("rate_Hz", "means"), [(100, True), (100, False), (250, False), (400, True), (500, False), (1000, True)]
)
def test_any_sampling_rate_is_as_good_as_ours(truth, tmp_path, capsys, rate_Hz, means):
    """The rig's clock shows in neither path: acceleration, current and angle are of the same instants at every rate, in random
    motion as in stops. What a current of the moment does between two samples is unknown, so that it has stops alone."""
    figures, motion = [], foreignkit.truth(foreignkit.random()) if means else truth
    for rate, as_means in ((250, True), (rate_Hz, means)):
        text = foreignkit.COLUMNS if as_means else foreignkit.COLUMNS.replace("unit: A", "unit: A, mean_ms: 0")
        foreignkit.write_rig(tmp_path, text)
        table = foreignkit.write_table(tmp_path / "stops.parquet", foreignkit.sampled(motion, rate, as_means))
        figures.append(_replay(tmp_path, table, capsys)[0]["force_N"])
    ours, theirs = figures
    assert theirs["torque"]["rmse"] < 1.4 * ours["torque"]["rmse"] < 700.0
    assert theirs["fused"]["rmse"] < ours["fused"]["rmse"] + 5.0 < 45.0
    assert theirs["inside_two_sigma"] > 0.93


@pytest.mark.parametrize("rate_Hz", [100, 500, 1000])
def test_our_own_layout_may_be_logged_at_any_rate(truth, tmp_path, capsys, rate_Hz):
    columns = {key: values[: 4 * rate_Hz] for key, values in foreignkit.sampled(truth, rate_Hz).items()}
    frames = foreignkit.our_frames(columns)
    write_frames(tmp_path / "ours.log", frames)
    samples = load_log(tmp_path / "ours.log").samples
    assert "sampled at another rate than every 4 ms" in capsys.readouterr().err
    at = samples["time_ns"] * 1e-9 - foreignkit.START_S
    assert np.all(samples["dt"][1:] == 0.004) and not (samples["reasons"] & E2E_ERROR).any()
    assert np.abs(samples["angle"] - np.interp(at, truth.time_s, truth.angle)).max() < 0.05
    assert np.abs((samples["current_q"] - np.interp(at - 0.002, truth.time_s, truth.current))[2:].mean()) < 0.05
    twice = np.concatenate([frames, frames])
    write_frames(tmp_path / "repeated.log", twice[np.argsort(twice["time_ns"], kind="stable")])
    assert (load_log(tmp_path / "repeated.log").samples["reasons"] & E2E_ERROR).any(), "no rate, but repetition"
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("name", ["stops.csv", "stops.parquet", "stops.1.mf4"])
def test_columns_and_channels_are_logs(truth, tmp_path, name):
    if name.endswith("mf4"):
        pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    text = foreignkit.COLUMNS if not name.endswith("mf4") else foreignkit.COLUMNS.replace("time: {signal: time_s}\n", "")
    foreignkit.write_rig(tmp_path, text)
    columns = {key: values[:500] for key, values in foreignkit.sampled(truth, 250.0).items()}
    samples = load_mapped(foreignkit.write_table(tmp_path / name, columns)).samples
    assert len(samples) == 500 and np.abs(samples["angle"] - columns["angle_rad"]).max() < 1.1e-4
    start_s = foreignkit.START_S if name.endswith("mf4") else 0.0
    assert samples["time_ns"][0] * 1e-9 - start_s == pytest.approx(columns["time_s"][0], abs=1e-6)


def _read_text(folder, text: str, mapping: str = foreignkit.COLUMNS, name: str = "a.csv") -> Log:
    """The log of a table that is a text."""
    foreignkit.write_rig(folder, mapping)
    (folder / name).write_text(text, encoding="utf-8", newline="")
    return load_mapped(folder / name)


@pytest.mark.parametrize(
    ("name", "mark", "before", "after"),
    [
        ("a.txt", " ", "", ""),
        ("a.csv", ",", "", ""),
        ("a.tsv", "\t", "", ""),
        ("a.dat", ";", "", ""),
        ("a.m", " ", "0.6\n", ""),
        ("a.m", " ", "0.6\ndata = [7 7 7 7 7 7\n", "];\n"),
        ("a.m", " ", "data = [7 7 7 7 7 7\n", "]"),
    ],
)
def test_a_table_without_header_has_its_columns_by_number(tmp_path, name, mark, before, after):
    """As microcontrollers print it: numbers alone, in a file called anything; and as a program prints a matrix for MATLAB,
    below a number of its own."""
    samples = _read_text(tmp_path, before + _table(100).replace(",", mark) + after, _by_place(), name).samples
    assert np.allclose(samples["angle"], 0.1 * np.arange(100), atol=2e-4) and np.all(samples["current_q"][1:] == 1.5)


def _table(count: int, row: str = "{t:.3f},{a:.1f},25.0,1.5,22,0") -> str:
    return "".join(row.format(t=0.004 * n, a=0.1 * n) + "\n" for n in range(count))


_HEADER = "time_s,angle_rad,speed_rad_per_s,current_A,plate_C,force_N"


def _segments(rows: int) -> str:
    """As LabVIEW writes a table, a header and how many samples it has over each few of its rows; the first has more words."""
    lines = _table(21 * rows).splitlines(keepends=True)
    over = f"Channels,6\nSamples,{rows}\n***End_of_Header***\n{_HEADER}\n"
    return "A Tool\nSeparator,Comma\n***End_of_Header***\n\n" + "\n".join(
        over + "".join(lines[n : n + rows]) for n in range(0, len(lines), rows)
    )


_OF_LINES = '"of the\nbench"\n' + _HEADER.replace(",", ',"more\n(in\nmm)",', 1) + "\n"
_PAIRS = _HEADER.replace(",", ",,") + ",\n"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("# a tool\n# with, more, commas, than, the, table, has\n" + _HEADER + "\n" + _table(100), ""),
        ("Measured on Monday\n\n" + _HEADER + "\n" + "s,rad,rad/s,A,degC,N\n" + _table(100), ""),
        (_HEADER + ",\n" + _table(100, "{t:.3f},{a:.1f},25.0,1.5,22,0,"), ""),
        (_HEADER + "\n" + _table(100, "{t:.3f},{a:.1f},25.0,1.5,22,0,"), ""),
        (_HEADER + ",\n" + _table(100), ""),
        ("\ufeff" + _HEADER.replace(",", "\t") + "\r\n" + _table(100).replace(",", "\t").replace("\n", "\r\n"), ""),
        (_HEADER + "\n" + _table(100) + "0.400,10.0,25", "1 rows with another number of cells than 6 left out"),
        (f"{_HEADER}\n{_table(100)}{_HEADER}\n", "the header is repeated 1 times"),
        (_segments(5), "the header is repeated 20 times; that and the words above it are left out"),
        (_HEADER + "\n" + _table(100, "{t:.3f},{a:.1f},25.0,1.5,22,#N/A") + "0.4,10,25,1.5,22,Over\n", "out, the first of"),
        ((_HEADER + "\n" + _table(100)).replace("\n", "\r"), ""),
        ((_HEADER + "\n" + _table(100)).replace(",", "|"), ""),
        (("# a tool's words\n# " + _HEADER + "\n" + _table(100, " {t:8.3f}, {a:.1f},25.0,1.5,22,0")).replace(",", "  "), ""),
        (_PAIRS + 6 * "X,Y," + "\n" + _table(100, "7,{t:.3f},7,{a:.1f},7,25,7,1.5,7,22,7,0"), ""),
        (_PAIRS + _table(100, "{t:.3f},0,{a:.1f},0,25.0,0,1.5,0,22,0,0,0"), ""),
        ("sep=;\n" + (_HEADER + "\n" + _table(100, "{t:g},{a:g},25,1.5,22,0")).replace(",", ";").replace(".", ","), ""),
        ('"' + _HEADER.replace(",", '"; "') + '"\n' + _table(100).replace(",", "; "), ""),
        (_HEADER + "\n" + _table(100, "{t:.3f},{a:.1f},25.0,1.5,22,\N{MINUS SIGN}5"), ""),
        (f"{_HEADER},,Press,300\n{_table(100)}", "rows have 6 cells, the header 9; its last name nothing: Press, 300"),
        (f"{_HEADER}\ns,rad,rad/s,A,degC,g\n\n{_table(100)}", "force_N says g and is taken in N: which is right?"),
        (_OF_LINES + _table(100, "{t:.3f},1,{a:.1f},25.0,1.5,22,0"), ""),
        ((_HEADER + "\n" + _table(100)).replace(",", "\r,").replace("\n", "\r\n"), ""),
        ((_HEADER + "\n" + _table(100)).replace(",", ";").replace(".", ","), ""),
    ],
    ids=[
        "comments", "units", "comma at the ends", "comma at the rows' ends", "comma at the header's end", "tabs", "cut off",
        "two headers", "segments", "words", "old Mac", "bars", "blanks", "pairs of time and value", "flags beside",
        "late decimal commas", "quotes after blanks", "a typesetter's minus", "more names than cells",
        "units above an empty line", "names of several lines", "columns put side by side", "decimal commas",
    ],
)  # fmt: skip
def test_tables_are_read_as_measurement_tools_write_them(tmp_path, capsys, content, said):
    samples = _read_text(tmp_path, content).samples
    assert np.allclose(samples["angle"][:100], 0.1 * np.arange(100), atol=2e-4) and np.all(samples["current_q"][1:] == 1.5)
    told = capsys.readouterr().err
    assert said in told and any(word in told for word in ("left out", "header", "which is right")) == bool(said)


@pytest.mark.parametrize(
    ("stamp", "unit"),
    [
        ("08:15:{s:06.3f}", "s"),
        ("15:{s:06.3f}", "s"),
        ("22.11.2026 08:15:{s:06.3f}", "s"),
        ("2026-11-22T08:15:{s:06.3f}Z", "s"),
        ("2026-11-22 08:15:{s:06.3f}", "s"),
        ("11/22/2026 08:15:{s:06.3f} PM", "s"),
        ("22/11/2026 08:15:{s:06.3f}", "s"),
        ("2026/11/22 08:15:{s:06.3f}", "s"),
        ("08:15:{whole:02d}:{ms:03d}", "s"),
        ("22.11.2026 08:15:{whole:02d}:{ms:03d}", "s"),
        ("22-Nov-2026 08:15:{s:06.3f}", "s"),
        ("{ns:d}", "ns"),
        ("0 days 00:00:{s:09.6f}", "s"),
        ("{part:d}", "ns"),
    ],
)
def test_times_are_read_as_tools_write_them(tmp_path, stamp, unit):
    mapping = foreignkit.COLUMNS.replace("{signal: time_s}", f"{{signal: time_s, unit: {unit}}}")
    rows = (
        stamp.format(s=10.0 + 0.004 * n, whole=10, ms=4 * n, ns=1_790_000_000_000_000_000 + 4_000_000 * n, part=part)
        for n, part in ((n, (800_000_000 + 4_000_000 * n) % 1_000_000_000) for n in range(100))
    )
    table = "".join(f"{time},{0.1 * n:.1f},25.0,1.5,22,0\n" for n, time in enumerate(rows))
    log = _read_text(tmp_path, f"{_HEADER}\n{table}", mapping)
    assert np.allclose(log.time_s, 0.004 * np.arange(100), atol=1e-6)


@pytest.mark.parametrize(
    ("delimiter", "decimal", "group"),
    [(";", ",", "."), (";", ",", " "), (";", ".", "'"), (",", ".", ","), (";", ",", "\u00a0")],
)
def test_thousands_may_be_told_apart(tmp_path, delimiter, decimal, group):
    def number(value: float) -> str:
        text = f"{value:,.1f}".translate(str.maketrans({",": group, ".": decimal}))
        return f'"{text}"' if delimiter == "," else text

    rows = [
        delimiter.join(map(number, (4.0 * n, 0.1 * n, 25.0, 1.5, 22.0, 1500.0 + 10.0 * (n % 2) - 900.0 * (n % 3 == 0))))
        for n in range(400)
    ]
    mapping = foreignkit.COLUMNS.replace("{signal: time_s}", "{signal: time_s, unit: ms}")
    log = _read_text(tmp_path, "\n".join([_HEADER.replace(",", delimiter), *rows]) + "\n", mapping)
    assert np.allclose(log.time_s, 0.004 * np.arange(400), atol=1e-6)
    assert set(np.round(log.force_N).tolist()) == {600.0, 610.0, 1500.0, 1510.0}


@pytest.mark.parametrize(("whole", "largest_N"), [(1, 20_399.0), (0, 19.399)], ids=["thousands", "decimals"])
def test_a_point_beside_decimal_commas_parts_thousands(tmp_path, whole, largest_N):
    """As a spreadsheet of such a country shows whole newtons; nobody writes thousands that begin with a zero."""
    rows = [
        f"{0.004 * n:.3f};{0.1 * n:.1f};25,0;1,5;22,0".replace(".", ",") + f";{whole + n % 20}.{n:03d}" for n in range(400)
    ]
    log = _read_text(tmp_path, "\n".join([_HEADER.replace(",", ";"), *rows]) + "\n")
    assert np.nanmax(log.force_N) == pytest.approx(largest_N, abs=0.2)


def test_what_a_tool_says_of_an_instrument_out_of_range_is_no_value(tmp_path, capsys):
    rows = [f"{0.004 * n:.3f},{0.1 * n:.1f},25.0,1.5,22,{'OVER' if n % 10 < 3 else '100'}" for n in range(300)]
    log = _read_text(tmp_path, "\n".join([_HEADER, *rows]) + "\n")
    assert "90 cells are no numbers, left out, the first of them 'OVER'" in capsys.readouterr().err
    assert np.nanmax(np.abs(log.force_N - 100.0)) < 1.0 and len(log.samples) == 300


def test_a_table_is_one_whatever_it_is_called(tmp_path, capsys):
    """A text called .log, its header behind a mark; a column that is missed is told by name, units in its name or not."""
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    text, mapping = f"# bench 4\n#{_HEADER}\n{_table(100)}", Mapping(tmp_path / "mapping.yaml")
    assert len(_read_text(tmp_path, text, name="a.log").samples) == 100
    named = ",".join(f"{name} [x]" for name in _HEADER.split(","))
    (tmp_path / "b.csv").write_text(f"{named.replace('time_s [x]', 'time_s')}\n{_table(100)}")
    with pytest.raises(InputError, match=r"no such column; the table has time_s, angle_rad \[x\], speed_rad_per_s \[x\]"):
        mapping.read(tmp_path / "b.csv")
    marked = foreignkit.COLUMNS.replace("signal: time_s", "signal: '#time_s'")
    assert len(_read_text(tmp_path, text, marked, "a.log").samples) == 100
    for binary in (b"PK\x03\x04", b"\x89HDF", b"a\rb\n"):
        (tmp_path / "c.csv").write_bytes(binary + bytes(100))
        with pytest.raises(InputError, match="not readable"):
            mapping.read(tmp_path / "c.csv")


@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_a_table_may_have_clock_times_and_old_letters(tmp_path, encoding):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS.replace("time_s", "Uhrzeit").replace("plate_C", '"Temperatur [°C]"'))
    head = _HEADER.replace("time_s", "Uhrzeit").replace("plate_C", "Temperatur [°C]")
    content = (
        head + "\n" + "".join(f"2026-11-22 08:15:{10 + 0.004 * n:06.3f},{0.1 * n:.1f},25.0,1.5,22,0\n" for n in range(100))
    )
    (tmp_path / "a.csv").write_bytes(content.encode(encoding))
    log = load_mapped(tmp_path / "a.csv")
    assert np.allclose(log.time_s, 0.004 * np.arange(100), atol=1e-6)
    assert log.samples["inner_backplate"][50] == 22.0


@pytest.mark.parametrize(
    ("letters", "angle", "force"),
    [
        ("gb18030", "位移", "力"),
        ("cp932", "角度", "荷重"),
        ("cp949", "각도", "힘"),
        ("cp1251", "угол", "сила"),
        ("cp1250", "úhel", "síla"),
    ],
)
def test_names_are_found_in_the_letters_of_their_country(tmp_path, capsys, letters, angle, force):
    """A testing machine's table: an empty line, names in the letters of its Windows, units, quoted numbers."""
    signals = {"MotorAngle": f"signal: {angle}, unit: rad", "ClampForceRef": f"signal: {force}, unit: N"}
    mapping = write_mapping(tmp_path, "time: {signal: t}", **signals)
    rows = "".join(f'"{0.02 * n:.4f}","{0.1 * n:.4f}","{2.0 * n:.4f}"\r\n' for n in range(100))
    content = f"\r\nt,{angle},{force}\r\n(s),(mm),(N)\r\n{rows}"
    (tmp_path / "a.csv").write_bytes(content.encode(letters))
    log = load_mapped(tmp_path / "a.csv")
    assert abs(log.samples["angle"][-1] - 9.9) < 0.05 and np.nanmax(log.force_N) == pytest.approx(198.0, abs=1.0)
    # A name that is not there is told beside those that are, not beside the empty line's.
    (tmp_path / "b.csv").write_text("\r\nt,way,load\r\n(s),(mm),(N)\r\n" + rows)
    with pytest.raises(InputError, match="no such column; the table has t, way, load"):
        mapping.read(tmp_path / "b.csv")
    assert "the header names 0" not in capsys.readouterr().err


def test_a_speed_that_is_another_motion_than_the_angle_is_left_out(tmp_path, capsys):
    """The stamps of a busy computer, beside which a drive's own speed would lose the angle's zero again and again."""
    time_s = 0.004 * np.arange(2000)
    columns = columns_of(time_s, angle_rad=30.0 * (1.0 - np.cos(3.0 * time_s)), current_A=np.sin(3.0 * time_s))
    true = 90.0 * np.sin(3.0 * time_s)
    for speed, is_said in ((true, False), (-true, True)):
        samples = read(tmp_path, columns | {"speed_rad_per_s": speed}).samples
        assert np.abs(samples["speed"][1:-1] - true[1:-1]).max() < 0.2
        assert ("another motion" in capsys.readouterr().err) == is_said


@pytest.mark.parametrize("load", ["a brake's", "none"])
def test_a_few_late_stamps_cost_a_machine_that_clamps_nothing_no_speed(tmp_path, capsys, load):
    """Two rows in a hundred and fifty are stamped when the one before was sampled. A contact would move with the angle."""
    mapping = (
        foreignkit.COLUMNS if load == "a brake's" else foreignkit.COLUMNS.replace("{signal: force_N, unit: N}", "{value: 0}")
    )
    true_s = 0.004 * np.arange(3000)
    speed = 200.0 * np.sin(2.0 * true_s)
    stamps = true_s.copy()
    for first in range(100, 3000, 150):
        stamps[first : first + 2] = true_s[first - 1 : first + 1]
    columns = columns_of(stamps, angle_rad=100.0 * (1.0 - np.cos(2.0 * true_s)), speed_rad_per_s=speed)
    log = read(tmp_path, columns, mapping)
    off = np.abs(log.samples["speed"] - np.interp(log.time_s, true_s, speed))[5:-5].max()
    assert ("another motion" in capsys.readouterr().err, off > 50.0) == 2 * (load == "a brake's",)


@pytest.mark.parametrize("slips_rad", [0.0, 2.0])
def test_stamps_that_jitter_are_no_other_motion_of_a_machine_that_clamps_nothing(tmp_path, capsys, slips_rad):
    """A robot's controller at 100 Hz, each row stamped up to half a period late or early: what one step lacks the next ones
    make up for. An angle that slips in one step of ten does not come back."""
    random, true_s = np.random.default_rng(1), 0.01 * np.arange(3000)
    speed = 120.0 * np.sin(2.0 * true_s)
    angle = 60.0 * (1.0 - np.cos(2.0 * true_s)) + slips_rad * np.cumsum(random.random(3000) < 0.1)
    stamps = np.sort(true_s + random.uniform(-0.005, 0.005, 3000))
    columns = columns_of(stamps, angle_rad=angle, speed_rad_per_s=speed)
    log = read(tmp_path, columns, foreignkit.COLUMNS.replace("{signal: force_N, unit: N}", "{value: 0}"))
    off = np.abs(log.samples["speed"] - np.interp(log.time_s, true_s, speed))[5:-5].max()
    assert ("another motion" in capsys.readouterr().err, off > 10.0) == 2 * (slips_rad > 0.0,)


@pytest.mark.parametrize(("way_rad", "told"), [(40.0, "goes from 22000 to 22040 rad"), (5000.0, "covers 5000 rad, more than")])
def test_an_angle_beyond_our_message_is_told_as_what_it_is(tmp_path, capsys, way_rad, told):
    """A stage whose zero is elsewhere moves by little; a motor that turns on goes far."""
    time_s = 0.004 * np.arange(8000)
    read(tmp_path, columns_of(time_s, angle_rad=22_000.0 + 0.5 * way_rad * (1.0 - np.cos(0.2 * time_s))))
    said = capsys.readouterr().err
    assert f"MotorAngle {told}" in said and ("`offset: -22000`" in said) == (way_rad < 3355.0)


def test_a_speed_of_a_motion_too_fast_for_its_samples_is_not_called_a_wrong_unit(tmp_path, capsys):
    """A motor that swings at 20 Hz, sampled at 67: between two samples nobody knows the way."""
    time_s = 0.015 * np.arange(2000)
    motion = {"angle_rad": 0.15 * np.sin(125.6 * time_s), "speed_rad_per_s": 18.84 * np.cos(125.6 * time_s)}
    read(tmp_path, columns_of(time_s, **motion))
    assert "times as fast" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.csv", "time_s,angle_rad\n0,0\n", "current_A: no such column; the table has time_s, angle_rad"),
        ("a.csv", "t,angle\n0,0\n", "time_s: no such column; the table has t, angle"),
        (
            "a.csv",
            ",".join(["time_s", *map("x{}".format, range(98)), "angle_deg"]) + "\n0" + 99 * ",0",
            "angle_rad: no such column; the table has angle_deg, ",
        ),
        ("a.csv", _HEADER + "\n0,x,0,0,0,0\n", "expected a column of numbers"),
        ("a.csv", _HEADER + "\n" + ",1,0,0,0,0\n" * 9, "no value of angle_rad"),
        ("a.csv", "", "not readable"),
        (
            "a.csv",
            _HEADER + "\n0,0,0,0,0,0\n" + "0,0,0,0\n" * 9,
            "9 of 10 rows have another number of cells than 6, the first of them 4",
        ),
        ("a.csv", _HEADER + "\n0,,,0,0,0\n", "no value of angle_rad"),
        ("a.parquet", "no parquet", "not readable"),
        ("a.mf4", "no measurement", "not readable as a measurement"),
        ("a.blf", "", "expected a table"),
    ],
)
def test_a_faulty_table_is_refused_in_one_line(tmp_path, capsys, name, content, expected):
    if name.endswith("mf4"):
        pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    (tmp_path / name).write_text(content)
    assert main(["replay", str(tmp_path / name), "--mapping", str(tmp_path / "mapping.yaml")]) == 2
    *_notes, line = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{tmp_path / name}: ") and expected in line, line


def test_a_table_without_times_is_read_at_the_rate_of_its_rows(columns, tmp_path):
    """Its first column has no name, as a table that counts its rows has none."""
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    columns["time_s"] = columns["time_s"][0] + 0.004 * np.arange(len(columns["time_s"]))
    path, log = foreignkit.write_table(tmp_path / "a.csv", columns), {}
    for time in ("time: {rate_Hz: 250}", "time: {signal: column 1}"):
        path.write_text(path.read_text().replace('"time_s"', '""', 1))
        (tmp_path / "mapping.yaml").write_text(foreignkit.COLUMNS.replace("time: {signal: time_s}", time))
        log[time] = load_mapped(path)
    counted, timed = log.values()
    assert np.array_equal(counted.samples["angle"], timed.samples["angle"])
    assert np.diff(counted.time_ns) == pytest.approx(np.diff(timed.time_ns), abs=1e3)


def test_a_column_may_count_instead_of_telling_a_time(columns, tmp_path):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    timed = load_mapped(foreignkit.write_table(tmp_path / "a.csv", columns))
    counts = np.rint(8000.0 * columns["time_s"]).astype(np.int64)
    foreignkit.write_table(tmp_path / "b.csv", columns | {"time_s": counts})
    (tmp_path / "mapping.yaml").write_text(foreignkit.COLUMNS.replace("signal: time_s", "signal: time_s, rate_Hz: 8000"))
    counted = load_mapped(tmp_path / "b.csv")
    assert counted.time_ns == pytest.approx(timed.time_ns, abs=1e9 / 8000.0)
    _assert_same(counted.samples, timed.samples)


def test_a_matrix_whose_rows_end_with_semicolons_is_a_table(columns, tmp_path, capsys):
    """As MATLAB and a motor drive's firmware write it: comments, a header and units behind %, rows of nan while nothing was
    measured yet."""
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    header, *rows = foreignkit.write_table(tmp_path / "a.csv", columns).read_text().split()
    plain = load_mapped(tmp_path / "a.csv")
    capsys.readouterr()
    nothing = ",".join(["nan"] * len(header.split(",")))
    lines = ["%Measured on the bench, axis 0", "", "%" + header, "%[s],[rad]", f"{nothing};", *(f"{row};" for row in rows)]
    (tmp_path / "b.csv").write_text("\n".join(lines) + "\n")
    log = load_mapped(tmp_path / "b.csv")
    _assert_same(log.samples, plain.samples)
    assert capsys.readouterr().err == ""


def _written(path: Path, variables: dict) -> Path:
    if path.suffix == ".mat":
        savemat(path, variables)
    else:
        np.savez(path, **variables)
    return path


@pytest.mark.parametrize("ending", [".mat", ".npz"])
def test_variables_of_matlab_and_numpy_are_columns(columns, tmp_path, ending):
    plain = read(tmp_path, columns)
    path = _written(tmp_path / f"a{ending}", columns | {"rate": 250.0, "rig": "A", "plate_C": columns["plate_C"].astype(int)})
    _assert_same(load_mapped(path).samples, plain.samples)
    motion = np.column_stack([columns["angle_rad"], columns["speed_rad_per_s"]])
    rest = {name: values for name, values in columns.items() if name not in ("angle_rad", "speed_rad_per_s", "force_N")}
    mapping = foreignkit.COLUMNS.replace("angle_rad", "motion column 1").replace("speed_rad_per_s", "motion column 2")
    if ending == ".mat":
        mapping = mapping.replace("signal: force_N", "signal: cell.load.N")
        cell = {"cell": {"load": {"N": columns["force_N"]}, "serial": 7}}
    else:
        cell = {"force_N": columns["force_N"]}
    (tmp_path / "mapping.yaml").write_text(mapping)
    path = _written(tmp_path / f"b{ending}", rest | cell | {"motion": motion.T})
    _assert_same(load_mapped(path).samples, plain.samples)


def _matlab_with_references(path: Path, angle: np.ndarray, signals: list[np.ndarray], time: np.ndarray) -> None:
    """As MATLAB 7.3 keeps cells and arrays of structures: references to parts that stand elsewhere."""
    h5py = pytest.importorskip("h5py", reason="NOT RUN: the formats extra is not installed")
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, whose, values in (("out/signals/values", "", signals), ("cells", "cell", [angle])):
            found = file.create_dataset(name, (1, len(values)), dtype=h5py.ref_dtype)
            if whose:
                found.attrs["MATLAB_class"] = np.bytes_(whose)
            for number, part in enumerate(values):
                file[f"#refs#/{whose}{number}"] = part[None]
                found[0, number] = file[f"#refs#/{whose}{number}"].ref
        file["time"] = time[None]
        file["tt"] = np.zeros((1, 6), np.uint32)
        file["tt"].attrs.update({"MATLAB_class": np.bytes_("timetable"), "MATLAB_object_decode": 3})
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def _element(kind: int, data: bytes) -> bytes:
    """Of a file of MATLAB 5."""
    return np.array([kind, len(data)], "<u4").tobytes() + data + bytes(-len(data) % 8)


#: A timetable as MATLAB 5 keeps it, named tt: flags of an object of unknown size, three texts, a number.
_TIMETABLE = _element(
    14,
    _element(6, np.array([17, 0], "<u4").tobytes())
    + b"".join(_element(1, text) for text in (b"tt", b"MCOS", b"timetable"))
    + _element(
        14,
        _element(6, np.array([13, 0], "<u4").tobytes())
        + _element(5, np.array([1, 1], "<i4").tobytes())
        + _element(1, b"")
        + _element(6, np.array([1], "<u4").tobytes()),
    ),
)


@pytest.mark.parametrize("version", [5, 7])
def test_cells_and_structures_of_matlab_are_named_as_matlab_does(columns, tmp_path, capsys, version):
    """Simulink's structure with time has an array of structures; a timetable only MATLAB reads, which is said of it."""
    path = tmp_path / "a.mat"
    signals = [columns["current_A"], columns["force_N"]]
    if version == 5:
        parts = np.zeros(2, [("values", object), ("label", object)])
        parts["values"], parts["label"] = [values[:, None] for values in signals], ["i", "F"]
        cells = np.zeros(1, object)
        cells[0] = columns["angle_rad"]
        savemat(path, {"out": {"signals": parts}, "cells": np.append(cells, ["a"]), "time": columns["time_s"]})
        path.write_bytes(path.read_bytes() + _TIMETABLE)
    else:
        _matlab_with_references(path, columns["angle_rad"], signals, columns["time_s"])
    names = [f"signal: {name}, unit: " for name in ("'cells{1}'", "out.signals(1).values", "out.signals(2).values")]
    mapped = {"MotorAngle": names[0] + "rad", "CurrentQ": names[1] + "A", "ClampForceRef": names[2] + "N"}
    write_mapping(tmp_path, "time: {signal: time}", **mapped)
    log = load_mapped(path)
    assert "tt is a timetable of MATLAB, which only MATLAB reads" in capsys.readouterr().err
    assert np.abs(log.samples["angle"] - columns["angle_rad"]).max() < 2e-4
    assert np.abs((log.samples["current_q"] - columns["current_A"])[1:]).max() < 0.02
    assert np.nanmax(np.abs(log.force_N - columns["force_N"])) < 0.1
    (tmp_path / "mapping.yaml").write_text((tmp_path / "mapping.yaml").read_text().replace("(2)", "(3)"))
    with pytest.raises(InputError, match=r"values: no such variable of numbers; it has .*out\.signals\(2\)\.values"):
        Mapping(tmp_path / "mapping.yaml").read(path)


@pytest.mark.parametrize("by_place", [True, False])
def test_values_with_a_time_beside_each_go_by_that(tmp_path, capsys, by_place):
    """A recorder's channels have rates of their own, and columns that end early."""
    time_s = np.arange(5000) / 250.0
    angle = 30.0 * (1.0 - np.cos(time_s))
    columns = [("Time (s)", time_s), ("Angle", angle), ("Time (s)", time_s[::2]), ("Current", np.cos(time_s)[::2])]
    columns += [("Time (s)", time_s[::5]), ("Force", 100.0 * angle[::5])]
    rows = [[f"{values[row]:.6f}" if row < len(values) else "" for _, values in columns] for row in range(5000)]
    lines = [",".join(name for name, _ in columns), *map(",".join, rows)]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    names = ["column 2", "column 4", "column 6"] if by_place else ["Angle", "Current", "Force"]
    angle_, current, force = (f"signal: {name}, unit: {unit}" for name, unit in zip(names, ("rad", "A", "N"), strict=True))
    mapped = {"MotorAngle": angle_, "CurrentQ": current + ", mean_ms: 0", "ClampForceRef": force}
    write_mapping(tmp_path, "time: {signal: column 1}", **mapped)
    log = load_mapped(tmp_path / "a.csv")
    assert "each value goes by the last of them before it" in capsys.readouterr().err
    known = np.isfinite(log.force_N)
    assert known.mean() > 0.99 and log.samples["has_current"].mean() > 0.99
    assert np.abs(log.force_N - 100.0 * log.samples["angle"])[known].max() < 60.0
    assert np.abs(log.samples["current_q"] - np.cos(log.time_s))[log.samples["has_current"]].max() < 0.03


def test_of_a_recording_and_its_description_the_signals_are_offered(tmp_path):
    """An object of system identification has a dozen lists beside its signals."""
    experiments = np.empty(3, object)
    experiments[:] = [np.random.default_rng(n).normal(size=(300, 2)) for n in range(3)]
    described = {f"Current{n}": np.arange(3.0) for n in range(30)}
    savemat(tmp_path / "a.mat", {"data": {"InputData": experiments, **described}})
    mapping = write_mapping(tmp_path, "time: {rate_Hz: 250}", MotorAngle="signal: Current, unit: rad")
    with pytest.raises(InputError, match=r"it has (data\.InputData\{\d\} column \d(, )?){6}$"):
        mapping.read(tmp_path / "a.mat")


def test_numbers_and_texts_of_an_array_of_structures_are_columns(tmp_path):
    rows = np.zeros(200, [("at", object), ("angle", object)])
    rows["at"] = [f"2026-01-01T00:00:{0.004 * n:09.6f}" for n in range(200)]
    rows["angle"] = [math.sin(0.05 * n) for n in range(200)]
    savemat(tmp_path / "a.mat", {"s": rows})
    write_mapping(tmp_path, "time: {signal: s.at}", MotorAngle="signal: s.angle, unit: rad")
    log = load_mapped(tmp_path / "a.mat")
    assert log.time_s[-1] == pytest.approx(0.792, abs=0.005)
    assert log.samples["angle"][-100:] == pytest.approx(np.sin(0.05 * np.arange(99, 199)), abs=2e-4)


def test_topics_of_several_senders_in_one_table_keep_their_own_times(columns, tmp_path, capsys):
    """Joined by their stamps, each in rows of its own: two of them within a fraction of a millisecond are no burst."""
    rows = []
    for n, time_s in enumerate(columns["time_s"]):
        angle, speed, current, plate, force = (f"{columns[name][n]:.6g}" for name in _HEADER.split(",")[1:])
        rows += [f"{time_s:.6f},{angle},{speed},,,", f"{time_s + 3e-4:.6f},,,{current},,"]
        rows += [f"{time_s + 7e-4:.6f},,,,{plate},{force}"] * (n % 5 == 0)
    samples = _read_text(tmp_path, "\n".join([_HEADER, *rows]) + "\n").samples
    assert "bunches" not in capsys.readouterr().err
    assert len(samples) == len(columns["time_s"])
    assert np.abs(samples["angle"] - columns["angle_rad"]).max() < 1e-3


def _write_workbook(path: Path, sheets: dict[str, list]) -> None:
    """The least that is a workbook."""
    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    relations = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    package = "http://schemas.openxmlformats.org/package/2006/relationships"

    def cell(value) -> str:
        return f'<c t="str"><v>{value}</v></c>' if isinstance(value, str) else f"<c><v>{value!r}</v></c>"

    listed = "".join(f'<sheet name="{name}" sheetId="{n}" r:id="r{n}"/>' for n, name in enumerate(sheets, 1))
    where = "".join(
        f'<Relationship Id="r{n}" Type="{relations}/worksheet" Target="worksheets/{n}.xml"/>'
        for n in range(1, len(sheets) + 1)
    )
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("[Content_Types].xml", f'<Types xmlns="{package.replace("relationships", "content-types")}"/>')
        root = f'<Relationship Id="r1" Type="{relations}/officeDocument" Target="xl/workbook.xml"/>'
        file.writestr("_rels/.rels", f'<Relationships xmlns="{package}">{root}</Relationships>')
        file.writestr(
            "xl/workbook.xml", f'<workbook xmlns="{main}" xmlns:r="{relations}"><sheets>{listed}</sheets></workbook>'
        )
        file.writestr("xl/_rels/workbook.xml.rels", f'<Relationships xmlns="{package}">{where}</Relationships>')
        for n, rows in enumerate(sheets.values(), 1):
            text = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
            file.writestr(f"xl/worksheets/{n}.xml", f'<worksheet xmlns="{main}"><sheetData>{text}</sheetData></worksheet>')


def _as_file(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """A table in the format of the path's ending, as its tools write it."""
    if path.suffix == ".feather":
        pyarrow.feather.write_feather(pyarrow.table(columns), path)
    elif path.suffix in (".h5", ".mat"):
        h5py = pytest.importorskip("h5py", reason="NOT RUN: the formats extra is not installed")
        with h5py.File(path, "w", userblock_size=512 if path.suffix == ".mat" else 0) as file:
            for name, values in columns.items():
                # MATLAB's vectors are matrices of one row.
                file[f"log/{name}"] = values[None]
        if path.suffix == ".mat":
            with path.open("r+b") as file:
                file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    elif path.suffix == ".xlsx":
        pytest.importorskip("python_calamine", reason="NOT RUN: the formats extra is not installed")
        rows = [
            ["my test bench"],
            list(columns),
            ["s", "m"],
            *zip(*(values.tolist() for values in columns.values()), strict=True),
        ]
        _write_workbook(path, {"notes": [["of Monday"]], "data": rows})
    elif path.suffix == ".tdms":
        nptdms = pytest.importorskip("nptdms", reason="NOT RUN: the formats extra is not installed")
        with nptdms.TdmsWriter(path) as file:
            file.write_segment([nptdms.ChannelObject("log", name, values) for name, values in columns.items()])
    elif path.suffix == ".json":
        path.write_text(json.dumps({"rig": "A", "log": {name: values.tolist() for name, values in columns.items()}}))
    elif path.suffix == ".ndjson":
        # pandas numbers the rows of each column.
        numbered = {name: {str(row): value for row, value in enumerate(values.tolist())} for name, values in columns.items()}
        path.write_text(json.dumps({"log": numbered}))
    elif path.suffix == ".jsonl":
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        lines = [json.dumps({"log": dict(zip(columns, row, strict=True))}) for row in rows]
        path.write_text("\n".join([*lines, lines[0][:20]]))
    else:
        np.save(path, np.column_stack(list(columns.values())))
    return path


@pytest.mark.parametrize("ending", [".xlsx", ".h5", ".mat", ".tdms", ".json", ".jsonl", ".ndjson", ".feather", ".npy"])
def test_a_table_is_the_same_in_every_format(columns, tmp_path, capsys, ending):
    """The format goes by how the file begins where that tells it, not by its name."""
    plain = read(tmp_path, columns)
    mapping = foreignkit.COLUMNS
    for place, name in enumerate(columns, 1):
        theirs = {".npy": f"column {place}", ".feather": name, ".xlsx": name}.get(ending, f"log.{name}")
        mapping = mapping.replace(f"signal: {name}", f"signal: {theirs}")
    (tmp_path / "mapping.yaml").write_text(mapping)
    path = _as_file(tmp_path / f"b{ending}", columns)
    if "json" not in ending:
        path = path.rename(tmp_path / "b.txt")
    _assert_same(load_mapped(path).samples, plain.samples)
    assert ("its last line is cut off" in capsys.readouterr().err) == (ending == ".jsonl")


def _long(line: str) -> str:
    """A row for each value: an angle every 4 ms, and what else is recorded beside it."""
    rows = []
    for tick in range(1000):
        stamp = f"2026-01-01 08:{tick // 250:02d}:{tick % 250 * 0.24:06.3f}"
        rows += [line.format(stamp, "angle", f"{math.sin(0.01 * tick):.5f}"), line.format(stamp, "mode", "RUN")]
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("text", "time"),
    [
        (_long("{1} {0} {2}  "), "signal: column 3, name: column 1, value: column 4"),
        ("#group,false\n,_time,_value,_field\n" + _long(",{0},{2},{1}"), "signal: _time, name: _field, value: _value"),
        ("tag;time;value\n" + _long("{1};{0};{2}").replace(".", ","), "signal: time, name: tag, value: value"),
    ],
    ids=["monitor", "database", "historian"],
)
def test_a_table_may_have_a_row_for_each_value(tmp_path, text, time):
    (tmp_path / "a.txt").write_text(text)
    mapping = write_mapping(tmp_path, f"time: {{{time}}}", MotorAngle="signal: angle, unit: rad, scale: 20")
    found = Decoder().columns(mapping.read(tmp_path / "a.txt"), "EMB_FL_Resolver")
    seconds = 1e-9 * (found["time_ns"] - found["time_ns"][0])
    assert seconds[-1] == pytest.approx(239.76, abs=0.3)
    assert found["MotorAngle"] == pytest.approx(20.0 * np.sin(0.01 * seconds / 0.24), abs=0.1)
    misspelt = write_mapping(tmp_path, f"time: {{{time}}}", MotorAngle="signal: angel, unit: rad")
    with pytest.raises(InputError, match="angel: no row has this name; the table has angle, mode"):
        misspelt.read(tmp_path / "a.txt")


def test_of_sheets_alike_the_one_that_is_read_is_named(tmp_path, capsys):
    pytest.importorskip("python_calamine", reason="NOT RUN: the formats extra is not installed")
    rows = [["t", "x"], *([0.004 * n, math.sin(0.1 * n)] for n in range(300))]
    _write_workbook(tmp_path / "a.xlsx", {"first": rows, "second": rows})
    write_mapping(tmp_path, "time: {signal: t}", MotorAngle="signal: x, unit: rad").read(tmp_path / "a.xlsx")
    assert "2 sheets have these columns (first, second); the first alone is read" in capsys.readouterr().err


def test_a_time_may_be_a_duration_and_a_name_have_a_blank_that_breaks_no_line(columns, tmp_path):
    mapping = foreignkit.COLUMNS.replace("signal: force_N", "signal: clamp force")
    # A duration has its unit, whatever the mapping says.
    foreignkit.write_rig(tmp_path, mapping.replace("{signal: time_s}", "{signal: time_s, unit: ms}"))
    table = pyarrow.table(columns).set_column(
        0, "time_s", pyarrow.array(np.rint(1e6 * columns["time_s"]).astype(np.int64)).cast(pyarrow.duration("us"))
    )
    names = ["clamp\N{NO-BREAK SPACE}force" if name == "force_N" else name for name in table.column_names]
    pyarrow.parquet.write_table(table.rename_columns(names), tmp_path / "a.parquet")
    log = load_mapped(tmp_path / "a.parquet")
    assert log.time_s == pytest.approx(columns["time_s"] - columns["time_s"][0], abs=1e-5)
    assert np.nanmax(log.force_N) == pytest.approx(np.max(columns["force_N"]), rel=1e-3)


@pytest.mark.parametrize("ending", [".parquet", ".npz"])
def test_dates_and_structures_are_read_as_libraries_keep_them(columns, tmp_path, ending):
    path = tmp_path / f"a{ending}"
    at = np.datetime64("2026-01-01") + np.rint(1e9 * columns["time_s"]).astype("timedelta64[ns]")
    drive = pyarrow.StructArray.from_arrays([pyarrow.array(columns["angle_rad"])], ["angle"])
    foreignkit.write_rig(
        tmp_path, foreignkit.COLUMNS.replace("angle_rad", "drive.angle").replace("signal: time_s", "signal: time_s, unit: ms")
    )
    if ending == ".parquet":
        pyarrow.parquet.write_table(pyarrow.table(columns | {"time_s": at, "drive": drive}), path)
    else:
        np.savez(path, **(columns | {"time_s": at, "drive.angle": columns["angle_rad"]}))
    log = load_mapped(path)
    assert log.time_s == pytest.approx(columns["time_s"] - columns["time_s"][0], abs=1e-5)
    assert np.abs(log.samples["angle"] - columns["angle_rad"]).max() < 2e-4


def test_batches_of_several_lengths_are_one_recording(columns, tmp_path):
    """Of a logger that empties its buffer now and then, and of a controller that goes through steps: part after part."""
    plain, mapping = tmp_path / "plain.json", foreignkit.COLUMNS
    foreignkit.write_rig(tmp_path, mapping)
    plain.write_text(json.dumps({name: values.tolist() for name, values in columns.items()}))
    whole = load_mapped(plain)
    for name in columns:
        mapping = mapping.replace(f"signal: {name}", f"signal: steps.graph.{name}")
    (tmp_path / "mapping.yaml").write_text(mapping)
    parts = [{name: values[first:last].tolist() for name, values in columns.items()} for first, last in ((0, 90), (90, None))]
    steps = [{"name": "Finding", "graph": parts[0]}, {"name": "pause"}, {"name": "Clamping", "graph": parts[1]}]
    (tmp_path / "steps.json").write_text(json.dumps({"steps": steps}))
    _assert_same(load_mapped(tmp_path / "steps.json").samples, whole.samples)


def test_stamps_of_json_lines_may_be_dates(tmp_path):
    rows = [{"at": f"2026-03-01T12:00:{second:02d}.500+01:00", "plate": 20.0 + second} for second in range(60)]
    (tmp_path / "a.jsonl").write_text("\n".join(map(json.dumps, rows)))
    write_mapping(tmp_path, "time: {signal: at}", MotorAngle="value: 0", InnerBackplateTemp="signal: plate, unit: degC")
    log = load_mapped(tmp_path / "a.jsonl")
    assert log.time_ns[-1] - log.time_ns[0] == pytest.approx(59e9, abs=2e9)
    assert log.samples["inner_backplate"][-1] == pytest.approx(79.0, abs=1.1)


class _Hostile:
    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_nothing_that_a_numpy_file_holds_is_executed(tmp_path):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    path = _written(tmp_path / "a.npz", {"angle_rad": np.array([_Hostile(tmp_path / "executed")], object)})
    with pytest.raises(InputError, match=r"not readable: .*pickle"):
        load_mapped(path)
    assert not (tmp_path / "executed").exists()


def test_a_channel_that_is_there_twice_is_told_by_its_group(tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    times = 0.004 * np.arange(100)
    with asammdf.MDF() as file:
        for factor in (1.0, 2.0):
            file.append([asammdf.Signal(factor * times, times, name="angle")])
        file.save(tmp_path / "a.mf4")
    mapping = "format: 1\nsignals:\n  EMB_FL_Resolver.MotorAngle: {signal: angle, unit: rad}\n"
    for signal, said in (
        ("angle", "2 channels have that name; expected one of `angle group 0`, `angle group 1`"),
        ("angel", "angel: no such channel; the measurement has .*angle"),
        ("angle group 7", "angle group 7: no such channel"),
    ):
        (tmp_path / "mapping.yaml").write_text(mapping.replace("angle,", f"{signal},"))
        with pytest.raises(InputError, match=said):
            Mapping(tmp_path / "mapping.yaml").read(tmp_path / "a.mf4")
    (tmp_path / "mapping.yaml").write_text(mapping.replace("angle,", "angle group 1,"))
    assert load_mapped(tmp_path / "a.mf4").samples["angle"][50] == pytest.approx(0.4)


def test_a_channel_of_words_has_its_numbers_and_one_of_several_values_is_refused(tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    times = 0.004 * np.arange(100)
    pairs = np.rec.fromarrays([np.column_stack([times, times])], [("pair", "<f8", (2,))])
    words = {"val_0": 0, "text_0": b"off", "val_1": 1, "text_1": b"on"}
    with asammdf.MDF() as file:
        file.append(
            [
                asammdf.Signal(np.arange(100, dtype=np.uint8) // 50, times, name="switch", conversion=words),
                asammdf.Signal(pairs, times, name="pair"),
            ]
        )
        file.save(tmp_path / "a.mf4")
    mapping = "format: 1\nsignals:\n  EMB_FL_Resolver.MotorAngle: {signal: switch, unit: rad, scale: 5}\n"
    (tmp_path / "mapping.yaml").write_text(mapping)
    angle = load_mapped(tmp_path / "a.mf4").samples["angle"]
    assert angle[[10, 90]].tolist() == pytest.approx([0.0, 5.0], abs=1e-3)
    (tmp_path / "mapping.yaml").write_text(mapping.replace("switch", "pair"))
    with pytest.raises(InputError, match="pair: each of its samples has several values; expected a channel of one"):
        Mapping(tmp_path / "mapping.yaml").read(tmp_path / "a.mf4")


def test_estimates_of_another_actuator_are_said_to_be(bus, capsys):
    arguments = [str(bus), "--mapping", str(bus.parent / "mapping.yaml")]
    line = "no --calibration: estimates are those of another actuator, rig-A"
    for calibration in ([], ["--calibration", str(bus.parent / "calibration.yaml")]):
        assert main(["replay", *arguments, *calibration]) == 0
        assert (line in capsys.readouterr().err) == (not calibration)


def test_variables_that_are_no_table_are_refused(columns, tmp_path):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    for faulty, expected in (
        (columns | {"angle_rad": columns["angle_rad"][:-1]}, "variables of one length expected, found .*angle_rad 2998"),
        ({name: values for name, values in columns.items() if name != "current_A"}, "current_A: no such variable of numbers"),
    ):
        path = _written(tmp_path / "a.npz", faulty)
        with pytest.raises(InputError, match=expected):
            load_mapped(path)
    for content, ending in (
        (b"no archive", ".npz"),
        (b"PK\x03\x04", ".npz"),
        (b"PK\x03\x04", ".xlsx"),
        (b"\xd0\xcf\x11\xe0", ".xls"),
        (b"MATLAB 5.0", ".mat"),
        (bytes(200), ".mat"),
        (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400), ".mat"),
        (b"\x89HDF" + bytes(200), ".h5"),
        (b"TDSm" + bytes(200), ".tdms"),
        (b"\x93NUMPY" + bytes(20), ".npy"),
        (b"ARROW1" + bytes(200), ".feather"),
        (b'{"angle_rad": [1, 2', ".json"),
        (b'{"a": 1}\nx\n{"a": 2}', ".jsonl"),
    ):
        path = tmp_path / f"b{ending}"
        path.write_bytes(content)
        with pytest.raises(InputError, match="not readable"):
            load_mapped(path)


def test_columns_are_called_by_their_place_where_names_do_not_tell(columns, tmp_path):
    """Two instruments in one table, each with its times, as an acquisition tool writes them; a first value that is none."""
    plain = read(tmp_path, columns)
    names, values = list(columns), [*columns.values(), columns["time_s"]]
    rows = [",".join(map(str, row)) for row in zip(*values, strict=True)]
    tool = 'Timestamp,2020-03-16 17:04:51,Unit,"V"\nInterval,0.004\n'
    (tmp_path / "a.csv").write_text("\n".join([tool + ",".join([*names, "time_s"]), *rows]))
    (tmp_path / "b.csv").write_text("\n".join([",".join(["nan"] * 5 + ["inf", "0", "nan"]), *(row + ",nan" for row in rows)]))
    for name, mapping in (
        ("a", foreignkit.COLUMNS.replace("signal: time_s", "signal: column 1")),
        ("a", _by_place()),
        ("b", _by_place()),
    ):
        (tmp_path / "mapping.yaml").write_text(mapping)
        log = load_mapped(tmp_path / f"{name}.csv")
        _assert_same(log.samples, plain.samples)
    (tmp_path / "mapping.yaml").write_text(foreignkit.COLUMNS.replace("signal: time_s", "signal: column 8"))
    with pytest.raises(InputError, match="column 8: no such column; the table has time_s"):
        load_mapped(tmp_path / "a.csv")
    (tmp_path / "mapping.yaml").write_text(foreignkit.COLUMNS)
    with pytest.raises(InputError, match="time_s: 2 such columns, of which `column N` is one by its place"):
        load_mapped(tmp_path / "a.csv")


def _assert_same(one: np.ndarray, other: np.ndarray) -> None:
    for name in other.dtype.names:
        np.testing.assert_array_equal(one[name], other[name], name)


def _by_place() -> str:
    mapping = foreignkit.COLUMNS
    for number, name in enumerate(_HEADER.split(",")):
        mapping = mapping.replace(f"signal: {name}", f"signal: column {number + 1}")
    return mapping


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("{cells},0", "rows have 7 cells, the header names 6; the last are column 7"),
        ('"{number}",{cells}', ""),
        ('"run no. {number}",{cells}', ""),
        ("{number},{cells}", ""),
        ("{cells},", ""),
    ],
)
def test_rows_with_more_cells_than_the_header_are_read(columns, tmp_path, capsys, row, said):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    header, *rows = foreignkit.write_table(tmp_path / "a.csv", columns).read_text().split()
    plain = load_mapped(tmp_path / "a.csv")
    capsys.readouterr()
    lines = [header, *(row.format(cells=cells, number=n + 1) for n, cells in enumerate(rows))]
    (tmp_path / "b.csv").write_text("\n".join(lines) + "\n")
    log = load_mapped(tmp_path / "b.csv")
    _assert_same(log.samples, plain.samples)
    assert capsys.readouterr().err == (f"{tmp_path / 'b.csv'}: {said}\n" if said else "")


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ("time: {signal: time_s}", "time: {}", "expected signal (a column), rate_Hz (rows per second), or both"),
        (
            "time: {signal: time_s}",
            "time: {signal: t, rate_Hz: 9, unit: ms}",
            "unit: counts have none; expected unit or rate_Hz",
        ),
        (
            "angle_rad, unit: rad",
            "x, unit: mm",
            "x is a travel in mm, not the motor's angle; state `unit: rad`, and as `scale`",
        ),
        ("speed_rad_per_s, unit: rad/s", "v, unit: mm/s", "v is a travel in mm/s, not the motor's angle; state `unit: rad/s`"),
        ("force_N, unit: N", "force_N, unit: stone", "force_N is in 'stone'; expected N, kN"),
        (
            "VEH_WheelSpeed.WheelSpeedFL: {value: 0}",
            "VEH_WheelSpeed.WheelSpeedFL: {signal: v, unit: km/h}",
            "v is the speed of a tyre in km/h, not the wheel's turning; state `unit: rad/s`, and as `scale` the radians that "
            "the wheel turns for one of them: 0.2778 over the tyre's radius in m",
        ),
    ],
)
def test_what_a_mapping_lacks_is_said_once(tmp_path, before, after, expected):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS.replace(before, after))
    with pytest.raises(InputErrors) as error:
        Mapping(tmp_path / "mapping.yaml")
    [line] = str(error.value).splitlines()
    assert expected in line


@pytest.mark.parametrize(("load", "missed"), [("value: 0", 1), ("signal: force_N, unit: N", 4)], ids=["none", "measured"])
def test_of_a_machine_that_clamps_nothing_no_brakes_messages_are_missed(tmp_path, load, missed):
    signals = {"MotorAngle": "signal: angle_rad, unit: rad", "ClampForceRef": load}
    notes = [n for n in write_mapping(tmp_path, "time: {signal: time_s}", **signals).notes if "is not mapped" in n]
    assert len(notes) == missed and "EMB_FL_Current" in notes[0]


@pytest.mark.parametrize(("unit", "newton"), [("kgf", 9.80665), ("kg", 9.80665), ("lbf", 4.448222), ("daN", 10.0)])
def test_a_load_cell_may_speak_of_the_mass_that_weighs_so_much(columns, tmp_path, unit, newton):
    mapping = foreignkit.COLUMNS.replace("force_N, unit: N", f"force_N, unit: {unit}")
    force = read(tmp_path, columns | {"force_N": columns["force_N"] / newton}, mapping).force_N
    assert np.nanmax(force) == pytest.approx(np.nanmax(columns["force_N"]), rel=1e-3)


def _without(text: str, *words: str) -> str:
    return "".join(line for line in text.splitlines(keepends=True) if not any(word in line for word in words))


@pytest.mark.parametrize(
    ("left_out", "said", "reasons", "most_N"),
    [
        ("CurrentQ", "EMB_FL_Current is not mapped: the force rests on the motor angle alone", {"current lost"}, 30.0),
        ("MotorSpeed", "MotorSpeed is not measured: it is the change of MotorAngle", set(), 30.0),
        ("MotorAngle", "MotorAngle is not measured: it is MotorSpeed added up, which drifts", set(), 60.0),
        ("Thermocouple", "EMB_FL_Thermocouple is not mapped", {"thermocouple lost", "pad temperature uncertain"}, 30.0),
        ("WheelSpeed", "VEH_WheelSpeed is not mapped: the disc may be turning", {"wheel speed lost"}, 120.0),
    ],
)
def test_what_is_missing_is_said_and_the_rest_goes_on(columns, tmp_path, capsys, left_out, said, reasons, most_N):
    """As far as the physics allows, and with a sigma that holds."""
    foreignkit.write_rig(tmp_path, _without(foreignkit.COLUMNS, left_out))
    table = foreignkit.write_table(tmp_path / "stops.parquet", columns)
    figures, notes = _replay(tmp_path, table, capsys)
    assert said in notes
    assert {word for word, share in figures["reasons"].items() if share > 0.9} == reasons
    assert figures["invalid"] < 0.01
    assert figures["force_N"]["fused"]["rmse"] < most_N and figures["force_N"]["inside_two_sigma"] > 0.93


@pytest.mark.parametrize("stands_s", [1.2, 0.0])
def test_a_log_that_begins_clamped_without_status_is_known_after_a_release(tmp_path, capsys, stands_s):
    """And not from where a motor turns round half open, from which the clearance does not count."""
    clearance = foreignkit.parameters()["clearance"]
    low = 0.0 if stands_s else 0.5 * clearance
    ways = [(14.0, 0.5), (clearance + 8.0, 0.5), (low, 0.5), (low, stands_s), (clearance + 12.0, 2.0), (clearance + 12.0, 1.0)]
    angle, at = [], clearance + 8.0
    for target, seconds in ways:
        share = (1.0 - np.cos(np.linspace(0.0, np.pi, round(seconds / foreignkit.FINE_S)))) / 2.0
        angle.append(at + (target - at) * share)
        at = target
    foreignkit.write_rig(tmp_path, _without(foreignkit.COLUMNS, "VEH_Status"))
    columns = foreignkit.sampled(foreignkit.truth(np.concatenate(angle)), 250.0)
    columns = {name: values[50:] for name, values in columns.items()}
    out = tmp_path / "out.parquet"
    _replay(tmp_path, foreignkit.write_table(tmp_path / "a.parquet", columns), capsys, "--output", out)
    table = pyarrow.parquet.read_table(out).to_pandas()
    error, sigma = table["clamp_force_N"] - table["clamp_force_ref_N"], table["clamp_force_sigma_N"]
    assert np.mean(np.abs(error) <= 2.0 * sigma) > 0.93
    assert (sigma[:200] > 1000.0).all() and (sigma.iloc[-200:].max() < 200.0) == bool(stands_s)


def test_neither_status_nor_current_is_said(tmp_path, capsys):
    mapping = foreignkit.write_rig(tmp_path, _without(foreignkit.COLUMNS, "VEH_Status", "CurrentQ"))
    assert main(["check", "--mapping", str(mapping)]) == 0
    assert "the force stays unknown; of a bench say so by `value: 0`" in capsys.readouterr().err


def test_a_rig_without_reference_is_judged_by_nothing(columns, tmp_path, capsys):
    foreignkit.write_rig(tmp_path, _without(foreignkit.COLUMNS, "RIG_"))
    table = foreignkit.write_table(tmp_path / "stops.parquet", columns)
    out = tmp_path / "out.parquet"
    figures, _ = _replay(tmp_path, table, capsys, "--output", out)
    assert figures["force_N"] == {} and figures["temperature_K"] == {}
    assert not [name for name in pyarrow.parquet.read_table(out).column_names if "_ref_" in name]


@pytest.mark.parametrize(
    ("left_out", "expected"),
    [
        (("Resolver",), "expected EMB_c_Resolver.MotorAngle, MotorSpeed or both"),
        (("ParkBrake",), "VEH_Status.ParkBrake: missing"),
    ],
)
def test_what_nothing_can_stand_in_for_is_a_fault(tmp_path, left_out, expected):
    with pytest.raises(InputErrors, match=expected):
        Mapping(foreignkit.write_rig(tmp_path, _without(foreignkit.COLUMNS, *left_out)))


def test_an_angle_that_starts_anew_each_turn_is_put_together(truth, tmp_path):
    columns = {key: values[:3000] for key, values in foreignkit.sampled(truth, 500.0).items()}
    samples = []
    for name, period in (("whole", None), ("turn", 360.0)):
        degrees = np.degrees(columns["angle_rad"]) - 90.0
        mapped = "angle_rad, unit: deg" + (f", period: {period:g}" if period else "")
        foreignkit.write_rig(tmp_path, foreignkit.COLUMNS.replace("angle_rad, unit: rad", mapped))
        table = columns | {"angle_rad": degrees % period if period else degrees}
        path = foreignkit.write_table(tmp_path / f"{name}.parquet", table)
        samples.append(load_mapped(path).samples["angle"])
    assert np.ptp(samples[0]) > 4.0 * np.pi and np.allclose(np.diff(samples[0]), np.diff(samples[1]), atol=4e-4)


def test_a_caliper_is_no_pad(tmp_path):
    text = foreignkit.COLUMNS.replace("InnerBackplateTemp", "CaliperTemp")
    with pytest.raises(InputErrors, match="EMB_FL_Thermocouple: expected InnerBackplateTemp or OuterBackplateTemp"):
        Mapping(foreignkit.write_rig(tmp_path, text))


def test_arrays_are_a_log(truth):
    columns = foreignkit.sampled(truth, 100.0)
    time_s, force_N = columns["time_s"], columns["force_N"]
    motion = (columns["angle_rad"], columns["speed_rad_per_s"], columns["current_A"])
    log = emb_daemon.log_of_arrays(time_s, *motion, inner_backplate_C=22.0, wheel_speed_rad_per_s=0.0, force_N=force_N)
    estimates = emb_daemon.run(log, foreignkit.calibration())
    error = (estimates["force"] - log.force_N)[1:]
    assert np.sqrt(np.nanmean(error**2)) < 40.0 and np.mean(np.abs(error) <= 2.0 * estimates["sigma"][1:]) > 0.93
    columns_of_replay = emb_daemon.table(log, estimates)
    assert {len(column) for column in columns_of_replay.values()} == {len(log.samples)}
    assert np.array_equal(columns_of_replay["clamp_force_N"], estimates["force"]) and "clamp_force_ref_N" in columns_of_replay
    with pytest.raises(InputError, match="one for each sample of"):
        emb_daemon.table(log, estimates[1:])
    without = emb_daemon.log_of_arrays(time_s, columns["angle_rad"])
    assert not without.samples["has_current"].any() and np.isnan(without.force_N).all()
    for wrong, expected in (
        ({"current_mA": motion[2]}, "current_mA: no such column; expected one of angle_rad"),
        ({"force_N": force_N[:5]}, "force_N: expected as many values as times"),
        ({"caliper_C": 20.0}, "expected inner_backplate_C or outer_backplate_C"),
        ({"time_s": np.roll(time_s, 150)}, "arrays: time goes back by"),
        ({"time_s": 1e9 * time_s + 1e10}, "is not a time in s"),
        ({"time_s": np.where(time_s > 1.0, np.nan, time_s)}, "time_s: nan is not a time in s"),
    ):
        with pytest.raises(InputError, match=expected):
            emb_daemon.log_of_arrays(**{"time_s": time_s, "angle_rad": motion[0]} | wrong)
    with pytest.raises(InputError, match="expected at least one of them"):
        emb_daemon.log_of_arrays(time_s, current_A=motion[2])


def test_stamps_of_arrays_are_put_right_as_a_files(columns, capsys):
    time_s, angle_rad = columns["time_s"], columns["angle_rad"]
    right = emb_daemon.log_of_arrays(time_s, angle_rad).samples
    assert capsys.readouterr().err == ""
    twice = np.sort(np.concatenate([np.arange(len(time_s)), np.arange(0, len(time_s), 3)]))
    for stamps, rows, said in (
        (time_s[twice], twice, f"arrays: {len(twice) - len(time_s)} of {len(twice)} values were recorded twice"),
        (np.floor(time_s / 0.01) * 0.01, slice(None), "arrays: stamps come in bunches, one every 10 ms: spread evenly"),
    ):
        samples = emb_daemon.log_of_arrays(stamps, angle_rad[rows]).samples
        assert said in capsys.readouterr().err
        assert len(samples) == len(right) and np.allclose(samples["angle"][20:-20], right["angle"][20:-20], atol=2e-4)


def test_a_log_of_other_ids_is_told_by_them(bus, capsys):
    assert main(["replay", str(bus)]) == 2
    said = capsys.readouterr().err
    assert "no frame of id 0x100, the resolver of corner FL; found 0x18feef01, 0x18feef02; " in said and "--mapping" in said


def test_what_a_log_does_not_hold_is_not_taken_for_used(bus, capsys):
    options = ["--mapping", str(bus.parent / "mapping.yaml"), "--calibration", str(bus.parent / "calibration.yaml")]
    for option, said in (
        (["--corner", "RR"], "nothing of corner RR; it holds FL"),
        (["--measured-torque"], "no brake torque"),
    ):
        assert main(["replay", str(bus), *options, *option]) == 2
        assert said in capsys.readouterr().err


def test_diagnosis_reads_a_bus_of_other_people(bus, monkeypatch, capsys):
    def stop(logs, *_):
        raise InputError(f"{len(logs)} log, {len(logs[0].samples)} samples, {np.nanmax(logs[0].force_N):.0f} N")

    monkeypatch.setattr("emb_daemon.diagnose.diagnosis.diagnose", stop)
    options = ["--mapping", bus.parent / "mapping.yaml", "--calibration", bus.parent / "calibration.yaml"]
    assert main(["diagnose", str(bus), *map(str, options), "--output", str(bus.parent / "found")]) == 2
    log = load_log(bus, read=Mapping(bus.parent / "mapping.yaml").read)
    assert f"1 log, {len(log.samples)} samples, {np.nanmax(log.force_N):.0f} N" in capsys.readouterr().err


def test_a_converted_log_is_replayed_alike(bus, capsys):
    out, mapping = bus.parent / "ours.log", bus.parent / "mapping.yaml"
    assert main(["convert", str(bus), "--mapping", str(mapping), "--output", str(out)]) == 0
    assert f"{out}: " in capsys.readouterr().out
    assert np.array_equal(load_log(out).samples["angle"], load_log(bus, read=Mapping(mapping).read).samples["angle"])
    assert main(["convert", str(bus), "--mapping", str(mapping), "--output", str(bus)]) == 2
    assert "is one of the inputs" in capsys.readouterr().err


def test_a_part_of_a_log_is_that_part_of_the_whole(bus, capsys):
    tables = []
    for name, options in (("whole", []), ("part", ["--from", "2.5", "--to", "4"])):
        out = bus.parent / f"{name}.parquet"
        figures, _ = _replay(bus.parent, bus, capsys, "--output", out, *options)
        tables.append(pyarrow.parquet.read_table(out).to_pandas())
    whole, part = tables
    start = whole["time_s"][0]
    inside = whole[(whole["time_s"] >= start + 2.5) & (whole["time_s"] <= start + 4.0)].reset_index(drop=True)
    assert figures["samples"] == len(part) == pytest.approx(375, abs=1) and abs(len(inside) - len(part)) <= 1
    count = min(len(inside), len(part))
    assert inside["clamp_force_N"][:count].equals(part["clamp_force_N"][:count])
    arguments = ["replay", str(bus), "--mapping", str(bus.parent / "mapping.yaml")]
    sent = bus.parent / "sent.log"
    assert main([*arguments, "--from", "2.5", "--to", "4", "--output", str(sent)]) == 0
    assert read_frames(sent)["time_ns"][0] >= 1e9 * (start + 2.49)
    for wrong in (["--from", "5", "--to", "4"], ["--from", "-1"], ["--to", "nan"], ["--from", "99"]):
        assert main([*arguments, *wrong]) == 2
        assert "--from" in capsys.readouterr().err


def test_the_delays_of_a_busy_machine_are_no_other_rate(rig):
    """A queue that empties in bursts: most frames come early, the rest late, all of them every 4 ms in the mean."""
    frames = read_frames(rig / "static" / "training_5mm.log.gz")
    resolver = np.flatnonzero(frames["can_id"] == 0x100)
    late_ns = np.where(np.arange(len(resolver)) % 5 < 3, 0, 400_000) + 600_000 * (np.arange(len(resolver)) % 5)
    frames["time_ns"][resolver] += late_ns[: len(resolver)]
    frames = frames[np.argsort(frames["time_ns"], kind="stable")]
    times = frames["time_ns"][frames["can_id"] == 0x100]
    assert abs(np.median(np.diff(times)) / 4e6 - 1.0) > 0.05
    assert at_our_rate(frames) is frames


def test_stalls_of_a_busy_machine_are_no_other_rate(rig):
    """It stands for up to seventy milliseconds, now and then, and then sends at once all that was due meanwhile."""
    frames = read_frames(rig / "static" / "training_5mm.log.gz")
    begins = np.cumsum(np.random.default_rng(4).uniform(0.1, 0.3, 1000)) * 1e9 + frames["time_ns"][0]
    ends = begins + np.random.default_rng(5).uniform(0.03, 0.07, 1000) * 1e9
    stall = np.searchsorted(begins, frames["time_ns"], side="right") - 1
    held_up = (stall >= 0) & (frames["time_ns"] < ends[np.maximum(stall, 0)])
    frames["time_ns"][held_up] = ends[stall[held_up]].astype(int)
    frames["time_ns"] = np.maximum.accumulate(frames["time_ns"])
    assert at_our_rate(frames) is frames


def test_a_bench_without_a_motor_is_a_log_of_what_it_measured(tmp_path, capsys, recwarn):
    """A heated rod, one value every two seconds: temperatures arrive, and nothing is said of a motor."""
    foreignkit.write_rig(tmp_path)
    plates = {"InnerBackplateTemp": "signal: near, unit: degC", "OuterBackplateTemp": "signal: far, unit: degC"}
    head, mapped = "time: {signal: t}", plates | {"MotorAngle": "value: 0", "InnerPadTemp2mm": "signal: middle, unit: degC"}
    mapping = write_mapping(tmp_path, head, **mapped)
    rows = "".join(f"{2 * n},{20 + 0.1 * n:.1f},{20 + 0.01 * n:.2f},{20 + 0.05 * n:.2f}\n" for n in range(300))
    (tmp_path / "rod.csv").write_text("t,near,far,middle\n" + rows)
    log = load_mapped(tmp_path / "rod.csv")
    assert capsys.readouterr().err == "" and log.time_s[-1] - log.time_s[0] == pytest.approx(598.0, abs=1.01)
    samples = log.samples
    assert not samples["angle"].any() and np.all(np.diff(samples["time_ns"]) == 1_000_000_000)
    # Nothing was measured oftener, so that a week of it stays small.
    frames = mapping.read(tmp_path / "rod.csv")
    assert len(frames) <= len(np.unique(frames["can_id"])) * (len(samples) + 1)
    half = len(samples) // 2
    assert samples["inner_backplate"][half] == pytest.approx(35.0, abs=0.2)
    assert samples["outer_backplate"][half] == pytest.approx(21.5, abs=0.1)
    times, pads = log.reference.pads["inner"]
    assert pads[0][len(times) // 2] == pytest.approx(27.5, abs=0.2)
    arguments = ["diagnose", "rod.csv", "--mapping", "mapping.yaml", "--calibration", "calibration.yaml", "--output", "found"]
    assert main([word if "." not in word and word != "found" else str(tmp_path / word) for word in arguments]) == 2
    assert "neither a clamp force reference nor motor current to judge by" in capsys.readouterr().err.splitlines()[-1]
    assert not [str(found.message) for found in recwarn if issubclass(found.category, RuntimeWarning)]
    lines = [line for line in mapping.notes if "Resolver" in line]
    assert lines == [f"{tmp_path / 'mapping.yaml'}: EMB_FL_Resolver is constant: the motor stands throughout"]
    write_mapping(tmp_path, head, ClampForceRef="signal: near, unit: N", **mapped)
    fine = load_mapped(tmp_path / "rod.csv")
    assert np.all(np.diff(fine.samples["time_ns"]) == 4_000_000), "a force may be fast"
