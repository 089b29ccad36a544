"""Samples of a reference after a target, (75)."""

from dataclasses import replace

import numpy as np
import pytest

from tests.model.path.test_flatness import ROUNDING, unequal
from tests.model.path.test_targets import EIGHT, RAMPS, target
from transport.agent.estimation.repeated_ticks import WINDOW
from transport.model.arrays import Array
from transport.model.path.flat_reference import FlatReference
from transport.model.path.maneuver import Maneuver
from transport.model.path.target_and_stop import Slowing
from transport.model.physics.hover import hover
from transport.mpc.reference import KEPT, HoverReference, Reference

PERIOD_S = 0.05
TARGET_TICK = 160
INSTANTS = 260
SYSTEM = unequal()
# Ends between two instants.
TARGET = target(TARGET_TICK * PERIOD_S, [1.0, 2.0, -11.0], duration_s=3.02)


def test_track_keeps_the_rows_that_estimators_repeat() -> None:
    """Rows before a target stay bit for bit, for as many ticks as late messages can correct."""
    path = FlatReference(SYSTEM, hover(SYSTEM), EIGHT)
    reference = Reference(path, PERIOD_S, INSTANTS)
    before, after = reference.sampled.track, reference.with_target(TARGET).sampled.track
    assert before is not None
    assert after is not None
    assert KEPT > WINDOW, "a law at the oldest tick needs rows before the target"

    since = TARGET_TICK - WINDOW
    assert after.first <= since
    rows = slice(since - after.first, TARGET_TICK - after.first)
    for old, new in ((before.X, after.X), (before.U, after.U), (before.paths, after.paths)):
        np.testing.assert_array_equal(new[rows], old[since:TARGET_TICK])


def test_samples_after_a_target_are_those_of_the_whole_path() -> None:
    """Samples end where the team rests at the target: the last one, held, equals all later ones."""
    path = FlatReference(SYSTEM, hover(SYSTEM), EIGHT)
    led = Reference(path, PERIOD_S, INSTANTS).with_target(TARGET)
    Y, X = path.with_maneuver(EIGHT.with_target(TARGET)).followed(led.times_s)

    def close(samples: Array, expected: Array) -> None:
        np.testing.assert_allclose(samples, expected, atol=ROUNDING)

    close(led.sampled.X, X)
    close(led.sampled.Y, Y)
    track = led.sampled.track
    assert track is not None
    assert replace(track, first=track.first + 1).key != track.key
    last = track.first + len(track.X)
    assert last < INSTANTS, "no instant is held"
    close(track.X, X[track.first : last])
    close(np.repeat(track.X[-1:], INSTANTS - last, axis=0), X[last:])


@pytest.mark.parametrize("tick", [43, TARGET_TICK])
def test_a_target_changes_the_reference_from_its_tick_on(tick: int) -> None:
    """The change begins at the tick of the target: 43 * 0.05 / 0.05 is rounded to less than 43."""
    given = target(tick * PERIOD_S, [1.0, 2.0, -11.0], duration_s=3.02)
    reference = Reference(FlatReference(SYSTEM, hover(SYSTEM), EIGHT), PERIOD_S, INSTANTS)
    change = reference.with_target(given).sampled.change
    assert change is not None
    assert change.track is not None
    assert (change.first, change.track.first) == (tick, tick)


RAMPS_PRESSED = replace(RAMPS, start_I=np.array([0.0, 0.0, -3.0]), press_m=0.2)
LOSSES = [Slowing(since_s=since_s, lost_s=0.6, ramp_s=1.0) for since_s in (1.0, 4.0)]
DOWN = replace(target(4.0, [0.0, 0.0, -0.125]), lands=True)


def ramps(maneuver: Maneuver = RAMPS_PRESSED) -> Reference:
    """Return a reference by hover of a climb, 13 s long."""
    return Reference(HoverReference(SYSTEM, hover(SYSTEM), maneuver), PERIOD_S, INSTANTS)


@pytest.mark.parametrize("is_loss", [False, True], ids=["landing", "second loss of time"])
def test_each_change_has_the_rest_of_the_way(*, is_loss: bool) -> None:
    """A landing until the ground has the payload, a loss to the end of the run; rows before stay as they were."""
    before = ramps().with_slowing(LOSSES[0]) if is_loss else ramps()
    after = before.with_slowing(LOSSES[1]) if is_loss else before.with_target(DOWN)
    path = HoverReference(SYSTEM, hover(SYSTEM), after.maneuver)
    Y, X = path.followed(after.times_s)
    np.testing.assert_allclose(after.sampled.X, X, atol=ROUNDING)
    np.testing.assert_allclose(after.sampled.Y, Y, atol=ROUNDING)
    assert np.abs(X[-1] - path.states(after.times_s)[-1]).max() == (0.0 if is_loss else 0.2)

    change = after.sampled.change
    assert change is not None
    assert change.first == 80
    np.testing.assert_array_equal(after.sampled.X[:80], before.sampled.X[:80])
    assert (after.sampled.X[120] != before.sampled.X[120]).any()


def test_a_clock_ahead_is_earlier_on_the_way() -> None:
    """The outputs at a time are those of the time that the clock shows."""
    t_s = np.linspace(0.0, 12.0, 25)
    np.testing.assert_array_equal(ramps().by_clock(0.4).outputs(t_s), ramps().outputs(t_s + 0.4))


def test_results_are_shared_by_what_they_follow_from() -> None:
    """Nodes with one change of one reference share it; another reference, change or instant is told apart."""
    longer = ramps(RAMPS_PRESSED.with_longer(2, 1.5))
    for loss in LOSSES:
        assert ramps().with_slowing(loss) is ramps().with_slowing(loss)
        assert ramps().with_slowing(loss) is not longer.with_slowing(loss)
    for given in (DOWN, TARGET):
        assert ramps().with_target(given) is ramps().with_target(given)
        assert ramps().with_target(given) is not longer.with_target(given)
    assert ramps().with_slowing(LOSSES[0]) is not ramps().with_slowing(LOSSES[1])

    flat = Reference(FlatReference(SYSTEM, hover(SYSTEM), EIGHT), PERIOD_S, INSTANTS)
    samples = flat.with_target(TARGET).sampled
    assert samples.track is not None
    assert samples.change is not None
    later = replace(samples.change, first=samples.change.first + 1)
    moved = replace(samples.track, first=samples.track.first + 1)
    turned = replace(samples.track, U=samples.track.U + 1.0)
    heavier = replace(SYSTEM, payload=replace(SYSTEM.payload, mass=9.0))
    at_rest = hover(SYSTEM)
    paths = [
        FlatReference(SYSTEM, at_rest, EIGHT),
        FlatReference(SYSTEM, at_rest, EIGHT.with_target(TARGET)),
        FlatReference(heavier, at_rest, EIGHT),
        FlatReference(SYSTEM, hover(heavier), EIGHT),
    ]
    keys = [
        *(path.key for path in paths),
        samples.key,
        flat.sampled.key,
        replace(samples, X=samples.X + 1.0).key,
        replace(samples, change=later).key,
        replace(samples, track=moved).key,
        replace(samples, track=turned).key,
        replace(samples, track=None).key,
    ]
    assert len(set(keys)) == len(keys)
