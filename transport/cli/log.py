"""The commands `transport log`: describe and export the log of a run."""

from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text
from typer import Argument, Option

from protocol.scenario.setup import Setup
from protocol.wire.messages import KINDS, Control, Measurement, Plan, PlantState, StepReport, Tick
from transport.cli.options import FormatOption, complete_run, run_folder
from transport.cli.output import Format, blame, facts, fail, rows, show
from transport.log.run_folder import missing, ranges
from transport.log.run_log import RunLog, kind_of, read_log, setup_in, topic_of
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


def _open(given: Path | None) -> tuple[Path, RunLog, Setup | None]:
    """Return file and content of a log, and its run, None if its scenario is missing or of another version."""
    path = run_folder(given)
    file = path / "run.mcap" if path.is_dir() else path
    log = read_log(file)
    return file, log, setup_in(log.header, file.parent)


def info(path: LogArgument = None, output: FormatOption = Format.text) -> None:
    """Describe the content of a log, and its gaps.

    Reads a truncated or damaged log as far as possible.

    Example: transport log info runs/20260102-101500-paper
    """
    content = _describe(*_open(path))
    whole = Text("complete", "bold green") if content["complete"] else Text("incomplete", "bold red")
    title = Text.assemble((content["file"], "bold"), " ", whole)
    channels = [
        {
            "channel": channel["topic"],
            **{name.replace("_", " "): channel[name] for name in ("messages", "first_tick", "last_tick")},
            "ticks without": ranges(channel["ticks_without"]),
        }
        for channel in content["channels"]
    ]
    tables = [rows(channels, "channel", "ticks without")] if channels else []
    show(output, content, facts(_lines(content), title), *tables)


def _describe(file: Path, log: RunLog, setup: Setup | None) -> dict[str, Any]:
    """Return a description of a log as JSON data."""
    ticks = [entry.message.tick for entry in log.messages]
    received = [entry.received_ns for entry in log.messages]
    control = next(log.of(Control), None)
    by_channel: dict[str, list[int]] = {}
    for entry in log.messages:
        by_channel.setdefault(topic_of(entry.message), []).append(entry.message.tick)
    return {
        "file": str(file),
        "bytes": file.stat().st_size,
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
        "lost": list(_lost(log, setup)),
        "channels": [
            {
                "topic": topic,
                "messages": len(found),
                "first_tick": min(found),
                "last_tick": max(found),
                # Only channels with a message at every tick can have gaps.
                "ticks_without": _gaps(found) if kind_of(topic) in _REGULAR else [],
            }
            for topic, found in sorted(by_channel.items(), key=lambda item: _natural(item[0]))
        ],
    }


def _lost(log: RunLog, setup: Setup | None) -> Iterator[str]:
    """Yield what is missing from a log, a sentence each."""
    if log.cut and not log.header:
        yield "the metadata of the run: its name, scenario, versions, machine"
    if log.cut and log.messages and next(log.of(Control), None) is None:
        last = max(entry.message.tick for entry in log.messages)
        rest = "everything after it"
        if setup is not None and last + 1 < setup.ticks:
            gone, period_s = setup.ticks - last - 1, setup.settings.sampling_period_s
            of_all = f"{gone} of {setup.ticks}, {gone * period_s:.2f} s of {setup.ticks * period_s:.2f} s"
            rest = f"ticks {last + 1} to {setup.ticks - 1} as far as they were simulated (up to {of_all})"
        yield f"possibly some messages of tick {last}; {rest}, and the outcome of the run"
    if gaps := missing(log):
        yield gaps


def _gaps(ticks: list[int]) -> list[list[int]]:
    """Return the spans missing between the smallest and the largest tick."""
    return [[a + 1, b - 1] for a, b in pairwise(sorted(set(ticks))) if b > a + 1]


def _natural(topic: str) -> tuple[str, int]:
    """Return the sorting key of a channel: agent 10 after agent 9."""
    head, _, last = topic.rpartition("/")
    return (head, int(last)) if last.isdecimal() else (topic, 0)


def _lines(content: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield name and text of each part of a description."""
    period_s, last, ticks = content["sampling_period_s"], content["last_tick"], content["ticks_of_the_run"]
    span = "no message is readable" if last is None else f"{content['first_tick']} to {last}"
    if last is not None and ticks is not None:
        flown = content["ticks_flown"]
        span += f"; {flown} of {ticks} simulated ({flown * period_s:.2f} of {ticks * period_s:.2f} s of scenario time)"
    yield "run", f"{content['run_id'] or 'unknown'}, scenario {content['scenario'] or 'unknown'}"
    yield "ended", f"{content['outcome']}{': ' if content['reason'] else ''}{content['reason']}"
    yield "ticks", span
    if last is not None:
        yield "received", f"within {content['wall_time_s']:.2f} s of wall time"
    yield "size", f"{content['bytes'] / 1e3:.0f} kB, {content['messages']} messages"
    yield "recorded with", content["versions"] or "unknown"
    yield "on", content["machine"] or "unknown"
    if content["cut"]:
        yield "log", Text(content["cut"], "yellow")
    for sentence in content["lost"]:
        yield "lost", Text(sentence, "yellow")


def export(
    path: LogArgument = None,
    out: Path | None = Option(None, metavar="FOLDER", help="Folder for the tables, created if missing."),
    parquet: bool = Option(
        False, "--parquet/--csv", help="Parquet (needs the extra: pip install 'payload-transport[parquet]')."
    ),
    kinds: list[str] | None = Option(
        None, "--kind", metavar="KIND", help="Kind of message: plant_state, plan, ... Repeatable."
    ),
    foxglove: Path | None = Option(None, metavar="FILE", help="Write a copy with a 3D scene for Foxglove."),
    ros2: Path | None = Option(None, metavar="FILE", help="Write a bag for ROS 2: an MCAP file with CDR messages."),
    output: FormatOption = Format.text,
) -> None:
    """Write a log as tables, for Foxglove, or as a bag for ROS 2.

    A table for each kind of message: arrays become columns whose names end in their units; docs/log.md lists them.

    Example: transport log export runs/20260102-101500-paper --parquet --out tables
    """
    scenes = {option: file for option, file in (("--foxglove", foxglove), ("--ros2", ros2)) if file is not None}
    if out is None and not scenes:
        fail("expected --out, --foxglove, --ros2 or several of them, got none")
    unknown = sorted(set(kinds or []) - set(KINDS))
    if unknown:
        fail(f"--kind: expected one of {', '.join(KINDS)}, got {unknown[0]!r}")
    for option, target in scenes.items():
        if target.exists():
            fail(f"{option}: expected a file that does not exist yet, got {target}")
    if parquet:
        import pyarrow.parquet  # noqa: F401 - before the log is read, which may take minutes
    file, log, setup = _open(path)
    written: list[dict[str, Any]] = []
    if out is not None:
        with blame("--out"):
            written += _export_tables(log, setup, out, kinds or [], parquet=parquet)
    for option, target in scenes.items():
        with blame(option):
            written.append({"file": str(target), "ticks": _export_scenes(file, log, setup, target, option)})
    for sentence in [*([log.cut] if log.cut else []), *(f"lost: {sentence}" for sentence in _lost(log, setup))]:
        typer.echo(f"warning: {sentence}", err=True)
    lines = [f" {file}  {count} {unit}" for (_, file), (unit, count) in (entry.items() for entry in written)]
    show(output, {"files": written}, *lines)


def _export_tables(
    log: RunLog, setup: Setup | None, out: Path, kinds: list[str], *, parquet: bool
) -> Iterator[dict[str, Any]]:
    """Write a table for each kind of message; yield file and number of rows."""
    from transport.report.report import write_csv

    period_s = None if setup is None else setup.settings.sampling_period_s
    commands = RATE_NAMES if setup is not None and setup.system.commands_rates else INPUT_NAMES
    out.mkdir(parents=True, exist_ok=True)
    for kind, table in tables(log, period_s, commands).items():
        if kinds and kind not in kinds:
            continue
        target = out / f"{kind}.{'parquet' if parquet else 'csv'}"
        if parquet:
            _write_parquet(table, target, log)
        else:
            values = ({k: int(v) if isinstance(v, bool) else v for k, v in row.items()} for row in table)
            write_csv(target, values, columns(table))
        yield {"file": str(target), "rows": len(table)}


def _write_parquet(table: list[Row], path: Path, log: RunLog) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    content = pa.table({name: [row.get(name) for row in table] for name in columns(table)})
    # The metadata of the file name its run.
    about = {key: value for key, value in log.header.items() if key in ("run_id", "scenario", "versions")}
    partial = path.with_name(path.name + ".partial")
    pq.write_table(content.replace_schema_metadata(about), partial)
    partial.replace(path)


def _export_scenes(file: Path, log: RunLog, setup: Setup | None, out: Path, option: str) -> int:
    """Write a log with its 3D scene, for Foxglove or as a bag of ROS 2; return the number of ticks."""
    from transport.scene.scene import SceneBuilder

    if option == "--foxglove":
        from transport.report.foxglove import write_foxglove as write
    else:
        from transport.report.ros2 import write_bag as write
    if setup is None:
        fail(f"{option}: {file} has no scenario, or one of another version")
    return write(SceneBuilder.of(setup, log), log, out)
