"""Runs in which agents command body rates."""

import numpy as np
import pytest

import transport
from transport.analysis.steps import steps_columns
from transport.log.tables import RATE_NAMES, tables

RATES = {"controller.inputs": "rates"}
CLIMB = [{"name": "climb", "duration_s": 1.5, "displacement_m": [0.2, 0.0, -0.2]}]
LEG = [
    {"name": "leg", "duration_s": 3.0, "displacement_m": [0.75, 0.6, -0.75]},
    {"name": "hover", "duration_s": 2.0, "displacement_m": [0.0, 0.0, 0.0]},
]
DEATH = {
    "faults.event": [{"at_s": 1.5, "do": "kill", "target": "agent3"}],
    "clock.on_agent_loss": "continue",
}
RELEASE = {"faults.event": [{"at_s": 1.5, "do": "release", "target": "uav3"}]}
IMPAIRED = {"links.delay_s": 0.2, "links.loss": 0.3}


def test_commands_and_moments_are_named() -> None:
    """Series, tables and step table name commanded rates; the moments are those of the inner loops."""
    run = transport.fly("resilient", RATES, phases=CLIMB, progress=False)
    setup, commands = run.scenario.setup, run.series["rate_command_radps"]
    assert run.outcome == "completed"
    assert 0.0 < np.abs(commands).max() <= max(setup.settings.limits.rates_rads)
    moments = run.series["moment_Nm"]
    assert 0.0 < np.abs(moments).max() < setup.settings.limits.moments_Nm[0]
    assert "rate1_x_rad_s" in steps_columns(setup)
    assert "moment1_x_Nm" not in steps_columns(setup)
    plan = tables(run.log, setup.settings.sampling_period_s, RATE_NAMES)["plan"][0]
    assert "rate_x_rad_s[0]" in plan


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "settings"),
    [
        ("resilient", {**DEATH, **IMPAIRED}),
        ("resilient", RELEASE),
        ("resilient", {"plant.engine": "mujoco", "maneuver.phase": CLIMB}),
        ("windy", {"plant.motors.lag_s": 0.06, "controller.motor_lag_s": 0.06}),
    ],
    ids=["death", "release", "mujoco", "windy with a known lag"],
)
def test_runs_complete(scenario: str, settings: dict[str, object]) -> None:
    """Whatever completes with moments completes with body rates."""
    assert (
        transport.fly(
            scenario, {**RATES, "maneuver.phase": LEG, **settings}, progress=False
        ).outcome
        == "completed"
    )
