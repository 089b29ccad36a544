"""Places of states and inputs in their vectors."""

import numpy as np
import pytest

from tests.support.random_systems import random_forces, random_input, random_state, random_system
from transport.model import state
from transport.model.linear.linearisation import Model


@pytest.mark.parametrize("uavs", [[0], [1, 2], [0, 1, 2, 3], [0, 2], [2, 1], [3]])
def test_places_of_inputs_read_the_same(uavs: list[int]) -> None:
    """As a slice or as positions, in the given order."""
    u = np.arange(16.0)
    np.testing.assert_array_equal(u[state.input_places(uavs)], u[state.input_indices(uavs)])


def test_tilts_are_roll_and_pitch_of_all_bodies() -> None:
    """Of the payload first, then of each UAV."""
    x = np.random.default_rng(3).standard_normal(state.PAYLOAD + 3 * state.PER_UAV)
    view = state.StateView(x)
    expected = np.concatenate([view.Theta0[:2], view.Theta[:, :2].reshape(-1)])
    np.testing.assert_array_equal(x[state.tilt_indices(3)], expected)


@pytest.mark.parametrize(("off", "released"), [((), ()), ((1,), ()), ((2,), (2,))])
def test_ways_to_the_same_numbers(off: tuple[int, ...], released: tuple[int, ...]) -> None:
    """A motion without its error, and derivatives under several forces, have the same bits as one."""
    rng = np.random.default_rng(4)
    system = random_system(rng, 3)
    model = Model(system, off=off, released=released)
    x, u = random_state(rng, 3, rate=0.5), random_input(rng, 3)
    forces = random_forces(rng, 3)

    end, _ = model.integrate(x, u, 0.05, 2, forces=forces)
    np.testing.assert_array_equal(model.advance(x, u, 0.05, 2, forces=forces), end)

    mass_error = 0.1 * system.payload.mass
    several = [np.append(scale * forces, mass_error) for scale in (0.0, 1.0, -2.0)]
    for found, each in zip(model.derivatives(x, u, several), several, strict=True):
        np.testing.assert_array_equal(found, model.derivative(x, u, forces=each))
