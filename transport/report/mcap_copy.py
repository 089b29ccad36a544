"""A copy of a log in another format, for viewers, as an MCAP file."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from mcap.writer import CompressionType, Writer

from transport.report.report import atomic_file

# Metadata record with the header of the log; another name than in a log, which the copy is not.
METADATA = "exported run"


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
