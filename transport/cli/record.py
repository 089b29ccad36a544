"""The command `transport record`."""

from pathlib import Path
from typing import Annotated

from rich.console import Console
from typer import Option

from protocol.wire.names import RECORDER
from transport.cli.options import RUNS, FiguresOption, FormatOption, LargeOption, ScenarioOption, SetOption
from transport.cli.output import Format, exit_on, fail
from transport.cli.process import ConnectOption, JoinOption, ProcessOptions, RunNameOption
from transport.cli.run_report import report
from transport.flight.run import observe
from transport.flight.run_error import RunError
from transport.flight.run_files import new_folder


def record(
    scenario: ScenarioOption = "paper",
    settings: SetOption = None,
    run_name: RunNameOption = None,
    connect: ConnectOption = None,
    out: Annotated[Path | None, Option("--out", metavar="FOLDER", help="Run folder to create.")] = None,
    join_timeout: JoinOption = None,
    figures: FiguresOption = True,
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Record and report a run whose processes were started by hand.

    Start the recorder before the first tick: `transport coordinator --observer recorder` waits for it.

    Example: transport record --scenario paper --out runs/by-hand
    """
    options = ProcessOptions(
        scenario=scenario,
        settings=settings,
        run_name=run_name,
        connect=connect,
        join_timeout=join_timeout,
        allow_large=large,
    )
    setup = options.setup()
    place = options.place(setup, RECORDER)
    folder = out if out is not None else new_folder(RUNS, setup.scenario.name)
    with exit_on(RunError):
        finished = observe(setup, place, folder, Console(stderr=True))
    report(finished.folder, output, figures=figures, setup=setup)
    if finished.exit_code != 0:
        fail(finished.reason, finished.exit_code)
