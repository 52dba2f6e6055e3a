"""Calibration files: load, hash, date, write."""

import datetime
import hashlib
import os
import time
from pathlib import Path

import msgspec
import yaml

from emb_daemon.atomic import write_atomically
from emb_daemon.calibration.strict_yaml import is_not_plain_text, load_yaml
from emb_daemon.calibration.types import Calibration
from emb_daemon.resources import resource


def load_calibration(path: Path) -> Calibration:
    """Read a calibration. Raises InputErrors: every fault with file, line and key."""
    return load_yaml(Path(path), Calibration)


def shipped_calibration() -> Calibration:
    """The calibration that ships with the package: that of a simulated rig, for first experiments."""
    return load_calibration(resource("config/calibration.yaml"))


def calibration_hash(calibration: Calibration) -> str:
    """Twelve hexadecimal digits over the values, independent of formatting and provenance."""
    values = msgspec.to_builtins(msgspec.structs.replace(calibration, provenance=None))
    return hashlib.sha256(msgspec.json.encode(values, order="sorted")).hexdigest()[:12]


def date_of_today() -> str:
    """Date that a result states, ISO 8601, in universal time. ``SOURCE_DATE_EPOCH`` (s since 1970) overrides the clock, so
    that the same inputs can give the same file."""
    seconds = int(os.environ.get("SOURCE_DATE_EPOCH") or time.time())
    return datetime.datetime.fromtimestamp(seconds, datetime.UTC).date().isoformat()


def dump_calibration(calibration: Calibration) -> str:
    return yaml.dump(msgspec.to_builtins(calibration), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=120)


def save_calibration(calibration: Calibration, path: Path) -> None:
    write_atomically(Path(path), dump_calibration(calibration).encode())


class _Dumper(yaml.SafeDumper):
    """Writes numbers so that `strict_yaml` and every YAML 1.1 reader read them as numbers; lists of numbers on one line."""


def _float(dumper: yaml.Dumper, value: float) -> yaml.Node:
    text = repr(value)
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


def _text(dumper: yaml.Dumper, value: str) -> yaml.Node:
    quoted = is_not_plain_text(value)
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style="'" if quoted else None)


def _sequence(dumper: yaml.Dumper, value) -> yaml.Node:
    numbers = all(isinstance(item, int | float) for item in value)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=numbers)


_Dumper.add_representer(float, _float)
_Dumper.add_representer(str, _text)
_Dumper.add_representer(list, _sequence)
_Dumper.add_representer(tuple, _sequence)
