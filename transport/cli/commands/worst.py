"""Command `transport worst`: search for the network that brings the team down."""

import textwrap
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer import Option

from transport.cli.options import RUNS, FormatOption, ScenarioArgument, SetOption
from transport.cli.output import Format, show
from transport.interface.setting_arguments import names_of
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.wire.errors_and_exit_codes import EXIT_DIVERGED
from transport.search.objective import MEASURES
from transport.search.search import SearchResult
from transport.search.search_options import DEFAULTS, SearchOptions, search
from transport.search.search_report import FIGURE, SCENARIO, in_words, ranked, summary
from transport.search.space import KINDS

_LINES = 5  # of the worst cases
_WIDTH = 100  # columns
_INDENTED: Any = {"initial_indent": " " * 8, "subsequent_indent": " " * 8}


def worst(
    scenario: ScenarioArgument = "resilient",
    settings: SetOption = None,
    budget: Annotated[
        int,
        Option(
            metavar="COUNT", min=1, help="Cases to simulate, in eights; a minimal case takes more."
        ),
    ] = DEFAULTS.budget,
    over: Annotated[
        str,
        Option(
            metavar="KINDS",
            help=f"Events to draw: {','.join(KINDS)}.",
        ),
    ] = ",".join(DEFAULTS.over),
    objective: Annotated[
        str,
        Option(
            metavar="NUMBER",
            help=f"What fails: {', '.join(MEASURES[:-1])} or {MEASURES[-1]}.",
        ),
    ] = DEFAULTS.objective,
    limit: Annotated[
        float | None, Option(metavar="VALUE", help="Value at which a run has failed.")
    ] = DEFAULTS.limit,
    bounds: Annotated[
        Path | None, Option(metavar="FILE", help="TOML file with bounds of the events.")
    ] = DEFAULTS.bounds,
    seed: Annotated[int, Option(metavar="SEED", min=0, help="Seed of the search.")] = DEFAULTS.seed,
    jobs: Annotated[
        int | None, Option(metavar="COUNT", min=1, help="Parallel runs; default: all cores.")
    ] = DEFAULTS.jobs,
    out: Annotated[
        Path | None,
        Option(
            metavar="FOLDER", help="Folder, by default a new one in runs/; resumed if it exists."
        ),
    ] = None,
    until_failure: Annotated[
        bool, Option("--until-failure", help="End with the first batch that has a failure.")
    ] = DEFAULTS.until_failure,
    strict: Annotated[
        bool,
        Option(
            "--strict", help="Exit code 6 if a case fails, unless it is shown to be beyond physics."
        ),
    ] = False,
    output: FormatOption = Format.text,
) -> None:
    """Search for the network that brings the team down.

    Draws silences, deaths, gusts or targets and simulates them in memory: quasi-random cases first,
    then those that CMA-ES derives from the worst. A case that fails is made minimal and written as
    a scenario, which gives the same bits in memory and with processes. Results: minimal.toml,
    minimal.png, summary.json, evaluations.jsonl.

    Example: transport worst resilient --over silence,gusts --budget 200
    """
    path = find_scenario(scenario)
    options = SearchOptions(
        over=names_of(over),
        budget=budget,
        objective=objective,
        limit=limit,
        bounds=bounds,
        seed=seed,
        until_failure=until_failure,
        jobs=jobs,
    )
    time_utc = datetime.now(UTC).strftime("%Y%m%d-%H%M%S")
    folder = out or RUNS / f"worst-{path.stem}-{time_utc}"
    start = read_scenario(path, settings or [])
    resumes = f"this command with --out {folder} resumes it after an interruption"
    typer.echo(f"searching: every case is kept in {folder}; {resumes}", err=True)
    result = search(start, str(path), options, folder, Console(stderr=True))

    content = {**summary(result), "folder": str(folder)}
    show(output, content, _in_words(result, folder))
    minimal = result.minimal
    if strict and minimal is not None and not minimal.verdict.beyond_physics:
        raise typer.Exit(EXIT_DIVERGED)


def _in_words(result: SearchResult, folder: Path) -> str:
    """Return a line for each of the worst cases, and the minimal one in words."""
    objective = result.problem.objective
    lines = ["worst cases (robustness: 1 far from failing, 0 at the limit, below 0 failed):"]
    for one in ranked(result)[:_LINES]:
        evaluation = one.evaluation
        value = objective.in_words(evaluation.value)
        case = f"case {one.number}, {value}: {evaluation.outcome}"
        lines.append(f"{evaluation.robustness:6.2f}  {case}")
        lines += textwrap.wrap(one.candidate.in_words(), _WIDTH, **_INDENTED)

    failures = f"{result.failures} of {len(result.cases)} cases fail"
    if result.refused:
        reason = result.refused[0].evaluation.reason
        lines += [
            "",
            f"{len(result.refused)} cases are refused and not simulated, such as: {reason}",
        ]
    if result.minimal is None:
        lines += ["", failures]
    else:
        lines += ["", f"{failures}, the first is case {result.first_failure}. Minimal case:"]
        lines += [f"  {sentence}" for sentence in in_words(result.minimal)]
        lines.append(f"{folder / SCENARIO}, {folder / FIGURE}")
    return "\n".join(lines)
