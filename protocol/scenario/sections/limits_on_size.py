"""Size of a run: ticks, integration steps and programs, and the three limits on them."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from transport.model.state import INPUTS
from transport.protocol.scenario.sections.lockstep_and_realtime_section import ROUNDING
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario

# Limits without --allow-large. At each of the latter two a process that simulates the whole run takes
# a few GB, and the first step of a single agent that owns all some seconds.
MOST_PLANT_STEPS = 10_000
MOST_AGENT_STEPS = 1_000_000
MOST_ENTRIES = 100_000_000

ADMITTED = "--allow-large admits more"


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """Size of a run."""

    ticks: int  # sampling periods
    plant_steps: int  # integration steps per sampling period before any is halved
    agents: int
    variables: int  # of the largest agent's QP
    rows: int  # of that QP, without the user's constraints on inputs

    @property
    def agent_steps(self) -> int:
        """Steps of all agents, of which log and report hold the results."""
        return self.agents * self.ticks

    @property
    def entries(self) -> int:
        """Entries of the constraint matrices of all agents."""
        return self.agents * self.rows * self.variables

    def text(self) -> str:
        """Return the size in one line."""
        parts = [
            f"{self.ticks} ticks",
            f"{self.plant_steps} integration steps per period",
            f"QP of {self.variables} variables and {self.rows} rows",
        ]
        return ", ".join(parts)


def size_of(scenario: Scenario) -> Size:
    """Return the size of a run, from its scenario alone: nothing is built."""
    controller = scenario.controller
    N = len(scenario.system.uav)
    own = max(len(group) for group in scenario.owned)

    # Rows per step that a slack softens, as `mpc.program.constraints` makes them; the user's have at
    # most one each.
    softened = _softened_rows(scenario, N, own)
    user = len(controller.constraint)
    slacks = sum(rows > 0 for rows in softened) + user
    soft_rows = sum(softened) + user

    inputs = INPUTS * own
    horizon = controller.horizon
    return Size(
        ticks=ticks_of(scenario),
        plant_steps=_plant_steps(scenario),
        agents=len(scenario.owned),
        variables=inputs * horizon + slacks,
        rows=inputs * (horizon - 1) + horizon * soft_rows,
    )


def ticks_of(scenario: Scenario) -> int:
    """Return the number of sampling instants of a run: those of its maneuver.

    A team outside comes down after it: its run has `vehicles.landing_s` more.
    """
    ticks = maneuver_ticks(scenario)
    if scenario.has_plant:
        return ticks
    return ticks + math.ceil(scenario.vehicles.landing_s / scenario.controller.sampling_period_s)


def maneuver_ticks(scenario: Scenario) -> int:
    """Return the number of sampling instants of a maneuver: t_k < its duration."""
    duration_s = sum(phase.duration_s for phase in scenario.maneuver.phase)
    periods = duration_s / scenario.controller.sampling_period_s
    return max(1, math.ceil(periods - ROUNDING * periods))


def check_size(scenario: Scenario, source: str) -> None:
    """Raise ScenarioError for a run that exceeds a limit, with field, limit and size."""
    for field, got, most, what in _limited(scenario):
        if got > most:
            expected = f"expected at most {most:,} {what}"
            raise ScenarioError(source, field, f"{expected}, got {got:,} ({ADMITTED})")


def most_workers(scenarios: Iterable[Scenario]) -> int:
    """Return how many of these runs fit into the memory of one at a limit, >= 1."""
    shares = [
        max(size.agent_steps / MOST_AGENT_STEPS, size.entries / MOST_ENTRIES)
        for size in map(size_of, scenarios)
    ]
    return max(1, int(1.0 / max(shares, default=1.0)))


def _limited(scenario: Scenario) -> Iterator[tuple[str, int, int, str]]:
    """Yield field, size, limit and meaning of each size that is limited."""
    size = size_of(scenario)
    is_mujoco = scenario.plant.engine == "mujoco"
    step_key = "plant.mujoco.step_s" if is_mujoco else "plant.step_s"

    per_period = "integration steps per sampling period"
    yield step_key, size.plant_steps, MOST_PLANT_STEPS, per_period
    yield "maneuver.phase", size.agent_steps, MOST_AGENT_STEPS, "steps of all agents"
    entries = "entries in the constraint matrices of all agents"
    yield "controller.horizon", size.entries, MOST_ENTRIES, entries


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
    return math.ceil(scenario.controller.sampling_period_s / step_s - ROUNDING)
