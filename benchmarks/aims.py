"""The controller's step against its aims: in ms, against the centralized controller, against the naive step."""

from collections.abc import Callable, Sequence
from functools import partial
from unittest.mock import patch

import numpy as np

from benchmarks import naive
from benchmarks.effort import Effort
from benchmarks.page import Table
from benchmarks.runs import Situation, setup, situations, step_times
from benchmarks.solvers import EXACT, SAME
from benchmarks.timing import Times, in_turns, joined
from model import native
from model.arrays import Array
from mpc.settings import SolverName

# Largest difference of the naive step's plan from the controller's, in units of half an actuator's range: if both
# programs are solved by the controller's solver, and if the naive one is solved by Clarabel (`benchmarks.solvers`).
SAME_PROGRAM, SAME_PLAN = SAME, EXACT

PLAIN = "paper, kernels not compiled"

TEXT = (
    "Processor time of one step of one agent, four UAVs, N_p = 20: stages estimate to solve of the step reports. The "
    "three scenarios run in turns; a ratio is the median over the turns (least to most). The naive step forms the "
    "stacked matrices of the paper's (16), multiplies them out and solves with Clarabel; it is compared with "
    "`Controller.step` alone, without the estimate, in the same situations of a run, one ratio each. Its plans equal "
    "the controller's to {daqp:.0e} of half an actuator's range with the controller's solver, to {clarabel:.0e} with "
    "Clarabel."
)


def measure(effort: Effort, log: Callable[[str], None]) -> list[Table]:
    """Run and step in turns."""
    runs = {name: setup(name, effort.climb) for name in ("paper", "resilient", "centralized")}
    turns: dict[str, list[Times]] = {name: [] for name in (*runs, PLAIN)}
    for turn in range(effort.turns):
        log(f"runs of {', '.join(runs)}: {turn + 1} of {effort.turns}")
        for name, run in runs.items():
            turns[name].append(Times(step_times(run)[:, -1]))
        with patch.object(native, "AVAILABLE", False):
            turns[PLAIN].append(Times(step_times(runs["paper"])[:, -1]))

    log("naive step and the controller's in the same situations")
    met = situations(runs["paper"], effort.programs)
    steps = [
        in_turns({"naive": partial(naive.step, at), "own": partial(own_step, at)}, effort.repetitions) for at in met
    ]
    aims = {"paper": "at most 1.0 (3)", "resilient": "at most 0.45 (1.0)"}
    rows = [(f"agent, `{name}`", *joined(times).cells, aims.get(name, "")) for name, times in turns.items()]
    rows += [
        ("`Controller.step`, `paper`", *joined(step["own"] for step in steps).cells, ""),
        ("naive step, same plans", *joined(step["naive"] for step in steps).cells, ""),
        *(
            (f"centralized over `{name}`", _ratio(turns["centralized"], turns[name]), "", "at least 8 times")
            for name in aims
        ),
        (
            "naive over `Controller.step`",
            _ratio([step["naive"] for step in steps], [step["own"] for step in steps]),
            "",
            "at least 10 times",
        ),
        (f"`{PLAIN}` over `paper`", _ratio(turns[PLAIN], turns["paper"]), "", ""),
    ]
    daqp, clarabel = (max(plan_difference(at, solver) for at in met) for solver in ("daqp", "clarabel"))
    text = TEXT.format(daqp=daqp, clarabel=clarabel)
    return [Table(text=text, columns=("", "median, ms", "p99, ms", "aim"), rows=rows)]


def own_step(at: Situation) -> Array:
    """Return the inputs of the owned UAVs by the controller's step, (N_p, m_own)."""
    return at.controller.step(at.x0, at.u0, at.U, at.y_ref).U


def plan_difference(at: Situation, solver: SolverName = "clarabel") -> float:
    """Return the largest difference of the naive step's plan from the controller's, in half actuator ranges."""
    limits, uavs = at.controller.settings.limits, len(at.controller.owned)
    half = (limits.upper(uavs) - limits.lower(uavs)) / 2.0
    return float(np.abs((naive.step(at, solver) - own_step(at)) / half).max())


def _ratio(these: Sequence[Times], those: Sequence[Times]) -> str:
    ratios = [this.median / that.median for this, that in zip(these, those, strict=True)]
    return f"{np.median(ratios):.1f} times ({min(ratios):.1f} to {max(ratios):.1f})"
