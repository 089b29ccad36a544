"""A log read while it is written, by readers that take no part in the run."""

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path

from protocol.scenario.setup import Setup
from protocol.wire.messages import KINDS, Message, MessageError
from transport.log.channels import METADATA, is_known
from transport.log.parser import Parser
from transport.log.run_log import LogReception, reading, setup_in


class LogTail:
    """Reader that follows one log and checks its messages as `read_log` does.

    Args:
        path: The file, which need not exist yet.
        kinds: Kinds of messages to return.
        setup: The run, if it is known already; otherwise it is taken from the header of the log.
    """

    def __init__(
        self, path: Path, kinds: Collection[str] | Mapping[str, object] = KINDS, setup: Setup | None = None
    ) -> None:
        self._path, self._wanted = path, frozenset(kinds)
        self._parser = Parser(path)
        self._setup = setup
        self._reception: LogReception | None = None

    @property
    def ended(self) -> bool:
        """Whether the data section has come to its proper end."""
        return self._parser.ended

    def read(self) -> list[Message]:
        """Return the new messages, in order; a record written only in part waits for the next call.

        Damage is skipped silently: `read_log` reports it.

        Raises: LogError: the file cannot be read, or would become too large.
        """
        found: list[Message] = []
        if self.ended:
            return found
        with reading(self._path), suppress(FileNotFoundError):
            for channel, data, received_ns in self._parser.entries():
                if not is_known(channel):
                    continue
                if self._reception is None:
                    header = self._parser.metadata.get(METADATA, {})
                    self._reception = LogReception(self._setup or setup_in(header, self._path.parent))
                with suppress(MessageError):
                    found += self._reception.read(channel.topic, data, received_ns)
            if self.ended and self._reception is not None:
                found += self._reception.close()
        return [message for message in found if message.kind in self._wanted]
