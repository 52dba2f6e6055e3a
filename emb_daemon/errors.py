"""Errors that a user sees on standard error: one line that says where and what was expected."""

import sys


class InputError(Exception):
    """Unusable input (file, key, frame or argument). The command line prints it and ends with exit status 2."""

    @property
    def faults(self) -> list[str]:
        """The faults, one line each."""
        return str(self).splitlines()


class InputErrors(InputError):
    """Several faults found in one pass over the same input, one per line."""

    def __init__(self, faults: list[str]):
        super().__init__("\n".join(faults))


class InvalidValue(InputError, ValueError):
    """Values that contradict each other, found when an object is made of them. For a file it becomes a fault with a line."""


class Unavailable(Exception):
    """Something outside of the program, such as a CAN interface, is missing now and may be there later. The command line
    prints it and ends with exit status 1, after which a service manager tries again."""


def tell(text: str) -> None:
    """Print a line for a person to standard error."""
    print(text, file=sys.stderr)
