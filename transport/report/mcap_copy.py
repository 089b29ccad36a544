"""A copy of a log in another format, for viewers, as an MCAP file."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from mcap.writer import CompressionType, Writer

from transport.model.arrays import Array
from transport.protocol.scenario.whole_files import atomic_file
from transport.scene.parts import quaternion

# Metadata record with the header of the log; another name than in a log, which the copy is not.
METADATA = "exported run"
_ORIGIN = np.zeros(3)
_LEVEL = np.eye(3)
_BRIGHTEST = 255.0

# Fields of a message by name.
Fields = dict[str, Any]


class Schema(NamedTuple):
    """Schema of messages."""

    name: str
    encoding: str
    content: bytes
    messages: str  # encoding of the messages


class Put(Protocol):
    """A function that writes a message to a copy of a log."""

    def __call__(
        self,
        topic: str,
        schema: Schema,
        data: bytes,
        at_ns: int,
        *,
        published_ns: int = 0,
        number: int = 0,
    ) -> None:
        """Write a message with its time; its time of publication and number if they are others."""


@contextmanager
def mcap_copy(out: Path, header: Mapping[str, str], profile: str = "") -> Iterator[Put]:
    """Open a copy of the log with a header, and give the function that writes a message.

    The file gets its name once it is complete.
    """
    with atomic_file(out) as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile=profile, library="payload-transport")
        writer.add_metadata(METADATA, dict(header))
        yield _Copy(writer)
        writer.finish()  # type: ignore[no-untyped-call]


class _Copy:
    """Messages of a copy; a topic gets its channel with its first message."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channel_of_topic: dict[str, int] = {}

    def __call__(
        self,
        topic: str,
        schema: Schema,
        data: bytes,
        at_ns: int,
        *,
        published_ns: int = 0,
        number: int = 0,
    ) -> None:
        """Write a message."""
        if topic not in self._channel_of_topic:
            registered = self._writer.register_schema(schema.name, schema.encoding, schema.content)
            channel = self._writer.register_channel(topic, schema.messages, registered)
            self._channel_of_topic[topic] = channel

        self._writer.add_message(
            self._channel_of_topic[topic],
            at_ns,
            data,
            publish_time=published_ns or at_ns,
            sequence=number,
        )


def point_fields(point: Array) -> Fields:
    """Return a point or vector, (3,), as Foxglove and ROS 2 have it."""
    return dict(zip("xyz", point.tolist(), strict=True))


def pose_fields(position: Array = _ORIGIN, R: Array = _LEVEL) -> Fields:
    """Return a position, (3,), m, and a rotation, (3, 3), as Foxglove and ROS 2 have them."""
    orientation = dict(zip("wxyz", quaternion(R).tolist(), strict=True))
    return {"position": point_fields(position), "orientation": orientation}


def colour_fields(colour: Iterable[float], opacity: float = 1.0) -> Fields:
    """Return a colour, 0..255, as Foxglove and ROS 2 have it."""
    red, green, blue = (float(channel) / _BRIGHTEST for channel in colour)
    return {"r": red, "g": green, "b": blue, "a": float(opacity)}
