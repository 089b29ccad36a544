"""Samples of a reference after a target, (75)."""

from dataclasses import replace

import numpy as np
import pytest

from tests.model.path.test_flatness import ROUNDING, unequal
from tests.model.path.test_targets import EIGHT, target
from transport.agent.estimation.repeated_ticks import WINDOW
from transport.model.arrays import Array
from transport.model.path.flat_reference import FlatReference
from transport.model.physics.hover import hover
from transport.mpc.reference import KEPT, Reference

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
