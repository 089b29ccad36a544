"""Arguments and options that several commands have, and the scenario or run that they name."""

from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from transport.cli.lazy import load
from transport.cli.output import Format, fail
from transport.cli.setting_words import complete_setting
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup

# Runs are recorded here, and runs are looked for here, unless an option names another folder.
RUNS = Path("runs")
_LOG = "run.mcap"


def _scenarios(incomplete: str) -> list[str]:
    """Return the ready-made scenarios that begin like an incomplete word.

    The shell adds files itself.
    """
    folder = Path(__file__).parents[1] / "scenarios"
    return sorted(path.stem for path in folder.glob("*.toml") if path.stem.startswith(incomplete))


def complete_run(incomplete: str) -> list[str]:
    """Return the folders of runs that begin like an incomplete word, the most recent first."""
    return [str(folder) for folder in newest_runs() if str(folder).startswith(incomplete)]


ScenarioArgument = Annotated[
    str,
    Argument(
        metavar="SCENARIO",
        help="Scenario file, or name: paper, centralized, resilient, precise, centralized_lq, "
        "windy, delivery, collision, eight, gap, playground, alone.",
        autocompletion=_scenarios,
        show_default=True,
    ),
]
ScenarioOption = Annotated[
    str,
    Option(
        metavar="SCENARIO",
        help="Scenario file or name; the same for all processes.",
        autocompletion=_scenarios,
    ),
]
SetOption = Annotated[
    list[str] | None,
    Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a scenario value, e.g. controller.horizon=10. Repeatable.",
        autocompletion=complete_setting,
    ),
]
LargeOption = Annotated[
    bool,
    Option(
        "--allow-large", help="Accept a run beyond the limits on steps, memory and computation."
    ),
]
RunArgument = Annotated[
    Path | None,
    Argument(
        metavar="RUN",
        help="Run folder, or its name in runs/; by default the most recent one.",
        autocompletion=complete_run,
    ),
]
FormatOption = Annotated[
    Format, Option("--format", metavar="FORMAT", help="Output format: text or json.")
]
FiguresOption = Annotated[bool, Option("--figures/--no-figures", help="Draw the figures.")]


def _an_address(given: str) -> str:
    """Return an address; an empty one would listen on all."""
    if not given.strip():
        fail(f"--host: expected an address, such as 127.0.0.1 or 0.0.0.0, got {given!r}")
    return given


HostOption = Annotated[
    str,
    Option(
        callback=_an_address,
        metavar="ADDRESS",
        help="Address to listen on. Any host that reaches it can view and change the run.",
    ),
]
PortOption = Annotated[
    int, Option(metavar="PORT", min=0, max=65535, help="Port, or the next free one.")
]


def read_setup(
    scenario: str, settings: Sequence[str] | None = None, *, allow_large: bool = False
) -> Setup:
    """Return the setup of a scenario, file or name, with changes KEY=VALUE.

    With `allow_large` the run may exceed the limits on its size. The last setup is kept until its file
    changes: the fork server reads it for all processes of a run.

    Raises: ScenarioError: it is refused.
    """
    path = find_scenario(scenario)
    version_ns = path.stat().st_mtime_ns if path.exists() else 0
    return _setup(path, tuple(settings or ()), allow_large, version_ns)


def process_setup(
    scenario: str, settings: Sequence[str] | None = None, *, allow_large: bool = False
) -> Setup:
    """Return the setup as `read_setup` does, for a process of the run.

    At a set speed its time for a tick is limited: a target through way points finds its spline
    imported, which takes 0.3 s. As fast as possible all processes import it at the target's tick, and
    wait for each other: `clock.barrier_timeout_s` has to allow that.
    """
    setup = read_setup(scenario, settings, allow_large=allow_large)
    if setup.scenario.clock.speed > 0.0:
        load("scipy.interpolate")
    return setup


def forget_setup() -> None:
    """Have the next `read_setup` read anew: its model takes the functions compiled meanwhile."""
    _setup.cache_clear()


@lru_cache(maxsize=1)
def _setup(path: Path, settings: tuple[str, ...], allow_large: bool, _version_ns: int) -> Setup:
    """Read a setup; the version of the file is a key of the cache only."""
    scenario = read_scenario(path, settings, allow_large=allow_large)
    return Setup.of(scenario, str(path))


def newest_runs() -> list[Path]:
    """Return the folders below runs/ that hold a log, the most recently written first."""
    written_ns: dict[Path, int] = {}
    for log in RUNS.glob(f"*/{_LOG}"):
        if log.parent.is_symlink():  # `latest` is one of the others
            continue

        with suppress(OSError):  # the folder has gone meanwhile
            written_ns[log.parent] = log.stat().st_mtime_ns

    return sorted(written_ns, key=lambda folder: written_ns[folder], reverse=True)


def run_folder(given: Path | None) -> Path:
    """Return the folder of the run that was named, or of the most recent one.

    The most recent one is told on standard error.
    """
    if given is not None:
        for folder in (given, RUNS / given):
            if (folder / "experiment.json").exists():
                got = "one of an experiment, whose results are in report.md and points.csv"
                fail(f"{folder}: expected a run folder, got {got}")
            if folder.exists():
                return folder
        folders = newest_runs()
        known = [*map(str, folders), *(folder.name for folder in folders)]
        similar = get_close_matches(str(given), known, n=1)
        if similar:
            fail(f"{given}: no such run; did you mean {similar[0]}?")
        fail(f"{given}: no such run, neither here nor in {RUNS}/")

    runs = newest_runs()
    if not runs:
        fail(f"RUN: expected a run folder, got none, and there is no run in {RUNS}/")
    typer.echo(f"run: {runs[0]}", err=True)
    return runs[0]
