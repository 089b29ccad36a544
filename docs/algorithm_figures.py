"""Draw the figures of the algorithms in examples/controllers, and renew their table.

Part of `make figures`, four minutes. Each is flown over the paper's maneuver on a perfect network and on a late one;
that of ADMM has its distance from the centralized optimum as well. Names of algorithms as arguments draw these only.
"""

import importlib
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib as mpl
import numpy as np
import orjson
import threadpoolctl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from tables import ROOT, commit, put, table

from transport.agent.user_class.run_for_user import run_of
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.series import Series
from transport.analysis.summary_assembly import summarise
from transport.experiments.arena.arena_algorithms import entered
from transport.experiments.arena.arena_tasks_and_networks import NETWORKS, PERFECT
from transport.experiments.simulation import run_in_memory
from transport.flight.run_files import machine
from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState
from transport.report.figures.column import Room, column_panels, head
from transport.report.figures.style import CURVES, DIVERGED, MARKER, RC, save

FOLDER = ROOT / "examples" / "controllers"
IMAGES = ROOT / "docs" / "images"
PAGE = ROOT / "docs" / "record" / "algorithms.md"

ALGORITHMS = (
    "alone:Alone",
    "paper:Paper",
    "sequential:Sequential",
    "admm:ADMM",
    "event_triggered:EventTriggered",
    "nmpc:NMPC",
)
SHOWN: Mapping[str, tuple[str, ...]] = {name: NETWORKS[name] for name in (PERFECT, "late")}
TEXTS = {PERFECT: "perfect network", "late": "200 ms delay, 30 % packet loss"}
STYLES = dict(zip(SHOWN, CURVES, strict=False))
LEAST = 1e-12  # of what is drawn on a logarithmic axis

ITERATIONS = 60
NEAR = 1e-4
HOVER_S = 5.0  # of the maneuver, in which nothing has to be agreed upon
# A state near hover, at rest, displaced and tilted so that limits are active.
DISPLACED_M = (0.5, -0.25, 0.4)
TILTED_RAD = (0.1, -0.05, 0.05)


@dataclass(frozen=True, slots=True)
class Flight:
    """A simulated run."""

    log: RunLog
    series: Series
    summary: Any

    @property
    def completed(self) -> bool:
        """Whether it has reached the end of the maneuver."""
        return bool(self.summary["outcome"] == "completed")


def flown(name: str, network: str) -> Flight:
    """Fly an algorithm over the paper's maneuver on a network."""
    sys.stderr.write(f"{name}, {network}\n")
    settings = [*entered(name).settings_for(uavs=4), *SHOWN[network]]
    setup = Setup.of(read_scenario(find_scenario("paper"), settings), "paper")
    with threadpoolctl.threadpool_limits(1):
        log = run_in_memory(setup)
    run = AnalysedRun.of(setup, log)
    return Flight(log, run.series, summarise(run))


def panel_of(panel: Axes, runs: Mapping[str, Flight], series: str, title: str) -> None:
    """Draw a series of the runs; a run that diverged ends with a hollow marker."""
    for network, run in runs.items():
        colour, marker, line = STYLES[network]
        values = np.maximum(getattr(run.series, series), LEAST)
        times_s = run.series.times_s
        panel.semilogy(times_s, values, color=colour, linestyle=line, linewidth=0.8)
        if not run.completed:
            end: Any = {"color": colour, "marker": marker, "markersize": MARKER, **DIVERGED}
            panel.plot(times_s[-1], values[-1], clip_on=False, **end)
    head(panel, title, legend=False)


def legend_of(networks: Iterable[str]) -> list[Line2D]:
    """Return the entries of a legend, a line for each network."""
    return [
        Line2D([], [], label=TEXTS[net], color=STYLES[net][0], linestyle=STYLES[net][2])
        for net in networks
    ]


def draw(name: str, runs: Mapping[str, Flight]) -> Path:
    """Draw payload error and cost of an algorithm over the maneuver; return the file."""
    with mpl.rc_context({**RC, "svg.hashsalt": name}):
        figure = Figure()
        error, cost = column_panels(figure, [0.9, 0.9], legend=legend_of(runs))
        panel_of(error, runs, "payload_error_norm_m", "payload error, m")
        panel_of(cost, runs, "cost", "stage cost")
        cost.set_ylim(bottom=1e-6)
        error.set_ylim(bottom=1e-3)
        for panel in (error, cost):
            panel.set_xlim(0.0, 25.0)
        return saved(figure, f"own_{name.partition(':')[0]}.png")


def saved(figure: Figure, name: str) -> Path:
    """Write a figure of the pages as PNG only; return the file."""
    picture, drawing = save(figure, IMAGES / name)
    drawing.unlink()
    return picture


def agents_of(setup: Setup, x: Array) -> list[Any]:
    """Return the ADMM objects of all agents at tick 0, which estimate a state exactly."""
    admm = importlib.import_module("admm").ADMM
    objects = []
    for agent in setup.agents:
        run = run_of(setup.run, agent)
        run.agents = setup.agents
        one = admm()
        one.start(run)
        one.estimate = SimpleNamespace(x_start=x, u_before=run.u_hover)
        objects.append(one)
    return objects


def optimum(program: Any, x: Array, u_before: Array, U: Array, Y_ref: Array) -> Array:
    """Return the optimal inputs of the whole team at a state, (N_p, 4 N), within their limits."""
    program.about(x, u_before)
    H, g = program.cost(U, Y_ref)
    lower, upper = program.bounds()
    solved = importlib.import_module("program").solved
    return np.asarray(program.inputs(solved(H, g, np.zeros((0, len(g))), [lower], [upper])))


def distances_over_iterations(setup: Setup) -> Array:
    """Return the largest distance of an input over the horizon from the optimum, by iteration."""
    x = setup.initial_state()
    x[:3] += DISPLACED_M
    x[6:9] = TILTED_RAD
    agents = agents_of(setup, x)
    one = agents[0]
    team = importlib.import_module("program").Program(one.run, range(4))
    U = np.tile(one.run.u_hover, (one.run.horizon, 1))
    best = optimum(team, x, one.run.u_hover, U, one.reference())

    results = [agent.step(None, []) for agent in agents]
    distances = []
    for iteration in range(1, ITERATIONS + 1):
        proposals = [
            SimpleNamespace(agent=agent, tick=0, data=data)
            for agent, (_, data, _) in enumerate(results, start=1)
        ]
        U = np.hstack([inputs for inputs, _, _ in results])
        distances.append(np.abs((U - best) / team.range).max())
        results = [
            agent.negotiate(iteration, [p for p in proposals if p.agent != agent.run.agent])
            for agent in agents
        ]
    return np.array(distances)


def distances_in_flight(run: Flight, setup: Setup) -> tuple[Array, Array]:
    """Return times, s, and the largest distance of an applied input from the centralized optimum."""
    one = run_of(setup.run, 1)
    team = importlib.import_module("program").Program(one, range(4))
    states = {state.tick: state for state in run.log.of(PlantState)}
    U = np.tile(one.u_hover, (one.horizon, 1))
    times_s, distances = [], []
    for tick in range(1, max(states)):
        ahead = [one.reference(tick + 1 + k) for k in range(one.horizon)]
        Y_ref = np.array([one.model.outputs(x_ref) for x_ref in ahead])
        best = optimum(team, states[tick].x, states[tick - 1].u, U, Y_ref)
        times_s.append(tick * one.period_s)
        distances.append(np.abs((states[tick].u - best[0]) / team.range).max())
    return np.array(times_s), np.array(distances)


def draw_admm(runs: Mapping[str, Flight]) -> tuple[Path, str]:
    """Draw the distance of ADMM from the centralized optimum; return the file and what it shows."""
    setup = Setup.of(read_scenario(find_scenario("paper")), "paper")
    iterated = distances_over_iterations(setup)
    in_flight = {network: distances_in_flight(run, setup) for network, run in runs.items()}
    with mpl.rc_context({**RC, "svg.hashsalt": "admm"}):
        figure = Figure()
        over, during = column_panels(
            figure, [1.0, 1.0], legend=legend_of(runs), room=Room(gap_in=0.42)
        )
        colour, marker, _ = STYLES[PERFECT]
        over.semilogy(
            range(1, len(iterated) + 1), iterated, color=colour, marker=marker, markersize=1.5
        )
        over.tick_params(labelbottom=True)
        head(over, "distance from the optimum over iterations of one tick", legend=False)
        for network, (times_s, distances) in in_flight.items():
            colour, _, line = STYLES[network]
            during.semilogy(
                times_s, np.maximum(distances, LEAST), color=colour, linestyle=line, linewidth=0.8
            )
        during.set_ylim(bottom=1e-8)
        head(during, "the same of the applied inputs, ten iterations a tick", legend=False)
        file = saved(figure, "own_admm_distance.png")

    return file, in_words(iterated, in_flight)


def in_words(iterated: Array, in_flight: Mapping[str, tuple[Array, Array]]) -> str:
    """Return what the distances show."""
    reached = int(np.argmax(iterated < NEAR)) + 1
    texts = [f"below {NEAR:g} from iteration {reached} on, {iterated[-1]:.0e} after {ITERATIONS}"]
    for network, (times_s, distances) in in_flight.items():
        moving = distances[times_s > HOVER_S]
        until = f"from {HOVER_S:g} s until {times_s[-1]:.1f} s"
        spread = f"median {np.median(moving):.0e}, largest {moving.max():.0e}"
        texts.append(f"in flight, {TEXTS[network]}, {until}: {spread}")
    return "; ".join(texts)


def row_of(name: str, runs: Mapping[str, Flight]) -> list[str]:
    """Return the row of an algorithm in the table."""
    file = name.partition(":")[0]
    cells = [f"`{name}` ([figure](../images/own_{file}.png))"]
    for network in SHOWN:
        if network not in runs:
            cells.append("no network")
            continue
        run = runs[network]
        end_s = run.series.times_s[-1]
        cost = run.summary["cost"]["mean"]
        cells.append(f"{cost:.5f}" if run.completed else f"diverges at {end_s:.1f} s")
    perfect = runs[PERFECT].summary
    cells.append(f"{perfect['payload_tracking']['rms_m']:.2f} m")
    cells.append(f"{perfect['agent_step_ms']['p50']:.2f} ms")
    return cells


def file_of(name: str) -> Path:
    """Return the file in which row and note of an algorithm are kept for this commit."""
    return ROOT / "runs" / "figures" / commit() / "algorithms" / f"{name.partition(':')[0]}.json"


def fly(name: str) -> None:
    """Fly and draw an algorithm, and keep its row."""
    networks = [PERFECT] if entered(name).centralized else list(SHOWN)
    runs = {network: flown(name, network) for network in networks}
    draw(name, runs)
    note = draw_admm(runs)[1] if name == "admm:ADMM" else ""
    file = file_of(name)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(orjson.dumps({"row": row_of(name, runs), "note": note}))


def main(names: Sequence[str]) -> None:
    """Fly algorithms, by default all that this commit has not flown, and renew the table of all flown."""
    os.chdir(FOLDER)
    sys.path.append(str(FOLDER))
    for name in names or [name for name in ALGORITHMS if not file_of(name).exists()]:
        fly(name)

    files = [file for file in map(file_of, ALGORITHMS) if file.exists()]
    made = [orjson.loads(file.read_bytes()) for file in files]
    headings = ["over the paper's maneuver", *TEXTS.values(), "payload error, rms", "step"]
    rows = table(headings, [one["row"] for one in made])
    notes = [f"ADMM's distance from the optimum: {one['note']}." for one in made if one["note"]]
    origin = f"Mean cost; step: median. Machine: {machine()}."
    put(PAGE, "ready algorithms", f"{rows}\n\n{' '.join([origin, *notes])}")


if __name__ == "__main__":
    main(sys.argv[1:])
