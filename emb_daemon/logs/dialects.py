"""Frames in other tools' text formats, converted to can-utils' log format, which is read in bulk."""

import re
from collections.abc import Iterator
from itertools import pairwise

from emb_daemon.logs.frame_tables import frame_table

#: What candump shows on a terminal with its option for times: ``(seconds)  interface  id   [length]  bytes``.
_SHOWN = re.compile(
    rb"\s*\((\d+\.\d+)\)\s+(\S+)\s+(?:[RT]X\s[^\[]*?\s)?([0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})\s+\[(\d+)\]((?:\s+[0-9A-Fa-f]{2})*)"
    rb"\s*(remote request|'.*)?"
)
#: How SavvyCAN's tables (GVRET) begin, times in microseconds; older ones name no direction.
_GVRET, _GVRET_COLUMNS = b"Time Stamp,ID,Extended,", (b"Time Stamp", b"ID", b"Extended", b"Bus", b"LEN")
#: How BUSMASTER's logs begin, and a frame in one: ``hh:mm:ss:fraction Rx|Tx channel id type length bytes``, of type s(tandard)
#: or (e)x(tended), with r where it is remote. All other lines begin with stars.
_BUSMASTER = b"***BUSMASTER"
_BUSMASTER_FRAME = re.compile(
    rb"(\d+):(\d+):(\d+):(\d+)\s+[RT]x\s+(\d+)\s+(?:0x)?([0-9A-Fa-f]+)\s+([sx]r?)(?:-fd)?\s+(\d+)((?:\s+[0-9A-Fa-f]+)*)", re.I
)
_DECIMAL = b"***DEC***"
_HALF_A_DAY_S = 43_200
#: How a trace of CANHacker begins, and a frame in one: ``seconds,milliseconds id length bytes``. The seconds start anew each
#: minute.
_CANHACKER = re.compile(rb"Time\s+ID\s+DLC\s+Data\b.*")
_CANHACKER_FRAME = re.compile(rb"(\d+)[,.](\d{3})\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+(\d+)((?:\s+[0-9A-Fa-f]{2})*)\b.*")
#: Longest pause of a bus, s; number of frames after which it was one.
_MINUTE_S, _LONGEST_S, _STRAYS = 60, 2.0, 20
#: How PEAK's trace files begin, if they name their version, and a line in one of 1.0 that is no frame: the number of an error.
_PEAK, _PEAK_ERROR = b";$FILEVERSION", re.compile(rb"[ \t]*\d+\)[^\n]*\bERROR\b[^\n]*\n?")
#: A stray semicolon after the time at which a trace file of PEAK began; version 1.2, which is 1.3 without a reserved column
#: between id and length.
_PEAK_START = re.compile(rb"(?m)^(;\$STARTTIME=[\d.]+);")
_PEAK_1_2 = re.compile(rb"^;\$FILEVERSION=1\.2\b")
_PEAK_1_2_ID = re.compile(rb"(?m)^(\s*\d+\)\s+[\d.]+\s+\d+\s+[RT]x\s+[0-9A-Fa-f]+)")
#: A row of a table that PEAK-Converter makes of one: ``number,ms,bus,Rx|Tx,type,id,reserved,length,bytes``, parted by what its
#: user chose; types of messages, and of those of CAN FD; how a row of any other type begins, or a comment.
_PEAK_ROW = re.compile(
    rb"\s*\d+\)?(?P<mark>[,;\t|])\s*(?P<ms>\d+(?:[.,]\d+)?)(?P=mark)\s*(?P<bus>\d+)(?P=mark)\s*[RT]x(?P=mark)\s*(?P<kind>[A-Z]{2})"
    rb"(?P=mark)\s*(?P<id>[0-9A-Fa-f]{3,8})(?P=mark)[^,;\t|]*(?P=mark)\s*(?P<length>\d+)(?P<data>(?:(?P=mark)[^,;\t|]*)*)\s*"
)
_PEAK_MESSAGES, _PEAK_FD = (b"DT", b"RR"), (b"FD", b"FB", b"FE", b"BI")
_PEAK_OTHER = re.compile(rb"\s*(\d+\)?[,;\t|]|;|$)")
#: How a line begins with its time; a text of Vector whose times count from one event to the next; least share of them that
#: go back where the times that candump shows do so.
_STAMP = re.compile(rb"(?m)^([ \t]*\(?)(\d+\.\d+)(?=[\s)])")
_ASC_RELATIVE, _GOES_BACK = re.compile(rb"(?mi)^base\s+\w+\s+timestamps\s+relative\b"), 0.1
#: Lines at the beginning of a file among which the first frame is looked for.
_FIRST_LINES = 100
#: Number of bytes that hold a header.
_HEADER_BYTES = 1000


def as_candump(content: bytes) -> bytes | None:
    """A text in another format converted to candump's log format line by line; None if the format is unknown. A line that
    cannot be read stays as it is."""
    first = content[:1000].lstrip().split(b"\n", 1)[0]
    names = [cell.strip() for cell in first.split(b",")]
    if first.startswith(_GVRET) and {*_GVRET_COLUMNS} <= {*names}:
        places = [names.index(name) for name in _GVRET_COLUMNS]
        # The header becomes an empty line, so that the line numbers stay the same.
        return b"\n".join([b"", *(_of_gvret(line, places) for line in content.split(b"\n")[1:])])
    if first.startswith(_BUSMASTER):
        return b"\n".join(_of_busmaster(content.split(b"\n")))
    if _CANHACKER.fullmatch(first.strip()):
        return b"\n".join(_of_canhacker(content.split(b"\n")))
    if _SHOWN.fullmatch(first.strip()):
        stamps = [float(stamp) for _, stamp in _STAMP.findall(content)]
        back = sum(after < before for before, after in pairwise(stamps))
        return b"\n".join(map(_of_terminal, (_summed(content) if back > _GOES_BACK * len(stamps) else content).split(b"\n")))
    if any(map(_PEAK_ROW.fullmatch, content.split(b"\n", _FIRST_LINES)[:_FIRST_LINES])):
        return b"\n".join(_of_peak_table(content.split(b"\n")))
    return frame_table(content)


def _summed(content: bytes) -> bytes:
    """Lines whose times count from the line before, counted from the first."""
    passed_ns = 0

    def later(found: re.Match[bytes]) -> bytes:
        nonlocal passed_ns
        passed_ns += round(1e9 * float(found[2]))
        return b"%s%d.%09d" % (found[1], *divmod(passed_ns, 1_000_000_000))

    return _STAMP.sub(later, content)


def with_absolute_times(content: bytes) -> bytes:
    """A text of Vector as python-can's reader knows it, whose times count from the first event."""
    return _summed(content) if _ASC_RELATIVE.search(content, 0, _HEADER_BYTES) else content


def tidied_trace(content: bytes) -> bytes:
    """A trace file of PEAK as python-can's reader knows it: not version 1.2, and no errors in 1.0."""
    if not content.startswith(_PEAK):
        return _PEAK_ERROR.sub(b"", content)
    content = _PEAK_START.sub(rb"\1", content)
    if not _PEAK_1_2.match(content):
        return content
    return _PEAK_1_2_ID.sub(rb"\1 -", _PEAK_1_2.sub(b";$FILEVERSION=1.3", content))


def _of_canhacker(lines: list[bytes]) -> Iterator[bytes]:
    """A stamp that jumps is not believed before others say the same: this logger's strays among frames in order."""
    before, passed, strays = None, 0.0, 0
    yield b""
    for line in lines[1:]:
        if not (found := _CANHACKER_FRAME.fullmatch(line.strip())):
            yield line.strip()
            continue
        seconds, octets = float(b"%s.%s" % found.group(1, 2)), b"".join(found[5].split())
        if before is None:
            before = passed = seconds
        step = (seconds - before) % _MINUTE_S
        strays = strays + 1 if step > _LONGEST_S or seconds >= _MINUTE_S else 0
        if strays > _STRAYS:
            # What was believed last may have been the stray.
            step = (seconds - before + 0.5 * _MINUTE_S) % _MINUTE_S - 0.5 * _MINUTE_S
        if not strays or strays > _STRAYS:
            before, passed, strays = seconds, passed + step, 0
        # A remote frame has a length and no bytes.
        payload = octets if int(found[4]) == len(octets) // 2 else b"R"
        yield b"(%.6f) can0 %s#%s" % (passed, found[3].upper(), payload)


def _of_peak_table(lines: list[bytes]) -> Iterator[bytes]:
    """Text before the first frame, and rows of events and errors, become empty lines."""
    begun = False
    for line in lines:
        found = _PEAK_ROW.fullmatch(line)
        begun = begun or found is not None
        if found and (found["kind"] in _PEAK_MESSAGES or found["kind"] in _PEAK_FD):
            yield _of_peak_row(found)
        else:
            yield line if begun and not _PEAK_OTHER.match(line) else b""


def _line(stamp: bytes, bus: bytes, can_id: int, extended: bool, fd: bool, octets: bytes) -> bytes:
    """A line of candump's log; ``octets`` in hexadecimal digits, or R of a remote frame."""
    return b"(%s) %s %s%s%s" % (stamp, bus, (b"%08X" if extended else b"%03X") % can_id, b"##0" if fd else b"#", octets)


def _of_peak_row(found: re.Match[bytes]) -> bytes:
    kind, can_id = found["kind"], found["id"]
    cells = [cell.strip() for cell in found["data"].split(found["mark"])]
    octets = b"R" if kind == b"RR" else b"".join(cell for cell in cells if cell not in (b"", b"-", b"--"))
    stamp = b"%.6f" % (1e-3 * float(found["ms"].replace(b",", b".")))
    # Ids of eleven bits have four digits.
    return _line(stamp, found["bus"], int(can_id, 16), len(can_id) > 4, kind in _PEAK_FD, octets)


def _of_terminal(line: bytes) -> bytes:
    found = _SHOWN.fullmatch(line.rstrip())
    if not found:
        return line
    stamp, interface, can_id, length, data, more = found.groups()
    octets = b"R" if (more or b"").startswith(b"r") else b"".join(data.split())
    # Lengths of CAN FD have two digits.
    return _line(stamp, interface, int(can_id, 16), len(can_id) > 3, len(length) > 1, octets)


def _of_gvret(line: bytes, places: list[int]) -> bytes:
    """``places``: the columns of time, id, whether it is extended, bus and length; the bytes follow the length."""
    cells = [cell.strip() for cell in line.split(b",")]
    try:
        stamp, can_id, extended, bus, length = (cells[place] for place in places)
        micros, can_id, length = int(stamp), int(can_id, 16), int(length)
        data = b"".join(b"%02X" % int(cell, 16) for cell in cells[places[-1] + 1 :][:length])
    except (ValueError, IndexError):
        return line
    stamp = b"%d.%06d" % divmod(micros, 1_000_000)
    return _line(stamp, bus, can_id, extended.lower() == b"true", length > 8, data)


def _of_busmaster(lines: list[bytes]) -> Iterator[bytes]:
    """Times count from midnight before the first frame; a log of more than a day goes on, session by session."""
    base, day, last = 16, 0, 0
    for line in lines:
        found = _BUSMASTER_FRAME.fullmatch(line.strip())
        if not found:
            base = 10 if line.strip() == _DECIMAL else base
            yield b"" if line.startswith(b"***") else line
            continue
        hours, minutes, seconds, fraction, channel, can_id, kind, length, data = found.groups()
        second = 3600 * int(hours) + 60 * int(minutes) + int(seconds)
        # Back by more than half a day is another day; by less it is what `stamps` makes of it.
        day += last - second > _HALF_A_DAY_S
        last = second
        extended, remote = kind[:1] in b"xX", len(kind) > 1
        octets = b"R" if remote else b"".join(b"%02X" % int(octet, base) for octet in data.split()[: int(length)])
        stamp = b"%d.%s" % (second + 2 * _HALF_A_DAY_S * day, fraction)
        yield _line(stamp, channel, int(can_id, base), extended, int(length) > 8, octets)
