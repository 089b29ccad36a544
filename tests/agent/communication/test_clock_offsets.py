"""Clocks of agents that differ: what plans of others say by the own clock, and the reference by it."""

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.runs import SHORT, begun, plant_states, ready, recorded, setup
from transport.agent.communication.clock_offsets import Clocks
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.rotations import cross, euler_rates, rotation
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.wire.messages import Plan

PERIOD_S, GRAVITY = 0.05, 9.81
AHEAD_S = 0.02
# Clocks of two agents: each sees the other by this much ahead, or behind.
OFFSETS_S = 0.0, AHEAD_S
SECOND_ORDER = 0.5 * 20.0 * AHEAD_S**2  # of motions with accelerations below 20 m/s^2 or rad/s^2
RUN = setup()


def seen(plan: Plan, ahead_s: float) -> Plan:
    """Return a plan of agent 2 as an agent sees it whose clock is behind by a time."""
    return Clocks((0.0, ahead_s), 1, PERIOD_S, GRAVITY).seen(plan)


def drawn(uav_states: Array, rows: int = 4) -> Plan:
    """Return a plan of agent 2 with random inputs and corrections."""
    rng = np.random.default_rng(1)
    inputs = rng.standard_normal((rows, 4))
    corrections = rng.standard_normal((rows, 4))
    plan = runs.plan(RUN, 2, 5)
    return replace(plan, uav_states=uav_states, inputs=inputs, corrections=corrections)


@pytest.mark.parametrize("ahead_s", [AHEAD_S, -AHEAD_S])
def test_inputs_are_means_over_the_own_periods(ahead_s: float) -> None:
    """Each row is held for a period of the sender's clock; corrections are zero after their end."""
    plan = drawn(runs.plan(RUN, 2, 5).uav_states)
    found = seen(plan, ahead_s)
    parts = 5  # the offset is two of them
    shift = round(ahead_s / PERIOD_S * parts)
    for rows, after, mixed in (
        (plan.inputs, plan.inputs[-1], found.inputs),
        (plan.corrections, 0.0 * plan.corrections[-1], found.corrections),
    ):
        fine = [*np.repeat(rows, parts, axis=0), *([after] * parts)]
        for row in range(len(rows)):
            places = np.maximum(np.arange(parts) + parts * row - shift, 0)
            expected = np.mean([fine[place] for place in places], axis=0)
            np.testing.assert_allclose(mixed[row], expected, atol=1e-12)


@pytest.mark.parametrize("ahead_s", [AHEAD_S, -AHEAD_S])
def test_states_are_taken_back(ahead_s: float) -> None:
    """A state that seems to be later is taken back by its rates, and forth if it seems to be earlier."""
    e, Omega = np.array([0.1, 0.0, np.sqrt(0.99)]), np.array([0.3, -0.2, 0.0])
    Theta, omega = np.array([0.1, -0.2, 0.4]), np.array([0.5, 0.3, -0.4])
    row = seen(drawn(np.concatenate([e, Omega, Theta, omega])[None]), ahead_s).uav_states[0]
    np.testing.assert_allclose(row[:3], e - ahead_s * cross(Omega, e), atol=SECOND_ORDER)
    assert np.linalg.norm(row[:3]) == pytest.approx(1.0)
    np.testing.assert_allclose(row[6:9], Theta - ahead_s * euler_rates(Theta) @ omega, atol=1e-12)
    np.testing.assert_array_equal(row[[3, 4, 5, 9, 10, 11]], [*Omega, *omega])


@pytest.mark.parametrize("ahead_s", [AHEAD_S, -AHEAD_S])
def test_measurements_of_sensors_are_taken_back(ahead_s: float) -> None:
    """Those of a UAV that accelerates, at each tick that the plan has; ticks without one stay."""
    r, v, a_I = np.array([1.0, 2.0, -3.0]), np.array([0.5, -1.0, 0.2]), np.array([2.0, -1.0, 0.5])
    Theta = np.array([0.1, -0.2, 0.4])
    force = rotation(Theta).T @ (a_I - [0.0, 0.0, GRAVITY])
    values = np.concatenate([r, v, Theta, np.zeros(3), force])
    known = np.concatenate([[1.0], values, [20.0, 0.0, 0.0, 0.0]])
    lost = np.zeros(state.REPORTED)
    rows = seen(drawn(np.concatenate([known, lost, known, lost])[None]), ahead_s).uav_states
    found = rows.reshape(state.REPORTS, state.REPORTED)
    np.testing.assert_array_equal(found[[1, 3]], [lost, lost])
    for row in found[[0, 2]]:
        np.testing.assert_allclose(row[1:4], r - ahead_s * v, atol=SECOND_ORDER)
        np.testing.assert_allclose(row[4:7], v - ahead_s * a_I, atol=1e-12)
        np.testing.assert_array_equal(row[7:], known[7:])


def test_clocks_that_agree_change_nothing() -> None:
    """A flight has the same bits without offsets, with zeros, and plans of the own clock pass."""
    plan = drawn(runs.plan(RUN, 2, 5).uav_states)
    assert seen(plan, 0.0) is plan
    flights = [recorded(setup(SHORT, *offsets)) for offsets in ((), ("clock.offsets_s=[0,0,0,0]",))]
    x = [[one.x.tobytes() for one in plant_states(messages)] for messages in flights]
    assert x[0] == x[1]


@pytest.mark.parametrize("ahead_s", [0.02, -0.02])
def test_the_reference_is_by_the_own_clock(ahead_s: float) -> None:
    """An agent whose clock is ahead is where the path leads then, at the start where it begins.

    After a target too.
    """
    run = ready("resilient", f"clock.offsets_s=[0.0,{ahead_s},0.0,0.0]")
    assert run.run.by_clock_of(1) is run.run
    own = run.run.by_clock_of(2)
    t_s = np.array([0.0, 5.5, 7.0, 12.0])
    np.testing.assert_allclose(
        own.reference.states(t_s), run.reference.states(np.maximum(t_s + ahead_s, 0.0)), atol=1e-12
    )
    ticks = np.array([0, 110, 140])
    np.testing.assert_array_equal(own.X_ref[ticks], own.reference.states(ticks * PERIOD_S))
    np.testing.assert_array_equal(own.by_clock_of(2).X_ref, own.X_ref)


def test_a_flight_with_clocks_that_differ() -> None:
    """The more a clock differs the more the payload turns, in a hover and a climb."""
    largest = []
    for offset_s in (0.0, 0.01, 0.04):
        run = ready("resilient", f"clock.offsets_s=[0.0,0.0,{offset_s},0.0]")
        x = np.array([one.x for one in plant_states(begun(run, 200))])
        largest.append(np.degrees(np.abs(x[:, state.THETA0]).max()))
    assert 1.3 * largest[0] < largest[1] < 0.7 * largest[2] < 0.7


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (("clock.offsets_s=[0.0,0.01]",), "expected one for each of 4 agents, got 2"),
        (("clock.offsets_s=[0.03,0.0,0.0,-0.02]",), "got 0.05 s"),
        (("clock.offsets_s=[0.06,0.06,0.06,0.06]",), "got 0.06 s"),
        (("clock.offsets_s=[0.0,0.0,0.0,0.01]", "clock.mode=realtime"), "clock.mode = 'realtime'"),
    ],
)
def test_clocks_that_are_refused(settings: tuple[str, ...], text: str) -> None:
    """Another number of them than of agents, a sampling period apart, or in real time."""
    with pytest.raises(ScenarioError, match=text) as refused:
        setup(*settings)
    assert "clock.offsets_s" in str(refused.value)
