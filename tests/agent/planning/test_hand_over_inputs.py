"""Inputs between those of the team and those of a UAV alone, by a law and a team with values made by hand (32d)."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.support.runs import setup
from transport.agent.planning.hand_over_inputs import HandOver
from transport.model.arrays import Array
from transport.mpc.alone.alone_law import steps_alone
from transport.mpc.alone.uav_motion import Setpoint, motion_of

RUN = setup()
PERIOD_S = RUN.settings.sampling_period_s
HOVER_N = float(RUN.hover.u[0])
FADES_S = 0.2
LAW_N, APPLIED_N = HOVER_N + 1.0, HOVER_N + 3.0
GAIN = 0.01  # of the deviation of the thrust, per N of the integral
SECOND = round(1.0 / PERIOD_S)
TEAM = np.tile(RUN.hover.u[:4] + np.array([0.02, 0.0, 0.0, 0.0]), (RUN.settings.horizon, 1))


class Law:
    """A law whose force is a constant one up, and whose integral falls by a newton at each step."""

    def force(self, *_: Any) -> Array:
        """Return the force of the law without its integral."""
        return np.array([0.0, 0.0, -LAW_N])

    def within(self, integral_I: Array) -> Array:
        """Return an integral within its limits."""
        return integral_I

    def inputs(self, _: Any, setpoint: Setpoint, integral_I: Array) -> Array:
        """Return the inputs at a setpoint, with the thrust by the integral, which is up."""
        return np.asarray(setpoint.inputs + np.array([-GAIN * integral_I[2], 0.0, 0.0, 0.0]))

    def integral_after(self, integral_I: Array, *_: Any) -> Array:
        """Return the integral one step later."""
        return np.asarray(integral_I + np.array([0.0, 0.0, 1.0]))


class Team:
    """A team at hover, of which the agent acts alone by a share; its plans gave more than the law."""

    def __init__(self, share: float) -> None:
        self.share = share
        self.has_heard_all = True
        heard = SimpleNamespace(has_heard_all=lambda before: self.has_heard_all)
        self.announced = SimpleNamespace(heard=heard, in_force=self._in_force)
        self.estimator = SimpleNamespace(past=lambda tick: None if tick % 2 else RUN.hover.x)
        self._law = Law()

    def share_alone(self, _: int) -> float:
        """Return the share that is wanted."""
        return self.share

    def alone(self, uav: int, _: int) -> tuple[Law, Setpoint]:
        """Return the law, and the hover."""
        motion = motion_of(RUN.system, uav, RUN.hover.x)
        inputs = RUN.hover.u[:4]
        return self._law, Setpoint(
            motion=motion, force_I=np.zeros(3), turning=np.zeros(3), inputs=inputs
        )

    def alone_ahead(self, _uav: int, _first: int, steps: int) -> Array:
        """Return the inputs of the setpoints ahead."""
        return np.tile(RUN.hover.u[:4], (steps, 1))

    def _in_force(self, tick: int, *, before: int) -> Array:
        """Return the inputs at a tick; before the last second those were others."""
        u = RUN.hover.u.copy()
        u[0] = APPLIED_N if tick >= before - SECOND else 2.0 * APPLIED_N
        return u


def handing_over(team: Team) -> HandOver:
    """Return the hand-over of UAV 1."""
    return HandOver(RUN.run, team, [0])  # type: ignore[arg-type]


def inputs(handover: HandOver, k: int) -> Array:
    """Return the inputs of a plan at a tick, from the hover on."""
    handover.advance(k)
    linear = SimpleNamespace(u0=RUN.hover.u, x0=RUN.hover.x)
    return handover.inputs(k, k, linear, TEAM) - RUN.hover.u[:4]  # type: ignore[arg-type]


def test_with_the_team_the_inputs_are_those_of_the_team() -> None:
    """The very same numbers, over the whole horizon."""
    np.testing.assert_array_equal(inputs(handing_over(Team(0.0)), 50), TEAM - RUN.hover.u[:4])


def test_alone_the_integral_begins_with_what_the_team_gave_beyond_the_law() -> None:
    """In the mean of the last second; then it follows the law, and each deviation fades over a plan."""
    handover = handing_over(Team(1.0))
    fading = np.exp(-PERIOD_S / FADES_S * np.arange(steps_alone(PERIOD_S)))
    for k, integral_N in [(50, APPLIED_N - LAW_N), (51, APPLIED_N - LAW_N - 1.0)]:
        found = inputs(handover, k)
        np.testing.assert_allclose(found[:, 0], GAIN * integral_N * fading, atol=1e-12)
        assert not found[:, 1:].any()


def test_after_a_time_with_the_team_the_integral_begins_anew() -> None:
    """Nothing of an earlier time alone is kept."""
    team = Team(1.0)
    handover = handing_over(team)
    first = inputs(handover, 50)
    team.share = 0.0
    while handover.share:
        inputs(handover, 51)
    team.share = 1.0
    while handover.share < 1.0:
        handover.advance(52)
    np.testing.assert_allclose(inputs(handover, 53), first, atol=1e-12)


@pytest.mark.parametrize(("has_heard_all", "up_s"), [(True, 1.0), (False, 0.5)])
def test_the_way_to_alone_is_shorter_for_one_that_has_not_heard_all(
    has_heard_all: bool, up_s: float
) -> None:
    """On the way the inputs are mixed by the share; the way back takes two seconds."""
    team = Team(0.0)
    team.has_heard_all = has_heard_all
    handover = handing_over(team)
    inputs(handover, 50)
    team.share = 1.0
    half = math.ceil(0.5 * up_s / PERIOD_S)
    for _ in range(half - 1):
        handover.advance(50)
    found = inputs(handover, 50)
    share = half * PERIOD_S / up_s
    assert handover.share == pytest.approx(share)
    expected = (1.0 - share) * 0.02 + share * GAIN * (APPLIED_N - LAW_N)
    assert found[0, 0] == pytest.approx(expected)
    assert len(found) == len(TEAM)
    team.share = 0.0
    handover.advance(51)
    assert handover.share == pytest.approx(share - PERIOD_S / 2.0)
