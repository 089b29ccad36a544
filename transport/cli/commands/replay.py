"""Command `transport replay`: one agent of a recorded run, as recorded or with other settings."""

from bdb import BdbQuit
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from transport.agent.node import AgentNode
from transport.analysis.replay.replay_difference import Comparison
from transport.analysis.replay.replay_of_agent import Replay
from transport.cli.lazy import with_options
from transport.cli.options import FormatOption, RunArgument, run_folder
from transport.cli.output import Format, blame, fail, rows, show
from transport.cli.setting_words import complete_setting
from transport.flight.run_files import machine, versions
from transport.flight.signals import leave_interrupts_to_python
from transport.log.run_folder import RecordedRun, open_run
from transport.log.tables import INPUT_NAMES, RATE_NAMES
from transport.protocol.scenario.scenario_file import ScenarioError, find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import EXIT_DIFFERENT
from transport.protocol.wire.messages import Measurement
from transport.report.figures.replay_figure import draw_replay

# Smaller differences of thrusts, N, and of moments, N m, or body rates, rad/s, are rounding: other
# numbers on the way to the same decision.
_ROUNDING = 1e-6
_BY_HAND = "links or processes were changed by hand"


def _owned(setup: Setup) -> list[list[int]]:
    return [[uav + 1 for uav in group] for group in setup.owned]


# Fixed values: the recorded messages fit no other number of UAVs, iterations or ticks.
_FIXED: dict[str, Callable[[Setup], object]] = {
    "agents.owned": _owned,
    "controller.sampling_period_s": lambda setup: setup.settings.sampling_period_s,
    "controller.negotiation_iterations": (
        lambda setup: setup.scenario.controller.negotiation_iterations
    ),
    "clock.mode": lambda setup: setup.scenario.clock.mode,
    "clock.actuation": (
        lambda setup: "next_tick" if setup.scenario.clock.next_tick else "immediate"
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """Options that say what is replayed, and which ticks are compared."""

    settings: Annotated[
        list[str] | None,
        Option(
            "--set",
            metavar="KEY=VALUE",
            help="Replay with this change. Repeatable.",
            autocompletion=complete_setting,
        ),
    ] = None
    against: Annotated[
        str | None,
        Option("--against", metavar="SCENARIO", help="Replay with this scenario's controller."),
    ] = None
    begin: Annotated[
        int,
        Option(
            "--from",
            metavar="TICK",
            min=0,
            help="First tick to compare; earlier ticks are replayed too.",
        ),
    ] = 0
    end: Annotated[
        int | None, Option("--to", metavar="TICK", min=0, help="Last tick to compare.")
    ] = None
    stop_at: Annotated[
        int | None,
        Option("--pdb", metavar="TICK", min=0, help="Open the debugger before this tick."),
    ] = None

    @property
    def is_changed(self) -> bool:
        """True if the controller is not the recorded one, so that plans may differ."""
        return bool(self.settings or self.against)


@with_options(ReplayOptions)
def replay(
    options: ReplayOptions,
    agent: int = Option(..., metavar="NUMBER", min=1, help="Number of the agent, from 1."),
    given: RunArgument = None,
    out: Path | None = Option(
        None, metavar="FOLDER", help="Folder for a figure of the differences, if plans differ."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Feed a recorded run to one agent and compare its plans.

    The messages the agent received are taken from the log; its answers are compared with the
    recorded ones, bit for bit. Without --set or --against the plans of a lockstep run must be
    identical. With them the result is the first tick at which the plans differ, and by how much;
    the plant states are the recorded ones.

    Exit codes: 0 all plans identical, 8 plans differ, 2 nothing can be compared, 3 scenario.

    Example: transport replay runs/20260102-101500-paper --agent 2 --set controller.weights.attitude=6.0
    """
    run = open_run(run_folder(given))
    setup = _changed_setup(run, options.settings or [], options.against)
    if agent not in setup.agents:
        fail(f"--agent: expected an agent from 1 to {len(setup.agents)} of the run, got {agent}")

    again = Replay(setup, run.log, agent, _debugger_at(options.stop_at))
    comparison = _compared(run, again, options)
    if not comparison.ticks:
        why = "; ".join(again.notes) or f"the log has no plan of agent {agent} between those ticks"
        fail(f"{run.folder}: nothing to compare: {why}")

    notes = list(_notes(run, again, comparison, is_changed=options.is_changed))
    if output is Format.text:
        for note in notes:
            typer.echo(f"note: {note}", err=True)

    files: list[Path] = []
    if out is not None and comparison.first is not None:
        with blame("--out"):
            out.mkdir(parents=True, exist_ok=True)
            files = draw_replay(run.setup, comparison, out)

    about = {"run": str(run.folder), "agent": agent}
    content = {**about, **_content(comparison), "notes": notes}
    tables = [_table(comparison)] if comparison.by_field else []
    lines = _verdict(agent, comparison)
    show(output, content, *lines, *tables, *(f" {file}" for file in files))
    raise typer.Exit(0 if comparison.first is None else EXIT_DIFFERENT)


def _debugger_at(tick: int | None) -> Callable[[AgentNode, Measurement], None]:
    """Return a function that opens the debugger before an agent gets the measurement of a tick."""

    # In the debugger `node` is the agent: `tbreak node.receive` and `c` lead into its step.
    def before(node: AgentNode, measurement: Measurement) -> None:  # noqa: ARG001
        if measurement.tick == tick:
            leave_interrupts_to_python()
            breakpoint()

    return before


def _compared(run: RecordedRun, again: Replay, options: ReplayOptions) -> Comparison:
    """Replay an agent and compare the ticks that the options select."""
    is_rates = run.setup.system.commands_rates
    comparison = Comparison(command_names=RATE_NAMES if is_rates else INPUT_NAMES)
    # In real time the log does not record when the agent noticed a lost message.
    is_realtime = again.setup.scenario.clock.mode == "realtime"
    ignored = ("report.lost",) if is_realtime else ()

    try:
        for step in again.steps():
            if options.end is not None and step.tick > options.end:
                break
            if step.tick >= options.begin:
                comparison.add(step, ignored=ignored)
    except BdbQuit:
        place = f"tick {options.stop_at}, before the end of the comparison"
        fail(f"--pdb: the debugger was left at {place}")
    return comparison


def _content(comparison: Comparison) -> dict[str, Any]:
    """Return a comparison as JSON data."""
    first = comparison.first
    return {
        "ticks": [comparison.ticks[0], comparison.ticks[-1]],
        "plans": comparison.plans,
        "identical": comparison.identical,
        "first": None if first is None else asdict(first),
        "first_tick_beyond_rounding": comparison.first_beyond(_ROUNDING),
        "fields": _fields(comparison),
    }


def _fields(comparison: Comparison) -> list[dict[str, Any]]:
    """Return a row for each field that differs, with its largest difference, as JSON data."""
    fields: list[dict[str, Any]] = []
    for name, differences in comparison.by_field.items():
        largest = max(differences, key=lambda difference: difference.size or 0.0)
        fields.append(
            {
                "field": name,
                "ticks": len({difference.tick for difference in differences}),
                "first_tick": differences[0].tick,
                "largest": asdict(largest),
            }
        )
    return fields


def _table(comparison: Comparison) -> Any:
    """Return the table of the fields that differ."""
    shown = [
        {**row, "largest": row["largest"]["size"], "where": row["largest"]["where"]}
        for row in _fields(comparison)
    ]
    return rows(shown, "field", "where")


def _verdict(agent: int, comparison: Comparison) -> list[str]:
    """Return the result of a comparison in lines."""
    first = comparison.first
    ticks = f"ticks {comparison.ticks[0]} to {comparison.ticks[-1]}"
    if first is None:
        return [f"agent{agent}: all {comparison.plans} plans of {ticks} are identical, bit for bit"]

    different = comparison.plans - comparison.identical
    beyond = comparison.first_beyond(_ROUNDING)
    return [
        f"agent{agent}: {different} of {comparison.plans} plans of {ticks} are different "
        f"from tick {first.tick} on",
        f"  first: {first.field} {first.where}: got {first.got}, expected {first.expected}",
        f"  first tick with inputs that differ by more than {_ROUNDING:g} (SI): "
        f"{'none' if beyond is None else beyond}",
    ]


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
    for key, value_of in _FIXED.items():
        expected = value_of(run.setup)
        got = value_of(setup)
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
        reason = "as the log has no answer of the agent (down, or at its end)"
        yield f"not compared, {reason}: tick {ticks}"
    if run.log.cut:
        yield run.log.cut
    if run.setup.scenario.clock.mode == "realtime":
        exceptions = "links have jitter, reordering, duplicates or delays that become shorter"
        yield f"real time: exact unless {exceptions}, measurements are delayed, or {_BY_HAND}"
    if comparison.first is not None and not is_changed:
        recorded = [run.log.header.get(name) for name in ("versions", "machine")]
        if recorded != [versions(), machine()]:
            yield f"recorded with {recorded[0]} on {recorded[1]}: last digits may differ"
