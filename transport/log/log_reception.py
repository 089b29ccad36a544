"""Reading the entries of a log as a receiver of the run would have read them when they came.

The log holds what came, also what was forged, repeated or garbled. Here every message passes the checks of
`protocol.admission`: form, key and sender, order, plausibility. Refused ones are counted and reported in the name of
the recorder.
"""

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path

import orjson

from protocol.admission.admission import Admission
from protocol.admission.plausibility import Plausibility
from protocol.admission.unbundling import Unbundling
from protocol.scenario.file import ScenarioError, validate
from protocol.scenario.setup import Setup
from protocol.wire.codec import decode
from protocol.wire.keys import RECORDER
from protocol.wire.messages import Bundle, Message, MessageError
from protocol.wire.rejections import Rejections
from transport.log.channels import KEYS, OWN, TOKENS

# A message, and its bytes if they are in the entry just read.
Read = tuple[Message, bytes | None]


class LogReception:
    """Checks the entries of one log in their order.

    Without the setup of the run, sizes, senders, moments and plausibility are not checked.
    """

    def __init__(self, setup: Setup | None) -> None:
        rejections = Rejections()
        self._admission = Admission(RECORDER, KEYS, setup, rejections)
        self._unbundling = Unbundling(RECORDER, KEYS, self._admission)
        self._plausibility = None if setup is None else Plausibility(setup)
        self._rejections = rejections
        self._announced: dict[str, int] = {}
        self._damaged = 0

    def read(self, topic: str, data: bytes, at_ns: int, damaged: int = 0) -> Iterator[Read]:
        """Yield the messages of an entry that arrived at a time, ns, and of earlier ones that waited for it.

        `damaged` is the number of damaged parts of the log so far: messages behind one may be of any later tick.

        Raises: MessageError: the recorder did not write this.
        """
        if topic.startswith(OWN):
            yield decode(data), data
            return
        if topic == TOKENS:
            self._announce(data, damaged)
        else:
            message = self._admission.read(KEYS.prefix + topic, data)
            if message is not None:
                yield from self._checked(message, data)
        while (message := self._admission.released()) is not None:
            yield from self._checked(message, None)
        for notice in self._admission.due_notices(at_ns, 0):
            yield notice, None

    def close(self) -> Iterator[Read]:
        """Yield what is to be said at the end of the log."""
        self._admission.close()
        for notice in self._admission.remaining_notices(0):
            yield notice, None

    def _checked(self, message: Message, data: bytes | None) -> Iterator[Read]:
        """Yield a message, or those of a bundle, if they are plausible."""
        if not isinstance(message, Bundle):
            if self._is_plausible(message):
                yield message, data
            return
        self._unbundling.open(message)
        while (part := self._unbundling.next()) is not None:
            if self._is_plausible(part):
                yield part, None if data is None else self._unbundling.data

    def _is_plausible(self, message: Message) -> bool:
        try:
            if self._plausibility is not None:
                self._plausibility.check(message)
        except MessageError as error:
            self._rejections.add(message.sender, error)
            return False
        return True

    def _announce(self, data: bytes, damaged: int) -> None:
        """Take note of tokens; all of them anew behind a damaged part, which may have had others."""
        try:
            content = orjson.loads(data)
            announced, now = dict(content["announced"]), set(content["now"])
        except (ValueError, TypeError, KeyError) as error:
            raise MessageError("malformed", f"tokens: {error}") from error
        for name, incarnation in announced.items():
            if name in now or damaged > self._damaged or self._announced.get(name) != incarnation:
                self._admission.announce(name, incarnation)
        self._announced, self._damaged = announced, damaged


def setup_in(header: Mapping[str, str], folder: Path) -> Setup | None:
    """Return the run of a log from its header, None if the scenario is missing or of another version.

    Files named in the scenario lie beside the log, in its run folder.
    """
    source = str(folder / "scenario.toml")
    try:
        return Setup.of(validate(tomllib.loads(header.get("scenario", "")), source), source)
    except (ScenarioError, tomllib.TOMLDecodeError):
        return None
