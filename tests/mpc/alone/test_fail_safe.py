"""The fail-safe, level or following the reference; its attitude loop is in test_schedule.py, the law in test_alone."""

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.model.path.test_flatness import unequal
from tests.support.systems import ring
from transport.model import state
from transport.model.path.flat_reference import FlatReference, Track
from transport.model.path.flatness import flight
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.physics.hover import hover, hover_after_failures
from transport.model.physics.parameters import table_1
from transport.mpc.alone.fail_safe import FailSafe
from transport.mpc.alone.uav_motion import setpoint_of
from transport.mpc.settings_period_horizon_weights import AloneGains

SYSTEM = table_1()
AT_REST = hover(SYSTEM)
PERIOD_S = 0.05


def test_level_is_linear_in_the_attitude() -> None:
    """Without reference the inputs are hover thrust and the gain times the UAV's block of the state, (31)."""
    level, x = FailSafe(SYSTEM, AT_REST.u), AT_REST.x + 0.01 * np.arange(len(AT_REST.x))
    for uav in range(SYSTEM.N):
        rest = AT_REST.u[state.input_slice(uav)] * np.array([1.0, 0.0, 0.0, 0.0])
        np.testing.assert_allclose(level.inputs(uav, x, 0), rest + level.gain(uav) @ x)


def test_level_has_no_setpoint() -> None:
    """A fail-safe that keeps level has no part of a reference, and its integral stays."""
    level = FailSafe(SYSTEM, AT_REST.u)
    assert not level.follows
    with pytest.raises(ValueError, match="keeps level"):
        level.setpoint(0, 0)
    held = np.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(level.integral_after(0, AT_REST.x, 0, held, 0.05), held)


@pytest.mark.parametrize(
    ("period_s", "steps", "expected"), [(0.05, 20, 8), (0.05, 4, 4), (2.0, 3, 1)]
)
def test_one_that_follows_takes_over_soon(period_s: float, steps: int, expected: int) -> None:
    """It comes 0.4 s after the begin of the last plan, or at its end; the one that keeps level at the end."""
    follows = FailSafe(SYSTEM, AT_REST.u, AT_REST.x[None])
    assert follows.played(steps, period_s) == expected
    assert FailSafe(SYSTEM, AT_REST.u).played(steps, period_s) == steps


TEAM = unequal()
HOVERING = hover(TEAM)
OFF = 3
ROUNDING = 1e-9


@lru_cache
def flown(first: int = 0) -> Track:
    """Return a flat way along x, with drag, that rests from 3 s on."""
    way = Phase(name="go", duration_s=3.0, displacement_I=[1.0, 0.0, -0.5])
    maneuver = Maneuver(start_I=[0.0, 0.0, -9.0], phases=[way], profile="smooth")
    system = replace(TEAM, has_drag=True)
    return FlatReference(system, HOVERING, maneuver).track(70, PERIOD_S, first)


def test_setpoints_are_rows_of_what_is_followed() -> None:
    """At a tick those of a track or of reference states, the last one held; a later track has later rows."""
    whole, later = flown(), flown(20)
    states = FailSafe(TEAM, HOVERING.u, whole.X)
    for tick in (20, 47, 69, 100):
        row = min(tick, 69)
        expected = setpoint_of(TEAM, 1, whole.X[row], whole.U[row])
        for track in (whole, later):
            found = FailSafe(TEAM, HOVERING.u, whole.X, track).setpoint(1, tick)
            np.testing.assert_allclose(
                found.motion.position_I, expected.motion.position_I, atol=ROUNDING
            )
            np.testing.assert_allclose(found.inputs, expected.inputs, atol=ROUNDING)
        hovered = states.setpoint(1, tick)
        np.testing.assert_array_equal(hovered.motion.position_I, expected.motion.position_I)
        np.testing.assert_allclose(hovered.inputs, HOVERING.u[4:8], atol=ROUNDING)


def test_setpoint_with_further_drag_is_that_of_bodies_that_have_it() -> None:
    """Along a track state and inputs are those of the flat motion with that drag, to first order, (73)."""
    track, tick, further = flown(), 30, np.array([1e-4, 2e-4])
    paths = np.moveaxis(track.paths[tick : tick + 1], 0, 2)
    system = replace(TEAM, has_drag=True)
    forces = np.concatenate([np.zeros(16), further])
    x = flight(system, HOVERING, np.ascontiguousarray(paths[0]), forces).x[0]
    u = flight(system, HOVERING, np.ascontiguousarray(paths[1]), forces).u[0]
    expected = setpoint_of(system, 1, x, u)
    without = FailSafe(system, HOVERING.u, track.X, track).setpoint(1, tick)
    found = FailSafe(system, HOVERING.u, track.X, track).setpoint(1, tick, further)
    for value, of, before in (
        (found.motion.Theta, expected.motion.Theta, without.motion.Theta),
        (found.inputs, expected.inputs, without.inputs),
    ):
        assert np.abs(of - before).max() > 1e-6
        np.testing.assert_allclose(value, of, atol=1e-8)


@pytest.mark.parametrize("is_flat", [False, True], ids=["hover", "flat"])
def test_after_a_release_the_others_carry_its_load(*, is_flat: bool) -> None:
    """At rest their thrusts are those of the hover of the team left; a UAV off keeps one for its attitude, (51)."""
    X_ref, track = flown().X, flown() if is_flat else None
    gains = AloneGains(position=3.0)
    whole = FailSafe(TEAM, HOVERING.u, X_ref, track, gains=gains)
    left = whole.of_team({OFF}, {OFF})
    assert left.gains == gains
    at_rest = hover_after_failures(TEAM, {OFF}, {OFF})
    for uav in range(TEAM.N):
        expected = HOVERING.u if uav == OFF else at_rest.u
        own = state.input_slice(uav)
        np.testing.assert_array_equal(left.u_hover[own], expected[own])
        if uav != OFF:
            np.testing.assert_allclose(left.setpoint(uav, 200).inputs, at_rest.u[own], atol=1e-6)
    assert whole.of_team((), ()) is whole
    assert whole.of_team({0, 1}, {0, 1}) is whole, "two neighbours less have no hover"
    if is_flat:
        assert left.track is not None
        x, u = left.track.X[30], left.track.U[30]
        np.testing.assert_array_equal(
            left.setpoint(0, 30).motion.Theta, setpoint_of(TEAM, 0, x, u).motion.Theta
        )


def test_a_team_follows_its_track_else_the_motion_of_the_whole_team() -> None:
    """A UAV off on its rod leaves the track as it is; the undisturbed motion ends with the whole team, (31f), (51)."""
    system = ring(6)
    at_rest = hover(system)
    rest = Phase(name="rest", duration_s=0.5, displacement_I=[0.0, 0.0, 0.0])
    maneuver = Maneuver(start_I=[0.0, 0.0, -9.0], phases=[rest], profile="smooth")
    track = FlatReference(system, at_rest, maneuver).track(4, PERIOD_S)
    left = FailSafe(system, at_rest.u, track.X, track).of_team({OFF}, ())
    assert (left.u_hover != at_rest.u).any()
    assert left.track is track

    followed = setpoint_of(system, 1, track.X[0], 1.1 * at_rest.u)
    motion: Any = SimpleNamespace(setpoint=lambda *_: followed)
    whole = FailSafe(system, at_rest.u, track.X, motion=motion)
    assert whole.setpoint(1, 2) is followed
    expected = whole.of_team({OFF}, ()).u_hover[4:8]
    np.testing.assert_allclose(whole.of_team({OFF}, ()).setpoint(1, 2).inputs, expected)


def test_what_a_team_follows_from_tells_it_apart() -> None:
    """Results are shared by the key: another team, track or reference, other thrusts or gains have another one."""
    track = flown()
    gains = AloneGains(position=3.0)
    keys = [
        FailSafe(TEAM, HOVERING.u, track.X, track).key,
        FailSafe(TEAM, HOVERING.u, track.X, flown(20)).key,
        FailSafe(TEAM, HOVERING.u, track.X[:40], track).key,
        FailSafe(TEAM, HOVERING.u, track.X, track, gains=gains).key,
        FailSafe(TEAM, HOVERING.u, track.X).key,
        FailSafe(TEAM, HOVERING.u).key,
        FailSafe(TEAM, 1.1 * HOVERING.u).key,
        FailSafe(SYSTEM, HOVERING.u).key,
    ]
    assert len(set(keys)) == len(keys)
    assert FailSafe(TEAM, HOVERING.u, track.X.copy(), track).key == keys[0]
