"""The command `transport replay`: one agent of a recorded run again, as recorded or with other settings."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer
from rich.text import Text
from typer import Option

from agent.node import AgentNode
from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_DIFFERENT
from protocol.wire.messages import Measurement
from transport.analysis.replay import Comparison, Difference, Replay
from transport.cli.options import FormatOption, RunArgument, run_folder
from transport.cli.output import Format, blame, fail, rows, show
from transport.flight.header import versions
from transport.log.run_folder import RecordedRun, open_run
from transport.log.tables import INPUT_NAMES, RATE_NAMES
from transport.report.figures import draw_replay
from transport.report.report import write_csv

# Smaller differences of inputs, N or N m, are rounding: other numbers on the way to the same decision.
_ROUNDING = 1e-6
# Parts of a plan that replay.csv compares.
_PARTS = ("first_step", "horizon")


# Fixed values: the recorded messages fit no other number of UAVs, iterations or ticks.
_FIXED = (
    ("agents.owned", lambda setup: [[uav + 1 for uav in group] for group in setup.owned]),
    ("system.uav", lambda setup: f"{setup.system.N} UAVs"),
    ("controller.sampling_period_s", lambda setup: setup.settings.sampling_period_s),
    ("controller.negotiation_iterations", lambda setup: setup.scenario.controller.negotiation_iterations),
    ("clock.mode", lambda setup: setup.scenario.clock.mode),
    ("clock.actuation", lambda setup: "next_tick" if setup.scenario.clock.next_tick else "immediate"),
)


def replay(
    agent: int = Option(..., metavar="NUMBER", min=1, help="Number of the agent, from 1."),
    given: RunArgument = None,
    settings: list[str] | None = Option(
        None, "--set", metavar="KEY=VALUE", help="Replay with this change. Repeatable."
    ),
    against: str | None = Option(None, metavar="SCENARIO", help="Replay with this scenario's controller."),
    begin: int = Option(
        0, "--from", metavar="TICK", min=0, help="First tick to compare; earlier ticks are replayed too."
    ),
    end: int | None = Option(None, "--to", metavar="TICK", min=0, help="Last tick to compare."),
    stop_at: int | None = Option(None, "--pdb", metavar="TICK", min=0, help="Open the debugger before this tick."),
    out: Path | None = Option(None, metavar="FOLDER", help="Folder for replay.csv and, if plans differ, figures."),
    output: FormatOption = Format.text,
) -> None:
    """Feed a recorded run to one agent and compare its plans.

    The messages the agent received are taken from the log; its answers are compared with the recorded ones, bit for
    bit. Without --set or --against the plans of a lockstep run must be identical. With them the result is the first
    tick at which the plans differ, and by how much; the plant states are the recorded ones.

    Exit codes: 0 all plans identical, 8 plans differ, 2 nothing can be compared, 3 scenario.

    Example: transport replay runs/20260102-101500-paper --agent 2 --set controller.weights.attitude=6.0
    """
    if end is not None and end < begin:
        fail(f"--to: expected a tick not before --from {begin}, got {end}")
    run = open_run(run_folder(given))
    setup = _changed_setup(run, settings or [], against)
    if agent not in setup.agents:
        fail(f"--agent: expected an agent from 1 to {len(setup.agents)} of the run, got {agent}")

    stopped: list[int] = []

    def before(node: AgentNode, measurement: Measurement) -> None:
        if measurement.tick == stop_at:
            stopped.append(measurement.tick)
            typer.echo(f"{node.name} is about to receive the measurement of tick {measurement.tick}", err=True)
            breakpoint()  # the next call is node.receive(measurement, 0)

    again = Replay(setup, run.log, agent, before)
    comparison = Comparison(commands=RATE_NAMES if run.setup.system.commands_rates else INPUT_NAMES)
    # In real time the log does not record when the agent noticed a lost message.
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
        fail(f"{run.folder}: nothing to compare: {why}")
    files = [] if out is None else _write(run, comparison, out)
    is_changed = bool(settings or against)
    notes = list(_notes(run, again, comparison, is_changed=is_changed))
    verdict = [*_verdict(run, agent, comparison, is_changed=is_changed), *(f" {file}" for file in files)]
    if output is Format.text:
        for note in notes:
            typer.echo(f"note: {note}", err=True)
    show(output, _content(run, agent, comparison, notes), *verdict)
    raise typer.Exit(0 if comparison.first is None else EXIT_DIFFERENT)


def _changed_setup(run: RecordedRun, settings: list[str], against: str | None) -> Setup:
    """Return the recorded setup with changed values, or with the controller of another scenario.

    Raises: ScenarioError: it is refused, or the recorded messages do not fit it.
    """
    if not settings and against is None:
        return run.setup
    stray = [setting for setting in settings if not setting.startswith("controller.")]
    if against is not None and stray:
        fail(f"--set: with --against expected a value of the controller, got {stray[0]!r}")
    source = run.scenario_file if against is None else find_scenario(against)
    scenario = read_scenario(source, settings, allow_large=True)
    if against is not None:
        scenario = run.setup.scenario.model_copy(update={"controller": scenario.controller})
    # Files of measured delays are relative to the run folder.
    setup = Setup.of(scenario, str(run.scenario_file))
    for key, value_of in _FIXED:
        expected, got = value_of(run.setup), value_of(setup)
        if got != expected:
            raise ScenarioError(str(source), key, f"expected {expected} as in the run, got {got}")
    return setup


def _write(run: RecordedRun, comparison: Comparison, out: Path) -> list[Path]:
    """Write a row for each tick, and a figure of the differences; return the files."""
    turning, unit = ("rate", "rad_s") if run.setup.system.commands_rates else ("moment", "Nm")
    parts = [f"{what}_{part}_{of}" for part in _PARTS for what, of in (("thrust", "N"), (turning, unit))]
    columns = ["tick", "t_s", *parts, "differs"]
    period_s = run.setup.settings.sampling_period_s
    ticks = ([tick, tick * period_s, *apart, int(differs)] for tick, *apart, differs in comparison.rows)
    with blame("--out"):
        out.mkdir(parents=True, exist_ok=True)
        write_csv(out / "replay.csv", (dict(zip(columns, row, strict=True)) for row in ticks), columns)
    return [out / "replay.csv", *(draw_replay(run.setup, comparison, out) if comparison.first is not None else ())]


def _verdict(run: RecordedRun, agent: int, comparison: Comparison, *, is_changed: bool) -> Iterator[Any]:
    """Yield the verdict and the largest differences by field, as they are shown."""
    period_s, first = run.setup.settings.sampling_period_s, comparison.first
    span = f"ticks {comparison.ticks[0]} to {comparison.ticks[-1]}"
    if first is None:
        verdict = Text("identical, bit for bit", "bold green")
        yield Text.assemble(f"agent{agent}: all {comparison.plans} plans of {span} are ", verdict)
    else:
        differ = f"agent{agent}: {comparison.plans - comparison.identical} of {comparison.plans} plans of {span} "
        verdict = Text(f"differ from tick {first.tick} on", "bold yellow" if is_changed else "bold red")
        yield Text.assemble(differ, verdict, f" (t = {first.tick * period_s:.2f} s)")
        exchange = f" (with {first.negotiation} exchanges to come)" if first.negotiation else ""
        where = first.where if first.where.startswith("[") else ""
        apart = f", {_size(first)} apart" if first.size is not None else ""
        yield f"  first: {first.field}{where}: got {first.got}, expected {first.expected}{apart}{exchange}"
        tick = comparison.first_beyond(_ROUNDING)
        when = "at no tick" if tick is None else f"from tick {tick} on (t = {tick * period_s:.2f} s)"
        yield f"  by more than {_ROUNDING:g} N or N m: {when}"
    if comparison.by_field:
        yield rows([_row(name, found) for name, found in comparison.by_field.items()], "field", "which")


def _row(name: str, found: Sequence[Difference]) -> dict[str, Any]:
    largest = _largest(found)
    which = largest.where or f"{_short(largest.got)}, recorded {_short(largest.expected)}"
    counts = {"field": name, "ticks": _ticks(found), "first": found[0].tick}
    return {**counts, "largest": _size(largest), "at tick": largest.tick, "which": which}


def _ticks(found: Sequence[Difference]) -> int:
    return len({difference.tick for difference in found})


def _largest(found: Sequence[Difference]) -> Difference:
    return max(found, key=lambda difference: difference.size or 0.0)


def _size(difference: Difference) -> str:
    return "-" if difference.size is None else f"{difference.size:.3g}"


def _short(text: str) -> str:
    try:
        return f"{float(text):.3g}"
    except ValueError:
        return text


def _content(run: RecordedRun, agent: int, comparison: Comparison, notes: list[str]) -> dict[str, Any]:
    """Return the comparison as plain data."""
    return {
        "run": str(run.folder),
        "agent": agent,
        "ticks": [comparison.ticks[0], comparison.ticks[-1]],
        "plans": comparison.plans,
        "identical": comparison.identical,
        "first": None if comparison.first is None else asdict(comparison.first),
        "first_tick_beyond_rounding": comparison.first_beyond(_ROUNDING),
        "fields": {
            name: {"ticks": _ticks(found), "first_tick": found[0].tick, "largest": asdict(_largest(found))}
            for name, found in comparison.by_field.items()
        },
        "not_compared": comparison.unrecorded,
        "notes": notes,
    }


def _notes(run: RecordedRun, again: Replay, comparison: Comparison, *, is_changed: bool) -> Iterator[str]:
    """Yield the limits of the comparison, one sentence each."""
    yield from again.notes
    header, missing = run.log.header, comparison.unrecorded
    if missing:
        ticks = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        yield f"not compared, as the log has no answer of the agent (down, or at its end): tick {ticks}"
    if run.log.cut:
        yield f"log: {run.log.cut}"
    if run.setup.scenario.clock.mode == "realtime":
        yield (
            "real time: the plans that the agent had at each step are taken from its step reports. That is exact "
            "unless links have jitter, reordering or duplicates, or measurements are delayed; then the log does "
            "not tell all of them"
        )
    if again.refused and is_changed:
        yield f"refused by the changed agent: {'; '.join(again.refused)}"
    if comparison.first is not None and not is_changed:
        recorded, here = header.get("versions", ""), versions()
        if recorded != here:
            yield f"recorded with {recorded}; here {here}: last digits may differ between versions"
        machine = header.get("machine", "") or "an unknown machine"
        yield f"recorded on {machine}: last digits may differ between processors"
