"""Progress of a run on the console: compilation, time, real-time factor, cost, attitude."""

import time
from collections.abc import Iterable
from typing import Self

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeRemainingColumn

from transport.model.kernels.casadi_functions import compile_functions, needs_compilation
from transport.model.physics.parameters import Kind
from transport.model.state import StateView
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.cost_of_run import StageCost
from transport.protocol.scenario.setup.model_objects import kinds_of
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState

# Period of the lines without a terminal, wall time, s.
_LINE_EVERY_S = 10.0


def compile_models(scenarios: Iterable[Scenario], console: Console) -> None:
    """Compile the models of the teams of scenarios, and say so.

    Nothing happens if they are compiled for this processor already.
    """
    kinds = set[Kind]().union(*(kinds_of(scenario) for scenario in scenarios))
    for kind in sorted(kinds):
        if needs_compilation(*kind):
            inputs = "body rates" if kind.rates else "moments"
            model = f"{inputs} and drag" if kind.drag else inputs
            text = f"compiling the model of {kind.N} UAVs with {model} for this processor, once"
            console.print(text, highlight=False, soft_wrap=True)
            compile_functions(*kind)


class ConsoleProgress:
    """Progress as a bar on a terminal, as a line every 10 s elsewhere.

    The console writes to standard error, as results go to standard output.
    """

    def __init__(self, console: Console, *columns: ProgressColumn) -> None:
        self._console = console
        is_disabled = not console.is_terminal
        self._bar = Progress(*columns, console=console, transient=True, disable=is_disabled)
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
        """Return whether to write a line now; if so, the next one is due a period later."""
        is_due = not self._console.is_terminal and time.monotonic() >= self._next_line_s
        if is_due:
            self._next_line_s += _LINE_EVERY_S
        return is_due


class RunProgress(ConsoleProgress):
    """Progress of a run: `setup`, with its targets so far."""

    def __init__(
        self, setup: Setup, console: Console, waiting: str = "waiting for the processes"
    ) -> None:
        columns = (
            BarColumn(bar_width=20),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
        )
        super().__init__(console, *columns)
        self.setup = setup
        self._cost = StageCost(setup)
        self._duration_s = setup.ticks * setup.settings.sampling_period_s
        self._task = self._bar.add_task(waiting, total=self._duration_s)

    def show(self, plant_state: PlantState | None, started_s: float | None) -> None:
        """Draw the newest state, None before the first.

        The steady-clock time of the first is `started_s`, s.
        """
        is_line_due = self._is_line_due()
        is_shown = is_line_due or self._console.is_terminal
        if plant_state is None or started_s is None or not is_shown:
            return

        t_s = plant_state.tick * self.setup.settings.sampling_period_s
        text = self._in_words(plant_state, t_s, wall_s=time.monotonic() - started_s)
        self._bar.update(self._task, completed=t_s, description=text)
        if is_line_due:
            self.say(text)

    def _in_words(self, plant_state: PlantState, t_s: float, wall_s: float) -> str:
        """Return time, real-time factor, cost and largest attitude angle of a state."""
        y = self.setup.model.outputs(plant_state.x)
        y_ref = self.setup.reference.outputs(np.array([t_s]))[0]
        cost = self._cost.at(plant_state.tick, y, y_ref, plant_state.u)
        attitude_deg = float(np.degrees(np.abs(StateView(plant_state.x).Theta0)).max())
        real_time_factor = t_s / max(wall_s, 1e-9)
        return (
            f"{t_s:5.1f} of {self._duration_s:.1f} s   {real_time_factor:5.1f}x real time   "
            f"cost {cost:.5f}   attitude {attitude_deg:.2f} deg"
        )
