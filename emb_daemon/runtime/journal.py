"""Logging: structured fields to systemd's journal when it started us, plain lines to stderr otherwise."""

import contextlib
import logging
import os
import socket
import sys

_JOURNAL = "/run/systemd/journal/socket"
_PRIORITY = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}

log: logging.Logger = logging.getLogger("emb_daemon")


def note(text: str, **words: str) -> None:
    """Log a line, whose words are fields of the journal, too."""
    log.info(text, words, extra={"fields": words})


class JournalHandler(logging.Handler):
    """The journal's native protocol: one datagram of FIELD=value lines. ``extra={"fields": {...}}`` adds EMB_* fields."""

    def __init__(self):
        super().__init__()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.connect(_JOURNAL)
        # The loop logs as well: if the journal does not keep up, lines are lost and not ticks.
        self._socket.setblocking(False)

    def emit(self, record: logging.LogRecord) -> None:
        fields = {
            "MESSAGE": record.getMessage(),
            "PRIORITY": _PRIORITY.get(record.levelno, 6),
            "SYSLOG_IDENTIFIER": "emb-daemon",
        }
        fields |= {f"EMB_{key.upper()}": value for key, value in getattr(record, "fields", {}).items()}
        lines = "".join(f"{key}={str(value).replace(chr(10), ' | ')}\n" for key, value in fields.items())
        with contextlib.suppress(OSError):
            self._socket.send(lines.encode())


def set_up_logging(level: str) -> None:
    """``level`` is debug, info, warning or error."""
    handler: logging.Handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    if os.environ.get("JOURNAL_STREAM") and os.path.exists(_JOURNAL):
        handler = JournalHandler()
    log.handlers[:] = [handler]
    log.propagate = False
    log.setLevel(level.upper())
