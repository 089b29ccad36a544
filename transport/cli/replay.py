"""The command `transport replay`: one agent of a recorded run again, as recorded or with other settings."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer
from typer import Option

from transport.agent.node import AgentNode
from transport.analysis.replay import Comparison, Replay
from transport.cli.options import FormatOption, RunArgument, run_folder
from transport.cli.output import Format, blame, fail, rows, show
from transport.flight.run_files import machine, versions
from transport.log.run_log import RecordedRun, open_run
from transport.log.tables import INPUT_NAMES, RATE_NAMES
from transport.protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.exit_codes import EXIT_DIFFERENT
from transport.protocol.wire.messages import Measurement
from transport.report.figures import draw_replay

# Smaller differences of inputs, N or N m, are rounding: other numbers on the way to the same decision.
_ROUNDING = 1e-6

# Fixed values: the recorded messages fit no other number of UAVs, iterations or ticks.
_FIXED = (
    ("agents.owned", lambda setup: [[uav + 1 for uav in group] for group in setup.owned]),
    ("system.uav", lambda setup: f"{setup.system.N} UAVs"),
    ("controller.sampling_period_s", lambda setup: setup.settings.sampling_period_s),
    (
        "controller.negotiation_iterations",
        lambda setup: setup.scenario.controller.negotiation_iterations,
    ),
    ("clock.mode", lambda setup: setup.scenario.clock.mode),
    (
        "clock.actuation",
        lambda setup: "next_tick" if setup.scenario.clock.next_tick else "immediate",
    ),
)


def replay(
    agent: int = Option(..., metavar="NUMBER", min=1, help="Number of the agent, from 1."),
    given: RunArgument = None,
    settings: list[str] | None = Option(
        None, "--set", metavar="KEY=VALUE", help="Replay with this change. Repeatable."
    ),
    against: str | None = Option(
        None, metavar="SCENARIO", help="Replay with this scenario's controller."
    ),
    begin: int = Option(
        0,
        "--from",
        metavar="TICK",
        min=0,
        help="First tick to compare; earlier ticks are replayed too.",
    ),
    end: int | None = Option(None, "--to", metavar="TICK", min=0, help="Last tick to compare."),
    stop_at: int | None = Option(
        None, "--pdb", metavar="TICK", min=0, help="Open the debugger before this tick."
    ),
    out: Path | None = Option(
        None, metavar="FOLDER", help="Folder for a figure of the differences, if plans differ."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Feed a recorded run to one agent and compare its plans.

    The messages the agent received are taken from the log; its answers are compared with the recorded ones, bit for
    bit. Without --set or --against the plans of a lockstep run must be identical. With them the result is the first
    tick at which the plans differ, and by how much; the plant states are the recorded ones.

    Exit codes: 0 all plans identical, 8 plans differ, 2 nothing can be compared, 3 scenario.

    Example: transport replay runs/20260102-101500-paper --agent 2 --set controller.weights.attitude=6.0
    """
    run = open_run(run_folder(given))
    setup = _changed_setup(run, settings or [], against)
    if agent not in setup.agents:
        fail(f"--agent: expected an agent from 1 to {len(setup.agents)} of the run, got {agent}")

    def before(_: AgentNode, measurement: Measurement) -> None:
        if measurement.tick == stop_at:
            breakpoint()  # the next call is of the agent's `receive`

    again = Replay(setup, run.log, agent, before)
    comparison = Comparison(commands=RATE_NAMES if run.setup.system.commands_rates else INPUT_NAMES)
    # In real time the log does not record when the agent noticed a lost message.
    ignored = ("report.lost",) if setup.scenario.clock.mode == "realtime" else ()
    for step in again.steps():
        if end is not None and step.tick > end:
            break
        if step.tick >= begin:
            comparison.add(step, ignored=ignored)
    if not comparison.ticks:
        why = "; ".join(again.notes) or f"the log has no plan of agent {agent} between those ticks"
        fail(f"{run.folder}: nothing to compare: {why}")
    notes, first = (
        list(_notes(run, again, comparison, is_changed=bool(settings or against))),
        comparison.first,
    )
    files: list[Path] = []
    if out is not None and first is not None:
        with blame("--out"):
            out.mkdir(parents=True, exist_ok=True)
            files = draw_replay(run.setup, comparison, out)
    fields: list[dict[str, Any]] = [
        {
            "field": name,
            "ticks": len({difference.tick for difference in found}),
            "first_tick": found[0].tick,
            "largest": asdict(max(found, key=lambda difference: difference.size or 0.0)),
        }
        for name, found in comparison.by_field.items()
    ]
    content = {
        "run": str(run.folder),
        "agent": agent,
        "ticks": [comparison.ticks[0], comparison.ticks[-1]],
        "plans": comparison.plans,
        "identical": comparison.identical,
        "first": None if first is None else asdict(first),
        "first_tick_beyond_rounding": comparison.first_beyond(_ROUNDING),
        "fields": fields,
        "notes": notes,
    }
    verdict = "identical, bit for bit" if first is None else f"different from tick {first.tick} on"
    differ = "all" if first is None else f"{comparison.plans - comparison.identical} of"
    lines = [
        f"agent{agent}: {differ} {comparison.plans} plans of ticks {comparison.ticks[0]} to {comparison.ticks[-1]} are "
        f"{verdict}"
    ]
    if first is not None:
        lines += [
            f"  first: {first.field} {first.where}: got {first.got}, expected {first.expected}",
            f"  first tick with inputs that differ by more than {_ROUNDING:g} N or N m: "
            f"{content['first_tick_beyond_rounding']}",
        ]
    for note in notes if output is Format.text else ():
        typer.echo(f"note: {note}", err=True)
    shown = [
        {**row, "largest": row["largest"]["size"], "where": row["largest"]["where"]}
        for row in fields
    ]
    tables = [rows(shown, "field", "where")] if shown else []
    show(output, content, *lines, *tables, *(f" {file}" for file in files))
    raise typer.Exit(0 if first is None else EXIT_DIFFERENT)


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
    setup = Setup.of(scenario, str(run.scenario_file))
    for key, value_of in _FIXED:
        expected, got = value_of(run.setup), value_of(setup)
        if got != expected:
            raise ScenarioError(str(source), key, f"expected {expected} as in the run, got {got}")
    return setup


def _notes(
    run: RecordedRun, again: Replay, comparison: Comparison, *, is_changed: bool
) -> Iterator[str]:
    """Yield the limits of the comparison, one sentence each."""
    yield from again.notes
    if comparison.unrecorded:
        ticks = ", ".join(map(str, comparison.unrecorded))
        yield f"not compared, as the log has no answer of the agent (down, or at its end): tick {ticks}"
    if run.log.cut:
        yield run.log.cut
    if run.setup.scenario.clock.mode == "realtime":
        yield "real time: exact unless links have jitter, reordering or duplicates, or measurements are delayed"
    if comparison.first is not None and not is_changed:
        recorded = [run.log.header.get(name) for name in ("versions", "machine")]
        if recorded != [versions(), machine()]:
            yield f"recorded with {recorded[0]} on {recorded[1]}: last digits may differ"
