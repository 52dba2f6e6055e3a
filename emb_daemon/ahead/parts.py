"""Code in LLVM's form that becomes a part of other code: of kernels, or of a library."""

from collections.abc import Callable

from llvmlite.binding import parse_bitcode
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class Part(JITCodeLibrary):
    """Code that only becomes a part of kernels, with which it is optimised and translated.

    numba's own libraries would do both before as well: of each function with all that it calls, once for each level of calls.
    """

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        return self.serialize_using_bitcode()

    @property
    def codegen(self) -> "Part":
        """Where numba would file constants of Python's for the machine code, which there is not."""
        return self

    def set_env(self, name: str, environment: object) -> None:
        pass

    @classmethod
    def of_bitcode(cls, codegen: object, name: str, bitcode: bytes) -> "Part":
        """What `serialize_using_bitcode` gave."""
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
    """numba's, into what is neither optimised nor translated."""

    def compile_extra(self, func: Callable) -> object:
        self.state.library = Part(self.state.targetctx.codegen(), func.__qualname__)
        return super().compile_extra(func)
