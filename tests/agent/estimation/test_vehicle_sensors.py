"""Estimator from the vehicles' sensors: any order of arrival, same bits."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

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
from tests.support.runs import VEHICLE, measurement, plan, setup
from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.agent.communication.unannounced_inputs import Unannounced
from transport.agent.estimation.estimator import sensor_estimator
from transport.agent.estimation.filter.belief import Belief
from transport.agent.estimation.filter.filter_interface import FilterPeriod, Sensed
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.agent.estimation.predicted_motion import PredictedMotion
from transport.agent.estimation.received_states import UavReport
from transport.agent.estimation.sensor_estimator import SensorEstimator
from transport.agent.silence.silence_thresholds import SHARED
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


# A filter and a motion that note what they are given: the model of a tick is its number.

AGES = (2, 1, 0, 1, 0)
LAST = 9
NO_SENSORS = 0b11111


@dataclass
class Noted:
    """What a filter was last given for each tick, and the ticks at which its belief is implausible once."""

    sensed: dict[int, list[Sensed]] = field(default_factory=dict)
    periods: dict[int, FilterPeriod] = field(default_factory=dict)
    entries_at: set[int] = field(default_factory=set)
    implausible: set[int] = field(default_factory=set)

    def first(self, x: Array) -> Any:
        """Return a belief."""
        return SimpleNamespace(x=x)

    def predict(self, _: Any, period: Any) -> Any:
        """Return the belief at the end of a period."""
        self.periods[period.model] = period
        return SimpleNamespace(x=period.end)

    def correct(self, belief: Any, tick: Any, sensed: list[Sensed]) -> Any:
        """Return a belief that is an eighth further."""
        self.sensed[tick] = sensed
        return SimpleNamespace(x=belief.x + 0.125, tick=tick)

    def is_plausible(self, belief: Any) -> bool:
        """Return whether a belief is, by its tick."""
        is_implausible = belief.tick in self.implausible
        self.implausible.discard(belief.tick)
        return not is_implausible

    def forces(self, belief: Any) -> Array:
        """Return forces by the belief."""
        return np.array([7.0 * belief.x[0]])

    # The motion.

    def reference_at(self, tick: int) -> Array:
        """Return a state by tick."""
        return np.full(60, 1000.0 * tick)

    def model_at(self, tick: int) -> int:
        """Return the tick for a model."""
        return tick

    def set_entries(self, _: Array, tick: int) -> list[Array]:
        """Return none, and note the tick."""
        self.entries_at.add(tick)
        return []

    def predict_motion(self, x: Array, tick: int, u: Array, forces: Array) -> Array:
        """Return a state that depends on all."""
        return np.asarray(x + tick + 0.01 * u.sum() + forces[0])


def report_of(tick: int, uav: int, missing: int = 0) -> UavReport:
    """Return a report whose numbers encode tick and UAV."""
    number = 10.0 * tick + uav
    return UavReport(np.full(state.SENSED, number), np.full(state.INPUTS, -number), missing)


def _rows(reports: Mapping[int, UavReport], newest: int) -> Array:
    """Return reports as a plan of the newest tick has them, one row for each of the last ticks."""
    rows = np.zeros((state.REPORTS, state.REPORTED))
    for tick, one in reports.items():
        rows[newest - tick] = [1.0 + one.missing, *one.values, *np.asarray(one.inputs)]
    return rows


def _assert_sensed(noted: Noted, told: Mapping[int, Mapping[int, UavReport]]) -> None:
    """Check the measurements of each tick: those of an older quantity are reported at a later tick."""
    for tick in range(1, LAST + 1):
        expected = [
            (uav, sensors, one.values[0])
            for age, of_age in ((0, (2, 4)), (1, (1, 3)), (2, (0,)))
            for uav, one in sorted(told.get(tick + age, {}).items())
            if (sensors := tuple(s for s in of_age if not one.missing >> s & 1))
        ]
        assert [(one.uav, one.sensors, one.values[0]) for one in noted.sensed[tick]] == expected


def test_each_measurement_counts_for_the_tick_that_it_is_of() -> None:
    """By the age of its sensor, without missing ones, in the order of UAVs; inputs for the period before the report.

    Agent 3's plan of tick 6 comes before agent 2's of tick 7, each with reports of the ticks before.
    """
    run = setup(*VEHICLE)
    noted = Noted()
    motion = SimpleNamespace(
        reference_at=noted.reference_at,
        model_at=noted.model_at,
        set_entries=noted.set_entries,
        predict=noted.predict_motion,
        add=lambda _: None,
    )
    estimator = SensorEstimator(motion, [0], noted, lambda tick: np.full((1, 1), tick), AGES)  # type: ignore[arg-type]
    mask = np.ones(run.system.m, dtype=bool)
    announced: Any = SimpleNamespace(
        in_force=lambda tick, before, x: np.full(run.system.m, 100.0 * tick + before + x[0]),
        unannounced=lambda tick, before: Unannounced(
            by_law=mask & (before > tick), by_fail_safe=~mask
        ),
        silent=lambda tick, before: (tick, before),
    )
    assert (estimator.belief, estimator.log_numbers(), estimator.start_state(0)) == (None, {}, None)

    told: dict[int, dict[int, UavReport]] = {
        tick: {0: report_of(tick, 0, 0b00100 if tick == 4 else 0)} for tick in range(LAST + 1)
    }
    of_plans = {
        3: {6: report_of(6, 2), 4: report_of(4, 2, NO_SENSORS), 3: report_of(3, 2, 0b00011)},
        2: {7: report_of(7, 1), 6: report_of(6, 1), 5: report_of(5, 1), 4: report_of(4, 1)},
    }
    for k in range(LAST + 1):
        for agent, newest in ((3, 6), (2, 7)) if k == LAST else ():
            rows = _rows(of_plans[agent], newest)
            for tick, one in of_plans[agent].items():
                told[tick][agent - 1] = one
            sent = structs.replace(plan(run, agent, newest), uav_states=rows.reshape(1, -1))
            estimator.take(sent)
            others = rows.copy()
            others[:, state.SENSED_VALUES] += 1.0
            estimator.take(structs.replace(sent, uav_states=others.reshape(1, -1)))  # not the first
        own = told[k][0]
        seen = structs.replace(
            measurement(run, 1, k),
            payload=np.zeros(0),
            uav_states=own.values[None],
            inputs=np.asarray(own.inputs)[None],
            missing=(own.missing,) if own.missing else (),
        )
        estimator.measure(seen)
        x = estimator.estimate(k, announced)
    assert (estimator.new_states.measured, estimator.new_states.age(3, LAST)) == (LAST, LAST - 6)

    _assert_sensed(noted, told)
    for tick, period in noted.periods.items():
        reporting = told[tick + 1]
        is_told = np.zeros(run.system.m, dtype=bool)
        for uav, one in reporting.items():
            is_told[state.input_slice(uav)] = True
            np.testing.assert_array_equal(period.u[state.input_slice(uav)], one.inputs)
        x_begin: Any = estimator.past(tick)
        if tick:  # the first period is not repeated
            assert (period.u[~is_told] == 100.0 * tick + LAST + x_begin[0]).all()
            assert str(period.silent) == str((tick, LAST))
            forces = noted.forces(SimpleNamespace(x=x_begin))
            end = noted.predict_motion(x_begin, tick, period.u, forces)
            np.testing.assert_array_equal(period.forces, forces)
            np.testing.assert_array_equal(period.end, end)
        assert (period.unannounced.by_law == ~is_told).all()
        np.testing.assert_array_equal(period.K, [[tick]])
        assert period.correlation == SHARED
    assert noted.entries_at == set(range(1, LAST + 1))
    assert estimator.forces == noted.forces(SimpleNamespace(x=x))
    assert estimator.resets == set()

    # A tick whose belief is implausible begins about the reference, with its measurements.
    noted.implausible = {LAST + 1}
    x = estimator.estimate(LAST + 1, announced)
    assert estimator.resets == {LAST + 1}
    np.testing.assert_array_equal(x, noted.reference_at(LAST + 1) + 0.125)

    # A failure that is heard late changes the step that ends at its tick, and all later ones.
    noted.periods.clear()
    estimator.change(SimpleNamespace(tick=LAST - 1))  # type: ignore[arg-type]
    estimator.estimate(LAST + 2, announced)
    assert set(noted.periods) == {LAST - 2, LAST - 1, LAST, LAST + 1}


def test_messages_too_old_to_be_used_are_ignored() -> None:
    """Of a tick before the first one that is kept, by plan or measurement."""
    run, _, U, Z = moving(3)
    estimator = sensor_estimator(run.run, 1, lambda k: run.X_ref[k].copy(), no_feedback(run))
    announced = AnnouncedInputs(run.owned, run.hover.u, own=1)
    estimator.estimate(8, announced)
    estimator.take(reported(run, 2, 7, U, Z))
    estimator.measure(measured(run, 7, U[7], Z[7]))
    assert (estimator.new_states.age(2, 8), estimator.new_states.measured) == (-1, 7)
    assert estimator.told(7, 0) is None
    estimator.take(reported(run, 2, 8, U, Z))
    assert estimator.new_states.age(2, 8) == 0
    assert [estimator.told(tick, 1) is None for tick in (7, 8)] == [True, False]
