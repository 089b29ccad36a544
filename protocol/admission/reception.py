"""The checks that admitted messages pass in every receiver: plausible in this run, and of a possible tick."""

from collections.abc import Callable

from protocol.admission.plausibility import Plausibility, check_moment, window
from protocol.scenario.setup import Setup
from protocol.wire.messages import Control, LinkChange, Message, MessageError, Roster
from protocol.wire.rejections import Rejections


class Reception:
    """Checks the messages of one receiver, hands them to its handler, and counts those that either refuses.

    `handle` takes in a checked message and the time (ns), and raises MessageError to refuse the message; `newest_tick`
    returns the newest tick the receiver knows of, or None while it knows none.

    Attributes:
        rejected: Counts of refused messages.
        window: How many ticks another process may be ahead of this one, or behind it.
    """

    def __init__(
        self,
        setup: Setup,
        handle: Callable[[Message, int], None],
        newest_tick: Callable[[], int | None] = lambda: None,
    ) -> None:
        self.rejected = Rejections()
        self.window = window(setup)
        self._plausibility = Plausibility(setup)
        self._handle, self._newest_tick = handle, newest_tick

    def receive(self, message: Message, now_ns: int) -> bool:
        """Hand a message to the handler; return whether it was accepted."""
        try:
            self._plausibility.check(message)
            if isinstance(message, Control | Roster | LinkChange):
                self._check_coordinator(message)
            self._handle(message, now_ns)
        except MessageError as error:
            self.rejected.add(message.sender, error)
            return False
        return True

    def _check_coordinator(self, message: Message) -> None:
        """Refuse a message the coordinator cannot send at its present tick; it repeats link changes of any past tick.

        Raises: MessageError: the message is of the past or the future.
        """
        tick = self._newest_tick()
        if tick is not None:
            first = 0 if isinstance(message, LinkChange) else tick - self.window
            check_moment(message, first, tick + 1 + self.window)
