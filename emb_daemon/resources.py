"""Files that ship with the package: DBC, example configuration, systemd units."""

from collections.abc import Sequence
from pathlib import Path

_PACKAGE = Path(__file__).parent


def resource(name: str) -> Path:
    """Path of a shipped file such as ``dbc/emb.dbc``.

    In a wheel they are inside the package, in a checkout next to it. Raises FileNotFoundError: the installation is
    incomplete."""
    for root in (_PACKAGE / "_resources", _PACKAGE.parent):
        path = root / name
        if path.exists():
            return path
    raise FileNotFoundError(f"{name}: not part of this installation; reinstall emb_daemon")


def shipped_configuration(folder: Path, corners: Sequence[str], *settings: str) -> Path:
    """A configuration in ``folder`` that gives all ``corners`` the shipped calibration; ``settings`` are further lines."""
    calibration, path = str(resource("config/calibration.yaml")), folder / "emb.yaml"
    lines = [f"  {corner}: {{calibration: {calibration!r}}}" for corner in corners]
    path.write_text("\n".join(["format: 1", *settings, "corners:", *lines, ""]), encoding="utf-8")
    return path
