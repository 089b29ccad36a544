"""Options that select an active run, the run they select, and requests to it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from transport.cli.options import RUNS
from transport.cli.output import fail
from transport.flight import active_runs
from transport.protocol.wire.key_expressions import Keys

RunOption = Annotated[
    str | None,
    Option(
        "--run",
        metavar="RUN",
        help="Run folder or name; by default the most recent active run, in runs/ or else "
        "anywhere.",
    ),
]
ConnectOption = Annotated[
    list[str] | None,
    Option(
        "--connect",
        metavar="ENDPOINT",
        help="Zenoh endpoint of a process; then --run is the run's name.",
    ),
]
KeysOption = Annotated[
    Path | None,
    Option(
        "--keys",
        metavar="FOLDER",
        help="Folder of keys, with --connect; a run folder knows its keys.",
    ),
]


def find_active(run: str | None, advice: str) -> tuple[Path, active_runs.LiveRun]:
    """Return folder and addresses of an active run; or end the command with advice.

    By default that is the most recent one in runs/, or else of this user in any folder, which is
    told on standard error.
    """
    if run is None:
        newest = active_runs.newest_folder(RUNS)
        folders = [] if newest is None else [newest]
    else:
        folders = [Path(run), RUNS / run]

    active = next((folder for folder in folders if active_runs.read(folder) is not None), None)
    addresses = None if active is None else active_runs.read(active)
    if active is None or addresses is None:
        fail(f"no active run in {run or f'{RUNS}/ or elsewhere'}; {advice}")

    if run is None and active.parent != RUNS:
        typer.echo(f"run: {active}", err=True)
    return active, addresses


@dataclass(frozen=True, slots=True, kw_only=True)
class ActiveRunOption:
    """Options that select an active run."""

    run: RunOption = None
    connect: ConnectOption = None
    keys: KeysOption = None

    def ask(self, name: str, what: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Return the answer of a process to a request (docs/reference/protocol.md), or end the command."""
        if self.connect:
            if not (self.run and Keys.allows(self.run)):
                fail(f"--run: expected the name of a run with --connect, got {self.run!r}")
            return active_runs.request(self.run, self.connect, name, what, arguments, self.keys)

        advice = "name its folder with --run, or its endpoints with --connect"
        _, active = find_active(self.run, advice)
        if name not in active.endpoints:
            fail(f"--process: expected one of {', '.join(active.endpoints)}, got {name!r}")
        return active.ask(name, what, arguments, self.keys)


def process_name(end: str) -> str:
    """Return the name of a process given as 2, agent2 or plant."""
    return f"agent{end}" if end.isdecimal() else end
