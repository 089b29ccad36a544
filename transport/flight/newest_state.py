"""The newest plant state among messages of which only the headers were read."""

from collections import deque
from collections.abc import Callable

from protocol.admission.gate import Sample
from protocol.wire.codec import decode
from protocol.wire.messages import MessageError, PlantState, Record

# Messages kept to find a plant state in: not every record has one, and one may be garbled.
_KEPT = 4


class NewestState:
    """The newest messages of the plant, in order, not decoded.

    Args:
        check: Raises MessageError for a plant state that cannot be of this run: a forged one may be in order.
    """

    def __init__(self, check: Callable[[PlantState], None]) -> None:
        self._check = check
        self._newest: deque[bytes] = deque(maxlen=_KEPT)

    def add(self, sample: Sample) -> None:
        """Take in a plant state or a record."""
        self._newest.append(sample.data)

    def decoded(self) -> PlantState | None:
        """Return the newest plant state, or None; safe on another thread than `add`."""
        for data in reversed(self._newest.copy()):
            try:
                message = decode(data)
                for part in message.parts if isinstance(message, Record) else (data,):
                    state = decode(part)
                    if isinstance(state, PlantState):
                        self._check(state)
                        return state
            except MessageError:
                continue
        return None
