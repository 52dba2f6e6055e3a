"""Secure onboard communication: proves who sent a message, and that it is not an old one played back.

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

The CMAC is passed in; this module uses neither keys nor a cryptographic library.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from struct import Struct
from typing import NamedTuple

import numpy as np

from emb_daemon.errors import InputErrors
from emb_daemon.jit import Array, entry
from emb_daemon.resources import resource
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.e2e import COUNTER_MODULO, crc
from emb_daemon.wire.frames import FRAME, UNAUTHENTIC
from emb_daemon.wire.layout import CORNERS, OPTIONAL, load_database

#: The 16 bytes of a message's AES-128-CMAC, under one sender's key.
Mac = Callable[[bytes], bytes]

#: Number of the set that consists of the freshness frame alone.
FRESHNESS_SET = 15
#: The largest message, trip and reset counters. One value of the reset counter lasts 0.7 s of a corner's frames. A trip can
#: therefore last 130 days; after that nothing is authenticated until the next start.
LAST_MESSAGE, LAST_TRIP, LAST_RESET = 0xFF, 0xFF_FFFF, 0xFF_FFFF
_TAG_BITS = 36
#: Payloads of a set, as on the wire.
_ONE, _TWO = Struct("<Q"), Struct("<QQ")
#: A Counter that no message has.
_NO_PAYLOAD = 0xF00
#: Flag of a frame to be sent whose CRC is not yet computed.
_BARE = 255
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
    CAN ids of the messages of each set.
    """

    name: str
    corner: str
    authentication_id: int
    freshness_id: int
    sets: tuple[tuple[int, ...], ...]


def load_links(path: Path | None = None, corners: Iterable[str] = CORNERS) -> tuple[list[Link], list[Link]]:
    """(links that the daemon receives, links that it sends) of ``corners`` and the vehicle, by a DBC or the shipped one.

    Raises:
        InputErrors: the DBC lacks messages or has their fields elsewhere; every fault is listed.
    """
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


def freshness_value(trip: int, reset: int, message: int) -> bytes:
    """The 56 bits that are different for each authentication under one key."""
    return (trip << 32 | reset << 8 | message).to_bytes(7, "big")


def authenticator(mac: Mac, data_id: int, payloads: Sequence[int], freshness: bytes) -> int:
    """The first 36 bits of the CMAC, as a whole number; payloads are those of FRAME."""
    octets = _ONE.pack(*payloads) if len(payloads) == 1 else _TWO.pack(*payloads)
    return int.from_bytes(mac(b"".join((data_id.to_bytes(2, "big"), octets, freshness)))[:5], "big") >> 4


def _data_id(link: Link, which: int) -> int:
    return link.authentication_id | which << 11


@entry(Array(FRAME), int)
def _protect(frames, count):
    """Fill in the CRCs of those of ``frames[:count]`` that are marked as lacking it."""
    for index in range(count):
        frame = frames[index]
        if frame.flags == _BARE:
            frame.flags = 0
            frame.data |= np.uint64(crc(frame.can_id, frame.data))


class _Outgoing:
    """Sender's side of one link: its counters, and payloads of sets that are not yet complete."""

    def __init__(self, link: Link, mac: Mac):
        self.link, self.mac = link, mac
        self.reset, self.message = 0, LAST_MESSAGE
        self.payloads = [[_NO_PAYLOAD] * len(ids) for ids in link.sets]


class Signer:
    """Puts authentication frames among the frames that a process sends.

    Args:
        links: those of which the process is the sender; messages of a link without a key are sent without authentication.
        macs: by the links' names.
        trip: trip counter of the process, one more than at its last start.
    """

    def __init__(self, links: Iterable[Link], macs: Mapping[str, Mac], trip: int):
        self._trip = trip
        self._places = {}
        for link in links:
            if link.name in macs:
                outgoing = _Outgoing(link, macs[link.name])
                for which, ids in enumerate(link.sets):
                    self._places |= {can_id: (outgoing, which, position) for position, can_id in enumerate(ids)}
        self._frames, self._freshness = np.zeros(64, FRAME), np.zeros(1, FRAME)
        # Compile now, not when the first frame is waiting.
        _protect(self._frames, 0)

    def sign(self, frames: np.ndarray) -> np.ndarray:
        """``frames`` (FRAME array in sending order) with each set's authentication behind it; valid until the next call."""
        if 4 * len(frames) > len(self._frames):
            self._frames = np.zeros(4 * len(frames), FRAME)
        signed: list[tuple] = []
        for row in frames.tolist():
            signed.append(row)
            place = self._places.get(row[2])
            if place is None:
                continue
            outgoing, which, position = place
            payloads = outgoing.payloads[which]
            payloads[position] = row[1]
            # The set is complete when all of its payloads have the same Counter.
            if len(payloads) == 1 or not any((payload ^ row[1]) & 0xF00 for payload in payloads):
                self._authenticate(outgoing, which, row[0], payloads, signed)
                payloads[:] = [_NO_PAYLOAD] * len(payloads)
        self._frames[: len(signed)] = signed
        _protect(self._frames, len(signed))
        return self._frames[: len(signed)]

    def _authenticate(self, outgoing: _Outgoing, which: int, time_ns: int, payloads: list[int], signed: list[tuple]) -> None:
        """Add the frames that follow a set; `sign` fills in the CRC of authentication frames."""
        if outgoing.message == LAST_MESSAGE:
            if outgoing.reset == LAST_RESET:
                return
            outgoing.reset += 1
            outgoing.message = 0
            data = outgoing.reset % COUNTER_MODULO << 8 | self._trip << 16 | outgoing.reset << 40
            self._freshness[0] = (time_ns, data, outgoing.link.freshness_id, 8, _BARE)
            # Its CRC is needed now, because it is part of what is authenticated.
            _protect(self._freshness, 1)
            signed += self._freshness.tolist()
            self._append(outgoing, FRESHNESS_SET, time_ns, [signed[-1][1]], signed)
        outgoing.message += 1
        self._append(outgoing, which, time_ns, payloads, signed)

    def _append(self, outgoing: _Outgoing, which: int, time_ns: int, payloads: list[int], signed: list[tuple]) -> None:
        link, freshness = outgoing.link, freshness_value(self._trip, outgoing.reset, outgoing.message)
        tag = authenticator(outgoing.mac, _data_id(link, which), payloads, freshness)
        data = payloads[0] & 0xF00 | which << 16 | outgoing.message << 20 | tag << 28
        signed.append((time_ns, data, link.authentication_id, 8, _BARE))


class _Incoming:
    """Receiver's side of one link: the last authentic freshness value, and the frames that wait for their authentication, as
    rows of FRAME by set and by place in the set."""

    def __init__(self, link: Link, mac: Mac | None, last: tuple[int, int]):
        self.link, self.mac = link, mac
        self.trip, self.reset = last
        self.message = LAST_MESSAGE
        self.in_step = False
        self.held = {which: [[] for _ in ids] for which, ids in enumerate(link.sets)}
        self.held[FRESHNESS_SET] = [[]]
        self.tries, self.since_ns = 0, 0


class Verifier:
    """Passes only authentic frames on, before `receive` looks at their counters and times.

    The verifier holds a frame until the authentication of its set arrives. It then passes the frame on with the arrival time
    of the authentication, because only from then on the frame can be used. A frame without authentication in time, and a frame
    whose set was completed by another frame of the same Counter, are passed on marked UNAUTHENTIC; `receive` refuses them. The
    result depends only on the frames and their order, so a recorded log gives the same result as the bus.

    Args:
        links: those of which the process is the receiver; every frame of a link without a key is refused.
        macs: by the links' names.
        last: (trip, reset) by the links' names: the last ones received, so that only later freshness values are accepted.
    """

    def __init__(self, links: Iterable[Link], macs: Mapping[str, Mac], last: Mapping[str, tuple[int, int]]):
        self._incoming = [_Incoming(link, macs.get(link.name), last.get(link.name, (0, 0))) for link in links]
        #: By CAN id: the link, and the place where its frames are held; authentication frames are not held.
        self._places: dict[int, tuple[_Incoming, list[tuple] | None]] = {}
        for incoming in self._incoming:
            link = incoming.link
            for which, ids in [*enumerate(link.sets), (FRESHNESS_SET, (link.freshness_id,))]:
                self._places |= {can_id: (incoming, held) for can_id, held in zip(ids, incoming.held[which], strict=True)}
            self._places[link.authentication_id] = incoming, None

    def last(self) -> dict[str, tuple[int, int]]:
        """(trip, reset) last received, by the links' names."""
        return {incoming.link.name: (incoming.trip, incoming.reset) for incoming in self._incoming}

    def verify(self, frames: np.ndarray) -> np.ndarray:
        """The frames (FRAME array) to pass on now: of ``frames``, in order of arrival, and of those held before."""
        known: list[tuple] = []
        for row in frames.tolist():
            # `receive` refuses what is not a classic data frame of eight bytes.
            place = self._places.get(row[2]) if row[4] == 0 and row[3] == 8 else None
            if place is None:
                known.append(row)
                continue
            incoming, held = place
            if held is None:
                _judge(incoming, row, known)
                continue
            while held and (len(held) >= _MOST_HELD or row[0] - held[0][0] > _HELD_NS):
                known.append(_refuse(held.pop(0), row[0]))
            held.append(row)
        return np.array(known, FRAME)


def _judge(incoming: _Incoming, row: tuple, known: list[tuple]) -> None:
    """Pass on the frames that an authentication frame proves authentic, or refuse it."""
    time_ns, data = row[:2]
    slots = incoming.held.get(data >> 16 & 15)
    genuine = _authentic(incoming, slots, data, time_ns) if slots else None
    if genuine is None:
        known.append((time_ns, 0, incoming.link.sets[0][0], 8, UNAUTHENTIC))
        return
    if data >> 16 & 15 != FRESHNESS_SET:
        known += [(time_ns, frame[1], frame[2], 8, 0) for frame in genuine]
    for slot, frame in zip(slots, genuine, strict=True):
        if len(slot) == 1:
            slot.clear()
            continue
        known += [_refuse(held, time_ns) for held in slot if held is not frame and not (held[1] ^ data) & 0xF00]
        slot[:] = [held for held in slot if (held[1] ^ data) & 0xF00]


def _authentic(incoming: _Incoming, slots: list[list[tuple]], data: int, time_ns: int) -> Sequence[tuple] | None:
    """The held frames that ``data`` authenticates, one for each place of the set; advances the link's freshness."""
    which, message = data >> 16 & 15, data >> 20 & LAST_MESSAGE
    freshness_alone = which == FRESHNESS_SET
    if incoming.mac is None or freshness_alone != (message == 0) or not (freshness_alone or incoming.in_step):
        return None
    if abs(time_ns - incoming.since_ns) >= CYCLE_NS:
        incoming.tries, incoming.since_ns = 0, time_ns
    # A message counter that is not larger than the last one belongs to the next reset, whose freshness frame was lost.
    trip, reset = incoming.trip, incoming.reset + (message <= incoming.message)
    choices = [[slot[0] for slot in slots if len(slot) == 1]]
    if len(choices[0]) != len(slots):
        # The newest first: the frames of this set arrived just before their authentication.
        choices = product(*[[held for held in slot[::-1] if not (held[1] ^ data) & 0xF00] for slot in slots])
    for frames in choices:
        if freshness_alone:
            trip, reset = frames[0][1] >> 16 & LAST_TRIP, frames[0][1] >> 40
            if (trip, reset) <= (incoming.trip, incoming.reset):
                continue
        if incoming.tries == _MOST_TRIES or reset > LAST_RESET:
            return None
        incoming.tries += 1
        freshness = freshness_value(trip, reset, message)
        tag = authenticator(incoming.mac, _data_id(incoming.link, which), [frame[1] for frame in frames], freshness)
        if tag == data >> 28:
            incoming.trip, incoming.reset, incoming.message, incoming.in_step = trip, reset, message, True
            return frames
    return None


def _refuse(row: tuple, time_ns: int) -> tuple:
    return (time_ns, *row[1:4], UNAUTHENTIC)
