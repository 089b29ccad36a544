"""Reading the entries of a log as a receiver of the run would have read them when they came.

The log holds what came, also what was forged, repeated or garbled. Every message passes the gate of the run, without
checks of the moment. Refused ones are counted and reported in the name of the recorder.
"""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from protocol.admission.gate import Gate
from protocol.scenario.file import ScenarioError, validate
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode
from protocol.wire.keys import RECORDER
from protocol.wire.messages import Message
from transport.log.channels import KEYS, OWN, TOKENS

# A message, and its bytes if they are in the entry just read.
Read = tuple[Message, bytes | None]


class LogReception:
    """Checks the entries of one log in their order.

    Without the setup of the run, sizes, agents and plausibility are not checked.
    """

    def __init__(self, setup: Setup | None) -> None:
        # The log of an in-memory run has no bundles.
        shape = None if setup is None else replace(setup.shape, relayed=False)
        self._gate = Gate(RECORDER, KEYS, shape)

    def read(self, topic: str, data: bytes, at_ns: int) -> Iterator[Read]:
        """Yield the messages of an entry that arrived at a time, ns.

        Raises: MessageError: the recorder did not write this.
        """
        if topic.startswith(OWN):
            yield decode(data), data
        elif topic != TOKENS:
            for message in self._gate.accept(KEYS.prefix + topic, data):
                if isinstance(message, Message):
                    yield message, self._gate.data
            for notice in self._gate.notices(at_ns, 0):
                yield notice, None

    def close(self) -> Iterator[Read]:
        """Yield what is to be said at the end of the log."""
        for notice in self._gate.last_notices(0):
            yield notice, None


def setup_in(header: Mapping[str, str], folder: Path) -> Setup | None:
    """Return the run of a log from its header, None if the scenario is missing or of another version.

    Files named in the scenario lie beside the log, in its run folder.
    """
    source = str(folder / "scenario.toml")
    try:
        return Setup.of(validate(tomllib.loads(header.get("scenario", "")), source), source)
    except (ScenarioError, tomllib.TOMLDecodeError):
        return None
