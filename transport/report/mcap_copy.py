"""A copy of a log in another format, for viewers, as an MCAP file."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer

from transport.model.arrays import Array
from transport.report.report import atomic_file
from transport.scene.parts import quaternion

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


@contextmanager
def mcap_copy(
    out: Path, header: Mapping[str, str], profile: str = ""
) -> Iterator[Callable[..., None]]:
    """Open a copy of the log with a header, which gets its name once it is complete.

    Give the function that writes.

    It takes topic, schema, bytes and time, ns, of a message, and time of publication and number if
    they are others.
    """
    channels: dict[str, int] = {}
    with atomic_file(out) as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile=profile, library="payload-transport")
        writer.add_metadata(METADATA, dict(header))

        def put(
            topic: str, schema: Schema, data: bytes, at_ns: int, published_ns: int = 0, n: int = 0
        ) -> None:
            if topic not in channels:
                channels[topic] = writer.register_channel(
                    topic, schema.messages, writer.register_schema(*schema[:3])
                )
            writer.add_message(
                channels[topic], at_ns, data, publish_time=published_ns or at_ns, sequence=n
            )

        yield put
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
    return dict(
        zip("rgba", (*(float(channel) / 255.0 for channel in colour), float(opacity)), strict=True)
    )
