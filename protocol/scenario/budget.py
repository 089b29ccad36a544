"""Memory, disk and processor time of a run, estimated from sizes: bytes and seconds were fitted."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from transport.model.state import INPUTS, PAYLOAD, PER_UAV
from transport.protocol.scenario.errors import ScenarioError
from transport.protocol.scenario.schema import Scenario

MB = 1e6

# Limits without --allow-large. A step is one while few constraints are active: with many, as in the
# first step, a large QP takes several times as long.
MOST_PLANT_STEPS = 10_000
MOST_TOTAL_BYTES = 8_000 * MB
MOST_STEP_S = 1.25

ADMITTED = "--allow-large admits more"

_FLOAT = 8  # bytes

# Memory of one process: interpreter and packages, and the functions of a model per UAV, bytes.
_BASE_BYTES = 60 * MB
_MODEL_BYTES = 1 * MB

# Bytes of the log over bytes of its messages.
_COMPRESSED = 0.65

# Python objects of plans and step reports in the memory of the report, bytes per tick and agent.
_REPORTED_BYTES = 4_000.0

# Bytes of a message beside its arrays: of a plan, of measurement and step report, and of the latter
# per agent of the run; of the state of the plant with its tick.
_PLAN_BYTES = 100.0
_STEP_BYTES = 320.0
_PEER_BYTES = 13.0
_TICK_BYTES = 120.0

_TICKS_PER_VARIABLE = 20  # ticks whose log and report take about the memory of a variable
_OTHER_PROCESSES = 3  # plant, coordinator and recorder

# Rounding of a number of periods or steps, absolute, and relative for the duration of a run: a whole
# number must not become one more.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Estimate of the resources of a run."""

    ticks: int  # sampling periods
    plant_steps: int  # integration steps per sampling period before any is halved
    variables: int  # of the largest agent's QP
    rows: int  # of that QP, without the user's constraints on inputs
    total_bytes: float  # memory of all processes, the report after the run among them
    worker_bytes: float  # memory of one process that simulates the whole run, as in a sweep
    log_bytes: float  # size of run.mcap
    step_s: float  # processor time of a step of the largest agent with few active constraints

    def text(self) -> str:
        """Return the estimate in one line."""
        parts = [
            f"{self.ticks} ticks",
            f"{self.plant_steps} integration steps per period",
            f"QP of {self.variables} variables and {self.rows} rows",
            f"{self.total_bytes / MB:.0f} MB of memory",
            f"log of {self.log_bytes / MB:.3g} MB",
            f"{1e3 * self.step_s:.2g} ms of processor time per step",
        ]
        return ", ".join(parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """Sizes of a team, of the program of its largest agent, and of its run."""

    N: int  # UAVs
    agents: int
    own: int  # UAVs of the largest agent
    horizon: int
    states: int  # of the model of a controller
    outputs: int
    variables: int  # of the QP
    rows: int
    ticks: int

    @staticmethod
    def from_scenario(scenario: Scenario) -> "Sizes":
        """Return the sizes of a scenario."""
        controller = scenario.controller
        N = len(scenario.system.uav)
        own = max(len(group) for group in scenario.owned)

        # With motor lag the actual inputs are states.
        states = PAYLOAD + PER_UAV * N
        if controller.motor_lag_s:
            states += INPUTS * N

        # Rows per step that a slack softens, as `mpc.program.constraints` makes them; the user's have at most
        # one each.
        softened = _softened_rows(scenario, N, own)
        user = len(controller.constraint)
        slacks = sum(rows > 0 for rows in softened) + user
        soft_rows = sum(softened) + user

        inputs = INPUTS * own
        horizon = controller.horizon
        return Sizes(
            N=N,
            agents=len(scenario.owned),
            own=own,
            horizon=horizon,
            states=states,
            outputs=INPUTS * N + 9,
            variables=inputs * horizon + slacks,
            rows=inputs * (horizon - 1) + horizon * soft_rows,
            ticks=ticks_of(scenario),
        )


def estimate(scenario: Scenario) -> Budget:
    """Return the budget of a run, from sizes alone: nothing is built."""
    sizes = Sizes.from_scenario(scenario)
    tick_bytes = _tick_bytes(scenario, sizes)
    agents_bytes = sizes.agents * (_path_bytes(scenario, sizes) + _matrix_bytes(sizes))

    base_bytes = _BASE_BYTES + _MODEL_BYTES * sizes.N
    plant_states = PAYLOAD + PER_UAV * sizes.N
    recorded_bytes = sizes.agents * _REPORTED_BYTES + 6.0 * _FLOAT * plant_states
    report_bytes = base_bytes + sizes.ticks * recorded_bytes

    processes = sizes.agents + _OTHER_PROCESSES
    return Budget(
        ticks=sizes.ticks,
        plant_steps=_plant_steps(scenario),
        variables=sizes.variables,
        rows=sizes.rows,
        total_bytes=processes * base_bytes + agents_bytes + report_bytes,
        worker_bytes=agents_bytes + sizes.ticks * tick_bytes + report_bytes,
        log_bytes=_COMPRESSED * sizes.ticks * tick_bytes,
        step_s=scenario.controller.negotiation_iterations * _step_s(sizes),
    )


def ticks_of(scenario: Scenario) -> int:
    """Return the number of sampling instants of a run: t_k < duration of the maneuver."""
    duration_s = sum(phase.duration_s for phase in scenario.maneuver.phase)
    periods = duration_s / scenario.controller.sampling_period_s
    return max(1, math.ceil(periods - _ROUNDING * periods))


def first_tick(at_s: float, period_s: float) -> int:
    """Return the first tick not before a time of the run."""
    return math.ceil(at_s / period_s - _ROUNDING)


def check_budget(scenario: Scenario, source: str) -> None:
    """Raise ScenarioError for a run that exceeds a limit, with field, limit and estimate."""
    for field, got, most, unit in _limited(scenario):
        if got > most:
            expected = f"expected at most {most:,g} {unit}"
            raise ScenarioError(source, field, f"{expected}, got {got:,.9g} ({ADMITTED})")


def most_workers(scenarios: Iterable[Scenario]) -> int:
    """Return how many processes with one of these runs each fit into the memory of a run, >= 1."""
    sizes = [estimate(scenario).worker_bytes for scenario in scenarios]
    largest = max(sizes, default=_BASE_BYTES)
    return max(1, int(MOST_TOTAL_BYTES // largest))


def _limited(scenario: Scenario) -> Iterator[tuple[str, float, float, str]]:
    """Yield field, estimate, limit and unit of each resource that is limited."""
    budget = estimate(scenario)

    is_mujoco = scenario.plant.engine == "mujoco"
    step_key = "plant.mujoco.step_s" if is_mujoco else "plant.step_s"
    yield (
        step_key,
        budget.plant_steps,
        MOST_PLANT_STEPS,
        "integration steps per sampling period",
    )

    # Log and report grow with the ticks, programs with their variables: the larger part is named.
    is_long = budget.ticks > _TICKS_PER_VARIABLE * budget.variables
    size_key = "maneuver.phase" if is_long else "controller.horizon"
    yield size_key, budget.total_bytes / MB, MOST_TOTAL_BYTES / MB, "MB of memory in total"

    yield "controller.horizon", budget.step_s, MOST_STEP_S, "s of processor time per step"


def _softened_rows(scenario: Scenario, N: int, own: int) -> list[int]:
    """Return the rows per step of separation, tilt and tension; 0 without the constraint."""
    controller = scenario.controller
    others = N - own
    pairs = N * (N - 1) // 2 - others * (others - 1) // 2  # with at least one own UAV
    return [
        pairs if controller.separation else 0,
        4 * own if controller.tilt else 0,
        own if controller.tension else 0,
    ]


def _plant_steps(scenario: Scenario) -> int:
    """Return the number of equal integration steps of a sampling period."""
    plant = scenario.plant
    step_s = plant.mujoco.step_s if plant.engine == "mujoco" else plant.step_s
    return math.ceil(scenario.controller.sampling_period_s / step_s - _ROUNDING)


def _tick_bytes(scenario: Scenario, sizes: Sizes) -> float:
    """Return the size of the messages of one tick: arrays, and the rest of each message."""
    controller = scenario.controller
    trajectories = 2 if controller.prediction == "closed_loop" else 1  # inputs, corrections

    planned = INPUTS * sizes.horizon * trajectories + PER_UAV
    plan_bytes = _FLOAT * sizes.own * planned + _PLAN_BYTES
    measurement_bytes = _FLOAT * (PAYLOAD + (PER_UAV + INPUTS) * sizes.own)
    step_bytes = _STEP_BYTES + _PEER_BYTES * sizes.agents

    agent_bytes = plan_bytes * controller.negotiation_iterations + measurement_bytes + step_bytes
    # State and, in some runs, actual inputs.
    plant_bytes = _FLOAT * (PAYLOAD + PER_UAV * sizes.N + 2.0 * INPUTS * sizes.N) + _TICK_BYTES
    return sizes.agents * agent_bytes + plant_bytes


def _path_bytes(scenario: Scenario, sizes: Sizes) -> float:
    """Return the memory of reference and preview of one agent, with intermediate results."""
    instants = sizes.ticks + sizes.horizon + 2
    preview = 7.0 * sizes.states if scenario.controller.preview else 0.0
    return _FLOAT * instants * (3.5 * sizes.outputs + preview)


def _matrix_bytes(sizes: Sizes) -> float:
    """Return the memory of the program of one agent."""
    rows_and_template = 2.0 * sizes.rows * sizes.variables
    hessian_and_factors = 3.0 * sizes.variables**2
    regulator = 6.0 * sizes.states**2
    linear_model = 2.0 * sizes.states * sizes.variables
    return _FLOAT * (rows_and_template + hessian_and_factors + regulator + linear_model)


def _step_s(sizes: Sizes) -> float:
    """Return the processor time of one solve and its preparation, s; coefficients were fitted."""
    model = 7e-8 * sizes.states**2
    condensing = 1.5e-8 * sizes.rows * sizes.variables
    factors = 3.4e-11 * sizes.variables**3
    return 6e-4 + model + condensing + factors
