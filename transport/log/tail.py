"""A log read while it is written, by readers that take no part in the run."""

from collections import OrderedDict
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata
from mcap.writer import MCAP0_MAGIC

from protocol.scenario.setup import Setup
from protocol.wire.codec import decode
from protocol.wire.messages import KINDS, Message, MessageError, Plan, StepReport
from transport.log.channels import is_known
from transport.log.log_file import METADATA
from transport.log.log_reception import LogReception, Read, setup_in
from transport.log.run_log import LogError
from transport.log.salvage import DAMAGE, MESSAGE_HEADER, chunk_content, frames, records

# Decompressed chunks kept in memory: messages that are looked up together lie close together.
_CACHED_CHUNKS = 8


class Chunks:
    """Decompressed chunks of one log file, read on demand."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._cache: OrderedDict[tuple[int, int], bytes] = OrderedDict()

    def content(self, offset: int, size: int) -> bytes | None:
        """Return the content of the chunk whose body lies at an offset, bytes; None if it cannot be read any more."""
        data = self._cache.pop((offset, size), None)
        if data is None:
            try:
                with self._path.open("rb") as file:
                    file.seek(offset)
                    data = chunk_content(file.read(size))
            except (OSError, *DAMAGE):
                return None
        self._cache[offset, size] = data
        if len(self._cache) > _CACHED_CHUNKS:
            self._cache.popitem(last=False)
        return data


@dataclass(frozen=True, slots=True, kw_only=True)
class Unread:
    """A message that stays in the file until it is needed.

    Attributes:
        kind: Key of `protocol.wire.messages.KINDS`.
        tick: k.
        agent: 1-based.
        negotiation: Iterations still to come, for a plan; 0 for other messages.
        chunks: Chunks of its log.
        chunk: Offset and size of its chunk, bytes.
        span: Where it begins and ends in the content of the chunk, bytes.
    """

    kind: str
    tick: int
    agent: int
    negotiation: int
    chunks: Chunks
    chunk: tuple[int, int]
    span: tuple[int, int]

    def message(self) -> Message | None:
        """Return the message; None if it is damaged, or the file is gone or replaced."""
        data = self.chunks.content(*self.chunk)
        if data is None:
            return None
        try:
            message = decode(data[slice(*self.span)])
        except MessageError:
            return None
        return message if (message.kind, message.tick) == (self.kind, self.tick) else None


class LogTail:
    """Reader that follows one log and checks its messages as `read_log` does.

    Args:
        path: The file, which need not exist yet.
        kinds: Kinds of messages to return.
        later: Those of them that are left in the file as `Unread`, which saves most of the memory.
        setup: The run, if it is known already; otherwise it is taken from the header of the log.

    Attributes:
        ended: Whether the data section has come to its proper end.
    """

    def __init__(
        self, path: Path, kinds: Collection[str] = KINDS, later: Collection[str] = (), setup: Setup | None = None
    ) -> None:
        self._path, self._wanted, self._later = path, frozenset(kinds), frozenset(later)
        self._chunks = Chunks(path)
        self._offset = len(MCAP0_MAGIC)  # of the next record
        self._topics: dict[int, str] = {}  # by channel
        self._setup = setup
        self._reception: LogReception | None = None
        self._damaged = 0  # parts of the file
        self.ended = False

    def read(self) -> list[Message | Unread]:
        """Return the new messages, in order; a record written only in part waits for the next call.

        Damage is skipped silently: `read_log` reports it.

        Raises: LogError: the file cannot be read.
        """
        found: list[Message | Unread] = []
        if self.ended:
            return found
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                for opcode, offset, body in frames(file):
                    self._offset = offset + len(body)
                    try:
                        self._read_record(opcode, offset, body, found)
                    except DAMAGE:
                        self._damaged += 1
                    if opcode == Opcode.DATA_END:
                        self.ended = True
                        if self._reception is not None:
                            found += [message for message, _ in self._reception.close()]
                        break
        except FileNotFoundError:
            pass
        except OSError as error:
            raise LogError(f"{self._path}: cannot read the log ({error.strerror or error})") from error
        return found

    def _read_record(self, opcode: int, offset: int, body: bytes, found: list[Message | Unread]) -> None:
        """Append the messages in a record of the file.

        Raises: one of `DAMAGE`: it cannot be decoded.
        """
        for code, data, begin, end in records(opcode, body):
            if code == Opcode.METADATA:
                metadata = Metadata.read(ReadDataStream(BytesIO(data[begin:end])))
                if metadata.name == METADATA and self._setup is None:
                    self._setup = setup_in(metadata.metadata, self._path.parent)
            elif code == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(data[begin:end])))
                if is_known(channel):
                    self._topics[channel.id] = channel.topic
            elif code == Opcode.MESSAGE:
                number, _, _, received_ns = MESSAGE_HEADER.unpack(data[begin : min(begin + MESSAGE_HEADER.size, end)])
                topic = self._topics.get(number)
                begin += MESSAGE_HEADER.size
                if topic is None:
                    continue
                if self._reception is None:
                    self._reception = LogReception(self._setup)
                with suppress(MessageError):
                    for read in self._reception.read(topic, data[begin:end], received_ns, self._damaged):
                        if read[0].kind not in self._wanted:
                            continue
                        chunk = (offset, len(body)) if opcode == Opcode.CHUNK else None
                        found.append(self._unread(read, data, begin, chunk) or read[0])

    def _unread(self, read: Read, content: bytes, begin: int, chunk: tuple[int, int] | None) -> Unread | None:
        """Return a message as one that stays in the file; None if it must not, or its bytes are elsewhere.

        Args:
            read: Message and bytes.
            content: Content of the chunk.
            begin: Where its entry begins there.
            chunk: Offset and size of the chunk; None for an entry outside of one.
        """
        message, data = read
        if message.kind not in self._later or not isinstance(message, Plan | StepReport):
            return None
        if chunk is None or data is None:
            return None
        at = content.find(data, begin)
        return Unread(
            kind=message.kind,
            tick=message.tick,
            agent=message.agent,
            negotiation=message.negotiation if isinstance(message, Plan) else 0,
            chunks=self._chunks,
            chunk=chunk,
            span=(at, at + len(data)),
        )
