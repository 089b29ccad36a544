"""Simulating a run, and loading a recorded one."""

import html
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, Self, Unpack

import tomli_w
from rich.console import Console

from protocol.scenario.file import ScenarioError
from protocol.scenario.setup import Setup
from protocol.scenario.targets import with_targets
from protocol.wire.exit_codes import EXIT_INTERRUPTED
from protocol.wire.messages import Message, PlantState, Target
from transport.flight import memory
from transport.flight.header import checked, run_header
from transport.flight.progress import RunProgress, compile_model
from transport.flight.run_files import RunError
from transport.interface.run import Run
from transport.interface.scenario import Scenario, path_phase
from transport.interface.settings import ArgumentError, Settings, ShortSettings, file_name, public
from transport.log.run_folder import open_run
from transport.log.run_log import Recorded, RunLog
from transport.report.report import write_report

# Shortest time between two updates, wall time, s.
_EVERY_S = 0.1


def console(*, shown: bool) -> Console:
    """Return the console for progress: standard error; in a notebook lines of text, neither a widget nor a terminal."""
    if _in_notebook():
        return Console(quiet=not shown, force_jupyter=False, force_terminal=False)
    return Console(stderr=True, quiet=not shown)


@contextmanager
def run_progress(setup: Setup, *, shown: bool) -> Iterator[Callable[[Message], None]]:
    """Show the progress of a run; yield the function that takes each of its messages."""
    if not shown:
        yield lambda _: None
        return
    began_s = next_s = time.monotonic()
    in_cell = _in_notebook()
    with _CellProgress(setup) if in_cell else RunProgress(setup, console(shown=True), waiting="in memory") as bar:

        def take(message: Message) -> None:
            nonlocal next_s
            if isinstance(message, Target):
                bar.setup = with_targets(bar.setup, [message])
            elif isinstance(message, PlantState) and time.monotonic() >= next_s:
                next_s = time.monotonic() + _EVERY_S
                bar.show(message, began_s)

        yield take


class _CellProgress:
    """Progress in the output of a notebook's cell, without widgets, and the duration at the end."""

    def __init__(self, setup: Setup) -> None:
        from IPython.display import HTML, display  # in every notebook

        self.setup = setup
        self._html: Any = HTML
        self._handle: Any = display(HTML("<pre>starting</pre>"), display_id=True)
        self._name, self._began_s = html.escape(setup.scenario.name), time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        duration_s = time.monotonic() - self._began_s
        self._handle.update(self._html(f"<pre>{self._name}: {duration_s:.1f} s of wall time</pre>"))

    def show(self, plant_state: PlantState, _: float) -> None:
        share, period_s = plant_state.tick / self.setup.ticks, self.setup.settings.sampling_period_s
        times = f"{plant_state.tick * period_s:.1f} of {self.setup.ticks * period_s:.1f} s"
        self._handle.update(self._html(f'<progress value="{share:.3f}"></progress> {self._name}: {times}'))


def _in_notebook() -> bool:
    """Return whether this process is the kernel of a notebook."""
    ipython: Any = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


RUNS = Path("runs")


@public
def fly(
    scenario: "str | PathLike[str] | Scenario" = "paper",
    settings: Settings | None = None,
    *,
    processes: bool = False,
    folder: "str | PathLike[str] | None" = None,
    progress: bool = True,
    path: Sequence[Sequence[float]] | None = None,
    **short: Unpack[ShortSettings],
) -> Run:
    """Simulate a run and return it, also if it diverges.

    In memory by default: the whole team in this process, unpaced, nothing written, with the same results bit for bit as
    with processes. With `processes=True` each agent, the plant and the coordinator is a process of its own, as in
    `transport run`, recorded into a run folder.

    >>> import transport
    >>> hover = [{"name": "hover", "duration_s": 0.5, "displacement_m": [0.0, 0.0, 0.0]}]
    >>> run = transport.fly("resilient", {"links.delay_s": 0.2}, horizon=10, phases=hover)
    >>> run.completed, run.scenario.links.delay_s, run.scenario.controller.horizon
    (True, 0.2, 10)
    >>> transport.fly("resilient", horizn=10)
    Traceback (most recent call last):
        ...
    transport.interface.settings.ArgumentError: horizn: expected a dotted key such as 'links.delay_s' or a short name; \
did you mean 'horizon'?

    Args:
        scenario: Scenario file, name of one that comes with the package, or a `Scenario`.
        settings: Changes by dotted key; list entries count from 1.
        processes: Start a process for each part of the run.
        folder: Run folder to create; by default none in memory, and runs/<time>-<scenario> with processes.
        progress: Show the progress on standard error, or in the notebook.
        path: Path of the payload in place of the maneuver: rows of time and position, (t_s, x_m, y_m, z_m), as an array
            or a list; both count from the first row. Between rows at constant speed; with a flat reference a spline
            through them, so a few rows are enough.
        short: Changes by short name (`transport.interface.settings.KEY_OF`), such as `horizon=10`.

    Raises: ScenarioError: the scenario or a setting is refused. ArgumentError: an argument is. RunError, HarnessError:
        the processes cannot be started. KeyboardInterrupt: Ctrl-C; no process is left.
    """
    # A setup of its own: the compiled functions of a setup must not be used by two threads.
    flown = Scenario(scenario, settings, **short)
    if path is not None:
        flown.set(phases=[path_phase(path, flat=flown.maneuver.reference == "flat")])
    setup = Setup.of(flown.validated, str(flown.file))
    target = None if folder is None else Path(file_name(folder, "folder"))
    if target is not None and target.exists():
        raise ArgumentError(f"folder: expected a folder that does not exist yet, got {target}")
    if processes:
        return _with_processes(flown, setup, target, shown=progress)
    if flown.clock.mode != "lockstep":
        expected = "expected lockstep in memory, where no time passes (processes=True runs in real time)"
        raise ScenarioError(str(flown.file), "clock.mode", f"{expected}, got {flown.clock.mode}")
    run = _in_memory(flown, setup, shown=progress)
    if target is not None:
        run.save(target)
    return run


@public
def load(folder: "str | PathLike[str]") -> Run:
    """Return a recorded run from its folder, also one that was cut off: `run.summary["log_cut"]` tells.

    >>> import transport
    >>> transport.load("runs/none")
    Traceback (most recent call last):
        ...
    transport.log.run_log.LogError: runs/none/run.mcap: cannot read the log (No such file or directory)

    Raises: LogError: no run folder, or a log that cannot be read. ScenarioError: its scenario cannot be read.
    """
    path = Path(file_name(folder, "folder"))
    recorded = open_run(path)
    return Run(Scenario(recorded.scenario_file, allow_large=True), recorded.setup, recorded.log, path)


def _in_memory(scenario: Scenario, setup: Setup, *, shown: bool) -> Run:
    began_ns = time.time_ns()
    compile_model(setup.system.N, console(shown=shown))
    header = run_header(setup, setup.scenario.name, 1, tomli_w.dumps(setup.scenario.tree()), checked(setup))
    messages: list[Recorded] = []
    with run_progress(setup, shown=shown) as show:

        def record(message: Message) -> None:
            messages.append(Recorded(message=message, received_ns=time.time_ns()))
            show(message)

        memory.simulate(setup, record)
    log = RunLog(header={**header, "command_started_ns": str(began_ns)}, messages=tuple(messages), cut="")
    return Run(scenario, setup, log)


def _with_processes(scenario: Scenario, setup: Setup, folder: Path | None, *, shown: bool) -> Run:
    # Imported when needed: a run in memory starts no process.
    from transport.flight import run as processes_run
    from transport.flight.fork_server import close_fork_server
    from transport.flight.run_files import new_folder

    target = new_folder(RUNS, setup.scenario.name) if folder is None else folder
    try:
        finished = processes_run.simulate(setup, target, console(shown=shown))
    except RunError as error:
        if error.exit_code == EXIT_INTERRUPTED:
            raise KeyboardInterrupt(str(error)) from None
        raise
    finally:
        close_fork_server()
    write_report(finished.folder, setup=setup)
    if finished.exit_code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt(f"interrupted; recorded in {finished.folder}")
    return Run(scenario, setup, open_run(finished.folder, setup=setup).log, finished.folder)
