"""History: its entries follow from all that was told, not from when it was told."""

from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from transport.agent.estimation.repeated_ticks import WINDOW, History, TickRecursion

TICKS = 30
LARGE = 1_000_003  # a prime: two histories hardly agree by chance


class Sums:
    """Recursion whose entries depend on each message of each tick and on their place in time."""

    def __init__(self) -> None:
        self.told: dict[int, int] = {}
        self.steps = 0  # computed so far
        self._own: dict[int, int] = {}

    def begin(self, tick: int) -> int:
        """Return the entry of the first tick."""
        return tick + 1

    def corrected(self, entry: int, tick: int) -> int:
        """Return an entry with the messages of its tick, which are its last digit."""
        return entry - entry % 10 + self.told.get(tick, 0)

    def following(self, entry: int, tick: int) -> int:
        """Return the next entry."""
        self.steps += 1
        moved = (31 * entry + tick) % LARGE * 10
        return self.corrected(moved, tick + 1)

    @property
    def recursion(self) -> TickRecursion[int]:
        """The recursion."""
        return TickRecursion(
            begin=lambda tick: 10 * self.begin(tick),
            corrected=self.corrected,
            following=self.following,
        )


def advanced(arrivals: Sequence[int], values: Sequence[int]) -> tuple[History[int], Sums]:
    """Return a history after all ticks; the message of tick k arrives at tick arrivals[k]."""
    history: History[int] = History()
    sums = Sums()
    for k in range(TICKS):
        for tick, (when, value) in enumerate(zip(arrivals, values, strict=True)):
            if when == k and history.keeps(tick):
                sums.told[tick] = value
                history.tell(tick)
        history.advance(k, sums.recursion)
    return history, sums


@settings(deadline=None)  # the host may be busy
@given(
    st.lists(st.integers(0, 9), min_size=TICKS, max_size=TICKS),
    st.lists(st.integers(0, TICKS), min_size=TICKS, max_size=TICKS),
)
def test_order_and_time_of_arrival_do_not_matter(values: list[int], delays: list[int]) -> None:
    """After all messages have arrived, every entry is that of messages in time."""
    in_time, _ = advanced(range(TICKS), values)
    late = [min(k + delay, TICKS - 1) for k, delay in enumerate(delays)]
    history, _ = advanced(late, values)
    assert [history.entry(k) for k in range(TICKS)] == [in_time.entry(k) for k in range(TICKS)]


def test_messages_in_time_repeat_nothing() -> None:
    """With messages of the present tick alone each step is computed once."""
    _, sums = advanced(range(TICKS), [1] * TICKS)
    assert sums.steps == TICKS - 1


def test_a_late_message_repeats_the_steps_after_its_tick() -> None:
    """A message that is d ticks late has d - 1 steps repeated, before that to the present tick."""
    late = 7
    arrivals = [k + late if k == 5 else k for k in range(TICKS)]
    _, sums = advanced(arrivals, [1] * TICKS)
    assert sums.steps == TICKS - 1 + late - 1


def test_outdated_steps_are_repeated_but_their_start_is_kept() -> None:
    """What changes between two ticks leaves the entry of the first as it is."""
    history, sums = advanced(range(TICKS), [1] * TICKS)
    entry = history.entry(20)
    history.outdate_after(20)
    history.advance(TICKS - 1, sums.recursion)
    assert history.entry(20) == entry
    assert sums.steps == TICKS - 1 + (TICKS - 1 - 20)


def test_only_the_newest_ticks_are_kept() -> None:
    """The window holds the newest ticks without a gap; older messages change nothing."""
    history: History[int] = History()
    sums = Sums()
    last = 3 * WINDOW
    for k in np.arange(0, last + 1, 2).tolist():  # gaps are bridged
        history.advance(k, sums.recursion)
    kept = [k for k in range(last + 1) if history.entry(k) is not None]
    assert kept == list(range(last - WINDOW + 1, last + 1))
    assert history.first == kept[0]
    assert not history.keeps(kept[0] - 1)
    assert history.newest == history.entry(last)
