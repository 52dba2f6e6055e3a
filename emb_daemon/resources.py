"""Files that ship with the package: DBC, example configuration, systemd units."""

from pathlib import Path

_PACKAGE = Path(__file__).parent


def resource(name: str) -> Path:
    """Path of a shipped file such as ``dbc/emb.dbc``.

    A wheel carries them inside the package, a checkout beside it.

    Raises:
        FileNotFoundError: the installation is incomplete.
    """
    for root in (_PACKAGE / "_resources", _PACKAGE.parent):
        path = root / name
        if path.exists():
            return path
    raise FileNotFoundError(f"{name}: not part of this installation; reinstall emb_daemon")
