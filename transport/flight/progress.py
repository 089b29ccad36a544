"""Progress of a run on the console: simulated time, real-time factor, cost, attitude."""

import time
from types import TracebackType

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from model.state import StateView
from mpc.cost import Cost
from protocol.scenario.setup import Setup
from protocol.wire.messages import PlantState

# Period of the lines without a terminal, wall time, s.
_LINE_EVERY_S = 10.0


class RunProgress:
    """A progress bar on a terminal, a line every 10 s elsewhere.

    Args:
        setup: The run.
        console: Standard error, as standard output is for results.
    """

    def __init__(self, setup: Setup, console: Console) -> None:
        self._setup, self._console = setup, console
        self._cost = Cost(setup.settings.weights, setup.hover)
        self._duration_s = setup.ticks * setup.settings.sampling_period_s
        self._next_line_s = time.monotonic() + _LINE_EVERY_S
        self._bar: Progress | None = None
        if console.is_terminal:
            self._bar = Progress(
                TextColumn("{task.description:<9}"),
                BarColumn(),
                TextColumn("{task.fields[status]}"),
                TimeRemainingColumn(),
                console=console,
                transient=True,
            )
            self._task = self._bar.add_task("starting", total=self._duration_s, status="waiting for the processes")

    def __enter__(self) -> "RunProgress":
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, plant_state: PlantState | None, started_s: float | None) -> None:
        """Draw the newest state.

        Args:
            plant_state: Newest state, or None before the first.
            started_s: Steady-clock time of the first state, s.
        """
        if plant_state is None or started_s is None:
            return
        t_s = plant_state.tick * self._setup.settings.sampling_period_s
        now_s = time.monotonic()
        if self._bar is not None:
            status = self._status(plant_state, t_s, now_s - started_s)
            self._bar.update(self._task, completed=t_s, description=self._phase(t_s), status=status)
        elif now_s >= self._next_line_s:
            self._next_line_s = now_s + _LINE_EVERY_S
            self._console.print(self._status(plant_state, t_s, now_s - started_s), highlight=False)

    def say(self, line: str) -> None:
        """Write a line above the bar."""
        self._console.print(line, highlight=False)

    def _status(self, plant_state: PlantState, t_s: float, wall_s: float) -> str:
        y_ref = self._setup.reference.outputs(np.array([t_s]))[0]
        cost = self._cost.stage(self._setup.model.outputs(plant_state.x), y_ref, plant_state.u)
        attitude_deg = float(np.degrees(np.abs(StateView(plant_state.x).Theta0)).max())
        factor = t_s / wall_s if wall_s > 0.0 else 0.0
        return (
            f"{t_s:5.1f} of {self._duration_s:.1f} s   {factor:5.1f}x real time   "
            f"cost {cost:.5f}   attitude {attitude_deg:.2f} deg"
        )

    def _phase(self, t_s: float) -> str:
        begin = 0.0
        for phase in self._setup.maneuver.phases:
            begin += phase.duration_s
            if t_s < begin:
                return phase.name
        return self._setup.maneuver.phases[-1].name
