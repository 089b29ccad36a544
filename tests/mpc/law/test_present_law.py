"""The present law of a team whose reference gets a target, and whose agents come and go."""

from functools import lru_cache

import numpy as np
import pytest

from tests.model.path.test_flatness import unequal
from tests.model.path.test_targets import EIGHT, target
from tests.mpc.law.test_regulation import LQ
from tests.mpc.law.test_tracking_lqr import SETTINGS
from tests.support.systems import changed
from transport.model.linear.linearisation import Model
from transport.model.path.flat_reference import FlatReference
from transport.model.path.hover_reference import HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.physics.hover import hover
from transport.mpc.law.present_law import Regulation
from transport.mpc.reference import Reference

PERIOD_S = 0.05
SYSTEM = unequal()
AT_REST = hover(SYSTEM)
TARGET_TICK, INSTANTS = 60, 180
TARGET = target(TARGET_TICK * PERIOD_S, [0.5, 0.5, -10.2], duration_s=4.0)
LOST = {3}
SAME_GAIN = 1e-9


@lru_cache
def flat() -> Reference:
    """Return a figure-eight without its end."""
    return Reference(FlatReference(SYSTEM, AT_REST, EIGHT), PERIOD_S, INSTANTS)


def corners() -> Reference:
    """Return a leg between two rests."""
    legs = [("rest", 1.0, 0.0), ("go", 3.0, 1.0), ("stay", 5.0, 0.0)]
    phases = [
        Phase(name=name, duration_s=duration_s, displacement_I=[x_m, 0.0, 0.0])
        for name, duration_s, x_m in legs
    ]
    maneuver = Maneuver(start_I=[0.0, 0.0, -10.0], phases=phases)
    return Reference(HoverReference(SYSTEM, AT_REST, maneuver), PERIOD_S, INSTANTS)


@pytest.mark.parametrize("gone", [set(), LOST], ids=["whole", "lost"])
def test_after_a_target_the_gains_are_those_along_the_new_reference(gone: set[int]) -> None:
    """Of the present team and of teams that were formed before, as of a controller that begins with it, (71), (75)."""
    model = Model(SYSTEM)
    led = flat().with_target(TARGET).sampled
    one = Regulation(model, AT_REST, SETTINGS, flat().sampled)
    for team in (LOST, gone):
        one.form(team, (), ())
    assert not one.follow(led)

    for team in (gone, set(), LOST):
        one.form(team, (), ())
        fresh = Regulation(model, AT_REST, SETTINGS, led)
        fresh.form(team, (), ())
        for k in (TARGET_TICK, TARGET_TICK + 30, INSTANTS - 1):
            np.testing.assert_allclose(one.gain(k), fresh.gain(k), atol=SAME_GAIN)
    assert np.abs(one.gain(TARGET_TICK + 30)).max() > 0.1


def test_a_team_that_forms_again_has_its_gains_at_once() -> None:
    """An agent dies, comes back and dies again: the gains that were computed hold from that instant on."""
    one = Regulation(Model(SYSTEM), AT_REST, SETTINGS, flat().sampled)
    at_once = Regulation(Model(SYSTEM), AT_REST, changed(SETTINGS, horizon=9), flat().sampled)
    at_once.form(LOST, (), ())
    k = 60
    one.form(LOST, (), (), since=k)
    while not one.advance(k):
        k += 1
    assert k > 60
    one.form((), (), ())
    one.form(LOST, (), (), since=k + 5)
    np.testing.assert_array_equal(one.gain(k + 5), at_once.gain(k + 5))
    assert not one.advance(k + 6), "nothing is under way"


@pytest.mark.parametrize("gone", [set(), LOST], ids=["whole", "lost"])
def test_before_a_target_the_present_team_keeps_its_preview(gone: set[int]) -> None:
    """Feedforward of instants before it is as it was; from it on that of the new reference, (36c)."""
    settings = changed(LQ, fail_safe="follow")
    reference = corners()
    led = reference.with_target(TARGET).sampled
    one = Regulation(Model(SYSTEM), AT_REST, settings, reference.sampled)
    one.form(gone, (), ())
    first = TARGET_TICK - 20
    before = one.current.feedforward(first, 60)
    one.follow(led)
    after = one.current.feedforward(first, 60)
    np.testing.assert_array_equal(after[:20], before[:20])
    assert np.abs(before[:20]).max() > 1e-3
    assert np.abs(after[20:] - before[20:]).max() > 1e-3
