"""Keys of authenticated communication: a file that only its owner may read."""

import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path

from emb_daemon.bounded import read_input
from emb_daemon.errors import InputError, InputErrors

_MOST_BYTES = 65_536
_LINE = re.compile(r"(\w+)\s+([0-9A-Fa-f]{32})")
_EXAMPLE = "expected a name and 32 hexadecimal digits, such as EMB_FL_Auth 00112233445566778899aabbccddeeff"


def key_file(name: str, relative_to: Path, environment: Mapping[str, str] = os.environ) -> Path:
    """Path of the key file: the systemd credential of that name (``LoadCredential=``) if there is one, else the file."""
    folder = environment.get("CREDENTIALS_DIRECTORY")
    if folder and (credential := Path(folder, name)).parent == Path(folder) and credential.exists():
        return credential
    return relative_to / name


def load_keys(path: Path, environment: Mapping[str, str] = os.environ) -> dict[str, bytes]:
    """Keys of 16 bytes by name: a line each, ``#`` begins a comment. Raises InputErrors: not readable, readable by others, or
    not a key file; every wrong line. Keys never appear in messages."""
    try:
        text, status = read_input(path, _MOST_BYTES).decode(), path.stat()
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file") from None
    # systemd gives a credential to its service by an access list, whose mask shows as the group's right to read.
    credential = path.parent == Path(environment.get("CREDENTIALS_DIRECTORY") or os.devnull)
    if status.st_mode & (0o037 if credential else 0o077):
        raise InputError(f"{path}: mode {stat.S_IMODE(status.st_mode):o}: others may read or change it; expected 600 or 400")
    if status.st_uid not in (0, os.geteuid()):
        raise InputError(f"{path}: belongs to another user")
    keys, faults = {}, []
    for number, line in enumerate(text.splitlines(), 1):
        if not (line := line.partition("#")[0].strip()):
            continue
        if not (match := _LINE.fullmatch(line)):
            faults.append(f"{path}:{number}: {_EXAMPLE}")
        elif match[1] in keys:
            faults.append(f"{path}:{number}: {match[1]}: occurs twice")
        elif (key := bytes.fromhex(match[2])) in keys.values():
            faults.append(
                f"{path}:{number}: {match[1]}: another name has the same key; expected a different key for each name"
            )
        else:
            keys[match[1]] = key
    if faults:
        raise InputErrors(faults)
    return keys
