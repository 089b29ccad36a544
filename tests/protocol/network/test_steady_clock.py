"""Times of arrival follow a steady clock from the start of a process on."""

from itertools import count

from transport.protocol.network.bus_events_and_clock import SteadyClock

SECOND_NS = 10**9


def test_a_corrected_clock_moves_no_time() -> None:
    """The wall clock is read once: a step of the system's clock by an hour changes no duration."""
    wall_ns = iter([1_700_000_000 * SECOND_NS, 1_699_996_400 * SECOND_NS])
    steady_ns = count(5 * SECOND_NS, SECOND_NS)
    clock = SteadyClock(lambda: next(wall_ns), lambda: next(steady_ns))
    times_s = [clock.now_ns() // SECOND_NS for _ in range(3)]
    assert times_s == [1_700_000_001, 1_700_000_002, 1_700_000_003]
