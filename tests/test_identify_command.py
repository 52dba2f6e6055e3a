"""emb-daemon identify on logs of the simulated rig: figures, faults, provenance, report."""

import contextlib
import hashlib
import io
import re
from types import SimpleNamespace

import foreignkit
import numpy as np
import pytest
from browserkit import assert_is_drawn

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.cli.main import main
from emb_daemon.errors import InputError
from emb_daemon.identify.campaign import RANDOM, Campaign, load_campaign
from emb_daemon.identify.campaign_file import DiscCooling
from emb_daemon.identify.run import identify
from emb_daemon.logs import read
from emb_daemon.logs.columns import Decoder


def _campaign(folder, rig, text):
    path = folder / "campaign.yaml"
    head = f"rig: A\ncorner: FL\ndatasheet: {rig}/datasheet.yaml\npad_thickness_mm: 6.5\n"
    path.write_text(head + text.replace("RIG", str(rig)))
    return path


@pytest.fixture(scope="module")
def identified(rig, tmp_path_factory, counted_reads):
    """A campaign on three pad thicknesses with an empty and a wrong log, run once by the command; reads by file name."""
    folder = tmp_path_factory.mktemp("identify")
    (folder / "empty.log").write_text("")
    campaign = _campaign(
        folder,
        rig,
        """curves:
  - {log: RIG/static/curve_0p5mm.log.gz, pad_thickness_mm: 0.5}
  - {log: RIG/static/curve_6p5mm.log.gz}
  - {log: RIG/static/curve_11p5mm.log.gz, pad_thickness_mm: 11.5}
random:
  - {log: RIG/static/random_0p5mm.log.gz, pad_thickness_mm: 0.5}
  - {log: RIG/static/random_6p5mm.log.gz}
  - {log: RIG/static/random_11p5mm.log.gz, pad_thickness_mm: 11.5}
  - {log: empty.log, pad_thickness_mm: 3.5}
  - {log: RIG/static/curve_3p5mm.log.gz, pad_thickness_mm: 3.5}
frequency_response:
  - {log: RIG/static/sine_0p6Hz.log.gz, frequency_Hz: 0.6, pad_thickness_mm: 10.0}
  - {log: RIG/static/sine_1p7Hz.log.gz, frequency_Hz: 1.7, pad_thickness_mm: 10.0}
  - {log: RIG/static/sine_5Hz.log.gz, frequency_Hz: 5.0, pad_thickness_mm: 10.0}
""",
    )
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), counted_reads() as reads:
        status = main(["identify", str(campaign), "--output", str(folder / "c.yaml"), "--report", str(folder / "report")])
    outputs = {"out": out.getvalue(), "err": err.getvalue(), "reads": reads}
    assert status == 3, "what two logs should have shown is missing: " + outputs["err"]
    return folder, outputs


def test_calibration_loads_and_is_good_on_logs_that_fitted_nothing(identified):
    folder, outputs = identified
    calibration = load_calibration(folder / "c.yaml")
    assert np.isfinite(to_parameters(calibration)["curve"]).all()
    figures = calibration.provenance.figures
    for thickness in ("0.5", "6.5", "11.5"):
        of = {path: figures[f"random, {thickness} mm: {path} rmse_N"] for path in ("stiffness", "torque", "fused")}
        assert of["stiffness"] <= 120.0 and of["torque"] <= 550.0
        assert of["fused"] <= 1.05 * min(of["stiffness"], of["torque"])
        # 0.99 is asked; other creep than the calibration knows adds up to 0.002 (`test_rig`).
        assert 0.90 <= figures[f"random, {thickness} mm: inside_two_sigma"] <= 0.993
    achieved = calibration.provenance.achieved
    assert achieved["torque_N"] == max(value for name, value in figures.items() if name.endswith("torque rmse_N"))
    rows = [line for line in outputs["out"].splitlines() if line.startswith(("random", "sine"))]
    assert len(rows) == 6 and "thesis" not in outputs["out"]


def test_every_log_is_read_once(identified):
    _, outputs = identified
    # Ten logs of the rig, and the empty one.
    assert len(outputs["reads"]) == 11 and set(outputs["reads"].values()) == {1}, outputs["reads"]


def test_every_log_that_cannot_serve_is_named_with_what_was_needed(identified):
    _, outputs = identified
    lines = outputs["err"].splitlines()
    for name in ("empty.log", "curve_3p5mm"):
        (line,) = [line for line in lines if name in line]
        assert "needed" in line
    assert any("nominal" in line for line in lines), "heat without logs must be said to be nominal"


def test_provenance_names_each_log_with_its_hash_and_each_value_with_its_sigma(identified, rig):
    folder, _ = identified
    provenance = load_calibration(folder / "c.yaml").provenance
    hashes = {source.log: source.sha256 for source in provenance.logs}
    name = f"{rig}/static/random_6p5mm.log.gz"
    assert hashes[name] == hashlib.sha256((rig / "static/random_6p5mm.log.gz").read_bytes()).hexdigest()
    for key in ("stiffness.relaxation_time_s", "effects.second_relaxation.share", "motor.torque_constant_Nm_per_A"):
        assert provenance.sigmas[key] > 0.0
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", provenance.date)


def test_report_is_one_file_that_fetches_nothing(identified):
    folder, _ = identified
    assert [path.name for path in (folder / "report").iterdir()] == ["report.html"]
    page = (folder / "report/report.html").read_text()
    assert page.count("Plotly.newPlot(place") == 1
    assert not re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="http', page)
    assert "Fused force" in page and "Torque balance" in page and "empty.log" in page
    assert "missed" not in page and "to reach" not in page


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("curvs: []\n", r"campaign.yaml:5: curvs: unknown key; did you mean curves\?"),
        ("corner: FL\n", "corner: occurs twice"),
        ("curves:\n  - {pad_thickness_mm: 3}\n", "curves.*log: missing"),
        ("random:\n  - {log: a.log, pad_thickness_mm: -1}\n", "pad_thickness_mm: Expected"),
        ("dbc: nowhere.dbc\n", "nowhere.dbc: no such file"),
        ("curves: []\n", "curves, random: no usable log; needed: slow clamp"),
        ("random:\n  - {log: gone.log}\n", r"random\[0\].log: .*gone.log: no such file"),
        ("thermal: {disc_cooling: [{log: gone.log, disc_turns_per_s: 1}]}\n", r"disc_cooling\[0\].log: .*no such file"),
    ],
)
def test_unusable_campaigns_end_with_one_clear_line(rig, tmp_path, capsys, text, expected):
    campaign = _campaign(tmp_path, rig, text)
    assert main(["identify", str(campaign), "--output", str(tmp_path / "c.yaml")]) == 2
    error = capsys.readouterr().err
    assert re.search(expected, error), error
    assert not (tmp_path / "c.yaml").exists()


def test_outputs_that_cannot_be_written_are_refused_before_the_work(rig, tmp_path, capsys):
    campaign = _campaign(tmp_path, rig, "curves: [{log: RIG/static/curve_6p5mm.log.gz}]\n")
    (tmp_path / "file").write_text("")
    for arguments, expected in (
        (["--output", str(tmp_path)], "is not a regular file"),
        (["--output", str(campaign)], "is one of the inputs"),
        (["--output", str(tmp_path / "none" / "c.yaml")], "no such folder"),
        (["--output", str(tmp_path / "c.yaml"), "--report", str(tmp_path / "file")], "expected a folder"),
        (["--output", str(tmp_path / "c.yaml"), "--report", str(tmp_path / "c.yaml")], "is the calibration's file"),
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(read, "read_file", lambda path: pytest.fail(f"{path} read"))
            assert main(["identify", str(campaign), *arguments]) == 2
        assert expected in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(rig, tmp_path, capsys, monkeypatch):
    campaign = _campaign(tmp_path, rig, "curves: [{log: RIG/static/curve_6p5mm.log.gz}]\n")
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert main(["identify", str(campaign), "--output", str(tmp_path / "c.yaml")]) == 2
    assert capsys.readouterr().err == f"{tmp_path / 'c.yaml'}: the folder cannot be written: {tmp_path}\n"


def test_a_disc_that_turns_otherwise_than_the_campaign_says_is_left_out(rig, tmp_path):
    campaign = load_campaign(_campaign(tmp_path, rig, ""))
    log = f"{rig}/thermal/disc_cooling_1tps.log.gz"
    assert campaign.load_cooling(DiscCooling(log=log, disc_turns_per_s=1.0)) is not None
    assert campaign.load_cooling(DiscCooling(log=log, disc_turns_per_s=2.0)) is None
    (fault,) = campaign.faults
    assert "disc_turns_per_s: expected 2 turns per second" in fault


def test_a_log_that_is_too_short_says_how_long_one_must_be(rig, tmp_path, monkeypatch):
    """A screw that is driven in within 1.5 s: the message does not blame the sampling of 4 ms."""
    campaign = load_campaign(_campaign(tmp_path, rig, ""))
    log = campaign.load(f"{rig}/static/random_6p5mm.log.gz", "random", "motion")
    short = SimpleNamespace(samples=log.samples[:400], force_N=log.force_N[:400], time_s=log.time_s[:400])
    monkeypatch.setattr(Campaign, "load", lambda *_: short)
    assert campaign.load_motion("a.log", "random", "motion", reversals=RANDOM) is None
    (fault,) = campaign.faults
    assert "400 samples, one every 4 ms; expected 500 of them, two seconds; needed: motion; left out" in fault


def test_a_force_that_no_such_brake_reaches_is_left_out(rig, tmp_path):
    """Jammed, or in another unit; single outliers of a sensor are accepted."""
    sheet = (rig / "datasheet.yaml").read_text()
    (tmp_path / "datasheet.yaml").write_text(sheet)
    (tmp_path / "campaign.yaml").write_text("rig: A\ndatasheet: datasheet.yaml\n")
    name = f"{rig}/static/random_6p5mm.log.gz"
    campaign = load_campaign(tmp_path / "campaign.yaml")
    log = campaign.load(name, "random", "motion")
    log.force_N[np.flatnonzero(np.isfinite(log.force_N))[:3]] = 1e6
    assert campaign.load(name, "random", "motion") is log and not campaign.faults
    log.force_N[:] *= 10.0
    assert campaign.load(name, "random", "motion") is None
    (fault,) = campaign.faults
    assert re.search(r"random: .*random_6p5mm.log.gz: the reference force reaches \d+ kN, which no brake of 30 kN", fault)


def test_a_wheel_with_other_pulses_than_the_daemon_counts_is_refused(rig, tmp_path):
    sheet = (rig / "datasheet.yaml").read_text()
    (tmp_path / "datasheet.yaml").write_text(sheet.replace("pulses_per_revolution: 96", "pulses_per_revolution: 48"))
    path = tmp_path / "campaign.yaml"
    path.write_text("rig: A\ndatasheet: datasheet.yaml\n")
    with pytest.raises(InputError, match="pulses_per_revolution: expected 96"):
        load_campaign(path)
    (tmp_path / "datasheet.yaml").write_text(sheet)
    assert load_campaign(path).pad_thickness_mm == 10.0, "the datasheet's, where the campaign states none"


def test_a_rig_with_another_bus_layout_is_refused(rig, tmp_path):
    text = (rig / "rig.dbc").read_text()
    (tmp_path / "other.dbc").write_text(
        text.replace("SG_ MotorAngle : 16|24@1- (0.0002,0)", "SG_ MotorAngle : 16|24@1- (0.0004,0)")
    )
    load_campaign(_campaign(tmp_path, rig, "dbc: RIG/rig.dbc\n"))
    with pytest.raises(InputError, match="EMB_FL_Resolver: expected id, signals and factors"):
        load_campaign(_campaign(tmp_path, rig, "dbc: other.dbc\n"))


@pytest.mark.parametrize(
    ("motions", "status"),
    [
        ({"curve": foreignkit.slow}, 3),
        pytest.param({"curve": foreignkit.slow, "random": foreignkit.random}, 0, marks=pytest.mark.trial),
    ],
    ids=["one slow curve", "both"],
)
def test_same_campaign_gives_the_same_calibration_but_for_its_date(tmp_path, monkeypatch, motions, status):
    campaign = foreignkit.write_campaign(tmp_path, **{name: motion() for name, motion in motions.items()})
    mapping = ["--mapping", str(tmp_path / "mapping.yaml")]
    for name, epoch in (("c.yaml", "0"), ("again.yaml", "86400")):
        monkeypatch.setenv("SOURCE_DATE_EPOCH", epoch)
        assert main(["identify", str(campaign), *mapping, "--output", str(tmp_path / name)]) == status
    first, again = ((tmp_path / name).read_text() for name in ("c.yaml", "again.yaml"))
    assert "1970-01-02" in again
    assert re.sub(r"\d{4}-\d\d-\d\d", "", first) == re.sub(r"\d{4}-\d\d-\d\d", "", again)


def test_missing_campaign_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_campaign(tmp_path / "none.yaml")


def test_the_report_opens_in_a_browser(identified, tmp_path):
    html = (identified[0] / "report" / "report.html").read_text()
    assert_is_drawn(html, tmp_path, plots=html.count("data-figure="))


@pytest.mark.trial
def test_a_late_reference_is_no_property_of_the_brake(rig, tmp_path):
    """A reference that is a sample late raised the relative sigma of the force from 0.33 to 3.7 %, and changed the inertia."""

    def late(path):
        frames, digest = read.read_with_digest(path)
        frames = frames.copy()
        force = np.flatnonzero(frames["can_id"] == Decoder("dbc/rig.dbc").can_id("RIG_FL_Force"))
        frames["data"][force[1:]] = frames["data"][force[:-1]]
        return frames, digest

    path = _campaign(
        tmp_path,
        rig,
        "curves:\n  - {log: RIG/static/curve_6p5mm.log.gz}\nrandom:\n  - {log: RIG/static/random_6p5mm.log.gz}\n",
    )
    ours, theirs = (identify(load_campaign(path, how)) for how in (read.read_with_digest, late))
    [told] = theirs.stiffness.notes
    assert not ours.stiffness.notes and float(told.split()[4]) == pytest.approx(4.0, abs=0.4)
    assert theirs.calibration.motor.inertia_kg_m2 == pytest.approx(ours.calibration.motor.inertia_kg_m2, rel=2e-3)
    assert theirs.calibration.noise.stiffness_N == pytest.approx(ours.calibration.noise.stiffness_N, rel=0.2)
    assert theirs.calibration.noise.stiffness_relative < ours.calibration.noise.stiffness_relative + 1e-3
