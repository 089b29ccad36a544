"""The active run that a command acts on: the options that select it, and requests to its processes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from protocol.wire.exit_codes import EXIT_UNREACHABLE, EXIT_USAGE
from protocol.wire.keys import Keys
from transport.cli.options import RUNS
from transport.cli.output import exit_on, fail
from transport.cli.recorded_run import newest_runs
from transport.flight import live
from transport.flight.live import RefusedError, UnansweredError, request

RunOption = Annotated[
    str | None,
    Option("--run", metavar="RUN", help="Run folder or name; by default the most recent active run in runs/."),
]
ConnectOption = Annotated[
    list[str] | None,
    Option("--connect", metavar="ENDPOINT", help="Zenoh endpoint of a process; then --run is the run's name."),
]
KeysOption = Annotated[
    Path | None, Option("--keys", metavar="FOLDER", help="Folder of keys, with --connect; a run folder knows its keys.")
]


def find_active(run: str | None, advice: str) -> tuple[Path, live.LiveRun]:
    """Return folder and addresses of an active run, the most recent one by default; or end the command with advice."""
    folders = [live.newest_folder(RUNS)] if run is None else [Path(run), RUNS / run]
    found = next(((at, there) for at in folders if at is not None and (there := live.read(at)) is not None), None)
    if found is None:
        recorded = newest_runs() if run is None else []
        ended = f" (the most recent one, {recorded[0]}, has ended)" if recorded else ""
        fail(f"no active run in {f'{RUNS}/' if run is None else run}{ended}; {advice}", EXIT_USAGE)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class ActiveRun:
    """Options that select an active run."""

    run: RunOption = None
    connect: ConnectOption = None
    keys: KeysOption = None

    def ask(self, name: str, what: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Return the answer of a process to a request (docs/protocol.md), or end the command."""
        with exit_on(UnansweredError, code=EXIT_UNREACHABLE), exit_on(RefusedError, code=EXIT_USAGE):
            if self.connect:
                if not (self.run and Keys.allows(self.run)):
                    fail(f"--run: expected the name of a run with --connect, got {self.run!r}", EXIT_USAGE)
                return request(self.run, self.connect, name, what, arguments, self.keys)
            _, there = find_active(self.run, "name its folder with --run, or its endpoints with --connect")
            if name not in there.endpoints:
                fail(f"--process: expected one of {', '.join(there.endpoints)}, got {name!r}", EXIT_USAGE)
            return there.ask(name, what, arguments, self.keys)
