"""Participants: instants of ticks on a process's own clock, and the order of targets."""

import pytest
from msgspec.structs import replace

from tests.support.messages import sample
from transport.protocol.admission.participant import Ticking, check_target
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import Target

PERIOD_NS = 50_000_000
START_NS = 7_000_000_000
# The common clock is this far ahead of the steady one of the process.
AHEAD_NS = 1_700_000_000_000_000_000


@pytest.mark.parametrize(("speed", "apart_ns"), [(1.0, 50_000_000), (2.0, 25_000_000)])
def test_ticks_follow_the_common_clock(speed: float, apart_ns: int) -> None:
    """Tick k is k T_s / speed after the start, and the newest one is the last whose instant has come."""
    ticking = Ticking.of(AHEAD_NS + START_NS, PERIOD_NS, speed, AHEAD_NS)
    for tick in (0, 1, 10, 1000):
        at_ns = START_NS + tick * apart_ns
        assert ticking.due_ns(tick) == at_ns
        assert ticking.newest(at_ns) == tick
        assert ticking.newest(at_ns - 1) == tick - 1
        assert ticking.ticks(at_ns + apart_ns // 2) == tick + 0.5
    assert ticking.due_ns(1.5) == START_NS + 3 * apart_ns // 2
    assert ticking.newest(START_NS - 100 * apart_ns) == -1


@pytest.mark.parametrize(("number", "is_refused"), [(1, False), (3, False), (4, False), (5, True)])
def test_targets_come_one_by_one(number: int, is_refused: bool) -> None:
    """After three of them the next one is taken, and those before may be repeated, but none is left out."""
    target = replace(sample(Target), number=number)
    if not is_refused:
        check_target(3, target)
        return
    with pytest.raises(MessageError, match="target 5 after 3") as refused:
        check_target(3, target)
    assert refused.value.reason == "future"
