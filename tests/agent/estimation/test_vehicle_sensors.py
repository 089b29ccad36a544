"""Estimator from the vehicles' sensors: any order of arrival, same bits."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from tests.agent.estimation.swing import (
    PERIOD_S,
    TICKS,
    filtered,
    in_time,
    measured,
    moving,
    no_feedback,
    reported,
)
from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.estimation.estimator import sensor_estimator
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.agent.estimation.predicted_motion import PredictedMotion
from transport.agent.estimation.sensor_estimator import SensorEstimator
from transport.model import state
from transport.model.arrays import Array


def test_messages_in_any_order_give_the_same_bits() -> None:
    """Late, shuffled messages, most lost but repeated later, end in the bits of those in time."""
    last = TICKS - 1
    together = [one for plans in in_time(2, 1).values() for one in plans if one.tick < last - 1]
    kept = [one for one in together if one.tick % state.REPORTS == 1 or one.tick == last - 2]
    rng = np.random.default_rng(0)
    rng.shuffle(kept)
    on_time = {one.tick + 1: [p for p in together if p.tick == one.tick] for one in together}

    straight = filtered(on_time, 2, last)[-1]
    # The inputs of the last period are those of the newest plans, which both have.
    late = filtered({last - 1: kept}, 2, last)[-1]

    assert late.x.tobytes() == straight.x.tobytes()
    assert late.covariance.P.tobytes() == straight.covariance.P.tobytes()


@pytest.mark.parametrize("ages", [(0, 0, 0, 0, 0), (2, 1, 0, 1, 0)])
def test_late_measurements_give_the_bits_of_those_in_time(ages: Sequence[int]) -> None:
    """A measurement is of quantities up to its age before, and has the inputs of the period before it.

    Those are not the announced ones here.
    """
    run, _, U, Z = moving(3)
    last = 11

    def belief(arrivals: Mapping[int, int]) -> Belief:
        """Return the belief at the last tick, with some measurements that arrive at later ticks."""
        motion = PredictedMotion(
            model=run.model, reference=lambda tick: run.X_ref[tick], period_s=PERIOD_S
        )
        estimator = SensorEstimator(
            motion, run.owned[0], TeamFilter(run.run), no_feedback(run), ages
        )
        announced = AnnouncedInputs(run.owned, run.hover.u, own=1)
        for k in range(last + 1):
            for tick in range(k + 1):
                if arrivals.get(tick, tick) == k:
                    estimator.measure(measured(run, tick, U[tick], Z[tick]))
            estimator.estimate(k, announced)
        assert estimator.belief is not None
        return estimator.belief

    in_order = belief({})
    for late in ({5: last}, {4: 6, 5: last, 8: 9}):
        found = belief(late)
        assert found.x.tobytes() == in_order.x.tobytes()
        assert found.covariance.P.tobytes() == in_order.covariance.P.tobytes()


def test_inputs_of_a_period_are_told_by_the_reports_at_its_end() -> None:
    """The gain of the law is asked for in periods alone whose inputs neither plan nor report has told."""
    last = 6
    newest = last - 1  # of the only plans that arrive, just before the last tick
    run, _, U, Z = moving(3)
    asked: list[int] = []

    def feedback(tick: int) -> Array:
        asked.append(tick)
        return no_feedback(run)(tick)

    estimator = sensor_estimator(run.run, 1, lambda k: run.X_ref[k].copy(), feedback)
    announced = AnnouncedInputs(run.owned, run.hover.u, own=1)
    for k in range(last + 1):
        estimator.measure(measured(run, k, U[k], Z[k]))
        if k < last:
            estimator.estimate(k, announced)
    assert set(asked) == set(range(last - 1))

    for agent in (2, 3, 4):
        estimator.take(reported(run, agent, newest, U, Z))
    asked.clear()
    estimator.estimate(last, announced)
    assert set(asked) == {newest}  # reports tell the periods before their ticks
