"""Bodies of the plant other than those that controllers assume (`[[plant.uav]]`, `load` in docs/reference/keys.md)."""

import numpy as np
import pytest

from tests.support.logs import log_of
from tests.support.random_systems import random_state
from tests.support.runs import SHORT, completed, plant_states, setup
from transport.analysis.events import events
from transport.flight.roles import plant_run
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.plant.actual_bodies import about
from transport.plant.engines import Engine
from transport.plant.node import PlantNode
from transport.plant.wind_and_noise import Environment
from transport.protocol.wire.messages import ActualInputs

CENTRE = np.array([0.06, -0.03, 0.02])  # m
ROUNDING = 1e-12
# Engines differ by the mass of the rods, a ten-thousandth of the UAVs', over half a second.
ENGINES = 1e-3
LOAD_TICK = 10


def advanced(engine: str, *settings: str) -> Array:
    """Return the state half a second after hover under held thrusts, one of them larger."""
    thin = ("plant.mujoco.rod_mass_kg=1e-4",) if engine == "mujoco" else ()
    run = setup(f"plant.engine={engine}", *thin, *settings)
    physics = Engine(plant_run(run), Environment(plant_run(run)).system)
    u = run.hover.u.copy()
    u[0] *= 1.05
    for _ in range(10):
        x, _ = physics.advance(u, None, 0.05)
    return x


def test_another_point_of_a_rigid_body() -> None:
    """Place and velocity of a point are those of (44a), and back, (44a) by differences of a motion."""
    run = setup()
    x = random_state(np.random.default_rng(3), run.system.N)
    moved = about(x, CENTRE)
    np.testing.assert_allclose(about(moved, -CENTRE), x, atol=ROUNDING)

    # The velocity of the point is the rate of its place.
    h = 1e-6
    rates = run.model.integrate(x, run.hover.u, h, 1)[0]
    speed_I = (about(rates, CENTRE)[state.R0] - moved[state.R0]) / h
    v_I = rotation(moved[state.THETA0]) @ moved[state.V0]
    np.testing.assert_allclose(speed_I, v_I, atol=1e-4)


def test_a_centre_of_mass_ahead_pulls_the_nose_down() -> None:
    """Both engines agree, and the point that the controllers know does not jump at the start."""
    ahead = "plant.payload_centre_m=[0.06,0.0,0.0]"
    as_known, rods, mujoco = advanced("rods"), advanced("rods", ahead), advanced("mujoco", ahead)
    assert rods[7] < as_known[7] - 1e-3  # pitch
    np.testing.assert_allclose(rods, mujoco, atol=ENGINES)

    run = setup(ahead)
    physics = Engine(plant_run(run), Environment(plant_run(run)).system)
    x, _ = physics.advance(run.hover.u, None, 1e-6)
    np.testing.assert_allclose(x, run.initial_state(), atol=1e-5)


def test_a_known_centre_is_no_difference() -> None:
    """Attachment points from the actual centre, given as known, are the same team: (44a).

    A system whose payload frame is at the actual centre moves as the plant with the offset.
    """
    offset = "plant.payload_centre_m=[0.06,-0.03,0.02]"
    mismatched = setup(offset)
    rho = [
        f"system.uav.{uav.id}.rho_m={(np.array(uav.rho_m) - CENTRE).tolist()}"
        for uav in mismatched.scenario.system.uav
    ]
    known = setup(*rho)
    x = random_state(np.random.default_rng(5), known.system.N)
    u = known.hover.u
    expected = known.model.integrate(x, u, 0.05, 5)[0]

    physics = Engine(plant_run(mismatched), Environment(plant_run(mismatched)).system)
    physics.restart(about(x, -CENTRE), Environment(plant_run(mismatched)).system)
    moved, _ = physics.advance(u, None, 0.05)
    np.testing.assert_allclose(about(moved, CENTRE), expected, atol=1e-9)


def test_factors_of_one_uav() -> None:
    """They are on top of those of all, and an efficiency on top of the factor of its thrust."""
    run = setup(
        SHORT,
        "plant.uav_mass_factor=1.1",
        "plant.payload_mass_factor=1.2",
        "plant.payload_inertia_factor=0.5",
        "plant.uav=[{id=2,mass_factor=1.5,thrust_factor=0.95},{id=3,inertia_factor=2.0}]",
        "faults.event=[{at_s=0.5,do='degrade',target='uav2',efficiency=0.9}]",
    )
    known, actual = run.system, Environment(plant_run(run)).system
    masses = [uav.mass / of.mass for uav, of in zip(actual.uavs, known.uavs, strict=True)]
    np.testing.assert_allclose(masses, [1.1, 1.65, 1.1, 1.1])
    inertias = [
        uav.inertia[0, 0] / of.inertia[0, 0]
        for uav, of in zip(actual.uavs, known.uavs, strict=True)
    ]
    np.testing.assert_allclose(inertias, [1.1, 1.65, 2.2, 1.1])
    assert actual.payload.mass == pytest.approx(1.2 * known.payload.mass)
    assert actual.payload.inertia[0, 0] == pytest.approx(0.5 * known.payload.inertia[0, 0])

    messages = completed(run)
    given = {one.tick: one.inputs for one in messages if isinstance(one, ActualInputs)}
    commands = {one.tick: one.u.reshape(-1, 4) for one in plant_states(messages)}
    for k, share in ((0, 0.95), (9, 0.95), (10, 0.95 * 0.9)):
        np.testing.assert_allclose(given[k][1], share * commands[k][1])
        np.testing.assert_allclose(given[k][0], commands[k][0])


@pytest.mark.parametrize("duration_s", [None, 0.25])
def test_a_load_that_changes(duration_s: float | None) -> None:
    """At once or linearly in time; the state does not jump, and the summary tells it."""
    lasting = "" if duration_s is None else f",duration_s={duration_s}"
    change = f"do='load',target='payload',mass_kg=2.0,centre_m=[0.05,0.0,0.0]{lasting}"
    run = setup(SHORT, f"faults.event=[{{at_s={0.05 * LOAD_TICK},{change}}}]")
    node = PlantNode(plant_run(run))
    ticks = range(LOAD_TICK - 1, LOAD_TICK + 7)
    loads = []
    for k in ticks:
        node._fail_uavs(k)  # the payload over each period
        payload = node.environment.system.payload
        loads.append([payload.mass, payload.inertia[0, 0], payload.centre[0]])

    shares = [0.0] + [1.0] * 7 if duration_s is None else [0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0]
    J = run.system.payload.inertia[0, 0]
    expected = [[3.0 - s, J * (1.0 - s / 3.0), 0.05 * s] for s in shares]
    np.testing.assert_allclose(loads, expected)
    np.testing.assert_allclose(
        node.environment.system.uavs[0].rho, run.system.uavs[0].rho - [0.05, 0.0, 0.0]
    )

    messages, without = completed(run), completed(setup(SHORT))
    paths = [np.array([one.x for one in plant_states(of)]) for of in (messages, without)]
    np.testing.assert_array_equal(paths[0][: LOAD_TICK + 1], paths[1][: LOAD_TICK + 1])
    assert np.abs(paths[0][LOAD_TICK + 1] - paths[1][LOAD_TICK + 1]).max() < 0.2
    assert np.abs(paths[0][-1] - paths[1][-1]).max() > 1e-3

    gradually = "" if duration_s is None else " gradually"
    text = f"payload changes{gradually}: 2 kg, centre of mass at [0.05, 0.0, 0.0] m by script"
    (told,) = events(run, log_of(messages), None)
    assert (told["tick"], told["what"], told["processes"]) == (LOAD_TICK, text, ["payload"])
