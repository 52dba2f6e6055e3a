"""Functions as LLVM's bitcode, which becomes a part of kernels or of a library."""

from collections.abc import Callable

from llvmlite.binding import parse_bitcode
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class Part(JITCodeLibrary):
    """The bitcode of a function that only kernels call; it is optimised and translated together with them.

    numba's own libraries would optimise and translate each function on its own as well, with all that it calls, once for each
    level of calls."""

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        return self.serialize_using_bitcode()

    @property
    def codegen(self) -> "Part":
        """Where numba registers Python's constants for machine code (`set_env`); there is none here."""
        return self

    def set_env(self, name: str, environment: object) -> None:
        pass

    @classmethod
    def of_bitcode(cls, codegen: object, name: str, bitcode: bytes) -> "Part":
        """The part that `serialize_using_bitcode` wrote."""
        part = cls(codegen, name)
        part._final_module = parse_bitcode(bitcode)
        part._finalize_final_module()
        return part

    def _optimize_final_module(self):
        pass

    def _finalize_final_module(self):
        self._finalize_dynamic_globals()
        self._finalized = True


class PartCompiler(Compiler):
    """numba's compiler, except that the result is neither optimised nor translated."""

    def compile_extra(self, func: Callable) -> object:
        self.state.library = Part(self.state.targetctx.codegen(), func.__qualname__)
        return super().compile_extra(func)
