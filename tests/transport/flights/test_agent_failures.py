"""Permanent failure of an agent: the others complete the maneuver, also without its last plan."""

import numpy as np
import pytest

from tests.support.runs import ready
from transport.flight.memory import simulate
from transport.model.state import StateView
from transport.protocol.wire.messages import Control, Message, PlantState

# Payload attitude in a run with a death, deg.
LARGEST_DEG = 10.0
CONTINUE = "clock.on_agent_loss=continue"
ON_CHANGE = "controller.share=on_change"
POOR = ("links.delay_s=0.2", "links.loss=0.3")
QUIET = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]},"
    "{name='translate',duration_s=1.0,displacement_m=[0.5,0,0]},"
    "{name='hover',duration_s=3.0,displacement_m=[0,0,0]}]"
)


def flown(*settings: str) -> tuple[Control, np.ndarray]:
    """Simulate `resilient`.

    Return the end, and the largest roll or pitch of the payload at each tick, deg.
    """
    run = ready("resilient", CONTINUE, *settings)
    messages: list[Message] = []
    end = simulate(run, messages.append)
    x = np.array([message.x for message in messages if isinstance(message, PlantState)])
    return end, np.abs(np.degrees(StateView(x).Theta0[:, :2])).max(axis=1)


def killed(agent: int, at_s: float, before: str = "") -> str:
    """Return the setting of a permanent failure of an agent, after other events."""
    return f"faults.event=[{before}{{at_s={at_s},do='kill',target='agent{agent}'}}]"


@pytest.mark.slow
def test_three_bring_the_load_home() -> None:
    """In the paper's maneuver one agent of four dies for good, and the payload stays within 10 deg."""
    end, attitude_deg = flown(killed(2, 6.9))
    assert end.outcome == "completed"
    assert attitude_deg.max() < LARGEST_DEG


def test_an_agent_dies_after_a_release() -> None:
    """The fail-safe has the thrust of the UAVs left.

    The hover of the whole team would turn the payload over.
    """
    end, attitude_deg = flown(
        QUIET, killed(2, 2.0, before="{at_s=0.5,do='release',target='uav3'},")
    )
    assert (end.outcome, attitude_deg.max() < LARGEST_DEG) == ("completed", True)


@pytest.mark.parametrize("network", [(), POOR], ids=["perfect", "poor"])
def test_an_agent_whose_last_plan_was_not_shared(network: tuple[str, ...]) -> None:
    """With plans sent on change the last plan of a failed agent is not shared.

    The others predict its inputs by (32b).

    In the first hover it sends no plans, and is killed after it; the payload comes to rest as with
    all plans sent.
    """
    for share in ("controller.share=always", ON_CHANGE):
        end, attitude_deg = flown(QUIET, killed(2, 1.0), share, *network)
        assert end.outcome == "completed"
        assert attitude_deg.max() < LARGEST_DEG / 2.0, share
        assert attitude_deg[-10:].max() < 2.0, share
