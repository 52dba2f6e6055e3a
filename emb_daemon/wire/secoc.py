"""Secure onboard communication: proves that a message is from its sender, and that it is not a replayed one.

AUTOSAR SecOC in the form of its profile 1 (AES-128-CMAC, truncated; 8 bits of freshness on the wire), as a secured PDU
collection with message linking, because resolver and current leave no room in their frames: an authentication frame follows
each *set* of messages, shares their Counter, and carries the first 36 bits of the CMAC over

    data id (16 bits: CAN id of the authentication frame, plus 2048 times the set's number)
    payloads of the set (8 bytes each)
    freshness value (56 bits: trip counter, reset counter, message counter)

most significant byte first. The message counter, 8 bits long, is on the wire. When it has reached its end, the sender
increments the reset counter and sends a freshness frame, which is itself authenticated with message counter 0. A sender
increments its trip counter at each start. Therefore no freshness value occurs twice under one key, and a receiver that missed
frames, however many, is in step again with the next freshness frame. Source: AUTOSAR CP R22-11, SWS
SecureOnboardCommunication: profile 1, secured PDU collection, freshness management.

All frames of a tick are signed, or verified, in one call of compiled code.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from emb_daemon.errors import InputErrors
from emb_daemon.jit import Array, entry, fields, njit
from emb_daemon.resources import resource
from emb_daemon.wire.cmac import KEY, cmac, new_key
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.e2e import COUNTER_MODULO, counter_of, protect
from emb_daemon.wire.frames import FRAME, UNAUTHENTIC, put
from emb_daemon.wire.layout import CORNERS, OPTIONAL, load_database

#: Number of the set that consists of the freshness frame alone.
FRESHNESS_SET = 15
#: The largest message, trip and reset counters. One value of the reset counter lasts 0.7 s of a corner's frames. A trip can
#: therefore last 130 days; after that nothing is authenticated until the next start.
LAST_MESSAGE, LAST_TRIP, LAST_RESET = 0xFF, 0xFF_FFFF, 0xFF_FFFF
_TAG_BITS = 36
#: Most sets of a sender, besides the freshness frame, and most messages of a set.
_SETS, _MESSAGES = 4, 2
#: Payload with a Counter that no message has.
_NO_PAYLOAD = 0xF00
#: Time for which a frame is held until its authentication arrives: eight cycles, which covers the burst of a delayed bus. If
#: more than eight frames of one message are waiting, this is a flood.
_HELD_NS, _MOST_HELD = 8 * CYCLE_NS, 8
#: Largest number of CMACs that are computed for one sender in one cycle, so that a flood of authentication frames cannot hold
#: up the loop. Without an attack a sender needs one CMAC for each set, at most three in a cycle.
_MOST_TRIES = 32

#: Messages that a sender authenticates, set by set, by the name of its authentication message.
_RECEIVED = {
    "EMB_{}_Auth": (("EMB_{}_Resolver", "EMB_{}_Current"), ("EMB_{}_Thermocouple",), ("EMB_{}_ForceSensor",)),
    "VEH_Auth": (("VEH_WheelSpeed",), ("VEH_WheelPulse",), ("VEH_Status",)),
}
_SENT = {
    "EMB_{}_EstimateAuth": (
        ("EMB_{}_ClampForce",), ("EMB_{}_PadTemp",), ("EMB_{}_EstimatorStatus",), ("EMB_{}_AdaptRequest",),
    )
}  # fmt: skip
#: Where their fields are: first bit and length.
_AUTHENTICATION = {"Counter": (8, 4), "Set": (16, 4), "Freshness": (20, 8), "Authenticator": (28, _TAG_BITS)}
_FRESHNESS = {"Counter": (8, 4), "TripCounter": (16, 24), "ResetCounter": (40, 24)}


class Link(NamedTuple):
    """The messages that one sender authenticates for one receiver, under a key of their own.

    ``name`` is the name of the authentication message and of the key; ``corner`` is empty for the vehicle; ``sets`` are the
    CAN ids of the messages of each set."""

    name: str
    corner: str
    authentication_id: int
    freshness_id: int
    sets: tuple[tuple[int, ...], ...]


def load_links(path: Path | None = None, corners: Iterable[str] = CORNERS) -> tuple[list[Link], list[Link]]:
    """(links that the daemon receives, links that it sends) of ``corners`` and the vehicle, by a DBC or the shipped one.
    Raises InputErrors: the DBC lacks messages or has their fields elsewhere; every fault is listed."""
    path = path or resource("dbc/emb.dbc")
    known = {message.name: message for message in load_database(path).messages}
    faults = []

    def id_of(name: str, fields: Mapping[str, tuple[int, int]] = {}) -> int:
        if name not in known:
            faults.append(f"{path}: message {name} is missing")
            return 0
        places = {signal.name: (signal.start, signal.length) for signal in known[name].signals}
        for field, (start, length) in fields.items():
            if places.get(field) != (start, length):
                faults.append(f"{path}: {name}.{field}: expected {length} bits from bit {start}")
        return known[name].frame_id

    def link(template: str, sets, corner: str) -> Link:
        name = template.format(corner)
        names = [[message.format(corner) for message in messages] for messages in sets]
        # Optional messages are the last of their table.
        there = [messages for messages in names if messages[0] in known or not messages[0].endswith(OPTIONAL)]
        ids = tuple(tuple(map(id_of, messages)) for messages in there)
        freshness = name.removesuffix("Auth") + "Freshness"
        return Link(name, corner, id_of(name, _AUTHENTICATION), id_of(freshness, _FRESHNESS), ids)

    received, sent = (
        [link(name, sets, corner) for name, sets in table.items() for corner in (corners if "{}" in name else ("",))]
        for table in (_RECEIVED, _SENT)
    )
    if faults:
        raise InputErrors(faults)
    return received, sent


#: One sender's link, for the sender and for the receiver. ``sizes``: number of messages of each set, the freshness frame's
#: last. ``trip``, ``reset``, ``message``: the freshness value last sent, or last received and found authentic. ``text``,
#: ``code``: what is authenticated now, and its CMAC. Of the sender ``payloads``: those of sets that are not complete. Of the
#: receiver ``in_step``: whether the freshness value is known; ``tries``: number of CMACs since ``since_ns``; ``held``: frames
#: that wait for their authentication, the oldest first, by set and place in the set, and their number ``waiting``.
LINK = np.dtype(
    [
        *fields("?", "keyed in_step"),
        *fields("i8", "authentication_id freshness_id first_id trip reset message tries since_ns"),
        ("key", KEY),
        ("sizes", "i8", (_SETS + 1,)),
        ("payloads", "u8", (_SETS, _MESSAGES)),
        ("held", FRAME, (_SETS + 1, _MESSAGES, _MOST_HELD)),
        ("waiting", "i8", (_SETS + 1, _MESSAGES)),
        ("text", "u1", (32,)),
        ("code", "u1", (16,)),
    ],
    align=True,
)
#: No frames.
_NONE = -1
#: Place of a CAN id: its link (-1: none), its set (of an authentication frame -1) and its place in the set.
_PLACE = np.dtype(fields("i8", "link which position"), align=True)


def _new_links(links: Iterable[Link], keys: Mapping[str, bytes]) -> tuple[np.ndarray, np.ndarray]:
    """LINK records, and _PLACE records by CAN id."""
    links, places = list(links), np.zeros(2048, _PLACE)
    records = np.zeros(len(links), LINK)
    places["link"] = -1
    for number, (link, record) in enumerate(zip(links, records, strict=True)):
        record["authentication_id"], record["freshness_id"] = link.authentication_id, link.freshness_id
        record["first_id"], record["message"], record["payloads"] = link.sets[0][0], LAST_MESSAGE, _NO_PAYLOAD
        for which, ids in [*enumerate(link.sets), (_SETS, (link.freshness_id,))]:
            record["sizes"][which] = len(ids)
            for position, can_id in enumerate(ids):
                places[can_id] = number, which, position
        places[link.authentication_id] = number, -1, 0
        if link.name in keys:
            record["keyed"] = True
            new_key(keys[link.name], record["key"])
    return records, places


@njit
def _authenticator(link, number, first, second, trip, reset, message):
    """The first 36 bits of the CMAC of set ``number`` with payloads ``first`` and, if it has two, ``second``."""
    text, at = link.text, 2
    data_id = link.authentication_id | number << 11
    text[0], text[1] = data_id >> 8, data_id & 0xFF
    for payload in (first, second):
        if at == 2 or (number != FRESHNESS_SET and link.sizes[number] == 2):
            for byte in range(8):
                text[at + byte] = (payload >> np.uint64(8 * byte)) & np.uint64(0xFF)
            at += 8
    for counter, octets in ((trip, 3), (reset, 3), (message, 1)):
        for byte in range(octets):
            text[at + byte] = counter >> 8 * (octets - 1 - byte) & 0xFF
        at += octets
    cmac(link.key, text, at, link.code)
    tag = 0
    for byte in range(5):
        tag = tag << 8 | int(link.code[byte])
    return tag >> 4


class Signer:
    """Puts authentication frames among the frames that a process sends on ``links``; messages of one without a key are sent
    without authentication. ``keys`` of 16 bytes by the links' names; ``trip`` counter of the process, one more than at its
    last start."""

    def __init__(self, links: Iterable[Link], keys: Mapping[str, bytes], trip: int):
        self.links: np.ndarray  #: their LINK records, shape (links,)
        self.links, self._places = _new_links(links, keys)
        self.links["trip"] = trip
        self._frames = np.zeros(64, FRAME)
        # Compile now, not when the first frame is waiting.
        self.sign(self._frames[:0])

    def sign(self, frames: np.ndarray) -> np.ndarray:
        """``frames`` (FRAME array in sending order) with each set's authentication behind it; valid until the next call."""
        if 4 * len(frames) > len(self._frames):
            self._frames = np.zeros(4 * len(frames), FRAME)
        return self._frames[: _sign(frames, self.links, self._places, self._frames)]


@entry(Array(FRAME), Array(LINK), Array(_PLACE), Array(FRAME), returns=1)
def _sign(frames, links, places, signed):
    count = 0
    for index in range(len(frames)):
        frame = frames[index]
        signed[count] = frame
        count += 1
        place = places[frame.can_id & 2047]
        if place.link < 0 or place.which < 0 or not links[place.link].keyed:
            continue
        link = links[place.link]
        payloads = link.payloads[place.which]
        payloads[place.position] = frame.data
        # The set is complete when all of its payloads have the same Counter.
        complete = True
        for position in range(link.sizes[place.which]):
            complete = complete and counter_of(payloads[position]) == counter_of(frame.data)
        if complete:
            count = _append(link, place.which, frame.time_ns, payloads[0], payloads[1], signed, count)
            payloads[:] = np.uint64(_NO_PAYLOAD)
    return count


@njit
def _append(link, which, time_ns, first, second, signed, count):
    """Append the frames that follow a set; returns the new count."""
    if link.message == LAST_MESSAGE:
        if link.reset == LAST_RESET:
            return count
        link.reset += 1
        link.message = 0
        counter = link.reset % COUNTER_MODULO
        data = protect(
            link.freshness_id, np.uint64(link.trip) << np.uint64(16) | np.uint64(link.reset) << np.uint64(40), counter, 0
        )
        count = put(signed, count, time_ns, link.freshness_id, data, 0)
        count = _append_authentication(link, FRESHNESS_SET, time_ns, data, data, signed, count)
    link.message += 1
    return _append_authentication(link, which, time_ns, first, second, signed, count)


@njit
def _append_authentication(link, number, time_ns, first, second, signed, count):
    tag = _authenticator(link, number, first, second, link.trip, link.reset, link.message)
    payload = np.uint64(number << 16 | link.message << 20) | np.uint64(tag) << np.uint64(28)
    data = protect(link.authentication_id, payload, counter_of(first), 0)
    return put(signed, count, time_ns, link.authentication_id, data, 0)


class Verifier:
    """Passes only authentic frames of ``links`` on, before `receive` looks at their counters and times; every frame of one
    without a key is refused. ``keys`` of 16 bytes and ``last``, (trip, reset) received, after which freshness values are
    accepted, by the links' names.

    The verifier holds a frame until the authentication of its set arrives. It then passes the frame on with the arrival time
    of the authentication, because only from then on the frame can be used. A frame without authentication in time, and a frame
    whose set was completed by another frame of the same Counter, are passed on marked UNAUTHENTIC; `receive` refuses them. The
    result depends only on the frames and their order, so a recorded log gives the same result as the bus."""

    def __init__(self, links: Iterable[Link], keys: Mapping[str, bytes], last: Mapping[str, tuple[int, int]]):
        links = list(links)
        self._names = [link.name for link in links]
        self.links: np.ndarray  #: their LINK records, shape (links,)
        self.links, self._places = _new_links(links, keys)
        for name, record in zip(self._names, self.links, strict=True):
            record["trip"], record["reset"] = last.get(name, (0, 0))
        self._most_held = len(links) * (_SETS + 1) * _MESSAGES * _MOST_HELD
        self._known = np.zeros(self._most_held + 256, FRAME)
        # Compile now, not when the first frame is waiting.
        self.verify(self._known[:0])

    def last(self) -> dict[str, tuple[int, int]]:
        """(trip, reset) last received, by the links' names."""
        pairs = zip(self.links["trip"].tolist(), self.links["reset"].tolist(), strict=True)
        return dict(zip(self._names, pairs, strict=True))

    def verify(self, frames: np.ndarray) -> np.ndarray:
        """The frames (FRAME array) to pass on now: of ``frames``, in order of arrival, and of those held before."""
        if len(frames) + self._most_held > len(self._known):
            self._known = np.zeros(len(frames) + self._most_held, FRAME)
        return self._known[: _verify(frames, self.links, self._places, self._known)].copy()


@entry(Array(FRAME), Array(LINK), Array(_PLACE), Array(FRAME), returns=1)
def _verify(frames, links, places, known):
    count = 0
    for index in range(len(frames)):
        frame = frames[index]
        place = places[frame.can_id & 2047]
        # `receive` refuses what is not a classic data frame of eight bytes.
        if place.link < 0 or frame.flags != 0 or frame.length != 8 or frame.can_id > 2047:
            known[count] = frame
            count += 1
        elif place.which < 0:
            count = _authenticate(links[place.link], frame.time_ns, frame.data, known, count)
        else:
            count = _hold(links[place.link], place.which, place.position, frame, known, count)
    return count


@njit
def _hold(link, which, position, frame, known, count):
    """Let a frame wait, and refuse those before it that are too old or too many."""
    held, waiting = link.held[which, position], link.waiting[which, position]
    gone = 0
    while gone < waiting and (waiting - gone >= _MOST_HELD or frame.time_ns - held[gone].time_ns > _HELD_NS):
        count = put(known, count, frame.time_ns, held[gone].can_id, held[gone].data, UNAUTHENTIC)
        gone += 1
    for row in range(gone, waiting):
        held[row - gone] = held[row]
    held[waiting - gone] = frame
    link.waiting[which, position] = waiting - gone + 1
    return count


@njit
def _authenticate(link, time_ns, data, known, count):
    """Pass on the frames that an authentication frame proves authentic, or refuse it."""
    number = np.int64(data >> np.uint64(16) & np.uint64(15))
    which = _SETS if number == FRESHNESS_SET else number
    genuine = _find_genuine(link, number, time_ns, data) if number < _SETS or number == FRESHNESS_SET else _NONE
    if genuine == _NONE:
        return put(known, count, time_ns, link.first_id, np.uint64(0), UNAUTHENTIC)
    if which < _SETS:
        for position in range(link.sizes[which]):
            frame = link.held[which, position, genuine >> 8 * position & 0xFF]
            count = put(known, count, time_ns, frame.can_id, frame.data, 0)
    for position in range(link.sizes[which]):
        held, left = link.held[which, position], 0
        for row in range(link.waiting[which, position]):
            if counter_of(held[row].data) != counter_of(data):
                held[left] = held[row]
                left += 1
            elif row != genuine >> 8 * position & 0xFF:
                count = put(known, count, time_ns, held[row].can_id, held[row].data, UNAUTHENTIC)
        link.waiting[which, position] = left
    return count


@njit
def _find_genuine(link, number, time_ns, data):
    """Which of the frames that are held ``data`` authenticates: the row of the set's first message, plus 256 times that of its
    second; _NONE if none. Advances the link's freshness."""
    message = np.int64(data >> np.uint64(20) & np.uint64(LAST_MESSAGE))
    freshness_alone = number == FRESHNESS_SET
    if not link.keyed or freshness_alone != (message == 0) or not (freshness_alone or link.in_step):
        return _NONE
    if abs(time_ns - link.since_ns) >= CYCLE_NS:
        link.tries, link.since_ns = 0, time_ns
    which = _SETS if freshness_alone else number
    # A message counter that is not larger than the last one belongs to the next reset, whose freshness frame was lost.
    trip, reset = link.trip, link.reset + (message <= link.message)
    pair = link.sizes[which] == 2
    # The newest first: the frames of this set arrived just before their authentication.
    for row in range(link.waiting[which, 0] - 1, -1, -1):
        first = link.held[which, 0, row].data
        if counter_of(first) != counter_of(data):
            continue
        if freshness_alone:
            trip = np.int64(first >> np.uint64(16) & np.uint64(LAST_TRIP))
            reset = np.int64(first >> np.uint64(40))
            if trip < link.trip or (trip == link.trip and reset <= link.reset):
                continue
        for other in range(link.waiting[which, 1] - 1 if pair else 0, -1, -1):
            second = link.held[which, 1, other].data if pair else first
            if counter_of(second) != counter_of(data):
                continue
            if link.tries == _MOST_TRIES or reset > LAST_RESET:
                return _NONE
            link.tries += 1
            if _authenticator(link, number, first, second, trip, reset, message) == np.int64(data >> np.uint64(28)):
                link.trip, link.reset, link.message, link.in_step = trip, reset, message, True
                return row | other << 8
    return _NONE
