"""The present law of a team whose reference gets a target, and whose agents come and go."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from tests.model.path.test_flatness import unequal
from tests.model.path.test_targets import EIGHT, target
from tests.mpc.law.test_regulation import LQ
from tests.mpc.law.test_tracking_lqr import SETTINGS
from tests.support.systems import changed
from transport.model.arrays import Array
from transport.model.linear.linearisation import Model
from transport.model.path.flat_reference import FlatReference
from transport.model.path.hover_reference import HoverReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.phase import Phase
from transport.model.physics.hover import hover
from transport.mpc.law.present_law import Regulation
from transport.mpc.reference import KEPT, Reference

PERIOD_S = 0.05
SYSTEM = unequal()
AT_REST = hover(SYSTEM)
TARGET_TICK, INSTANTS = 60, 180
TARGET = target(TARGET_TICK * PERIOD_S, [0.5, 0.5, -10.2], duration_s=4.0)
ELSEWHERE = target(TARGET_TICK * PERIOD_S, [-0.5, 0.2, -10.0], duration_s=4.0)
# UAVs without an agent, without motors, cut loose.
Team = tuple[set[int], set[int], set[int]]
WHOLE: Team = (set(), set(), set())
LOST: Team = ({3}, set(), set())
RELEASED: Team = (set(), {3}, {3})
SAME_GAIN = 1e-9


@lru_cache
def flat() -> Reference:
    """Return a figure-eight without its end."""
    return Reference(FlatReference(SYSTEM, AT_REST, EIGHT), PERIOD_S, INSTANTS)


def corners() -> Reference:
    """Return a leg between two rests, longer after its begin than rows before a target are kept."""
    legs = [("rest", 5.5, 0.0), ("go", 3.0, 1.0), ("stay", 0.5, 0.0)]
    phases = [
        Phase(name=name, duration_s=duration_s, displacement_I=[x_m, 0.0, 0.0])
        for name, duration_s, x_m in legs
    ]
    maneuver = Maneuver(start_I=[0.0, 0.0, -10.0], phases=phases)
    return Reference(HoverReference(SYSTEM, AT_REST, maneuver), PERIOD_S, INSTANTS)


@pytest.mark.parametrize("present", [WHOLE, LOST, RELEASED], ids=["whole", "lost", "released"])
def test_after_a_target_the_gains_are_those_along_the_new_reference(present: Team) -> None:
    """Of the present team and of teams that were formed before, as of a controller that begins with it, (71), (75).

    Also where another controller of the process has followed another target.
    """
    model = Model(SYSTEM)
    led = flat().with_target(TARGET).sampled
    other, one = (Regulation(model, AT_REST, SETTINGS, flat().sampled) for _ in range(2))
    for regulation in (other, one):
        for team in (LOST, present):
            regulation.form(*team)
    other.follow(flat().with_target(ELSEWHERE).sampled)
    assert not one.follow(led)

    for formed in (None, WHOLE, LOST):
        if formed is not None:
            one.form(*formed)
        fresh = Regulation(model, AT_REST, SETTINGS, led)
        fresh.form(*(formed or present))
        for k in (TARGET_TICK, TARGET_TICK + 30, INSTANTS - 1):
            np.testing.assert_allclose(one.gain(k), fresh.gain(k), atol=SAME_GAIN)
    assert np.abs(one.gain(TARGET_TICK + 30)).max() > 0.1


def test_a_team_that_forms_again_has_its_gains_at_once() -> None:
    """An agent dies, comes back and dies again: the gains that were computed hold from that instant on."""
    one = Regulation(Model(SYSTEM), AT_REST, SETTINGS, flat().sampled)
    at_once = Regulation(Model(SYSTEM), AT_REST, changed(SETTINGS, horizon=9), flat().sampled)
    at_once.form(*LOST)
    k = 60
    one.form(*LOST, since=k)
    while not one.advance(k):
        k += 1
    assert k > 60
    one.form(*WHOLE)
    one.form(*LOST, since=k + 5)
    np.testing.assert_array_equal(one.gain(k + 5), at_once.gain(k + 5))
    assert not one.advance(k + 6), "nothing is under way"


def test_before_a_target_the_gains_stay_as_they_were() -> None:
    """Those of a team that was another one earlier, also beside an agent that has known only the present one."""
    early, late = (Regulation(Model(SYSTEM), AT_REST, SETTINGS, flat().sampled) for _ in range(2))
    since = TARGET_TICK - 40
    early.form(*LOST)
    late.form(*LOST, since=since)
    k = since
    while not late.advance(k):
        k += 1
    assert k < TARGET_TICK
    instants = (since - 10, TARGET_TICK - 5)
    before = [late.gain(instant) for instant in instants]
    for one in (early, late):
        one.follow(flat().with_target(TARGET).sampled)
    for instant, gain in zip(instants, before, strict=True):
        np.testing.assert_array_equal(late.gain(instant), gain)
    assert (early.gain(since - 10) != late.gain(since - 10)).any()


@pytest.mark.parametrize("team", [WHOLE, LOST], ids=["whole", "lost"])
def test_before_a_target_the_present_team_keeps_its_preview(team: Team) -> None:
    """Feedforward and motion of instants before it are as they were; then those of the new reference, (31f), (36c)."""
    settings = changed(LQ, fail_safe="follow")
    reference = corners()
    tick = KEPT + 22
    led = reference.with_target(replace(TARGET, since_s=tick * PERIOD_S)).sampled
    one = Regulation(Model(SYSTEM), AT_REST, settings, reference.sampled)
    one.form(*team)
    first = tick - 20

    def ahead() -> tuple[Array, Array]:
        """Return the feedforward from the first instant on, and the slope of the cost-to-go then."""
        x_ref = reference.sampled.X[first]
        end = one.current.cost_to_go(x_ref, x_ref, None, first)
        assert end is not None
        return one.current.feedforward(first, 60), end.slope

    def motion_at(instant: int) -> Array:
        """Return the state of the undisturbed motion that UAVs alone follow."""
        motion = one.whole.fail_safe.motion
        assert motion is not None
        return motion.at(instant)[0]

    before, slope_before = ahead()
    moved = [motion_at(instant) for instant in (first, tick, tick + 20)]
    one.follow(led)
    after, slope = ahead()
    np.testing.assert_array_equal(motion_at(first), moved[0])
    np.testing.assert_array_equal(motion_at(tick), moved[1])
    assert (motion_at(tick + 20) != moved[2]).any()
    assert one.current.preview is not None
    assert one.current.preview.first > 0, "all rows are kept"
    np.testing.assert_array_equal(after[:20], before[:20])
    np.testing.assert_array_equal(slope, slope_before)
    assert np.abs(before[:20]).max() > 1e-3
    assert np.abs(after[20:] - before[20:]).max() > 1e-3


def test_a_recursion_under_way_ends_with_a_return_or_a_target() -> None:
    """A return holds at once, for good; a target completes it first: its gains hold before the target, (71), (75)."""
    model = Model(SYSTEM)
    one, fresh = (Regulation(model, AT_REST, SETTINGS, flat().sampled) for _ in range(2))
    since, later = TARGET_TICK - 2, TARGET_TICK + 30
    whole = one.gain(later)
    one.form(*LOST, since=since)
    one.form(*WHOLE)
    assert not one.advance(later)
    np.testing.assert_array_equal(one.gain(later), whole)

    led = flat().with_target(TARGET).sampled
    one.form(*LOST, since=since)
    assert not one.advance(since)
    assert one.follow(led)
    assert not one.advance(later), "nothing is under way"
    fresh.form(*LOST)
    np.testing.assert_array_equal(one.gain(since), fresh.gain(since))
    fresh.follow(led)
    np.testing.assert_allclose(one.gain(later), fresh.gain(later), atol=SAME_GAIN)
