"""The command `transport log info`."""

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from transport.cli.log.opening import LogArgument, open_or_fail
from transport.cli.options import FormatOption
from transport.cli.output import Format, show_json
from transport.log.info import describe
from transport.log.run_folder import ranges


def info(path: LogArgument = None, output: FormatOption = Format.text) -> None:
    """Describe the content of a log, and its gaps.

    Reads a truncated or damaged log as far as possible.

    Example: transport log info runs/20260102-101500-paper
    """
    content = describe(open_or_fail(path))
    if output is Format.json:
        show_json(content)
        return
    console = Console()
    console.print(_summary(content))
    if content["channels"]:
        console.print(_channels(content["channels"]))


def _summary(content: dict[str, Any]) -> Table:
    whole = Text("complete", "bold green") if content["complete"] else Text("incomplete", "bold red")
    table = Table(box=None, show_header=False, title=Text.assemble((content["file"], "bold"), " ", whole))
    table.title_justify = "left"
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    period_s, last, ticks = content["sampling_period_s"], content["last_tick"], content["ticks_of_the_run"]
    span = "no message is readable" if last is None else f"{content['first_tick']} to {last}"
    if last is not None and ticks is not None:
        flown = content["ticks_flown"]
        span += f"; {flown} of {ticks} simulated ({flown * period_s:.2f} of {ticks * period_s:.2f} s of scenario time)"
    reason = f": {content['reason']}" if content["reason"] else ""
    lines = [
        ("run", f"{content['run_id'] or 'unknown'}, scenario {content['scenario'] or 'unknown'}"),
        ("ended", f"{content['outcome']}{reason}"),
        ("ticks", span),
        ("received", "-" if content["wall_time_s"] is None else f"within {content['wall_time_s']:.2f} s of wall time"),
        ("size", f"{content['bytes'] / 1e3:.0f} kB, {content['messages']} messages"),
        ("recorded with", content["versions"] or "unknown"),
        ("on", content["machine"] or "unknown"),
        *([("log", content["cut"])] if content["cut"] else []),
        *[("lost", sentence) for sentence in content["lost"]],
    ]
    for name, text in lines:
        table.add_row(name, Text(text, "yellow" if name in ("log", "lost") else ""))
    return table


def _channels(channels: list[dict[str, Any]]) -> Table:
    table = Table(box=None)
    for column in ("channel", "messages", "first tick", "last tick", "ticks without"):
        table.add_column(column, justify="left" if column in ("channel", "ticks without") else "right")
    for channel in channels:
        counts = (channel["messages"], channel["first_tick"], channel["last_tick"])
        table.add_row(channel["topic"], *map(str, counts), ranges(channel["ticks_without"]))
    return table
