"""The estimator's step in C, compiled here and now by the system's compiler: a yardstick for the compiled step.

The C source keeps the order of every operation, so its results equal the step's to the last bit; it is compiled with -O2 and
neither -ffast-math nor contraction. It works on the same records: their C declarations are written from the numpy dtypes, and
the compiler checks every offset.
"""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from emb_daemon.estimator import records
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE, STATE, new_state
from emb_daemon.wire import contract

_SOURCE = Path(__file__).parent / "step.c"
_FLAGS = ("-O2", "-std=c11", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared")
_TYPES = {"f8": "double", "i8": "int64_t", "b1": "bool"}


def compiler() -> str | None:
    """Path of the system's C compiler, if there is one."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def declarations() -> str:
    """C declarations of the estimator's records, and the numbers that `records` and the wire contract name."""
    named = vars(contract) | vars(records)
    numbers = {name: value for name, value in named.items() if name.isupper() and type(value) is int}
    lines = ["enum {", *(f"    {name} = {value}," for name, value in numbers.items()), "};"]
    for name, record in (("parameters", PARAMETERS), ("state", STATE), ("sample", SAMPLE), ("estimate", ESTIMATE)):
        checks: list[str] = []
        lines += [*_declare(name, record, checks), *checks]
    return "\n".join(lines) + "\n"


def _declare(tag: str, record: np.dtype, checks: list[str]) -> list[str]:
    """Lines that declare ``record`` as ``struct tag``, after those of the records within; assertions go to ``checks``."""
    inner, members = [], []
    for name, (field, offset, *_) in record.fields.items():
        dimensions = "".join(f"[{length}]" for length in field.shape)
        if field.names:
            inner += _declare(f"{tag}_{name}", field, checks)
            members.append(f"    struct {tag}_{name} {name};")
        else:
            members.append(f"    {_TYPES[field.base.str[1:]]} {name}{dimensions};")
        checks.append(f'_Static_assert(offsetof(struct {tag}, {name}) == {offset}, "{tag}.{name}");')
    checks.append(f'_Static_assert(sizeof(struct {tag}) == {record.itemsize}, "{tag}");')
    return [*inner, f"struct {tag} {{", *members, "};"]


class Twin:
    """The C step.

    Raises:
        FileNotFoundError: no compiler.
        subprocess.CalledProcessError: it does not compile; what the compiler said is in ``stderr``.
    """

    def __init__(self):
        cc = compiler()
        if cc is None:
            raise FileNotFoundError("no C compiler (cc, gcc or clang)")
        with tempfile.TemporaryDirectory() as folder:
            library = Path(folder) / "step.so"
            (Path(folder) / "records.h").write_text(declarations())
            command = [cc, *_FLAGS, "-I", folder, "-o", str(library), str(_SOURCE), "-lm"]
            subprocess.run(command, check=True, capture_output=True, text=True)
            self._answer = ctypes.CDLL(str(library)).answer
        self._answer.restype = None
        self.version = subprocess.run([cc, "--version"], capture_output=True, text=True).stdout.partition("\n")[0]

    def estimate(self, samples: np.ndarray, parameters: np.ndarray, state: np.ndarray | None = None) -> np.ndarray:
        """As `offline.estimate`: SAMPLE rows to ESTIMATE rows with PARAMETERS of shape (1,)."""
        estimates = np.zeros(len(samples), ESTIMATE)
        state = new_state() if state is None else state
        samples, parameters = np.ascontiguousarray(samples), np.ascontiguousarray(parameters)
        arrays = [ctypes.c_void_p(array.ctypes.data) for array in (samples, state, parameters, estimates)]
        self._answer(arrays[0], ctypes.c_int64(len(samples)), *arrays[1:])
        return estimates
