"""DBCs of other people: what cantools refuses in them, and other tools do not, is left out, and said."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

from emb_daemon.errors import tell
from emb_daemon.wire.layout import NO_DBC, load_database, not_readable, read_dbc

if TYPE_CHECKING:
    from cantools.database.can import Database

#: Statements that name a message by its id.
_WITH_ID = re.compile(
    r"(?m)^(\s*(?:BO_|BO_TX_BU_|SIG_VALTYPE_|SIG_GROUP_|SG_MUL_VAL_|VAL_|CM_ +(?:SG|BO)_"
    r'|BA_ +"[^"]*" +(?:BO|SG)_) +)(\d+)\b'
)
#: Largest id of 11 and of 29 bits, and the bit by which a DBC tells the latter.
_STANDARD, _LONG, _IS_LONG = 0x7FF, 0x1FFFFFFF, 0x80000000
#: What cantools says of a line that it cannot read, of a message that cannot be, of statements about what is not there, and of
#: each of these.
_AT_LINE, _IN_MESSAGE = re.compile(r"Invalid syntax at line (\d+)"), re.compile(r"frame id .* in message (\w+)")
_UNUSED, _STATEMENT = "unused ", re.compile(r"(\w+_) (\d+) (\w+)")
#: A message as it has to begin.
_MESSAGE = re.compile(r"\s*BO_ +\d+ +[A-Za-z_]\w* *: *\d+ +\w+\s*$")
#: Faults up to which a file is a DBC, and number of names that are listed of one.
_MOST, _LISTED = 30, 5


def load_foreign(path: Path) -> "Database":
    """A rig's cantools database; its signals may overlap and reach beyond their message.

    Statements that no DBC may have are left out, with a line on stderr, as long as they are few; ids that need 29 bits are
    taken to be long, whether their file says so or not. Raises InputError: the file cannot be read or is no DBC."""
    if path.suffix.lower() in NO_DBC:
        return load_database(path, strict=False)
    import cantools

    text, left_out = _WITH_ID.sub(_long, read_dbc(path)), []
    while True:
        try:
            database = cantools.database.load_string(text, "dbc", strict=False)
        except Exception as error:
            shorter, what = _without(text, str(error))
            if shorter == text or len(left_out) == _MOST:
                raise not_readable(path, error) from None
            text = shorter
            left_out.append(what)
            continue
        for what in left_out:
            tell(f"{path}: {what}: left out")
        return database


def _long(found: re.Match) -> str:
    number = int(found[2])
    return f"{found[1]}{number | _IS_LONG if _STANDARD < number <= _LONG else number}"


def _without(text: str, error: str) -> tuple[str, str]:
    """A DBC without what an ``error`` of cantools is about, and that in words; lines keep their numbers. Unchanged if it
    cannot be told."""
    if _UNUSED in error:
        unused = _STATEMENT.findall(error)
        for kind, number, name in unused:
            text = re.sub(rf"(?m)^\s*{kind} +{number} +{name}\b[^;]*;", "", text)
        named = sorted({name for _, _, name in unused})
        return text, f"what it says of {', '.join(named[:_LISTED])}{', …' * (len(named) > _LISTED)}, not in that message"
    lines = text.split("\n")
    if found := _IN_MESSAGE.search(error):
        row = next((n for n, line in enumerate(lines) if re.match(rf"\s*BO_ +\d+ +{found[1]} *:", line)), len(lines) - 1)
    elif found := _AT_LINE.search(error):
        row = int(found[1]) - 1
        # Of a statement that does not end the next one is said to be wrong.
        while row > 0 and (not lines[row].strip() or _MESSAGE.match(lines[row])):
            row -= 1
    else:
        return text, ""
    what, end = lines[row].strip(), row + 1
    if what.startswith("BO_ "):
        # Its signals would count as those of the message before.
        end += next((n for n, line in enumerate(lines[end:]) if not line.strip().startswith("SG_ ")), 0)
    lines[row:end] = [""] * (end - row)
    return "\n".join(lines), f"line {row + 1} is no DBC's ({what[:60]})"
