"""A force controller around the estimator as an FMU, as a simulation tool runs it; the FMU contains no Python.

emb-daemon compile
emb-daemon export --calibration config/calibration.yaml --output brake.fmu
python examples/fmu_control_loop.py brake.fmu

Needs fmpy. The toy brake is that of control_loop.py; put your plant's FMU in its place.
"""

import math
import shutil
import sys

import fmpy
from control_loop import DT_S, FASTEST, SPEED_PER_ERROR, ToyBrake
from fmpy.fmi3 import FMU3Slave

import emb_daemon


def main(path: str, seconds: float = 3.0, wanted_N: float = 8000.0) -> float:
    description = fmpy.read_model_description(path)
    reference = {variable.name: variable.valueReference for variable in description.modelVariables}
    inputs = [reference[name] for name in ("angle_rad", "speed_rad_per_s", "current_A")]
    outputs = [reference[name] for name in ("clamp_force_N", "clamp_force_sigma_N")]
    folder = fmpy.extract(path)
    estimator = FMU3Slave(
        guid=description.guid,
        modelIdentifier=description.coSimulation.modelIdentifier,
        unzipDirectory=folder,
        instanceName="brake",
    )
    estimator.instantiate()
    estimator.enterInitializationMode()
    estimator.exitInitializationMode()

    brake, current, force = ToyBrake(emb_daemon.shipped_calibration()), 0.0, 0.0
    for cycle in range(round(seconds / DT_S)):
        estimator.setFloat64(inputs, [brake.angle, brake.speed, current])
        estimator.doStep(cycle * DT_S, DT_S)
        force, sigma = estimator.getFloat64(outputs)
        if estimator.getInt64([reference["source"]])[0] == 15:
            raise SystemExit("no force to control by: open the brake")
        # For its first tenth of a second the estimator makes sure that the brake is released.
        error = (wanted_N if cycle * DT_S > 0.2 else 0.0) - force
        current = brake.move(math.copysign(min(abs(SPEED_PER_ERROR * error), FASTEST), error))
        if cycle % 125 == 0:
            print(f"{cycle * DT_S:4.1f} s  {force:7.0f} ± {sigma:3.0f} N")
    print(f"wanted {wanted_N:.0f} N, estimated {force:.0f} N, the toy's own force {brake.force:.0f} N")
    estimator.terminate()
    estimator.freeInstance()
    shutil.rmtree(folder)
    return brake.force


if __name__ == "__main__":
    main(sys.argv[1])
