"""Reports of a team by tick and UAV, and the newest ticks that an agent has heard of."""

from collections.abc import Sequence

import numpy as np
import pytest

from tests.support.runs import measurement, plan, setup
from transport.agent.estimation.received_states import NewStates, Reports, UavReport
from transport.model import state


def report(number: float, missing: int = 0) -> UavReport:
    """Return measurements of sensors that are all one number, with inputs that are its negative."""
    return UavReport(np.full(state.SENSED, number), np.full(state.INPUTS, -number), missing)


def test_the_first_report_of_a_uav_at_a_tick_counts() -> None:
    """Later ones are repeats of it, whatever they hold; other UAVs and ticks have their own."""
    reports = Reports()
    for number, (tick, uav) in enumerate([(3, 0), (3, 0), (3, 1), (4, 0)]):
        reports.tell(tick, uav, report(number))
    assert {uav: told.values[0] for uav, told in reports.uavs(3).items()} == {0: 0.0, 1: 2.0}
    assert {uav: told.values[0] for uav, told in reports.uavs(4).items()} == {0: 3.0}
    assert [reports.has(*one) for one in [(3, 1), (4, 1), (5, 0)]] == [True, False, False]


def test_a_plan_repeats_the_reports_of_its_last_ticks() -> None:
    """Newest first, with the sensors that measured nothing; ticks without a report are known as such."""
    reports = Reports()
    reports.tell(7, 2, report(7.0, missing=0b101))
    reports.tell(6, 2, report(6.0))
    reports.tell(7, 0, report(9.0))
    rows = reports.rows(7, [2]).reshape(state.REPORTS, state.REPORTED)
    assert rows[:, state.IS_KNOWN].tolist() == [6.0, 1.0, *[0.0] * (state.REPORTS - 2)]
    assert rows[:, state.SENSED_VALUES][:3, 0].tolist() == [7.0, 6.0, 0.0]
    assert rows[:, state.REPORTED_INPUTS][:3, 0].tolist() == [-7.0, -6.0, 0.0]


def test_reported_inputs_replace_announced_ones() -> None:
    """Those of UAVs that have told theirs at the tick; what is forgotten is as if it had not been told."""
    reports = Reports()
    reports.tell(5, 1, report(2.0))
    reports.tell(5, 2, UavReport(np.zeros(state.SENSED)))
    reports.tell_payload(5, np.ones(state.PAYLOAD))
    for first, expected in [(5, [1.0, -2.0, 1.0]), (6, [1.0, 1.0, 1.0])]:
        reports.forget_before(first)
        u = np.ones(3 * state.INPUTS)
        reports.apply_inputs(5, u)
        assert u[:: state.INPUTS].tolist() == expected
        assert (reports.payload(5) is None) == (first > 5)


@pytest.mark.parametrize("ticks", [(3, 5, 4), (5, 4, 3), (4, 5, 5)])
def test_the_newest_state_counts_in_any_order(ticks: Sequence[int]) -> None:
    """Ages are of the newest tick heard of, not of the last message; -1 without any."""
    run = setup()
    heard = NewStates()
    assert (heard.age(2, 9), heard.measured) == (-1, -1)
    for tick in ticks:
        heard.take(plan(run, 2, tick))
        heard.take(measurement(run, 1, tick))
    assert (heard.age(2, 9), heard.age(3, 9), heard.measured) == (4, -1, 5)
