"""The plan a controller announces: within limits, at any team size and horizon, from any state."""

import numpy as np
import pytest

from tests.support.systems import Situation, controller, paper_setup, ring_setup, situation, step
from transport.model.arrays import Array
from transport.mpc.settings_period_horizon_weights import ControllerSettings, SeparationSection

# N and N m. Bounds are clipped exactly; rates are as good as the solver's primal tolerance times
# the scale.
LIMIT_SLACK = 1e-6
# N and N m. At equilibrium the drift is zero up to rounding, which the weights amplify.
HOVER_AGREEMENT = 1e-9

OWNED = [(0,), (1, 3), (0, 1, 2, 3)]


def limits_kept(
    settings: ControllerSettings, owned: tuple[int, ...], u: Array, plan: Array
) -> bool:
    """Return whether a plan keeps bounds and rates, the first rate against the inputs in force."""
    uavs = len(owned)
    own = [4 * i + j for i in owned for j in range(4)]
    low, high = settings.lower(uavs), settings.upper(uavs)
    rate = settings.largest_step(uavs)
    change = np.abs(np.diff(np.vstack([u[own], plan]), axis=0))
    return bool(
        (plan >= low).all() and (plan <= high).all() and (change <= rate + LIMIT_SLACK).all()
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("owned", OWNED)
def test_plan_keeps_bounds_and_rates(owned: tuple[int, ...], seed: int) -> None:
    """From violent states the plan stays within the input limits and their rates, paper (18) and section V-A."""
    setup = paper_setup()
    settings = ControllerSettings(horizon=12, separation=SeparationSection(minimum_m=0.4))
    at = situation(setup, settings, seed, size=0.3)
    at = Situation(x=at.x, u=setup.hover.u, U=at.U, y_ref=at.y_ref)
    optimum = step(controller(setup, settings, owned), at)
    assert optimum.solution.status == "solved"
    assert limits_kept(settings, owned, at.u, optimum.U)
    own_rate = settings.largest_step(len(owned))
    assert (np.abs(np.diff(optimum.U, axis=0)) > 0.99 * own_rate).any(), (
        "no rate was ever at its limit"
    )


@pytest.mark.parametrize("thrust", [-20.0, -3.0, 46.0, 80.0])
def test_inputs_outside_their_limits_come_back(thrust: float) -> None:
    """Inputs in force outside the bounds leave the program solvable and the plan inside, paper (18)."""
    setup, settings = paper_setup(), ControllerSettings(horizon=8)
    at = situation(setup, settings, seed=3)
    u = at.u.copy()
    u[4] = thrust
    optimum = step(
        controller(setup, settings, (1,)), Situation(x=at.x, u=u, U=at.U, y_ref=at.y_ref)
    )
    assert optimum.solution.status == "solved"
    assert (settings.lower(1) <= optimum.U).all()
    assert (settings.upper(1) >= optimum.U).all()


@pytest.mark.parametrize("horizon", [1, 10, 40])
@pytest.mark.parametrize("N", [1, 2, 8])
def test_any_team_size_and_horizon(N: int, horizon: int) -> None:
    """Teams of 1, 2 and 8 hold hover exactly and answer a disturbance within limits, at horizons 1 to 40."""
    setup = ring_setup(N)
    settings = ControllerSettings(horizon=horizon, separation=SeparationSection(minimum_m=0.2))
    all_uavs = tuple(range(N))
    # All eight over 40 steps is a program of 1280 unknowns: seconds, and nothing the others do not
    # show.
    for owned in [(0,)] if N == 8 and horizon == 40 else [(0,), all_uavs]:
        one = controller(setup, settings, owned)
        y_ref = np.tile(setup.model.outputs(setup.x), (horizon + 1, 1))
        still = Situation(
            x=setup.x, u=setup.hover.u, U=np.tile(setup.hover.u, (horizon, 1)), y_ref=y_ref
        )
        held = step(one, still)
        assert np.allclose(held.U, still.U[:, one.own], rtol=0.0, atol=HOVER_AGREEMENT)
        at = situation(setup, settings, seed=N)
        moved = step(one, Situation(x=at.x, u=setup.hover.u, U=at.U, y_ref=at.y_ref))
        assert moved.solution.status == "solved"
        assert moved.U.shape == (horizon, 4 * len(owned))
        assert limits_kept(settings, owned, setup.hover.u, moved.U)
