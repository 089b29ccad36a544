"""Inputs between those of the team and those of a UAV alone, by a law and a team with values made by hand (32d)."""

import dataclasses
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.support.random_systems import random_state
from tests.support.runs import setup
from transport.agent.estimation.received_states import UavReport
from transport.agent.estimation.sensor_estimator import SensorEstimator
from transport.agent.planning.hand_over_inputs import HandOver
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.mpc.alone.alone_law import steps_alone
from transport.mpc.alone.motion_by_own_sensors import OwnSensors
from transport.mpc.alone.uav_motion import Setpoint, UavMotion, ahead, motion_of

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


# A moving team, of which agent 1 owns two UAVs: what each part of an input depends on, by a law that notes it.

OWNED = (0, 2)
AGES = (2, 1, 0, 1, 0)
K = 50
STATES = np.array(
    [random_state(np.random.default_rng(tick), RUN.system.N) for tick in range(K + 3)]
)
TENSIONS_N = (9.0, 8.0, 1e3, 6.0)  # that of the third is so large that its rod counts as slack
FORCE_N = 7.0  # of the law, in all directions
IN_MID_RUN, EARLY = K, 6


def numbers(thing: Any) -> Array:
    """Return all numbers of arrays, motions and setpoints, in order."""
    if dataclasses.is_dataclass(thing):
        thing = [getattr(thing, field.name) for field in dataclasses.fields(thing)]
    if isinstance(thing, list | tuple):
        return np.concatenate([numbers(one) for one in thing])
    return np.ravel(thing)


def setpoint(uav: int, tick: int) -> Setpoint:
    """Return a setpoint by tick and UAV."""
    motion = motion_of(RUN.system, uav, STATES[tick][::-1].copy())
    number = 0.01 * (tick - K) + 0.1 * uav
    inputs = RUN.hover.u[state.input_slice(uav)] + number * np.array([1.0, 0.1, 0.1, 0.1])
    return Setpoint(motion=motion, force_I=np.zeros(3), turning=np.zeros(3), inputs=inputs)


class NotingLaw(Law):
    """The law of a UAV alone, which notes what it is asked for."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, Setpoint, Array]] = []

    def force(self, *_: Any) -> Array:
        """Return a force."""
        return np.full(3, FORCE_N)

    def within(self, integral_I: Array) -> Array:
        """Return a part of it."""
        return 0.5 * integral_I

    def inputs(self, motion: Any, here: Setpoint, integral_I: Array) -> Array:
        """Return the inputs of the setpoint and note what they are for."""
        self.asked.append((motion, here, integral_I))
        return here.inputs

    def driven(self, *given: Any) -> Any:
        """Return what a motion with inputs in force depends on."""
        return given


class MovingTeam(Team):
    """A team whose UAVs are where their states are; those of each second tick are known."""

    def __init__(self, estimator: Any) -> None:
        super().__init__(1.0)
        self.estimator = estimator
        self.laws = {uav: NotingLaw() for uav in OWNED}

    def alone(self, uav: int, tick: int) -> Any:
        """Return law and setpoint."""
        return self.laws[uav], setpoint(uav, tick)

    def alone_ahead(self, uav: int, first: int, steps: int) -> Array:
        """Return the inputs of the setpoints ahead."""
        return np.array([setpoint(uav, first).inputs] * steps)

    def _in_force(self, tick: int, *, before: int) -> Array:
        """Return inputs by tick, of plans made before one."""
        return np.asarray(RUN.hover.u + 0.1 * tick + 10.0 * before + np.arange(16.0))


class Sensing(SensorEstimator):
    """An estimator from sensors that some UAVs have told it of at some ticks."""

    def __init__(self, reports: dict[int, UavReport | None]) -> None:
        self._told = reports

    def told(self, tick: int, uav: int) -> UavReport | None:
        """Return a report, other numbers for each UAV."""
        one = self._told.get(tick)
        return None if one is None else one._replace(values=one.values + 0.01 * uav)

    def past(self, _: int) -> Array | None:
        """Return no estimate."""
        return None


def begun(team: MovingTeam) -> HandOver:
    """Return the hand-over of UAVs 1 and 3."""
    known = SimpleNamespace(
        settings=RUN.settings,
        system=RUN.system,
        hover=SimpleNamespace(tensions=np.array(TENSIONS_N), x=RUN.hover.x),
        sensors=SimpleNamespace(ages=AGES),
    )
    return HandOver(known, team, OWNED)  # type: ignore[arg-type]


LINEAR = SimpleNamespace(u0=RUN.hover.u + 0.5 * np.arange(16.0), x0=STATES[-1])


def asked(team: MovingTeam, handover: HandOver, k: int, start: int) -> dict[int, Any]:
    """Return motion, setpoint and integral that the law of each UAV is asked for at a tick."""
    handover.advance(k)
    handover.inputs(k, start, LINEAR, np.tile(TEAM, 2))  # type: ignore[arg-type]
    return {uav: law.asked[-1] for uav, law in team.laws.items()}


def past(tick: int) -> Array | None:
    """Return the state of each second tick."""
    return None if tick % 2 else STATES[tick]


@pytest.mark.parametrize("k", [IN_MID_RUN, EARLY, IN_MID_RUN - 1])
@pytest.mark.parametrize("delay", [0, 1])
def test_by_states_each_uav_is_asked_for_where_it_is(k: int, delay: int) -> None:
    """The estimate, with the inputs in force until the plan starts; without one that of the begin of the horizon.

    The integral begins with the mean of what the team's thrust gave beyond the law in the last second.
    """
    team = MovingTeam(SimpleNamespace(past=past))
    found = asked(team, begun(team), k, k + delay)
    for uav in OWNED:
        differences = [
            -team._in_force(tick, before=k)[4 * uav] * rotation(motion.Theta)[:, 2] - FORCE_N
            for tick in range(max(0, k - SECOND), k)
            if (x := past(tick)) is not None and (motion := motion_of(RUN.system, uav, x))
        ]
        x = past(k)
        here, there = setpoint(uav, k), setpoint(uav, k + 1)
        now = motion_of(RUN.system, uav, LINEAR.x0 if x is None else x)
        expected_motion: Any = now
        if x is not None and delay:
            on = ahead(now, k, k + 1, {k: here.motion, k + 1: there.motion}.__getitem__, PERIOD_S)
            u0 = LINEAR.u0[state.input_slice(uav)]
            expected_motion = (on, here, there.motion, u0, PERIOD_S)
        expected = expected_motion, setpoint(uav, k + delay), 0.5 * np.mean(differences, axis=0)
        np.testing.assert_allclose(numbers(found[uav]), numbers(expected), rtol=1e-12)


def report(tick: int, missing: int = 0, *, has_inputs: bool = True) -> UavReport:
    """Return measurements of a tick."""
    values = 0.1 * np.random.default_rng(tick).standard_normal(state.SENSED)
    values[state.SPECIFIC_FORCE] += [0.0, 0.0, -12.0]
    inputs = np.array([20.0 + 0.1 * tick, 0.0, 0.0, 0.0]) if has_inputs else None
    return UavReport(values, inputs, missing)


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("is_complete", [True, False])
def test_by_sensors_each_uav_has_an_observer_of_its_own(delay: int, is_complete: bool) -> None:
    """It begins a second before, goes on tick by tick, and begins anew after a time with the team.

    Ticks with missing sensors, without inputs or without a report are left out; one of those now leaves the estimate.
    """
    usable = [*range(K - SECOND - 3, K - 9), K - 6, K - 5, K - 2, K, K + 1]
    unusable = {
        K - 8: report(K - 8, missing=1),
        K - 3: report(K - 3, has_inputs=False),
        K - 1: None,
    }
    reports: dict[int, UavReport | None] = {**{tick: report(tick) for tick in usable}, **unusable}
    if not is_complete:
        reports[K] = report(K, missing=4)
    team = MovingTeam(Sensing(reports))
    handover = begun(team)

    def check(found: dict[int, Any], k: int, ticks: Sequence[int]) -> None:
        for uav in OWNED:
            sensors = OwnSensors(RUN.system, uav, TENSIONS_N[uav], AGES, PERIOD_S)

            def reference(tick: int, uav: int = uav) -> UavMotion:
                return setpoint(uav, tick).motion

            motion: Any = motion_of(RUN.system, uav, LINEAR.x0)
            for tick in ticks:
                one = team.estimator.told(tick, uav)
                sensors.observe(one.values, one.inputs[0], tick, reference)
                if tick == k:
                    motion = sensors.motion(one.values, k, k + delay, reference)
                    if delay:
                        u0 = LINEAR.u0[state.input_slice(uav)]
                        there = reference(k + 1)
                        motion = (motion, setpoint(uav, k), there, u0, PERIOD_S)
            np.testing.assert_allclose(numbers(found[uav][0]), numbers(motion), rtol=1e-12)

    before = [tick for tick in usable if K - SECOND <= tick < K]
    at_k = [K] if is_complete else []
    check(asked(team, handover, K, K + delay), K, [*before, *at_k])
    reports[K - 4] = report(K - 4)  # too late for the observer
    check(asked(team, handover, K + 1, K + 1 + delay), K + 1, [*before, *at_k, K + 1])

    team.share = 0.0
    while handover.share:
        asked_before = handover.share
        handover.advance(K + 1)
        handover.inputs(K + 1, K + 1, LINEAR, np.tile(TEAM, 2))  # type: ignore[arg-type]
        assert handover.share < asked_before
    team.share = 1.0
    while handover.share < 1.0:
        handover.advance(K + 1)
    anew = sorted([*before[1:], K - 4, *at_k, K + 1])
    check(asked(team, handover, K + 1, K + 1 + delay), K + 1, anew)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_inputs_change_by_steps_from_those_in_force_within_the_limits(sign: float) -> None:
    """Inputs far off are approached at the largest rate, from the inputs before on, up to the limits."""
    step = RUN.settings.largest_step(1)
    limit = RUN.settings.upper(1) if sign > 0.0 else RUN.settings.lower(1)
    team = Team(0.5)
    handover = handing_over(team)
    before = limit - 1.5 * sign * step
    handover.advance(50)
    linear = SimpleNamespace(u0=np.concatenate([before, RUN.hover.u[4:]]), x0=RUN.hover.x)
    far = np.tile(sign * 1e4, (4, 4))
    found = handover.inputs(50, 50, linear, far)  # type: ignore[arg-type]
    np.testing.assert_allclose(found, [before + sign * step, limit, limit, limit])


def test_the_later_inputs_are_those_of_the_setpoints_from_the_start_of_the_plan_on() -> None:
    """Of each UAV, where its law asks for no deviation."""
    team = MovingTeam(SimpleNamespace(past=past))
    handover = begun(team)
    handover.advance(K)
    at_start = np.concatenate([setpoint(uav, K + 1).inputs for uav in OWNED])
    u0 = np.concatenate([setpoint(uav, K + 1).inputs for uav in range(4)])
    linear = SimpleNamespace(u0=u0, x0=STATES[K])
    found = handover.inputs(K, K + 1, linear, np.tile(TEAM, 2))  # type: ignore[arg-type]
    np.testing.assert_allclose(found, np.tile(at_start, (len(found), 1)))
