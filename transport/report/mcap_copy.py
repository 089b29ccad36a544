"""A copy of a log in another format, for viewers, as an MCAP file."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer

from model.arrays import Array
from transport.report.report import atomic_file
from transport.scene.drawing import quaternion

# Metadata record with the header of the log; another name than in a log, which the copy is not.
METADATA = "exported run"
_ORIGIN, _LEVEL = np.zeros(3), np.eye(3)

# Fields of a message by name.
Fields = dict[str, Any]


class Schema(NamedTuple):
    """Schema of messages: its name, and its encoding and content, and the encoding of the messages."""

    name: str
    encoding: str
    content: bytes
    messages: str


class McapCopy:
    """An MCAP file, whose channels and schemas are registered on first use."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def put(self, topic: str, schema: Schema, data: bytes, at_ns: int, publish_ns: int = -1, sequence: int = 0) -> None:
        """Write a message, published at its time unless told otherwise."""
        if topic not in self._channels:
            if schema.name not in self._schemas:
                self._schemas[schema.name] = self._writer.register_schema(*schema[:3])
            self._channels[topic] = self._writer.register_channel(topic, schema.messages, self._schemas[schema.name])
        published_ns = at_ns if publish_ns < 0 else publish_ns
        self._writer.add_message(self._channels[topic], at_ns, data, publish_time=published_ns, sequence=sequence)


@contextmanager
def mcap_copy(out: Path, header: Mapping[str, str], profile: str = "") -> Iterator[McapCopy]:
    """Open a copy of the log with a header; the file gets its name once it is complete."""
    with atomic_file(out) as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile=profile, library="payload-transport")
        writer.add_metadata(METADATA, dict(header))
        yield McapCopy(writer)
        writer.finish()  # type: ignore[no-untyped-call]


def point_fields(point: Array) -> Fields:
    """Return a point or vector, (3,), as Foxglove and ROS 2 have it."""
    return dict(zip("xyz", point.tolist(), strict=True))


def pose_fields(position: Array = _ORIGIN, R: Array = _LEVEL) -> Fields:
    """Return a position, (3,), m, and a rotation, (3, 3), as Foxglove and ROS 2 have them."""
    orientation = dict(zip("wxyz", quaternion(R).tolist(), strict=True))
    return {"position": point_fields(position), "orientation": orientation}


def colour_fields(colour: Iterable[float], opacity: float = 1.0) -> Fields:
    """Return a colour, 0..255, as Foxglove and ROS 2 have it."""
    return dict(zip("rgba", (*(float(channel) / 255.0 for channel in colour), float(opacity)), strict=True))
