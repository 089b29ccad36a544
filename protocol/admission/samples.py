"""Messages handed over as they came, for the recorder: only the header is read."""

from collections.abc import Collection
from dataclasses import dataclass

from protocol.wire.codec import class_of
from protocol.wire.header import Header, header_of
from protocol.wire.keys import Keys
from protocol.wire.messages import MessageError
from protocol.wire.names import AGENT, agent_name


@dataclass(frozen=True, slots=True)
class Sample:
    """Event: a message as it came, under a key that belongs to the sender that its header names."""

    key: str
    data: bytes
    header: Header


class Samples:
    """Recognition of samples.

    Args:
        kinds: Kinds of messages to hand over, each of which one role sends.
        keys: Keys of the run.
        agents: Agents of the run.
    """

    def __init__(self, kinds: Collection[str], keys: Keys, agents: Collection[int]) -> None:
        self._owners: dict[tuple[str, str], str] = {}  # sender by key and kind
        for kind in kinds:
            route = class_of(kind).route
            for beginning in filter(None, (route.key or kind, route.unshared_key)):
                for agent in agents:
                    key = f"{keys.prefix}/{beginning}/{agent}" if route.each else f"{keys.prefix}/{beginning}"
                    self._owners[key, kind] = agent_name(agent) if route.sender == AGENT else str(route.sender)

    def take(self, key: str, data: bytes) -> Sample | None:
        """Return a message as a sample; None if all of it must be read."""
        if not self._owners:
            return None
        try:
            header = header_of(data)
        except MessageError:
            return None
        known = header is not None and self._owners.get((key, header.kind)) == header.sender
        return Sample(key, data, header) if header is not None and known else None
