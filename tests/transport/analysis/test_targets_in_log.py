"""The path that analysis takes from a log, by hand-made plans that carry a target of an obstacle seen."""

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.logs import log_of
from transport.analysis.series import series_of
from transport.analysis.targets_in_log import led_as_logged
from transport.protocol.admission.targets_in_plans import number_of_sight
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Plan, Target

PERIOD_S = 0.05
RUN = runs.setup(runs.ticks(200))
REST_I, END_I = np.array([0.0, 0.0, -10.0]), np.array([1.0, 0.0, -10.0])
TOLD, BEGINS = 20, 80  # ticks
APPROACH_S = WAY_S = 2.0
ROUNDING_M = 1e-9
# Copies of the target, as an agent sends them before and after all agents have it.
WAITING = Target(
    sender="agent2",
    incarnation=0,
    sequence=0,
    tick=TOLD,
    number=number_of_sight(2),
    points=np.array([REST_I, END_I]),
    times=np.zeros(2),
    approach_s=APPROACH_S,
    approach_ramp_s=APPROACH_S / 4.0,
    way_s=WAY_S,
    way_ramp_s=WAY_S / 4.0,
    to=(2,),
    informed=(2,),
    got=(TOLD,),
    brakes=True,
)
CONFIRMED = replace(WAITING, informed=(), got=(), begins=BEGINS)


def carrying(k: int, target: Target) -> Plan:
    """Return a plan of agent 2 at tick k that carries a target."""
    return replace(runs.plan(RUN, 2, k), targets=(encode(target),))


def payload_x_m(run: Setup, tick: int) -> float:
    """Return x of the payload's reference at a tick."""
    path_I, _ = run.maneuver.path(np.array([tick * PERIOD_S]))
    return float(path_I[0, 0])


@pytest.mark.parametrize("copies", [[WAITING, CONFIRMED], [CONFIRMED, WAITING]])
def test_the_copy_that_says_when_its_way_begins_counts(copies: list[Target]) -> None:
    """The payload rests until all agents have the target, then moves, whichever copy was seen first."""
    log = log_of([carrying(BEGINS + k, copy) for k, copy in enumerate(copies)])
    led = led_as_logged(RUN, log)
    way = round(WAY_S / PERIOD_S)
    places_m = [payload_x_m(led, BEGINS + after) for after in (0, way // 2, way)]
    assert places_m == pytest.approx([REST_I[0], 0.5, END_I[0]], abs=ROUNDING_M)
    assert led_as_logged(led, log) is led


def test_the_first_of_two_begins_counts() -> None:
    """A later copy with another tick does not move the beginning."""
    later = replace(CONFIRMED, begins=BEGINS + 30)
    led = led_as_logged(RUN, log_of([carrying(150, CONFIRMED), carrying(151, later)]))
    assert payload_x_m(led, BEGINS + round(WAY_S / PERIOD_S)) == pytest.approx(END_I[0])


def test_a_target_that_was_never_confirmed_is_followed_from_its_own_tick() -> None:
    """Braking and way follow each other, as if all agents had heard of it at once."""
    led = led_as_logged(RUN, log_of([carrying(TOLD, WAITING)]))
    rest = TOLD + round(APPROACH_S / PERIOD_S)
    way = round(WAY_S / PERIOD_S)
    places_m = [payload_x_m(led, rest + after) for after in (0, way // 2, way)]
    assert places_m == pytest.approx([REST_I[0], 0.5, END_I[0]], abs=ROUNDING_M)


def test_series_of_a_log_have_the_path_with_its_targets() -> None:
    """The reference of the payload is at the end of the way once it is over."""
    at_end = BEGINS + round(WAY_S / PERIOD_S)
    log = log_of([carrying(BEGINS, CONFIRMED), runs.plant_state(RUN, at_end)])
    assert series_of(RUN, log).payload_reference_I == pytest.approx(END_I[None], abs=ROUNDING_M)


def test_a_log_without_targets_leaves_the_path() -> None:
    """Plans that carry none change nothing."""
    led = led_as_logged(RUN, log_of([runs.plan(RUN, 2, 5)]))
    assert not led.maneuver.targets
