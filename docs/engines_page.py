"""Renew the measured tables of docs/engines.md: part of `make figures`, two minutes on two cores."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import threadpoolctl
from simulations import Run
from tables import ROOT, commit, place, put, table

from model import state
from model.arrays import Array
from plant.engines import Engine, engine_version
from protocol.scenario.file import find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.scenario.team import resized
from protocol.wire.messages import Message, PlantState
from transport.experiments.workers import each_on_cores
from transport.flight import memory
from transport.flight.header import machine, versions

DOCUMENT = ROOT / "docs" / "engines.md"

MUJOCO = "plant.engine=mujoco"
IMPAIRED = ("links.delay_s=0.2", "links.loss=0.3")
NETWORKS: Mapping[str, tuple[str, ...]] = {"perfect": (), "200 ms delay, 30 % packet loss": IMPAIRED}
SCENARIOS = ("resilient", "precise")

# Suspensions of the load, as settings of MuJoCo.
SUSPENSIONS: Mapping[str, tuple[str, ...]] = {
    "rods of 1 g": (),
    "rods of 10 g": ("plant.mujoco.rod_mass_kg=0.01",),
    "rods of 100 g": ("plant.mujoco.rod_mass_kg=0.1",),
    "rods of 100 g, with `controller.disturbance.estimate`": (
        "plant.mujoco.rod_mass_kg=0.1",
        "controller.disturbance.estimate=true",
    ),
    "cables": ("plant.mujoco.suspension=cables",),
}

SEEDS = 10
DELIVERIES: Mapping[str, tuple[str, ...]] = {"noise of `windy`": ()}
# The delivery without its release, held for long.
HELD = Run("delivery", ("faults.event=[]", "maneuver.phase.5.duration_s=10.0"))

# Speed: periods of the maneuver's hover, integrated and read out, by teams of these sizes.
TEAMS, PERIODS, REPETITIONS = (2, 4, 8), 100, 5


@dataclass(frozen=True, slots=True)
class Flight:
    """One simulation: how and when it ended, and positions and errors of the payload at its ticks."""

    outcome: str
    end_s: float
    payload_I: Array
    errors_m: Array


Found = Mapping[Run, Flight]


@dataclass(frozen=True, slots=True)
class Measured:
    """A table: name of its markers, simulations it needs, and the function that writes it."""

    name: str
    runs: tuple[Run, ...]
    text: Callable[[Found], str]


def setup_of(run: Run) -> Setup:
    """Return the setup of a run."""
    path = find_scenario(run.scenario)
    return Setup.of(read_scenario(path, run.settings), str(path))


def simulate(run: Run) -> tuple[Run, Flight]:
    """Simulate a run in this process."""
    setup, states = setup_of(run), []

    def record(message: Message) -> None:
        if isinstance(message, PlantState):
            states.append(message.x)

    with threadpoolctl.threadpool_limits(1):
        control = memory.simulate(setup, record, lambda: 0)
    period_s = setup.settings.sampling_period_s
    payload_I = np.array(states)[:, state.R0]
    path_I, _ = setup.maneuver.path(period_s * np.arange(len(payload_I), dtype=np.float64))
    errors_m = np.linalg.norm(payload_I - path_I, axis=1)
    return run, Flight(control.outcome, control.tick * period_s, payload_I, np.asarray(errors_m))


def outcome(flight: Flight) -> str:
    """Return how a run ended."""
    return "completes" if flight.outcome == "completed" else f"**{flight.outcome}** at {flight.end_s:.1f} s"


def errors(flight: Flight) -> str:
    """Return outcome and payload errors."""
    rms_m = float(np.sqrt(np.mean(flight.errors_m**2)))
    return f"{outcome(flight)}, {rms_m * 100:.2f} cm rms, {flight.errors_m.max() * 100:.2f} cm"


def controller_run(name: str, engine: tuple[str, ...], network: tuple[str, ...]) -> Run:
    """Return a run of the table of controllers."""
    return Run(name, (*engine, *network))


def controllers(found: Found) -> str:
    """Return the table of both engines under both networks."""
    rows = []
    for name in SCENARIOS:
        for network, settings in NETWORKS.items():
            cells = [errors(found[controller_run(name, engine, settings)]) for engine in ((), (MUJOCO,))]
            rows.append([f"`{name}`", network, *cells])
    return table(["scenario", "network", "`rods`: payload error", "`mujoco`: payload error"], rows)


def suspensions(found: Found) -> str:
    """Return the table of rods of several masses and cables, against massless rods."""
    massless = found[Run("resilient")].payload_I
    rows = []
    for name, settings in SUSPENSIONS.items():
        flight = found[Run("resilient", (MUJOCO, *settings))]
        apart_m = np.linalg.norm(flight.payload_I - massless[: len(flight.payload_I)], axis=1).max()
        rows.append([name, f"{apart_m * 1e3:.1f} mm", errors(flight)])
    return table(["`resilient` in MuJoCo with", "largest distance to the path of massless rods", "payload error"], rows)


def delivery_run(settings: tuple[str, ...], seed: int) -> Run:
    """Return a run of the table of deliveries."""
    return Run("delivery", (*settings, f"seed={seed}"))


def deliveries(found: Found) -> str:
    """Return the table of deliveries over the seeds."""
    rows = []
    for name, settings in DELIVERIES.items():
        flights = [found[delivery_run(settings, seed)] for seed in range(SEEDS)]
        completed = [flight for flight in flights if flight.outcome == "completed"]
        ends_cm = [100.0 * float(flight.errors_m[-1]) for flight in completed]
        cells = [f"{np.median(ends_cm):.1f} cm", f"{max(ends_cm):.1f} cm"] if ends_cm else ["", ""]
        rows.append([name, f"{len(completed)} of {len(flights)}", *cells])
    headings = ["`delivery`, seeds 0 to 9", "completed", "distance of the payload from its target, median", "largest"]
    return table(headings, rows)


def held(found: Found) -> str:
    """Return the sentence about a team that stays on its rods above a payload on the ground."""
    landed_s = sum(phase.duration_s for phase in setup_of(HELD).maneuver.phases[:4])
    flight = found[HELD]
    if flight.outcome == "completed":
        return "Without the release the team stands above the payload until the end of the run, 10 s after the landing."
    return f"Without the release the run ends as {flight.outcome} {flight.end_s - landed_s:.1f} s after the landing."


def periods(engine: Engine, setup: Setup) -> None:
    """Integrate and read out some periods from the initial state."""
    engine.reset(setup.initial_state())
    for _ in range(PERIODS):
        engine.advance(setup.hover.u, None, setup.settings.sampling_period_s)


def processor_time_s(work: Callable[[], None]) -> float:
    """Return the smallest processor time of some repetitions, s."""
    times = []
    for _ in range(REPETITIONS):
        begun_s = time.process_time()
        work()
        times.append(time.process_time() - begun_s)
    return min(times)


def speed() -> str:
    """Return the table of the speed of each engine, alone, for several teams."""
    rows = []
    for name in ("rods", "mujoco"):
        cells = []
        for uavs in TEAMS:
            setup = Setup.of(_team(uavs, name), "resilient")
            engine = Engine(setup, setup.system)
            engine.warm_up(setup)
            simulated_s = PERIODS * setup.settings.sampling_period_s
            cells.append(f"{simulated_s / processor_time_s(partial(periods, engine, setup)):.0f}")
        rows.append([f"`{name}`", *cells])
    return table(["simulated time over processor time", *(f"{uavs} UAVs" for uavs in TEAMS)], rows)


def _team(uavs: int, engine: str) -> Scenario:
    """Return a team of some size with an engine."""
    path = find_scenario("resilient")
    scenario = read_scenario(path, [f"plant.engine={engine}"])
    return resized(scenario, path.parent, uavs, group=None, name=None, source=str(path))


TABLES = (
    Measured(
        "controllers",
        tuple(controller_run(name, e, n) for name in SCENARIOS for e in ((), (MUJOCO,)) for n in NETWORKS.values()),
        controllers,
    ),
    Measured(
        "suspensions",
        (Run("resilient"), *(Run("resilient", (MUJOCO, *settings)) for settings in SUSPENSIONS.values())),
        suspensions,
    ),
    Measured("speed", (), lambda _: speed()),
    Measured(
        "deliveries", tuple(delivery_run(s, seed) for s in DELIVERIES.values() for seed in range(SEEDS)), deliveries
    ),
    Measured("held", (HELD,), held),
)


def renew(tables: Sequence[Measured], jobs: int = 2) -> None:
    """Simulate in some processes, and renew the tables of the document."""
    for name in ("origin", *(part.name for part in tables)):
        place(DOCUMENT, name)  # refused before minutes are spent
    runs = list(dict.fromkeys(run for part in tables for run in part.runs))
    found: dict[Run, Flight] = {}
    for run, flight in each_on_cores(simulate, runs, jobs):
        found[run] = flight
        sys.stderr.write(f"\r{DOCUMENT.name}: {len(found)} of {len(runs)} simulations")
    sys.stderr.write("\n")
    for part in tables:
        put(DOCUMENT, part.name, part.text(found))
    engine = f"mujoco {engine_version('mujoco')}"
    put(DOCUMENT, "origin", f"*Commit {commit()}; {versions()}, {engine}; {machine()}.*")


if __name__ == "__main__":
    renew(TABLES)
