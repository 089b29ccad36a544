"""The commands `transport log`: describe and export the log of a run."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_USAGE
from protocol.wire.messages import KINDS, Control, Measurement, Plan, PlantState, StepReport, Tick
from transport.cli.options import FormatOption
from transport.cli.output import Format, exit_on, fail, show_json
from transport.cli.recorded_run import complete_run, run_folder
from transport.log.run_folder import missing, ranges
from transport.log.run_log import LogError, RunLog, kind_of, read_log, setup_in, topic_of
from transport.log.tables import INPUT_NAMES, RATE_NAMES, Row, columns, tables

LogArgument = Annotated[
    Path | None,
    Argument(
        metavar="RUN|FILE",
        help="Run folder, its name in runs/, or MCAP file; by default the most recent run.",
        autocompletion=complete_run,
    ),
]


# Kinds of messages sent at every tick.
_REGULAR = (Tick.kind, PlantState.kind, Measurement.kind, Plan.kind, StepReport.kind)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogFile:
    """Readable content of a log file, and the run, None if the scenario in the log is missing or of another version."""

    path: Path
    log: RunLog
    setup: Setup | None


def open_or_fail(given: Path | None) -> LogFile:
    """Open a log, by default that of the most recent run, or end the command if it cannot be read."""
    path = run_folder(given)
    with exit_on(LogError, code=EXIT_USAGE):
        file = path / "run.mcap" if path.is_dir() else path
        log = read_log(file)
    return LogFile(path=file, log=log, setup=setup_in(log.header, file.parent))


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


def describe(file: LogFile) -> dict[str, Any]:
    """Return a description of a log as JSON data."""
    log, setup = file.log, file.setup
    ticks = [entry.message.tick for entry in log.messages]
    received = [entry.received_ns for entry in log.messages]
    control = next(log.of(Control), None)
    return {
        "file": str(file.path),
        "bytes": file.path.stat().st_size,
        "run_id": log.header.get("run_id"),
        "scenario": None if setup is None else setup.scenario.name,
        "versions": log.header.get("versions"),
        "machine": log.header.get("machine"),
        "messages": len(log.messages),
        "kinds": dict(Counter(entry.message.kind for entry in log.messages)),
        "first_tick": min(ticks, default=None),
        "last_tick": max(ticks, default=None),
        "ticks_of_the_run": None if setup is None else setup.ticks,
        "ticks_flown": len({plant_state.tick for plant_state in log.of(PlantState)}),
        "sampling_period_s": None if setup is None else setup.settings.sampling_period_s,
        "wall_time_s": (max(received) - min(received)) / 1e9 if received else None,
        "outcome": "unknown" if control is None else control.outcome,
        "reason": "" if control is None else control.reason,
        "complete": not log.cut and not missing(log),
        "cut": log.cut or None,
        "lost": lost(file),
        "channels": _channels_in(log),
    }


def lost(file: LogFile) -> list[str]:
    """Return what is missing from the log, a sentence each; empty if it is whole."""
    log, setup = file.log, file.setup
    found = []
    if log.cut:
        if not log.header:
            found.append("the metadata of the run: its name, scenario, versions, machine")
        if log.messages and next(log.of(Control), None) is None:
            last = max(entry.message.tick for entry in log.messages)
            rest = "everything after it, and the outcome of the run"
            if setup is not None and last + 1 < setup.ticks:
                period_s = setup.settings.sampling_period_s
                gone = setup.ticks - last - 1
                rest = (
                    f"ticks {last + 1} to {setup.ticks - 1} as far as they were simulated (up to {gone} of "
                    f"{setup.ticks}, {gone * period_s:.2f} s of {setup.ticks * period_s:.2f} s), "
                    "and the outcome of the run"
                )
            found.append(f"possibly some messages of tick {last}; {rest}")
    gaps = missing(log)
    if gaps:
        found.append(gaps)
    return found


def _channels_in(log: RunLog) -> list[dict[str, Any]]:
    """Return the channels, sorted by name, each with the spans of ticks in between that have no message."""
    ticks: dict[str, list[int]] = {}
    for entry in log.messages:
        ticks.setdefault(topic_of(entry.message), []).append(entry.message.tick)
    return [
        {
            "topic": topic,
            "messages": len(found),
            "first_tick": min(found),
            "last_tick": max(found),
            # Only channels with a message at every tick can have gaps.
            "ticks_without": _gaps(found) if kind_of(topic) in _REGULAR else [],
        }
        for topic, found in sorted(ticks.items(), key=lambda item: _natural(item[0]))
    ]


def _gaps(ticks: Iterable[int]) -> list[list[int]]:
    """Return the spans missing between the smallest and the largest tick."""
    return [[a + 1, b - 1] for a, b in pairwise(sorted(set(ticks))) if b > a + 1]


def _natural(topic: str) -> tuple[str, int]:
    """Return the sorting key of a channel: agent 10 after agent 9."""
    head, _, last = topic.rpartition("/")
    return (head, int(last)) if last.isdecimal() else (topic, 0)


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


def export(
    path: LogArgument = None,
    out: Annotated[
        Path | None, Option("--out", metavar="FOLDER", help="Folder for the tables, created if missing.")
    ] = None,
    parquet: Annotated[
        bool, Option("--parquet/--csv", help="Parquet (needs the extra: pip install 'payload-transport[parquet]').")
    ] = False,
    kinds: Annotated[
        list[str] | None, Option("--kind", metavar="KIND", help="Kind of message: plant_state, plan, ... Repeatable.")
    ] = None,
    foxglove: Annotated[
        Path | None, Option("--foxglove", metavar="FILE", help="Write a copy with a 3D scene for Foxglove.")
    ] = None,
    ros2: Annotated[
        Path | None, Option("--ros2", metavar="FILE", help="Write a bag for ROS 2: an MCAP file with CDR messages.")
    ] = None,
    output: FormatOption = Format.text,
) -> None:
    """Write a log as tables, for Foxglove, or as a bag for ROS 2.

    A table for each kind of message: arrays become columns whose names end in their units; docs/log.md lists them.

    Example: transport log export runs/20260102-101500-paper --parquet --out tables
    """
    scenes = {option: file for option, file in (("--foxglove", foxglove), ("--ros2", ros2)) if file is not None}
    if out is None and not scenes:
        fail("expected --out, --foxglove, --ros2 or several of them, got none", EXIT_USAGE)
    unknown = sorted(set(kinds or []) - set(KINDS))
    if unknown:
        fail(f"--kind: expected one of {', '.join(KINDS)}, got {unknown[0]!r}", EXIT_USAGE)
    for option, target in scenes.items():
        if target.exists():
            fail(f"{option}: expected a file that does not exist yet, got {target}", EXIT_USAGE)
    if parquet:
        try:
            import pyarrow.parquet  # noqa: F401 - before the log is read, which may take minutes
        except ImportError:
            fail("--parquet: needs pyarrow; pip install 'payload-transport[parquet]', or use --csv", EXIT_USAGE)
    file = open_or_fail(path)
    written = [] if out is None else _export_tables(file, out, kinds or [], parquet=parquet)
    for option, target in scenes.items():
        written += _export_scenes(file, target, option)
    _warn(file)
    if output is Format.json:
        show_json({"files": written})
        return
    for entry in written:
        file, (unit, count) = entry["file"], list(entry.items())[1]
        typer.echo(f" {file}  {count} {unit}")


def _export_tables(file: LogFile, out: Path, kinds: list[str], *, parquet: bool) -> list[dict[str, Any]]:
    from transport.report.report import write_csv

    period_s = None if file.setup is None else file.setup.settings.sampling_period_s
    commands = RATE_NAMES if file.setup is not None and file.setup.system.commands_rates else INPUT_NAMES
    written: list[dict[str, Any]] = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for kind, rows in tables(file.log, period_s, commands).items():
            if kinds and kind not in kinds:
                continue
            target = out / f"{kind}.{'parquet' if parquet else 'csv'}"
            if parquet:
                _write_parquet(rows, target, file)
            else:
                values = ({k: int(v) if isinstance(v, bool) else v for k, v in row.items()} for row in rows)
                write_csv(target, values, columns(rows))
            written.append({"file": str(target), "rows": len(rows)})
    except OSError as error:
        fail(f"--out: cannot write to {out} ({error.strerror or error})", EXIT_USAGE)
    return written


def _export_scenes(file: LogFile, out: Path, option: str) -> list[dict[str, Any]]:
    """Write a log with its 3D scene, for Foxglove or as a bag of ROS 2."""
    from transport.scene.scene import SceneBuilder

    if option == "--foxglove":
        from transport.report.foxglove import write_foxglove as write
    else:
        try:
            from transport.report.ros2 import write_bag as write
        except ImportError:
            fail("--ros2: needs rosbags; pip install 'payload-transport[ros2]'", EXIT_USAGE)
    if file.setup is None:
        fail(f"{option}: {file.path} has no scenario, or one of another version", EXIT_USAGE)
    try:
        with exit_on(LogError, code=EXIT_USAGE, option=option):
            ticks = write(SceneBuilder.of(file.setup, file.log), file.log, out)
    except OSError as error:
        fail(f"{option}: cannot write {out} ({error.strerror or error})", EXIT_USAGE)
    return [{"file": str(out), "ticks": ticks}]


def _warn(file: LogFile) -> None:
    if file.log.cut:
        typer.echo(f"warning: {file.log.cut}", err=True)
    for sentence in lost(file):
        typer.echo(f"warning: lost: {sentence}", err=True)


def _write_parquet(rows: list[Row], path: Path, file: LogFile) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({name: [row.get(name) for row in rows] for name in columns(rows)})
    # The metadata of the file name its run.
    about = {key: value for key, value in file.log.header.items() if key in ("run_id", "scenario", "versions")}
    partial = path.with_name(path.name + ".partial")
    pq.write_table(table.replace_schema_metadata(about), partial)
    partial.replace(path)
