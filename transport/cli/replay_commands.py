"""The command `transport replay`: one agent of a recorded run again, as it was or as it might have been."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.wire.exit_codes import EXIT_DIFFERENT, EXIT_SCENARIO, EXIT_USAGE
from transport.cli.answers import Format, fail, show_json

if TYPE_CHECKING:
    from agent.node import AgentNode
    from protocol.scenario.setup import Setup
    from protocol.wire.messages import Measurement
    from transport.analysis.replay import Replay
    from transport.analysis.replay_compare import Comparison, Difference
    from transport.log.run_folder import RecordedRun


# Differences of inputs below are rounding: other numbers on the way to the same decision.
_FELT = 1e-6

# What cannot be another's: the messages of the run are of this number of UAVs, rounds, ticks.
_FIXED = (
    ("agents.owned", lambda setup: [[uav + 1 for uav in group] for group in setup.owned]),
    ("system.uav", lambda setup: f"{setup.system.N} UAVs"),
    ("controller.sampling_period_s", lambda setup: setup.settings.sampling_period_s),
    ("controller.negotiation_iterations", lambda setup: setup.scenario.controller.negotiation_iterations),
    ("clock.mode", lambda setup: setup.scenario.clock.mode),
    ("clock.actuation", lambda setup: "next_tick" if setup.scenario.clock.next_tick else "immediate"),
)


def replay(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    agent: Annotated[int, typer.Option("--agent", min=1, help="Which agent, from 1.")],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="What if this value were another? Repeatable."),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option("--against", metavar="SCENARIO", help="What if its controller were that of another scenario?"),
    ] = None,
    begin: Annotated[int, typer.Option("--from", min=0, help="First tick to compare; those before are fed too.")] = 0,
    end: Annotated[int | None, typer.Option("--to", min=0, help="Last tick to compare.")] = None,
    stop_at: Annotated[
        int | None,
        typer.Option("--pdb", min=0, metavar="TICK", help="Open the debugger as the agent gets this measurement."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for replay.csv (a row per tick) and, if any differ, figures.")
    ] = None,
    output: Annotated[Format, typer.Option("--format", help="What goes to standard output.")] = Format.text,
) -> None:
    """Feed a recorded run to one agent and compare its plans.

    What the agent heard is taken from the run's log; what it says is compared with what it said, bit for bit. Without
    --set or --against the plans of a lockstep run must be identical. With them it says from which tick on, and how
    far, that agent would have decided otherwise in the same situation: the flight itself stays the recorded one.

    Exit codes: 0 all plans identical, 8 plans differ, 2 nothing can be compared, 3 scenario.

    Example: transport replay runs/20260102-101500-paper --agent 2 --set controller.weights.attitude=6.0
    """
    from protocol.scenario.file import ScenarioError
    from transport.analysis.replay import Replay
    from transport.analysis.replay_compare import Comparison
    from transport.log.run_folder import open_run
    from transport.log.run_log import LogError

    if end is not None and end < begin:
        fail(f"--to: expected a tick not before --from {begin}, got {end}", EXIT_USAGE)
    try:
        run = open_run(folder)
        setup = _what_if(run, settings or [], against)
    except LogError as error:
        fail(str(error), EXIT_USAGE)
    except ScenarioError as error:
        fail(str(error.blaming(settings or [])), EXIT_SCENARIO)
    if agent not in setup.agents:
        known = f"1 to {len(setup.agents)} of the run"
        fail(f"--agent: expected an agent from {known}, got {agent}", EXIT_USAGE)

    stopped: list[int] = []

    def before(node: "AgentNode", measurement: "Measurement") -> None:
        if measurement.tick == stop_at:
            stopped.append(measurement.tick)
            _pause(node, measurement)

    again = Replay(setup, run.log, agent, before)
    comparison = Comparison()
    # When a loss was noticed depends, in real time, on instants that nobody recorded.
    ignored = ("report.lost",) if setup.scenario.clock.mode == "realtime" else ()
    for step in again.steps():
        if end is not None and step.tick > end:
            break
        if step.tick >= begin:
            comparison.add(step, ignored=ignored)
    if stop_at is not None and not stopped:
        again.notes.append(f"--pdb: the agent has no measurement of tick {stop_at} that could be replayed")
    if not comparison.ticks:
        why = "; ".join(again.notes) or f"the log has no plan of agent {agent} between those ticks"
        fail(f"{run.folder}: nothing to compare: {why}", EXIT_USAGE)
    files = [] if out is None else _files(run, comparison, out)
    if output is Format.json:
        show_json(_summary(run, agent, again, comparison))
    else:
        _show(run, agent, again, comparison, asked=bool(settings or against))
        for file in files:
            typer.echo(f" {file}")
    raise typer.Exit(0 if comparison.first is None else EXIT_DIFFERENT)


def _pause(node: "AgentNode", measurement: "Measurement") -> None:
    """Open the debugger: `node.receive(measurement, 0)` is what comes next."""
    typer.echo(f"{node.name} is about to receive the measurement of tick {measurement.tick}", err=True)
    breakpoint()


def _what_if(run: "RecordedRun", settings: list[str], against: str | None) -> "Setup":
    """The run as it was flown, or with another value or another scenario's controller.

    Raises: ScenarioError: it cannot be, or the messages of the run are not for it.
    """
    from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
    from protocol.scenario.setup import Setup

    if not settings and against is None:
        return run.setup
    source = str(run.scenario_file)
    if against is None:
        scenario = read_scenario(run.scenario_file, settings)
    else:
        stray = [setting for setting in settings if not setting.startswith("controller.")]
        if stray:
            fail(f"--set: with --against expected a value of the controller, got {stray[0]!r}", EXIT_USAGE)
        path = find_scenario(against)
        source = str(path)
        scenario = run.setup.scenario.model_copy(update={"controller": read_scenario(path, settings).controller})
    # Files of measured delays are named from the run's folder on.
    setup = Setup.of(scenario, str(run.scenario_file))
    for key, of in _FIXED:
        expected, got = of(run.setup), of(setup)
        if got != expected:
            raise ScenarioError(source, key, f"expected {expected} as in the run, got {got}")
    return setup


def _show(run: "RecordedRun", agent: int, again: "Replay", comparison: "Comparison", *, asked: bool) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    period_s = run.setup.settings.sampling_period_s
    span = f"ticks {comparison.ticks[0]} to {comparison.ticks[-1]}"
    first = comparison.first
    if first is None:
        verdict = Text("identical, bit for bit", "bold green")
        console.print(Text.assemble(f"agent{agent}: all {comparison.plans} plans of {span} are ", verdict))
    else:
        differ = comparison.plans - comparison.identical
        verdict = Text(f"differ from tick {first.tick} on", "bold yellow" if asked else "bold red")
        console.print(
            Text.assemble(
                f"agent{agent}: {differ} of {comparison.plans} plans of {span} ",
                verdict,
                f" (t = {first.tick * period_s:.2f} s)",
            )
        )
        typer.echo(f"  {_sentence(first)}")
        felt = comparison.first_beyond(_FELT)
        when = "at no tick" if felt is None else f"from tick {felt} on (t = {felt * period_s:.2f} s)"
        typer.echo(f"  by more than {_FELT:g} N or N m: {when}")
    if comparison.tallies:
        table = Table(box=None, pad_edge=True, title="", show_edge=False)
        for column in ("field", "ticks", "first", "largest", "at tick", "which"):
            table.add_column(column, justify="left" if column in ("field", "which") else "right")
        for name, tally in comparison.tallies.items():
            largest = tally.largest
            size = "-" if largest.size is None else f"{largest.size:.3g} {largest.unit}".strip()
            where = largest.where or f"{_short(largest.got)}, recorded {_short(largest.expected)}"
            table.add_row(
                name, str(tally.ticks), str(tally.first.tick), size, str(largest.tick), Text(where, overflow="ellipsis")
            )
        console.print(table)
    for note in _remarks(run, again, comparison, asked=asked):
        typer.echo(f"note: {note}", err=True)


def _short(text: str) -> str:
    try:
        return f"{float(text):.3g}"
    except ValueError:
        return text


def _sentence(first: "Difference") -> str:
    size = "" if first.size is None else f", {first.size:.3g} {first.unit}".rstrip() + " apart"
    exchange = f" (with {first.negotiation} exchanges to come)" if first.negotiation else ""
    where = f"{first.where}: " if first.where.startswith("[") else ": "
    return f"first: {first.field}{where}got {first.got}, expected {first.expected}{size}{exchange}".replace(
        "]: ", "]: "
    )


def _remarks(run: "RecordedRun", again: "Replay", comparison: "Comparison", *, asked: bool) -> list[str]:
    """What people have to know to believe the result."""
    found = list(again.notes)
    if comparison.unrecorded:
        ticks = ", ".join(map(str, comparison.unrecorded[:8])) + (", ..." if len(comparison.unrecorded) > 8 else "")
        found.append(
            f"not compared, as the log has no answer of the agent (it was down, or its last words): tick {ticks}"
        )
    if run.log.cut:
        found.append(f"log: {run.log.cut}")
    if run.setup.scenario.clock.mode == "realtime":
        found.append(
            "real time: which plans the agent had at each step is taken from its step reports. That is exact unless "
            "links have jitter, reordering or duplicates, or measurements are delayed; then the log does not say it all"
        )
    if again.refused and asked:
        found.append(f"refused by the agent as it is now: {'; '.join(again.refused)}")
    if comparison.first is not None and not asked:
        recorded, here = run.log.header.get("versions", ""), _versions_here()
        if recorded != here:
            found.append(f"recorded with {recorded}; here {here}: last digits may differ between versions")
        machine = run.log.header.get("machine", "")
        found.append(f"recorded on {machine or 'an unknown machine'}: last digits may differ between processors")
    return found


def _versions_here() -> str:
    from transport.flight.run import versions

    return versions()


def _summary(run: "RecordedRun", agent: int, again: "Replay", comparison: "Comparison") -> dict[str, Any]:
    from dataclasses import asdict

    first = comparison.first
    return {
        "run": str(run.folder),
        "agent": agent,
        "ticks": [comparison.ticks[0], comparison.ticks[-1]],
        "plans": comparison.plans,
        "identical": comparison.identical,
        "first": None if first is None else asdict(first),
        "first_tick_beyond_rounding": comparison.first_beyond(_FELT),
        "fields": {
            name: {"ticks": tally.ticks, "first_tick": tally.first.tick, "largest": asdict(tally.largest)}
            for name, tally in comparison.tallies.items()
        },
        "not_compared": comparison.unrecorded,
        "notes": _remarks(run, again, comparison, asked=False),
    }


def _files(run: "RecordedRun", comparison: "Comparison", out: Path) -> list[Path]:
    """Write a row for each tick, and a figure of how far the plans are apart."""
    import csv

    period_s = run.setup.settings.sampling_period_s
    try:
        out.mkdir(parents=True, exist_ok=True)
        table = out / "replay.csv"
        with table.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            first = ("thrust_first_step_N", "moment_first_step_Nm", "thrust_horizon_N", "moment_horizon_Nm")
            writer.writerow(["tick", "t_s", *first, "differs"])
            for tick, *apart, differs in comparison.rows:
                writer.writerow([tick, tick * period_s, *apart, int(differs)])
    except OSError as error:
        fail(f"--out: cannot write to {out} ({error.strerror})", EXIT_USAGE)
    if comparison.first is None:
        return [table]
    from transport.report.replay_figure import draw_replay

    return [table, *draw_replay(run.setup, comparison, out)]
