"""The processes of a run that may still send messages to the recorder."""

from collections.abc import Collection

from protocol.wire.messages import Presence


class Departures:
    """Tells which processes have not said that they have sent their last message.

    Attributes:
        present: Their names.
    """

    def __init__(self, expected: Collection[str]) -> None:
        self.present = set(expected)
        self._expected = frozenset(expected)
        self._gone: set[str] = set()  # those of them without a token
        self._newest: dict[str, int] = {}  # incarnations

    @property
    def are_gone(self) -> bool:
        """Whether the tokens of all that are present have disappeared."""
        return self.present <= self._gone

    def note(self, event: Presence) -> None:
        """Take note of a token that has appeared or disappeared."""
        newest = self._newest.get(event.name, 0)
        if not event.alive:
            if event.incarnation >= newest:
                self._gone.add(event.name)
            return
        # Reconnected after a standstill of that process or of this one.
        self._newest[event.name] = max(event.incarnation, newest)
        self._gone.discard(event.name)
        self.present.update({event.name} & self._expected)
