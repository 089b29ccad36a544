"""Memory, disk and processor time of a run, estimated from sizes.

Bytes and seconds per size were fitted to runs.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from transport.model.state import INPUTS, PAYLOAD, PER_UAV
from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.scenario.schema import Scenario

MB = 1e6

# Limits without --allow-large.
MOST_PLANT_STEPS = 10_000
MOST_TOTAL_BYTES = 8_000 * MB
MOST_STEP_S = 1.25  # while many constraints are active, as in the first step, a large QP takes several times as long

ADMITTED = "--allow-large admits more"

_FLOAT = 8  # bytes
# Interpreter and packages, and the functions of a model per UAV; bytes of the log over bytes of its
# messages; bytes in the memory of the report per tick and agent: Python objects of plans and step
# reports.
_BASE_BYTES, _MODEL_BYTES, _COMPRESSED, _REPORTED_BYTES = 60 * MB, 1 * MB, 0.65, 4_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Estimate of what a run takes."""

    ticks: int  # sampling periods
    plant_steps: int  # integration steps per sampling period before any is halved
    variables: int  # of the largest agent's QP
    rows: int  # of that QP, without the user's constraints on inputs
    total_bytes: float  # memory of all processes, the report after the run among them
    worker_bytes: float  # memory of one process that simulates the whole run, as in a sweep
    log_bytes: float  # size of run.mcap
    step_s: (
        float  # processor time of one step of the largest agent while few constraints are active
    )

    def text(self) -> str:
        """Return the estimate in one line."""
        return (
            f"{self.ticks} ticks, {self.plant_steps} integration steps per period, "
            f"QP of {self.variables} variables and {self.rows} rows, {self.total_bytes / MB:.0f} MB of memory, "
            f"log of {self.log_bytes / MB:.3g} MB, {1e3 * self.step_s:.2g} ms of processor time per step"
        )


def estimate(scenario: Scenario) -> Budget:
    """Return the budget of a run, from sizes alone: nothing is built."""
    controller, plant, N, M = (
        scenario.controller,
        scenario.plant,
        len(scenario.system.uav),
        len(scenario.owned),
    )
    horizon, own, ticks = controller.horizon, max(map(len, scenario.owned)), ticks_of(scenario)
    n, outputs = PAYLOAD + PER_UAV * N, INPUTS * N + 9
    states = n + (
        INPUTS * N if controller.motor_lag_s else 0
    )  # with motor lag the actual inputs are states

    user, pairs = len(controller.constraint), N * (N - 1) // 2 - (N - own) * (N - own - 1) // 2
    # The QP, as `mpc.constraints` make it: rows per step that a slack softens; the user's have at
    # most one each.
    softened = [
        pairs * bool(controller.separation),
        4 * own * bool(controller.tilt),
        own * bool(controller.tension),
    ]
    variables = INPUTS * own * horizon + sum(map(bool, softened)) + user
    rows = INPUTS * own * (horizon - 1) + horizon * (sum(softened) + user)

    # Messages of a tick: arrays, and what is beside them; plant state and, in some runs, actual
    # inputs.
    plan = (
        _FLOAT * own * (INPUTS * horizon * (1 + (controller.prediction == "closed_loop")) + PER_UAV)
        + 100.0
    )
    measurement = _FLOAT * (PAYLOAD + (PER_UAV + INPUTS) * own)
    of_agent = plan * controller.negotiation_iterations + measurement + 320.0 + 13.0 * M
    tick_bytes = M * of_agent + _FLOAT * (n + 2.0 * INPUTS * N) + 120.0

    # Reference, with intermediate results; the preview and its recursion.
    path_bytes = (
        _FLOAT
        * (ticks + horizon + 2)
        * (3.5 * outputs + (7.0 * states if controller.preview else 0.0))
    )
    # Rows and their template; Hessian, its factor and copies; regulator and linear model.
    matrix_bytes = _FLOAT * (
        2.0 * rows * variables + 3.0 * variables**2 + 6.0 * states**2 + 2.0 * states * variables
    )
    base_bytes = _BASE_BYTES + _MODEL_BYTES * N
    report_bytes = base_bytes + ticks * (M * _REPORTED_BYTES + 6.0 * _FLOAT * n)
    plant_step_s = plant.mujoco.step_s if plant.engine == "mujoco" else plant.step_s
    step_s = 6e-4 + 7e-8 * states**2 + 1.5e-8 * rows * variables + 3.4e-11 * variables**3
    return Budget(
        ticks=ticks,
        plant_steps=math.ceil(controller.sampling_period_s / plant_step_s - 1e-9),
        variables=variables,
        rows=rows,
        # Plant, coordinator and recorder besides.
        total_bytes=(M + 3) * base_bytes + M * (path_bytes + matrix_bytes) + report_bytes,
        worker_bytes=M * (path_bytes + matrix_bytes) + ticks * tick_bytes + report_bytes,
        log_bytes=_COMPRESSED * ticks * tick_bytes,
        step_s=controller.negotiation_iterations * step_s,
    )


def ticks_of(scenario: Scenario) -> int:
    """Return the number of sampling instants of a run: t_k < duration of the maneuver."""
    periods = (
        sum(phase.duration_s for phase in scenario.maneuver.phase)
        / scenario.controller.sampling_period_s
    )
    return max(
        1, math.ceil(periods - 1e-9 * periods)
    )  # a whole number of periods must not gain one by rounding


def check_budget(scenario: Scenario, source: str) -> None:
    """Raise ScenarioError for a run that exceeds a limit, with field, limit and estimate."""
    found = estimate(scenario)
    size = "maneuver.phase" if found.ticks > 20 * found.variables else "controller.horizon"
    steps = "plant.mujoco.step_s" if scenario.plant.engine == "mujoco" else "plant.step_s"
    for field, got, most, unit in (
        (steps, found.plant_steps, MOST_PLANT_STEPS, "integration steps per sampling period"),
        (size, found.total_bytes / MB, MOST_TOTAL_BYTES / MB, "MB of memory in total"),
        ("controller.horizon", found.step_s, MOST_STEP_S, "s of processor time per step"),
    ):
        if got > most:
            raise ScenarioError(
                source, field, f"expected at most {most:,g} {unit}, got {got:,.9g} ({ADMITTED})"
            )


def most_workers(scenarios: Iterable[Scenario]) -> int:
    """Return how many processes that simulate one of these runs each fit into the memory of a run, at least one."""
    largest = max((estimate(scenario).worker_bytes for scenario in scenarios), default=_BASE_BYTES)
    return max(1, int(MOST_TOTAL_BYTES // largest))
