"""Progress on the console.

Compilation before a run; simulated time, real-time factor, cost, attitude.
"""

import time
from typing import Self

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn

from transport.model.compiled import compile_functions, needs_compilation
from transport.model.state import StateView
from transport.protocol.scenario.setup import Setup
from transport.protocol.scenario.stage_cost import StageCost
from transport.protocol.wire.messages import PlantState

# Period of the lines without a terminal, wall time, s.
_LINE_EVERY_S = 10.0


def compile_model(uavs: int, console: Console) -> None:
    """Compile the model of a team of that many UAVs, and say so, if that has not been done on this processor."""
    if needs_compilation(uavs):
        console.print(
            "compiling the model for this processor, once", highlight=False, soft_wrap=True
        )
        compile_functions(uavs)


class ConsoleProgress:
    """A progress bar on a terminal, a line every 10 s elsewhere.

    On standard error, as results go to stdout.
    """

    def __init__(self, console: Console, *columns: ProgressColumn) -> None:
        self._console = console
        self._bar = Progress(
            *columns, console=console, transient=True, disable=not console.is_terminal
        )
        self._next_line_s = time.monotonic() + _LINE_EVERY_S

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def say(self, line: str) -> None:
        """Write a line, above the bar."""
        self._console.print(line, highlight=False, soft_wrap=True)

    def _is_line_due(self) -> bool:
        is_due = not self._console.is_terminal and time.monotonic() >= self._next_line_s
        self._next_line_s += _LINE_EVERY_S * is_due
        return is_due


class RunProgress(ConsoleProgress):
    """Progress of a run: `setup`, with its targets so far."""

    def __init__(
        self, setup: Setup, console: Console, waiting: str = "waiting for the processes"
    ) -> None:
        super().__init__(
            console,
            BarColumn(bar_width=20),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
        )
        self.setup, self._cost = setup, StageCost(setup)
        self._duration_s = setup.ticks * setup.settings.sampling_period_s
        self._task = self._bar.add_task(waiting, total=self._duration_s)

    def show(self, plant_state: PlantState | None, started_s: float | None) -> None:
        """Draw the newest state, None before the first, given the steady-clock time of the first, s."""
        is_line_due = self._is_line_due()
        if (
            plant_state is None
            or started_s is None
            or not (is_line_due or self._console.is_terminal)
        ):
            return
        t_s, wall_s = (
            plant_state.tick * self.setup.settings.sampling_period_s,
            time.monotonic() - started_s,
        )
        y_ref = self.setup.reference.outputs(np.array([t_s]))[0]
        cost = self._cost.at(
            plant_state.tick, self.setup.model.outputs(plant_state.x), y_ref, plant_state.u
        )
        text = (
            f"{t_s:5.1f} of {self._duration_s:.1f} s   {t_s / max(wall_s, 1e-9):5.1f}x real time   cost {cost:.5f}   "
            f"attitude {float(np.degrees(np.abs(StateView(plant_state.x).Theta0)).max()):.2f} deg"
        )
        self._bar.update(self._task, completed=t_s, description=text)
        if is_line_due:
            self.say(text)
