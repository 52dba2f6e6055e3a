"""The estimator as an FMU: FMI 3.0 co-simulation, over the library that is compiled ahead, with no Python inside.

Inputs and outputs are `signals`, parameters are the calibration's numbers by their keys (`places`). A step takes its inputs as
the sample at its beginning and returns the estimate from it at its end, as a brake controller receives it one cycle later.
"""

import hashlib
import io
import platform
import shutil
import subprocess
import tempfile
import zipfile
from math import isfinite, isnan
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from emb_daemon import __version__
from emb_daemon.ahead.library import Manifest, Refused, check
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError, Unavailable
from emb_daemon.estimator.records import ESTIMATE, SAMPLE
from emb_daemon.interface.header import header
from emb_daemon.interface.places import places
from emb_daemon.interface.signals import INPUTS, OUTPUTS, Signal, field_of
from emb_daemon.wire.contract import CYCLE_S

_NAME = "emb_brake"
_KINDS = {"f": ("FLOAT64", "Float64"), "i": ("INT64", "Int64"), "b": ("BOOLEAN", "Boolean")}
#: Units as powers of base units, and offsets to them.
_BASE_UNITS = {
    "N": {"kg": 1, "m": 1, "s": -2},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "m/s": {"m": 1, "s": -1},
    "A": {"A": 1},
    "degC": {"K": 1, "offset": 273.15},
    "s": {"s": 1},
}


class _Variable(NamedTuple):
    """One variable, at its value reference: a row of C's table, and an element of modelDescription.xml."""

    row: str
    element: str
    attributes: dict[str, str]


def _text(value) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "NaN" if isnan(value) else repr(value)


def _of_signal(signal: Signal, record: np.dtype, part: str, role: str) -> _Variable:
    kind, offset = field_of(record, signal.field)
    constant, element = _KINDS[kind.kind]
    attributes = {"name": signal.name, "description": signal.meaning, "causality": role, "variability": "discrete"}
    if role == "input":
        attributes["start"] = _text(signal.start)
    else:
        attributes["initial"] = "calculated"
    if signal.unit:
        attributes["unit"] = signal.unit
    return _Variable(f"{{{constant}, {role.upper()}, offsetof(model, {part}) + {offset}}}", element, attributes)


def _variables(calibration: Calibration) -> list[_Variable]:
    time = {"name": "time", "causality": "independent", "variability": "continuous", "unit": "s"}
    found = [_Variable("{FLOAT64, INDEPENDENT, offsetof(model, time)}", "Float64", time)]
    found += [_of_signal(signal, SAMPLE, "sample", "input") for signal in INPUTS]
    found += [_of_signal(signal, ESTIMATE, "estimate", "output") for signal in OUTPUTS]
    for place in places(calibration):
        attributes = {"name": place.key, "causality": "parameter", "variability": "fixed", "unit": place.unit}
        attributes |= {name: repr(bound) for name, bound in (("min", place.low), ("max", place.high)) if isfinite(bound)}
        row = f"{{FLOAT64, PARAMETER, offsetof(model, brake.parameters) + {place.offset}}}"
        found.append(_Variable(row, "Float64", attributes | {"start": repr(place.value)}))
    return found


def _table(variables: list[_Variable], token: str) -> str:
    starts = ", ".join(
        f".{signal.field} = {'NAN' if isnan(signal.start) else _text(signal.start)}" for signal in INPUTS if signal.start
    )
    rows = ",\n    ".join(variable.row for variable in variables)
    return (
        f'#define EMB_TOKEN "{token}"\n'
        f"static const emb_sample start_sample = {{{starts}}};\n"
        f"static const variable variables[] = {{\n    {rows},\n}};\n"
    )


def _description(variables: list[_Variable], token: str, about: str) -> bytes:
    root = ElementTree.Element(
        "fmiModelDescription",
        {
            "fmiVersion": "3.0",
            "modelName": "emb_daemon",
            "instantiationToken": token,
            "description": about,
            "version": __version__,
            "generationTool": f"emb_daemon {__version__}",
            "variableNamingConvention": "flat",
        },
    )
    ElementTree.SubElement(
        root,
        "CoSimulation",
        {
            "modelIdentifier": _NAME,
            "canHandleVariableCommunicationStepSize": "true",
            "fixedInternalStepSize": repr(CYCLE_S),
            "canGetAndSetFMUState": "true",
            "canSerializeFMUState": "true",
        },
    )
    units = ElementTree.SubElement(root, "UnitDefinitions")
    for name in sorted({variable.attributes["unit"] for variable in variables if "unit" in variable.attributes}):
        unit = ElementTree.SubElement(units, "Unit", name=name)
        if name in _BASE_UNITS:
            ElementTree.SubElement(unit, "BaseUnit", {key: str(value) for key, value in _BASE_UNITS[name].items()})
    categories = ElementTree.SubElement(root, "LogCategories")
    ElementTree.SubElement(categories, "Category", name="logStatusError", description="reason why a call failed")
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0", stepSize=repr(CYCLE_S))
    listed = ElementTree.SubElement(root, "ModelVariables")
    structure = ElementTree.SubElement(root, "ModelStructure")
    outputs = [str(k) for k, variable in enumerate(variables) if variable.attributes["causality"] == "output"]
    for reference, variable in enumerate(variables):
        attributes = {"name": variable.attributes["name"], "valueReference": str(reference)} | variable.attributes
        ElementTree.SubElement(listed, variable.element, attributes)
    for element in ("Output", "InitialUnknown"):
        for reference in outputs:
            ElementTree.SubElement(structure, element, valueReference=reference)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)


def _compile(folder: Path, kernels: Path) -> bytes:
    """The FMU's own library, which loads the kernels from its own folder. Raises Unavailable without a compiler."""
    if not shutil.which("cc"):
        raise Unavailable("no C compiler is installed: gcc is one")
    library = folder / f"{_NAME}.so"
    command = ["cc", "-std=c11", "-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-fvisibility=hidden",
               f"-I{folder}", Path(__file__).with_name("fmi.c"), "-o", library, f"-L{folder}", f"-l:{kernels.name}", "-lm",
               "-Wl,-rpath,$ORIGIN", "-Wl,-z,defs", "-Wl,-z,now"]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise Unavailable(f"cc cannot compile the FMU: {done.stderr.strip()}")
    return library.read_bytes()


def make_fmu(calibration: Calibration, kernels: Path) -> bytes:
    """The FMU's content, for machines like this one. ``kernels``: the library that ``emb-daemon compile`` has made. Raises
    InputError: the library must not be used here. Raises Unavailable: there is no C compiler."""
    try:
        manifest: Manifest = check(kernels)
    except (Refused, OSError) as refusal:
        why = getattr(refusal, "strerror", None) or refusal
        raise InputError(f"{kernels}: {why}; emb-daemon compile --output {kernels} makes it") from None
    variables, text = _variables(calibration), header(calibration)
    token = hashlib.sha256((text + _table(variables, "")).encode()).hexdigest()[:32]
    content = io.BytesIO()
    with tempfile.TemporaryDirectory() as name, zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as fmu:
        folder = Path(name)
        # Under a unique name, because a process loads only one of two libraries with the same name.
        library = folder / f"kernels-{manifest.sources}.so"
        library.write_bytes(kernels.read_bytes())
        (folder / "emb.h").write_text(text)
        (folder / "variables.h").write_text(_table(variables, token))
        about = f"Clamp force of {calibration.actuator}, calibration {calibration_hash(calibration)}, in one corner"
        where = f"binaries/{platform.machine()}-linux"
        for path, data in (
            ("modelDescription.xml", _description(variables, token, about)),
            (f"{where}/{_NAME}.so", _compile(folder, library)),
            (f"{where}/{library.name}", library.read_bytes()),
        ):
            # The same content gives the same file.
            fmu.writestr(zipfile.ZipInfo(path), data, zipfile.ZIP_DEFLATED)
    return content.getvalue()
