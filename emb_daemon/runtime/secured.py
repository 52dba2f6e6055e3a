"""A bus that passes on only authentic frames and authenticates sent ones, and the counters that must survive a restart."""

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from emb_daemon.adapt import files
from emb_daemon.atomic import write_in_reserve
from emb_daemon.calibration.configuration import Setup
from emb_daemon.errors import InputError, Unavailable
from emb_daemon.runtime.bus import Bus
from emb_daemon.runtime.journal import log
from emb_daemon.wire.secoc import LAST_TRIP, Link, Signer, Verifier

_FORMAT = 1
#: Reset counters that a sender may be ahead of the stored one. Frames of this time, 45 s of a corner's, can be played back to
#: a daemon that was killed. Storing every reset counter would write to flash memory once a second.
_RESETS_NOT_KEPT = 64
#: Room on the disk for the counters of all links, taken at the first start: a daemon that cannot store them on a full disk
#: would not start, and after a kill would accept everything that was sent since they were last stored.
_ROOM = 4096


class Freshness(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Counters that must survive a restart: the process's own trip counter, and the last (trip, reset) received, by link."""

    format: int = _FORMAT
    trip: Annotated[int, Meta(ge=0, le=LAST_TRIP)] = 0
    heard: dict[str, tuple[int, int]] = {}

    def next_trip(self) -> "Freshness":
        """Trip counter of the process that starts now."""
        return msgspec.structs.replace(self, trip=self.trip + 1)


class FreshnessFile:
    """The freshness values of one state directory."""

    def __init__(self, folder: Path):
        self.path: Path = Path(folder) / "freshness.json"
        self._told: str | None = None

    def load(self) -> Freshness:
        """The stored values; none without a file. A damaged file is set aside. Without values old messages are accepted."""
        try:
            return files.decode(files.read(self.path), Freshness, _FORMAT)
        except FileNotFoundError:
            return Freshness()
        except ValueError as error:
            log.error("%s: damaged (%s), %s", self.path, error, files.set_aside(self.path))
            return Freshness()
        except OSError as error:
            raise Unavailable(f"{self.path}: not readable: {error.strerror}") from None

    def begin_trip(self) -> Freshness:
        """The stored values, with a trip counter that was never used before. Raises Unavailable: it cannot be stored; messages
        sent under a counter that is used twice could be played back. Raises InputError: all trip counters are used up."""
        kept = self.load()
        if kept.trip >= LAST_TRIP:
            raise InputError(f"{self.path}: all trip counters are used up; install new keys and remove this file")
        begun = kept.next_trip()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._write(begun)
        except OSError as error:
            raise Unavailable(f"{self.path}: trip counter cannot be stored: {error.strerror}") from None
        return begun

    def keep(self, freshness: Freshness) -> bool:
        """Whether the values could be stored; a reason why not is logged once."""
        try:
            self._write(freshness)
        except OSError as error:
            if error.strerror != self._told:
                log.error("%s: freshness cannot be stored: %s", self.path, error.strerror)
            self._told = error.strerror
            return False
        self._told = None
        return True

    def _write(self, freshness: Freshness) -> None:
        write_in_reserve(self.path, files.encode(freshness), _ROOM)


class Authentication:
    """Both directions of one process, over its links; messages of a link without a key, all by the links' names, are refused,
    or sent without authentication. ``kept``: the process's own trip counter, and the counters received before; ``file``: where
    these are stored; None when logs are read."""

    def __init__(
        self,
        received: Sequence[Link],
        sent: Sequence[Link],
        keys: Mapping[str, bytes],
        kept: Freshness,
        file: FreshnessFile | None = None,
    ):
        self.keyless: list[Link] = [link for link in (*received, *sent) if link.name not in keys]  #: links without a key
        self._kept, self._file = kept, file
        self._verifier = Verifier(received, keys, kept.heard)
        self.verify: Callable[[np.ndarray], np.ndarray] = self._verifier.verify
        self.sign: Callable[[np.ndarray], np.ndarray] = Signer(sent, keys, kept.trip).sign
        self._writer: threading.Thread | None = None

    def stale(self) -> bool:
        """Whether the stored counters are far behind those received."""
        for name, (trip, reset) in self._verifier.last().items():
            kept_trip, kept_reset = self._kept.heard.get(name, (0, 0))
            if trip != kept_trip or reset - kept_reset >= _RESETS_NOT_KEPT:
                return True
        return False

    def keep(self) -> None:
        """Start to store the received counters, in a thread."""
        if self._file and not (self._writer and self._writer.is_alive()):
            heard = msgspec.structs.replace(self._kept, heard=self._kept.heard | self._verifier.last())
            self._writer = threading.Thread(target=self._store, args=(self._file, heard), name="freshness")
            self._writer.start()

    def _store(self, file: FreshnessFile, heard: Freshness) -> None:
        """Counters that cannot be stored stay stale, and storing is tried again."""
        if file.keep(heard):
            self._kept = heard

    def close(self) -> None:
        """Store the received counters."""
        if self._writer:
            self._writer.join()
        self.keep()
        if self._writer:
            self._writer.join()


class SecuredBus:
    """A bus of this package behind an `Authentication`, with the same interface."""

    #: Number of frames between two checks of whether the counters must be stored.
    _FRAMES = 4096

    def __init__(self, bus: Bus, authentication: Authentication):
        self._bus, self._authentication = bus, authentication
        self._heard = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def drain(self) -> np.ndarray:
        frames = self._bus.drain()
        self._heard += len(frames)
        if self._heard >= self._FRAMES:
            self._heard = 0
            if self._authentication.stale():
                self._authentication.keep()
        return self._authentication.verify(frames)

    def send(self, frames: np.ndarray) -> None:
        self._bus.send(self._authentication.sign(frames))

    def close(self) -> None:
        self._authentication.close()
        self._bus.close()


def secure(bus: Bus, setup: Setup, state: Path | None) -> tuple[SecuredBus, set[str]]:
    """The daemon's end of an authenticated bus, and the corners of which a key is missing. Raises InputError: no state
    directory, or all trip counters used up. Raises Unavailable: the trip counter cannot be stored."""
    if state is None:
        raise InputError(f"{setup.path}: secoc: freshness must survive a restart; expected state_directory as well")
    file = FreshnessFile(state)
    authentication = Authentication(*setup.links, setup.keys, file.begin_trip(), file)
    for link in authentication.keyless:
        log.error(
            "%s: no key %s: its messages are neither accepted nor sent with authentication",
            setup.configuration.secoc.keys,
            link.name,
        )
    return SecuredBus(bus, authentication), {link.corner for link in authentication.keyless} - {""}
