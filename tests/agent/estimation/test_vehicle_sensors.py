"""Estimator from the vehicles' sensors: any order of arrival, same bits."""

import numpy as np

from tests.agent.estimation.swing import TICKS, filtered, in_time
from transport.model import state


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
