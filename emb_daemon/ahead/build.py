"""Compiles entry points through numba into one shared library that needs only libc and libm.

numba compiles each entry point behind a wrapper whose arguments are plain C. The results are linked into one module that
exports only those wrappers; functions that need Python or numba are then unused, and are removed. LLVM optimises the module
and emits code for the target, and an installed linker makes the library.
"""

import functools
import platform
import re
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path

import llvmlite
import llvmlite.binding as llvm
import numba
from numba import types

from emb_daemon import __version__
from emb_daemon.ahead.library import Target, mark, seal
from emb_daemon.ahead.parts import PartCompiler
from emb_daemon.ahead.signature import Array, Entry, is_group
from emb_daemon.atomic import write_atomically
from emb_daemon.errors import Unavailable

#: Reference counting of numba's arrays does nothing: kernels make no arrays, and do not own those that they are given.
_NO_OWNERS = "define void @NRT_incref(ptr %0) { ret void }\ndefine void @NRT_decref(ptr %0) { ret void }\n"
#: Names of functions that exist only in a process with Python and numba.
_HERE_ALONE = re.compile("_?Py|NRT_|_?numba")


def _numba_type(kind):
    number = {int: types.int64, float: types.float64, bool: types.int64}
    return number.get(kind) or types.CPointer(numba.from_dtype(kind))


def _wrapper(entry: Entry):
    """``entry`` behind plain C arguments, after a pointer to what it returns; and their types."""
    names, lines, kinds = ["results"], [], [types.CPointer(types.int64)]

    def unpack(kind) -> str:
        """The expression that makes an argument from plain C arguments."""
        name = f"a{len(names)}"
        if is_group(kind):
            return f"{type(kind).__name__}({', '.join([unpack(part) for part in kind])})"
        kinds.append(_numba_type(kind.dtype if isinstance(kind, Array) else kind))
        names.append(name)
        if isinstance(kind, Array):
            sizes = [f"{name}_{axis}" for axis in range(kind.dimensions)]
            names.extend(sizes)
            kinds.extend([types.int64] * len(sizes))
            return f"carray({name}, ({', '.join(sizes)},))"
        if kind is bool:
            return f"{name} != 0"
        return name if kind in (int, float) else f"carray({name}, (1,))[0]"

    call = f"function({', '.join([unpack(kind) for kind in entry.takes])})"
    if entry.returns > 1:
        call = f"{', '.join(f'results[{i}]' for i in range(entry.returns))} = {call}"
    elif entry.returns:
        call = f"results[0] = {call}"
    scope = {type(kind).__name__: type(kind) for kind in entry.takes if is_group(kind)}
    scope |= {"carray": numba.carray, "function": entry.function}
    exec("\n    ".join([f"def {entry.name}({', '.join(names)}):", *lines, call]), scope)
    return scope[entry.name], tuple(kinds)


@functools.cache
def _lower(entry: Entry) -> str:
    """LLVM assembly of an entry point with all that it calls, and of the wrapper that calls it with words in memory, under its
    name in C. It is the same for all targets."""
    wrapper, kinds = _wrapper(entry)
    options = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True, "no_cpython_wrapper": True}
    compiled = numba.njit(types.void(*kinds), pipeline_class=PartCompiler, **options)(wrapper)
    [overload] = compiled.overloads.values()
    kind_in_c = {types.int64: "i64", types.float64: "double"}
    loads, arguments = [], ["ptr %words"]
    for index, kind in enumerate(kinds[1:], entry.returns):
        word = kind_in_c.get(kind, "ptr")
        loads += [f"  %p{index} = getelementptr i64, ptr %words, i64 {index}", f"  %a{index} = load {word}, ptr %p{index}"]
        arguments.append(f"{word} %a{index}")
    # numba's functions return a status, and take pointers to a result and to an exception, which are not used here.
    return "\n".join(
        [
            str(overload.library._final_module),
            f"define i32 @{entry.name}(ptr %words) {{",
            "  %nothing = alloca ptr",
            *loads,
            f"  %status = call i32 @{overload.fndesc.llvm_func_name}(ptr %nothing, ptr %nothing, {', '.join(arguments)})",
            "  ret i32 %status",
            "}",
        ]
    )


def _merge(entries: list[Entry], sources: str, triple: str):
    """One module of all entry points, which exports nothing else but its `mark`."""
    marked = f"@{mark(sources)} = constant i8 0"
    whole = llvm.parse_assembly(f'target triple = "{triple}"\n{_NO_OWNERS}{marked}\n')
    for entry in entries:
        # numba compiles for this machine, but its code before optimisation is the same for all.
        text = re.sub(r'(?m)^target (datalayout|triple) = ".*"$', "", _lower(entry))
        whole.link_in(llvm.parse_assembly(f'target triple = "{triple}"\n{text}'))
    visible = {mark(sources), *(entry.name for entry in entries)}
    for symbol in (*whole.functions, *whole.global_variables):
        if not symbol.is_declaration and symbol.name not in visible:
            symbol.linkage = "internal"
    return whole


def emit_object(entries: list[Entry], sources: str, target: Target) -> bytes:
    """The entry points, and the `mark` of ``sources``, as a relocatable ELF object. Raises RuntimeError: an entry point needs
    an address of this process."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(target.triple).create_target_machine(cpu=target.cpu, opt=3, reloc="pic")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", numba.NumbaWarning)
        module = _merge(entries, sources, target.triple)
    module.data_layout = str(machine.target_data)
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    before, after = llvm.create_new_module_pass_manager(), llvm.create_new_module_pass_manager()
    for passes in (before, builder.getModulePassManager(), after):
        passes.add_global_dead_code_eliminate_pass()
        passes.run(module, builder)
    needed = [function.name for function in module.functions if function.is_declaration and _HERE_ALONE.match(function.name)]
    needed += re.findall(r"(?m)^@(\S+) = .*inttoptr \(i64", str(module))
    if needed:
        raise RuntimeError(f"kernels refer to addresses of this process: {', '.join(needed)}")
    return machine.emit_object(module)


def linker_for(machine: str) -> list[str]:
    """A command that links for ``machine``, the best one that is installed.

    A compiler finds libm; symbols that a bare linker leaves undefined are resolved when the library is loaded. Raises
    Unavailable: none is; the message names packages that have one."""
    own = machine == platform.machine()
    prefix = "" if own else f"{machine}-linux-gnu-"
    for command in (
        [f"{prefix}{'cc' if own else 'gcc'}", "-shared", "-nostartfiles", "-Wl,-z,noexecstack,-z,now", "-lm"],
        [f"{prefix}ld", "-shared", "-z", "noexecstack"],
        ["ld.lld", "-shared", "-z", "noexecstack"],
    ):
        if shutil.which(command[0]):
            return command
    packages = "gcc or binutils" if own else f"gcc-{machine.replace('_', '-')}-linux-gnu or lld"
    raise Unavailable(f"no linker for {machine} is installed: {packages} has one")


def _link(elf: bytes, command: list[str]) -> bytes:
    """The shared object of a relocatable one. Raises Unavailable with the linker's message if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder, "kernels.o"), Path(folder, "kernels.so")
        source.write_bytes(elf)
        # The object before the libraries that it needs.
        done = subprocess.run([command[0], source, *command[1:], "-o", library], capture_output=True, text=True)
        if done.returncode:
            raise Unavailable(f"{command[0]} cannot link the kernels: {done.stderr.strip()}")
        return library.read_bytes()


def build(entries: list[Entry], sources: str, target: Target, path: Path, layouts: dict[str, bytes]) -> None:
    """Write the library of ``entries`` that were imported from ``sources`` (`library.source_digest`), with ``layouts`` as in
    `library.Manifest`.

    With the ending ``.o`` it is a plain object, to be linked into a program. Raises Unavailable: no linker for the target is
    installed. Raises OSError: the file cannot be written."""
    linker = None if path.suffix == ".o" else linker_for(target.machine)
    path.parent.mkdir(parents=True, exist_ok=True)
    elf = emit_object(entries, sources, target)
    if linker is None:
        return write_atomically(path, elf)
    content = seal(
        _link(elf, linker),
        layouts,
        sources=sources,
        machine=target.machine,
        cpu=target.cpu,
        flags=target.flags,
        made_by=f"emb_daemon {__version__}, numba {numba.__version__}, llvmlite {llvmlite.__version__}",
    )
    write_atomically(path, content)
