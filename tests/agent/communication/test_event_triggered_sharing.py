"""Sharing of plans: the first, on change, at the heartbeat, under a new roster."""

import numpy as np
import pytest

from transport.agent.communication.event_triggered_sharing import Corrections, Sharing
from transport.model.arrays import Array
from transport.protocol.scenario.sections.schema import ControllerSection

STEPS, RANGE = 4, 8.0


def rule(threshold: float = 0.1, heartbeat_s: float = 1.0, share: str = "on_change") -> Sharing:
    """Return the rule of one UAV whose inputs all have the same range, at 20 Hz."""
    section = ControllerSection.model_validate(
        {"share": share, "share_threshold": threshold, "share_heartbeat_s": heartbeat_s}
    )
    return Sharing(section, np.full(4, -RANGE / 2.0), np.full(4, RANGE / 2.0))


def corrections(*thrusts: float) -> Array:
    """Return corrections of the first input by step; the others are zero."""
    c = np.zeros((STEPS, 4))
    c[: len(thrusts), 0] = thrusts
    return c


def decided(sharing: Sharing, k: int, c: Array, roster: int = 1) -> bool:
    """Return the decision on a plan of tick k that starts there."""
    return sharing.decide(Corrections(tick=k, start=k, c=c, roster=roster))


def test_expected_corrections_are_not_shared() -> None:
    """Corrections that equal the shared ones, shifted and zero after their end, are kept, (49)."""
    sharing = rule(threshold=0.0)
    assert decided(sharing, 0, corrections(1.0, 2.0, 3.0, 4.0))
    assert not decided(sharing, 1, corrections(2.0, 3.0, 4.0))
    assert not decided(sharing, 3, corrections(4.0))
    assert not decided(sharing, 9, corrections())


def test_threshold() -> None:
    """A change is a share of the input's range, the largest over horizon and inputs.

    More is shared.
    """
    sharing = rule(threshold=0.25)
    assert decided(sharing, 0, corrections())
    assert not decided(sharing, 1, corrections(0.0, 0.0, -2.0))
    assert decided(sharing, 2, corrections(0.0, 0.0, 0.0, -2.1))


def test_small_changes_add_up() -> None:
    """The change counts from the last shared plan, so that a drift is shared."""
    sharing = rule(threshold=0.1)
    # The input for tick 3 grows from plan to plan by a twentieth of the range.
    plans = [corrections(*[0.0] * (3 - k), 0.05 * RANGE * k) for k in range(4)]
    assert [decided(sharing, k, c) for k, c in enumerate(plans)] == [True, False, False, True]


@pytest.mark.parametrize(
    ("heartbeat_s", "ticks"), [(1.0, 20), (0.3, 6), (0.35, 7), (0.12, 2), (0.01, 1)]
)
def test_heartbeat(heartbeat_s: float, ticks: int) -> None:
    """Without any change a plan is shared at that pace, in whole ticks."""
    sharing = rule(heartbeat_s=heartbeat_s)
    shared = [k for k in range(3 * ticks + 1) if decided(sharing, k, corrections())]
    assert shared == [0, ticks, 2 * ticks, 3 * ticks]


def test_a_new_roster() -> None:
    """The first plan under each roster is shared: control law or receivers may be new."""
    sharing = rule()
    shared = [
        decided(sharing, k, corrections(), version) for k, version in enumerate([1, 1, 2, 2, 4, 4])
    ]
    assert shared == [True, False, True, False, True, False]


def test_a_hand_over() -> None:
    """A plan is shared when its share of the law alone has changed by more than 0.2, both ways."""
    sharing = rule()
    shares = [0.0, 0.15, 0.25, 0.40, 1.0, 1.0, 0.85, 0.75, 0.0]
    shared = [
        sharing.decide(Corrections(tick=k, start=k, c=corrections(), roster=1, alone=share))
        for k, share in enumerate(shares)
    ]
    assert shared == [True, False, True, False, True, False, False, True, True]
