"""The wire: the contract's tables, other people's codecs, and what reception accepts."""

import re

import cantools
import numpy as np
import pytest
import wirekit
from e2e.p01 import e2e_p01_check, e2e_p01_protect
from hypothesis import given
from hypothesis import strategies as st
from wirekit import MS, frame, record

from emb_daemon.errors import InputError, InputErrors
from emb_daemon.resources import resource
from emb_daemon.wire import layout as wire
from emb_daemon.wire.contract import CYCLE_NS, MODES, REASONS, REQUESTS, RESULTS, reason_words
from emb_daemon.wire.e2e import crc, protect
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, REMOTE, row_of
from emb_daemon.wire.layout import CORNERS, _restrict, default_layout, load_layout, pack, unpack
from emb_daemon.wire.receive import (
    ACCEPTED,
    BAD_COUNTER,
    BAD_CRC,
    BAD_LENGTH,
    BAD_RANGE,
    BAD_STATUS,
    IGNORED,
    SECOND_SENDER,
    lateness,
    new_reception,
    receive,
)
from emb_daemon.wire.units import conversion

#: The wire contract: message, id of its first corner, cycle (ms), signals as start|length, sign, factor, offset, unit.
_CONTRACT = (
    ("EMB_{}_Resolver", 0x100, 4, "MotorAngle 16|24 s 0.0002 0 rad; MotorSpeed 40|16 s 0.02 0 rad/s"),
    ("EMB_{}_Current", 0x110, 4, "CurrentQ 16|16 s 0.01 0 A; CurrentD 32|16 s 0.01 0 A; DcBusVoltage 48|8 u 0.25 0 V"),
    ("EMB_{}_Thermocouple", 0x120, 10, "InnerBackplateTemp 16|16 s 0.1 0 degC; OuterBackplateTemp 32|16 s 0.1 0 degC; "
     "CaliperTemp 48|16 s 0.1 0 degC"),
    ("VEH_WheelSpeed", 0x180, 10, "; ".join(f"WheelSpeed{c} {16 + 12 * k}|12 u 0.05 0 rad/s" for k, c in enumerate(CORNERS))),
    ("VEH_WheelPulse", 0x181, 10, "; ".join(f"WheelPulse{c} {16 + 12 * k}|12 u 1 0 -" for k, c in enumerate(CORNERS))),
    ("VEH_Status", 0x182, 100, "ParkBrake 16|2 u 1 0 -; BrakeRequest 18|1 u 1 0 -; AmbientTemp 24|16 s 0.1 0 degC; "
     "VehicleSpeed 40|16 u 0.01 0 m/s"),
    ("EMB_{}_ClampForce", 0x200, 4, "ClampForce 16|16 u 0.001 0 kN; ClampForceSigma 32|16 u 0.001 0 kN; "
     "InputCounter 48|4 u 1 0 -; ForceSource 52|4 u 1 0 -; InputAge 56|8 u 1 0 ms"),
    ("EMB_{}_PadTemp", 0x210, 20, "InnerSurfaceTemp 16|12 u 0.25 -40 degC; InnerMeanTemp 28|12 u 0.25 -40 degC; "
     "OuterSurfaceTemp 40|12 u 0.25 -40 degC; OuterMeanTemp 52|12 u 0.25 -40 degC"),
    ("EMB_{}_EstimatorStatus", 0x220, 100, "Mode 16|4 u 1 0 -; StiffnessFactor 20|12 u 0.0005 0 -; "
     "ContactAngle 32|16 s 0.1 0 rad; DegradedReasons 48|16 u 1 0 -"),
    ("EMB_{}_AdaptRequest", 0x230, 20, "Request 16|2 u 1 0 -; Progress 18|7 u 1 0 %; Result 25|4 u 1 0 -; "
     "LowForce 32|8 u 0.25 0 kN; HighForce 40|8 u 0.25 0 kN; "
     "DitherAmplitude 48|8 u 0.02 0 rad; DitherFrequency 56|8 u 0.1 0 Hz"),
)  # fmt: skip
#: What was added to it.
_ADDED = (("EMB_{}_ForceSensor", 0x0F0, 4, "SensorForce 16|16 s 1 0 N"),)
_MESSAGES = [
    (template.format(corner), can_id + index, cycle, signals)
    for template, can_id, cycle, signals in (*_CONTRACT, *_ADDED)
    for index, corner in enumerate(CORNERS if "{}" in template else ("",))
]
_NAMES = [name for name, *_ in _MESSAGES]
_RECEIVED = [name for name, can_id, *_ in _MESSAGES if can_id < 0x200]


@pytest.mark.parametrize(("name", "can_id", "cycle", "signals"), _MESSAGES, ids=_NAMES)
def test_dbc_states_the_contract(name, can_id, cycle, signals):
    message = wirekit.database().get_message_by_name(name)
    assert (message.frame_id, message.length, message.cycle_time, message.is_extended_frame) == (can_id, 8, cycle, False)
    assert message.senders and message.comment
    known = {signal.name: signal for signal in message.signals}
    head = {"CRC": (0, 8), "Counter": (8, 4), "Status": (12, 4)}
    for signal, place in head.items():
        assert (known[signal].start, known[signal].length) == place
    assert known["Status"].choices == {0: "Ok", 1: "Degraded", 2: "Fault", 15: "NotAvailable"}
    listed = re.findall(r"(\w+) (\d+)\|(\d+) ([su]) (\S+) (\S+) ([^;]+)", signals)
    assert set(known) == {signal for signal, *_ in listed} | set(head)
    for signal, start, length, sign, factor, offset, unit in listed:
        found = known[signal]
        assert (found.start, found.length, found.is_signed) == (int(start), int(length), sign == "s")
        assert (found.scale, found.offset) == (float(factor), float(offset))
        assert (found.unit or "-") == unit
        assert found.byte_order == "little_endian" and found.comment and found.receivers


def test_the_dbc_names_the_values_of_enumerations():
    def choices(message, signal):
        found = wirekit.database().get_message_by_name(message).get_signal_by_name(signal)
        return {number: str(name) for number, name in found.choices.items()}

    assert choices("VEH_Status", "ParkBrake") == {0: "Released", 1: "Applied", 2: "InTransition", 3: "Fault"}
    assert choices("EMB_FL_ClampForce", "ForceSource") == {
        0: "Fused", 1: "StiffnessOnly", 2: "TorqueOnly", 3: "Predicted", 15: "Invalid"}  # fmt: skip
    assert choices("EMB_RR_EstimatorStatus", "Mode") == {number: mode.capitalize() for number, mode in enumerate(MODES)}
    assert choices("EMB_FL_AdaptRequest", "Request") == {number: word.capitalize() for number, word in enumerate(REQUESTS)}
    assert choices("EMB_FL_AdaptRequest", "Result") == {number: word.capitalize() for number, word in enumerate(RESULTS)}
    reasons = wirekit.database().get_message_by_name("EMB_FL_EstimatorStatus").get_signal_by_name("DegradedReasons").comment
    for bit, reason in enumerate(REASONS):
        assert f"bit {bit} (0x{1 << bit:04X}) {reason}" in reasons


def test_contract_on_paper_lists_these_messages(shared):
    """The literal copy above against the contract itself."""
    text = (shared / "wire-contract.md").read_text()
    rows = re.findall(r"^\| (0x[0-9A-F]+)(?:\+k)? \| (\w+) \| (\d+) \|", text, re.MULTILINE)
    assert {(int(i, 16), name, int(cycle)) for i, name, cycle in rows} == {
        (can_id, template.replace("{}", "c"), cycle) for template, can_id, cycle, _ in _CONTRACT
    }


def test_check_value_of_the_contract():
    assert crc(0x123, np.uint64(0)) == 0xCC


@given(st.integers(0, 0x7FF), st.integers(0, 2**48 - 1), st.integers(0, 14), st.integers(0, 15))
def test_protection_is_that_of_autosar(can_id, payload, counter, status):
    data = protect(can_id, np.uint64(payload << 16), counter, status)
    theirs = bytearray((payload << 16 | status << 12 | counter << 8).to_bytes(8, "little"))
    e2e_p01_protect(theirs, can_id, increment_counter=False)
    assert int(data).to_bytes(8, "little") == bytes(theirs)
    assert e2e_p01_check(theirs, can_id)


@given(st.data())
def test_unpack_is_that_of_cantools(data):
    name = data.draw(st.sampled_from(_NAMES))
    message = wirekit.database().get_message_by_name(name)
    raw = data.draw(st.integers(0, 2**64 - 1))
    names = tuple(signal.name for signal in message.signals)
    theirs = message.decode(raw.to_bytes(8, "little"), decode_choices=False)
    for signal, ours in zip(names, wire.signal_columns(wirekit.database(), name, names), strict=True):
        assert unpack(np.uint64(raw), ours) == pytest.approx(theirs[signal], rel=1e-12)


@given(st.data())
def test_pack_is_that_of_cantools_inside_the_range(data):
    name = data.draw(st.sampled_from(_NAMES))
    message = wirekit.database().get_message_by_name(name)
    signal = data.draw(st.sampled_from([s for s in message.signals if s.name not in ("CRC", "Counter", "Status")]))
    ours = wire.signal_columns(wirekit.database(), name, (signal.name,))[0]
    value = data.draw(st.floats(float(ours["low"]), float(ours["high"])))
    payload = np.uint64(pack(value, ours))
    assert unpack(payload, ours) == pytest.approx(value, abs=0.5000001 * ours["factor"])
    zeros = {s.name: max(0, s.offset) for s in message.signals}
    empty = int.from_bytes(message.encode(zeros, strict=False), "little")
    mask = ((1 << signal.length) - 1) << signal.start
    theirs = int.from_bytes(message.encode(zeros | {signal.name: value}, strict=False), "little")
    step = abs(((theirs & mask) >> signal.start) - (int(payload) >> signal.start))
    assert step in (0, 1, (1 << signal.length) - 1), "further apart than rounding of a half"
    assert not int(payload) & ~mask and not (theirs ^ empty) & ~mask


def test_a_value_one_count_beyond_its_range_is_refused():
    tried = 0
    for name in _RECEIVED:
        message = wirekit.database().get_message_by_name(name)
        signals = [signal for signal in message.signals if signal.name not in ("CRC", "Counter", "Status")]
        lowest = {signal.name: signal.minimum for signal in signals}
        for signal in signals:
            data = int(frame(name, **lowest | {signal.name: signal.maximum})["data"][0]) & ~0xFFFF
            if (data >> signal.start & (1 << signal.length) - 1) + 1 < 1 << signal.length - signal.is_signed:
                beyond = protect(message.frame_id, np.uint64(data + (1 << signal.start)), 0, 0)
                sent = record(0, message.frame_id, int(beyond).to_bytes(8, "little"))
                assert _receive(sent, new_reception())[1] == BAD_RANGE, signal.name
                tried += 1
    assert tried


_WITHOUT_RANGES = """VERSION ""
BU_: X
BO_ 256 M: 8 X
 SG_ Unsigned : 16|12@1+ (0.5,-10) [0|0] "" X
 SG_ Signed : 32|12@1- (0.5,-10) [0|0] "" X
"""


@pytest.mark.parametrize(("name", "low", "high"), [("Unsigned", 0, 4095), ("Signed", -2048, 2047)])
def test_a_signal_without_a_stated_range_has_that_of_its_bits(name, low, high):
    signal = wire.signal_columns(cantools.database.load_string(_WITHOUT_RANGES, "dbc"), "M", (name,))[0]
    assert (signal["low"], signal["high"]) == (0.5 * low - 10.0, 0.5 * high - 10.0)


@given(st.sampled_from(_NAMES), st.sampled_from([np.inf, -np.inf, np.nan, 1e300, -1e300]))
def test_a_value_beyond_the_range_saturates(name, value):
    signals = [s.name for s in wirekit.database().get_message_by_name(name).signals]
    for signal in wire.signal_columns(wirekit.database(), name, tuple(signals)):
        assert unpack(np.uint64(pack(value, signal)), signal) == pytest.approx(signal["high"] if value > 0 else signal["low"])


@given(st.data())
def test_every_number_a_sender_can_send_within_its_range_is_accepted(data):
    """The ends of a range included, although factor times raw value may round beyond them."""
    name = data.draw(st.sampled_from(_RECEIVED))
    message = wirekit.database().get_message_by_name(name)
    values = {}
    for signal in message.signals:
        if signal.name not in ("CRC", "Counter", "Status"):
            values[signal.name] = data.draw(st.sampled_from([signal.minimum, signal.maximum]))
    receptions = new_reception()
    slot, verdict = _receive(frame(name, **values), receptions)
    assert verdict == ACCEPTED
    for column, value in enumerate(values.values()):
        assert receptions[slot]["values"][column] == pytest.approx(value)


def _receive(frames, receptions, layout=None):
    return receive(frames[0], receptions, (default_layout() if layout is None else layout)[0])


def _resolver(counter, time_ns, status=0, angle=1.0):
    return frame("EMB_FL_Resolver", time_ns, counter, status, MotorAngle=angle, MotorSpeed=2.0)


@pytest.fixture
def heard():
    """Receivers after two good resolver frames at 0 and 4 ms; the next counter is 2."""
    receptions = new_reception()
    for counter in range(2):
        assert _receive(_resolver(counter, 4 * MS * counter), receptions) == (0, ACCEPTED)
    return receptions


def _refused(receptions, frames, verdict):
    """Receive a frame that must change nothing but the counts."""
    before = receptions.copy()
    slot, found = _receive(frames, receptions)
    assert found == verdict
    if slot >= 0:
        assert receptions[slot]["count"][verdict] == before[slot]["count"][verdict] + 1
    for name in ("values", "time_ns", "counter"):
        assert receptions[name].tobytes() == before[name].tobytes()


@given(st.integers(0, 63), st.sampled_from(_RECEIVED), st.integers(0, 14))
def test_any_flipped_bit_is_refused(bit, name, counter):
    """And the frame as it was sent is taken."""
    good = frame(name, 0, counter)
    receptions = new_reception()
    bad = good.copy()
    bad["data"] ^= np.uint64(1 << bit)
    _refused(receptions, bad, BAD_CRC)
    assert _receive(good, receptions)[1] == ACCEPTED


@given(st.integers(0, 10), st.sampled_from(_NAMES[:4]), st.sampled_from(_NAMES[:4]))
def test_a_frame_under_another_id_is_refused(counter, name, other):
    moved = frame(name, 0, counter)
    moved["can_id"] = wirekit.database().get_message_by_name(other).frame_id
    assert (_receive(moved, new_reception())[1] == ACCEPTED) == (name == other)


@pytest.mark.parametrize("length", [0, 1, 7])
def test_wrong_length(heard, length):
    data = wirekit.payload("EMB_FL_Resolver", 2)[:length]
    _refused(heard, record(8 * MS, 0x100, data), BAD_LENGTH)


@pytest.mark.parametrize("flags", [EXTENDED, REMOTE, ERROR, FD])
def test_frames_of_other_kinds_are_ignored(heard, flags):
    foreign = _resolver(2, 8 * MS)
    foreign["flags"] = flags
    _refused(heard, foreign, IGNORED)
    assert _receive(_resolver(2, 8 * MS), heard)[1] == ACCEPTED


@pytest.mark.parametrize("can_id", [0x0, 0x104, 0x1FF, 0x700, 0x7FF])
def test_foreign_ids_are_ignored(heard, can_id):
    _refused(heard, record(8 * MS, can_id, bytes(8)), IGNORED)


def test_our_own_messages_from_another_node_are_a_second_sender(heard):
    _refused(heard, frame("EMB_FL_ClampForce", 8 * MS), SECOND_SENDER)


def test_corners_that_are_not_ours_are_foreign():
    layout = load_layout(corners=("FR",))
    assert _receive(_resolver(0, 0), new_reception(), layout)[1] == IGNORED
    assert _receive(frame("EMB_FL_ClampForce"), new_reception(), layout)[1] == IGNORED
    assert _receive(frame("EMB_FR_Resolver"), new_reception(), layout)[1] == ACCEPTED
    # As out of that of all corners, which a compiled library holds.
    assert _restrict(default_layout().copy(), ("FR",)).tobytes() == layout.tobytes()


def test_a_repeated_frame_is_refused_and_the_next_taken(heard):
    _refused(heard, _resolver(1, 8 * MS), BAD_COUNTER)
    assert _receive(_resolver(2, 12 * MS), heard)[1] == ACCEPTED


@pytest.mark.parametrize(
    ("counter", "angle", "later_ms", "contested"),
    [(1, 2.0, 0.1, True), (1, 1.0, 0.1, False), (2, 2.0, 0.1, False), (1, 2.0, 4.0, False)],
)
def test_a_frame_with_the_last_counter_and_other_content_contests_it(heard, counter, angle, later_ms, contested):
    """Within a cycle; a frame that comes twice, or comes when another is due, is no contradiction."""
    later_ns = round((4.0 + later_ms) * MS)
    _receive(_resolver(counter, later_ns, angle=angle), heard)
    assert (heard[0]["contested_ns"] == later_ns) == contested


def test_a_sender_that_repeats_its_frame_is_never_accepted(heard):
    for cycle in range(2, 200):
        assert _receive(_resolver(1, 4 * MS * cycle, angle=9.0), heard)[1] == BAD_COUNTER
    assert heard[0]["values"][0] == pytest.approx(1.0)


@pytest.mark.parametrize("lost", range(1, 40))
def test_lost_frames_are_accounted_for_by_the_time_that_passed(heard, lost):
    """Whatever the number of lost frames, a whole turn of the counter too: the first frame that arrives is taken."""
    cycle = 2 + lost
    assert _receive(_resolver(cycle % 15, 4 * MS * cycle), heard)[1] == ACCEPTED


@pytest.mark.parametrize("counter", [4, 7, 14, 0])
def test_a_counter_that_runs_ahead_of_time_is_refused(heard, counter):
    _refused(heard, _resolver(counter if counter != 4 else 5, 8 * MS), BAD_COUNTER)


@pytest.mark.parametrize("stray", [None, *(counter for counter in range(15) if counter not in (5, 6, 7, 8))])
def test_after_a_turn_of_silence_alone_the_counter_may_stand(stray):
    """Somebody who was heard meanwhile, out of sequence, makes a frame with the last counter a repetition."""
    receptions = new_reception()
    for counter in range(6):
        assert _receive(_resolver(counter, 4 * MS * counter), receptions)[1] == ACCEPTED
    if stray is not None:
        _refused(receptions, _resolver(stray, 24 * MS), BAD_COUNTER)
    stands = _receive(_resolver(5, 80 * MS), receptions)[1]
    assert stands == (ACCEPTED if stray in (None, 3, 4) else BAD_COUNTER)


def test_a_restarted_sender_is_accepted_from_its_second_frame_on(heard):
    for cycle in range(2, 10):
        assert _receive(_resolver(cycle % 15, 4 * MS * cycle), heard)[1] == ACCEPTED
    _refused(heard, _resolver(0, 40 * MS), BAD_COUNTER)
    assert _receive(_resolver(1, 44 * MS), heard)[1] == ACCEPTED
    assert _receive(_resolver(2, 48 * MS), heard)[1] == ACCEPTED


def test_time_that_steps_back_costs_one_frame(heard):
    verdicts = [_receive(_resolver(2 + n, -5_000 * MS + 4 * MS * n), heard)[1] for n in range(4)]
    assert verdicts[1:] == [ACCEPTED] * 3


@pytest.mark.parametrize(("apart_ms", "believed"), [(1.6, False), (2.0, True), (4.0, True)])
def test_a_restarted_sender_is_accepted_if_its_second_frame_comes_half_a_cycle_later(heard, apart_ms, believed):
    """Two frames in a burst may both be somebody else's."""
    _refused(heard, _resolver(9, 8 * MS), BAD_COUNTER)
    verdict = _receive(_resolver(10, 8 * MS + round(apart_ms * MS)), heard)[1]
    assert verdict == (ACCEPTED if believed else BAD_COUNTER)


def test_acceptance_of_frames_does_not_depend_on_the_clocks_zero():
    """A million frames into a drive and years after a start: late, early, lost, repeated and foreign ones."""
    rng, verdicts = np.random.default_rng(7), []
    late_ns, counters = (
        rng.choice([0, 0, 0, 0, 1, 3, -2, -3], 400) * MS,
        np.arange(400) + rng.choice([0, 0, 0, 0, 0, 1, 7], 400),
    )
    for begin_ns in (0, 3 * 10**17):
        receptions = new_reception()
        verdicts.append([
            _receive(_resolver(int(counter) % 15, begin_ns + 4 * MS * cycle + int(late_ns[cycle])), receptions)[1]
            for cycle, counter in enumerate(counters)
        ])  # fmt: skip
    assert verdicts[0] == verdicts[1] and set(verdicts[0]) == {ACCEPTED, BAD_COUNTER}


@pytest.mark.parametrize("early_ms", [1.9, 2.1])
def test_a_frame_is_half_a_cycle_early_at_most_at_any_time(early_ms):
    """Once 128 frames have shown the schedule."""
    receptions, begin_ns = new_reception(), 3 * 10**17
    for cycle in range(300):
        assert _receive(_resolver(cycle % 15, begin_ns + 4 * MS * cycle), receptions)[1] == ACCEPTED
    verdict = _receive(_resolver(0, begin_ns + 1200 * MS - round(early_ms * MS)), receptions)[1]
    assert verdict == (ACCEPTED if early_ms < 2.0 else BAD_COUNTER)


def test_after_a_long_silence_128_frames_show_the_schedule_again():
    """Who comes early then is refused as before the silence of 1.6 s."""
    receptions, begin_ns = new_reception(), 3 * 10**17
    for cycle in (*range(300), *range(700, 900)):
        assert _receive(_resolver(cycle % 15, begin_ns + 4 * MS * cycle), receptions)[1] == ACCEPTED
    assert _receive(_resolver(0, begin_ns + 3600 * MS - round(2.1 * MS)), receptions)[1] == BAD_COUNTER


@pytest.mark.parametrize("shown", [40, 300], ids=["before a window is full", "after it"])
def test_a_frame_is_as_late_as_it_comes_after_the_promptest(shown):
    """Also if the first of all was late; and after a silence, of which the schedule knows no whole turns of the counter."""
    receptions, begin_ns = new_reception(), 3 * 10**17

    def late_ms(cycle, by_ms):
        time_ns = begin_ns + 4 * MS * cycle + round(by_ms * MS)
        assert _receive(_resolver(cycle % 15, time_ns), receptions)[1] == ACCEPTED
        return lateness(receptions[wire.RESOLVER], CYCLE_NS) / MS

    late_ms(0, 8.0)
    for cycle in range(1, shown):
        assert late_ms(cycle, 0.0) == 0.0
    assert late_ms(shown, 9.0) == pytest.approx(9.0)
    assert late_ms(shown + 1, 5.0) == pytest.approx(5.0)
    assert late_ms(shown + 32, 0.0) == 0.0
    assert late_ms(shown + 64, -1.0) == 0.0
    assert late_ms(shown + 96, 8.0) == pytest.approx(8.0)


def test_of_can_fd_the_first_eight_bytes_are_kept():
    import can

    message = can.Message(arbitration_id=0x100, data=bytes(range(1, 65)), is_fd=True, is_extended_id=False)
    assert row_of(message, 7) == (7, 0x0807060504030201, 0x100, 64, FD)


def test_counter_fifteen_does_not_exist(heard):
    _refused(heard, _resolver(15, 8 * MS), BAD_COUNTER)


@pytest.mark.parametrize(
    ("status", "verdict"), [(0, ACCEPTED), (1, ACCEPTED), (2, BAD_STATUS), (3, BAD_STATUS), (15, BAD_STATUS)]
)
def test_status_of_the_sender(heard, status, verdict):
    assert _receive(_resolver(2, 8 * MS, status), heard)[1] == verdict
    assert heard[0]["degraded"] == (status == 1)


def test_value_out_of_range_changes_nothing_of_its_frame():
    receptions = new_reception()
    good = {"InnerBackplateTemp": 20.0, "OuterBackplateTemp": 21.0, "CaliperTemp": 22.0}
    assert _receive(frame("EMB_FL_Thermocouple", 0, 0, **good), receptions)[1] == ACCEPTED
    _refused(receptions, frame("EMB_FL_Thermocouple", 10 * MS, 1, **(good | {"CaliperTemp": 3000.0})), BAD_RANGE)
    assert _receive(frame("EMB_FL_Thermocouple", 20 * MS, 2, **good), receptions)[1] == ACCEPTED


def test_layout_lists_every_fault_of_a_dbc(tmp_path):
    text = resource("dbc/emb.dbc").read_text()
    path = tmp_path / "broken.dbc"
    text = text.replace(" SG_ MotorSpeed", " SG_ RotorSpeed", 1).replace("VEH_WheelPulse", "VEH_Pulses")
    path.write_text(text.replace('"GenMsgCycleTime" BO_ 256 4;', '"GenMsgCycleTime" BO_ 256 5;'))
    with pytest.raises(InputErrors) as caught:
        load_layout(path)
    faults = "\n".join(caught.value.faults)
    assert "signal MotorSpeed is missing" in faults and "message VEH_WheelPulse is missing" in faults
    assert "EMB_FL_Resolver: GenMsgCycleTime is 5 ms" in faults, "a missing signal hides no other fault of its message"
    assert faults.count(str(path)) == len(caught.value.faults) == 3


def _altered(tmp_path, *replacements: tuple[str, str]):
    """The shipped DBC with texts replaced."""
    text = resource("dbc/emb.dbc").read_text()
    for old, new in replacements:
        assert old in text, old
        text = text.replace(old, new)
    path = tmp_path / "own.dbc"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("unit", "factor", "offset", "value"), [("deg", "0.01", "0", 0.01 * np.pi / 180.0), ("mrad", "0.2", "5", 0.2e-3)]
)
def test_a_dbc_of_ones_own_is_read_in_its_units(tmp_path, unit, factor, offset, value):
    line = next(line for line in resource("dbc/emb.dbc").read_text().splitlines() if "SG_ MotorAngle" in line).strip()
    other = re.sub(r"\(.*?\) \[.*?\]", f"({factor},{offset}) [-80000|80000]", line).replace('"rad"', f'"{unit}"')
    signal = load_layout(_altered(tmp_path, (line, other)))[0]["received"][wire.RESOLVER, wire.MOTOR_ANGLE]
    per_unit = value / float(factor)
    assert unpack(np.uint64(1000 << 16), signal) == pytest.approx(1000.0 * value + float(offset) * per_unit)
    assert (signal["low"], signal["high"]) == (pytest.approx(-80000 * per_unit), pytest.approx(80000 * per_unit))


def test_temperatures_of_a_dbc_of_ones_own_may_be_absolute(tmp_path):
    """Value and range of 0.1 K a bit from 200 K."""
    line = next(line for line in resource("dbc/emb.dbc").read_text().splitlines() if "SG_ InnerBackplateTemp" in line).strip()
    kelvin = re.sub(r"\(.*?\) \[.*?\]", "(0.1,200) [220|1400]", line).replace('"degC"', '"K"')
    signal = load_layout(_altered(tmp_path, (line, kelvin)))[0]["received"][wire.THERMOCOUPLE, wire.INNER_BACKPLATE]
    assert unpack(np.uint64(1000) << np.uint64(signal["start"]), signal) == pytest.approx(300.0 - 273.15)
    assert (signal["low"], signal["high"]) == (pytest.approx(220.0 - 273.15), pytest.approx(1400.0 - 273.15))


@pytest.mark.parametrize(
    ("unit", "target", "value"),
    [("Degrees", "rad", np.pi / 180.0), ("U/min", "rad/s", np.pi / 30.0), ("U", "rad", 2.0 * np.pi), ("KPH", "m/s", 1.0 / 3.6),
     ("Amps", "A", 1.0), ("Celsius", "degC", 1.0), ("mV", "V", 1e-3)],
)  # fmt: skip
def test_a_unit_may_be_spelt_in_other_ways(unit, target, value):
    assert conversion(unit, target)[0] == pytest.approx(value)
    with pytest.raises(InputError, match="expected s, ms"):
        conversion("MV", "s")


def test_what_is_sent_is_in_the_units_of_a_dbc_of_ones_own(tmp_path):
    path = _altered(
        tmp_path, ('SG_ ClampForce : 16|16@1+ (0.001,0) [0|65.535] "kN"', 'SG_ ClampForce : 16|16@1+ (2,0) [0|131070] "N"')
    )
    signal = load_layout(path)[0]["sent"][wire.CLAMP_FORCE, 0]
    assert int(pack(12.0, signal)) >> 16 == 6000


@pytest.mark.parametrize("unit", ["", "A", "furlong"])
def test_a_unit_that_cannot_be_converted_is_refused(tmp_path, unit):
    line = next(line for line in resource("dbc/emb.dbc").read_text().splitlines() if "SG_ MotorAngle" in line).strip()
    with pytest.raises(InputErrors) as caught:
        load_layout(_altered(tmp_path, (line, line.replace('"rad"', f'"{unit}"'))))
    assert len(caught.value.faults) == 4
    assert all("_Resolver.MotorAngle: " in fault and "expected rad" in fault for fault in caught.value.faults)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('BA_ "GenMsgCycleTime" BO_ 256 4;', 'BA_ "GenMsgCycleTime" BO_ 256 10;', "GenMsgCycleTime is 10 ms; expected 4 ms"),
        (" 256 ", " 2147483904 ", "expected an 11-bit id and 8 bytes"),
    ],
)
def test_a_dbc_may_not_contradict_the_contract(tmp_path, old, new, expected):
    with pytest.raises(InputErrors) as caught:
        load_layout(_altered(tmp_path, (old, new)))
    assert any(f"EMB_FL_Resolver: {expected}" in fault for fault in caught.value.faults)


def test_a_counter_elsewhere_is_refused(tmp_path):
    text = resource("dbc/emb.dbc").read_text()
    at = text.index("BO_ 256 ")
    path = tmp_path / "own.dbc"
    path.write_text(text[:at] + text[at:].replace("SG_ Counter : 8|4@", "SG_ Counter : 8|3@", 1))
    with pytest.raises(InputErrors, match=r"EMB_FL_Resolver\.Counter: expected 4 bits from bit 8"):
        load_layout(path)


@given(st.integers(0, 0xFFFF))
def test_reasons_in_words_are_the_bits(bits):
    words = reason_words(bits)
    assert sum(1 << REASONS.index(word) for word in words) == bits
