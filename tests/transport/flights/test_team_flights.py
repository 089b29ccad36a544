"""Teams of other sizes, made by `transport scenario new`, complete the paper's maneuver like the team of four."""

import numpy as np
import pytest

from tests.support.logs import log_of
from tests.support.runs import SCENARIOS, completed
from transport.analysis.series import series_of
from transport.flight.memory import simulate
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, resized
from transport.protocol.wire.messages import StepReport

# Half the ways of the paper's maneuver, at its speeds.
WAYS = (
    ("hover", 1.0, 0, 0),
    ("climb", 2.5, 0, -1.25),
    ("translate", 2.5, 1.25, 0),
    ("descend", 2.5, 0, 1.25),
)
HALF = "maneuver.phase=[{}]".format(
    ",".join(
        f"{{name='{name}',duration_s={duration_s},displacement_m=[{x},0,{z}]}}"
        for name, duration_s, x, z in (*WAYS, ("hover", 2.5, 0, 0))
    )
)


def team(uavs: int, template: str, *settings: str) -> Setup:
    """A team that flies as a ready scenario does, with some of its settings changed."""
    ready = read_scenario(SCENARIOS / f"{template}.toml", settings)
    return Setup.of(resized(ready, Team(uavs=uavs), template), template)


@pytest.mark.slow
def test_eight_complete_the_maneuver() -> None:
    """Section V at its speeds with eight UAVs, level and apart, with plans 0.1 s late."""
    run = team(8, "resilient", HALF, "links.delay_s=0.1")
    messages = completed(run)
    series = series_of(run, log_of(messages))
    assert len(series.ticks) == run.ticks == 220
    reports = [message for message in messages if isinstance(message, StepReport)]
    assert {report.status for report in reports} == {"solved"}
    assert max(report.plan_ages[0] for report in reports) == 2
    # The four are held to 2.5 deg and 0.4 m (test_processes.py); measured here: at most 0.4 deg,
    # and 0.499 m.
    assert series.attitude_max_deg.max() < 1.0
    assert series.separation_m.min() > 0.45
    # The cost is a sum over the UAVs: for each it stays that of one of the four of `resilient` on
    # this path, 0.00148.
    assert series.cost.mean() / 8 < 1.6e-3
    assert np.linalg.norm(series.payload_error_I, axis=1).max() < 0.7


@pytest.mark.slow
def test_the_papers_settings_do_not_carry_over() -> None:
    """Why teams are made from `resilient`.

    Eight agents that each correct the whole error lose the load.
    """
    control = simulate(team(8, "paper"))
    assert control.outcome == "diverged"
