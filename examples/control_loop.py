"""The estimator inside a control loop of your own: a force controller without a force sensor.

The brake is a toy (a spring with friction) so that the loop fits on a screen; put your plant, HIL or drive in its place.

python examples/control_loop.py
"""

import math

import emb_daemon
from emb_daemon.calibration.curves import curve_at

DT_S = 0.004
SPEED_PER_ERROR = 0.02  # rad/s per N
FASTEST = 150.0  # rad/s


class ToyBrake:
    """A motor that obeys speed commands, pads whose force follows the calibration's own curve, and its friction."""

    def __init__(self, calibration):
        self.curve = curve_at(calibration.stiffness.curves, calibration.pad_thickness_mm)
        self.share = 1.0 - math.exp(-DT_S / calibration.stiffness.relaxation_time_s)
        self.motor, self.friction, self.clearance = calibration.motor, calibration.friction, calibration.contact.clearance_rad
        self.angle = self.speed = self.force = self.turned = 0.0

    def move(self, speed: float) -> float:
        """Returns the mean motor current over the cycle."""
        before, self.angle = self.force, self.angle + speed * DT_S
        x = max(self.angle - self.clearance, 0.0)
        self.force += self.share * (sum(a * x ** (n + 1) for n, a in enumerate(self.curve)) - self.force)
        mean = 0.5 * (before + self.force)
        torque = self.motor.inertia_kg_m2 * (speed - self.speed) / DT_S + self.motor.gear_gain_m_per_rad * mean
        # Friction changes its direction over the presliding angle.
        self.turned += (math.copysign(1.0, speed) - self.turned) * (
            1.0 - math.exp(-abs(speed) * DT_S / self.friction.presliding_angle_rad)
        )
        torque += self.turned * (self.friction.load_m_per_rad * mean + self.friction.offset_Nm)
        self.speed = speed
        return torque / self.motor.torque_constant_Nm_per_A


def main(seconds: float = 3.0, wanted_N: float = 8000.0) -> float:
    calibration = emb_daemon.shipped_calibration()
    brake, estimator = ToyBrake(calibration), emb_daemon.Estimator(calibration)
    current, answer = 0.0, None
    for cycle in range(round(seconds / DT_S)):
        answer = estimator.step(
            brake.angle, brake.speed, current, dt_s=DT_S, backplates_C=(20.0, 20.0), wheel_speed_rad_per_s=0.0
        )
        if answer.source == "invalid":
            raise SystemExit("no force to control by: open the brake")
        # For its first tenth of a second the estimator makes sure that the brake is released.
        error = (wanted_N if cycle * DT_S > 0.2 else 0.0) - answer.force_N
        current = brake.move(math.copysign(min(abs(SPEED_PER_ERROR * error), FASTEST), error))
        if cycle % 125 == 0:
            print(f"{cycle * DT_S:4.1f} s  {answer.force_N:7.0f} ± {answer.sigma_N:3.0f} N  ({answer.source}, {answer.mode})")
    print(f"wanted {wanted_N:.0f} N, estimated {answer.force_N:.0f} N, the toy's own force {brake.force:.0f} N")
    return brake.force


if __name__ == "__main__":
    main()
