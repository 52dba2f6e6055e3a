"""Recordings as recorders make them: what their stamps and columns get wrong, and what a mapping states wrongly."""

import re

import foreignkit
import numpy as np
import pytest
from foreignkit import columns_of, load_mapped, read, write_mapping
from scipy.signal import lfilter

from emb_daemon.cli.main import main
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import SAMPLE
from emb_daemon.logs.columns import Decoder
from emb_daemon.logs.contradictions import _find_late_force, contradictions, starts_anew
from emb_daemon.logs.currents import find_command, other_current, other_motor
from emb_daemon.logs.mapping import Mapping
from emb_daemon.logs.overflow import overflown
from emb_daemon.logs.read import read_frames
from emb_daemon.logs.series import Series
from emb_daemon.logs.stamps import held_rows, in_time, no_values, renewed_rows, strays, without_sign
from emb_daemon.offline import load_log


@pytest.fixture(scope="module")
def truth():
    return foreignkit.truth(foreignkit.random(seconds=3.0))


@pytest.fixture
def columns(truth):
    return foreignkit.sampled(truth, 250.0)


def _twice(columns):
    rows = np.sort(np.concatenate([np.arange(len(columns["time_s"])), np.arange(0, len(columns["time_s"]), 3)]))
    return {name: values[rows] for name, values in columns.items()}


def _coarse(resolution_s):
    return lambda columns: columns | {"time_s": np.floor(columns["time_s"] / resolution_s) * resolution_s}


def _in_batches(columns):
    """Five frames each time that an adapter's queue is emptied, 50 us apart."""
    row = np.arange(len(columns["time_s"]))
    ends = np.minimum(row // 5 * 5 + 4, len(row) - 1)
    return columns | {"time_s": columns["time_s"][ends] + 5e-5 * (row % 5)}


def _since_the_row_before(jitter_s):
    """The time since the row before in place of the time, a first one of none."""
    rng = np.random.default_rng(3)

    def change(columns):
        times = columns["time_s"] + jitter_s * rng.random(len(columns["time_s"]))
        return columns | {"time_s": np.diff(times, prepend=times[0])}

    return change


def _shuffled(columns):
    rows = np.arange(len(columns["time_s"]))
    rows[100:105] = rows[100:105][::-1]
    return {name: values[rows] for name, values in columns.items()}


@pytest.mark.parametrize(
    ("change", "said", "most_s"),
    [
        (_twice, "were recorded twice: left out", 0.0001),
        (_coarse(0.010), "stamps come in bunches, one every 10 ms", 0.0015),
        (_coarse(0.005), "stamps come in bunches, one every 5 ms", 0.0015),
        (_coarse(0.0156), "stamps come in bunches, one every 15.6 ms", 0.0015),
        (_since_the_row_before(0.0), "time_s holds the time since the row before: added up", 0.0001),
        (_since_the_row_before(0.0005), "time_s holds the time since the row before: added up", 0.0015),
        (_in_batches, "stamps come in bunches, one every 19.8 ms", 0.0015),
        (_shuffled, "", 0.0001),
    ],
    ids=["twice", "10 ms", "5 ms", "15.6 ms", "steps", "jittered steps", "batches", "out of order"],
)  # fmt: skip
def test_stamps_of_recorders_are_put_right(columns, tmp_path, capsys, change, said, most_s):
    """Sample by sample the log is the one with right stamps, but for a delay that all its signals share."""
    samples = read(tmp_path, columns).samples
    assert capsys.readouterr().err == ""
    log = read(tmp_path, change(columns))
    assert said in capsys.readouterr().err
    assert len(log.samples) == len(samples)
    for name in ("angle", "speed", "current_q", "reasons"):
        assert np.array_equal(log.samples[name][20:-20], samples[name][20:-20]), name
    late = log.time_s - 0.004 * np.arange(len(samples))
    assert np.ptp(late[20:-20]) < 2.0 * most_s


def test_values_stamped_before_the_clock_was_set_are_left_out(columns, tmp_path, capsys):
    late = columns["time_s"] + np.where(np.arange(len(columns["time_s"])) < 3, 111.0, 0.0)
    log = read(tmp_path, columns | {"time_s": late})
    assert f"after value 3: 3 of {len(late)} values of another time left out" in capsys.readouterr().err
    samples = read(tmp_path, columns).samples
    assert np.array_equal(log.samples["angle"], samples["angle"][3:])


def test_what_was_recorded_before_a_trigger_is_a_log_too(columns, tmp_path):
    """An oscilloscope counts from its trigger; no log that anybody reads has times below zero."""
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    table = foreignkit.write_table(tmp_path / "a.csv", columns | {"time_s": columns["time_s"] - 0.5})
    arguments = ["convert", table, "--mapping", tmp_path / "mapping.yaml", "--output", tmp_path / "ours.log"]
    assert main([str(argument) for argument in arguments]) == 0
    log = load_log(tmp_path / "ours.log")
    assert log.time_ns[0] >= 0 and log.samples["angle"][100] == pytest.approx(columns["angle_rad"][100], abs=1e-3)


@pytest.mark.parametrize(
    ("unit", "starts_anew"), [("ms", 2**8), ("ms", 1000), ("ms", 2**16), ("us", 2**32), ("s", 86_400), ("s", 3600)]
)
def test_a_counter_that_is_full_and_a_clock_at_midnight_go_on(tmp_path, unit, starts_anew):
    """A motor at 2 rad/s, its stamps begun anew in the middle: as far apart as before."""
    per_s = {"ms": 1e3, "us": 1e6, "s": 1.0}[unit]
    stamps = np.mod(starts_anew - 2.0 * per_s + 0.004 * per_s * np.arange(1000), starts_anew)
    if unit == "s":
        written = [f"{int(t // 3600):02d}:{int(t // 60 % 60):02d}:{t % 60:06.3f}" for t in np.round(stamps, 3)]
        written = [text[3:] if starts_anew == 3600 else text for text in written]
    else:
        written = np.rint(stamps).astype(int).tolist()
    rows = "".join(f"{time},{0.008 * n:.3f}\n" for n, time in enumerate(written))
    (tmp_path / "a.csv").write_text("t,angle\n" + rows)
    write_mapping(tmp_path, f"time: {{signal: t, unit: {unit}}}", MotorAngle="signal: angle, unit: rad")
    log = load_mapped(tmp_path / "a.csv")
    assert log.time_s[-1] - log.time_s[0] == pytest.approx(3.996, abs=0.005)
    assert np.abs(log.samples["speed"][5:-5] - 2.0).max() < 0.05


@pytest.mark.parametrize("mapped", ["{signal: sec, unit: s}", "{signal: nanosec, unit: ns}"])
@pytest.mark.parametrize("order", ["sec nanosec", "nanosec sec"])
def test_seconds_and_their_parts_in_two_columns_are_one_time(tmp_path, capsys, mapped, order):
    """As ROS writes them, with rows missing for up to some seconds: neither column alone tells when the rest was measured."""
    time_s = 1.7e9 + 0.02 * np.delete(np.arange(2000), np.r_[200:210, 700:900, 1234])
    sec, nanosec = np.floor(time_s + 1e-6).astype(int), np.rint(1e9 * np.mod(time_s + 1e-6, 1.0) - 1e3).astype(int)
    parts = {"sec": sec, "nanosec": np.maximum(nanosec, 0)}
    rows = zip(*(parts[name] for name in order.split()), 2.0 * (time_s - 1.7e9), strict=True)
    (tmp_path / "a.csv").write_text(
        ",".join([*order.split(), "angle"]) + "\n" + "".join(f"{a},{b},{x:.4f}\n" for a, b, x in rows)
    )
    write_mapping(tmp_path, f"time: {mapped}", MotorAngle="signal: angle, unit: rad")
    log = load_mapped(tmp_path / "a.csv")
    said = capsys.readouterr().err
    assert "nanosec is the part of what sec counts" in said and "bunches" not in said
    assert np.abs(log.samples["angle"] - 2.0 * (1e-9 * log.time_ns - 1.7e9)).max() < 0.01


@pytest.mark.parametrize("beside", ["falling", "slow", "signed", "absent", "rolling"])
def test_what_does_not_begin_anew_with_each_second_is_no_part_of_it(tmp_path, capsys, beside):
    """A clock of whole seconds beside a count: its rows are spread evenly as ever."""
    row = np.arange(2000)
    within = row % 50
    counts = {"falling": 999 - within * 20, "slow": row // 2, "signed": within * 20 - 1, "absent": within // 30 * 900}
    count = (counts | {"rolling": row % 1000})[beside]
    lines = "".join(f"{r // 50},{c},{0.04 * r:.3f}\n" for r, c in zip(row, count, strict=True))
    (tmp_path / "a.csv").write_text("t,count,angle\n" + lines)
    write_mapping(tmp_path, "time: {signal: t, unit: s}", MotorAngle="signal: angle, unit: rad")
    load_mapped(tmp_path / "a.csv")
    said = capsys.readouterr().err
    assert "stamps come in bunches, one every 1e+03 ms" in said and "is the part" not in said


def test_a_signal_that_is_held_in_a_finer_raster_is_taken_at_its_own_rate(truth, tmp_path):
    """A current of 250 Hz in a table of 1 kHz is a mean over 4 ms, and a force of 25 Hz does not go by steps."""
    fine = foreignkit.sampled(truth, 1000.0)
    own = foreignkit.sampled(truth, 250.0)
    row = np.maximum(np.searchsorted(own["time_s"], fine["time_s"] + 1e-9, side="right") - 1, 0)
    held = fine | {"current_A": own["current_A"][row]}
    late, right = ((read(tmp_path, columns).samples["current_q"]) for columns in (held, fine))
    assert np.std((late - right)[5:]) < 0.5
    slow = foreignkit.sampled(foreignkit.truth(foreignkit.slow(seconds=6.0)), 250.0)
    stairs = np.repeat(slow["force_N"][::10], 10)[: len(slow["time_s"])]
    assert np.abs(read(tmp_path, slow | {"force_N": stairs}).force_N - slow["force_N"])[20:-20].max() < 250.0
    assert np.abs(stairs - slow["force_N"]).max() > 500.0


@pytest.mark.parametrize("step", [0.02, 0.5])
def test_steps_of_resolution_are_not_taken_for_a_raster(truth, step):
    values = np.round(foreignkit.sampled(truth, 1000.0)["angle_rad"] / step) * step
    assert held_rows(values) is None


def test_rows_that_a_finer_raster_repeats_are_taken_as_they_came(truth, tmp_path):
    """A controller of 100 Hz whose values come 7 to 13 ms apart, in a table of 1 kHz; where it stands, whatever it repeats."""
    fine = foreignkit.sampled(truth, 1000.0)
    came = np.arange(1, len(fine["time_s"]) - 7, 10)
    came += np.random.default_rng(1).integers(-1, 3, len(came))
    row = came[np.maximum(np.searchsorted(came, np.arange(len(fine["time_s"])), side="right") - 1, 0)]
    held, right = (read(tmp_path, columns) for columns in (fine | {n: v[row] for n, v in fine.items() if n != "time_s"}, fine))
    speed = np.interp(held.time_s, right.time_s, right.samples["speed"])
    assert np.std((held.samples["speed"] - speed)[10:-10]) < 0.1 * np.std(speed)
    standing = [np.where(row < 2000, np.sin(row + phase), 0.0) for phase in (0.0, 1.0)]
    assert np.diff(renewed_rows(standing)).max() < 20


def test_values_that_change_by_themselves_are_no_repeated_rows(truth):
    """Steps of two encoders, and noise beside one."""
    fine = foreignkit.sampled(truth, 1000.0)
    coarse = [np.round(fine[name] / step) * step for name, step in (("angle_rad", 0.5), ("force_N", 300.0))]
    assert renewed_rows(coarse) is None
    assert renewed_rows([coarse[0], np.random.default_rng(1).normal(size=len(coarse[0]))]) is None
    assert renewed_rows(coarse[:1]) is None and renewed_rows([]) is None


def test_bursts_of_a_sender_that_sends_at_random_stay(capsys):
    time_ns = np.cumsum(np.random.default_rng(1).exponential(1e7, 2000)).astype(np.int64)
    times, rows = in_time("a", time_ns, [np.arange(2000.0)])
    assert np.array_equal(times, time_ns) and np.array_equal(rows, np.arange(2000))


@pytest.mark.parametrize(
    ("time_s", "said"),
    [
        (lambda t: 1e3 * t, "4 s; expected 1e-05 to 1 s; is the unit of time right? With `unit: ms` it is 0.004 s"),
        (lambda t: 1e6 * t, "one value every 4e+03 s"),
        (lambda t: 1e-6 * t, "one value every 4e-09 s"),
        (lambda t: 45000.0 + t / 86400.0, "is the unit of time right? With `unit: d` it is 0.00"),
        (lambda t: 1e6 * (1.79e9 + t), "1.79e+15 s are no time; is `time.unit`, s, right? As us it is 1790000"),
        (lambda t: np.where(np.arange(len(t)) == 500, 1e7, t), "time goes back by 1e+07 s after value 501"),
        (lambda t: 0.0 * t, "749 values, all of them of one time"),
        (lambda t: np.concatenate([t[:400], t[: len(t) - 400]]), "time goes back by 1.596 s after value 400"),
        (lambda t: 0.001 * (np.arange(len(t)) % 256), "time begins anew 2 times and never passes 0.255 s"),
    ],
    ids=["ms", "us", "s as us", "days of a spreadsheet", "year", "outlier", "no clock", "two recordings", "counter"],
)
def test_times_that_cannot_be_are_refused(columns, tmp_path, time_s, said):
    with pytest.raises(InputError) as caught:
        read(tmp_path, columns | {"time_s": time_s(columns["time_s"])})
    assert said in str(caught.value) and str(caught.value).startswith(f"{tmp_path / 'a.parquet'}: ")


def test_of_times_that_cannot_be_nothing_else_is_said(columns, tmp_path, capsys):
    """Slow motion, late signals and gaps of minutes are then its consequence, and the gear's ratio no remedy."""
    with pytest.raises(InputError):
        read(tmp_path, columns | {"time_s": 1e3 * columns["time_s"]})
    assert " FL: " not in capsys.readouterr().err


@pytest.mark.parametrize("rate_Hz", [250.0, 500.0, 1000.0])
def test_a_counter_or_milliseconds_taken_for_seconds_are_asked_for(truth, tmp_path, capsys, rate_Hz):
    """A row each second could be, but is too rare for a motor that moves; one at other times is no counter's."""
    columns = foreignkit.sampled(truth, rate_Hz)
    slow = {name: 0.2 * columns[name] for name in ("angle_rad", "speed_rad_per_s")}
    counted = columns | slow | {"time_s": 7000.0 + np.arange(len(columns["time_s"]))}
    read(tmp_path, counted)
    said = capsys.readouterr().err
    assert "or a counter's? Then `rate_Hz`" in said and "by the gear's ratio" not in said
    mapping = foreignkit.COLUMNS.replace("{signal: time_s}", f"{{signal: time_s, rate_Hz: {rate_Hz:g}}}")
    read(tmp_path, counted, mapping)
    assert "rate_Hz" not in capsys.readouterr().err
    read(tmp_path, {name: values[:: int(rate_Hz / 7)] for name, values in columns.items()})
    said = capsys.readouterr().err
    assert "too rare" in said and "rate_Hz" not in said


def test_a_clock_that_is_set_while_recording_costs_no_memory(truth, tmp_path):
    """The first stamp of a computer whose clock was not yet set, in a log of another rate than ours."""
    columns = foreignkit.sampled(truth, 500.0)
    time_s = foreignkit.START_S + columns["time_s"]
    time_s[:5] -= foreignkit.START_S
    log = read(tmp_path, columns | {"time_s": time_s})
    assert 0.99 * 750 < len(log.samples) < 1.01 * 750
    assert np.ptp(log.samples["angle"]) > 15.0


def _wrong(columns: dict, *names: str, factor: float = -1.0) -> dict:
    return columns | {name: factor * columns[name] for name in names}


_MOTION = ("angle_rad", "speed_rad_per_s")


@pytest.mark.parametrize(
    ("wrong", "factor", "said"),
    [
        (("current_A",), -1.0, "A where MotorAngle is largest; positive current clamps"),
        (_MOTION, -1.0, "`scale: -1` of MotorAngle and MotorSpeed?"),
        ((*_MOTION, "current_A"), -1.0, "`scale: -1` of MotorAngle and MotorSpeed and CurrentQ?"),
        (("force_N",), -1.0, "`scale: -1` of ClampForceRef?"),
        (("force_N",), 1e-3, "N, which clamps nothing; is its unit right?"),
        (("force_N",), 30.0, "of the samples, which count as not measured; is its unit right? If so, a `scale` "),
        (("current_A",), 1e3, "of the samples, which make no frames; is its unit right? If so, a `scale` "),
        (("current_A",), 0.0, "CurrentQ is 0 throughout, while the motor turns: it is taken as not measured"),
        (("speed_rad_per_s",), -1.0, "a direction turned round"),
        (("speed_rad_per_s",), 30.0 / np.pi, "rpm taken for rad/s, or the reverse"),
        (("angle_rad",), 180.0 / np.pi, "degrees taken for radians, or the reverse"),
        (("angle_rad",), 1.0 / 12.0, "a wrong unit or gear"),
        (("speed_rad_per_s",), 0.1, "times as fast (a wrong unit or gear)"),
        (("plate_C",), 1372.0 / 22.0, "which no backing plate lasts: an open thermocouple"),
        (("plate_C",), 295.0 / 22.0, "InnerBackplateTemp is never below 295 °C: are these kelvins?"),
    ],
)
def test_what_no_brake_does_is_said(columns, tmp_path, capsys, wrong, factor, said):
    read(tmp_path, _wrong(columns, *wrong, factor=factor))
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("step_s", "count", "said"),
    [
        (1.0, 3600, ""),
        (1000.0, 250, "comes once in 1000 s, in which a brake has cooled"),
        (1.0 / 60.0, 3600, "K/s, as no backing plate does"),
    ],
    ids=["seconds", "milliseconds taken for them", "minutes"],
)
def test_a_plate_that_cools_tells_the_unit_of_time(tmp_path, capsys, step_s, count, said):
    """Heated for half an hour and let cool; nothing else was measured."""
    ticks = np.arange(count)
    plate = 22.0 + 160.0 * np.where(ticks < 1800, 1.0 - np.exp(-ticks / 500.0), np.exp((1800 - ticks) / 700.0))
    noisy = plate + np.random.default_rng(1).normal(0.0, 0.5, count)
    rows = [f"{step_s * tick:.6f},{value:.3f}" for tick, value in zip(ticks.tolist(), noisy.tolist(), strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["t,plate", *rows]) + "\n")
    mapping = write_mapping(
        tmp_path, "time: {signal: t}", MotorAngle="value: 0", InnerBackplateTemp="signal: plate, unit: degC"
    )
    mapping.read(tmp_path / "a.csv")
    told = capsys.readouterr().err
    assert said in told and ("a brake has cooled" in told or "as no backing plate" in told) == bool(said)


def test_noise_of_a_thermocouple_in_a_short_log_tells_no_unit_of_time(columns, tmp_path, capsys):
    noise_K = np.random.default_rng(1).normal(0.0, 2.0, len(columns["time_s"]))
    read(tmp_path, {name: values[:250] for name, values in (columns | {"plate_C": 22.0 + noise_K}).items()})
    assert "K/s" not in capsys.readouterr().err


def test_a_current_that_is_nothing_but_zero_is_none(columns, tmp_path, capsys):
    """As a measured one it would tell the torque path that nothing clamps: 9 kN of error."""
    columns["current_A"] = 0.0 * columns["current_A"]
    for mapping in (foreignkit.COLUMNS, re.sub(r"(EMB_FL_Current.CurrentQ): .*", r"\1: {value: 0}", foreignkit.COLUMNS)):
        assert not read(tmp_path, columns, mapping).samples["has_current"].any()
    # A motor that stands needs none.
    columns |= {name: 0.0 * columns[name] for name in ("angle_rad", "speed_rad_per_s")}
    assert read(tmp_path, columns).samples["has_current"].any()


def test_a_brake_that_is_said_to_be_released_has_no_force(tmp_path, capsys):
    """Where a log begins under force its first angle is no released one, whatever a mapping says."""
    columns = foreignkit.sampled(foreignkit.truth(foreignkit.slow(seconds=6.0)), 250.0)
    released = re.sub(r"VEH_Status.(ParkBrake|BrakeRequest): .*", r"VEH_Status.\1: {value: 0}", foreignkit.COLUMNS)
    rows = slice(int(np.argmax(columns["force_N"])), None)
    clamped = {name: values[rows] for name, values in columns.items()}
    for log, mapping, said in (
        (clamped, released, True),
        (columns, released, False),
        (clamped, re.sub(r"  VEH_Status.*\n", "", released), False),
        (clamped, re.sub(r"(ParkBrake): .*", r"\1: {value: 1}", released), False),
        (clamped | {"force_N": clamped["force_N"] + 60_000.0}, released, False),
    ):
        read(tmp_path, log, mapping)
        assert ("ClampForceRef begins at" in capsys.readouterr().err) == said


@pytest.mark.parametrize(("preload_N", "status", "said"), [(5000.0, 0.0, True), (0.0, 0.0, False), (5000.0, 1.0, False)])
def test_a_brake_that_is_said_to_be_released_carries_nothing_in_the_whole_log(tmp_path, capsys, preload_N, status, said):
    """A specimen that a testing machine loads in cycles and never lets go: taken for released where the log begins, each
    estimate would lack what it carries then."""
    columns = foreignkit.sampled(foreignkit.truth(foreignkit.slow(seconds=6.0)), 250.0)
    columns["force_N"] = preload_N + 500.0 * columns["angle_rad"]
    read(
        tmp_path,
        columns,
        re.sub(r"VEH_Status.(ParkBrake|BrakeRequest): .*", rf"VEH_Status.\1: {{value: {status}}}", foreignkit.COLUMNS),
    )
    assert ("at the start and seldom below" in capsys.readouterr().err) == said


@pytest.mark.parametrize("motion", ["on", "late", "yields", "to and fro"])
def test_a_load_that_no_angle_tells_is_of_no_other_time(tmp_path, capsys, motion):
    """A shaft that another motor brakes in steps: it turns on; begins to turn at the end; yields to each step 40 ms later; or
    turns to and fro."""
    time_s = 0.004 * np.arange(2000)
    load = 5000.0 * np.repeat(np.random.default_rng(3).uniform(0.1, 1.0, 40), 50)
    speed = {
        "on": 20.0 + 0.0 * time_s,
        "late": 20.0 * (time_s > 7.9),
        "yields": 4e-3 * np.roll(load, 10),
        "to and fro": 20.0 * np.cos(9.0 * time_s),
    }[motion]
    angle = 0.004 * np.cumsum(speed)
    read(tmp_path, columns_of(time_s, angle_rad=angle, speed_rad_per_s=speed, current_A=1e-3 * load, force_N=load))
    assert "ClampForceRef comes" not in capsys.readouterr().err


def test_a_force_that_falls_at_every_time_is_of_none(recwarn):
    times = 4_000_000 * np.arange(2000)
    angle = Series(times, 20.0 * np.sin(1e-9 * times))
    assert _find_late_force(angle, Series(times, -100.0 * angle.values)) == []
    assert not [one for one in recwarn if one.category is RuntimeWarning]


def test_gaps_are_told_with_their_place_and_length(columns, tmp_path, capsys):
    time_s = columns["time_s"]
    for name in ("angle_rad", "current_A"):
        columns[name] = np.where((time_s > 1.0) & (time_s < 1.5), np.nan, columns[name])
    columns["current_A"][10:50] = np.nan
    columns["force_N"][300:310] = np.nan
    read(tmp_path, columns)
    said = capsys.readouterr().err
    assert "MotorAngle: a gap of 0.5 s, 0.996 s after the first value" in said
    assert "CurrentQ: 2 gaps, together 0.664 s, the longest of 0.5 s" in said
    assert "ClampForceRef" not in said


def test_a_speed_adds_up_to_no_way_where_nothing_was_recorded():
    """A recorder that pauses: the last and the first speed say nothing of five minutes between them. What is late goes on."""
    time_s = 0.004 * np.arange(1000)
    speed = np.full(1000, 2.0)
    late_ns = (1e9 * (time_s + 0.05 * (time_s >= 2.0))).astype(np.int64)
    assert Series(late_ns, speed).integral().values[-1] == pytest.approx(2.0 * (time_s[-1] + 0.05))
    pause_ns = (1e9 * (time_s + 300.0 * (time_s >= 2.0))).astype(np.int64)
    assert Series(pause_ns, speed).integral().values[-1] == pytest.approx(2.0 * (time_s[-1] - 0.004))
    said = contradictions("FL", {"EMB_FL_Resolver": {"MotorSpeed": Series(pause_ns, speed)}})
    assert "MotorSpeed: a gap of 300 s, 1.996 s after the first value; nothing is known of it meanwhile" in said


@pytest.mark.parametrize(
    ("late_s", "said"),
    [
        (0.1, "ms after the motor's angle that it belongs to, and pads explain some 30 ms: `mean_ms: 180`"),
        (-0.1, "ms before the motor's angle that it belongs to, as of no brake"),
        (0.02, ""),
    ],
)
def test_a_force_of_another_clock_is_said(columns, tmp_path, capsys, late_s, said):
    """Identification would make effects of it, and judging would call the estimate wrong."""
    read(tmp_path, columns | {"force_N": np.roll(columns["force_N"], round(250.0 * late_s))})
    told = capsys.readouterr().err
    assert said in told
    assert bool(said) == ("that it belongs to" in told)


@pytest.mark.parametrize("stroke", [[0.0, 20.0, 0.0], [0.0, 20.0, 20.0, 0.0]], ids=["to and fro", "held"])
def test_a_loop_over_the_angle_is_no_other_clock(stroke):
    """Rubber, or a gear with play: on the way to a force there is more of it than back, at any speed."""
    time_s = 0.004 * np.arange(6000)
    angle = np.interp(time_s % 12.0, np.linspace(0.0, 12.0, len(stroke)), stroke)
    play = [0.0]
    for step in np.diff(angle):
        play.append(min(max(play[-1] + step, -1.0), 1.0))
    noise, times = np.random.default_rng(1).normal(size=(2, len(angle))), 4_000_000 * np.arange(len(angle))
    force = 500.0 * np.maximum(angle + play - 3.0, 0.0) + 20.0 * noise[0]
    coarse = 0.05 * np.round(angle / 0.05 + 0.3 * noise[1])
    assert _find_late_force(Series(times, coarse), Series(times, force)) == []


@pytest.mark.parametrize(
    ("factor", "is_said"), [(1.0, False), (3.6, True), (1.0 / 3.6, True)], ids=["m/s", "km/h as m/s", "rad/s from km/h"]
)
def test_a_vehicle_rolls_on_tyres(factor, is_said):
    time_ns = 10_000_000 * np.arange(1000)
    wheel = Series(time_ns, 20.0 * (1.0 - np.cos(1e-9 * time_ns)))
    messages = {
        "VEH_WheelSpeed": {"WheelSpeedFL": wheel},
        "VEH_Status": {"VehicleSpeed": Series(time_ns, factor * 0.3 * wheel.values)},
    }
    lines = [line for line in contradictions("FL", messages) if "the radius of no tyre" in line]
    assert bool(lines) == is_said


@pytest.mark.parametrize(("step_A", "bits"), [(0.002, 16), (0.05, 12)])
def test_a_current_that_lost_its_sign_is_said_and_has_it_by_its_period(columns, tmp_path, capsys, step_A, bits):
    counts = np.mod(np.rint(columns["current_A"] / step_A), 2.0**bits)
    written = columns | {"current_A": step_A * counts}
    read(tmp_path, written)
    whole = f"{step_A * 2.0**bits:.10g}"
    assert f"current_A jumps between 0 and {whole}, the end of its bits" in (told := capsys.readouterr().err)
    assert f"Then `period: {whole}`" in told and told.count("jumps between") == 1
    mapping = foreignkit.COLUMNS.replace("current_A, unit: A", f"current_A, unit: A, period: {whole}")
    log = read(tmp_path, written, mapping)
    assert "jumps between" not in capsys.readouterr().err
    plain = read(tmp_path, columns)
    assert log.samples["current_q"] == pytest.approx(plain.samples["current_q"], abs=0.6 * step_A + 0.006)


def test_a_position_of_32_bits_may_begin_below_zero(columns, tmp_path, capsys):
    """As a drive's counts are written that knows no sign, and printed with eight digits."""
    counts = np.mod(np.rint(columns["angle_rad"] * 1e4) - 3.0, 2.0**32)
    counts = np.array([float(f"{count:.8g}") for count in counts])
    read(tmp_path, columns | {"angle_rad": counts})
    assert "angle_rad jumps between 0 and 4294967296" in capsys.readouterr().err
    mapping = foreignkit.COLUMNS.replace("angle_rad, unit: rad", f"angle_rad, unit: rad, scale: 1e-4, period: {2**32}")
    log = read(tmp_path, columns | {"angle_rad": counts}, mapping)
    assert log.samples["angle"] == pytest.approx(read(tmp_path, columns).samples["angle"], abs=0.03)


@pytest.mark.parametrize(
    "values",
    [
        np.where(np.arange(1000) % 100 < 50, 0.0, 250.0),
        np.interp(np.arange(1000), [0, 495, 500, 999], [0.0, 90.0, 3900.0, 4000.0]).round(),
        np.mod(41.0 * np.arange(1000), 4096.0),
        np.where(np.arange(1000) % 100 < 50, -3.0, 4000.0) + np.arange(1000) % 7,
        np.abs(np.rint(4000.0 * np.sin(np.arange(1000) / 50.0))),
    ],
    ids=["two levels", "a step", "a turn", "levels of either sign", "a size"],
)
def test_what_goes_between_two_values_has_not_lost_a_sign(values):
    assert without_sign(values) == 0.0


def test_one_stroke_like_the_other_is_no_turn():
    """Stops at 10 Hz: released in one sample, clamped by the same angle in the next."""
    clamped = np.arange(600) // 30 % 2
    time_ns = 100_000_000 * np.arange(600)
    assert not starts_anew(Series(time_ns, 12.0 * clamped + 0.01 * np.sin(1.3 * np.arange(600.0))))
    assert starts_anew(Series(time_ns, np.mod(0.4 * np.arange(600.0), 12.0))) == pytest.approx(12.0, rel=0.01)


@pytest.mark.parametrize("stray", [0.0, -999.0, 1200.0])
def test_single_values_far_from_those_beside_them_are_no_motion(columns, tmp_path, capsys, stray):
    """What stands for a lost value must not be taken for an angle that starts anew, nor for motion."""
    lost = np.random.default_rng(3).random(len(columns["time_s"])) < 0.005
    lost[np.flatnonzero(lost) - 1] = False
    lost &= columns["angle_rad"] > 15.0
    log = read(tmp_path, columns | {"angle_rad": np.where(lost, stray, columns["angle_rad"] + 5.0)})
    told = capsys.readouterr().err
    how = "values are -999, which stand for none" if stray == -999.0 else "values of MotorAngle are far from both beside them"
    assert f"{np.sum(lost)} {how}: left out" in told and "start anew" not in told
    assert np.ptp(log.samples["angle"]) == pytest.approx(np.ptp(columns["angle_rad"]), abs=0.1)


def test_a_rare_stroke_is_no_stray():
    """Of a brake that stands nearly always the range of the angle is its resolver's noise, and a stroke is far beyond it."""
    angle = np.random.default_rng(5).normal(0.0, 0.001, 5000)
    angle[2000:2030] += np.interp(np.arange(30), [0, 4, 25, 29], [0.0, 20.0, 20.0, 0.0])
    assert not np.any(strays(angle))
    angle[1000] = 10.0
    assert np.flatnonzero(strays(angle)).tolist() == [1000]


def _replay(folder, columns: dict) -> None:
    foreignkit.write_rig(folder, foreignkit.COLUMNS)
    table = foreignkit.write_table(folder / "a.parquet", columns)
    command = ["replay", table, "--mapping", folder / "mapping.yaml", "--calibration", folder / "calibration.yaml"]
    assert main([str(word) for word in command]) == 0


def _phase(columns: dict) -> np.ndarray:
    return columns["current_A"] * np.cos(4.0 * columns["angle_rad"])


@pytest.mark.parametrize("current", [_phase, lambda columns: 0.3 * columns["speed_rad_per_s"]], ids=["phase", "duty cycle"])
def test_what_does_not_accelerate_the_motor_is_not_its_current(columns, tmp_path, capsys, current):
    _replay(tmp_path, columns | {"current_A": current(columns)})
    assert "the current does not accelerate the motor" in capsys.readouterr().err


def _steps(current: np.ndarray) -> np.ndarray:
    return np.repeat(current[::50], 50)[: len(current)]


def _ramps(current: np.ndarray) -> np.ndarray:
    rows = np.arange(len(current))
    return np.interp(rows, rows[::50], current[::50])


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (_steps, True),
        (_ramps, True),
        (lambda current: current, False),
        (lambda current: 0.5 * np.round(current / 0.5), False),
        (lambda current: 0.4 * np.round(np.linspace(1.0, 23.0, len(current))), False),
        (lambda current: np.concatenate([np.full(19 * len(current), -0.01), 0.5 * np.round(current / 0.5)]), False),
        (lambda current: np.repeat(np.random.default_rng(1).normal(0.0, 5.0, len(current)), 5)[: len(current)], False),
    ],
    ids=[
        "steps",
        "ramps",
        "measured",
        "in halves of an ampere",
        "a slow one in counts",
        "mostly at rest",
        "each value five times",
    ],
)
def test_a_command_in_place_of_the_measured_current_is_said(columns, made, said):
    values = made(columns["current_A"])
    lines = find_command(Series(4_000_000 * np.arange(len(values)), values))
    assert [line for line in lines if "as a command's do" in line] == lines and bool(lines) == said


def test_a_command_is_said_of_a_table(columns, tmp_path, capsys):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    table = foreignkit.write_table(tmp_path / "a.parquet", columns | {"current_A": _steps(columns["current_A"])})
    command = ["convert", str(table), "--mapping", str(tmp_path / "mapping.yaml"), "--output", str(tmp_path / "a.log")]
    assert main(command) == 0
    assert "% of CurrentQ's values stay as they are" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("factor", "said"),
    [(1.0, ""), (1.0 / 20.0, "times what is stated: is the angle that of a gear's output"), (-1.0, "backwards")],
    ids=["the motor's", "behind a gear", "turned round"],
)
def test_an_angle_of_another_place_is_told_by_the_inertia(columns, tmp_path, capsys, factor, said):
    """Convert cannot tell it, since an angle behind a gear is a motion like any other; a calibration can."""
    _replay(tmp_path, _wrong(columns, *_MOTION, factor=factor))
    told = capsys.readouterr().err
    assert said in told
    assert bool(said) == ("the current accelerates the motor" in told)


def _samples_of(columns: dict) -> np.ndarray:
    samples = np.zeros(len(columns["time_s"]), SAMPLE)
    samples["time_ns"], samples["has_current"] = 1e9 * columns["time_s"], True
    for field, column in (("angle", "angle_rad"), ("speed", "speed_rad_per_s"), ("current_q", "current_A")):
        samples[field] = columns[column]
    return samples


@pytest.mark.parametrize(
    ("factor", "said"),
    [(1.0, ""), (np.sqrt(0.5), "the current is 0.7"), (np.sqrt(2.0), "the current is 1.4"), (0.9, "")],
    ids=["the motor's", "effective", "amplitude of an effective value", "within tolerances"],
)
@pytest.mark.parametrize("stiffer", [1.0, 1.4])
def test_a_current_of_another_scale_is_told_by_load_and_acceleration(truth, factor, said, stiffer):
    """Other pads, whose force is another at the same angle, do not pass for it: what the sensor shows is taken."""
    columns = foreignkit.sampled(foreignkit.truth(foreignkit.random(seconds=10.0)), 250.0)
    samples = _samples_of(_wrong(columns, "current_A", factor=factor))
    motor = foreignkit.calibration().motor
    told = other_current(samples, stiffer * columns["force_N"], motor)
    assert [line.startswith(said) for line in told] == ([True] if said and stiffer == 1.0 else [])
    assert not other_current(samples, np.full(len(samples), np.nan), motor)


def test_rare_samples_tell_no_inertia():
    """Between two of them a motor is accelerated and braked again: some 8 times the inertia would come out."""
    columns = foreignkit.sampled(foreignkit.truth(foreignkit.random(seconds=120.0)), 20.0, means=False)
    samples = _samples_of(columns)
    motor = foreignkit.calibration().motor
    assert not other_motor(samples, motor.torque_constant_Nm_per_A, motor.inertia_kg_m2)


@pytest.mark.parametrize(
    ("one", "said"),
    [(1.0 + 1e-9, ""), (100.0, "a `scale` 100 times smaller"), (0.37, "BrakeRequest is 0 or 1, and between them in")],
)
def test_a_flag_of_a_coarse_factor_is_one(columns, tmp_path, capsys, one, said):
    """A DBC whose factor makes 1.000000001 of what it means by 1; per cent are no flag, and a brake request of 37 per cent,
    scaled to one, would be sent as none."""
    flag = {"request": np.where(np.arange(len(columns["time_s"])) % 100 < 50, 0.0, one)}
    mapping = re.sub(r"(VEH_Status.BrakeRequest): .*", r'\1: {signal: request, unit: "1"}', foreignkit.COLUMNS)
    log = read(tmp_path, columns | flag, mapping)
    told = capsys.readouterr().err
    assert said in told and ("BrakeRequest is" in told) == bool(said)
    assert (np.mean(log.slow.status["BrakeRequest"]) == pytest.approx(0.5, abs=0.1)) == (not said)


def test_a_clock_of_whole_seconds_is_spread_over_its_rows(capsys):
    seconds = np.arange(2500) / 250.0
    times, rows = in_time("x", (1e9 * np.floor(seconds)).astype(np.int64), [np.sin(seconds)])
    assert "stamps come in bunches, one every 1e+03 ms" in capsys.readouterr().err
    assert len(rows) == 2500
    # Where the first of the second's rows lies is not known, how far apart they are is.
    assert np.diff(times) == pytest.approx(4e6, rel=0.2)


def test_late_stamps_are_no_missing_samples(columns, tmp_path):
    """Counters that skip would be E2E errors of a log that lacks nothing; where samples are missing, they do skip."""
    late_s = np.random.default_rng(1).normal(0.0, 0.0008, len(columns["time_s"])).clip(-0.0019, 0.0019)
    rows = np.r_[0:300, 310 : len(late_s)]
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    table = {name: values[rows] for name, values in (columns | {"time_s": columns["time_s"] + late_s}).items()}
    path = foreignkit.write_table(tmp_path / "a.parquet", table)
    counters = Decoder().columns(Mapping(tmp_path / "mapping.yaml").read(path), "EMB_FL_Resolver")["Counter"].astype(int)
    steps = np.diff(counters) % 15
    assert np.flatnonzero(steps != 1).tolist() == [299]
    assert steps[299] == 11


def test_an_angle_within_one_turn_asks_for_its_period(truth, tmp_path, capsys):
    columns = foreignkit.sampled(truth, 500.0)
    read(tmp_path, columns | {"angle_rad": columns["angle_rad"] % (2.0 * np.pi)})
    assert "does it start anew? Then state its `period`" in capsys.readouterr().err


def _joint(period_rad: float = 0.0, jitter_ms: float = 0.0) -> dict:
    """A joint that turns to and fro at 48 Hz, as an angle that starts anew at a period, if one is given."""
    time_s = np.arange(2400) / 48.0 + 1e-3 * jitter_ms * np.random.default_rng(1).uniform(-1.0, 1.0, 2400)
    angle = 40.0 * (1.0 - np.cos(2.0 * np.pi * time_s / 25.0))
    speed = 40.0 * 2.0 * np.pi / 25.0 * np.sin(2.0 * np.pi * time_s / 25.0)
    angle = (angle + 12.5) % period_rad - 12.5 if period_rad else angle
    return columns_of(time_s - time_s[0], angle_rad=angle, speed_rad_per_s=speed, current_A=0.5 * np.sign(speed))


def test_an_angle_of_few_samples_that_starts_anew_is_told_from_a_fast_motion(tmp_path, capsys):
    read(tmp_path, _joint(period_rad=25.0))
    told = capsys.readouterr().err
    jump = float(re.search(r"MotorAngle jumps by about ([\d.]+) rad and back to and fro", told)[1])
    assert jump == pytest.approx(25.0, abs=0.1) and "too rare" not in told
    still = _joint()
    # A motor that really goes as far between two samples goes anywhere.
    still["angle_rad"] = np.repeat(np.random.default_rng(2).choice([0.0, 20.0, 30.0], 240), 10)
    read(tmp_path, still | {"speed_rad_per_s": np.gradient(still["angle_rad"], still["time_s"])})
    assert "start anew" not in capsys.readouterr().err


def _hoist(**factors: float) -> dict:
    """A weight that a motor lifts and lowers, 31 rows a second that a busy computer reads late and stamps when it does, one in
    twenty by 0.1 s; friction needs a fifth of the weight's current. Columns are as stated times a factor."""
    rng = np.random.default_rng(1)
    time_s = np.arange(1240) / 31.0
    speed = 6.0 * np.clip(4.0 * np.sin(2.0 * np.pi * time_s / 20.0), -1.0, 1.0) + rng.normal(0.0, 0.05, 1240)
    late = rng.uniform(0.0, 0.01, 1240) + 0.1 * (rng.uniform(size=1240) < 0.05)
    stamps, current = np.maximum.accumulate(time_s + late), 5.0 + np.sign(speed) + rng.normal(0.0, 0.2, 1240)
    columns = columns_of(
        stamps + 1e-6 * np.arange(1240), angle_rad=np.cumsum(speed) / 31.0, speed_rad_per_s=speed, current_A=current
    )
    return {name: factors.get(name, 1.0) * values for name, values in columns.items()}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({}, ""),
        ({"speed_rad_per_s": 1.0 / 60.0}, "times as fast (turns per minute taken for turns per second, or the reverse)"),
        ({"current_A": -1.0}, "as if friction drove the motor: `scale: -1` of CurrentQ?"),
        (
            {"angle_rad": -1.0, "speed_rad_per_s": -1.0},
            "as if friction drove the motor: `scale: -1` of MotorAngle and MotorSpeed?",
        ),
    ],
)
def test_a_hoist_of_late_rows_tells_a_wrong_unit_and_direction(tmp_path, capsys, wrong, said):
    """What lies between its rows is unknown, but not how far it went in ten of them nor which way friction acts. Of a weight
    a current that is turned round has the wrong sign, a motion that is turned round has not."""
    stated = foreignkit.COLUMNS.replace("signal: force_N, unit: N", "value: 4000")
    for columns, mapping in (
        (_hoist(**wrong), stated),
        (_hoist(**wrong) | {"force_N": np.full(1240, 4000.0)}, foreignkit.COLUMNS),
    ):
        read(tmp_path, columns, mapping)
        told = capsys.readouterr().err
        assert said in told and ("scale" in told or "times as fast" in told) == bool(said)
        assert "too rare for this motion: what lies between two samples is unknown, and is not filled in" in told


def test_slow_motion_with_the_stamps_of_a_busy_computer_is_not_too_rare(tmp_path, capsys):
    """Ten radians a second, stamped up to six milliseconds early or late, as it was sampled."""
    samples = read(tmp_path, _joint(jitter_ms=6.0)).samples
    assert "too rare" not in capsys.readouterr().err and np.median(samples["dt"]) == pytest.approx(0.004)


def test_lines_of_a_serial_port_that_name_their_values_are_a_table(tmp_path, capsys):
    """With other lines between them; a table whose cells hold times of day is none of these."""
    columns = _joint()
    pairs = zip(1e3 * columns["time_s"], columns["angle_rad"], columns["current_A"], strict=True)
    lines = [f"Time: {t:.3f}, Angle = {a:.5f} rad Current:{c:.2f}" for t, a, c in pairs]
    lines.insert(900, "DONE POSITIONING")
    (tmp_path / "serial.txt").write_text("\n".join(lines))
    angle, current = "signal: Angle, unit: rad", "signal: column 3, unit: A, mean_ms: 0"
    write_mapping(tmp_path, "time: {signal: Time, unit: ms}", MotorAngle=angle, CurrentQ=current)
    samples = load_mapped(tmp_path / "serial.txt").samples
    assert "1 rows with another number of cells than 3 left out" in capsys.readouterr().err
    assert len(samples) > 10_000 and np.ptp(samples["angle"]) == pytest.approx(80.0, rel=0.01)
    assert np.nanmax(samples["current_q"]) == pytest.approx(0.5)


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
def test_a_line_for_each_signal_is_a_table_of_columns(tmp_path, capsys, named, delimiter):
    """As numpy saves the matrix that a script has stacked."""
    time_s = 0.004 * np.arange(1000)
    signals = {"t": time_s, "angle": 2.0 * time_s, "nothing": np.zeros(1000)}
    rows = [[*([name] if named else []), *(f"{value:.4f}" for value in values)] for name, values in signals.items()]
    lines = [delimiter.join(row).replace(*(".", ",") if delimiter == ";" else (".", ".")) for row in rows]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    clock, angle = ("t", "angle") if named else ("column 1", "column 2")
    write_mapping(tmp_path, f"time: {{signal: {clock}, unit: s}}", MotorAngle=f"signal: {angle}, unit: rad")
    log = load_mapped(tmp_path / "a.csv")
    assert f"each of the 3 lines has {1000 + named} cells" in capsys.readouterr().err
    assert len(log.samples) >= 999 and np.abs(log.samples["angle"] - 2.0 * log.time_s).max() < 1e-3


def test_a_table_of_many_columns_and_few_rows_is_none_of_lines(tmp_path, capsys):
    """The names of its columns are a line, too."""
    names = ["t", "angle", *(f"cell {n}" for n in range(300))]
    rows = [[0.02 * n, 0.1 * n, *[0] * 300] for n in range(40)]
    (tmp_path / "a.csv").write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]))
    write_mapping(tmp_path, "time: {signal: t, unit: s}", MotorAngle="signal: angle, unit: rad")
    log = load_mapped(tmp_path / "a.csv")
    assert "lines has" not in capsys.readouterr().err and log.samples["angle"][-1] > 3.7


@pytest.mark.parametrize("decimal", [".", ","])
def test_a_trace_of_a_plc_is_a_table_of_its_variables(tmp_path, capsys, decimal):
    """CODESYS and ctrlX write one variable's times and values below the other's; those of a slower task have fewer."""
    columns = _joint()
    lines = ["[key]; [value]", "Version; 0x03050000", "BufferEntries; 101"]
    for number, (name, every) in enumerate((("Axis.fActPosition", 1), ("Axis.fActCurrent", 2), ("Main.iState", 1))):
        values = (columns["angle_rad"], columns["current_A"], np.ones(2400))[number][::every]
        lines += [f"{number}.Variable; {name}", f"{number}.Class; 14", f"{number}.Data; "]
        lines += [
            f"; {1e3 * t:.3f}; {v:.5f}".replace(".", decimal) for t, v in zip(columns["time_s"][::every], values, strict=True)
        ]
    lines.insert(900, "; 1.2.3; 4")
    (tmp_path / "axis.trace.csv").write_text("\n".join(lines) + "\n")
    signals = {
        "MotorAngle": "signal: Axis.fActPosition, unit: rad",
        "CurrentQ": "signal: Axis.fActCurrent, unit: A, mean_ms: 0",
    }
    write_mapping(tmp_path, "time: {signal: Time, unit: ms}", **signals)
    samples = load_mapped(tmp_path / "axis.trace.csv").samples
    assert "left out" not in capsys.readouterr().err
    assert len(samples) > 10_000 and np.ptp(samples["angle"]) == pytest.approx(80.0, rel=0.01)
    assert np.nanmax(samples["current_q"]) == pytest.approx(0.5)


def test_a_steady_speed_in_another_unit_is_said(tmp_path, capsys, recwarn):
    time_s = 0.004 * np.arange(1000)
    read(tmp_path, columns_of(time_s, angle_rad=25.0 * time_s, speed_rad_per_s=25.0 * 30.0 / np.pi, current_A=1.0))
    assert "rpm taken for rad/s, or the reverse" in capsys.readouterr().err
    assert not [warning for warning in recwarn if warning.category is RuntimeWarning]


@pytest.mark.parametrize(
    ("per_turn", "said"),
    [
        (2.0 * np.pi, ": 6.28319 rad in the rig's unit"),
        (360.0, "360, with `unit: deg`"),
        (1.0, "1, with `unit: rev`"),
        (4096.0, "4096 counts in a turn? `unit: rev`, `scale: 0.000244140625`, `period: 4096`"),
        (64.0, "Then state its `period`\n"),
    ],
)
def test_a_turn_is_told_in_the_unit_that_it_is_likely_in(tmp_path, capsys, per_turn, said):
    columns = foreignkit.sampled(foreignkit.truth(foreignkit.slow()), 250.0)
    turns = 3.0 * columns["angle_rad"] / (2.0 * np.pi)
    read(tmp_path, columns | {"angle_rad": per_turn * (turns % 1.0)})
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("unit", ["deg", "rev"])
def test_counts_that_were_mapped_as_another_unit_are_counts(tmp_path, capsys, unit):
    columns = foreignkit.sampled(foreignkit.truth(), 250.0)
    mapping = re.sub(r"\n.*MotorSpeed.*", "", foreignkit.COLUMNS).replace("angle_rad, unit: rad", f"angle_rad, unit: {unit}")
    read(tmp_path, columns | {"angle_rad": np.rint(5e4 * columns["angle_rad"])}, mapping)
    assert "counts of an encoder? Then `unit: rev`" in capsys.readouterr().err


@pytest.mark.parametrize(("unit", "is_asked"), [("rad", True), ("rev", True), ("deg", False)])
def test_counts_of_a_joint_that_turns_slowly_are_counts(tmp_path, capsys, unit, is_asked):
    """No angle has steps of a radian or a turn; whole degrees are a coarse sensor's, or a servo's."""
    columns = foreignkit.sampled(foreignkit.truth(), 250.0)
    way = 40.0 * np.sin(np.linspace(0.0, 30.0, len(columns["time_s"])))
    mapping = re.sub(r"\n.*MotorSpeed.*", "", foreignkit.COLUMNS).replace("angle_rad, unit: rad", f"angle_rad, unit: {unit}")
    for angle, is_whole in ((np.rint(way), is_asked), (way, False), (np.rint(way / 30.0), False)):
        read(tmp_path, columns | {"angle_rad": angle}, mapping)
        assert ("counts of an encoder? Then `unit: rev`" in capsys.readouterr().err) == is_whole


@pytest.mark.parametrize("rate_Hz", [50.0, 250.0])
@pytest.mark.parametrize(
    ("per_rad", "whole", "said"),
    [
        (1.0, False, ""),
        (180.0 / np.pi, False, "if its values are degrees, `unit: deg` makes"),
        (5e4, True, "counts of an encoder? Then `unit: rev`"),
        (5e4, False, "or is the unit of time wrong?"),
    ],
)
def test_an_angle_in_another_unit_is_told_without_a_speed(tmp_path, capsys, per_rad, whole, said, rate_Hz):
    columns = foreignkit.sampled(foreignkit.truth(), rate_Hz)
    angle = per_rad * columns["angle_rad"] + 0.3
    mapping = re.sub(r"\n.*MotorSpeed.*", "", foreignkit.COLUMNS)
    read(tmp_path, columns | {"angle_rad": np.rint(angle) if whole else angle}, mapping)
    lines = [line for line in capsys.readouterr().err.splitlines() if "which no motor does" in line]
    assert len(lines) == bool(said) and all(said in line for line in lines)


def test_a_part_of_a_log_is_no_contradiction(truth, tmp_path, capsys):
    """Neither hard motion alone nor a clamped, a held, or a released brake alone says that anything is turned round."""
    columns = foreignkit.sampled(foreignkit.truth(), 250.0)
    for start in range(0, len(columns["time_s"]) - 400, 800):
        read(tmp_path, {name: values[start : start + 400] for name, values in columns.items()})
        assert "scale: -1" not in capsys.readouterr().err, start


def test_a_load_that_pulls_as_it_pushes_is_no_clamp_that_is_turned_round(tmp_path, capsys):
    """A pendulum's: it falls where the angle rises, and so does the current that holds it."""
    time_s = 0.004 * np.arange(5000)
    angle = 2.5 * np.sin(2.0 * np.pi * 0.2 * time_s) + 1.8
    load = 6000.0 * np.sin(angle + 2.0)
    speed = np.gradient(angle, time_s)
    read(tmp_path, columns_of(time_s, angle_rad=angle, speed_rad_per_s=speed, current_A=5e-4 * load, force_N=load))
    assert "scale: -1" not in capsys.readouterr().err


@pytest.mark.parametrize("load", ["signal: force_N, unit: N", "value: 0"])
def test_a_joint_stated_at_its_motor_is_sampled_as_often_as_it_was(tmp_path, capsys, load):
    """Every 20 ms, and the straight line misses three times what it may of a brake: without a load the current
    tells of its speed, and not of where it is."""
    mapping = foreignkit.COLUMNS.replace("signal: force_N, unit: N", load)
    time_s = 0.02 * np.arange(1000)
    angle = 300.0 * np.sin(2.0 * np.pi * 0.25 * time_s)
    speed, force = np.gradient(angle, time_s), 100.0 * np.abs(np.sin(time_s))
    log = read(tmp_path, columns_of(time_s, angle_rad=angle, speed_rad_per_s=speed, current_A=1.0, force_N=force), mapping)
    told = "too rare for this motion" in capsys.readouterr().err
    assert told == ("value" not in load) and (len(log.samples) > 4000) == ("value" in load)


@pytest.mark.parametrize("rate_Hz", [12.5, 250.0])
def test_neither_inertia_nor_slow_samples_are_a_contradiction(tmp_path, capsys, rate_Hz):
    """At the top of a fast sine the current brakes the motor; between slow samples the motor goes its way."""
    time_s = foreignkit.FINE_S * np.arange(round(8.0 / foreignkit.FINE_S))
    sine = foreignkit.parameters()["clearance"] + 10.0 + 4.0 * np.sin(2.0 * np.pi * 5.0 * time_s)
    read(tmp_path, foreignkit.sampled(foreignkit.truth(sine if rate_Hz > 100.0 else foreignkit.random()), rate_Hz))
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (rate_Hz < 100.0) and all("one sample of the motor every 80 ms, too rare" in line for line in lines)


def test_a_few_stops_in_a_long_rest_are_not_filled_in(truth, tmp_path, capsys):
    """Neither are they at 20 Hz where almost all samples stand."""
    columns = foreignkit.sampled(truth, 20.0)
    rest = {name: np.full(100 * len(values), values[0]) for name, values in columns.items()}
    rest["time_s"] = 0.05 * np.arange(len(rest["time_s"]))
    columns["time_s"] = columns["time_s"] + rest["time_s"][-1]
    log = read(tmp_path, {name: np.concatenate([rest[name], columns[name]]) for name in columns})
    assert "one sample of the motor every 50 ms, too rare" in capsys.readouterr().err
    assert len(log.samples) <= 101 * len(columns["time_s"])


@pytest.mark.parametrize("rate_Hz", [20.0, 250.0])
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("angle_rad", "speed_rad_per_s", "current_A", "force_N"), "`scale: -1` of ClampForceRef, MotorAngle, MotorSpeed and"),
        (("force_N",), "`scale: -1` of ClampForceRef"),
        ((), ""),
    ],
)
def test_a_slow_clamp_that_is_turned_round_is_told_at_any_rate(tmp_path, capsys, rate_Hz, wrong, said):
    """20 Hz do for a slow clamp, whose way between two samples is known; all that is turned round fits together."""
    columns = foreignkit.sampled(foreignkit.truth(foreignkit.slow(seconds=20.0)), rate_Hz)
    read(tmp_path, _wrong(columns, *wrong))
    told = capsys.readouterr().err
    assert said in told and ("scale: -1" in told) == bool(said)


@pytest.mark.parametrize(
    ("signal", "said"),
    [
        ("force (kN), unit: N", "force (kN) says kN and is taken in N: which is right?"),
        ("force (kN), unit: kN", ""),
        ("force (kN), unit: N, scale: -1000", ""),
        ("force (kN), unit: kN, scale: 10", ""),
        ("'force [Newtons]', unit: N", ""),
        ("force (raw), unit: N", ""),
    ],
)
def test_a_unit_in_a_columns_name_that_is_not_the_mappings_is_said(tmp_path, signal, said):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS.replace("force_N, unit: N", signal))
    notes = "\n".join(Mapping(tmp_path / "mapping.yaml").notes)
    assert said in notes and ("which is right" in notes) == bool(said)


_ROW = {"angle_rad": "rad", "speed_rad_per_s": "rad/s", "current_A": "A", "plate_C": "°C", "force_N": "N", "time_s": "s"}


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({}, ""),
        ({"angle_rad": "mm", "plate_C": "V", "current_A": "?"}, ""),
        ({"force_N": "[kgf]"}, "RIG_FL_Force.ClampForceRef: force_N says kgf and is taken in N: which is right?"),
        ({"plate_C": "°F"}, "InnerBackplateTemp: plate_C says °F and is taken in degC"),
        ({"plate_C": "ºF"}, "InnerBackplateTemp: plate_C says degF and is taken in degC"),
        ({"plate_C": "K"}, "InnerBackplateTemp: plate_C says K and is taken in degC"),
        ({"force_N": "N.m"}, ""),
        ({"force_N": "oz-in"}, "ClampForceRef: force_N says ozf in, and an N·m is 141.6 of it: is that in `scale`?"),
        ({"time_s": "ms"}, "time_s says ms and is taken in s"),
    ],
)
@pytest.mark.parametrize("ending", [".csv", ".mf4"])
def test_a_unit_in_the_file_that_is_not_the_mappings_is_said(truth, tmp_path, capsys, ending, stated, said):
    """All plausible: a load cell in kilograms hides 90 % of the force, a thermocouple in °F doubles the heat."""
    units, columns = _ROW | stated, foreignkit.sampled(truth, 250.0)
    path = tmp_path / f"a{ending}"
    if ending == ".csv":
        foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        lines = [",".join(columns), ",".join(units[name] for name in columns), *(",".join(map(repr, row)) for row in rows)]
        path.write_text("\n".join(lines), encoding="utf-8")
    else:
        # Channels have times of their own, in seconds.
        said = "" if "time_s" in stated else said
        asammdf = pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
        foreignkit.write_rig(tmp_path, foreignkit.COLUMNS.replace("time: {signal: time_s}\n", ""))
        file = asammdf.MDF(version="4.10")
        time_s = columns.pop("time_s")
        file.append([asammdf.Signal(values, time_s, unit=units[name], name=name) for name, values in columns.items()])
        file.save(path)
    Mapping(tmp_path / "mapping.yaml").read(path)
    told = capsys.readouterr().err
    assert said in told and told.count("is right?") + told.count("`scale`?") == bool(said)


@pytest.mark.parametrize(
    ("force", "said", "least_N"),
    [
        (lambda f, _: np.where(np.arange(len(f)) % 90 < 9, -9999.0, f), "values are -9999, which stand for none", -200.0),
        (lambda f, _: np.where(np.arange(len(f)) == 300, 3.4e38, f), "values are 3.4e+38, which stand for none", -200.0),
        (lambda f, _: np.where(np.arange(len(f)) % 4 == 0, f, 0.0), "values are 0, which stand for none", -200.0),
        (lambda f, _: np.minimum(f, 9999.0), "", -200.0),
        (lambda f, _: 2000.0 * np.rint(f / 2000.0), "", -200.0),
        (lambda f, t: 9000.0 * np.sin(2 * np.pi * 30.0 * t) * (np.sin(9.0 * t) > 0.0), "", -9100.0),
    ],
    ids=["nines", "largest float", "filled with zeros", "end of a sensor", "coarse", "bursts"],
)
def test_numbers_that_stand_for_none_are_no_force(columns, truth, tmp_path, capsys, force, said, least_N):
    noisy = columns["force_N"] + np.random.default_rng(5).normal(0, 25, 749)
    columns["force_N"] = np.round(force(noisy, columns["time_s"]), 3)
    log = read(tmp_path, columns)
    told = capsys.readouterr().err
    assert said in told and ("which stand for none" in told) == bool(said)
    assert least_N < np.nanmin(log.force_N) and np.nanmax(log.force_N) < 40e3
    at = np.interp(1e-9 * (log.samples["time_ns"] - log.samples["time_ns"][0]), truth.time_s, truth.force)
    assert not said or np.nanmax(np.abs(log.force_N - at)) < 4e3


def test_a_coarse_sensor_about_zero_is_filled_with_nothing():
    steps = 50.0 * np.rint(np.abs(np.random.default_rng(5).normal(0.0, 40.0, 2000)) / 50.0)
    assert not no_values(steps).any() and np.sum(steps == 0.0) > 500


def test_a_torque_that_is_cut_off_where_it_is_small_is_measured_all_the_same():
    """Half of a drive is without braking; zeros that fill rows stand between any values, these between the smallest."""
    torque = 60.0 * np.abs(np.convolve(np.random.default_rng(5).normal(0.0, 1.0, 20_000), np.hanning(120), "valid"))
    cut = np.where(torque < 200.0, 0.0, torque)
    assert not no_values(cut).any() and np.sum(np.diff(cut == 0.0)) > 200
    assert np.array_equal(no_values(np.where(np.arange(len(torque)) % 4, 0.0, torque)), np.arange(len(torque)) % 4 > 0)


@pytest.mark.parametrize(("least_kmh", "measured"), [(-0.3, 1.0), (-3.0, 0.5)])
def test_a_standing_wheel_may_be_measured_a_little_below_zero(tmp_path, capsys, least_kmh, measured):
    """A zero error of some tenths of a kilometre an hour makes no unknown speed."""
    time_s = 0.1 * np.arange(400)
    speed = np.where(np.arange(400) % 2, 100.0, least_kmh)
    (tmp_path / "a.csv").write_text("t,v\n" + "\n".join(f"{t:.1f},{v}" for t, v in zip(time_s, speed, strict=True)))
    stated = dict.fromkeys(("MotorAngle", "BrakeRequest", "ParkBrake", "AmbientTemp"), "value: 0")
    mapping = write_mapping(tmp_path, "time: {signal: t, unit: s}", VehicleSpeed="signal: v, unit: km/h", **stated)
    frames = mapping.read(tmp_path / "a.csv")
    told, sent = capsys.readouterr().err, np.sum(frames["can_id"] == 0x182)
    assert abs(sent * 1e8 / np.ptp(frames["time_ns"]) - measured) < 0.1
    assert ("VehicleSpeed is beyond 0 to 655.35" in told) == (measured < 1.0) and "times smaller" not in told


@pytest.mark.parametrize(
    ("force", "said"),
    [
        (lambda f, t: np.where(t > 1.5, f[375], f), "N for 1.4"),
        (lambda f, _: np.maximum(f, 0.0), ""),
        (lambda f, _: np.minimum(f, 8000.0), "stays at 8000 N"),
        (lambda f, _: 500.0 * np.rint(f / 500.0), ""),
        (lambda f, _: np.where(np.arange(len(f)) == 5, -200.0, 200.0 * np.rint(f / 200.0)), ""),
    ],
    ids=["a recorder that ended", "nothing below zero", "an amplifier's end", "coarse", "coarse in the clearance"],
)
def test_a_force_that_stays_while_the_motor_turns_is_said(columns, tmp_path, capsys, force, said):
    """Judged by it, every estimate would be wrong."""
    columns["force_N"] = force(columns["force_N"] + np.random.default_rng(5).normal(0, 25, 749), columns["time_s"])
    read(tmp_path, columns)
    told = capsys.readouterr().err
    assert said in told and ("while the motor turns by" in told) == bool(said)


def test_a_spreadsheets_days_are_a_unit_of_time(columns, tmp_path):
    days = columns | {"time_s": 45000.0 + columns["time_s"] / 86400.0}
    log = read(tmp_path, days, foreignkit.COLUMNS.replace("signal: time_s}", "signal: time_s, unit: d}"))
    assert np.ptp(log.time_s) == pytest.approx(np.ptp(columns["time_s"]), abs=0.01)


_OF_MESSAGES, _PACKED = "is not read; expected what it holds as CSV", "is not read; unpack it first"


@pytest.mark.parametrize(
    ("begins", "said"),
    [
        *((begins, _OF_MESSAGES) for begins in (b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0", b"%PDF-1.4")),
        *((begins, _OF_MESSAGES) for begins in (b"\x80\x04\x95", b"\x80\x05\x95")),
        *((begins, _PACKED) for begins in (b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07", b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18")),
        (bytes(257) + b"ustar", "is a tar archive, which is not read; unpack it first"),
        (b"PK\x03\x04", "unpack an archive first"),
        (b"<!DOCTYPE html>\n", "is a web page"),
        (b"<html><body>", "is a web page"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n",
            "is a pointer of Git LFS to a file that is not here",
        ),
    ],
)
def test_what_is_no_log_is_refused_with_what_would_do(tmp_path, begins, said):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    mapped = Mapping(tmp_path / "mapping.yaml").read
    for name, reads in (("a.csv", mapped), ("a.log", read_frames), ("a.blf", read_frames)):
        (tmp_path / name).write_bytes(begins + bytes(200))
        with pytest.raises(InputError, match=f"^{tmp_path / name}: .*{re.escape(said)}[^\n]*$"):
            reads(tmp_path / name)


_NO_ANGLE = re.sub(r"\n.*MotorAngle.*", "", foreignkit.COLUMNS)


@pytest.mark.parametrize(("factor", "said"), [(-1.0, "ClampForceRef falls while CurrentQ rises"), (1.0, "")])
@pytest.mark.parametrize("motion", [foreignkit.slow, foreignkit.random])
def test_a_torque_sensor_the_wrong_way_round_is_told_without_an_angle(tmp_path, capsys, motion, factor, said):
    """A motor on a dynamometer: speed, current and torque, no angle."""
    columns = foreignkit.sampled(foreignkit.truth(motion()), 250.0)
    read(tmp_path, _wrong(columns, "force_N", factor=factor), _NO_ANGLE)
    told = capsys.readouterr().err
    assert said in told and ("scale: -1" in told) == bool(said)


def test_inertia_alone_turns_no_torque_sensor_round(tmp_path, capsys):
    """At the top of a fast sine the current brakes the motor while the force is largest."""
    time_s = foreignkit.FINE_S * np.arange(round(4.0 / foreignkit.FINE_S))
    sine = foreignkit.parameters()["clearance"] + 10.0 + 4.0 * np.sin(2.0 * np.pi * 7.0 * time_s)
    columns = foreignkit.sampled(foreignkit.truth(sine), 500.0)
    assert np.corrcoef(columns["current_A"], columns["force_N"])[0, 1] < -0.6
    read(tmp_path, columns, _NO_ANGLE)
    assert "scale: -1" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("load", "factor", "of_current", "said"),
    [
        (0.0, 1.0, 1.0, ""),
        (0.0, -1.0, 1.0, "as if friction drove the motor: `scale: -1` of MotorAngle"),
        (400.0, 1.0, 1.0, ""),
        (400.0, -1.0, 1.0, "as if friction drove the motor: `scale: -1` of MotorAngle"),
        (400.0, 1.0, -1.0, "as if friction drove the motor: `scale: -1` of CurrentQ"),
    ],
)
def test_friction_drives_no_motor(tmp_path, capsys, load, factor, of_current, said):
    """A motor to and fro against a torque sensor, load and stroke of their own; and one that turns free, at either end of its
    travel with a current of its own (cogging), which is nothing that clamps."""
    rng, time_s = np.random.default_rng(4), 0.004 * np.arange(5000)
    angle = 60.0 / np.pi * np.arcsin(np.sin(2.0 * np.pi * 0.37 * time_s))
    speed = np.gradient(angle, time_s)
    force = load * np.sin(2.0 * np.pi * 0.11 * time_s)
    current = 0.02 * force + 0.8 * np.sign(speed) + 2e-4 * np.gradient(speed, time_s) + rng.normal(0.0, 0.1, len(time_s))
    if not load:
        current += 0.5 * (angle < -25.0)
    motion = {"angle_rad": factor * angle, "speed_rad_per_s": factor * speed}
    free = foreignkit.COLUMNS.replace("{signal: force_N, unit: N}", "{value: 0}")
    columns = columns_of(time_s, **motion, current_A=of_current * current, force_N=force)
    read(tmp_path, columns, foreignkit.COLUMNS if load else free)
    told = capsys.readouterr().err
    assert said in told and told.count("scale: -1") == bool(said)


@pytest.mark.parametrize(
    ("late_s", "mean_ms", "said"),
    [
        (0.0, None, "CurrentQ comes 7 ms before the load that it belongs to: is it a value of the moment? Then `mean_ms: 0`"),
        (0.0, 0, ""),
        (0.01, 0, "CurrentQ comes 10 ms after the load that it belongs to: a `mean_ms` longer by 20"),
        (0.01, 20, ""),
        (-0.001, 0, ""),
        (0.05, 0, "CurrentQ comes 50 ms after the load"),
        (-0.08, 0, "CurrentQ comes 80 ms before the load that it belongs to: is ClampForceRef late? Then `mean_ms: 160`"),
    ],
)
def test_a_current_of_another_time_than_its_load_is_said(tmp_path, capsys, late_s, mean_ms, said):
    """A drive of 67 Hz against a torque sensor, whose current is no mean: half a period is a fifth of a load at 5 Hz."""
    time_s = 0.015 * np.arange(1500)

    def current(at_s):
        return 20.0 * np.sin(2.0 * np.pi * 5.0 * at_s) + 10.0 * np.sin(2.0 * np.pi * 3.1 * at_s)

    speed = 5.0 * np.sin(2.0 * np.pi * 0.4 * time_s)
    motion = {"angle_rad": -2.0 * np.cos(2.0 * np.pi * 0.4 * time_s), "speed_rad_per_s": speed}
    late_A = current(time_s - late_s) + np.sign(speed)
    mapped = "" if mean_ms is None else f", mean_ms: {mean_ms}"
    columns = columns_of(time_s, **motion, current_A=late_A, force_N=1000.0 * current(time_s))
    read(tmp_path, columns, foreignkit.COLUMNS.replace("unit: A", f"unit: A{mapped}"))
    told = capsys.readouterr().err
    assert said in told and ("that it belongs to" in told) == bool(said)


@pytest.mark.parametrize("load", ["another motor", "a brake", "a propeller"])
@pytest.mark.parametrize("seed", range(3))
def test_what_a_drive_takes_from_its_supply_is_no_current_of_the_motor(load, seed):
    """It is power over the supply's voltage. Where the load is one of the speed, neither is told from the other."""
    rng, time_s = np.random.default_rng(seed), 0.01 * np.arange(6000)
    speed = lfilter([0.05], [1.0, -0.95], np.repeat(rng.uniform(0.1, 1.0, 60), 100) * rng.uniform(20.0, 300.0))
    torque = np.repeat(rng.uniform(0.0 if load == "a brake" else -1.0, 1.0, 30), 200)
    torque = (speed / np.max(speed)) ** 2 if load == "a propeller" else torque
    acceleration = np.gradient(speed, time_s)
    motor_A = 10.0 * (torque + rng.uniform(0.02, 0.15) + rng.uniform(0.0, 0.3) * acceleration / np.max(np.abs(acceleration)))
    supply_A = 0.7 * motor_A * speed / np.max(speed) + 0.01 * motor_A**2
    for current, said in ((motor_A, False), (supply_A, load != "a propeller")):
        messages = {}
        for name, values in (("EMB_FL_Resolver", speed), ("EMB_FL_Current", current), ("RIG_FL_Force", torque)):
            noisy = values + rng.normal(0.0, 0.02 * np.max(np.abs(values)), 6000)
            messages[name] = Series((1e9 * time_s).astype(np.int64), noisy)
        signals = ("MotorSpeed", "CurrentQ", "ClampForceRef")
        lines = contradictions("FL", {name: {signal: messages[name]} for name, signal in zip(messages, signals, strict=True)})
        assert any("takes such a current from its supply" in line for line in lines) == said


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("load", ["either sign", "one sign", "none"])
def test_the_size_of_a_current_is_none_with_a_sign(load, seed):
    """As of an effective value or a phase's amplitude; where a load holds the current's sign its size is itself, and what goes
    to both sides has a sign."""
    rng, time_s = np.random.default_rng(seed), 0.004 * np.arange(8000)
    speed = sum(rng.uniform(20.0, 60.0) * np.sin(rng.uniform(2.0, 12.0) * time_s + rng.uniform(0.0, 6.0)) for _ in range(3))
    lowest, highest = {"either sign": (-1.0, 1.0), "one sign": (0.6, 1.0), "none": (0.0, 0.0)}[load]
    torque = np.repeat(rng.uniform(lowest, highest, 40), 200)
    acceleration = np.gradient(speed, time_s)
    accelerates = rng.uniform(0.1, 0.3) * acceleration / np.max(np.abs(acceleration))
    motor_A = 10.0 * (torque + rng.uniform(0.02, 0.1) * np.sign(speed) + accelerates)
    at = (1e9 * time_s).astype(np.int64)

    def noisy(values: np.ndarray) -> Series:
        return Series(at, values + rng.normal(0.0, 0.002 * np.max(np.abs(values)), len(at)))

    shifted_A = np.abs(motor_A) - 0.2 * np.max(np.abs(motor_A))
    for current, said in ((motor_A, False), (np.abs(motor_A), load != "one sign"), (shifted_A, False)):
        messages = {
            "EMB_FL_Resolver": {"MotorSpeed": noisy(speed)},
            "EMB_FL_Current": {"CurrentQ": noisy(current)},
            "RIG_FL_Force": {"ClampForceRef": noisy(torque) if load != "none" else 0.0},
        }
        assert any("goes with the size of what load" in line for line in contradictions("FL", messages)) == said


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1.0, []),
        (
            1e-3,
            [
                "MotorSpeed covers 7.3 steps",
                "CurrentQ covers 8 steps of our message, and rounding hides what it says: `scale`",
            ],
        ),
        (4e-6, ["MotorAngle covers 29 steps"]),
    ],
)
def test_what_our_messages_would_round_away_is_said(tmp_path, capsys, factor, said):
    """A robot's joint, at its own shaft, takes minutes for a turn, and its spring makes none. What stands is not too slow."""
    time_s = 0.004 * np.arange(20000)
    speed = 73.0 * factor * np.sin(0.1 * time_s)
    angle, current = -730.0 * factor * np.cos(0.1 * time_s), 40.0 * factor * np.sign(speed)
    columns = columns_of(time_s, angle_rad=angle, speed_rad_per_s=speed, current_A=current)
    read(tmp_path, columns, foreignkit.COLUMNS.replace("{signal: force_N, unit: N}", "{value: 0}"))
    told = capsys.readouterr().err
    assert all(line in told for line in said) and ("covers" in told) == bool(said), told


@pytest.mark.parametrize(
    ("speed_rad_per_s", "current_A", "load_N", "said"),
    [
        (50.0, 4.0, 0.0, []),
        (0.05, 4.0, 0.0, ["MotorSpeed covers 5."]),
        (50.0, 4e-4, 0.0, ["CurrentQ covers 0.08"]),
        (None, 4.0, 1e4, []),
        (None, 4e-3, 1e4, ["CurrentQ covers 0.8"]),
        (0.0, 4e-3, 0.0, []),
    ],
)
def test_what_rounding_hides_is_said_without_an_angle(speed_rad_per_s, current_A, load_N, said):
    """A motor whose speed alone is measured, one locked against a torque sensor, and one that stands: it has only noise."""
    rng, wave = np.random.default_rng(2), np.sin(0.01 * np.arange(4000))

    def column(most: float, noise: float) -> Series:
        return Series(4_000_000 * np.arange(4000), most * wave + noise * rng.normal(size=4000))

    messages = {"EMB_FL_Current": {"CurrentQ": column(current_A, 0.01 * current_A)}, "RIG_FL_Force": {"ClampForceRef": load_N}}
    if load_N:
        messages["RIG_FL_Force"]["ClampForceRef"] = column(load_N, 10.0)
    if speed_rad_per_s is not None:
        messages["EMB_FL_Resolver"] = {"MotorSpeed": column(speed_rad_per_s, 0.001)}
    told = [line for line in contradictions("FL", messages) if "covers" in line]
    assert len(told) == len(said) and all(one.startswith(start) for one, start in zip(told, said, strict=True)), told


def test_a_brake_that_stands_is_no_contradiction(tmp_path, capsys):
    """The last count of its encoder goes to and fro."""
    rng, count = np.random.default_rng(1), 800
    noise = {"speed_rad_per_s": 0.3, "current_A": 0.2, "plate_C": 0.0, "force_N": 20.0}
    columns = {"time_s": 0.004 * np.arange(count), "angle_rad": 5.0 + 0.0015 * rng.integers(0, 2, count)}
    read(tmp_path, columns | {name: rng.normal(0.0, sigma, count) for name, sigma in noise.items()})
    assert capsys.readouterr().err == ""


def test_a_log_of_two_recordings_ends_a_command_with_one_line(columns, tmp_path, capsys):
    foreignkit.write_rig(tmp_path, foreignkit.COLUMNS)
    table = foreignkit.write_table(tmp_path / "a.csv", {name: np.tile(values, 2) for name, values in columns.items()})
    assert main(["replay", str(table), "--mapping", str(tmp_path / "mapping.yaml")]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"{table}: time goes back by")


def test_a_coarse_encoder_hides_no_way():
    """A finger's thousand counts of a tenth of a radian, one too many or too few: more than 0.01 rad, and no motion."""
    time_ns = 22_000_000 * np.arange(400)
    counts = np.floor(0.7 * np.arange(400)) + np.random.default_rng(3).integers(-1, 2, 400)
    assert not Series(time_ns, 0.1 * counts).way_is_unknown
    assert Series(time_ns, 0.1 * counts + 1e-5 * np.arange(400)).way_is_unknown


def _swings_against(load, way):
    """A joint that swings against a load, ``load`` of the angle's swing (-1 to 1) and the time: messages to be compared."""
    time_s = 0.004 * np.arange(6000)
    # To and fro at constant speed, so that acceleration takes no part.
    swing = 2.0 / np.pi * np.arcsin(np.sin(1.3 * time_s))
    force = load(swing, time_s)
    current = 1e-3 * force + 0.4 * np.sign(np.cos(1.3 * time_s)) + np.random.default_rng(3).normal(0.0, 0.05, 6000)
    times = (1e9 * time_s).astype(np.int64)
    values = {"EMB_FL_Resolver": ("MotorAngle", 30.0 * swing), "EMB_FL_Current": ("CurrentQ", current)}
    values["RIG_FL_Force"] = ("ClampForceRef", way * force)
    return {message: {name: Series(times, own)} for message, (name, own) in values.items()}


def _either_sign(swing, time_s):
    return 4000.0 * np.sin(0.37 * time_s)


def _never_released(swing, time_s):
    return 6000.0 - 2500.0 * swing


def _of_the_time(swing, time_s):
    return 3500.0 + 3400.0 * np.sin(0.21 * time_s)


@pytest.mark.parametrize(
    ("load", "way", "said"),
    [
        (_either_sign, 1.0, ""),
        (_either_sign, -1.0, "the motor's current bears its load: `scale: -1` of ClampForceRef?"),
        (_never_released, 1.0, ""),
        (_never_released, -1.0, "positive current clamps: `scale: -1` of one of the two?"),
        (_of_the_time, 1.0, ""),
    ],
    ids=["right", "sensor turned round", "a joint's weight", "turned round", "another motor's load"],
)
def test_a_load_is_asked_about_where_it_opposes_its_current_and_not_because_it_is_no_clamps(load, way, said):
    """No clamp is under load at both ends of its travel, and none's force is the same there."""
    told = [line for line in contradictions("FL", _swings_against(load, way)) if "scale: -1" in line]
    assert (said in told[0] and "ClampForceRef falls while CurrentQ rises" in told[0] if told else False) == bool(said)
    assert len(told) == bool(said)


def _driven(current: np.ndarray) -> dict[str, Series]:
    """A motor of 1 N·m/A at 300 Hz against a load that its current, less 2 A of friction, bears; by name."""
    time_s = np.arange(len(current)) / 300.0
    speed, times = 3.0 * np.sin(2.5 * time_s), np.round(1e9 * time_s).astype(np.int64)
    noise = np.random.default_rng(3).normal(0.0, 0.5, len(current))
    load = 400.0 * (current - 2.0 * np.sign(speed) - 0.3 * np.gradient(speed, time_s) + noise)
    return {name: Series(times, values) for name, values in {"current": current, "speed": speed, "force": load}.items()}


def _needed() -> np.ndarray:
    """30 s, some of it beyond 28 A, with a few sudden steps."""
    time_s = np.arange(9000) / 300.0
    return 20.0 * np.sin(2.1 * time_s) + 14.0 * np.sin(0.9 * time_s) - 15.0 * ((time_s > 28.1) & (time_s < 28.3))


@pytest.mark.parametrize("limit_A", [28.0, 22.0])
@pytest.mark.parametrize("late", [0, 5])
def test_a_current_whose_number_was_full_is_told_by_the_load_that_goes_on(limit_A, late):
    """Also where it stays at the end for some samples first, and where it is full for a quarter of the time."""
    needed = _needed()
    told = _driven(needed)
    numbered = np.clip(needed, -limit_A, limit_A)
    beyond = np.convolve(np.abs(needed) > limit_A, np.ones(late + 1), "full")[: len(needed)] > late
    full = np.where(beyond, needed - 2.0 * limit_A * np.sign(needed), numbered)
    found = overflown(Series(told["current"].time_ns, full), told["speed"], told["force"])
    assert np.array_equal(
        found, (np.abs(needed) > limit_A) | (np.abs(full) == limit_A) | (full == full.max()) | (full == full.min())
    )


def test_a_full_number_goes_almost_from_end_to_end_between_rare_samples():
    """The rest passes up to 13 % of the range within a sample here; what falls by less of it was lost and not full."""
    time_s, rows = np.arange(24_000) / 300.0, slice(0, None, 40)
    needed = 20.0 * np.sin(2.1 * time_s) + 14.0 * np.sin(0.9 * time_s)
    told = {name: Series(s.time_ns[rows], s.values[rows]) for name, s in _driven(needed).items()}
    beyond = np.abs(needed) > 22.0
    full = np.where(beyond, needed - 44.0 * np.sign(needed), needed)[rows]
    ends = np.abs(np.diff(full))[np.diff(beyond[rows].astype(int)) != 0]
    assert 0.8 < np.min(ends) / np.ptp(full) < 0.9
    found = overflown(Series(told["current"].time_ns, full), told["speed"], told["force"])
    assert np.array_equal(found, beyond[rows] | (full == full.max()) | (full == full.min()))
    lost = np.where(np.abs(needed) > 25.0, needed - 35.0 * np.sign(needed), needed)
    told = _driven(needed)
    assert 0.6 < np.max(np.abs(np.diff(lost))) / np.ptp(lost) < 0.8
    assert not np.any(overflown(Series(told["current"].time_ns, lost), told["speed"], told["force"]))


@pytest.mark.parametrize("follows", [True, False], ids=["load follows", "load of its own"])
def test_a_current_that_is_turned_round_at_once_was_no_larger(follows):
    turned = 20.0 * np.where(np.sin(4.0 * np.arange(9000) / 300.0) > 0.0, 1.0, -1.0)
    turned += np.random.default_rng(4).normal(0.0, 0.3, len(turned))
    told = _driven(turned if follows else _needed())
    assert not np.any(overflown(Series(told["current"].time_ns, turned), told["speed"], told["force"]))
    spiked = np.where(np.arange(9000) == 4000, 200.0, _needed())
    assert not np.any(overflown(Series(told["current"].time_ns, spiked), told["speed"], told["force"]))
    assert not np.any(overflown(Series(told["current"].time_ns, _needed()), told["speed"], told["force"]))


def _smoothed(random: np.random.Generator, over: int) -> np.ndarray:
    noise = np.convolve(random.normal(size=5999 + over), np.ones(over) / over, "valid")
    return noise / noise.std()


def _of_its_own(seed: int) -> list[Series]:
    """A current that goes from one end to the other at random times, at once or almost, a speed and a load."""
    random = np.random.default_rng(seed)
    slow = _smoothed(random, random.integers(5, 200))
    current = 20.0 * (np.sign(slow) if seed % 2 else np.clip(5.0 * slow, -1.0, 1.0)) + random.normal(0.0, 0.5, 6000)
    speed, load = 3.0 * _smoothed(random, 100), 4000.0 * _smoothed(random, random.integers(5, 300))
    return [Series(np.arange(6000) * 3_333_333, values) for values in (current, speed, load)]


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 35, 99, 103, 145])
def test_a_current_that_nothing_explains_is_left_as_it_is(seed):
    assert not np.any(overflown(*_of_its_own(seed)))


def test_a_recording_that_begins_and_ends_in_a_full_number_is_no_other():
    needed = _needed()
    rows = slice(int(np.argmax(needed > 30.0)), len(needed) - int(np.argmax(needed[::-1] < -30.0)))
    told = {name: Series(s.time_ns[rows], s.values[rows]) for name, s in _driven(needed).items()}
    full = np.where(np.abs(needed) > 28.0, needed - 56.0 * np.sign(needed), needed)[rows]
    found = overflown(Series(told["current"].time_ns, full), told["speed"], told["force"])
    assert found[0] and found[-1] and np.mean(found) < 0.3


def test_what_was_recorded_as_another_current_is_left_out_and_said(tmp_path, capsys):
    told = _driven(needed := _needed())
    angle = np.cumsum(told["speed"].values) / 300.0
    motion = {"angle_rad": angle, "speed_rad_per_s": told["speed"].values}
    columns = columns_of(1e-9 * told["current"].time_ns, **motion, force_N=told["force"].values)
    full = (needed + 30.0) % 60.0 - 30.0
    gone = np.sum((np.abs(needed) > 30.0) | (full == full.max()) | (full == full.min()))
    log = read(tmp_path, columns | {"current_A": full})
    said = capsys.readouterr().err
    assert f"its number was full; {gone} of 9000 values are left out" in said
    known = log.samples["has_current"]
    assert 0.8 < np.mean(known) < 0.999
    read(tmp_path, columns | {"current_A": needed})
    assert "number was full" not in capsys.readouterr().err
