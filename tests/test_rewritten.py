"""A recording that is written again in other units, directions, clocks and layouts is the same recording."""

import numpy as np
import pytest

from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.logs.columns import Decoder
from emb_daemon.logs.read import read_frames
from emb_daemon.logs.write import write_frames
from emb_daemon.offline import load_log
from emb_daemon.plant import scenarios as sc
from emb_daemon.plant.derive import plant_from_calibration
from studies import rewritten

#: Ways that change nothing but how numbers are written.
_SAME = [
    "as it is", "deg, rpm, mA, kN", "deg/s, kgf", "per cent of a current", "current turned round", "motion turned round",
    "force turned round", "ms", "us since 1970", "s since 1970", "16 bit of ms", "32 bit of us", "counted rows", "semicolons",
    "within one turn",
]  # fmt: skip


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "clamp.log"
    plant = plant_from_calibration(shipped_calibration(), seed=3)
    write_frames(path, sc.simulate_log(plant, sc.rest(0.5) + sc.park(15e3, 3.0), seed=4)[0])
    return path


@pytest.mark.parametrize("name", _SAME)
def test_with_its_mapping_it_is_what_it_was(recording, tmp_path, name):
    plain, way = rewritten.plain(recording), rewritten.variants(250.0)[name]
    status, path, said = rewritten.convert(recording, way, tmp_path / "theirs")
    assert status == 0, said
    log = load_log(path)
    middle = slice(5, min(len(log.samples), len(plain["time"])) - 5)
    # The first frames of a log may lack what a later one brings.
    lag = int(np.argmin([np.abs(log.force_N[middle] - np.roll(plain["force"], n)[middle]).sum() for n in range(-3, 4)])) - 3
    there = {"angle": log.samples["angle"], "current": log.samples["current_q"], "force": log.force_N}
    for column, limit in (("angle", 0.02), ("current", 0.02), ("force", 2.0)):
        theirs, ours = there[column][middle], np.roll(plain[column], lag)[middle]
        turned = np.median(theirs - ours) if column == "angle" else 0.0
        assert np.quantile(np.abs(theirs - ours - turned), 0.95) < limit, column


def test_a_current_that_was_not_measured_is_not_written(recording, tmp_path):
    frames = read_frames(recording)
    seconds = 1e-9 * (frames["time_ns"] - frames["time_ns"][0])
    unknown = (frames["can_id"] == Decoder().can_id("EMB_FL_Current")) & (seconds > 1.0) & (seconds < 2.0)
    write_frames(tmp_path / "gap.log", frames[~unknown])
    _, path, _ = rewritten.convert(tmp_path / "gap.log", rewritten.variants(250.0)["as it is"], tmp_path / "theirs")
    there = [load_log(log).samples["has_current"] for log in (tmp_path / "gap.log", path)]
    assert 0.2 < np.mean(~there[0]) < 0.4 and np.sum(there[0] != there[1]) < 5


@pytest.mark.parametrize(
    ("name", "question"),
    [
        ("counted rows", "or a counter's? Then `rate_Hz`"),
        ("untared", "was the sensor tared? `offset: -70"),
        ("current without its sign", "The motor's has a sign"),
    ],
)
def test_without_its_mapping_what_is_wrong_is_said(recording, tmp_path, name, question):
    status, _, said = rewritten.convert(recording, rewritten.variants(250.0)[name], tmp_path / "theirs", mapped=False)
    assert (status, question in said) == (0, True), said
    assert question not in rewritten.convert(recording, rewritten.variants(250.0)["as it is"], tmp_path / "plain")[2]
