"""Writes the reference pages that restate code: calibration.md, configuration.md, mapping.md, campaign.md, catalogue.md, and
safety.md's table of facts.

python docs/generate.py            writes them
python docs/generate.py --check    exit status 1 if one is not current
"""

import ast
import inspect
import sys
import typing
from pathlib import Path

import msgspec

from emb_daemon.calibration import configuration, types
from emb_daemon.effects import REGISTRY
from emb_daemon.estimator import status
from emb_daemon.identify import campaign_file
from emb_daemon.logs import mapping_file
from emb_daemon.wire import contract

_HERE = Path(__file__).parent
_PATHS = {"stiffness": "the stiffness path", "torque": "the torque path", "thermal": "heat"}


def _comments(module) -> dict[str, dict[str, str]]:
    """The ``#:`` comment of every field, by class."""
    lines = inspect.getsource(module).splitlines()
    found: dict[str, dict[str, str]] = {}
    for node in ast.parse("\n".join(lines)).body:
        if not isinstance(node, ast.ClassDef):
            continue
        found[node.name] = {}
        for item in node.body:
            if isinstance(item, ast.AnnAssign):
                text, above = [], item.lineno - 2
                while lines[above].strip().startswith("#:"):
                    text.insert(0, lines[above].strip()[2:].strip())
                    above -= 1
                found[node.name][item.target.id] = " ".join(text)
    return found


def _bounds(meta: msgspec.Meta) -> str:
    signs = (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤"))
    parts = [f"{sign} {getattr(meta, name):g}" for name, sign in signs if getattr(meta, name) is not None]
    if meta.pattern:
        parts.append("one of " + meta.pattern.strip("^()$").replace("|", ", "))
    if meta.min_length is not None and meta.min_length == meta.max_length:
        parts.append(f"{meta.min_length} entries")
    elif meta.min_length is not None or meta.max_length is not None:
        parts.append(f"{meta.min_length or 0} to {meta.max_length} entries" if meta.max_length else "not empty")
    return ", ".join(parts)


def _describe(kind) -> tuple[str, type | None]:
    """A type in words, and the struct in it if there is one."""
    if typing.get_origin(kind) is typing.Annotated:
        base, *metas = typing.get_args(kind)
        text, struct = _describe(base)
        return ", ".join([text, *filter(None, (_bounds(meta) for meta in metas))]), struct
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        text, struct = _describe(arguments[0])
        return f"list of {text}", struct
    if origin is dict:
        text, struct = _describe(arguments[1])
        return f"name: {text}", struct
    if type(None) in arguments:
        text, struct = _describe(next(argument for argument in arguments if argument is not type(None)))
        return f"{text}, or null", struct
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return "keys below", kind
    if origin is typing.Literal:
        return "one of " + ", ".join(arguments), None
    return {float: "number", int: "whole number", str: "text", bool: "true or false"}[kind], None


def _default(field) -> str:
    if field.required:
        return ""
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if isinstance(value, msgspec.Struct) or value in ((), {}, ""):
        return "may be left out"
    text = {None: "null", True: "true", False: "false"}.get(value, value) if not isinstance(value, float) else f"{value:g}"
    return f"default {text}"


def _struct(kind: type, path: str, out: list[str]) -> None:
    comments = _comments(sys.modules[kind.__module__])
    out += [f"## `{path}`" if path else "## The file", "", inspect.getdoc(kind) or "", ""]
    out += ["| key | what | meaning |", "| --- | --- | --- |"]
    below = []
    for field in msgspec.structs.fields(kind):
        text, struct = _describe(field.type)
        what = ", ".join(filter(None, (text, _default(field))))
        meaning = next(
            comments[owner.__name__][field.name] for owner in kind.__mro__ if field.name in comments[owner.__name__]
        )
        if struct and not meaning:
            meaning = (inspect.getdoc(struct) or "").splitlines()[0]
        out.append(f"| `{field.encode_name}` | {what} | {_cell(meaning)} |")
        if struct:
            below.append((struct, f"{path}.{field.encode_name}" if path else field.encode_name))
    out.append("")
    for struct, name in below:
        _struct(struct, name, out)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _structs(title: str, text: str, kind: type) -> str:
    out = [f"# {title}", "", text, ""]
    _struct(kind, "", out)
    return "\n".join(out).rstrip() + "\n"


def _catalogue() -> str:
    out = ["# Catalogue of effects", "", "The physical effects that the thesis does not model and the estimator can. Each is"]
    out += ["one file in `emb_daemon/effects`; an entry under `effects` in a calibration switches it on. `diagnose`"]
    out += ["finds which of them a log proves. [How to add one](effects.md).", ""]
    out += ["A *placebo* is a disturbed form of an effect that must not explain the residual: if it explains half of what"]
    out += ["the effect explains, `diagnose` refuses the effect.", ""]
    for path, words in _PATHS.items():
        out += [f"## Effects on {words}", ""]
        for effect in REGISTRY:
            if effect.path != path:
                continue
            summary = inspect.getdoc(sys.modules[f"emb_daemon.effects.{effect.name}"]).splitlines()[0]
            out += [f"### {effect.name}", "", summary, "", f"    {effect.equation}", ""]
            out += ["| parameter | unit | from | to | usual size | meaning |", "| --- | --- | --- | --- | --- | --- |"]
            for p in effect.parameters:
                out.append(f"| `{p.name}` | {p.unit} | {p.low:g} | {p.high:g} | {p.prior:g} | {_cell(p.meaning)} |")
            placebos = f" Placebo: {'; '.join(p.text for p in effect.placebos)}." if effect.placebos else ""
            out += ["", f"Enters at `{effect.hook}`. Shown by: {effect.manoeuvre}.{placebos} Source: {effect.source}.", ""]
    return "\n".join(out).rstrip() + "\n"


#: Between these lines of safety.md stands the table of facts.
_BEGIN, _END = "<!-- facts: begin -->", "<!-- facts: end -->"


def _safety() -> str:
    """The page as it is, with the table of facts written anew."""
    before, rest = (_HERE / "safety.md").read_text(encoding="utf-8").split(_BEGIN)
    _, after = rest.split(_END)
    rows = ["| fact | reasons | source |", "| --- | --- | --- |"]
    for fact in status.TABLE.values():
        source = "" if fact.source == contract.FUSED else contract.SOURCES[fact.source]
        rows.append(f"| {fact.sentence} | {', '.join(contract.reason_words(fact.reasons))} | {source} |")
    return "\n".join([before + _BEGIN, *rows, _END + after])


def pages() -> dict[str, str]:
    """The text of every generated page, by file name."""
    return {
        "calibration.md": _structs(
            "Calibration file",
            "The keys of a calibration: the file from which the estimator knows a brake. `emb-daemon identify` writes it; "
            "`emb-daemon check` lists every fault of it with its line. Each key ends in its unit. A file with an unknown key, "
            "with a key that occurs twice or with a number that is not finite is refused. The daemon never writes into this "
            "file; it keeps [learned values](integration.md#files) in its state directory.",
            types.Calibration,
        ),
        "configuration.md": _structs(
            "Configuration file",
            "The keys of the file that `emb-daemon run`, `check`, `uds`, `xcp` and `a2l` read with `--config`. Bus options on "
            "the command line and python-can's `CAN_*` variables override the file.",
            configuration.Configuration,
        ),
        "mapping.md": _structs(
            "Mapping file",
            "Where our signals come from in the logs of another rig: `--mapping FILE` of the commands that read logs. "
            "[How it is used](formats.md#another-rigs-signals); [an example](own_actuator.md).",
            mapping_file.MappingFile,
        ),
        "campaign.md": _structs(
            "Campaign and datasheet",
            "The keys of the two files that `emb-daemon identify` reads. The campaign says which log was recorded for which "
            "purpose; the datasheet holds the supplier's nominal values. [What to record, and why](own_actuator.md).",
            campaign_file.CampaignFile,
        ) + "\n# Datasheet\n\n" + _structs("", "", campaign_file.Datasheet).split("\n", 4)[4],
        "catalogue.md": _catalogue(),
        "safety.md": _safety(),
    }  # fmt: skip


def main() -> int:
    stale = [name for name, text in pages().items() if not _is_current(name, text)]
    if "--check" in sys.argv[1:]:
        if stale:
            print(f"{', '.join(stale)}: not current, run docs/generate.py", file=sys.stderr)
        return int(bool(stale))
    for name, text in pages().items():
        (_HERE / name).write_text(text, encoding="utf-8")
    return 0


def _is_current(name: str, text: str) -> bool:
    path = _HERE / name
    return path.is_file() and path.read_text(encoding="utf-8") == text


if __name__ == "__main__":
    sys.exit(main())
