"""Membership: who is believed, by the rosters received, and plans that overtake their roster."""

from protocol.membership import Membership
from protocol.messages import Plan
from tests.runs import INCARNATION, plan, roster, setup

NOT_ON_IT = "plan of an incarnation that is not on the roster"


def sent(agent: int, incarnation: int = INCARNATION, k: int = 0) -> Plan:
    """A plan of some incarnation of an agent."""
    return plan(setup(), agent, k, incarnation=incarnation)


def test_nobody_at_first() -> None:
    """Before the first roster nobody takes part, and every plan is kept for it."""
    membership = Membership()
    assert membership.version == 0
    assert membership.agents == set()
    assert membership.refusal(sent(1)) is None


def test_rosters_count_in_order_of_version() -> None:
    """A roster takes effect unless a newer one has; the same again or an older one changes nothing."""
    membership = Membership()
    membership.update(roster({1: 1, 2: 1}, version=2))
    membership.update(roster({1: 1, 2: 1, 3: 1}, version=1))
    membership.update(roster({1: 1}, version=2))
    assert membership.version == 2
    assert membership.agents == {1, 2}
    membership.update(roster({2: 1}, version=5))
    assert (membership.version, membership.agents) == (5, {2})


def test_who_is_believed() -> None:
    """The roster's incarnation is believed, an earlier one or one that left is refused, a later one kept."""
    membership = Membership()
    membership.update(roster({1: 1, 2: 3}))
    assert membership.refusal(sent(2, 3)) == ""
    assert membership.refusal(sent(2, 2)) == NOT_ON_IT
    assert membership.refusal(sent(2, 4)) is None
    membership.update(roster({1: 1}, version=2))
    assert membership.refusal(sent(2, 3)) == NOT_ON_IT
    assert membership.refusal(sent(2, 4)) is None
    membership.update(roster({1: 1, 2: 4}, version=3))
    assert membership.refusal(sent(2, 4)) == ""
    assert membership.refusal(sent(2, 3)) == NOT_ON_IT


def test_early_plans_come_back_once_in_order() -> None:
    """What was ahead of a roster comes back with it, once, in the order received."""
    membership = Membership()
    early = [sent(2), sent(1), sent(2, k=1), sent(3)]
    assert [membership.refusal(message) for message in early] == [None] * 4
    assert membership.update(roster()) == early
    assert [membership.refusal(message) for message in early] == [""] * 4
    assert membership.update(roster(version=2)) == []


def test_an_old_roster_releases_nothing() -> None:
    """Plans ahead of a roster still wait after one that changes nothing."""
    membership = Membership()
    membership.update(roster())
    assert membership.refusal(sent(1, 2)) is None
    assert membership.update(roster()) == []
    assert len(membership.update(roster({1: 2}, version=2))) == 1


def test_what_is_kept_is_bounded() -> None:
    """Somebody who keeps talking without ever being admitted is refused from some plan on, in words."""
    membership = Membership()
    answers = [membership.refusal(sent(1)) for _ in range(5000)]
    kept = answers.count(None)
    assert 100 < kept < 5000
    assert set(answers[kept:]) == {"plan of an incarnation that no roster has admitted"}
    assert len(membership.update(roster())) == kept
