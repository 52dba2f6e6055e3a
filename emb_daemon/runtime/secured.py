"""A bus on which only authentic frames are heard and every frame is authenticated, and what of that outlives a restart."""

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from emb_daemon.adapt import files
from emb_daemon.calibration.configuration import Setup
from emb_daemon.errors import InputError, Unavailable
from emb_daemon.runtime.journal import log
from emb_daemon.wire.keys import cmac
from emb_daemon.wire.secoc import LAST_TRIP, Link, Signer, Verifier

_FORMAT = 1
#: Reset counters that a sender may be ahead of what is kept of it: what can be played back to a daemon that was killed, 45 s
#: of a corner's frames. To keep each would be a write a second to a flash memory.
_RESETS_NOT_KEPT = 64


class Freshness(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a process must not forget: its own trip counter, and (trip, reset) up to which it has heard others, by link."""

    format: int = _FORMAT
    trip: Annotated[int, Meta(ge=0, le=LAST_TRIP)] = 0
    heard: dict[str, tuple[int, int]] = {}

    def next_trip(self) -> "Freshness":
        """Of the process that starts now."""
        return msgspec.structs.replace(self, trip=self.trip + 1)


class FreshnessFile:
    """The freshness values of one state directory."""

    def __init__(self, folder: Path):
        self.path = Path(folder) / "freshness.json"

    def load(self) -> Freshness:
        """What is kept; nothing if there is no file or a damaged one, which is set aside: old messages are then new."""
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
        """What is kept, with a trip counter that was never used before.

        Raises:
            Unavailable: it cannot be kept; messages under a used one could be played back.
            InputError: there is none left.
        """
        kept = self.load()
        if kept.trip >= LAST_TRIP:
            raise InputError(f"{self.path}: all trip counters are used up; install new keys and remove this file")
        begun = kept.next_trip()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            files.write(self.path, begun)
        except OSError as error:
            raise Unavailable(f"{self.path}: trip counter cannot be stored: {error.strerror}") from None
        return begun

    def keep(self, freshness: Freshness) -> None:
        try:
            files.write(self.path, freshness)
        except OSError as error:
            log.error("%s: freshness cannot be stored: %s", self.path, error.strerror)


class Authentication:
    """Both directions of one process.

    Args:
        received, sent: its links; of one without a key nothing is believed, and nothing authenticated.
        keys: by the links' names.
        kept: its own trip counter, and what it heard before.
        file: where that is kept; nowhere if it reads logs.

    Attributes:
        keyless: links without a key.

    Raises:
        InputError: the extra `secoc` is not installed.
    """

    def __init__(
        self,
        received: Sequence[Link],
        sent: Sequence[Link],
        keys: Mapping[str, bytes],
        kept: Freshness,
        file: FreshnessFile | None = None,
    ):
        self.keyless = [link for link in (*received, *sent) if link.name not in keys]
        macs = {link.name: cmac(keys[link.name]) for link in (*received, *sent) if link.name in keys}
        self._kept, self._file = kept, file
        self._verifier = Verifier(received, macs, kept.heard)
        self.verify, self.sign = self._verifier.verify, Signer(sent, macs, kept.trip).sign
        self._writer: threading.Thread | None = None

    def stale(self) -> bool:
        """Whether what is kept lies far behind what was heard."""
        for name, (trip, reset) in self._verifier.last().items():
            kept_trip, kept_reset = self._kept.heard.get(name, (0, 0))
            if trip != kept_trip or reset - kept_reset >= _RESETS_NOT_KEPT:
                return True
        return False

    def keep(self) -> None:
        """Begin to write down what was heard, beside the caller."""
        if self._file and not (self._writer and self._writer.is_alive()):
            self._kept = msgspec.structs.replace(self._kept, heard=self._kept.heard | self._verifier.last())
            self._writer = threading.Thread(target=self._file.keep, args=(self._kept,), name="freshness")
            self._writer.start()

    def close(self) -> None:
        """Write down what was heard."""
        if self._writer:
            self._writer.join()
        self.keep()
        if self._writer:
            self._writer.join()


class SecuredBus:
    """Any of our buses behind an `Authentication`; the same interface."""

    #: Frames between two looks at what is to be kept.
    _FRAMES = 4096

    def __init__(self, bus, authentication: Authentication):
        self._bus, self._authentication = bus, authentication
        self._heard = 0

    def __getattr__(self, name: str):
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


def secure(bus, setup: Setup, state: Path | None) -> tuple[SecuredBus, set[str]]:
    """The daemon's end of an authenticated bus, and the corners of which a key is missing.

    Raises:
        InputError: there is no state directory, no trip counter left, or the extra `secoc` is not installed.
        Unavailable: the trip counter cannot be kept.
    """
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
