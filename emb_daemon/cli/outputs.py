"""Checks of an output before the work."""

import os
from collections.abc import Iterable
from pathlib import Path

from emb_daemon.errors import InputError


def check_output(path: Path, inputs: Iterable[Path | None], endings: tuple[str, ...] = ()) -> None:
    """Refuse a path that cannot be written, that is not a regular file, or that is an input.

    Raises:
        InputError: with the path and what was expected.
    """
    from emb_daemon.logs.write import ending_of

    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: no such folder: {path.absolute().parent}")
    if not os.access(path.absolute().parent, os.W_OK):
        raise InputError(f"{path}: the folder cannot be written: {path.absolute().parent}")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is not a regular file, and writing would replace it")
    if path.resolve() in [given.resolve() for given in inputs if given]:
        raise InputError(f"{path}: is one of the inputs, and writing would overwrite it")
    if endings and ending_of(path) not in endings:
        raise InputError(f"{path}: unknown ending, expected one of {', '.join(endings)}")
