"""How much an agent acts alone, by the age of its information (docs/equations.md (32c)-(32e))."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from transport.agent.planning.hand_over_inputs import Mixture, mixed
from transport.agent.silence.age_of_information import InformationAge, InformationAges
from transport.agent.silence.silence_thresholds import SHARED, Silence

PERIOD_S = 0.05
TO_ALONE_S, UNHEARD_S, TO_TEAM_S = 1.0, 0.5, 2.0  # (32d)
RULES = [Silence.of(PERIOD_S, is_filtered=filtered) for filtered in (True, False)]
ROUNDING = 1e-12


def _overdue(ticks: float) -> InformationAge:
    """Return an age that is as usual in the mean, and overdue now."""
    return InformationAge(mean=1.0, overdue=ticks)


@pytest.mark.parametrize("rule", RULES)
def test_usual_ages_change_nothing(rule: Silence) -> None:
    """Until the rule begins no share is alone and the errors of agents are correlated as always."""
    for overdue in range(int(rule.overdue.begins) + 1):
        assert rule.alone(_overdue(overdue)) == 0.0
        assert rule.correlation(_overdue(overdue)) == SHARED


@pytest.mark.parametrize("rule", RULES)
def test_share_grows_and_correlation_falls_with_the_age(rule: Silence) -> None:
    """The share grows steadily to one, the correlation falls to zero."""
    ages = [_overdue(ticks) for ticks in np.arange(0.0, 40.0 * rule.overdue.complete)]
    shares, shared = (list(map(of, ages)) for of in (rule.alone, rule.correlation))
    assert (np.diff(shares) >= 0.0).all()
    assert shares[-1] == 1.0
    assert (np.diff(shared) <= 0.0).all()
    assert shared[-1] < ROUNDING


def test_mean_age_counts_with_a_filter() -> None:
    """Information within 150 ms is that of a team, a second old it is none; with a measured payload, none is late."""
    filtered, measured = RULES
    ages = [
        InformationAge(mean=age_s / PERIOD_S, overdue=0.0)
        for age_s in (0.1, 0.15, 0.3, 0.6, 1.0, 2.0)
    ]
    shares = [filtered.alone(age) for age in ages]
    assert shares[:2] == [0.0, 0.0]
    assert 0.0 < shares[2] < shares[3] < 1.0
    assert shares[4:] == [1.0, 1.0]
    assert [measured.alone(age) for age in ages] == [0.0] * len(ages)


@pytest.mark.parametrize("period_s", [0.05, 0.2, 2.0])
def test_information_of_the_tick_before_is_never_late(period_s: float) -> None:
    """On a perfect network no agent acts alone, however long its period is."""
    rule = Silence.of(period_s, is_filtered=True)
    assert rule.alone(InformationAge(mean=1.0, overdue=0.0)) == 0.0
    assert rule.alone(InformationAge(mean=1.0 + 1.0 / period_s, overdue=0.0)) == 1.0


def test_a_lost_heartbeat_is_no_silence() -> None:
    """Where plans are sent on change, an agent waits for two heartbeats before it counts ages."""
    plain, shared = (
        Silence.of(PERIOD_S, is_filtered=False, heartbeat_s=heartbeat_s)
        for heartbeat_s in (0.0, 1.0)
    )
    assert shared.overdue.begins == pytest.approx(plain.overdue.begins + 2.0 / PERIOD_S)
    assert shared.uninformed == pytest.approx(plain.uninformed + 2.0 / PERIOD_S)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=60), st.integers(1, 8), st.integers(1, 8))
def test_usual_age_is_the_least_recent_one(ages: list[int], window: int, recent: int) -> None:
    """The usual age is the smallest in its window, and the mean one that of the last ticks; 1 before any."""
    information = InformationAges((2,), window, recent)
    for _ in range(2):  # as from the start once the agent starts anew
        assert (information.usual(2), information.mean(2)) == (1, 1.0)
        for count, age in enumerate(ages, start=1):
            information.observe(2, age)
            known = ages[:count]
            assert information.usual(2) == min(known[-window:])
            assert information.mean(2) == sum(known[-recent:]) / len(known[-recent:])
        information.forget(2)


@pytest.mark.parametrize("rule", RULES)
def test_a_silence_for_good_stays_one(rule: Silence) -> None:
    """Ages that grow for ever never become usual: the window is longer than the age at which an agent acts alone."""
    information = InformationAges((2,), rule.window, rule.recent)
    for age in range(1, 5000):
        information.observe(2, age)
    assert rule.alone(_overdue(4999 - information.usual(2))) == 1.0


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=100), st.booleans())
def test_mixture_is_smooth(wanted: list[float], has_heard_all: bool) -> None:
    """The share begins as wanted, stays within 0 and 1 and changes at a limited rate from then on."""
    mixture = Mixture(PERIOD_S)
    before = mixture.advance(wanted[0])
    assert before == wanted[0]
    up = PERIOD_S / (TO_ALONE_S if has_heard_all else UNHEARD_S)
    for share in wanted[1:]:
        after = mixture.advance(share, has_heard_all=has_heard_all)
        assert -ROUNDING <= after <= 1.0 + ROUNDING
        assert -PERIOD_S / TO_TEAM_S - ROUNDING <= after - before <= up + ROUNDING
        before = after


@given(st.floats(0.0, 1.0), st.integers(0, 1000))
def test_mixed_inputs_keep_the_rates(share: float, seed: int) -> None:
    """From the inputs in force on, no input changes by more than its step per period."""
    rng = np.random.default_rng(seed)
    team, alone, before = (10.0 * rng.standard_normal(shape) for shape in ((8, 4), (8, 4), 4))
    step = np.array([1.0, 0.1, 0.1, 0.2])
    inputs = mixed(team, alone, share, before, step)
    changes = np.diff(np.vstack([before, inputs]), axis=0)
    assert (np.abs(changes) <= step + ROUNDING * 100.0).all()
    wide = mixed(team, alone, share, before, np.full(4, 1e9))
    np.testing.assert_allclose(wide, (1.0 - share) * team + share * alone)
