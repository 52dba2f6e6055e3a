"""Two wings: the box, which runs in the car, and the bench, which identifies, judges and reports; `cli` alone knows both."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import processkit

import emb_daemon

_PACKAGE = Path(emb_daemon.__file__).parent
#: The box, from the ground up: each may know those before it.
_BOX = (
    "errors", "resources", "atomic", "bounded", "ahead", "numba_cache", "jit", "wire", "models", "effects", "estimator",
    "calibration", "adapt", "pipeline", "interface", "runtime", "monitor", "workshop",
)  # fmt: skip
#: What stands above both wings.
_ABOVE = ("cli", "api", "__init__")
#: Libraries of the extra `offline`.
_OFFLINE = {"scipy", "pyarrow", "matplotlib", "plotly"}


@cache
def _imports() -> dict[tuple[str, str], set[str]]:
    """Parts of the package that import others, at the top of a module or within a function, and the files that do."""
    found = defaultdict(set)
    for file in _PACKAGE.rglob("*.py"):
        part = file.relative_to(_PACKAGE).parts[0].removesuffix(".py")
        for node in ast.walk(ast.parse(file.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module == "emb_daemon":
                names = [f"emb_daemon.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
                assert node.level == 0, f"{file}: imports are absolute here"
            for name in names:
                package, _, rest = name.partition(".")
                to = rest.partition(".")[0]
                if package == "emb_daemon" and to not in (part, "__version__", ""):
                    found[part, to].add(str(file.relative_to(_PACKAGE)))
                if package in _OFFLINE | {"tests", "studies"}:
                    found[part, package].add(str(file.relative_to(_PACKAGE)))
    return found


def test_the_box_imports_nothing_of_the_bench_and_packages_import_downwards():
    for (part, to), files in _imports().items():
        if part in _BOX:
            assert to in _BOX[: _BOX.index(part)], f"{', '.join(sorted(files))}: {part} may not know {to}"


def test_nothing_imports_cli_and_the_package_imports_no_tests_or_studies():
    for (part, to), files in _imports().items():
        assert to not in {*_ABOVE, "tests", "studies"} or part in _ABOVE, f"{', '.join(sorted(files))}: {part} knows {to}"


def test_no_circle():
    """Parts that know no other, or that no other knows, are taken away one after the other; a circle stays."""
    edges = set(_imports())
    while open_ends := {name for edge in edges for name in edge} - ({a for a, _ in edges} & {b for _, b in edges}):
        edges = {(part, to) for part, to in edges if not {part, to} & open_ends}
    assert not edges, f"in a circle: {', '.join(sorted({name for edge in edges for name in edge}))}"


def test_what_the_box_loads():
    """In a process of its own: neither the bench nor its libraries come along."""
    modules = (
        "cli.run", "runtime.daemon", "runtime.bus", "cli.check", "calibration.configuration", "cli.adaptation", "adapt.memory",
        "cli.monitor", "monitor.listener", "monitor.terminal",
    )  # fmt: skip
    names = ", ".join(f"emb_daemon.{name}" for name in modules)
    # python-can imports asammdf where it finds it, and with it half of the others; the daemon forbids it likewise.
    code = f"import sys; sys.modules['asammdf'] = None; import {names}; print(*sys.modules)"
    done = processkit.python("-c", code)
    assert done.returncode == 0, done.stderr
    loaded = set(done.stdout.split())
    parts = {name.split(".")[1] for name in loaded if name.startswith("emb_daemon.")}
    assert parts <= {*_BOX, "cli"}
    # numba loads SciPy by itself where it finds it.
    assert not (_OFFLINE - {"scipy"}) & loaded
