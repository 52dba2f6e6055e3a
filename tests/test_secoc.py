"""Authenticated frames: whose codecs agree with ours, that genuine ones are all taken and others never, and what a receiver
needs to be in step."""

import os
import subprocess
import sys
import threading
import time
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import cantools
import numpy as np
import pytest
import wirekit
from hypothesis import given
from hypothesis import strategies as st
from test_daemon import Running, answers
from test_pipeline import _sliding

from emb_daemon.calibration.configuration import Setup
from emb_daemon.errors import InputError, Unavailable
from emb_daemon.logs.write import write_frames
from emb_daemon.pipeline import Pipeline
from emb_daemon.resources import resource
from emb_daemon.runtime import secured
from emb_daemon.runtime.secured import Authentication, Freshness, FreshnessFile, SecuredBus
from emb_daemon.wire import contract
from emb_daemon.wire.cmac import KEY, cmac, new_key
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.frames import FRAME, UNAUTHENTIC
from emb_daemon.wire.keys import key_file, load_keys
from emb_daemon.wire.secoc import FRESHNESS_SET, LAST_MESSAGE, LAST_RESET, Signer, Verifier, load_links
from studies import attacks

RECEIVED, SENT = load_links(corners=("FL",))
KEYS = {link.name: bytes([number] * 16) for number, link in enumerate((*RECEIVED, *SENT), 1)}
AUTH, FRESHNESS, VEHICLE_AUTH = 0x130, 0x140, 0x183
_START_NS = 1_000_000_000


def plain_cmac(key: bytes, message: bytes) -> bytes:
    """RFC 4493, section 2.4, step by step, over one block of AES at a time."""
    from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes

    encrypt = Cipher(algorithms.AES(key), modes.ECB()).encryptor().update

    def doubled(block: bytes) -> bytes:
        number = int.from_bytes(block) << 1
        return ((number ^ 0x87) & (1 << 128) - 1 if number >> 128 else number).to_bytes(16)

    first = doubled(encrypt(bytes(16)))
    blocks = [message[at : at + 16] for at in range(0, len(message), 16)] or [b""]
    whole = len(blocks[-1]) == 16
    last, mask = (blocks[-1], first) if whole else ((blocks[-1] + b"\x80").ljust(16, b"\0"), doubled(first))
    state = bytes(16)
    for block in (*blocks[:-1], bytes(a ^ b for a, b in zip(last, mask, strict=True))):
        state = encrypt(bytes(a ^ b for a, b in zip(state, block, strict=True)))
    return state


@pytest.mark.parametrize(
    ("length", "tag"),
    [
        (0, "bb1d6929e95937287fa37d129b756746"),
        (16, "070a16b46b4d4144f79bdd9dd04a287c"),
        (40, "dfa66747de9ae63030ca32611497c827"),
        (64, "51f0bebf7e3b9d92fc49741779363cfe"),
    ],
)
def test_vectors_of_rfc_4493(length, tag):
    key = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")
    message = bytes.fromhex(
        "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51"
        "30c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710"
    )[:length]
    assert code_of(key, message).hex() == plain_cmac(key, message).hex() == tag


@given(st.binary(min_size=16, max_size=16), st.binary(max_size=40))
def test_any_message_has_the_cmac_of_the_rfc(key, message):
    assert code_of(key, message) == plain_cmac(key, message)


def test_every_length_has_the_cmac_of_the_rfc():
    for length in range(66):
        key, message = bytes(range(length, length + 16)), bytes(range(100, 100 + length))
        assert code_of(key, message) == plain_cmac(key, message), length


def code_of(key: bytes, message: bytes) -> bytes:
    keys, code = np.zeros(1, KEY), np.zeros(16, np.uint8)
    new_key(key, keys[0])
    cmac(keys[0], np.frombuffer(message + bytes(1), np.uint8).copy(), len(message), code)
    return code.tobytes()


@st.composite
def authenticated(draw):
    """Any set of FL's sender: its number, its payloads' octets, its freshness value of 56 bits, its authentication frame."""
    which, *ids = draw(st.sampled_from([(0, 0x100, 0x110), (1, 0x120), (2, 0x0F0), (FRESHNESS_SET, FRESHNESS)]))
    trip, reset, message = draw(st.integers(0, 2**24 - 1)), draw(st.integers(0, 2**24 - 2)), draw(st.integers(0, 254))
    if which == FRESHNESS_SET:
        # It has a content of its own, and is sent where the message counter is at its end, before another set.
        frames, reset_after, message_after = answer_to(trip, reset, 255, [(0x120, 0)]), reset + 1, 0
        can_id, data = (int(frames[1][name]) for name in ("can_id", "data"))
        assert (can_id, data >> 16 & 2**24 - 1, data >> 40) == (FRESHNESS, trip, reset + 1)
        octets, tag = data.to_bytes(8, "little"), frames[2]
    else:
        # One sample's messages have the same Counter.
        each = [draw(st.binary(min_size=1, max_size=1)) + b"\x05" + draw(st.binary(min_size=6, max_size=6)) for _ in ids]
        octets, payloads = b"".join(each), [int.from_bytes(one, "little") for one in each]
        frames, reset_after, message_after = (
            answer_to(trip, reset, message, zip(ids, payloads, strict=True)), reset, message + 1,
        )  # fmt: skip
        tag = frames[-1]
    assert (tag["can_id"], tag["length"], int(tag["data"]) >> 20 & 0xFF) == (AUTH, 8, message_after)
    return which, octets, trip << 32 | reset_after << 8 | message_after, tag


@given(authenticated())
def test_authenticator_and_its_place_are_those_of_cantools(secured_set):
    """cantools puts freshness and authenticator of a secured message behind its payload, most significant bit first."""
    from cantools.autosar.secoc import apply_authenticator, verify_authenticator
    from cantools.database.can.formats.arxml.message_specifics import AutosarMessageSpecifics
    from cantools.database.can.formats.arxml.secoc_properties import AutosarSecOCProperties

    which, octets, freshness, tag = secured_set
    properties = AutosarSecOCProperties(
        auth_algorithm_name=None, freshness_algorithm_name=None, data_id=AUTH | which << 11, payload_length=len(octets),
        freshness_bit_length=56, freshness_tx_bit_length=8, auth_tx_bit_length=36,
    )  # fmt: skip
    specifics = AutosarMessageSpecifics()
    specifics._secoc = properties
    theirs = cantools.database.can.Message(AUTH, "Secured", len(octets) + 6, [], autosar_specifics=specifics)
    key = KEYS["EMB_FL_Auth"]
    secured_message = apply_authenticator(octets + bytes(6), theirs, lambda _m, data, _f: plain_cmac(key, data), freshness)
    assert verify_authenticator(secured_message, theirs, lambda _m, data, _f: plain_cmac(key, data), freshness)
    tail = int.from_bytes(secured_message[-6:]) >> 4
    assert tail >> 36 == int(tag["data"]) >> 20 & 0xFF
    assert tail & (1 << 36) - 1 == int(tag["data"]) >> 28


@given(authenticated())
def test_scapy_has_the_same_code_of_a_set(secured_set):
    """With its own AES and CMAC; its messages carry eight bits of freshness and 24 of the code, which it also verifies."""
    from scapy.contrib.automotive.autosar.secoc_pdu import SecOC_PDU
    from scapy.packet import Raw

    which, octets, freshness, tag = secured_set

    class Secured(SecOC_PDU):
        def get_secoc_payload(self):
            return (AUTH | which << 11).to_bytes(2) + bytes(self.pdu_payload)

        def get_secoc_key(self):
            return KEYS["EMB_FL_Auth"]

        def get_secoc_freshness_value(self):
            return freshness.to_bytes(7)

    message = Secured(pdu_id=AUTH, pdu_payload=Raw(octets))
    assert int.from_bytes(message.get_message_authentication_code()) >> 92 == int(tag["data"]) >> 28
    message.secoc_authenticate()
    assert message.tfv == int(tag["data"]) >> 20 & 0xFF and int.from_bytes(message.tmac) == int(tag["data"]) >> 40
    heard = Secured(bytes(message))
    assert heard.secoc_verify()
    heard.pdu_payload = Raw(bytes([octets[0] ^ 1]) + octets[1:])
    assert not heard.secoc_verify()


def answer_to(trip, reset, message, payloads):
    """What a sender with these counters sends for frames of (CAN id, payload)."""
    signer = Signer(RECEIVED, KEYS, trip)
    signer.links[["reset", "message"]][0] = reset, message
    frames = np.concatenate([wirekit.record(0, can_id, payload.to_bytes(8, "little")) for can_id, payload in payloads])
    return signer.sign(frames)


def test_check_value_of_the_documentation():
    page = (Path(__file__).parent.parent / "docs" / "wire.md").read_text(encoding="utf-8")
    signer = Signer(RECEIVED, {"EMB_FL_Auth": bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")}, 1)
    frames = signer.sign(np.concatenate([wirekit.record(0, can_id, bytes(8)) for can_id in (0x100, 0x110)]))
    assert int(frames[-1]["data"]) >> 28 == 0xB7684ADB3
    assert all(word in page for word in ("0xB7684ADB3", "00000100000101"))


@cache
def drive():
    """Frames of FL's brake and its car: four seconds, never at rest."""
    return wirekit.merged(*_sliding(1000, start_ns=_START_NS))


@cache
def signed(trip=1):
    return Signer(RECEIVED, KEYS, trip).sign(drive()).copy()


def verifier(last=None):
    return Verifier(RECEIVED, KEYS, last or {})


def fresh(frames):
    """Whether the link is in step, and how many frames were refused."""
    return int(np.sum(frames["flags"] == 0)), int(np.sum(frames["flags"] == UNAUTHENTIC))


def new_pipeline():
    return Pipeline(Setup(resource("config/emb.yaml")).parameters, ("FL",), capacity=1 << 13)


def estimates_of(frames, pipeline=None):
    pipeline = pipeline or new_pipeline()
    pipeline.begin(_START_NS)
    _, count = pipeline.collect(frames, predictions=False)
    pipeline.answer(count)
    return pipeline.estimates[:count].copy()


NUMBERS = ("cycle", "counter", "force", "sigma", "stiffness_force", "torque_force", "contact_angle", "disc", "mean", "mode")


def test_authentication_frames_decode_by_the_dbc():
    """By the DBC and other people's codecs: freshness first, then each set's authentication, with its Counter."""
    frames = signed()
    decoded = [wirekit.decode(frame) for frame in frames[np.isin(frames["can_id"], [AUTH, FRESHNESS])][:300]]
    (first, freshness), (second, its_authentication), (third, thermocouple) = decoded[:3]
    assert (first, second, third) == ("EMB_FL_Freshness", "EMB_FL_Auth", "EMB_FL_Auth")
    assert (freshness["TripCounter"], freshness["ResetCounter"]) == (1, 1)
    assert (its_authentication["Set"], its_authentication["Freshness"]) == (FRESHNESS_SET, 0)
    assert (thermocouple["Set"], thermocouple["Freshness"]) == (1, 1)
    assert [signals["Freshness"] for name, signals in decoded[1:257] if name == "EMB_FL_Auth"] == list(range(256))
    assert decoded[257][1]["ResetCounter"] == 2
    announced = [wirekit.decode(frame)[1] for frame in frames[frames["can_id"] == FRESHNESS]]
    expected = [(number % 15, 0, 1, number) for number in range(1, len(announced) + 1)]
    names = ("Counter", "Status", "TripCounter", "ResetCounter")
    assert [tuple(signals[name] for name in names) for signals in announced] == expected
    reset, sets = 1, {0: [0x100, 0x110], 1: [0x120], FRESHNESS_SET: [FRESHNESS]}
    for index in np.flatnonzero(frames["can_id"] == AUTH):
        signals = wirekit.decode(frames[index])[1]
        of_set = [frames[:index][frames["can_id"][:index] == can_id][-1] for can_id in sets[signals["Set"]]]
        assert {wirekit.decode(frame)[1]["Counter"] for frame in of_set} == {signals["Counter"]}
        reset += int(signals["Set"] == FRESHNESS_SET and index > 10)
        payloads = b"".join(int(frame["data"]).to_bytes(8, "little") for frame in of_set)
        covered = (AUTH + 2048 * signals["Set"]).to_bytes(2) + payloads + (1).to_bytes(3) + reset.to_bytes(3)
        tag = plain_cmac(KEYS["EMB_FL_Auth"], covered + signals["Freshness"].to_bytes(1))
        assert int.from_bytes(tag) >> 92 == signals["Authenticator"]


def test_every_genuine_frame_is_taken_and_the_forces_are_the_same_to_the_bit():
    frames = verifier().verify(signed())
    assert fresh(frames) == (len(drive()), 0)
    assert np.array_equal(np.sort(frames["data"]), np.sort(drive()["data"]))
    ours, theirs = estimates_of(frames), estimates_of(drive())
    assert len(ours) == len(theirs) > 900
    for name in NUMBERS:
        assert ours[name].tobytes() == theirs[name].tobytes(), name
    assert np.all(ours["reasons"] & contract.E2E_ERROR == 0)


@given(st.lists(st.integers(0, 2000), max_size=12))
def test_cuts_between_batches_change_nothing(cuts):
    """As ticks cut the bus's frames, and a log does not."""
    frames = signed()[:2000]
    whole, parts = verifier().verify(frames), verifier()
    assert wirekit.same(np.concatenate([parts.verify(part) for part in np.split(frames, sorted(cuts))]), whole)


@pytest.mark.parametrize("name", attacks.FORGERIES)
def test_of_frames_without_the_key_none_is_taken_and_the_forces_stay_the_same_to_the_bit(name):
    """A short form of studies/attacks.py."""
    foreign = attacks.forged(name, signed(), np.random.default_rng(1), KEYS | {"nobody": b"somebody's key !"})
    frames, missing, others = attacks.believed(signed(), foreign, KEYS)
    assert len(foreign) > 500 and (missing, others) == (0, 0)
    ours, theirs = estimates_of(frames), estimates_of(drive())
    for field in NUMBERS[:-1]:
        assert ours[field].tobytes() == theirs[field].tobytes(), field
    assert np.any(ours["reasons"] & contract.E2E_ERROR), "noticed"
    assert np.all(ours["mode"][theirs["mode"] != contract.FAULT] != contract.FAULT), "and no reason not to use the force"


def test_who_silences_the_sender_and_plays_back_its_frames_is_not_believed():
    """The attack that physics alone would have to notice."""
    genuine = signed()
    half = _START_NS + 500 * CYCLE_NS
    before = genuine[genuine["time_ns"] < half]
    again = before.copy()
    again["time_ns"] += half - _START_NS
    frames = verifier().verify(np.concatenate([before, again]))
    assert fresh(frames)[0] == int(np.sum(~np.isin(before["can_id"], [AUTH, FRESHNESS, VEHICLE_AUTH, 0x184])))
    estimates = estimates_of(frames, pipeline := new_pipeline())
    assert len(estimates) <= 500
    count = pipeline.overdue(int(again["time_ns"][-1]))
    pipeline.answer(count)
    assert pipeline.estimates[0]["mode"] == contract.FAULT
    assert pipeline.estimates[0]["reasons"] & contract.E2E_ERROR and pipeline.estimates[0]["reasons"] & contract.RESOLVER_LOST


def without(frames, rows):
    return np.delete(frames, rows)


def of(frames, can_id):
    return np.flatnonzero(frames["can_id"] == can_id)


@pytest.mark.parametrize("lost", [1, 2, 200])
def test_after_lost_authentications_the_next_is_right(lost):
    """However many: within a reset all of the counter is on the wire, and the next reset is told by a counter that does not go
    on, should its freshness frame be lost as well."""
    frames = signed()
    rows = of(frames, AUTH)
    between = [row for row in of(frames, FRESHNESS) if rows[100] < row < rows[100 + lost]]
    taken, _ = fresh(verifier().verify(without(frames, np.concatenate([rows[100 : 100 + lost], between]).astype(int))))
    assert taken >= len(drive()) - 2 * lost - 2


def test_a_lost_freshness_frame_costs_nothing():
    frames = signed()
    taken, refused = fresh(verifier().verify(without(frames, of(frames, FRESHNESS)[1:3])))
    assert taken == len(drive()) and refused == 2, "what authenticates the lost frames is refused, no other"


def test_after_losing_more_than_a_reset_the_next_freshness_frame_is_needed():
    frames = signed()
    silent = (frames["time_ns"] > _START_NS + 100 * CYCLE_NS) & (frames["time_ns"] < _START_NS + 600 * CYCLE_NS)
    heard = verifier().verify(frames[~silent])
    again = heard["time_ns"][
        (heard["time_ns"] > _START_NS + 600 * CYCLE_NS) & (heard["flags"] == 0) & (heard["can_id"] == 0x100)
    ]
    assert (again[0] - _START_NS) / CYCLE_NS < 600 + 256 and np.all(np.diff(again) < 2 * CYCLE_NS)


def test_a_receiver_that_starts_late_is_in_step_with_the_next_freshness_frame():
    frames = signed()[1000:]
    heard = verifier().verify(frames)
    first = heard[(heard["flags"] == 0) & (heard["can_id"] == 0x100)][0]["time_ns"]
    assert first - frames["time_ns"][0] < 256 * CYCLE_NS
    # What had waited before is refused when it is old.
    since = heard[heard["time_ns"] > first + 9 * CYCLE_NS]
    assert not np.any(since["flags"][np.isin(since["can_id"], [0x100, 0x110])])


def test_frames_from_before_a_restart_are_refused_after_it():
    """Of the same trip and of an older one; the next start of the sender is."""
    first = verifier()
    first.verify(signed())
    last = first.last()
    assert last["EMB_FL_Auth"][0] == 1 and last["EMB_FL_Auth"][1] > 4
    assert fresh(verifier(last).verify(signed()))[0] == 0
    assert fresh(verifier({"EMB_FL_Auth": (2, 1), "VEH_Auth": (2, 1)}).verify(signed()))[0] == 0
    assert fresh(verifier(last).verify(signed(trip=2))) == (len(drive()), 0)


def test_the_last_set_comes_no_second_time():
    """Neither at once nor after a pause: its message counter does not go on, and is taken for the next reset's."""
    receiver, last = verifier(), of(signed(), AUTH)[-1]
    heard = receiver.verify(signed()[: last + 1])
    again = signed()[last - 2 : last + 1].copy()
    assert set(again["can_id"]) == {0x100, 0x110, AUTH} and not np.any(heard["flags"][-2:])
    for pause_ns in (100_000, 3_000_000_000):
        again["time_ns"] += pause_ns
        repeated = receiver.verify(again)
        assert not np.any(repeated["flags"] == 0) and np.any(repeated["flags"] == UNAUTHENTIC)


def test_keys_of_other_links_verify_nothing():
    """Each sender has its own: the vehicle's cannot speak for a corner, nor can the daemon's."""
    for name in KEYS:
        if name != "EMB_FL_Auth":
            frames = Signer(RECEIVED, KEYS | {"EMB_FL_Auth": KEYS[name]}, 1).sign(drive()[:2000])
            heard = verifier().verify(frames)
            assert not np.any(np.isin(heard["can_id"][heard["flags"] == 0], [0x100, 0x110, 0x120]))


def test_a_set_counts_whole_or_not_at_all():
    """A current of another sample under the same Counter, a turn ago, makes no pair with a resolver that is authentic."""
    frames = signed().copy()
    currents = of(frames, 0x110)
    frames["data"][currents[315]] = frames["data"][currents[300]]
    heard = verifier().verify(frames)
    assert fresh(heard)[0] == len(drive()) - 2
    assert heard["flags"][heard["can_id"] == 0x100].tolist().count(UNAUTHENTIC) == 2, (
        "the refusal, and the frame when it is old"
    )


@pytest.mark.parametrize("place", [0, 1])
def test_a_rival_is_refused_with_the_genuine_frame_and_the_next_sample_waits(place):
    """Authentication of one sample that comes after the frames of the next: a bus that was held up may turn them round."""
    frames = signed()
    first, second = of(frames, AUTH)[100:102]
    while wirekit.decode(frames[first])[1]["Set"] or wirekit.decode(frames[second])[1]["Set"] or second - first != 3:
        first, second = second, of(frames, AUTH)[np.searchsorted(of(frames, AUTH), second) + 1]
    rival = frames[[first - 2 + place]].copy()
    rival["data"] ^= np.uint64(1 << 40)
    order = [*range(first - 2, first), first + 1, first + 2, first, second]
    judge = verifier()
    judge.verify(frames[: first - 2])
    heard = judge.verify(np.concatenate([rival, frames[order]]))
    heard = heard[np.isin(heard["can_id"], [0x100, 0x110])]
    assert heard["flags"].tolist() == [0, 0, UNAUTHENTIC, 0, 0]
    assert (
        heard["data"].tolist()
        == frames["data"][[first - 2, first - 1]].tolist()
        + rival["data"].tolist()
        + frames["data"][[first + 1, first + 2]].tolist()
    )


def test_without_freshness_or_key_nothing_is_accepted():
    """Not even what would follow the last reset that was kept: that may have been heard before the restart."""
    late = signed()[of(signed(), FRESHNESS)[1] + 2 : of(signed(), FRESHNESS)[2]]
    corner = late[np.isin(late["can_id"], [0x100, 0x110, 0x120, AUTH])]
    assert fresh(verifier({"EMB_FL_Auth": (1, 1)}).verify(corner))[0] == 0
    assert fresh(Verifier(RECEIVED, {}, {}).verify(signed()))[0] == 0


def test_a_flood_of_authentication_frames_costs_a_bounded_number_of_tries():
    """32 in a cycle: then the right one is not believed either, but again in the next cycle."""
    last = of(signed(), AUTH)[100]
    known = signed()[:last]
    known = known[~np.isin(known["can_id"], [0x120, 0x180, 0x181, 0x182])]
    guesses = np.repeat(signed()[last : last + 1], 33)
    guesses["data"] ^= np.arange(1, 34, dtype=np.uint64) << np.uint64(28)
    right = guesses[:1].copy()
    right["data"] = signed()["data"][last]
    for count, later_ns, expected in ((31, 0, 0), (32, 0, UNAUTHENTIC), (32, CYCLE_NS, 0)):
        judge = verifier()
        judge.verify(known)
        refused = judge.verify(guesses[:count])
        right["time_ns"] = signed()["time_ns"][last] + later_ns
        heard = judge.verify(right)
        assert np.all(refused["flags"] == UNAUTHENTIC) and len(refused) == count
        assert set(heard["flags"].tolist()) == {expected}, (count, later_ns)


def test_an_authentication_is_tried_on_each_pair_that_waits_and_on_no_other():
    """With the Counter that places without a frame have."""
    judge, last = verifier(), of(signed(), AUTH)[100]
    judge.verify(signed()[: last + 1])
    waiting = np.repeat(signed()[last - 2 : last + 1], (3, 2, 1))
    assert waiting["can_id"].tolist() == [0x100] * 3 + [0x110] * 2 + [AUTH]
    waiting["time_ns"] += CYCLE_NS
    waiting["data"] = (np.arange(6, dtype=np.uint64) + np.uint64(1)) << np.uint64(56)
    waiting["data"][-1] |= np.uint64(250 << 20)
    assert set(judge.verify(waiting)["flags"].tolist()) == {UNAUTHENTIC} and judge.links["tries"][0] == 6


def test_more_than_eight_frames_that_wait_are_refused_the_oldest_first():
    judge = verifier()
    judge.verify(signed()[: of(signed(), AUTH)[100] + 1])
    burst = np.zeros(3000, FRAME)
    burst["length"], burst["time_ns"] = 8, signed()["time_ns"][of(signed(), AUTH)[100]] + CYCLE_NS + np.arange(3000)
    burst["can_id"] = np.tile([0x100, 0x110, AUTH], 1000)
    burst["data"] = np.where(burst["can_id"] == AUTH, 200 << 20, 0) + (np.arange(3000) << 30)
    heard = judge.verify(burst)
    assert fresh(heard) == (0, 1000 + 2 * (1000 - 8))
    refused = heard["data"][heard["can_id"] == 0x110]
    assert np.array_equal(refused, burst["data"][burst["can_id"] == 0x110][:-8])


def test_frames_of_other_kinds_pass_to_be_refused_for_that():
    odd = np.concatenate(
        [wirekit.record(1, 0x100, bytes(7)), wirekit.record(2, 0x100, bytes(8), flags=1), wirekit.record(3, 0x555, b"")]
    )
    assert wirekit.same(verifier().verify(odd), odd)


@pytest.mark.parametrize("missing", ["EMB_FL_Auth", "EMB_FL_EstimateAuth"])
def test_without_a_key_the_status_is_fault(missing, tmp_path):
    authentication = Authentication(RECEIVED, SENT, {k: v for k, v in KEYS.items() if k != missing}, Freshness(trip=1))
    assert [link.name for link in authentication.keyless] == [missing]
    pipeline = new_pipeline()
    pipeline.distrust({link.corner for link in authentication.keyless})
    pipeline.begin(_START_NS)
    _, count = pipeline.consume(authentication.verify(signed()))
    sent = authentication.sign(pipeline.broadcast(count))
    assert count and np.all(pipeline.estimates["mode"][:count] == contract.FAULT)
    assert np.all(pipeline.estimates["reasons"][:count] & contract.E2E_ERROR)
    status = {wirekit.decode(frame)[1]["Status"] for frame in sent if frame["can_id"] == 0x200}
    assert status == {contract.STATUS_FAULT}
    assert np.any(sent["can_id"] == 0x240) == (missing != "EMB_FL_EstimateAuth")


def test_signed_frames_are_accepted_by_a_receiver_with_the_key(tmp_path):
    daemon = opened(tmp_path)
    pipeline = new_pipeline()
    pipeline.begin(_START_NS)
    _, count = pipeline.consume(daemon.verify(signed()))
    plain = pipeline.broadcast(count).copy()
    heard = Verifier(SENT, KEYS, {}).verify(daemon.sign(plain))
    assert fresh(heard) == (len(plain), 0) and np.array_equal(heard["data"], plain["data"])
    assert {0x200, 0x210, 0x220, 0x230} <= set(heard["can_id"].tolist())


def opened(folder):
    file = FreshnessFile(folder)
    return Authentication(RECEIVED, SENT, KEYS, file.begin_trip(), file)


def test_a_sender_whose_counters_are_used_up_authenticates_nothing_more():
    """A freshness value that came twice could be played back."""
    payloads = [(RECEIVED[0].sets[1][0], 0x1200)]
    for reset, frames in ((LAST_RESET - 1, 4), (LAST_RESET, 1)):
        assert len(answer_to(1, reset, LAST_MESSAGE, payloads)) == frames


class TestFreshnessFile:
    def test_a_trip_counter_is_used_once(self, tmp_path):
        assert [FreshnessFile(tmp_path / "state").begin_trip().trip for _ in range(3)] == [1, 2, 3]

    def test_after_a_restart_stored_freshness_refuses_played_back_frames(self, tmp_path):
        first = opened(tmp_path)
        assert not first.stale(), "nothing was heard yet"
        first.verify(signed())
        assert first.stale()
        first.close()
        assert not first.stale()
        second = opened(tmp_path)
        assert fresh(second.verify(signed()))[0] == 0 and fresh(second.verify(signed(trip=2)))[0] == len(drive())

    def test_freshness_of_a_corner_that_is_not_configured_now_is_kept(self, tmp_path):
        file = FreshnessFile(tmp_path)
        file.keep(Freshness(heard={"EMB_RR_Auth": (7, 9)}))
        opened(tmp_path).close()
        assert "EMB_RR_Auth" not in [link.name for link in RECEIVED] and file.load().heard["EMB_RR_Auth"] == (7, 9)

    def test_received_freshness_is_stored_while_the_bus_runs(self, tmp_path):
        frames, bus = signed(), SimpleNamespace()
        authentication = opened(tmp_path)
        secured_bus = SecuredBus(bus, authentication)
        bus.drain = lambda: frames[:4095]
        secured_bus.drain()
        assert authentication.stale()
        bus.drain = lambda: frames[4095:4096]
        secured_bus.drain()
        # What was heard up to then is kept; who drains waits for no disk.
        authentication._writer.join()
        assert FreshnessFile(tmp_path).load().heard["EMB_FL_Auth"][0] == 1

    def test_only_one_thread_stores_freshness_at_a_time(self, tmp_path, monkeypatch):
        """And none where logs are read; what the first had not heard the last one stores."""
        authentication, held, stored = opened(tmp_path), threading.Event(), []
        monkeypatch.setattr(authentication._file, "keep", lambda kept: (held.wait(20.0), stored.append(kept)))
        frames = signed()
        authentication.verify(frames[:2000])
        authentication.keep()
        authentication.verify(frames[2000:])
        authentication.keep()
        held.set()
        authentication.close()
        assert [kept.heard["EMB_FL_Auth"] for kept in stored] == [(1, 2), authentication._verifier.last()["EMB_FL_Auth"]]
        reading = Authentication(RECEIVED, SENT, KEYS, Freshness(trip=1))
        reading.verify(frames)
        reading.close()
        assert reading._writer is None

    def test_a_damaged_file_is_set_aside(self, tmp_path, caplog):
        FreshnessFile(tmp_path).path.write_text("{")
        assert FreshnessFile(tmp_path).begin_trip().trip == 1
        assert "damaged" in caplog.text and list(tmp_path.glob("*.unusable-1"))

    def test_a_trip_that_cannot_be_stored_does_not_begin(self, tmp_path, monkeypatch):
        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(secured, "write_in_reserve", full)
        with pytest.raises(Unavailable, match="trip counter cannot be stored: No space left on device"):
            FreshnessFile(tmp_path).begin_trip()

    def test_a_disk_that_has_become_full_is_no_obstacle(self, tmp_path, monkeypatch):
        """Nothing is made and nothing grows once the file was written."""
        opened(tmp_path).close()
        taken, plain = {(file.stat().st_ino, file.stat().st_size) for file in tmp_path.iterdir()}, os.open

        def full(path, flags, *mode):
            if flags & os.O_CREAT and not Path(path).exists():
                raise OSError(28, "No space left on device")
            return plain(path, flags, *mode)

        monkeypatch.setattr(os, "open", full)
        authentication = opened(tmp_path)
        authentication.verify(signed())
        authentication.close()
        assert {(file.stat().st_ino, file.stat().st_size) for file in tmp_path.iterdir()} == taken
        assert FreshnessFile(tmp_path).load() == Freshness(trip=2, heard=authentication._verifier.last())
        assert FreshnessFile(tmp_path).begin_trip().trip == 3

    def test_storing_is_tried_again_and_a_failure_reported_once(self, tmp_path, monkeypatch, caplog):
        def broken(*_):
            raise OSError(5, "Input/output error")

        authentication = opened(tmp_path)
        authentication.verify(signed())
        with monkeypatch.context() as patch:
            patch.setattr(secured, "write_in_reserve", broken)
            for _ in range(3):
                authentication.close()
                assert authentication.stale()
        assert caplog.text.count("freshness cannot be stored: Input/output error") == 1
        authentication.close()
        assert not authentication.stale() and FreshnessFile(tmp_path).load().heard == authentication._verifier.last()

    def test_used_up(self, tmp_path):
        file = FreshnessFile(tmp_path)
        file.keep(Freshness(trip=2**24 - 1))
        with pytest.raises(InputError, match="used up"):
            file.begin_trip()

    def test_stored_counters_are_stale_after_64_resets(self, tmp_path):
        authentication = opened(tmp_path)
        authentication.verify(signed())
        authentication.close()
        links = authentication._verifier.links
        links["reset"][0] += 63
        assert not authentication.stale()
        links["reset"][0] += 1
        assert authentication.stale()


class TestKeys:
    GOOD = "# ours\nEMB_FL_Auth ab7e151628aed2a6abf7158809cf4f3c\n\nVEH_Auth  000102030405060708090A0B0C0D0E0F  # car\n"

    def written(self, folder, text, mode=0o600):
        (folder / "keys").write_text(text)
        os.chmod(folder / "keys", mode)
        return folder / "keys"

    @pytest.mark.parametrize("mode", [0o600, 0o400])
    def test_lines(self, tmp_path, mode):
        keys = load_keys(self.written(tmp_path, self.GOOD, mode), {})
        assert keys == {"EMB_FL_Auth": bytes.fromhex("ab7e151628aed2a6abf7158809cf4f3c"), "VEH_Auth": bytes(range(16))}

    @pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o602, 0o644, 0o601])
    def test_a_key_file_readable_by_others_is_refused(self, tmp_path, mode):
        with pytest.raises(InputError, match=f"mode {mode:o}: others may read"):
            load_keys(self.written(tmp_path, self.GOOD, mode), {})

    def test_a_key_file_of_another_user_is_refused(self, tmp_path, monkeypatch):
        """He may write to it again whenever he likes."""
        path = self.written(tmp_path, self.GOOD)
        if os.geteuid() == 0:
            os.chown(path, 4242, -1)
        else:
            monkeypatch.setattr(os, "geteuid", lambda: 4242)
        with pytest.raises(InputError, match="belongs to another user"):
            load_keys(path, {})

    def test_a_credential_shows_its_access_list_as_the_groups_right(self, tmp_path):
        path, environment = self.written(tmp_path, self.GOOD, 0o440), {"CREDENTIALS_DIRECTORY": str(tmp_path)}
        assert len(load_keys(path, environment)) == 2
        os.chmod(path, 0o444)
        with pytest.raises(InputError, match="others may read"):
            load_keys(path, environment)

    def test_a_credential_comes_before_a_file(self, tmp_path):
        self.written(tmp_path, self.GOOD)
        environment = {"CREDENTIALS_DIRECTORY": str(tmp_path)}
        assert key_file("keys", tmp_path / "etc", environment) == tmp_path / "keys"
        assert key_file("other", tmp_path / "etc", environment) == tmp_path / "etc" / "other"
        assert key_file("keys", tmp_path / "etc", {}) == tmp_path / "etc" / "keys"
        assert key_file("../keys", tmp_path / "etc", environment) == tmp_path / "etc" / ".." / "keys"

    @pytest.mark.parametrize(
        ("line", "said"),
        [
            ("EMB_FL_Auth 2b7e", "keys:5: expected a name and 32 hexadecimal digits"),
            ("EMB_FL_Auth", "keys:5: expected a name"),
            ("VEH_Auth ffeeddccbbaa99887766554433221100", "keys:5: VEH_Auth: occurs twice"),
            ("EMB_FR_Auth 000102030405060708090a0b0c0d0e0f", "keys:5: EMB_FR_Auth: another name has the same key"),
        ],
    )
    def test_a_bad_line_is_named_without_printing_a_key(self, tmp_path, line, said):
        with pytest.raises(InputError) as error:
            load_keys(self.written(tmp_path, self.GOOD + line), {})
        assert said in str(error.value) and "ab7e15162" not in str(error.value) and "ffeedd" not in str(error.value)

    @pytest.mark.parametrize(("name", "said"), [("nothing", "no such file"), (".", "Is a directory")])
    def test_a_missing_key_file_or_a_folder_is_refused(self, tmp_path, name, said):
        os.chmod(tmp_path, 0o700)
        with pytest.raises(InputError, match=said):
            load_keys(tmp_path / name, {})


def configured(folder, lines):
    config = folder / "emb.yaml"
    config.write_text(f"format: 1\ncorners:\n  FL: {{calibration: {resource('config/calibration.yaml')}}}\n{lines}")
    return config


class TestConfiguration:
    def test_a_missing_key_file_is_an_error_of_the_configuration(self, tmp_path):
        with pytest.raises(InputError, match="keys: no such file"):
            Setup(configured(tmp_path, "secoc: {keys: keys}\n"))

    def test_check_names_the_keys_that_are_missing(self, tmp_path, capsys):
        from emb_daemon.cli.main import main

        TestKeys().written(tmp_path, TestKeys.GOOD)
        assert main(["check", "--config", str(configured(tmp_path, "secoc: {keys: keys}\n"))]) == 0
        said = capsys.readouterr().out
        assert "no key EMB_FL_EstimateAuth" in said and "no key EMB_FL_Auth" not in said and "no key VEH_Auth" not in said

    def test_without_secoc_a_dbc_needs_no_authentication_messages(self, tmp_path):
        text = resource("dbc/emb.dbc").read_text(encoding="utf-8").replace("EMB_FL_Auth", "EMB_FL_Auht")
        (tmp_path / "other.dbc").write_text(text, encoding="utf-8")
        TestKeys().written(tmp_path, TestKeys.GOOD)
        Setup(configured(tmp_path, "dbc: other.dbc\n"))
        with pytest.raises(InputError, match="message EMB_FL_Auth is missing"):
            Setup(configured(tmp_path, "dbc: other.dbc\nsecoc: {keys: keys}\n"))

    def test_fields_elsewhere_are_refused(self, tmp_path):
        text = (
            resource("dbc/emb.dbc").read_text(encoding="utf-8").replace("SG_ TripCounter : 16|24", "SG_ TripCounter : 16|16")
        )
        (tmp_path / "other.dbc").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=r"VEH_Freshness.TripCounter: expected 24 bits from bit 16"):
            load_links(tmp_path / "other.dbc", ("FL",))

    def test_a_dbc_without_a_force_sensor_has_one_set_less(self, tmp_path):
        text = resource("dbc/emb.dbc").read_text(encoding="utf-8").replace("_ForceSensor", "_Other")
        (tmp_path / "other.dbc").write_text(text, encoding="utf-8")
        (corner, vehicle), _ = load_links(tmp_path / "other.dbc", ("FL",))
        assert (len(RECEIVED[0].sets), corner.sets, vehicle) == (3, RECEIVED[0].sets[:2], RECEIVED[1])

    def test_the_daemon_begins_a_trip_and_knows_which_corners_lack_a_key(self, tmp_path, caplog):
        """The vehicle's key concerns no corner alone."""
        lines = "".join(f"{name} {key.hex()}\n" for name, key in KEYS.items() if name == "EMB_FL_EstimateAuth")
        TestKeys().written(tmp_path, lines)
        setup, bus = Setup(configured(tmp_path, "secoc: {keys: keys}\n")), SimpleNamespace(close=lambda: None)
        secured_bus, keyless = secured.secure(bus, setup, tmp_path / "state")
        assert keyless == {"FL"} and "no key EMB_FL_Auth" in caplog.text and "no key VEH_Auth" in caplog.text
        secured_bus.close()
        assert FreshnessFile(tmp_path / "state").load().trip == 1

    def test_freshness_needs_a_state_directory(self, tmp_path):
        TestKeys().written(tmp_path, TestKeys.GOOD)
        setup = Setup(configured(tmp_path, "secoc: {keys: keys}\n"))
        with pytest.raises(InputError, match="expected state_directory as well"):
            secured.secure(None, setup, None)


def test_a_running_daemon_receives_and_sends_what_a_replay_of_its_bus_does(tmp_path):
    """In the midst of forged frames: every genuine sample is answered, with the payload that the recorded bus gives, and who
    has the key believes it."""
    running = Running(Setup(configured(tmp_path, "realtime: {fifo_priority: null, lock_memory: false}\n")))
    running.daemon._bus = SecuredBus(running.daemon._bus, opened(tmp_path / "state"))
    genuine = signed()[: of(signed(), AUTH)[250] + 1]
    foreign = attacks.forged(next(iter(attacks.FORGERIES)), signed(), np.random.default_rng(2), KEYS)
    mixed = wirekit.merged(foreign[foreign["time_ns"] < genuine["time_ns"][-1]], genuine)
    log = []
    with running:
        for frames in np.split(mixed, np.flatnonzero(np.diff((mixed["time_ns"] - _START_NS) // CYCLE_NS)) + 1):
            log.append(running.send(frames))
            running.listen()
            time.sleep(0.004)
        samples = int(np.sum(genuine["can_id"] == 0x100))
        heard = running.wait_for(lambda frames: len(answers(frames)) >= samples)
    believed = Verifier(SENT, KEYS, {}).verify(heard)
    assert np.all(believed["flags"] == 0) and np.sum(believed["can_id"] == 0x200) == np.sum(heard["can_id"] == 0x200)
    pipeline = new_pipeline()
    pipeline.begin(int(log[0]["time_ns"][0]))
    _, count = pipeline.collect(verifier().verify(np.concatenate(log)), predictions=False)
    pipeline.answer(count)
    assert np.array_equal(answers(believed), answers(pipeline.broadcast(count))) and count == samples


def test_without_secoc_no_module_of_it_is_loaded():
    modules = "emb_daemon.cli.run, emb_daemon.runtime.daemon, emb_daemon.runtime.bus"
    code = f"import sys; sys.modules['asammdf'] = None; import {modules}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not [name for name in loaded if "secured" in name]


def test_a_recorded_bus_replays_to_the_same_bytes(tmp_path):
    """Of all that the daemon sends, authentication included, begun with the same state; and without the key to nothing."""
    from emb_daemon.cli.main import main

    log, keys = tmp_path / "bus.log", tmp_path / "keys"
    for record in (signed(), drive()):
        record["time_ns"] = record["time_ns"] // 1000 * 1000
    write_frames(log, signed())
    keys.write_text("".join(f"{name} {key.hex()}\n" for name, key in KEYS.items()))
    keys.chmod(0o600)
    replay = partial(_frames_of, main, tmp_path, "replay", str(log), "--keys", str(keys), "--output")
    first, again = (replay(f"{name}.log", "--state", str(tmp_path / name)) for name in ("first", "again"))
    assert len(of(first, 0x240)) > 900 and wirekit.same(first, again)
    heard = Verifier(SENT, KEYS, {}).verify(first)
    assert np.all(heard["flags"] == 0)
    plain = _frames_of(main, tmp_path, "replay", str(log), "--output", "plain.log")
    assert np.array_equal(plain["data"][plain["can_id"] == 0x200], heard["data"][heard["can_id"] == 0x200])
    FreshnessFile(tmp_path / "first").keep(Freshness(heard={"EMB_FL_Auth": (1, 9)}))
    after = replay("after.log", "--state", str(tmp_path / "first"))
    assert not any(wirekit.decode(frame)[1]["Status"] < 2 for frame in after[after["can_id"] == 0x200]), "an old recording"


def _frames_of(main, folder, *arguments):
    from emb_daemon.logs.read import read_frames

    place = next(index for index, word in enumerate(arguments) if word == "--output") + 1
    output = folder / arguments[place]
    assert main([*arguments[:place], str(output), *arguments[place + 1 :]]) == 0
    return read_frames(output)
