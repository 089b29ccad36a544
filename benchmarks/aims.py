"""What the controller's step was to take, and takes: in ms, against one agent for all, against the naive step."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np

from benchmarks import naive
from benchmarks.effort import Effort
from benchmarks.flights import Situation, setup, situations, step_times
from benchmarks.page import Table
from benchmarks.solvers import EXACT, SAME
from benchmarks.timing import Times, digits, in_turns
from model import native
from model.arrays import Array
from mpc.settings import SolverName

# The naive step's plan may differ from the controller's by so much, in units of half an actuator's range: if the
# controller's solver solves its program, which is then the same one, and if Clarabel does (`benchmarks.solvers`).
SAME_PROGRAM, SAME_PLAN = SAME, EXACT

PLAIN = "paper, kernels not compiled"

TEXT = (
    "Processor time of one step of one agent, four UAVs, N_p = 20: estimate to solve as the step reports have it. "
    "The three scenarios fly in turns, and a ratio is the median of those of the turns, least and most behind it. The "
    "naive step forms the stacked matrices of the paper's (16), multiplies them out and asks Clarabel; beside it is "
    "`Controller.step` alone, without the estimate, in the same situations of a flight; a ratio for each situation."
)


def measure(effort: Effort, say: Callable[[str], None]) -> list[Table]:
    """Fly and step in turns."""
    flown = {name: setup(name, effort.climb) for name in ("paper", "resilient", "centralized")}
    turns: dict[str, list[Times]] = {name: [] for name in (*flown, PLAIN)}
    for turn in range(effort.flights):
        say(f"flights of {', '.join(flown)}: {turn + 1} of {effort.flights}")
        for name, run in flown.items():
            turns[name].append(Times(step_times(run)[:, -1]))
        with _plain_kernels():
            turns[PLAIN].append(Times(step_times(flown["paper"])[:, -1]))
    everything = {name: Times(np.concatenate([times.ms for times in of])) for name, of in turns.items()}

    say("naive step and the controller's on the same situations")
    met = situations(flown["paper"], effort.programs)
    steps = [
        in_turns({"naive": partial(naive.step, at), "own": partial(own_step, at)}, effort.repetitions) for at in met
    ]
    naive_times, own_times = (Times(np.concatenate([step[name].ms for step in steps])) for name in ("naive", "own"))
    slower = [step["naive"].median / step["own"].median for step in steps]

    rows = [
        (f"agent, `{name}`", digits(everything[name].median), digits(everything[name].p99), aim)
        for name, aim in (
            ("paper", "at most 1.0 (3)"),
            ("resilient", "at most 1.0 (3)"),
            ("centralized", ""),
            (PLAIN, ""),
        )
    ]
    rows += [
        ("`Controller.step`, `paper`", digits(own_times.median), digits(own_times.p99), ""),
        ("naive step, same plans", digits(naive_times.median), digits(naive_times.p99), ""),
        *(
            (f"centralized over `{name}`", _ratio(_over(turns["centralized"], turns[name])), "", "at least 8 times")
            for name in ("paper", "resilient")
        ),
        ("naive over `Controller.step`", _ratio(slower), "", "at least 10 times"),
        (f"`{PLAIN}` over `paper`", _ratio(_over(turns[PLAIN], turns["paper"])), "", ""),
    ]
    daqp, clarabel = (max(plan_difference(at, solver) for at in met) for solver in ("daqp", "clarabel"))
    text = (
        f"{TEXT} Its plans are the controller's to {daqp:.0e} of half an actuator's range with the controller's "
        f"solver, to {clarabel:.0e} with Clarabel."
    )
    return [Table(text=text, columns=("", "median, ms", "p99, ms", "aim"), rows=rows)]


@contextmanager
def _plain_kernels() -> Iterator[None]:
    """Do without the compiled kernels for a while."""
    before, native.AVAILABLE = native.AVAILABLE, False
    try:
        yield
    finally:
        native.AVAILABLE = before


def own_step(at: Situation) -> Array:
    """The controller's step in a situation: inputs of the owned UAVs, (N_p, m_own)."""
    return at.controller.step(at.x0, at.u0, at.U, at.y_ref).U


def plan_difference(at: Situation, solver: SolverName = "clarabel") -> float:
    """Largest difference of the naive step's plan from the controller's, in units of half an actuator's range."""
    limits, uavs = at.controller.settings.limits, len(at.controller.owned)
    half = (limits.upper(uavs) - limits.lower(uavs)) / 2.0
    return float(np.abs((naive.step(at, solver) - own_step(at)) / half).max())


def _over(these: Sequence[Times], those: Sequence[Times]) -> list[float]:
    return [this.median / that.median for this, that in zip(these, those, strict=True)]


def _ratio(ratios: Sequence[float]) -> str:
    return f"{np.median(ratios):.1f} times ({min(ratios):.1f} to {max(ratios):.1f})"
