"""Messages as bytes: round trips bit for bit, and nothing but `MessageError` from bytes that are no message."""

import dataclasses
import struct
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.wire.codec import MAX_BYTES, VERSION, decode, encode
from protocol.wire.messages import BUNDLES, KINDS, Message, MessageError, Plan, Tick
from tests.support.samples import fields, sample, samples
from tests.support.strategies import bundles, messages

SEED = 20240611
RANDOM_MESSAGES = 20_000  # of each sort; some seconds in all
DEPTHS = (10, 100, 500, 900, 1000, 1020, 1100, 10_000, 1_000_000)  # around the limits of interpreter and msgpack


def bits(value: Any) -> Any:
    """A field in a form whose equality is equality of bits and types."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, tuple):
        return tuple((type(entry), entry) for entry in value)
    return type(value), value


def content(message: Message) -> Any:
    """Kind and bits of every field."""
    return message.kind, [bits(getattr(message, field.name)) for field in dataclasses.fields(message)]


def packed(*values: Any, version: int = VERSION) -> bytes:
    """Bytes of any values as a sender without this code would pack them."""
    body: bytes = msgpack.packb(list(values))
    return bytes([version]) + body


def wire(message: Message) -> list[Any]:
    """Kind and fields of a message as msgpack has them, arrays as extension types."""
    listed: list[Any] = msgpack.unpackb(encode(message)[1:])
    return listed


def array(*header: int, values: int = 0, code: int = 1) -> msgpack.ExtType:
    """An array on the wire whose header says one thing and whose body holds `values` numbers."""
    return msgpack.ExtType(code, struct.pack("<4I", *header) + bytes(8 * values))


def survives(data: bytes) -> Message | None:
    """Decode arbitrary bytes: the result is `MessageError` or a complete message."""
    try:
        message = decode(data)
    except MessageError:
        return None
    assert content(decode(encode(message))) == content(message)
    return message


@given(messages | bundles)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_round_trip(message: Message) -> None:
    """decode(encode(m)) equals m bit for bit, signed zeros included, and encodes to the same bytes again."""
    data = encode(message)
    again = decode(data)
    assert content(again) == content(message)
    assert encode(again) == data
    assert data[0] == VERSION


@pytest.mark.parametrize("message", samples(), ids=lambda message: message.kind)
def test_truncated(message: Message) -> None:
    """Every proper prefix of an encoded message is refused, and so is a message with anything behind it."""
    data = encode(message)
    for length in range(len(data)):
        assert survives(data[:length]) is None
    for tail in (b"\0", b"\xc0", data, data[1:]):
        assert survives(data + tail) is None


@pytest.mark.parametrize("message", samples(), ids=lambda message: message.kind)
def test_every_flipped_bit(message: Message) -> None:
    """With any one bit flipped an encoded message is refused or another valid one."""
    data = bytearray(encode(message))
    for at in range(len(data)):
        for bit in range(8):
            data[at] ^= 1 << bit
            survives(bytes(data))
            data[at] ^= 1 << bit


def test_changed_bytes() -> None:
    """With one to four bytes replaced an encoded message is refused or another valid one."""
    rng = np.random.default_rng(SEED)
    encoded = [encode(message) for message in samples()]
    for _ in range(RANDOM_MESSAGES):
        data = bytearray(encoded[rng.integers(len(encoded))])
        for at in rng.integers(len(data), size=rng.integers(1, 5)):
            data[at] = rng.integers(256)
        survives(bytes(data))


def test_random_bytes() -> None:
    """Random bytes, alone and behind a valid version byte and list header, are refused or a valid message."""
    rng = np.random.default_rng(SEED)
    for i in range(RANDOM_MESSAGES):
        data = rng.bytes(int(rng.integers(0, 80)))
        prefix = (b"", bytes([VERSION]), bytes([VERSION, 0x90 + i % 16]), bytes([VERSION]) + b"\x98\xa4tick")[i % 4]
        survives(prefix + data)


@given(st.binary(max_size=200))
@settings(max_examples=300, deadline=None, derandomize=True)
def test_any_bytes(data: bytes) -> None:
    """Arbitrary bytes are refused or a valid message, with and without the version byte."""
    survives(data)
    survives(bytes([VERSION]) + data)


def test_well_formed_garbage() -> None:
    """Fields of every other type msgpack knows, in every place, are refused or a valid message."""
    rng = np.random.default_rng(SEED)
    garbage: list[Any] = [
        None, True, -1, 0, 1, 2**48, 2**64 - 1, -(2**63), 0.5, float("nan"), float("inf"), "", "solved", "plant",
        "x" * 2000, b"", b"\xff", [], [1, 2], [2, 1], [[]], [None], {}, {"a": 1}, {"": []}, [1] * 300,
        msgpack.Timestamp(1, 2), array(0, 0, 0, 0, values=1), array(1, 0, 0, 0), array(1, 2, 0, 0, values=2),
        array(2, 2, 12, 0, values=24), array(3, 1, 1, 1, values=1), [array(1, 1, 0, 0, values=1)], array(2, 0, 12, 0),
    ]  # fmt: skip
    wires = [wire(message) for message in samples()]
    for _ in range(RANDOM_MESSAGES):
        values = list(wires[rng.integers(len(wires))])
        for at in rng.integers(len(values), size=rng.integers(1, 4)):
            values[at] = garbage[rng.integers(len(garbage))]
        survives(packed(*values))


def test_refusal_is_one_line() -> None:
    """An array in a field's place is shown on one line: the text ends up in counters and logs."""
    values = wire(sample(Tick))
    with pytest.raises(MessageError) as caught:
        decode(packed(*[*values[:-1], array(2, 3, 8, 0, values=24)]))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("version", [0, VERSION + 1, 0xFF])
def test_other_versions(version: int) -> None:
    """A message of another protocol version is refused with both versions in the text."""
    data = bytes([version]) + encode(sample(Tick))[1:]
    with pytest.raises(MessageError, match=f"protocol version {version}, expected {VERSION}"):
        decode(data)


def test_empty() -> None:
    """No bytes at all are refused."""
    with pytest.raises(MessageError, match="empty"):
        decode(b"")


def test_oversized() -> None:
    """More bytes than the largest message are refused undecoded."""
    with pytest.raises(MessageError, match=f"message of {MAX_BYTES + 1} bytes, at most {MAX_BYTES}"):
        decode(bytes([VERSION]) + b"\x90" * MAX_BYTES)


@pytest.mark.parametrize("message", samples(), ids=lambda message: message.kind)
def test_wrong_number_of_fields(message: Message) -> None:
    """A field too few or too many is refused with both numbers in the text."""
    values = wire(message)
    expected = len(fields(type(message)))
    for changed in (values[:-1], [*values, 0], values[:1]):
        with pytest.raises(MessageError, match=f"{message.kind}: expected {expected} fields, got {len(changed) - 1}"):
            decode(packed(*changed))


@pytest.mark.parametrize("kind", ["", "Tick", "ticks", "x" * 10_000, "tick\0"])
def test_unknown_kind(kind: str) -> None:
    """An unknown kind is refused and named, cut to a readable length."""
    with pytest.raises(MessageError, match="unknown message kind") as caught:
        decode(packed(kind, *wire(sample(Tick))[1:]))
    assert len(str(caught.value)) < 100


@pytest.mark.parametrize("body", [b"\x90", b"\x80", b"\xc0", b"\x01", b"\x91\xc0", b"\x91\x90", b"\xa4tick", b"\xc1"])
def test_not_a_list_that_starts_with_a_kind(body: bytes) -> None:
    """Valid msgpack of another form, and the one byte msgpack never uses, are refused."""
    with pytest.raises(MessageError, match=r"expected a list that starts with a message kind|not msgpack"):
        decode(bytes([VERSION]) + body)


@pytest.mark.parametrize(
    "lie",
    [
        array(2, 3, 8, 0, values=23),
        array(2, 3, 8, 0, values=25),
        array(2, 3, 8, 0),
        array(2, 3, 4, 0, values=12),
        array(2, 8, 3, 0, values=24),
        array(1, 24, 0, 0, values=24),
        array(3, 3, 8, 1, values=24),
        array(0, 3, 8, 0, values=24),
        array(0, 0, 0, 0, values=1),
        array(4, 3, 8, 1, values=24),
        array(2**32 - 1, 3, 8, 1, values=24),
        array(2, 2**32 - 1, 2**32 - 1, 0, values=24),
        array(2, 2**31, 2**32 - 1, 0, values=1),
        array(3, 0, 2**32 - 1, 2**32 - 1),
        array(2, 3, 8, 0, values=24, code=2),
        msgpack.ExtType(1, b""),
        msgpack.ExtType(1, bytes(15)),
        msgpack.ExtType(127, bytes(16)),
        struct.pack("<4I", 2, 3, 8, 0) + bytes(192),
        [[0.0] * 8] * 3,
    ],
)
def test_array_that_lies_about_its_shape(lie: object) -> None:
    """An array whose header does not fit its body, or whose shape is not the field's, is refused."""
    values = wire(sample(Plan))
    at = 1 + [field.name for field in dataclasses.fields(Plan)].index("inputs")
    assert decode(packed(*values)).kind == "plan"
    assert survives(packed(*[*values[:at], lie, *values[at + 1 :]])) is None


@pytest.mark.parametrize(
    ("lie", "reason"),
    [
        (array(2, 3, 8, 0, values=23), r"array of shape \(3, 8\) in 184 bytes"),
        (array(4, 3, 8, 1, values=24), "array of 4 axes, at most 3 allowed"),
        (array(2, 3, 8, 0, values=24, code=2), "unknown extension type 2 of 208 bytes"),
        (msgpack.ExtType(1, bytes(15)), "unknown extension type 1 of 15 bytes"),
        (array(2, 3, 4, 0, values=12), r"inputs: expected shape \(any, 8\), got \(3, 4\)"),
    ],
)
def test_what_an_array_lies_about_is_told(lie: object, reason: str) -> None:
    """The refusal of an array says what does not fit."""
    values = wire(sample(Plan))
    at = 1 + [field.name for field in dataclasses.fields(Plan)].index("inputs")
    with pytest.raises(MessageError, match=reason):
        decode(packed(*[*values[:at], lie, *values[at + 1 :]]))


@pytest.mark.parametrize(
    ("data", "sender", "reason"),
    [
        (b"", "", "malformed"),
        (bytes([VERSION]) + bytes(MAX_BYTES), "", "oversized"),
        (bytes([VERSION + 1]) + encode(sample(Tick))[1:], "", "wrong_version"),
        (encode(sample(Tick))[:-1], "", "malformed"),
        (packed({"tick": 1}), "", "malformed"),
        (packed("truce", "agent2"), "", "unknown_kind"),
        (packed("tick", "agent2"), "", "wrong_shape"),
        (packed(*[*wire(sample(Plan))[:-1], array(4, 1, 1, 1, values=1)]), "", "malformed"),
        (packed(*[*wire(sample(Plan))[:-1], "sold"]), "agent2", "out_of_range"),
        (packed(*[*wire(sample(Plan))[:-1], 7]), "agent2", "wrong_shape"),
        (packed("plan", "agent-2", *wire(sample(Plan))[2:]), "", "out_of_range"),
        (packed("plan", ["agent2"], *wire(sample(Plan))[2:]), "", "wrong_shape"),
    ],
)
def test_why_and_whose(data: bytes, sender: str, reason: str) -> None:
    """A refusal has one of a few reasons, and names the sender where the bytes can be read that far."""
    with pytest.raises(MessageError) as caught:
        decode(data)
    assert (caught.value.reason, caught.value.sender) == (reason, sender)


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1k"], ids=["lists", "maps"])
def test_deep_nesting(depth: int, opening: bytes) -> None:
    """Containers in containers to any depth, alone and in a field's place, are refused, not a stack overflow."""
    nest = opening * depth + b"\xc0"
    assert survives(bytes([VERSION]) + nest) is None
    values = wire(sample(Tick))
    for at in range(len(values)):
        parts = [nest if i == at else msgpack.packb(value) for i, value in enumerate(values)]
        assert survives(bytes([VERSION, 0x90 + len(values)]) + b"".join(parts)) is None


@pytest.mark.parametrize("header", [b"\xdd", b"\xdf", b"\xc6", b"\xdb", b"\xc9"])
def test_claimed_lengths_are_not_believed(header: bytes) -> None:
    """A container or text that claims 2**32 - 1 entries is refused without making room for them."""
    for place in (b"", b"\x98\xa4tick", b"\x91"):
        assert survives(bytes([VERSION]) + place + header + b"\xff\xff\xff\xff\x01") is None


def test_only_arrays_and_plain_values_are_sent() -> None:
    """Every kind of message and bundle can be sent; an array with more axes than its header can hold raises."""
    assert {decode(encode(message)).kind for message in samples()} == {*KINDS, *BUNDLES}
    message = sample(Plan)
    object.__setattr__(message, "inputs", np.zeros((1, 1, 1, 1)))
    with pytest.raises(TypeError, match="cannot send"):
        encode(message)
