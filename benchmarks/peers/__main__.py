"""The same team, maneuver and cost with other frameworks.

`python -m benchmarks.peers`, or `--help`.

Every controller has the model, weights, limits of inputs and horizon of `paper`, and flies the same
plant in lockstep, so that none is late however long it computes. Needs the packages of `pip install
'payload-transport[bench]'`.
"""

import argparse
import logging
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.runs import WARM_UP, BenchmarkError, digits, messages, origin, quiet, setup
from docs.tables import place, put, table
from transport.model.arrays import Array
from transport.protocol.scenario.setup.cost_of_run import StageCost
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import STAGES, PlantState, StepReport

HERE = Path(__file__).resolve().parent
DOCUMENT = HERE.parents[1] / "docs" / "record" / "performance.md"
MANEUVER = (
    "maneuver.phase=[{name='climb',duration_s=1.0,displacement_m=[0.3,0,-0.3]},"
    "{name='hold',duration_s=1.0,displacement_m=[0,0,0]}]"
)
ITERATIONS = (2, 5)  # of ADMM a tick
TEXT = (
    "Four UAVs, horizon {horizon}, 2 s with a climb of 0.4 m in 1 s, `python -m benchmarks.peers`. Cost: mean stage "
    "cost over that of the first row. Step: processor time of an agent at a tick, median; for AgentLib-MPC the mean, "
    "with its messages. Lines: what states the problem. do-mpc and AgentLib-MPC have their defaults but IPOPT's "
    "tolerance, 1e-3 instead of 1e-8, with which IPOPT needs 6 iterations a step instead of up to 300 with the same "
    "cost, and ADMM's penalty, 0.01. Their problems have neither limits on changes of inputs nor a separation; "
    "AgentLib-MPC has no terminal cost. Limits of thrust and moments are not reached."
)


def flown(run: Setup) -> tuple[float, float]:
    """Return mean stage cost and median processor time of an agent's step, ms, of a run in memory."""
    sent = messages(run)
    states = {message.tick: message for message in sent if isinstance(message, PlantState)}
    total = STAGES.index("total")
    reports = [m.times_ms[total] for m in sent if isinstance(m, StepReport) and m.tick >= WARM_UP]
    X, U = (
        np.array([getattr(states[tick], name) for tick in range(run.ticks)]) for name in ("x", "u")
    )
    return _mean(run, X, U), float(np.median(reports))


def with_admm(run: Setup, iterations: int) -> tuple[float, float]:
    """Return mean stage cost and mean processor time of an agent at a tick, ms, of AgentLib-MPC."""
    from benchmarks.peers import with_agentlib

    with quiet():
        X, U, taken_s = with_agentlib.fly(run, iterations)
    return _mean(run, X, U), 1e3 * taken_s / run.ticks / run.system.N


def _mean(run: Setup, X: Array, U: Array) -> float:
    cost, y = StageCost(run), run.model.outputs_along(X)
    return float(
        np.mean([cost.at(tick, y[tick], run.Y_ref[tick], U[tick]) for tick in range(len(X))])
    )


def _rows(horizon: int) -> Iterator[tuple[str, Callable[[], tuple[float, float]], str]]:
    """Yield each controller's name, a flight with it, and the file that states its problem."""
    common = (MANEUVER, f"controller.horizon={horizon}")
    yield "centralized", lambda: flown(setup("centralized", *common)), ""
    yield "paper, an agent each", lambda: flown(setup("paper", *common)), ""
    own = "agents.controller=benchmarks.peers.with_do_mpc:Centralized"
    yield "do-mpc, centralized", lambda: flown(setup("centralized", *common, own)), "with_do_mpc.py"
    for count in ITERATIONS:
        yield (
            f"AgentLib-MPC, an agent each, {count} iterations of ADMM",
            partial(with_admm, setup("paper", *common), count),
            "with_agentlib.py",
        )


def main() -> int:
    """Fly all controllers, print the table or write it; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--horizon", type=int, default=10, help="N_p of all controllers (10)")
    parser.add_argument(
        "--document",
        type=Path,
        help=f"file to write, such as docs/{DOCUMENT.name}; by default none",
    )
    options = parser.parse_args()
    # Of the other frameworks: optional parts that are not installed.
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    if options.document:
        place(options.document, "bench: peers")
    rows, first = [], None
    try:
        for name, fly, file in _rows(options.horizon):
            cost, step_ms = fly()
            first = first or (cost, step_ms)
            lines = str(_statements(HERE / file)) if file else "scenario file"
            rows.append(
                (name, f"{cost / first[0]:.3f}", digits(step_ms), digits(step_ms / first[1]), lines)
            )
            print(*rows[-1], sep=", ", file=sys.stderr, flush=True)  # noqa: T201
    except (ImportError, BenchmarkError) as error:
        sys.stderr.write(
            f"benchmarks.peers: {error} (packages: pip install 'payload-transport[bench]')\n"
        )
        return 1
    columns = ("controller", "cost", "step, ms", "step, times the first", "lines")
    content = f"{TEXT.format(horizon=options.horizon)}\n\n{table(columns, rows)}\n\n*{origin()}.*"
    if options.document:
        put(options.document, "bench: peers", content)
    else:
        sys.stdout.write(f"{content}\n")
    return 0


def _statements(file: Path) -> int:
    """Return the lines of a file that are neither empty nor comments."""
    return sum(
        bool(line.strip()) and not line.strip().startswith("#")
        for line in file.read_text().splitlines()
    )


if __name__ == "__main__":
    sys.exit(main())
