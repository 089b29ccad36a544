"""Gain that is used again: nearly as exact, its covariance exact, no effect if switched off."""

import numpy as np
import pytest

from tests.agent.estimation.swing import TICKS, filtered, in_time, moving, sensed
from tests.agent.estimation.test_team_filter import told_period
from transport.agent.estimation.filter.belief import Belief, Covariance
from transport.agent.estimation.filter.filter_interface import Filter
from transport.agent.estimation.filter.gain_reuse import MOST_TICKS, Deferred, GainReuse
from transport.agent.estimation.filter.team_filter import TeamFilter
from transport.model.arrays import Array

DELAY = 4  # ticks
HALF = 0.5  # share of the filter's first doubt
# Largest ratio of the error and of the variance to those with own gains, and what noise adds, m.
ERROR_RATIO, VARIANCE_RATIO = 1.1, 1.2
NOISE_M = 1e-3


def with_late_plans(most_ticks: int) -> tuple[Array, Belief]:
    """Return errors of the payload's position, and the last belief, with plans that are late."""
    _, X, _, _ = moving(3, HALF)
    beliefs = filtered(in_time(3, DELAY, HALF), 3, TICKS - 1, HALF, most_ticks)
    errors = [belief.x - x for belief, x in zip(beliefs, X, strict=False)]
    return np.array(errors)[2 * DELAY :, :3], beliefs[-1]


def test_newest_ticks_are_nearly_as_exact_as_with_their_own_gains() -> None:
    """The gain of the last tick with others' messages costs a tenth of the error; P knows it."""
    errors, quick = with_late_plans(MOST_TICKS)
    least, exact = with_late_plans(0)
    assert not np.array_equal(quick.x, exact.x)
    assert np.sqrt((errors**2).mean()) < ERROR_RATIO * np.sqrt((least**2).mean()) + NOISE_M
    variance, least_variance = (np.trace(b.covariance.P[:3, :3]) for b in (quick, exact))
    assert least_variance < variance < VARIANCE_RATIO * least_variance


def flown(team: Filter, own_only: range) -> list[Belief]:
    """Return the beliefs of a filter with all measurements, at some ticks with agent 1's alone."""
    run, X, U, Z = moving(4, HALF)
    belief = team.first(run.X_ref[0])
    beliefs = []
    for k in range(TICKS):
        measurements = sensed(Z[k])
        belief = team.correct(
            belief, run.model, measurements[:1] if k in own_only else measurements
        )
        beliefs.append(belief)
        belief = team.predict(belief, told_period(run, X[k + 1], U[k + 1], team.forces(belief)))
    return beliefs


def test_switched_off_it_is_the_plain_filter() -> None:
    """Without reuse every belief has the bits of the filter alone, with deferred covariances."""
    run, *_ = moving(4, HALF)
    own_only = range(10, 16)
    plain = flown(TeamFilter(run.run), own_only)
    off = flown(GainReuse(TeamFilter(run.run), [0], most_ticks=0), own_only)
    for one, other in zip(plain, off, strict=True):
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(one.covariance.P, other.covariance.P)


def test_a_gain_is_used_again_where_own_measurements_are_alone_and_for_some_ticks() -> None:
    """Ticks with own measurements alone use a saved gain until the limit, then have their own."""
    run, *_ = moving(4, HALF)
    beliefs = flown(GainReuse(TeamFilter(run.run), [0], most_ticks=3), range(10, 16))
    ticks = [None if belief.saved is None else belief.saved.ticks for belief in beliefs[9:17]]
    assert ticks == [0, 1, 2, 3, 0, 1, 2, 0]


def test_a_deferred_covariance_is_computed_once_when_asked_for() -> None:
    """Nothing is computed before, and nothing twice."""
    run, *_ = moving(4, HALF)
    covariance = TeamFilter(run.run).first(run.X_ref[0]).covariance
    calls = []

    def compute() -> Covariance:
        calls.append(1)
        return covariance

    deferred = Deferred(compute)
    assert calls == []
    assert deferred.value is covariance
    assert deferred.value is covariance
    assert calls == [1]


def test_a_failure_to_compute_is_not_hidden() -> None:
    """An error is raised at every request, not only at the first."""

    def fail() -> Covariance:
        raise FloatingPointError("no inverse")

    deferred = Deferred(fail)
    for _ in range(2):
        with pytest.raises(FloatingPointError, match="no inverse"):
            _ = deferred.value
