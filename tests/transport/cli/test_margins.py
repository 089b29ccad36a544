"""Margins by linear analysis against runs that excite the modes (docs/record/guarantees.md)."""

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

import transport
from transport.cli.main import app
from transport.protocol.wire.errors_and_exit_codes import EXIT_SCENARIO, EXIT_USAGE

# Gusts and a diagonal leg: the symmetric maneuver of the paper hardly excites the modes that
# diverge first.
BEGIN = (
    {"name": "hover", "duration_s": 2.0, "displacement_m": [0.0, 0.0, 0.0]},
    {"name": "diagonal", "duration_s": 5.0, "displacement_m": [2.0, 1.5, -1.5]},
)

# Inner loops at 1 kHz tolerate more lag of the motors than moments at 20 Hz.
LAG_WITH_RATES_S = 0.08


@pytest.mark.slow
@pytest.mark.parametrize(
    ("actuation", "inputs", "beyond", "hover_s"),
    [("immediate", "moments", 1.1, 29.0), ("next_tick", "rates", 1.2, 15.0)],
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
    margin_s = transport.margins(scenario).data["margins"][actuation]["lag_s"]["upper"]
    assert inputs == "moments" or margin_s > LAG_WITH_RATES_S
    for factor, outcome in ((0.9, "completed"), (beyond, "diverged")):
        settings = {
            "controller.inputs": inputs, "clock.actuation": actuation, "plant.motors.lag_s": factor * margin_s,
            "plant.wind.gust_mps": [0.2] * 3,
        }  # fmt: skip
        assert (
            transport.fly("resilient", settings, phases=phases, progress=False).outcome == outcome
        )


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
    assert transport.margins("resilient", without=[1, 2]).data["settling_s"]["next_tick"] < 10.0
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
