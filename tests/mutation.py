"""Mutation testing: does a test fail when one operator, comparison or constant of the box is changed?

Run as ``python tests/mutation.py [COUNT] [SEED] [PART]``. COUNT mutants (60), of modules whose path contains PART (all), are
drawn from wire, estimator, models, adaptation, runtime and the evidence of discovery, and judged in the order drawn, so that
a run that is ended early has judged a fair sample. Each is built into a copy of the package, which runs as plain Python:
compiling a mutant takes longer than interpreting its tests. Every test runs once without a mutant first, which tells how long
it takes and which functions it calls; a mutant is tried with those that call its function, quick ones first, until one fails.
Each is printed with its line, and the test that failed or the number of tests that passed.
"""

import ast
import contextlib
import importlib
import itertools
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
_SCOPE = (
    "wire/*", "models/*", "estimator/*", "adapt/*", "runtime/*", "pipeline", "atomic", "bounded", "diagnose/episodes",
    "diagnose/evidence",
)  # fmt: skip
#: Files whose tests are not all drives, which take minutes as plain Python.
_TESTS = (
    "adaptation", "alignment", "atomic", "bus", "common", "consistency", "contact", "daemon", "diagnose_evidence",
    "faults_loop", "filter", "force_sensor", "friction", "fuse", "gear", "heat", "hostile", "hypotheses", "kernels",
    "lateness", "monitor_bounds", "pages", "parameters", "pipeline", "plausibility_kernels", "reload", "resolver", "rewind",
    "secoc", "snapshots", "stale_angle", "start", "status", "step", "stiffness", "training_fit", "training_rules", "uneven",
    "unknown", "wander", "wheel", "wire", "xcp",
)  # fmt: skip
#: Libraries that take longest to import, imported once before processes are forked.
_LIBRARIES = (
    "can", "cantools", "cryptography.hazmat.primitives.ciphers", "hypothesis", "msgspec", "numba", "rich", "scipy.optimize",
    "yaml",
)  # fmt: skip
#: A test that takes longer as plain Python is left out, and all tests of one mutant take no longer, s of the processor.
_TEST_S, _MUTANT_S = 0.75, 20.0
_SWAPPED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.BitXor: ast.BitOr, ast.BitAnd: ast.BitOr, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
    ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


def _sites(tree: ast.Module) -> list[tuple[ast.AST, int, int]]:
    """Nodes inside functions that can be changed, with the index of the comparison and the first line of the innermost
    function. Decorators are left out: their signatures matter only where kernels are compiled ahead."""
    sites = {}
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
        first = min(part.lineno for part in (function, *function.decorator_list))
        for node in (part for statement in function.body for part in ast.walk(statement)):
            if isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(node.op) in _SWAPPED:
                sites[node, -1] = first
            elif isinstance(node, ast.Compare):
                sites |= {(node, index): first for index, op in enumerate(node.ops) if type(op) in _SWAPPED}
            elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
                sites[node, -1] = first
    return [(node, index, first) for (node, index), first in sites.items()]


def _change(node: ast.AST, index: int) -> None:
    if isinstance(node, ast.Compare):
        node.ops[index] = _SWAPPED[type(node.ops[index])]()
    elif isinstance(node, ast.Constant):
        node.value += 1
    else:
        node.op = _SWAPPED[type(node.op)]()


class _Learned:
    """Of each test that passes in time: how long it takes, and the functions of the package that it calls (file, line)."""

    def __init__(self, package: Path):
        self.result: dict[str, tuple[float, list[tuple[str, int]]]] = {}
        self._package, self._called, self._failed, self._slow = f"{package}/", set(), set(), set()

    def _trace(self, frame, _event, _argument):
        code = frame.f_code
        if code.co_filename.startswith(self._package):
            self._called.add((code.co_filename[len(self._package) :], code.co_firstlineno))

    def pytest_runtest_setup(self, item):
        if item.nodeid.partition("[")[0] in self._slow:
            pytest.skip("takes too long with other parameters")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        def too_long(*_):
            self._slow.add(item.nodeid.partition("[")[0])
            pytest.skip("takes too long")

        self._called, begun = set(), time.process_time()
        signal.signal(signal.SIGPROF, too_long)
        signal.setitimer(signal.ITIMER_PROF, _TEST_S)
        threading.settrace(self._trace)
        sys.settrace(self._trace)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            if item.nodeid not in self._failed:
                self.result[item.nodeid] = time.process_time() - begun, list(self._called)

    def pytest_runtest_logreport(self, report):
        if not report.passed:
            self._failed.add(report.nodeid)


class _Chosen:
    """Runs tests in a given order, and tells which failed."""

    def __init__(self, names: Iterable[str]):
        self.result: list[str] = []
        self._place = {name: place for place, name in enumerate(names)}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items):
        items[:] = sorted((item for item in items if item.nodeid in self._place), key=lambda item: self._place[item.nodeid])

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.result.append(report.nodeid)


def _run(copy: Path, files: Iterable[str], plugin: _Learned | _Chosen, *options: str, limit_s: int = 0):
    """The plugin's result after pytest has run ``files`` of the copy in a process of its own, which ends with all that it
    started; None if it ended otherwise, or nothing could be run."""
    found = copy.parent / "found"
    found.unlink(missing_ok=True)
    if (child := os.fork()) == 0:
        os.setsid()
        signal.alarm(limit_s)
        # What a mutant fills must not be the machine's memory.
        resource.setrlimit(resource.RLIMIT_DATA, (4 << 30, 4 << 30))
        os.chdir(copy)
        sys.path[:0] = [str(copy), str(copy / "tests")]
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        try:
            if pytest.main(["-q", "-p", "no:cacheprovider", "-m", "not trial", *options, *files], [plugin]) <= 1:
                found.write_text(json.dumps(plugin.result))
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    return json.loads(found.read_text()) if found.exists() else None


def _failing(copy: Path, tests: Iterable[tuple[float, str]], most_s: float, *options: str) -> list[str] | None:
    """Which of these (time, name) fail, without those beyond ``most_s``. Files whose tests are quick on average come first,
    each as a whole: others would make the fixtures of a file anew."""
    of_file: dict[str, list[tuple[float, str]]] = {}
    for seconds, name in sorted(tests):
        of_file.setdefault(name.partition("::")[0], []).append((seconds, name))
    chosen, total_s = [], 0.0
    for seconds, name in itertools.chain(*sorted(of_file.values(), key=lambda each: sum(s for s, _ in each) / len(each))):
        total_s += seconds
        if total_s <= most_s:
            chosen.append(name)
    files = dict.fromkeys(name.partition("::")[0] for name in chosen)
    return _run(copy, files, _Chosen(chosen), *options, limit_s=round(60.0 + 5.0 * min(total_s, most_s)))


def _learn(copy: Path) -> dict[str, tuple[float, list[tuple[str, int]]]]:
    """Every test that passes without a mutant, alone and among the others."""
    learned = _run(copy, [f"tests/test_{name}.py" for name in _TESTS], _Learned(copy / "emb_daemon"))
    sys.dont_write_bytecode = True
    for name in _failing(copy, [(seconds, name) for name, (seconds, _) in learned.items()], 1e9):
        learned.pop(name, None)
    return learned


def main() -> None:
    words = (*sys.argv[1:], *("60", "0", "")[len(sys.argv) - 1 :])
    count, seed, part = int(words[0]), int(words[1]), words[2]
    os.environ["NUMBA_DISABLE_JIT"] = "1"
    os.environ.setdefault("EMB_SHARED", str(ROOT.parent / "shared"))
    for library in _LIBRARIES:
        importlib.import_module(library)
    killed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".*", "__pycache__", "build", "dist"))
        os.environ["PYTHONPATH"], package = str(copy), copy / "emb_daemon"
        modules = sorted(path for pattern in _SCOPE for path in package.glob(f"{pattern}.py") if part in str(path))
        mutants = [(path, place) for path in modules for place in range(len(_sites(ast.parse(path.read_text()))))]
        drawn = random.Random(seed).sample(mutants, min(count, len(mutants)))
        learned = _learn(copy)
        print(f"{len(learned)} tests pass within {_TEST_S:g} s each as plain Python", flush=True)
        every = [(seconds, name) for name, (seconds, _) in learned.items()]
        for number, (path, place) in enumerate(drawn, 1):
            source, times, name = path.read_text(), path.stat(), str(path.relative_to(package))
            tree = ast.parse(source)
            node, index, first = _sites(tree)[place]
            _change(node, index)
            path.write_text(ast.unparse(tree))
            # What runs only while a module is imported matters to any test.
            tests = [(seconds, test) for seconds, test in every if [name, first] in learned[test][1]] or every
            failed = _failing(copy, tests, _MUTANT_S, "-x")
            killed += failed != []
            line = source.splitlines()[node.lineno - 1].strip()
            verdict = f"survived {len(tests)} tests" if failed == [] else f"killed by {failed[0] if failed else 'its end'}"
            print(f"{verdict}: {name}:{node.lineno}: {line}: {ast.unparse(node)}", flush=True)
            path.write_text(source)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
            if number % 20 == 0 or number == len(drawn):
                print(f"{killed} of {number} mutants killed, of {len(mutants)} drawn with seed {seed}", flush=True)


if __name__ == "__main__":
    main()
