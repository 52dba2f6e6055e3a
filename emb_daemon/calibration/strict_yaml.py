"""YAML read strictly into msgspec structs.

PyYAML alone takes `1e-3` for a string, `on` for true, `010` for eight, keeps the last of two equal keys and accepts `.nan`.
Here a scalar is read by YAML 1.2's core schema, a duplicate key or a number that is not finite is a fault, and all faults of a
file are reported together, with their lines.
"""

import difflib
import math
import re
import types
import typing
from pathlib import Path
from typing import Any

import msgspec
import yaml

from emb_daemon.bounded import read_input
from emb_daemon.errors import InputErrors

_T = typing.TypeVar("_T")
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)\Z")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?\Z")
_CONSTANTS = {"true": True, "false": False, "null": None, "~": None, "": None}
#: Limits beyond any valid file: bytes of a file, characters of a number, and levels of nesting, because composer and reader
#: are recursive.
_MOST_BYTES, _LONGEST_NUMBER, _DEEPEST = 4_000_000, 40, 50
_NOT_FINITE = {".nan", ".inf", "-.inf", "+.inf", "nan", "inf", "-inf"}


def is_not_plain_text(text: str) -> bool:
    """Whether ``text`` without quotes would be read as something other than text."""
    return text in _CONSTANTS or text.lower() in _NOT_FINITE or bool(_INTEGER.match(text) or _FLOAT.match(text))


class _Reader:
    def __init__(self, name: str):
        self.name = name
        self.faults: list[str] = []

    def fault(self, node: yaml.Node, path: str, text: str) -> None:
        self.faults.append(f"{self.name}:{node.start_mark.line + 1}: {path + ': ' if path else ''}{text}")

    def scalar(self, node: yaml.ScalarNode, path: str) -> Any:
        text = node.value
        if node.style in ("'", '"', "|", ">"):
            return text
        if text.lower() in _NOT_FINITE:
            self.fault(node, path, f"{text} is not a finite number")
            return None
        if text in _CONSTANTS:
            return _CONSTANTS[text]
        if len(text) > _LONGEST_NUMBER and (_INTEGER.match(text) or _FLOAT.match(text)):
            self.fault(node, path, f"a number of {len(text)} characters; expected at most {_LONGEST_NUMBER}")
            return None
        if _INTEGER.match(text):
            return int(text)
        if _FLOAT.match(text):
            value = float(text)
            if math.isfinite(value) and not (text.lstrip("+-").startswith("0") and text.lstrip("+-0").isdigit()):
                return value
            self.fault(node, path, f"{text}: expected a finite decimal number without leading zeros")
            return None
        return text

    def plain(self, node: yaml.Node, path: str) -> Any:
        """Plain Python data, checked for duplicate keys on the way."""
        if isinstance(node, yaml.ScalarNode):
            return self.scalar(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self.plain(item, f"{path}[{index}]") for index, item in enumerate(node.value)]
        return {key: self.plain(value, _join(path, key)) for key, value in self.entries(node, path).items()}

    def entries(self, node: yaml.MappingNode, path: str) -> dict[str, yaml.Node]:
        entries: dict[str, yaml.Node] = {}
        for key, value in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else "?"
            if name in entries:
                self.fault(key, _join(path, name), "occurs twice")
            entries[name] = value
        return entries

    def convert(self, node: yaml.Node, kind: Any, path: str) -> Any:
        """``node`` as ``kind``; None after a fault, which is then recorded.

        A struct's ``__post_init__`` may find several faults: one line each of its ValueError, ``key: what was expected``."""
        optional, kind = _strip_optional(kind)
        if optional and isinstance(node, yaml.ScalarNode) and node.value in ("null", "~", ""):
            return None
        if _is_struct(kind):
            return self.struct(node, kind, path)
        container, least = _strip_length(kind)
        origin, arguments = typing.get_origin(container), typing.get_args(container)
        if origin is tuple and arguments[-1] is Ellipsis and _is_struct(arguments[0]):
            if not isinstance(node, yaml.SequenceNode) or len(node.value) < least:
                return self.fault(node, path, f"expected a list of at least {least}" if least else "expected a list")
            return tuple(self.convert(item, arguments[0], f"{path}[{index}]") for index, item in enumerate(node.value))
        if origin is dict:
            if not isinstance(node, yaml.MappingNode) or len(node.value) < least:
                return self.fault(node, path, f"expected at least {least} key" if least else "expected keys and values")
            entries = self.entries(node, path)
            for key, value in entries.items():
                try:
                    msgspec.convert(key, arguments[0])
                except msgspec.ValidationError as error:
                    self.fault(value, _join(path, key), str(error))
            return {key: self.convert(value, arguments[1], _join(path, key)) for key, value in entries.items()}
        before = len(self.faults)
        value = self.plain(node, path)
        if len(self.faults) > before:
            return None
        try:
            return msgspec.convert(value, kind)
        except msgspec.ValidationError as error:
            text, _, where = str(error).partition(" - at `$")
            self.fault(node, path + where.rstrip("`"), text)

    def struct(self, node: yaml.Node, kind: type[msgspec.Struct], path: str) -> Any:
        if not isinstance(node, yaml.MappingNode):
            return self.fault(node, path, f"expected keys, such as {', '.join(kind.__struct_fields__[:3])}")
        before = len(self.faults)
        fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
        values = {}
        entries = self.entries(node, path)
        for name, child in entries.items():
            if name not in fields:
                near = difflib.get_close_matches(name, fields, 1, 0.5)
                hint = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(fields)}"
                self.fault(child, _join(path, name), f"unknown key; {hint}")
                continue
            values[fields[name].name] = self.convert(child, fields[name].type, _join(path, name))
        for name, field in fields.items():
            if field.required and name not in entries:
                self.fault(node, _join(path, name), "missing")
        if len(self.faults) > before:
            return None
        try:
            return kind(**values)
        except ValueError as error:
            for line in str(error).splitlines():
                key, colon, text = line.partition(": ")
                if not colon or " " in key:
                    self.fault(node, path, line)
                else:
                    self.fault(_child(node, key), _join(path, key), text)


def _child(node: yaml.Node, key: str) -> yaml.Node:
    """The node at a dotted key below ``node``, or the nearest above it."""
    for name in key.split("."):
        if not isinstance(node, yaml.MappingNode):
            break
        node = next((value for entry, value in node.value if entry.value == name), node)
    return node


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _strip_optional(kind: Any) -> tuple[bool, Any]:
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        rest = [argument for argument in typing.get_args(kind) if argument is not type(None)]
        if len(rest) == 1:
            return True, rest[0]
    return False, kind


def _strip_length(kind: Any) -> tuple[Any, int]:
    """A container's type without the annotation of its length, and its least length."""
    if typing.get_origin(kind) is not typing.Annotated:
        return kind, 0
    container, *metas = typing.get_args(kind)
    return container, max((meta.min_length or 0 for meta in metas if isinstance(meta, msgspec.Meta)), default=0)


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)


def _compose(name: str, text: str) -> yaml.Node:
    """The file's tree. Content with which libyaml would not end, or overflow its stack, is refused first."""
    depth = 0
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        for event in yaml.parse(text, Loader=loader):
            line = event.start_mark.line + 1
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                raise InputErrors([f"{name}:{line}: anchors and aliases (& and *) are not used here"])
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEEPEST:
                raise InputErrors([f"{name}:{line}: nested more than {_DEEPEST} levels deep"])
        root = yaml.compose(text, Loader=loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        raise InputErrors([f"{name}:{mark.line + 1 if mark else 1}: not YAML: {error.problem}"]) from None
    except yaml.YAMLError as error:
        raise InputErrors([f"{name}: not YAML: {str(error).splitlines()[0]}"]) from None
    if root is None:
        raise InputErrors([f"{name}: empty"])
    return root


def load_yaml(path: Path, kind: type[_T]) -> _T:
    """Read a YAML file into a struct type. Raises InputErrors: every fault found, each as ``file:line: key: what was
    expected``."""
    try:
        text = read_input(path, _MOST_BYTES).decode()
    except UnicodeDecodeError as error:
        raise InputErrors([f"{path}: not a readable text file ({error})"]) from None
    reader = _Reader(str(path))
    value = reader.convert(_compose(str(path), text), kind, "")
    if reader.faults:
        raise InputErrors(reader.faults)
    return value
