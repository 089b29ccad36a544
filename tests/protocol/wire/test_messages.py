"""Messages as bytes: round trips bit for bit, the bytes of another codec, and a refusal of everything else."""

from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings

from tests.support.messages import (
    array,
    bundles,
    changed,
    content,
    fields,
    messages,
    packed,
    sample,
    samples,
)
from transport.protocol.wire.codec import (
    CLASSES,
    MAX_BYTES,
    VERSION,
    decode,
    encode,
    encoded_length,
    header_of,
)
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import (
    MAX_DATA,
    Airtime,
    Control,
    LinkChange,
    Measurement,
    Message,
    Note,
    Plan,
    PlantState,
    Rejected,
    Roster,
    StepReport,
    Target,
    Tick,
    VehicleStatus,
)
from transport.protocol.wire.outbox import Outbox

SEED = 20240611
RANDOM_MESSAGES = 6_000  # of each sort; a second in all
NAN, INF = float("nan"), float("inf")


def survives(data: bytes) -> Message | None:
    """Decode arbitrary bytes: the result is `MessageError` or a complete message."""
    try:
        message = decode(data)
    except MessageError:
        return None
    assert encode(decode(encode(message))) == encode(message)
    return message


@given(messages | bundles)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_bytes_are_those_of_another_codec(message: Message) -> None:
    """A message has the bytes that msgpack makes of its fields, and reads back bit for bit, signed zeros included."""
    data = encode(message)
    assert data == packed(*content(message))
    assert encode(decode(data)) == data
    if isinstance(message, Plan):
        assert encoded_length(message) == len(data)
    head = (message.kind, message.sender, message.incarnation, message.sequence, message.tick)
    assert msgspec.structs.astuple(header_of(data)) == head


@pytest.mark.parametrize(
    ("kind", "field", "number", "reason"),
    [(Plan, "alone", -5.0, "out_of_range"), (StepReport, "residual", INF, "not_finite")],
)
def test_a_number_beyond_its_range_is_no_infinity(
    kind: type[Message], field: str, number: float, reason: str
) -> None:
    """Both are refused with the field and their own reason."""
    message = msgspec.structs.replace(sample(kind), **{field: number})
    with pytest.raises(MessageError, match=field) as refused:
        decode(encode(message))
    assert refused.value.reason == reason


@pytest.mark.parametrize("message", samples(), ids=lambda message: message.kind)
def test_truncated(message: Message) -> None:
    """Every proper prefix of an encoded message is refused, and so is a message with anything behind it."""
    data = encode(message)
    assert decode(data).kind == message.kind
    for length in range(len(data)):
        assert survives(data[:length]) is None
    for tail in (b"\0", b"\xc0", data):
        assert survives(data + tail) is None


def test_random_and_changed_bytes() -> None:
    """Random bytes behind all or part of a header, and messages with changed bytes, are refused or a valid message."""
    rng = np.random.default_rng(SEED)
    prefixes = (b"", bytes([VERSION]), bytes([VERSION, 0x98]), bytes([VERSION]) + b"\x98\xa4tick")
    encoded = [encode(message) for message in samples()]
    for i in range(RANDOM_MESSAGES):
        survives(prefixes[i % 4] + rng.bytes(int(rng.integers(0, 80))))
        data = bytearray(encoded[i % len(encoded)])
        for at in rng.integers(len(data), size=rng.integers(1, 5)):
            data[at] = rng.integers(256)
        survives(bytes(data))


def test_well_formed_garbage() -> None:
    """Fields of every other type msgpack knows, in every place, are refused or a valid message."""
    rng = np.random.default_rng(SEED)
    garbage: list[Any] = [
        None, True, -1, 0, 1, 2**48, 2**64 - 1, -(2**63), 0.5, NAN, INF, "", "solved", "plant",
        "x" * 2000, b"", b"\xff", [], [1, 2], [2, 1], [[]], [None], {}, {"a": 1}, {"": []}, [1] * 300,
        msgpack.Timestamp(1, 2), array(0, 0, 0, 0, values=bytes(8)), array(1, 0, 0, 0),
        array(2, 2, 12, 0, values=bytes(192)), [array(1, 1, 0, 0, values=bytes(8))], array(2, 0, 12, 0),
    ]  # fmt: skip
    contents = [content(message) for message in samples()]
    for i in range(RANDOM_MESSAGES):
        values = list(contents[i % len(contents)])
        for at in rng.integers(len(values), size=rng.integers(1, 4)):
            values[at] = garbage[rng.integers(len(garbage))]
        survives(packed(*values))


@pytest.mark.parametrize(
    ("data", "sender", "reason", "text"),
    [
        (b"", "", "malformed", "not MessagePack"),
        (bytes([VERSION]) + bytes(MAX_BYTES), "", "oversized", f"at most {MAX_BYTES}"),
        (
            bytes([VERSION + 1]) + encode(sample(Tick))[1:],
            "",
            "wrong_version",
            f"{VERSION + 1}, expected {VERSION}",
        ),
        (encode(sample(Tick))[:-1], "", "malformed", "not MessagePack"),
        (packed({"tick": 1}), "", "malformed", "expected str, got object"),
        (packed("truce", "agent2"), "", "unknown_kind", "unknown message kind 'truce'"),
        (packed("tick", "agent2"), "", "wrong_shape", "expected array of at least length"),
        (
            packed(*content(sample(Tick)), 0),
            "coordinator",
            "wrong_shape",
            "at most length 10, got 11",
        ),
        (
            packed(*content(sample(Plan))[:-6], "sold"),
            "agent2",
            "out_of_range",
            "status: invalid enum value 'sold'",
        ),
        (
            packed(*content(sample(Plan))[:-6], 7),
            "agent2",
            "wrong_shape",
            "status: expected str, got int",
        ),
        (
            packed(*content(sample(Plan))[:-7], array(4, 1, 1, 1, values=bytes(8)), "solved"),
            "agent2",
            "malformed",
            "array of 4 axes",
        ),
        (
            packed(
                *content(sample(Plan))[:-7], array(1, 1, 0, 0, values=bytes(8), code=2), "solved"
            ),
            "agent2",
            "malformed",
            "unknown extension type 2 of 24 bytes",
        ),
        (packed("plan", "agent-2", *content(sample(Plan))[2:-6], 7), "", "wrong_shape", "status"),
        (
            packed("plan", ["agent2"], *content(sample(Plan))[2:]),
            "",
            "wrong_shape",
            "sender: expected str",
        ),
    ],
)
def test_why_and_whose(data: bytes, sender: str, reason: str, text: str) -> None:
    """A refusal has one of a few reasons, names the field, and the sender where the bytes can be read that far."""
    with pytest.raises(MessageError, match=text) as caught:
        decode(data)
    assert (caught.value.reason, caught.value.sender) == (reason, sender)


ARRAYS = [(kind, field) for kind in CLASSES.values() for field in kind.shapes]


@pytest.mark.parametrize(("kind", "field"), ARRAYS)
def test_arrays_are_checked(kind: type[Message], field: str) -> None:
    """An array of a wrong shape, with an entry that is not finite, or no array, is refused with its field."""
    good = fields(kind)[field]
    shorter = good[:-1] if good.ndim == 1 else good[:, :-1]
    wrong = [np.zeros((*good.shape, 1)), np.zeros(())]
    if (kind, field) != (Plan, "data"):  # of any length
        wrong.append(shorter)
    for value in wrong:
        with pytest.raises(MessageError, match=rf"{field}: expected shape \("):
            decode(encode(sample(kind, **{field: value})))
    for number in (NAN, INF, -INF):
        bad = good.copy()
        bad.flat[-1] = number
        with pytest.raises(MessageError, match=f"{field}: expected finite numbers"):
            decode(encode(sample(kind, **{field: bad})))
    with pytest.raises(MessageError, match=f"{field}: expected numpy.ndarray, got"):
        decode(packed(*content(sample(kind, **{field: [1.0]}))))
    largest = sample(kind, **{field: np.full(good.shape, -1.7e308)})
    assert encode(decode(encode(largest))) == encode(largest)  # whose square overflows


def test_data_of_a_plan() -> None:
    """A plan carries up to 4 KB of a user's numbers; without them it is as long as without the field."""
    largest = decode(encode(sample(Plan, data=np.arange(float(MAX_DATA)))))
    assert isinstance(largest, Plan)
    assert largest.data[-1] == MAX_DATA - 1
    with pytest.raises(MessageError, match="data: expected at most 512 numbers, got 513"):
        decode(encode(sample(Plan, data=np.zeros(MAX_DATA + 1))))
    bare = encode(sample(Plan, data=np.zeros(0), stale=0, targets=(), lag=0))
    assert bare == packed(*content(sample(Plan))[:-4])
    without = decode(bare)
    assert isinstance(without, Plan)
    assert without.data.shape == (0,)
    for count in (29, 30, 31):  # an extension of 256 bytes has a longer header than a shorter one
        plan = sample(Plan, data=np.zeros(count))
        assert encoded_length(plan) == len(encode(plan))


def test_the_largest_message_is_read() -> None:
    """One byte more is refused for its size alone, whatever it is."""
    for length, reason in ((MAX_BYTES, "malformed"), (MAX_BYTES + 1, "oversized")):
        with pytest.raises(MessageError) as refused:
            decode(bytes([VERSION]).ljust(length, b"\0"))
        assert refused.value.reason == reason


def test_age_of_a_plan() -> None:
    """A plan with fresh inputs is as long as without the field; none is older than the run."""
    fresh = sample(Plan, stale=0, targets=(), lag=0)
    assert encode(fresh) == packed(*content(sample(Plan))[:-3])
    assert decode(encode(fresh)).stale == 0  # type: ignore[attr-defined]
    first = sample(Plan, tick=3, stale=3, data=np.zeros(0))
    assert decode(encode(first)).solved_tick == 0  # type: ignore[attr-defined]
    for ticks in (4, 2**48):
        with pytest.raises(MessageError, match=f"stale: .* 3 ticks so far, got {ticks}") as refused:
            decode(encode(sample(Plan, tick=3, stale=ticks)))
        assert refused.value.reason == "out_of_range"
    for lag in (4, 2**48):
        with pytest.raises(MessageError, match=f"lag: .* 3 ticks so far, got {lag}") as refused:
            decode(encode(sample(Plan, tick=3, lag=lag)))
        assert refused.value.reason == "out_of_range"
    with pytest.raises(MessageError, match="stale") as refused:  # fresh at a tick to come
        decode(encode(sample(Plan, tick=3, stale=-1)))
    assert refused.value.reason == "out_of_range"


def test_a_plan_counts_the_steps_it_has_played() -> None:
    """From its start on, and from the tick at which its inputs were fresh."""
    plan = sample(Plan, tick=10, start_tick=11, stale=4)
    assert (plan.solved_tick, plan.played(13)) == (6, 6)


@pytest.mark.parametrize(
    ("changes", "words", "first_tick"),
    [
        ({}, "target (0, 1, 2) m", 3),
        ({"to": (2, 4)}, "target (0, 1, 2) m, told to agent2, agent4", 3),
        ({"lands": True}, "landing (6, 7, 8) m", 3),
        ({"begins": 9}, "target (0, 1, 2) m", 9),
        ({"begins": 9, "brakes": True}, "target (0, 1, 2) m", 3),
    ],
)
def test_a_target_tells_where_and_from_when_on(
    changes: dict[str, Any], words: str, first_tick: int
) -> None:
    """A landing is named by its place; one that is confirmed begins when all had it, braking at its own tick."""
    plain = {"to": (), "informed": (), "got": (), "begins": 0, "lands": False, "brakes": False}
    target = sample(Target, **plain | changes)
    assert (target.in_words(), target.first_tick) == (words, first_tick)


UAV = {"uavs": (2,), "uav_states": np.zeros((1, 12)), "inputs": np.zeros((1, 4))}


def steps(count: int) -> dict[str, Any]:
    """Return the inputs of a plan of one UAV, without corrections."""
    return UAV | {"inputs": np.zeros((count, 4)), "corrections": np.zeros((0, 4))}


ALL_IDS = tuple(range(1, 257))


def points(count: int) -> dict[str, Any]:
    """Return the points of a target."""
    return {"points": np.zeros((count, 3)), "times": np.zeros(count)}


@pytest.mark.parametrize(
    ("kind", "possible", "beyond", "text"),
    [
        (Plan, steps(1), steps(0), "inputs: expected 1 to 10000 steps, got 0"),
        (Plan, steps(10_000), steps(10_001), "inputs: expected 1 to 10000 steps, got 10001"),
        (
            Plan,
            steps(2) | {"corrections": np.zeros((2, 4))},
            steps(2) | {"corrections": np.zeros((1, 4))},
            "corrections: expected none or 2 steps, got 1",
        ),
        (Plan, {"negotiation": 19}, {"negotiation": 20}, "negotiation"),
        (Plan, {"alone": 1.0}, {"alone": 1.01}, "alone"),
        (Plan, {"tick": 3, "lag": 3}, {"tick": 3, "lag": 4}, "lag"),
        (Airtime, {"negotiation": 19}, {"negotiation": 20}, "negotiation"),
        (Airtime, {}, {"exchanges": (0,)}, "exchanges: expected one for each of 2 agents, got 1"),
        (Target, points(1), points(0), "points: expected 1 to 256, got 0"),
        (Target, points(256), points(257), "points: expected 1 to 256, got 257"),
        (Target, {"number": 1}, {"number": 0}, "number"),
        (
            Target,
            {"informed": (1,), "got": (0,)},
            {"informed": (1,), "got": ()},
            "got: expected one",
        ),
        (LinkChange, {"number": 1}, {"number": 0}, "number"),
        (Roster, {"incarnations": (0, 2)}, {"incarnations": (0,)}, "incarnations: expected one"),
        (StepReport, {}, {"state_ages": (1,)}, "state_ages: expected one for each of 2 peers"),
        (StepReport, {"measurement_age": -1}, {"measurement_age": -2}, "measurement_age"),
        (PlantState, {"plan_ticks": (-3, 0)}, {"plan_ticks": (-4, 0)}, "plan_ticks"),
        (VehicleStatus, {"plan_tick": -3}, {"plan_tick": -4}, "plan_tick"),
        (Tick, {"members": (1, 256)}, {"members": (0, 1)}, "members"),
        (Tick, {"members": ALL_IDS}, {"members": (257,)}, "members"),
        (Tick, {"answered": ALL_IDS}, {"answered": (*ALL_IDS, 256)}, "answered"),
        (
            Roster,
            {"agents": ALL_IDS, "incarnations": (0,) * 256},
            {"agents": (1,), "incarnations": (-1,)},
            "incarnations",
        ),
        (Control, {"reason": "x" * 1_000}, {"reason": "x" * 1_001}, "reason"),
        (
            Note,
            {"names": ("x" * 80,) * 64, "values": np.zeros(64)},
            {"names": ("x",) * 65, "values": np.zeros(65)},
            "names",
        ),
        (Note, {}, {"names": ("x" * 81, "y")}, "names"),
        (Plan, {"targets": (b"x" * 16_384,) * 8}, {"targets": (b"x",) * 9}, "targets"),
        (Plan, {}, {"targets": (b"x" * 16_385,)}, "targets"),
        (Control, {"exit_code": 255}, {"exit_code": 256}, "exit_code"),
        (Rejected, {"count": 1}, {"count": 0}, "count"),
        (
            Measurement,
            UAV | {"missing": (1,)},
            UAV | {"missing": (1, 1)},
            "missing: expected none or one",
        ),
        (Measurement, UAV | {"missing": ()}, UAV | {"uavs": (2, 3)}, "uav_states: expected shape"),
    ],
)
def test_each_limit_is_kept_and_no_more(
    kind: type[Message], possible: dict[str, Any], beyond: dict[str, Any], text: str
) -> None:
    """The last value that a field may have is read, the next one refused with the field."""
    message = sample(kind, **possible)
    assert encode(decode(encode(message))) == encode(message)
    with pytest.raises(MessageError, match=text):
        decode(encode(sample(kind, **beyond)))


def test_own_messages_keep_their_arrays() -> None:
    """A stamped message owns its arrays.

    Later changes of what it was made from do not reach it, nor can it change.
    """
    given_fields = {
        name: value
        for name, value in fields(Measurement).items()
        if name not in ("sender", "sequence")
    }
    del given_fields["incarnation"]
    payload = given_fields["payload"] = np.arange(12)
    message = Outbox("plant", 0).stamp(Measurement, **given_fields)
    payload += 1
    np.testing.assert_array_equal(message.payload, np.arange(12.0))
    with pytest.raises(ValueError, match="read-only"):
        message.payload[0] = 1.0
    with pytest.raises(AttributeError):
        message.tick = 3  # type: ignore[misc]
    whole_numbers: Any = decode(encode(changed(message, payload=np.arange(12))))
    np.testing.assert_array_equal(whole_numbers.payload, np.arange(12.0))
    with pytest.raises(TypeError, match="cannot send"):
        encode(changed(message, payload=np.zeros((1, 1, 1, 1))))
