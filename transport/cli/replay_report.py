"""The result of `transport replay`, as text and as JSON."""

from dataclasses import asdict, dataclass
from typing import Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from transport.analysis.replay import Replay
from transport.analysis.replay_compare import Comparison, Difference, Tally
from transport.flight.header import versions
from transport.log.run_folder import RecordedRun

# Smaller differences of inputs, N or N m, are rounding: other numbers on the way to the same decision.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """Comparison of an agent's plans with the recorded ones, of a replay with or without changed settings."""

    run: RecordedRun
    agent: int
    again: Replay
    comparison: Comparison
    is_changed: bool

    def show(self) -> None:
        """Print the verdict, the largest differences by field, and notes."""
        console = Console()
        comparison, period_s = self.comparison, self.run.setup.settings.sampling_period_s
        span = f"ticks {comparison.ticks[0]} to {comparison.ticks[-1]}"
        first = comparison.first
        if first is None:
            verdict = Text("identical, bit for bit", "bold green")
            console.print(Text.assemble(f"agent{self.agent}: all {comparison.plans} plans of {span} are ", verdict))
        else:
            differ = (
                f"agent{self.agent}: {comparison.plans - comparison.identical} of {comparison.plans} plans of {span} "
            )
            verdict = Text(f"differ from tick {first.tick} on", "bold yellow" if self.is_changed else "bold red")
            console.print(Text.assemble(differ, verdict, f" (t = {first.tick * period_s:.2f} s)"))
            typer.echo(f"  {_sentence(first)}")
            tick = comparison.first_beyond(_ROUNDING)
            when = "at no tick" if tick is None else f"from tick {tick} on (t = {tick * period_s:.2f} s)"
            typer.echo(f"  by more than {_ROUNDING:g} N or N m: {when}")
        if comparison.tallies:
            console.print(_table(comparison.tallies))
        for note in self._notes():
            typer.echo(f"note: {note}", err=True)

    def content(self) -> dict[str, Any]:
        """Return the comparison as plain data."""
        comparison = self.comparison
        return {
            "run": str(self.run.folder),
            "agent": self.agent,
            "ticks": [comparison.ticks[0], comparison.ticks[-1]],
            "plans": comparison.plans,
            "identical": comparison.identical,
            "first": None if comparison.first is None else asdict(comparison.first),
            "first_tick_beyond_rounding": comparison.first_beyond(_ROUNDING),
            "fields": {
                name: {"ticks": tally.ticks, "first_tick": tally.first.tick, "largest": asdict(tally.largest)}
                for name, tally in comparison.tallies.items()
            },
            "not_compared": comparison.unrecorded,
            "notes": self._notes(),
        }

    def _notes(self) -> list[str]:
        """Return the limits of the comparison, one sentence each."""
        found = list(self.again.notes)
        header, missing = self.run.log.header, self.comparison.unrecorded
        if missing:
            ticks = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
            found.append(f"not compared, as the log has no answer of the agent (down, or at its end): tick {ticks}")
        if self.run.log.cut:
            found.append(f"log: {self.run.log.cut}")
        if self.run.setup.scenario.clock.mode == "realtime":
            found.append(
                "real time: the plans that the agent had at each step are taken from its step reports. That is exact "
                "unless links have jitter, reordering or duplicates, or measurements are delayed; then the log does "
                "not tell all of them"
            )
        if self.again.refused and self.is_changed:
            found.append(f"refused by the changed agent: {'; '.join(self.again.refused)}")
        if self.comparison.first is not None and not self.is_changed:
            recorded, here = header.get("versions", ""), versions()
            if recorded != here:
                found.append(f"recorded with {recorded}; here {here}: last digits may differ between versions")
            machine = header.get("machine", "") or "an unknown machine"
            found.append(f"recorded on {machine}: last digits may differ between processors")
        return found


def _table(tallies: dict[str, Tally]) -> Table:
    table = Table(box=None, pad_edge=True, title="", show_edge=False)
    for column in ("field", "ticks", "first", "largest", "at tick", "which"):
        table.add_column(column, justify="left" if column in ("field", "which") else "right")
    for name, tally in tallies.items():
        largest = tally.largest
        size = "-" if largest.size is None else f"{largest.size:.3g} {largest.unit}".strip()
        where = largest.where or f"{_short(largest.got)}, recorded {_short(largest.expected)}"
        counts = (str(tally.ticks), str(tally.first.tick), size, str(largest.tick))
        table.add_row(name, *counts, Text(where, overflow="ellipsis"))
    return table


def _short(text: str) -> str:
    try:
        return f"{float(text):.3g}"
    except ValueError:
        return text


def _sentence(first: Difference) -> str:
    size = "" if first.size is None else f", {first.size:.3g} {first.unit}".rstrip() + " apart"
    exchange = f" (with {first.negotiation} exchanges to come)" if first.negotiation else ""
    where = first.where if first.where.startswith("[") else ""
    return f"first: {first.field}{where}: got {first.got}, expected {first.expected}{size}{exchange}"
