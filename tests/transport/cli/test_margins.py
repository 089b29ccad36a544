"""Margins by linear analysis against runs that excite the modes (docs/record/guarantees.md)."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

import transport
from transport.cli.main import app
from transport.flight.memory import simulate
from transport.mpc.margins.actual_plant import Mismatch
from transport.mpc.margins.sampled_loop import margins
from transport.protocol.wire.errors_and_exit_codes import EXIT_SCENARIO, EXIT_USAGE
from transport.report.laws import team_loops

# Gusts and a diagonal leg: the symmetric maneuver of the paper hardly excites the modes that
# diverge first.
BEGIN = (
    {"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "diagonal", "duration_s": 3.0, "displacement_m": [2.0, 1.5, -1.5]},
)
GUSTS_MPS = 3.0

# Inner loops at 1 kHz tolerate more lag of the motors than moments at 20 Hz.
LAG_WITH_RATES_S = 0.08


@pytest.mark.slow
@pytest.mark.parametrize(
    ("actuation", "inputs", "beyond", "hover_s"),
    [("immediate", "moments", 1.1, 20.0), ("next_tick", "rates", 1.2, 9.0)],
)
def test_runs_diverge_where_the_analysis_says(
    actuation: str, inputs: str, beyond: float, hover_s: float
) -> None:
    """An unknown lag of 0.9 times the margin completes, one of 1.1 times diverges.

    With body rates it is 80 ms.

    Further beyond the margin a run diverges sooner.
    """
    phases = [*BEGIN, {"name": "hover", "duration_s": hover_s, "displacement_m": [0.0, 0.0, 0.0]}]
    scenario = transport.Scenario("resilient", {"controller.inputs": inputs})
    margin_s = margins(team_loops(scenario.setup, ())[actuation], ["lag_s"])["lag_s"].upper
    assert margin_s is not None
    assert inputs == "moments" or margin_s > LAG_WITH_RATES_S
    for factor, outcome in ((0.9, "completed"), (beyond, "diverged")):
        settings = {
            "controller.inputs": inputs, "clock.actuation": actuation, "plant.motors.lag_s": factor * margin_s,
            "plant.wind.gust_mps": [GUSTS_MPS] * 3, "maneuver.phase": phases,
        }  # fmt: skip
        run = transport.Scenario("resilient", settings).setup
        assert simulate(run, lambda _message: None).outcome == outcome


def test_the_command_prints_ranges_and_draws_them(tmp_path: Path) -> None:
    """A row for each property, and a figure."""
    figure = tmp_path / "margins.png"
    printed = CliRunner().invoke(
        app, ["margins", "centralized_lq", "--format", "json", "--figure", str(figure)]
    )
    assert printed.exit_code == 0
    found = json.loads(printed.stdout)["margins"]
    assert found["next_tick"]["lag_s"]["upper"] < found["immediate"]["lag_s"]["upper"]
    assert figure.stat().st_size > 0


@pytest.mark.slow
def test_a_team_without_two_agents() -> None:
    """It holds the payload if the fail-safe follows.

    UAVs that keep level swing undamped, and the command says so.
    """
    loop = team_loops(transport.Scenario("resilient").setup, (1, 2))["next_tick"]
    settling_s = loop.settling_s(Mismatch(lag_s=loop.known_lag_s))
    assert settling_s is not None
    assert settling_s < 10.0
    level = ["margins", "resilient", "--without", "1,2", "--set", "controller.fail_safe=level"]
    assert re.search(r"deviations decay in +never", CliRunner().invoke(app, level).output)


@pytest.mark.parametrize(
    ("scenario", "gone", "code", "reason"),
    [
        ("resilient", "1,5", EXIT_SCENARIO, "some of"),
        ("paper", "1", EXIT_SCENARIO, "closed_loop"),
        ("paper", "x", EXIT_USAGE, "1,2"),
    ],
)
def test_agents_that_cannot_be_gone(scenario: str, gone: str, code: int, reason: str) -> None:
    """They are refused before the analysis."""
    refused = CliRunner().invoke(app, ["margins", scenario, "--without", gone])
    assert refused.exit_code == code
    assert reason in refused.output
