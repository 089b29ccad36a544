"""Membership: plans admitted by the rosters received, and plans that overtake their roster."""

import pytest

from tests.support.runs import INCARNATION, plan, roster, setup
from transport.protocol.admission.membership import Membership
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import Plan


def sent(agent: int, incarnation: int = INCARNATION, k: int = 0) -> Plan:
    """A plan of some incarnation of an agent."""
    return plan(setup(), agent, k, incarnation=incarnation)


def is_refused(membership: Membership, message: Plan) -> bool:
    """Whether a plan is refused rather than kept."""
    with pytest.raises(MessageError) as caught:
        membership.check(message)
    return caught.value.reason == "wrong_incarnation"


def test_admitted_incarnations() -> None:
    """Plans of the roster's incarnation are admitted, earlier ones and those that left refused, later ones kept."""
    membership = Membership()
    membership.update(roster({1: 1, 2: 3}))
    assert membership.admit_or_keep(sent(2, 3))
    assert is_refused(membership, sent(2, 2))
    assert not membership.admit_or_keep(sent(2, 4))
    membership.update(roster({1: 1}, version=2))
    assert is_refused(membership, sent(2, 3))
    assert not membership.admit_or_keep(sent(2, 4))
    membership.update(roster({1: 1, 2: 4}, version=3))
    assert membership.admit_or_keep(sent(2, 4))
    assert is_refused(membership, sent(2, 3))


def test_plans_sent_before_leaving_count() -> None:
    """Plans of ticks before the one an agent left at are admitted after that roster, later ones are refused."""
    membership = Membership()
    membership.update(roster({1: 1, 2: 1}))
    membership.update(roster({1: 1}, k=5, version=2))
    assert membership.admit_or_keep(sent(2, k=4))
    assert is_refused(membership, sent(2, k=5))
    assert is_refused(membership, sent(2, 0, k=4))
    membership.update(roster({1: 1, 2: 2}, k=8, version=3))
    assert membership.admit_or_keep(sent(2, k=4))
    assert is_refused(membership, sent(2, k=7))
    assert membership.admit_or_keep(sent(2, 2, k=8))
