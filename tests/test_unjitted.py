"""The kernels as plain Python give the same: what numba compiles is what is written."""

from pathlib import Path

import numpy as np
import processkit
import wirekit

_ESTIMATES = """
import sys, numpy as np
from emb_daemon.offline import estimate
samples, parameters = np.load(sys.argv[1]), np.load(sys.argv[2])
np.save(sys.argv[3], estimate(samples, parameters[:1]))
"""


def test_kernels_pass_without_compilation():
    arguments = ["-m", "pytest", "-q", "-p", "no:cacheprovider", Path(__file__).parent / "test_kernels.py"]
    done = processkit.python(*arguments, NUMBA_DISABLE_JIT="1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout and "skipped" not in done.stdout


def test_estimates_are_equal_without_compilation(parameters, tmp_path):
    """A clamp on a turning disc, bit for bit."""
    from emb_daemon.offline import estimate
    from emb_daemon.pipeline import Pipeline

    pipeline = Pipeline(parameters, ("FL",))
    pipeline.begin(0)
    frames = np.concatenate(
        wirekit.drive(
            150,
            angle=30.0 * np.clip(np.arange(150) / 75.0, 0.0, 1.0),
            speed=100.0 * (np.arange(150) < 75),
            current=0.5 + 0.12 * np.arange(150),
            wheel_speed=30.0,
        )
    )
    _, count = pipeline.consume(frames)
    for name, array in (("samples", pipeline.samples[:count]), ("parameters", parameters)):
        np.save(tmp_path / name, array)
    files = [tmp_path / f"{name}.npy" for name in ("samples", "parameters", "estimates")]
    done = processkit.python("-c", _ESTIMATES, *files, NUMBA_DISABLE_JIT="1")
    assert done.returncode == 0, done.stderr
    compiled, plain = estimate(pipeline.samples[:count], parameters[:1]), np.load(tmp_path / "estimates.npy")
    assert plain["force"][-1] > 5000.0
    for name in plain.dtype.names:
        np.testing.assert_array_equal(plain[name], compiled[name], err_msg=name)
