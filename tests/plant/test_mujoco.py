"""The engine "mujoco": its state is the one it was given, its motion that of the equations, its ground carries."""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import transport
from tests.support.random_systems import (
    random_forces,
    random_input,
    random_state,
    random_system,
    with_drag,
)
from tests.support.runs import plant_states, ready, recorded
from transport.model import state
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.physics.hover import with_released
from transport.model.physics.parameters import System, payload_half_size, resting_height, table_1
from transport.model.state import StateView
from transport.plant.engines import Rods
from transport.plant.mujoco_engine import MujocoEngine
from transport.protocol.scenario.sections.plant_sections import MujocoSection, PlantSection

# The engine's coordinates are quaternions and relative rates: there and back is rounding.
ROUNDING = 1e-9
# Rods of a hundredth of a gram, as they may not weigh nothing: an error in proportion to that.
LIGHTEST = PlantSection(engine="mujoco", mujoco=MujocoSection(step_s=0.001, rod_mass_kg=1e-4))
GROUND_M = -2.0
GROUND = PlantSection(engine="mujoco", ground_m=GROUND_M)
LIGHT_CABLES = PlantSection(
    engine="mujoco", mujoco=MujocoSection(step_s=0.001, suspension="cables")
)
CABLES = PlantSection(engine="mujoco", mujoco=MujocoSection(suspension="cables"))
GROUND_CABLES = CABLES.model_copy(update={"ground_m": GROUND_M})

MUJOCO = "plant.engine=mujoco"
IMPAIRED = ("links.delay_s=0.2", "links.loss=0.3")
# A leg in all directions, and a hover in which the payload swings back.
LEG = (
    "maneuver.phase=[{name='leg',duration_s=5.0,displacement_m=[2.0,1.0,-2.0]},"
    "{name='hover',duration_s=2.0,displacement_m=[0,0,0]}]"
)


def at_rest(system: System, z: float) -> Array:
    """Return a team at rest on vertical rods with the payload's centre at a height z, (n,)."""
    x = np.zeros(system.n)
    x[2] = z
    StateView(x).e_P[:] = [0.0, 0.0, 1.0]
    return x


def advanced(
    engine: MujocoEngine | Rods, x: Array, u: Array, duration_s: float, forces: Array | None = None
) -> Array:
    """Return the state after a duration, in periods of 50 ms."""
    engine.reset(x)
    for _ in range(round(duration_s / 0.05)):
        engine.advance(u, forces, 0.05)
    return engine.state()


@lru_cache
def flight(name: str, *settings: str) -> Array:
    """Return the states of a ready scenario flown in memory to its end, (ticks, n)."""
    return np.array([entry.x for entry in plant_states(recorded(ready(name, *settings)))])


def payload_errors(name: str, *settings: str) -> Array:
    """Return the distances of the payload from its reference, (ticks,), m."""
    run, x = ready(name, *settings), flight(name, *settings)
    times_s = run.settings.sampling_period_s * np.arange(run.ticks, dtype=np.float64)
    return np.asarray(np.linalg.norm(x[:, state.R0] - run.maneuver.path(times_s)[0], axis=1))


@pytest.mark.parametrize("section", [LIGHTEST, CABLES], ids=["rods", "cables"])
@pytest.mark.parametrize("N", [1, 3, 6])
def test_the_state_is_the_given_one(N: int, section: PlantSection) -> None:
    """Reading out what was written is the identity, for rods in all directions and heads beyond half a turn."""
    rng = np.random.default_rng(900 + N)
    for _ in range(4):
        engine = MujocoEngine(random_system(rng, N), section)
        x = random_state(rng, N)
        x[8] += 4.0 * np.pi  # turned twice
        engine.reset(x)
        np.testing.assert_allclose(engine.state(), x, atol=ROUNDING)


@pytest.mark.parametrize("N", [1, 3, 6])
def test_the_motion_is_that_of_the_equations(N: int) -> None:
    """Random teams, states, inputs and forces.

    A period ends in nearly the same state, every component.
    """
    rng = np.random.default_rng(950 + N)
    for _ in range(4):
        system = random_system(rng, N)
        x, u, F = random_state(rng, N), random_input(rng, N), random_forces(rng, N)
        found = advanced(MujocoEngine(system, LIGHTEST), x, u, 0.05, F)
        expected = advanced(Rods(system, PlantSection(step_s=0.001)), x, u, 0.05, F)
        moved = np.abs(expected - x).max()
        assert np.abs(found - expected).max() < 2e-3 * moved


@pytest.mark.parametrize("section", [LIGHTEST, LIGHT_CABLES], ids=["rods", "cables"])
def test_the_drag_is_that_of_the_equations(section: PlantSection) -> None:
    """A team in flight at 5 m/s, tilted: half a second of drag and other forces moves it as the equations say.

    MuJoCo holds the drag over a step of 1 ms, so its velocity is off by half a step.
    """
    rng = np.random.default_rng(960)
    system = with_drag(rng, table_1())
    x, u = at_rest(system, -10.0), hover_inputs(system)
    x[state.V0] = [4.0, 3.0, -0.5]
    StateView(x).Theta[:, 1] = 0.3
    gust = np.tile([0.5, -0.3, 0.2], 5)
    found = advanced(MujocoEngine(system, section), x, u, 0.5, gust)
    expected = advanced(Rods(system, PlantSection(step_s=0.001)), x, u, 0.5, gust)
    vacuum = advanced(Rods(table_1(), PlantSection(step_s=0.001)), x, u, 0.5, gust)
    slowed = np.abs(expected - vacuum)[: state.V0.stop].max()
    assert slowed > 0.1
    assert np.abs(found - expected).max() < 5e-3 * slowed


@pytest.mark.parametrize("engine", [Rods, MujocoEngine])
def test_a_fall_in_still_air_ends_at_the_terminal_velocity(
    engine: type[Rods] | type[MujocoEngine],
) -> None:
    """Without thrust a team falls at v = m_T g / (d_0 + sum d_i^z), all UAVs level, (42).

    v(t) = v_end (1 - exp(-t / tau)), tau = m_T / (d_0 + sum d_i^z), from rest.
    """
    team = table_1()
    uavs = tuple(replace(uav, drag=np.array([0.1, 0.75])) for uav in team.uavs)
    system = replace(team, payload=replace(team.payload, drag=1.5), uavs=uavs)  # 9 kg, 4.5 kg/s
    tau_s, v_end = 2.0, 2.0 * system.gravity
    for t_s in (1.0, 8.0):
        x = advanced(engine(system, LIGHTEST), at_rest(system, -500.0), np.zeros(16), t_s)
        expected = v_end * (1.0 - np.exp(-t_s / tau_s))
        assert abs(x[state.V0][2] - expected) < 2e-3 * v_end


def test_the_difference_is_the_mass_of_the_rods() -> None:
    """Ten times lighter rods are ten times nearer to massless ones."""
    rng = np.random.default_rng(980)
    system = random_system(rng, 4)
    x, u = random_state(rng, 4), random_input(rng, 4)
    expected = advanced(Rods(system, PlantSection(step_s=0.001)), x, u, 0.2)
    errors = []
    for mass in (1e-1, 1e-2, 1e-3):
        section = PlantSection(
            engine="mujoco", mujoco=MujocoSection(step_s=0.001, rod_mass_kg=mass)
        )
        errors.append(np.abs(advanced(MujocoEngine(system, section), x, u, 0.2) - expected).max())
    assert all(5.0 < heavy / light < 20.0 for heavy, light in pairwise(errors)), errors


def test_a_heading_goes_on_beyond_half_a_turn() -> None:
    """A UAV that spins about its vertical has a heading that grows without a jump."""
    system = table_1()
    engine = MujocoEngine(system, LIGHTEST)
    x = at_rest(system, -10.0)
    StateView(x).omega_B[:, 2] = 6.0
    u = hover_inputs(system)
    engine.reset(x)
    headings = []
    for _ in range(40):
        engine.advance(u, None, 0.05)
        headings.append(StateView(engine.state()).Theta[0, 2])
    np.testing.assert_allclose(np.diff(headings), 0.3, atol=1e-6)


def hover_inputs(system: System, share: float = 1.0) -> Array:
    """Return inputs that carry the UAVs and a share of the payload, (4 N,)."""
    u = np.zeros(system.m)
    u[::4] = [
        (uav.mass + share * system.payload.mass / system.N) * system.gravity for uav in system.uavs
    ]
    return u


@pytest.mark.parametrize("section", [GROUND, GROUND_CABLES], ids=["rods", "cables"])
def test_the_ground_carries_the_load(section: PlantSection) -> None:
    """A load let down from 2 cm comes to rest on the ground, level.

    Without it the same team falls on.
    """
    system = table_1()
    height = resting_height(system, GROUND_M)
    assert height == GROUND_M - payload_half_size(system)[2] == GROUND_M - 0.125
    u = hover_inputs(system, 0.5)
    end = StateView(advanced(MujocoEngine(system, section), at_rest(system, height - 0.02), u, 2.0))
    assert end.r0_I == pytest.approx([0.0, 0.0, height], abs=2e-3)
    assert np.abs(end.v0_P).max() < 1e-3
    assert np.abs(end.Theta0).max() < 1e-3
    free = section.model_copy(update={"ground_m": None})
    assert (
        advanced(MujocoEngine(system, free), at_rest(system, height - 0.02), u, 1.0)[2]
        > GROUND_M + 0.5
    )


def test_uavs_lie_on_the_ground_too() -> None:
    """Without thrust the rods fall over; no UAV ends below the ground."""
    system = table_1()
    model = Model(system)
    x = at_rest(system, resting_height(system, GROUND_M))
    StateView(x).e_P[:, 1] = [0.05, -0.05, -0.05, 0.05]
    StateView(x).e_P[:] /= np.linalg.norm(StateView(x).e_P, axis=1, keepdims=True)
    engine = MujocoEngine(system, GROUND)
    engine.reset(x)
    for _ in range(100):
        engine.advance(np.zeros(system.m), None, 0.05)
        heights = model.outputs(engine.state())[: 3 * system.N].reshape(-1, 3)[:, 2]
        assert heights.max() < GROUND_M
    # Spheres of 10 cm.
    assert heights.max() == pytest.approx(GROUND_M - 0.1, abs=0.01)
    assert heights.min() > GROUND_M - 0.3


def test_a_load_lies_on_its_box_and_not_on_what_is_gone() -> None:
    """Its centre of mass may be elsewhere than in the middle; the bob of a released UAV hangs into the ground."""
    team = table_1()
    centre = np.array([0.0, 0.0, 0.05])
    payload = replace(team.payload, centre=centre)
    uavs = tuple(replace(uav, rho=uav.rho - centre) for uav in team.uavs)
    system = with_released(replace(team, payload=payload, uavs=uavs), [3])
    x = at_rest(system, GROUND_M - 0.125 + 0.05)
    StateView(x).e_P[3] = [0.0, 0.0, -1.0]
    u = hover_inputs(system, 0.5)
    u[12:] = 0.0
    end = StateView(advanced(MujocoEngine(system, GROUND), x, u, 1.0))
    assert end.r0_I == pytest.approx([0.0, 0.0, GROUND_M - 0.075], abs=2e-3)


def test_cables_pull_and_do_not_push() -> None:
    """A cable carries the load at its length.

    UAVs that sink faster than the load fall freely, their cables slack.
    """
    system = table_1()
    x = at_rest(system, -10.0)
    engine = MujocoEngine(system, CABLES)
    hanging = StateView(advanced(engine, x, hover_inputs(system), 1.0))
    assert hanging.r0_I == pytest.approx([0.0, 0.0, -10.0], abs=1e-5)
    tensions = Model(system).tensions(x, hover_inputs(system))
    assert engine.tensions == pytest.approx(tensions, rel=1e-3)
    push = np.zeros(system.m)
    forces = np.zeros(3 + 3 * system.N)
    forces[5::3] = 30.0  # N on each UAV, down
    pushed = advanced(engine, x, push, 0.2, forces)
    assert not engine.tensions.any()
    # The load falls as without UAVs: 0.2 m in 0.2 s.
    assert pushed[2] == pytest.approx(-10.0 + 0.5 * 9.81 * 0.2**2, abs=1e-3)
    rods = advanced(MujocoEngine(system, LIGHTEST), x, push, 0.2, forces)
    assert rods[2] > pushed[2] + 0.1


def test_two_engines_are_equal_bit_for_bit() -> None:
    """The same calls give the same bits, contacts included, also in an engine that has been used before."""
    system = table_1()
    x, u = at_rest(system, -0.15), hover_inputs(system, 0.3)
    first, used = MujocoEngine(system, GROUND), MujocoEngine(system, GROUND)
    advanced(used, at_rest(system, -0.2), 1.2 * u, 0.5)
    assert advanced(first, x, u, 0.5).tobytes() == advanced(used, x, u, 0.5).tobytes()


@pytest.mark.parametrize(
    ("duration_s", "longest_s", "count"),
    [(0.05, 0.005, 10), (0.05, 0.007, 8), (0.07, 0.01, 7), (0.004, 0.01, 1)],
    ids=["5 ms", "shorter, to fit in", "rounded", "shorter than one"],
)
def test_an_interval_is_as_good_as_its_steps(
    duration_s: float, longest_s: float, count: int
) -> None:
    """The fewest equal steps, none too long, at once or one by one: the same motion; the least tension is told."""
    system = table_1()
    x, u = at_rest(system, -10.0), hover_inputs(system)
    at_once, one_by_one = (
        MujocoEngine(
            system,
            PlantSection(engine="mujoco", mujoco=MujocoSection(step_s=step_s, suspension="cables")),
        )
        for step_s in (longest_s, duration_s / count)
    )
    for engine in (at_once, one_by_one):
        engine.reset(x)
    spans_N = []
    for share in (1.5, 0.5, 1.0):
        at_once.advance(share * u, None, duration_s)
        steps = []
        for _ in range(count):
            one_by_one.advance(share * u, None, duration_s / count)
            steps.append(one_by_one.tensions)
        np.testing.assert_allclose(at_once.state(), one_by_one.state(), rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(at_once.tensions, np.min(steps, axis=0), rtol=1e-9)
        spans_N.append(np.ptp(steps, axis=0).min())
    assert max(spans_N) > 0.1 or count == 1


def test_a_rod_is_homogeneous_and_thin() -> None:
    """A force F on the UAV turns a rod, with a mass at either end, by F d / I about the common centre of mass."""
    team, rod_kg, force_N, t_s = table_1(), 3.0, 10.0, 0.001
    uav = replace(team.uavs[0], rho=np.zeros(3))
    system = replace(team, uavs=(uav,))
    section = PlantSection(engine="mujoco", mujoco=MujocoSection(step_s=t_s, rod_mass_kg=rod_kg))
    engine, length = MujocoEngine(system, section), uav.rod_length
    engine.reset(at_rest(system, -10.0))
    engine.advance(np.zeros(4), np.array([0.0, 0.0, 0.0, force_N, 0.0, 0.0]), t_s)
    masses = np.array([system.payload.mass, rod_kg, uav.mass])
    places = np.array([0.0, length / 2.0, length])
    centre = masses @ places / masses.sum()
    inertia = masses @ (places - centre) ** 2 + rod_kg * length**2 / 12.0
    turned = force_N * (length - centre) / inertia * t_s
    found = StateView(engine.state()).Omega_P[0]
    np.testing.assert_allclose(found, [0.0, -turned, 0.0], rtol=1e-5, atol=1e-9)


def test_a_run_that_becomes_unstable_does_not_begin_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its state is no longer finite or far away, and nothing is written into the current folder."""
    monkeypatch.chdir(tmp_path)
    system = table_1()
    engine = MujocoEngine(system, LIGHTEST)
    end = advanced(engine, at_rest(system, -10.0), np.full(16, 1e9), 0.5)
    assert not np.isfinite(end).all()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["resilient", "precise"])
@pytest.mark.parametrize(
    "network", [IMPAIRED], ids=["impaired"]
)  # docs/measured_pages.py also has the perfect one
def test_the_controllers_hold_in_mujoco(name: str, network: tuple[str, ...]) -> None:
    """A leg completes, with a payload error of at most 1.3 times that of our equations, plus 1 cm."""
    found, own = payload_errors(name, LEG, MUJOCO, *network), payload_errors(name, LEG, *network)
    assert len(found) == len(own) == 140
    assert found.max() < 1.3 * own.max() + 0.01
    assert np.sqrt(np.mean(found**2)) < 1.3 * np.sqrt(np.mean(own**2)) + 0.01


@pytest.mark.slow
def test_fast_flight_on_cables() -> None:
    """At 3 m/s no cable is slack.

    With a fifth of its thrust a UAV slackens some for a moment; then all are taut.
    """
    eight = {
        "name": "eight",
        "kind": "eight",
        "size_m": [2.0, 1.0, 0.0],
        "laps": 1.0,
        "speed_mps": 3.0,
        "ramp_s": 3.0,
    }
    still = {"displacement_m": [0.0, 0.0, 0.0]}
    phases = [
        {"name": "hover", "duration_s": 0.5, **still},
        eight,
        {"name": "hover", "duration_s": 1.5, **still},
    ]
    dip = [
        {"at_s": at_s, "do": "degrade", "target": "uav2", "efficiency": e}
        for at_s, e in ((4.0, 0.2), (4.2, 1.0))
    ]
    settings = {
        "plant.engine": "mujoco",
        "plant.mujoco.suspension": "cables",
        "faults.event": dip,
        # Measured states, as filters take most of the time.
        "plant.sensors": "state",
        "controller.estimator": "measured",
        "plant.noise": {},
    }
    run = transport.fly("eight", settings, phases=phases, progress=False)
    tensions_N, cables = run.series["cable_tension_N"], run.summary["cables"]
    assert run.completed
    assert np.linalg.norm(run.series["payload_velocity_mps"], axis=1).max() > 2.9
    assert tensions_N[:80].min() > 1.0
    assert cables["slack"] > 0
    assert tensions_N[-40:].min() > 1.0
    assert np.linalg.norm(run.series["payload_error_m"][-20:], axis=1).max() < 0.03


@pytest.mark.slow
def test_planned_tensions_keep_cables_taut() -> None:
    """Cables become slack in a descent almost as fast as bodies fall.

    With a least planned tension they do not.
    """
    ways = (("hover", 1.0, 0.0), ("descend", 1.0, 6.0), ("hover", 1.5, 0.0))
    settings: dict[str, Any] = {
        "plant.engine": "mujoco",
        "plant.mujoco.suspension": "cables",
        "maneuver.phase": [
            {"name": name, "duration_s": s, "displacement_m": [0.0, 0.0, z]} for name, s, z in ways
        ],
    }
    loose, taut = (
        transport.fly("resilient", settings | more, progress=False).summary
        for more in ({}, {"controller.tension.minimum_N": 2.0})
    )
    assert loose["outcome"] == taut["outcome"] == "completed"
    assert loose["cables"]["slack"] > 0
    assert taut["cables"]["slack"] == 0
    assert taut["cables"]["tension_min_N"] > 1.8


@pytest.mark.slow
def test_rods_of_100_g_and_cables() -> None:
    """Rods of which the controllers know nothing, with the estimate of forces.

    And cables: a leg completes.
    """
    own = payload_errors("resilient", LEG).max()
    heavy = ("plant.mujoco.rod_mass_kg=0.1", "controller.disturbance.estimate=true")
    for changes in (heavy, ("plant.mujoco.suspension=cables",)):
        assert payload_errors("resilient", LEG, MUJOCO, *changes).max() < 1.3 * own + 0.01
