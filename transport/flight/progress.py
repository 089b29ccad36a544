"""Progress on the console: compilation before a run; simulated time, real-time factor, cost, attitude."""

import time
from typing import Self

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn

from model.compiled import compile_functions, needs_compilation
from model.state import StateView
from protocol.scenario.setup import Setup
from protocol.scenario.stage_cost import StageCost
from protocol.wire.messages import PlantState

# Period of the lines without a terminal, wall time, s.
_LINE_EVERY_S = 10.0
# Widths on a terminal, characters: the bar, and the remaining time with the gaps between the columns.
_BAR, _REMAINING = 20, 10
_GAP = "   "
_COMPILING = "compiling the model for this processor, once"


def compile_model(uavs: int, console: Console) -> None:
    """Compile the model of a team of that many UAVs, and say so, if that has not been done on this processor."""
    if not needs_compilation(uavs):
        return
    if console.is_terminal:
        with console.status(_COMPILING):
            compile_functions(uavs)
    else:
        console.print(_COMPILING, highlight=False, soft_wrap=True)
        compile_functions(uavs)


class ConsoleProgress:
    """A progress bar on a terminal, a line every 10 s elsewhere; on standard error, as results go to stdout."""

    def __init__(self, console: Console, *columns: ProgressColumn) -> None:
        self._console = console
        self._bar = Progress(*columns, console=console, transient=True) if console.is_terminal else None
        self._next_line_s = time.monotonic() + _LINE_EVERY_S

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def say(self, line: str) -> None:
        """Write a line, above the bar."""
        self._console.print(line, highlight=False, soft_wrap=True)

    def _is_line_due(self) -> bool:
        """Return whether a line is due without a terminal, and schedule the next."""
        now_s = time.monotonic()
        is_due = now_s >= self._next_line_s
        if is_due:
            self._next_line_s = now_s + _LINE_EVERY_S
        return is_due


class RunProgress(ConsoleProgress):
    """Progress of a run: `setup`, with its targets so far."""

    def __init__(self, setup: Setup, console: Console, waiting: str = "waiting for the processes") -> None:
        names = [phase.name for phase in setup.scenario.maneuver.phase]
        self._description = max(map(len, ["starting", *names]))
        columns = (
            TextColumn(f"{{task.description:<{self._description}}}"),
            BarColumn(bar_width=_BAR),
            TextColumn("{task.fields[status]}"),
        )
        super().__init__(console, *columns, TimeRemainingColumn())
        self.setup, self._cost = setup, StageCost(setup)
        self._duration_s = setup.ticks * setup.settings.sampling_period_s
        if self._bar is not None:
            self._task = self._bar.add_task("starting", total=self._duration_s, status=waiting)

    def show(self, plant_state: PlantState | None, started_s: float | None) -> None:
        """Draw the newest state, None before the first, given the steady-clock time of the first, s."""
        if plant_state is None or started_s is None:
            return
        t_s = plant_state.tick * self.setup.settings.sampling_period_s
        if self._bar is not None:
            status = self._status(plant_state, t_s, time.monotonic() - started_s)
            width = self._console.width - self._description - _BAR - _REMAINING
            while len(status) > 1 and len(_GAP.join(status)) > width:  # a wider line would hide the bar
                status.pop()
            phase = self.setup.maneuver.phase_at(t_s).name
            self._bar.update(self._task, completed=t_s, description=phase, status=_GAP.join(status))
        elif self._is_line_due():
            self.say(_GAP.join(self._status(plant_state, t_s, time.monotonic() - started_s)))

    def _status(self, plant_state: PlantState, t_s: float, wall_s: float) -> list[str]:
        """Return the parts of a line, the most important first."""
        y_ref = self.setup.reference.outputs(np.array([t_s]))[0]
        cost = self._cost.at(plant_state.tick, self.setup.model.outputs(plant_state.x), y_ref, plant_state.u)
        attitude_deg = float(np.degrees(np.abs(StateView(plant_state.x).Theta0)).max())
        factor = t_s / wall_s if wall_s > 0.0 else 0.0
        times = [f"{t_s:5.1f} of {self._duration_s:.1f} s", f"{factor:5.1f}x real time"]
        return [*times, f"cost {cost:.5f}", f"attitude {attitude_deg:.2f} deg"]
