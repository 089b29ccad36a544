"""Failure of a whole UAV in flight.

Cases the remaining team survives, cases it does not, and the record.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pytest

from tests.support.logs import log_of
from tests.support.runs import SCENARIOS
from transport.analysis.series import Series, series_of
from transport.flight.memory import simulate
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, resized
from transport.protocol.wire.messages import Control, Message, Roster, StepReport

# The paper's maneuver at its speeds, shortened: the fault is in the climb, before a corner.
MANEUVER = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=1.0,displacement_m=[0,0,-0.5]},"
    "{name='translate',duration_s=1.0,displacement_m=[0.5,0,0]},"
    "{name='hover',duration_s=1.0,displacement_m=[0,0,0]}]"
)
# No corner after the failure.
CLIMB = (
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='climb',duration_s=2.2,displacement_m=[0,0,-1.1]}]"
)
LONGER = "maneuver.phase.4.duration_s=3.5"
AT_S = 1.0
LATE = ("links.delay_s=0.2", "links.loss=0.3")


@dataclass(frozen=True)
class Flight:
    """An in-memory run."""

    control: Control
    series: Series
    messages: tuple[Message, ...]

    @property
    def attitude_deg(self) -> float:
        """Return the largest roll or pitch of the payload, deg."""
        return float(np.abs(self.series.attitude_deg[:, :2]).max())

    @property
    def payload_error_m(self) -> Array:
        """Return the distance of the payload from its reference, (T,), m."""
        return np.asarray(np.linalg.norm(self.series.payload_error_I, axis=1))


def failures(*events: tuple[float, str]) -> str:
    """Return the setting of the failures of UAV 3, with times after `AT_S`."""
    listed = ",".join(
        f"{{at_s={AT_S + after_s},do='{do}',target='uav3'}}" for after_s, do in events
    )
    return f"faults.event=[{listed}]"


RELEASED, OFF = failures((0.0, "release")), failures((0.0, "motor_off"))


@lru_cache
def flown(uavs: int, template: str, *changes: str) -> Flight:
    """Simulate the short maneuver with a team of some size and the settings of a ready scenario."""
    # Names of UAVs and agents refer to the larger team, so these settings apply after it is
    # resized.
    ready = read_scenario(SCENARIOS / f"{template}.toml", [MANEUVER, *changes])
    if uavs != len(ready.system.uav):
        ready = resized(ready, Team(uavs=uavs), template)
    run = Setup.of(ready, template)
    messages: list[Message] = []
    control = simulate(run, messages.append)
    return Flight(control, series_of(run, log_of(messages)), tuple(messages))


@pytest.mark.parametrize("template", ["resilient", "precise", "centralized_lq", "centralized"])
def test_four_fly_on_without_the_released_one(template: str) -> None:
    """With UAV 3 released at once, the other three complete the maneuver with the payload level."""
    flight = flown(4, template, RELEASED)
    assert flight.control.outcome == "completed"
    assert flight.attitude_deg < 1.0  # measured: 0.3 to 0.4
    assert {report.status for report in flight.messages if isinstance(report, StepReport)} == {
        "solved"
    }


@pytest.mark.parametrize(
    "changes", [LATE, ("clock.actuation=next_tick",), ("agents.owned=[[1,2],[3,4]]",)]
)
def test_on_a_bad_network_too(changes: Sequence[str]) -> None:
    """Three UAVs also complete with 200 ms delay and 30 % loss, next-tick actuation, or two UAVs per agent."""
    flight = flown(4, "resilient", RELEASED, *changes)
    assert flight.control.outcome == "completed"
    assert flight.attitude_deg < 3.0  # measured: 0.4 to 1.7


def test_its_agent_may_die_with_it() -> None:
    """The agent of a released UAV has no influence.

    Its death at the same tick has no further effect.
    """
    both = f"{RELEASED[:-1]},{{at_s={AT_S},do='kill',target='agent3'}}]"
    flight = flown(4, "resilient", both, "clock.on_agent_loss=continue")
    assert flight.control.outcome == "completed"
    assert flight.attitude_deg < 1.0


def test_four_do_not_fly_with_the_dead_one_on_its_rod() -> None:
    """The failed UAV falls over on its rod, and the other three cannot control it.

    Docs/record/guarantees.md.
    """
    flight = flown(4, "resilient", OFF, LONGER)
    assert flight.control.outcome == "diverged"
    assert 1.0 < flight.series.times_s[-1] - AT_S < 5.0  # measured: 1.8


@pytest.mark.parametrize(("after_s", "limit_deg"), [(0.05, 4.0), (0.25, 12.0)])
def test_a_late_release_of_the_dead_one(after_s: float, limit_deg: float) -> None:
    """The team survives some periods with the failed UAV on its rod.

    Measured tilts are 2.3 and 8.8 deg.
    """
    flight = flown(4, "resilient", failures((0.0, "motor_off"), (after_s, "release")))
    assert flight.control.outcome == "completed"
    assert 1.0 < flight.attitude_deg < limit_deg


def test_five_balance_the_dead_one() -> None:
    """With one UAV more the failed one stays upright on its rod, balanced by the motion of the payload below."""
    flight = flown(5, "resilient", OFF, CLIMB)
    assert flight.control.outcome == "completed"
    assert flight.attitude_deg < 4.0  # measured: 2.5
    # Above the payload: z is down.
    assert flight.series.uavs_I[-1, 2, 2] < flight.series.x[-1, 2] - 3.0


def test_six_balance_it_shortly_before_a_corner() -> None:
    """With a corner of the path 0.5 s after the failure, while the payload still tilts, it stays upright, too."""
    assert flown(6, "resilient", OFF).control.outcome == "completed"


def test_the_cost_is_that_of_the_team_that_is_left() -> None:
    """The released UAV, 6.4 m below its reference, has no part in cost or separation, nor have its hover inputs."""
    flight = flown(4, "precise", RELEASED)
    assert flight.series.cost[-1] < 1e-3
    assert 0.4 < flight.series.separation_m.min() < 0.5
    assert flight.series.violation.max() < 0.01
    assert flight.payload_error_m[-1] < 0.03


def test_no_controller_anticipates_the_fault() -> None:
    """Until the tick of the fault every message equals that of a run without the fault."""
    at = round(AT_S / 0.05)

    def said(flight: Flight) -> list[tuple[str, int, int]]:
        return [(m.kind, m.sequence, m.tick) for m in flight.messages if m.tick < at]

    with_fault, without = flown(4, "resilient", RELEASED), flown(4, "resilient")
    assert said(with_fault) == said(without)
    np.testing.assert_array_equal(with_fault.series.x[:at], without.series.x[:at])
    np.testing.assert_array_equal(with_fault.series.u[:at], without.series.u[:at])
    rosters = [m for m in with_fault.messages if isinstance(m, Roster)]
    assert [(r.tick, r.off, r.released, r.reason) for r in rosters] == [
        (0, (), (), "all processes are ready"),
        (at, (3,), (3,), "uav3 released at t = 1.00 s"),
    ]
