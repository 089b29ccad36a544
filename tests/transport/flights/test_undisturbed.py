"""The motion that UAVs whose agents hear no others, and those without an agent, take the team to be on."""

import numpy as np
import pytest

from tests.support import runs
from transport.flight.memory import simulate
from transport.model import state
from transport.model.arrays import Array
from transport.model.path.target_and_stop import PathTarget
from transport.mpc.alone.undisturbed_motion import UndisturbedMotion
from transport.mpc.law.present_law import Regulation
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_timing import straight
from transport.protocol.wire.messages import Message, PlantState

# Limits of thrust and corrections of the programs shift the team from its law by centimetres.
FORESEEN_M = 0.03
ARRIVED_M = 0.01
# Thrusts of up to 20 N, in one sum and in two.
ROUNDING_N, MOVED_N = 1e-9, 0.1
GONE = 1  # UAV, 0-based
AT, BACK = 100, 64  # tick of a target, and how far estimators look back


def motion_of(run: Setup) -> tuple[UndisturbedMotion, Setup]:
    """Return the motion of the whole team of a run that follows a hover reference."""
    motion = run.whole_team().law.fail_safe.motion
    assert motion is not None
    return motion, run


@pytest.mark.parametrize("scenario", ["resilient", "precise"])
def test_the_team_takes_the_motion_foreseen(scenario: str) -> None:
    """In still air and on a perfect network, along corners, (31f)."""
    motion, run = motion_of(runs.ready(scenario))
    messages: list[Message] = []
    assert simulate(run, messages.append).outcome == "completed"
    flown = np.array([message.x for message in messages if isinstance(message, PlantState)])
    foreseen = np.array([instant.x for instant in motion.over(0, len(flown))])
    assert np.abs(flown - foreseen)[:, state.R0].max() < FORESEEN_M
    assert np.ptp(flown[:, state.R0], axis=0).max() > 1.0, "nothing moved"


def test_a_long_hover_ends_soon() -> None:
    """The motion is held a minute after the last move: half an hour of hover takes no time."""
    motion, run = motion_of(runs.ready("playground"))
    assert motion.last < run.ticks / 10
    assert motion.at(run.ticks).x.tolist() == motion.at(motion.last).x.tolist()


def test_a_target_continues_it() -> None:
    """Until the target it stays as it was, bit for bit; then it leads there."""
    run = runs.ready("playground")
    whole = run.whole_team()
    before = whole.law.fail_safe.motion
    assert before is not None
    goal: Array = run.X_ref[0, state.R0] + [1.0, -0.5, -0.5]
    since_s = AT * run.settings.sampling_period_s
    target = PathTarget(since_s=since_s, point_I=goal, approach=straight(4.0, 1.0))
    sent = run.with_target(target)
    reference = sent.reference.sampled
    assert reference.change is not None
    whole.follow(reference, reference.change)
    after = whole.law.fail_safe.motion
    assert after is not None
    for tick in range(AT - BACK, AT + 1):
        np.testing.assert_array_equal(after.at(tick).x, before.at(tick).x)
    at_rest = after.at(after.last).x[state.R0]
    assert np.abs(at_rest - goal).max() < ARRIVED_M
    assert np.abs(before.at(after.last).x[state.R0] - goal).max() > 0.4


@pytest.mark.parametrize("preview", [True, False])
def test_the_others_know_it_of_a_dead_agent(*, preview: bool) -> None:
    """On the motion the law of the others has the inputs of the motion for a UAV without an agent, (45a)."""
    run = runs.ready("resilient", f"controller.preview={str(preview).lower()}")
    motion, _ = motion_of(run)
    regulation = Regulation(run.model, run.hover, run.settings, run.reference.sampled)
    regulation.form([GONE], (), ())
    own = state.input_slice(GONE)
    moved = 0.0
    for tick in range(0, run.ticks, 10):
        x, u = motion.at(tick)
        by_law = regulation.inputs(x, run.X_ref[tick], None, tick)
        assert by_law is not None
        np.testing.assert_allclose(by_law[own], u[own], atol=ROUNDING_N)
        moved = max(moved, float(np.abs(u - run.hover.u)[own].max()))
    assert moved > MOVED_N, "nothing moved"
