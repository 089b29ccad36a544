"""UAVs alone as one agent sees them: by the kernel and by Python, through failures and new references."""

from collections.abc import Callable

import numpy as np
import pytest

from tests.support import runs
from transport.model.arrays import Array
from transport.model.kernels import native
from transport.mpc.alone.uav_motion import motion_of
from transport.mpc.law.laws_of_uavs_alone import AloneTeam
from transport.mpc.law.present_law import Regulation
from transport.protocol.scenario.setup.run_setup import Setup

TICK = 40


def team_of(setup: Setup) -> AloneTeam:
    """Return the UAVs of a run alone."""
    reference = setup.reference.sampled
    regulation = Regulation(setup.model, setup.hover, setup.settings, reference)
    return AloneTeam(setup.model, setup.hover, setup.settings, regulation, reference)


def expected(team: AloneTeam, setup: Setup, uav: int, x: Array, integral_I: Array) -> Array:
    """Return the inputs of a UAV by its present law and setpoint."""
    return team.law(uav).inputs(
        motion_of(setup.system, uav, x), team.setpoint(uav, TICK), integral_I
    )


@pytest.mark.parametrize("compiled", [False, True], ids=["Python", "kernel"])
def test_inputs_follow_the_present_team(*, compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a failure, a release and another reference no law and no setpoint is that of before."""
    if compiled and not native.AVAILABLE:
        pytest.skip("no compiled kernels")
    monkeypatch.setattr(native, "AVAILABLE", compiled)
    setup, elsewhere = runs.ready("resilient"), runs.ready("gap")
    team = team_of(setup)
    rng = np.random.default_rng(5)
    x = setup.hover.x + 0.05 * rng.standard_normal(setup.system.n)
    integral_I = rng.standard_normal(3)

    changes: list[Callable[[], None]] = [
        lambda: None,
        lambda: team.fail({1}, set()),
        lambda: team.fail({1}, {1}),
        lambda: team.follow(elsewhere.reference.sampled),
    ]
    seen = []
    for change in changes:
        change()
        found = team.inputs(0, x, TICK, integral_I)
        np.testing.assert_allclose(found, expected(team, setup, 0, x, integral_I), rtol=1e-11)
        seen.append(found)
    assert np.abs(np.diff(seen, axis=0)).max(axis=1).min() > 1e-3
