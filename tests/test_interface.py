"""The estimator for C and for simulators: every byte is replay's, and what does not fit is refused."""

import shutil
import subprocess
from pathlib import Path

import adaptkit
import msgspec
import numpy as np
import processkit
import pytest

from emb_daemon.ahead import library
from emb_daemon.calibration.parameters import keys, value_of
from emb_daemon.calibration.types import to_parameters
from emb_daemon.cli.main import main
from emb_daemon.estimator.records import ESTIMATE, SAMPLE
from emb_daemon.interface import signals
from emb_daemon.interface.header import header
from emb_daemon.interface.places import places
from emb_daemon.logs.write import table_columns
from emb_daemon.offline import estimate
from emb_daemon.plant.scenarios import city_drive
from emb_daemon.replay import Replay

_CALIBRATION = adaptkit.ROOT / "config" / "calibration.yaml"

#: Samples in, estimates out, as they are in memory.
_ROWS = """
#include <stdio.h>
#include "emb.h"
int main(void) {
    emb_brake brake;
    emb_sample sample;
    emb_estimate estimate;
    emb_init(&brake, &emb_calibration);
    while (fread(&sample, sizeof sample, 1, stdin) == 1) {
        if (emb_step(&brake, &sample, &estimate) != 0)
            return 1;
        fwrite(&estimate, sizeof estimate, 1, stdout);
    }
    return 0;
}
"""
#: What the daemon counts beside the estimator, and a C program or a simulator does not.
_COUNTED = ("time_ns", "cycle", "elapsed_cycles", "counter")

needs_cc = pytest.mark.skipif(not shutil.which("cc"), reason="NOT RUN: no C compiler is installed")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Replay's samples and estimates of 30 s in the simulated car."""
    heard = []

    def hear(frames):
        heard.append(frames.copy())
        return frames

    adaptkit.ClosedLoop(tmp_path_factory.mktemp("learned"), pads_mm=10.0).run(city_drive().first(30.0), spoil=hear)
    frames = np.concatenate(heard)
    result = Replay(adaptkit.shipped(), read=lambda _: frames).run(Path("drive"))
    assert np.ptp(result.estimates["force"]) > 5000.0, "the drive does not show much"
    return result


@pytest.fixture(scope="module")
def exported(compiled, tmp_path_factory):
    """A folder with emb.h and brake.fmu of the shipped calibration."""
    folder = tmp_path_factory.mktemp("exported")
    arguments = ["export", "--calibration", str(_CALIBRATION), "--kernels", str(compiled / "kernels.so"), "--output"]
    assert main([*arguments, str(folder / "emb.h")]) == 0
    if shutil.which("cc"):
        assert main([*arguments, str(folder / "brake.fmu")]) == 0
    return folder


def _built(folder: Path, source: Path, kernels: Path, compiler: str = "cc", *options: str) -> Path:
    program = folder / source.stem
    command = [compiler, "-std=c11", "-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{folder}", source, kernels, "-lm",
               f"-Wl,-rpath,{kernels.parent}", "-o", program, *options]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


def _rows(*command, samples: np.ndarray) -> np.ndarray:
    done = subprocess.run(command, input=samples.tobytes(), capture_output=True, check=True)
    return np.frombuffer(done.stdout, ESTIMATE)


# --- C ------------------------------------------------------------------------------------------------------------------


@needs_cc
def test_in_c_every_byte_equals_replay(exported, compiled, drive):
    (exported / "rows.c").write_text(_ROWS)
    program = _built(exported, exported / "rows.c", compiled / "kernels.so")
    found = _rows(program, samples=drive.samples)
    for name in ESTIMATE.names:
        assert found[name].tobytes() == drive.estimates[name].tobytes(), name


def test_on_aarch64_the_numbers_are_the_same(exported, compiled, drive):
    """Run in qemu with Debian's libm for aarch64, which may round the other way."""
    if not shutil.which("qemu-aarch64") or not shutil.which("aarch64-linux-gnu-gcc"):
        pytest.skip("NOT RUN: qemu-user and gcc-aarch64-linux-gnu are not installed")
    (exported / "rows64.c").write_text(_ROWS)
    program = _built(exported, exported / "rows64.c", compiled / "aarch64.o", "aarch64-linux-gnu-gcc", "-static")
    found = _rows("qemu-aarch64", program, samples=drive.samples)
    for name in ESTIMATE.names:
        # What a message can hold is a million times coarser.
        rounding = 1e-9 if found[name].dtype.kind == "f" else 0.0
        np.testing.assert_allclose(found[name], drive.estimates[name], rtol=rounding, atol=rounding, err_msg=name)


@needs_cc
def test_the_example_in_c_prints_what_python_prints(exported, compiled, drive):
    program = _built(exported, adaptkit.ROOT / "examples" / "estimate.c", compiled / "kernels.so")
    samples = drive.samples[:3000].copy()
    for signal in signals.INPUTS:
        if signal.name.startswith("has_"):
            samples[signal.field] = True
    samples["reasons"] = samples["brake_request"] = 0
    columns = np.column_stack(
        [np.rint(samples["dt"] / 0.004)]
        + [samples[name] for name in ("angle", "speed", "current_q", "inner_backplate", "outer_backplate", "caliper",
                                      "ambient", "wheel_speed", "wheel_pulse", "vehicle_speed", "park_brake")]
    )  # fmt: skip
    text = "\n".join(" ".join([str(int(row[0])), *map(repr, row[1:].tolist())]) for row in columns)
    done = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in done.stdout.splitlines()], float)
    e = estimate(samples, to_parameters(adaptkit.shipped()))
    expected = [e["force"], e["sigma"], e["source"], e["mode"], e["reasons"], e["mean"][:, 0], e["mean"][:, 1]]
    assert np.array_equal(found, np.column_stack(expected), equal_nan=True)


@needs_cc
def test_a_header_of_other_sources_does_not_link(exported, compiled, tmp_path):
    text = (exported / "emb.h").read_text()
    (tmp_path / "emb.h").write_text(text.replace(library.mark(library.installed_digest()), library.mark("0" * 16)))
    (tmp_path / "rows.c").write_text(_ROWS)
    with pytest.raises(AssertionError, match="emb_made_from_0000000000000000"):
        _built(tmp_path, tmp_path / "rows.c", compiled / "kernels.so")


def test_every_input_field_is_described():
    named = {signal.field.partition("[")[0] for signal in signals.INPUTS} | set(signals.BOOKKEEPING)
    assert set(SAMPLE.names) == named
    for signal in signals.INPUTS:
        signals.field_of(SAMPLE, signal.field)


def test_outputs_are_replays_columns(drive):
    columns = table_columns(drive.estimates, drive.time_ns)
    told = {signal.name: signal for signal in signals.OUTPUTS}
    assert columns.keys() - told.keys() == {"time_s", "corner"}
    for name in columns.keys() & told.keys() - {"mode", "source", "reasons"}:
        kind, offset = signals.field_of(ESTIMATE, told[name].field)
        values = np.ndarray(len(drive.estimates), kind, drive.estimates, offset, (ESTIMATE.itemsize,))
        assert np.array_equal(values, columns[name], equal_nan=True), name


def test_a_rows_texts_take_no_more_room_than_its_numbers():
    """A week of thermocouples has half a million rows; the reasons, written out, take half a kilobyte in each."""
    estimates = np.zeros(100, ESTIMATE)
    estimates["reasons"] = 0xFFFF
    columns = table_columns(estimates, 0.004 * np.arange(100))
    assert columns["reasons"][0].count("; ") == 15 and columns["mode"][0] and columns["corner"][0] == "FL"
    assert max(values.dtype.itemsize for values in columns.values()) == 8


def test_each_number_of_the_calibration_has_its_place():
    """One that is set there is the one that `to_parameters` sets; a term's are not named."""
    calibration = adaptkit.shipped()
    found = {place.key: place for place in places(calibration)}
    words = np.frombuffer(to_parameters(calibration).tobytes(), float)
    assert all(words[place.offset // 8] == place.value for place in found.values())
    assert all(place.value == value_of(calibration, key) for key, place in found.items() if "curve[" not in key)
    apart = ("adaptation", "stiffness.curves", "pad_thickness_mm")
    assert {key for key in keys(calibration) if not key.startswith(apart)} == {key for key in found if "curve[" not in key}
    assert len({place.offset for place in found.values()}) == len(found)


def test_a_calibration_with_a_term_is_written_whole(tmp_path):
    """What C makes of the initialiser is the estimator's own record; the actuator's name is no part of the program."""
    if not shutil.which("cc"):
        pytest.skip("NOT RUN: no C compiler is installed")
    from emb_daemon.calibration.files import load_calibration, save_calibration

    builtins = msgspec.to_builtins(adaptkit.shipped())
    builtins["actuator"] = "a brake */\n#error code from a file"
    builtins["terms"] = [
        {"name": "term:a", "port": "force", "signal": "disc_temperature", "shape": "odd_power", "coefficient": 3.25,
         "exponent": 1.0, "scale": 100.0, "low": 0.0, "high": 300.0}
    ]  # fmt: skip
    calibration = msgspec.convert(builtins, type(adaptkit.shipped()))
    save_calibration(calibration, tmp_path / "calibration.yaml")
    assert load_calibration(tmp_path / "calibration.yaml") == calibration
    (tmp_path / "emb.h").write_text(header(calibration))
    (tmp_path / "dump.c").write_text('#include <stdio.h>\n#include "emb.h"\nint main(void) {\n'
                                     "fwrite(&emb_calibration, sizeof emb_calibration, 1, stdout); return 0; }\n")  # fmt: skip
    command = ["cc", "-std=c11", f"-I{tmp_path}", tmp_path / "dump.c", "-o", tmp_path / "dump"]
    subprocess.run(command, check=True, capture_output=True)
    done = subprocess.run([tmp_path / "dump"], capture_output=True, check=True)
    assert done.stdout == to_parameters(calibration).tobytes()


# --- FMU ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def fmpy(exported):
    if not (exported / "brake.fmu").exists():
        pytest.skip("NOT RUN: no C compiler is installed")
    return pytest.importorskip("fmpy", reason="NOT RUN: fmpy is not installed")


@pytest.fixture
def fmu(exported, fmpy, tmp_path):
    """The FMU's instance, set up and not yet initialized, and value references by name."""
    from fmpy.fmi3 import FMU3Slave

    path = exported / "brake.fmu"
    description = fmpy.read_model_description(path)
    fmpy.extract(path, tmp_path)
    instance = FMU3Slave(guid=description.guid, unzipDirectory=tmp_path, instanceName="brake",
                         modelIdentifier=description.coSimulation.modelIdentifier)  # fmt: skip
    instance.instantiate()
    yield instance, {variable.name: variable.valueReference for variable in description.modelVariables}
    instance.freeInstance()


def _begin(instance) -> None:
    instance.enterInitializationMode()
    instance.exitInitializationMode()


def _by_kind(table, record, reference) -> dict[str, tuple[list[int], list[str]]]:
    """Value references and fields of signals, by the name of FMI's functions."""
    found = {"Float64": ([], []), "Int64": ([], []), "Boolean": ([], [])}
    for signal in table:
        kind = {"f": "Float64", "i": "Int64", "b": "Boolean"}[signals.field_of(record, signal.field)[0].kind]
        found[kind][0].append(reference[signal.name])
        found[kind][1].append(signal.field)
    return found


def _stepped(instance, reference, samples) -> np.ndarray:
    """ESTIMATE rows that hold what the FMU tells."""
    takes, tells = (_by_kind(*table, reference) for table in ((signals.INPUTS, SAMPLE), (signals.OUTPUTS, ESTIMATE)))
    cycles = np.append(np.diff(samples["cycle"]), 1).astype(float)
    found = np.zeros(len(samples), ESTIMATE)
    raw = found.view(np.uint8).reshape(len(samples), -1)
    time = 0.0
    for row, sample in enumerate(samples):
        for kind, (references, fields) in takes.items():
            getattr(instance, f"set{kind}")(references, [sample[field].item() for field in fields])
        instance.doStep(time, 0.004 * cycles[row])
        time += 0.004 * cycles[row]
        for kind, (references, fields) in tells.items():
            if references:
                for field, value in zip(fields, getattr(instance, f"get{kind}")(references), strict=True):
                    type_, offset = signals.field_of(ESTIMATE, field)
                    raw[row, offset : offset + 8] = np.frombuffer(np.array(value, type_).tobytes(), np.uint8)
    return found


def test_the_fmu_is_valid(exported, fmpy):
    from fmpy.validation import validate_fmu

    assert validate_fmu(str(exported / "brake.fmu")) == []


def test_in_the_fmu_every_number_equals_replay(fmu, drive):
    _begin(fmu[0])
    found = _stepped(*fmu, drive.samples[:2500])
    for signal in signals.OUTPUTS:
        name = signal.field.partition("[")[0]
        expected = drive.estimates[name][:2500]
        assert np.array_equal(found[name], expected, equal_nan=expected.dtype.kind == "f"), name


def test_steps_of_several_cycles_and_without_a_sample_are_as_the_daemon_takes_them(fmu, drive):
    """Some samples missing altogether, and a stretch for which a prediction is asked."""
    _begin(fmu[0])
    samples = drive.samples[:1500][np.arange(1500) % 7 != 3].copy()
    samples["is_prediction"][800:808] = True
    last = 0
    for row in range(1, len(samples)):
        since = samples["cycle"][row] - samples["cycle"][last]
        if samples["is_prediction"][row]:
            samples["age_cycles"][row] = since
        else:
            samples["dt"][row], last = 0.004 * since, row
    expected = estimate(samples, to_parameters(adaptkit.shipped()))
    assert expected["sigma"][807] > expected["sigma"][799], "predictions show nothing"
    found = _stepped(*fmu, samples)
    for name in ("force", "sigma", "source", "mode", "reasons"):
        assert np.array_equal(found[name], expected[name], equal_nan=True), name


def test_a_parameter_of_the_fmu_is_a_number_of_the_calibration(fmu, drive):
    instance, reference = fmu
    instance.setFloat64([reference["motor.torque_constant_Nm_per_A"]], [0.06])
    _begin(instance)
    parameters = to_parameters(adaptkit.shipped())
    parameters["torque_constant"] = 0.06
    expected = estimate(drive.samples[:1000], parameters)
    assert np.array_equal(_stepped(instance, reference, drive.samples[:1000])["force"], expected["force"])
    assert not np.array_equal(expected["force"], drive.estimates["force"][:1000])
    with pytest.raises(Exception, match="fmi3SetFloat64"):
        instance.setFloat64([reference["motor.torque_constant_Nm_per_A"]], [0.05])


def test_a_simulation_returns_to_a_saved_state(fmu, drive):
    instance, reference = fmu
    _begin(instance)
    samples = drive.samples[:400]
    _stepped(instance, reference, samples[:200])
    state = instance.getFMUState()
    kept = instance.serializeFMUState(state)
    first = _stepped(instance, reference, samples[200:])
    instance.setFMUState(state)
    assert np.array_equal(_stepped(instance, reference, samples[200:]), first)
    instance.reset()
    _begin(instance)
    restored = instance.deserializeFMUState(kept)
    instance.setFMUState(restored)
    assert np.array_equal(_stepped(instance, reference, samples[200:]), first)
    for each in (state, restored):
        instance.freeFMUState(each)


def test_the_fmu_reports_what_it_does_not_support(fmu):
    instance, reference = fmu
    _begin(instance)
    with pytest.raises(Exception, match="fmi3DoStep"):
        instance.doStep(0.0, 0.005)
    with pytest.raises(Exception, match="fmi3SetFloat64"):
        instance.setFloat64([reference["clamp_force_N"]], [1.0])
    with pytest.raises(Exception, match="fmi3GetFloat64"):
        instance.getFloat64([reference["mode"]])
    with pytest.raises(Exception, match="fmi3GetFloat64"):
        instance.getFloat64([9999])


@needs_cc
def test_its_functions_are_those_that_fmi_declares(exported, fmpy, tmp_path):
    """The header of the standard, which fmpy has: declarations agree, and nothing is left out."""
    import re
    import zipfile

    headers = Path(fmpy.__file__).parent / "c-code"
    declared = set(re.findall(r"(?m)^FMI3_Export fmi3\w+TYPE +(fmi3\w+);", (headers / "fmi3Functions.h").read_text()))
    source = Path(signals.__file__).with_name("fmi.c")
    (tmp_path / "variables.h").write_text('#define EMB_TOKEN ""\nstatic const emb_sample start_sample = {.angle = 0};\n'
                                          "static const variable variables[] = {{TIME, INDEPENDENT, 0}};\n")  # fmt: skip
    command = ["cc", "-std=c11", "-fsyntax-only", "-Wall", "-Werror", f"-I{headers}", f"-I{tmp_path}", f"-I{exported}",
               "-include", "fmi3Functions.h", source]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(exported / "brake.fmu") as archive:
        [name] = [name for name in archive.namelist() if name.endswith("/emb_brake.so")]
        archive.extract(name, tmp_path)
    listed = subprocess.run(["nm", "-D", "--defined-only", tmp_path / name], capture_output=True, text=True, check=True)
    assert len(declared) > 70 and {line.split()[-1] for line in listed.stdout.splitlines()} == declared


def test_the_example_closes_a_loop_around_the_fmu(exported, fmpy):
    done = processkit.python(adaptkit.ROOT / "examples" / "fmu_control_loop.py", exported / "brake.fmu")
    assert done.returncode == 0, done.stderr
    own_N = float(done.stdout.rpartition("own force")[2].split()[0])
    assert abs(own_N - 8000.0) < 100.0


def test_without_a_library_the_message_names_the_command_that_makes_one(tmp_path, capsys):
    arguments = ["export", "--calibration", str(_CALIBRATION), "--output", str(tmp_path / "brake.fmu")]
    assert main([*arguments, "--kernels", str(tmp_path / "none.so")]) == 2
    expected = f"{tmp_path}/none.so: No such file or directory; emb-daemon compile --output {tmp_path}/none.so makes it\n"
    assert capsys.readouterr().err == expected
    assert main([*arguments[:-1], str(tmp_path / "brake.dll")]) == 2
    assert "expected one of .h, .fmu" in capsys.readouterr().err
