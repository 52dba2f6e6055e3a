"""Force sensor of low range: what it teaches below its limit holds above, and no error of its own is taken for force."""

import brake
import foreignkit
import msgspec
import numpy as np
import pytest
import wirekit
from wirekit import MS

import emb_daemon
from emb_daemon.calibration.files import load_calibration, shipped_calibration
from emb_daemon.calibration.parameters import moved, parameter
from emb_daemon.calibration.types import ForceSensor, to_parameters
from emb_daemon.errors import InputErrors
from emb_daemon.estimator import force_sensor
from emb_daemon.estimator.records import SAMPLE, new_state
from emb_daemon.logs.mapping import Mapping
from emb_daemon.models.fusion import CONTACT, FAST, OF_THE_MODEL, SCALE, STATES
from emb_daemon.offline import estimate, log_of
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant import scenarios as sc
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.resources import resource
from emb_daemon.wire import layout as wire
from emb_daemon.wire.contract import DEGRADED, E2E_ERROR, PATHS_DISAGREE, TORQUE_ONLY
from studies.phases import LEARNED_RMSE_N

LIMIT_N = 5000.0
SENSOR = ForceSensor(
    limit_N=LIMIT_N, noise_N=10.0, offset_N=50.0, offset_walk_N_per_sqrt_s=1.0, offset_N_per_K=1.0, gain_relative=0.01
)


@pytest.fixture
def ideal(parameters):
    """A brake of the thesis's models alone, and the same with a sensor."""
    without = brake.ideal(parameters)
    with_sensor = without.copy()
    mounted = msgspec.structs.replace(shipped_calibration(), force_sensor=SENSOR)
    with_sensor["sensor"] = to_parameters(mounted)["sensor"]
    return without, with_sensor


def _measured(force_N, gain=1.0, offset_N=0.0, limit_N=LIMIT_N):
    """What a sensor says, in whole newtons."""
    noisy = gain * force_N + offset_N + SENSOR.noise_N * np.random.default_rng(2).standard_normal(len(force_N))
    return np.rint(np.clip(noisy, -limit_N, limit_N))


def _drive(p, count=6, **of_the_brake):
    """SAMPLE rows of stops with a brake that differs from PARAMETERS ``p``, and its force."""
    other = p.copy()
    for name, factor in of_the_brake.items():
        other[name] = factor * other[name]
    rows, force_N = brake.samples(other, brake.stops(p, count))
    return brake.noisy(rows, p), force_N


def _with_sensor(rows, values):
    rows = rows.copy()
    rows["sensor_force"], rows["has_sensor_force"] = values, True
    return rows


def _rmse(estimates, force_N, rows):
    return float(np.sqrt(np.mean((estimates["force"] - force_N)[rows] ** 2)))


@pytest.mark.parametrize("change", [{"curve": 0.85}, {"curve": 1.15}, {"clearance": 0.9}, {"clearance": 1.1}])
def test_it_carries_the_force_beyond_its_limit(ideal, change):
    """In the first application of a brake that is not as calibrated; the promise is 60 %, or the 100 N that are promised of a
    brake which has learned."""
    without, mounted = ideal
    rows, force_N = _drive(without, 1, **change)
    above = force_N > LIMIT_N
    alone = _rmse(estimate(rows, without), force_N, above)
    with_sensor = _rmse(estimate(_with_sensor(rows, _measured(force_N)), mounted), force_N, above)
    assert with_sensor <= max(0.6 * alone, LEARNED_RMSE_N) and with_sensor < alone


def test_what_it_is_off_by_within_its_tolerances_does_not_harm(ideal):
    without, mounted = ideal
    rows, force_N = _drive(without)
    alone = _rmse(estimate(rows, without), force_N, force_N > 0.0)
    for gain, offset_N in ((1.01, 0.0), (0.99, 0.0), (1.0, 80.0), (1.0, -80.0)):
        found = estimate(_with_sensor(rows, _measured(force_N, gain=gain, offset_N=offset_N)), mounted)
        assert _rmse(found, force_N, force_N > 0.0) <= 1.1 * alone
        assert np.mean(np.abs(found["force"] - force_N) <= 3.0 * found["sigma"]) > 0.99
        assert not (found["reasons"] & PATHS_DISAGREE).any()


def test_at_its_limit_it_measures_nothing(ideal):
    _, mounted = ideal
    rows, force_N = _drive(mounted, 3, curve=0.9)
    clipped = _with_sensor(rows, _measured(force_N))
    silent = clipped.copy()
    silent["has_sensor_force"] &= clipped["sensor_force"] < LIMIT_N
    assert estimate(clipped, mounted)["force"].tobytes() == estimate(silent, mounted)["force"].tobytes()


_AT = 2000


def _stuck(values, force_N):
    values[_AT:] = values[_AT]


def _stuck_in_contact(values, force_N):
    at = _AT + int(np.flatnonzero((force_N[_AT:] > 2000.0) & (force_N[_AT:] < LIMIT_N))[0])
    values[at:] = values[at]


def _weak(values, force_N):
    values[_AT:] *= 0.8


def _jumped(values, force_N):
    values[_AT:] += 700.0


def _drifting(values, force_N):
    values[_AT:] += 0.004 * 20.0 * np.arange(len(values) - _AT)


@pytest.mark.parametrize("fault", [_stuck, _stuck_in_contact, _weak, _jumped, _drifting])
def test_its_own_faults_do_not_harm_and_are_said(ideal, fault):
    without, mounted = ideal
    rows, force_N = _drive(without, 10)
    values = _measured(force_N, limit_N=np.inf)
    fault(values, force_N)
    values = np.minimum(values, LIMIT_N)
    alone, found = estimate(rows, without), estimate(_with_sensor(rows, values), mounted)
    wrong = np.arange(len(rows)) >= _AT
    assert _rmse(found, force_N, wrong) <= 1.1 * _rmse(alone, force_N, wrong)
    said = (found["mode"] == DEGRADED) & (found["reasons"] & PATHS_DISAGREE > 0)
    assert not said[:_AT].any()
    # A zero that drifts slowly shows in each clearance and is followed.
    assert said[_AT:].any() or fault is _drifting


def test_it_stands_in_where_the_resolver_has_failed(ideal):
    without, mounted = ideal
    rows, force_N = _drive(without, 3)
    low = brake.stops(without, 3)
    rows, force_N = brake.samples(without, np.minimum(low, without["clearance"] + 6.0))
    rows = brake.noisy(rows, without)
    frozen = len(rows) // 2
    rows["angle"][frozen:], rows["speed"][frozen:] = rows["angle"][frozen], 0.0
    alone, found = estimate(rows, without), estimate(_with_sensor(rows, _measured(force_N)), mounted)
    failed = (found["source"] == TORQUE_ONLY) & (alone["source"] == TORQUE_ONLY) & (force_N > 500.0)
    assert failed.sum() > 100
    assert _rmse(found, force_N, failed) <= 0.3 * _rmse(alone, force_N, failed)
    assert np.median(found["sigma"][failed]) < 0.5 * np.median(alone["sigma"][failed])


def _car(force_sensor):
    calibration = msgspec.structs.replace(shipped_calibration(), force_sensor=force_sensor)
    car = Car(np.atleast_1d(plant_from_calibration(calibration, 3)), seed=4)
    schedule = sc.rest(1.0) + sc.stop(8000.0, 2.0) + sc.rest(1.0)
    frames, truth = car.run(sc.commands_of(schedule, ("FL",)), schedule.drives)
    return calibration, frames, truth[:, 0]


def _consumed(calibration, frames):
    pipeline = Pipeline(np.repeat(np.atleast_1d(to_parameters(calibration)), 4), ("FL",))
    pipeline.begin(int(frames["time_ns"][0]))
    _, count = pipeline.consume(frames)
    return pipeline.samples[:count].copy(), pipeline.estimates[:count].copy()


def test_the_simulated_car_sends_what_its_sensor_says():
    calibration, frames, truth = _car(SENSOR)
    samples, _ = _consumed(calibration, frames)
    assert samples["has_sensor_force"].all()
    below = truth["force"] < 4500.0
    off = samples["sensor_force"] - truth["force"]
    assert np.std(off[below & (truth["force"] == 0.0)]) == pytest.approx(SENSOR.noise_N, rel=0.2)
    assert np.abs(off[below]).max() < 5.0 * (SENSOR.offset_N + SENSOR.noise_N + 0.01 * LIMIT_N)
    assert np.all(samples["sensor_force"][truth["force"] > 5500.0] == LIMIT_N)


def test_without_it_in_the_calibration_its_frames_change_nothing():
    calibration, frames, _ = _car(SENSOR)
    bare = msgspec.structs.replace(calibration, force_sensor=None)
    others = frames[frames["can_id"] != 0x0F0]
    assert wirekit.same(_consumed(bare, frames)[1], _consumed(bare, others)[1])
    assert not wirekit.same(_consumed(calibration, frames)[1], _consumed(calibration, others)[1])


def test_a_car_without_it_sends_what_it_sent():
    _, with_it, _ = _car(SENSOR)
    _, without, _ = _car(None)
    assert 0x0F0 in with_it["can_id"] and 0x0F0 not in without["can_id"]


def _sample(frames):
    pipeline = Pipeline(np.repeat(np.atleast_1d(to_parameters(shipped_calibration())), 4), ("FL",))
    pipeline.begin(0)
    _, count = pipeline.consume(np.concatenate(frames))
    return pipeline.samples[:count]


def test_its_value_belongs_to_the_sample_with_its_counter():
    def force(at_ns, counter, value):
        return wirekit.frame("EMB_FL_ForceSensor", at_ns, counter, SensorForce=value)

    drive = wirekit.drive(4)
    fast = [frame for frame in drive if frame["can_id"][0] in (0x100, 0x110)]
    frames = [
        force(0, 0, 100.0), *fast[:2],
        # Late: its sample has been answered.
        *fast[2:4], force(4 * MS + 200_000, 1, 200.0),
        # None for this one; the next as the first.
        *fast[4:6], force(12 * MS - 1000, 3, 300.0), *fast[6:8],
    ]  # fmt: skip
    rows = _sample(frames)
    assert rows["has_sensor_force"].tolist() == [True, False, False, True]
    assert rows["sensor_force"][[0, 3]].tolist() == [100.0, 300.0]
    broken = force(0, 0, 100.0)
    broken["data"] ^= np.uint64(1 << 20)
    [row] = _sample([broken, *fast[:2], wirekit.frame("VEH_WheelPulse", 3 * MS)])
    assert not row["has_sensor_force"] and row["reasons"] & E2E_ERROR


def test_a_dbc_may_be_without_it(tmp_path):
    text = resource("dbc/emb.dbc").read_text()
    bare = "\n".join(block for block in text.split("\n\n") if "ForceSensor: 8" not in block)
    bare = "\n".join(line for line in bare.splitlines() if not any(f" {can_id} " in line for can_id in range(240, 244)))
    (tmp_path / "own.dbc").write_text(bare.replace("\nBO_ ", "\n\nBO_ "))
    layout = wire.load_layout(tmp_path / "own.dbc")
    assert layout["slot"][0][0x0F0] == wire.FOREIGN and layout["slot"][0][0x100] == wire.RESOLVER


def test_a_strangers_sensor_is_mapped(tmp_path):
    truth = foreignkit.truth()
    columns = foreignkit.sampled(truth, 500.0)
    log = emb_daemon.log_of_arrays(
        columns["time_s"], columns["angle_rad"], columns["speed_rad_per_s"], columns["current_A"],
        sensor_force_N=np.minimum(columns["force_N"], LIMIT_N), force_N=columns["force_N"],
    )  # fmt: skip
    known = np.isfinite(log.force_N) & (log.force_N < LIMIT_N)
    assert log.samples["has_sensor_force"].mean() > 0.99
    assert np.abs(log.samples["sensor_force"] - log.force_N)[known].max() < 60.0
    text = "format: 1\ntime: {signal: t}\nsignals:\n  EMB_FL_Resolver.MotorAngle: {signal: a, unit: rad}\n"
    (tmp_path / "m.yaml").write_text(text + "  EMB_FL_ForceSensor.SensorForce: {signal: f, unit: kN}\n")
    table = np.column_stack([columns["time_s"], columns["angle_rad"], 1e-3 * np.minimum(columns["force_N"], LIMIT_N)])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,a,f", comments="")
    mapped = log_of(Mapping(tmp_path / "m.yaml").read(tmp_path / "log.csv"))
    assert mapped.samples["has_sensor_force"].mean() > 0.99
    assert mapped.samples["sensor_force"].max() == LIMIT_N


def test_its_section_of_the_calibration_is_checked(tmp_path):
    calibration = shipped_calibration()
    text = resource("config/calibration.yaml").read_text()
    (tmp_path / "c.yaml").write_text(text + "force_sensor: {limit_N: -1, noise_N: 10, offset_N: 1, gain_relative: 2}\n")
    with pytest.raises(InputErrors) as faults:
        load_calibration(tmp_path / "c.yaml")
    assert all(
        f"force_sensor.{name}" in str(faults.value) or name in str(faults.value) for name in ("limit_N", "gain_relative")
    )
    mounted = msgspec.structs.replace(calibration, force_sensor=SENSOR)
    found = parameter(mounted, "force_sensor.offset_N_per_K")
    assert (found.value, found.unit, found.low) == (1.0, "N/K", 0.0)
    assert moved(mounted, {"force_sensor.limit_N": 4000.0}, checked=True).force_sensor.limit_N == 4000.0


# The sensor alone.


def _sensor(wrong=False, variance=2500.0):
    """Its record in a STATE, with a zero known to 50 N, and a SAMPLE."""
    s, m = new_state()[0], np.zeros(1, SAMPLE)[0]
    s["sensor"]["started"], s["sensor"]["wrong"], s["sensor"]["variance"] = True, wrong, variance
    s["sensor"]["zeroed"], m["caliper"], m["has_thermocouple"] = 20.0, 20.0, True
    return s, m


def test_the_zero_is_the_mean_of_what_open_pads_show_and_of_what_was_known(ideal):
    """By their variances; from readings that are three sigma off, too."""
    (s, m), q = _sensor(), ideal[1]["sensor"]
    c, readings = s["sensor"], 150.0 + 10.0 * np.random.default_rng(1).standard_normal(40)
    for value in readings:
        m["sensor_force"] = value
        force_sensor._find_zero(c, q, m, float(c["variance"]))
    known = 1.0 / (1.0 / 50.0**2 + len(readings) / 10.0**2)
    assert c["variance"] == pytest.approx(known) and c["offset"] == pytest.approx(known * readings.sum() / 10.0**2)
    assert c["contradiction"] == 0.0


def test_a_zero_that_jumps_is_disbelieved_before_it_is_found_anew(ideal):
    (s, m), q = _sensor(variance=25.0), ideal[1]["sensor"]
    c, m["sensor_force"] = s["sensor"], 2000.0
    force_sensor._find_zero(c, q, m, 25.0)
    assert (c["offset"], c["variance"]) == (0.0, 25.0) and c["contradiction"] > 100.0
    c["wrong"] = True
    force_sensor._find_zero(c, q, m, 25.0)
    assert c["offset"] == pytest.approx(2000.0, abs=0.1) and c["variance"] == pytest.approx(10.0**2, rel=1e-3)


def test_what_all_samples_of_a_stroke_share_is_zero_warmth_age_and_gain(ideal):
    """1 N/K of a caliper that is 30 K warmer than at the last zero, a third of a cycle of a force that grows, 1 % of it."""
    (s, m), p = _sensor(), ideal[1]
    assert force_sensor._common(s, p, m, 0.0, 0.0) == pytest.approx(50.0)
    m["caliper"], s["force"] = 50.0, 4000.0
    expected = np.sqrt(50.0**2 + 30.0**2 + (0.3 * 400.0) ** 2 + 40.0**2)
    assert force_sensor._common(s, p, m, 4000.0, 3600.0) == pytest.approx(expected)
    m["has_thermocouple"] = False
    assert force_sensor._common(s, p, m, 4000.0, 4000.0) == pytest.approx(np.hypot(50.0, 40.0))


def test_no_number_of_values_teaches_more_than_their_common_error_allows():
    """Nor is anything learned from one that is far off."""
    rng, gain, h = np.random.default_rng(2), np.zeros(STATES), np.zeros(STATES)
    h[CONTACT], h[SCALE], h[FAST] = -900.0, 8000.0, 40.0
    x, P = np.zeros(STATES), np.diag(np.full(STATES, 1e-4))
    P[FAST, FAST], noise, common = 1.0, 10.0, 30.0
    total, share = force_sensor._learn(x, P, gain, h, 50.0, noise, common)
    slow = (900.0**2 + 8000.0**2) * 1e-4
    assert total == pytest.approx(slow + 40.0**2 + noise**2 + common**2) and 0.0 < share < 1.0
    for _ in range(2000):
        force_sensor._learn(x, P, gain, h, rng.normal(0.0, noise), noise, common)
        P[FAST, FAST] = 1.0
    of_model = np.where(np.isin(np.arange(STATES), OF_THE_MODEL), h, 0.0)
    assert 0.99 * common**2 < of_model @ P @ of_model < 2.0 * common**2
    before = x.copy()
    assert force_sensor._learn(x, P, gain, h, 5000.0, noise, 1.0)[1] == 0.0 and np.array_equal(x, before)
