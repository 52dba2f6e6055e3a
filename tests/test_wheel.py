"""How fast the disc turns, from whatever of wheel speed, pulses and vehicle speed there is and can be true."""

import numpy as np
import pytest

from emb_daemon.estimator.records import SAMPLE
from emb_daemon.estimator.wheel import WHEEL, disc_speed
from emb_daemon.models.wheel import wheel_angle

_DT = 0.004
_PULSES_PER_RAD = 96 / (2.0 * np.pi)


class Car:
    """A wheel and a vehicle that pass by; pulses are counted, wrapped and sent every 20 ms."""

    def __init__(self, pulses_from=0.0, radius=0.31):
        self.w, self.m, self.radius = np.zeros(1, WHEEL), np.zeros(1, SAMPLE), radius
        self.m["dt"] = _DT
        self._counted, self._samples, self._heard = float(pulses_from), 0, False

    def drive(self, seconds, turning=0.0, wheel_speed=None, pulses=True, vehicle=True, rolling=None):
        """``turning`` rad/s of the disc; ``wheel_speed`` what its sensor says, None if it is lost; ``rolling`` m/s of the
        vehicle.

        Returns what is told, shape (samples, 2)."""
        m, told = self.m, []
        m["has_wheel_speed"], m["wheel_speed"] = wheel_speed is not None, wheel_speed or 0.0
        m["has_wheel_pulse"], m["has_status"] = pulses, vehicle
        m["vehicle_speed"] = turning * self.radius if rolling is None else rolling
        for _ in range(round(seconds / _DT)):
            self._counted += turning * _PULSES_PER_RAD * _DT
            self._samples += 1
            if pulses and (self._samples % 5 == 0 or not self._heard):
                m["wheel_pulse"] = np.floor(self._counted) % 4096
            self._heard = pulses
            told.append(disc_speed(self.w[0], m[0]))
        return np.array(told)

    @property
    def contradicted(self):
        return bool(self.w["contradicted"][0])


def test_wheel_speed_is_taken_as_it_is():
    told = Car().drive(2.0, turning=30.0, wheel_speed=30.1)
    assert np.all(told == [30.1, 0.0])


@pytest.mark.parametrize("turning", [5.0, 40.0, 120.0])
def test_pulses_alone(turning):
    """Within the five percent that it says of itself, through the counter's wrap."""
    car = Car(pulses_from=3900)
    told = car.drive(4.0, turning=turning, vehicle=False)[500:]
    assert np.all(np.abs(told[:, 0] - turning) < 3.0 * told[:, 1]) and np.all(told[:, 1] < 0.08 * turning)
    stood = car.drive(2.5, vehicle=False)
    assert stood[-1, 0] < 0.5, "and they say when it stands"


def test_pulses_that_were_not_heard_for_a_while_are_no_speed():
    """The count goes on while no message comes: its jump is neither a speed nor a contradiction."""
    car = Car()
    car.drive(1.0, turning=20.0, wheel_speed=20.0)
    car.drive(5.0, turning=20.0, wheel_speed=20.0, pulses=False)
    car._counted += 1900
    told = []
    for _ in range(5):
        told.append(car.drive(0.2, turning=0.0, wheel_speed=0.0))
        assert not car.contradicted
    late = Car(pulses_from=3000)
    late.drive(0.1, wheel_speed=0.0, pulses=False)
    late.drive(0.4, wheel_speed=0.0)
    assert not late.contradicted and late.drive(0.1)[-1, 0] < 0.5


def test_a_speed_from_before_the_pulses_were_lost_is_forgotten():
    car = Car()
    car.drive(1.0, turning=20.0, vehicle=False)
    car.drive(3.0, turning=0.0, pulses=False, vehicle=False)
    assert np.all(car.drive(0.2, turning=0.0, vehicle=False)[:, 0] < 0.5)


def test_vehicle_speed_alone_knows_the_tyre_to_a_tenth():
    told = Car(radius=0.33).drive(1.0, turning=40.0, pulses=False)
    assert np.all(np.abs(told[:, 0] - 40.0) < told[:, 1]) and np.all(told[:, 1] == pytest.approx(4.0, rel=0.1))


def test_the_tyres_radius_is_learned_while_both_speeds_are_there():
    car = Car(radius=0.33)
    car.drive(60.0, turning=40.0, wheel_speed=40.0, pulses=False)
    assert car.drive(0.1, turning=40.0, pulses=False)[-1, 0] == pytest.approx(40.0, rel=0.01)
    spinning = Car(radius=0.05)
    spinning.drive(60.0, turning=110.0, wheel_speed=110.0, pulses=False)
    assert spinning.w["radius"][0] == pytest.approx(0.31), "a wheel that spins teaches no radius"


def test_zero_while_the_pulses_go_on_is_contradicted():
    """An eighth of a turn is what a wheel that is said to stand may still give."""
    car = Car()
    car.drive(2.0, turning=40.0, wheel_speed=40.0)
    told = car.drive(1.0, turning=40.0, wheel_speed=0.0)
    believed = np.flatnonzero(told[:, 0] > 30.0)[0] * _DT
    assert car.contradicted and 40.0 * believed == pytest.approx(2.0 * np.pi / 8.0, abs=40.0 * 0.024)
    assert told[-1, 0] == pytest.approx(40.0, rel=0.1) and told[-1, 1] > 0.0
    assert np.all(car.drive(0.1, turning=40.0, wheel_speed=40.0)[-1] == [40.0, 0.0]) and not car.contradicted


def test_a_wheel_that_comes_to_rest_is_no_contradiction():
    """Its sensor reads zero from some speed down while the last pulses still come."""
    car = Car()
    car.drive(2.0, turning=8.0, wheel_speed=8.0)
    for turning in np.linspace(2.0, 0.0, 50):
        car.drive(0.008, turning=turning, wheel_speed=0.0)
        assert not car.contradicted


def test_rolling_backwards_is_a_speed():
    car = Car(pulses_from=3000)
    told = car.drive(3.0, turning=-20.0, vehicle=False)[-1]
    assert told[0] == pytest.approx(20.0, rel=0.1) and told[1] > 0.0


def test_a_blocked_wheel_is_no_contradiction():
    """The car slides on, wheel and pulses stand: the disc stands."""
    car = Car()
    car.drive(2.0, turning=40.0, wheel_speed=40.0)
    told = car.drive(4.0, turning=0.0, wheel_speed=0.0, rolling=12.0)
    assert np.all(told[:, 0] == 0.0) and not car.contradicted


def test_without_pulses_a_wheel_may_block_for_a_second():
    """As long as an anti-lock control lets it; after that the vehicle is believed, with its tenth."""
    car = Car()
    car.drive(2.0, turning=40.0, wheel_speed=40.0, pulses=False)
    told = car.drive(2.0, turning=0.0, wheel_speed=0.0, pulses=False, rolling=12.0)
    assert np.all(told[: round(0.95 / _DT), 0] == 0.0)
    late = told[round(1.05 / _DT) :]
    assert car.contradicted and np.all(np.abs(late[:, 0] - 12.0 / 0.31) < late[:, 1])


def test_when_all_is_lost_nothing_is_known():
    car = Car()
    car.drive(1.0, turning=40.0, wheel_speed=40.0)
    told = car.drive(0.1, turning=40.0, pulses=False, vehicle=False)
    assert np.all(np.isnan(told[:, 0])) and np.all(np.isinf(told[:, 1]))


def test_what_is_not_seen_to_heat_may_have_heated(parameters):
    """A stop at 7 kN of a turning disc: without any speed sigma of the temperature grows by what the stop heats, and it is
    said."""
    import brake

    from emb_daemon.offline import estimate
    from emb_daemon.wire.contract import TEMPERATURE_UNCERTAIN

    p = brake.ideal(parameters)
    up = brake.clamp(p, 14.0, 0.4)
    rows, _ = brake.samples(p, np.concatenate([np.zeros(100), up, np.full(5000, up[-1])]))
    rows["wheel_speed"], rows["has_wheel_pulse"] = 40.0, False
    rows["vehicle_speed"] = 40.0 * 0.31
    good = estimate(rows, p)
    assert not np.any(good["reasons"] & TEMPERATURE_UNCERTAIN)
    rows["has_wheel_speed"][200:], rows["has_status"][200:] = False, False
    blind = estimate(rows, p)
    assert blind["reasons"][-1] & TEMPERATURE_UNCERTAIN
    assert blind["sigma"][-1] > good["sigma"][-1]


@pytest.mark.parametrize("speed", [0.4, 7.0, 40.0, 120.0])
def test_the_angle_of_a_wheel_is_that_of_its_pulses_through_the_counters_wrap(speed):
    """Within a pulse after a second: by a message every 20 ms, which was sent half a sample ago, and by the wheel speed."""
    width, rows = 2.0 * np.pi / 96, np.zeros(2500, SAMPLE)
    turned = 3990.3 * width + speed * _DT * np.arange(len(rows))
    rows["dt"], rows["wheel_speed"], rows["has_wheel_speed"], rows["has_wheel_pulse"] = _DT, speed, True, True
    sent = np.floor((turned - 0.5 * speed * _DT) / width) % 4096
    rows["wheel_pulse"] = sent[np.arange(len(rows)) // 5 * 5]
    assert np.abs(wheel_angle(rows) - turned)[250:].max() < width
    rows["has_wheel_speed"] = False
    # Nothing carries the angle on between the messages, and it is where the last count says.
    late = speed * _DT * (np.arange(len(rows)) % 5 + 0.5)
    assert np.abs(wheel_angle(rows) + late - turned).max() < 3.0 * width


def test_a_wheel_without_pulses_has_the_angle_of_the_last():
    rows = np.zeros(6, SAMPLE)
    rows["dt"], rows["wheel_speed"], rows["has_wheel_speed"], rows["wheel_pulse"] = _DT, 40.0, True, 960.0
    rows["has_wheel_pulse"][2:4] = True
    first = 960.5 * 2.0 * np.pi / 96
    assert wheel_angle(rows) == pytest.approx([0.0, 0.0, first, first + 0.16, first + 0.16, first + 0.16])
