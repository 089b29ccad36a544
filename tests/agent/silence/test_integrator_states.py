"""Forces that the integrals of UAVs alone are assumed to hold (docs/equations.md (32f))."""

import numpy as np
import pytest

from transport.agent.silence.integrator_states import IntegratorForces
from transport.model.arrays import Array

N = 4
PERIOD_S, FOLLOWS_S = 0.05, 2.4  # T_s and T_h
STEP = PERIOD_S / FOLLOWS_S
ROUNDING = 1e-12

BEFORE, NOW = np.random.default_rng(31).uniform(-5.0, 5.0, (2, 3 + 3 * N))


def _followed(*shares: float) -> IntegratorForces:
    """Return the forces that follow `BEFORE` with the team, and then `NOW` by some shares alone."""
    held = IntegratorForces(PERIOD_S)
    held.follow(BEFORE, share_alone=0.0, follows_s=FOLLOWS_S)
    for share in shares:
        held.follow(NOW, share_alone=share, follows_s=FOLLOWS_S)
    return held


def _assert_holds(
    held: IntegratorForces, forces: Array, motors_off: frozenset[int] = frozenset()
) -> None:
    """Check that each UAV balances the force on it, and its part of the force on the payload."""
    carrying = set(range(N)) - motors_off
    for uav in carrying:
        on_uav = forces[3 * (1 + uav) :][:3]
        expected = -on_uav - forces[:3] / len(carrying)
        part = held.part(uav, motors_off)
        assert part is not None
        np.testing.assert_allclose(part, expected, rtol=0.0, atol=ROUNDING)


def test_without_an_estimate_nothing_is_held() -> None:
    """An agent that estimates no forces assumes none."""
    assert IntegratorForces(PERIOD_S).part(0, ()) is None


def test_with_the_team_the_estimate_is_held() -> None:
    """At a share alone of 0 the held forces are those of the tick, whatever was held before."""
    _assert_holds(_followed(), BEFORE)
    _assert_holds(_followed(1.0, 1.0, 0.0), NOW)


def test_the_first_estimate_is_held_alone_too() -> None:
    """An agent that starts alone has nothing to follow from."""
    held = IntegratorForces(PERIOD_S)
    held.follow(NOW, share_alone=1.0, follows_s=FOLLOWS_S)
    _assert_holds(held, NOW)


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_alone_a_step_takes_a_share_of_the_difference(share: float) -> None:
    """Alone, also in part, the held forces move by T_s / T_h of the way to the estimate."""
    _assert_holds(_followed(share), BEFORE + STEP * (NOW - BEFORE))
    left = (1.0 - STEP) ** 20
    _assert_holds(_followed(*[share] * 20), NOW + left * (BEFORE - NOW))


@pytest.mark.parametrize("motors_off", [frozenset({3}), frozenset({0, 2})])
def test_those_that_are_left_carry_the_payload(motors_off: frozenset[int]) -> None:
    """The force on the payload is divided among the UAVs with motors: N - 1 with one off."""
    _assert_holds(_followed(), BEFORE, motors_off)
