"""Divergence: the plant reports it with a reason and stops."""

import numpy as np
import pytest

from tests.support.nodes import PlantNode
from tests.support.runs import ALL, plan, roster, setup, tick
from transport.model.arrays import Array
from transport.protocol.wire.messages import PlantState

# N: 1.5 kg and a quarter of the payload's 3 kg, under 9.81 m/s^2.
HOVER = np.array([22.0725, 0.0, 0.0, 0.0])


def last_state(settings: tuple[str, ...], shoves: dict[int, Array], ticks: int = 1) -> PlantState:
    """Return the plant state after some ticks at hover in which some UAVs have other inputs."""
    run = setup(*settings)
    node = PlantNode(run)
    messages = list(node.receive(roster(), 0))
    for k in range(ticks):
        messages += node.receive(tick(k), 0)
        for agent in ALL:
            inputs = np.tile(shoves.get(agent, run.hover.u[:4]), (2, 1))
            messages += node.receive(plan(run, agent, k, inputs=inputs), 0)
    found = [message for message in messages if isinstance(message, PlantState)][-1]
    if found.diverged:
        # Whatever comes now, the flight is over.
        after = [
            *node.receive(tick(found.tick + 1), 0),
            *node.receive(plan(run, 1, found.tick + 1), 0),
        ]
        assert after == []
    return found


@pytest.mark.parametrize(
    ("moments", "reason"),
    [
        ([1.0, 0.0, 0.0], "UAV2 roll of 2 deg exceeds 1 deg"),
        ([-1.0, 0.0, 0.0], "UAV2 roll of 2 deg exceeds 1 deg"),
        ([0.1, -1.0, 0.0], "UAV2 pitch of 2 deg exceeds 1 deg"),
    ],
)
def test_attitude(moments: list[float], reason: str) -> None:
    """A UAV that tilts beyond the limit, either way, is named with its angle.

    1 N m turns it by 2.5 deg in 50 ms.
    """
    found = last_state(("plant.max_attitude_deg=1",), {2: np.array([HOVER[0], *moments])})
    assert found.diverged == reason


def test_position() -> None:
    """A payload too far from its reference ends the flight; the reason has the distance."""
    more = HOVER + np.array([10.0, 0.0, 0.0, 0.0])
    found = last_state(("plant.max_error_m=0.5",), dict.fromkeys(ALL, more), ticks=10)
    # 40 N more on 9 kg: 0.5 m after 0.47 s, in the tenth interval of 50 ms.
    assert (found.tick, found.diverged) == (9, "payload position error of 0.6 m exceeds 0.5 m")


def test_position_is_that_of_the_path_at_its_time() -> None:
    """A payload that stays behind a moving reference ends the flight when that is too far ahead."""
    ahead = "maneuver.phase=[{name='leg',duration_s=1.0,displacement_m=[4.0,0.0,0.0]}]"
    limit = "plant.max_error_m=0.5"
    run = setup(ahead, limit)
    path_m = run.maneuver.path(0.05 * np.arange(21.0))[0][:, 0]
    beyond = int(np.argmax(path_m > 0.5))
    found = last_state((ahead, limit), {}, ticks=20)
    reason = f"payload position error of {path_m[beyond]:.1f} m exceeds 0.5 m"
    assert (found.tick, found.diverged) == (beyond - 1, reason)


@pytest.mark.filterwarnings("ignore:overflow")  # that is what is tested
def test_not_finite() -> None:
    """A state that is no longer finite ends the flight, and is not sent.

    The log ends with the last finite one.
    """
    found = last_state(
        ("controller.limits.thrust_N=[0,1e12]",), {3: np.array([1e12, 0.0, 0.0, 0.0])}
    )
    assert found.diverged == "the state is no longer finite"
    assert np.isfinite(found.x).all()
    assert found.local_error == -1.0
