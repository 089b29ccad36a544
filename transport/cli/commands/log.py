"""The commands `transport log`: describe and export the log of a run."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text
from typer import Argument, Option

from transport.cli.lazy import with_options
from transport.cli.options import FormatOption, complete_run, run_folder
from transport.cli.output import Format, blame, facts, fail, rows, show
from transport.log.missing_messages import missing
from transport.log.run_log import RunLog, read_log, setup_in, topic_of
from transport.log.tables import INPUT_NAMES, RATE_NAMES, Row, columns, tables
from transport.protocol.scenario.files.atomic_writing import write_csv
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import KINDS, Control, Message

LogArgument = Annotated[
    Path | None,
    Argument(
        metavar="RUN|FILE",
        help="Run folder, its name in runs/, or MCAP file; by default the most recent run.",
        autocompletion=complete_run,
    ),
]


def _open(given: Path | None) -> tuple[Path, RunLog, Setup | None]:
    """Return file and content of a log, and its run.

    The run is None if its scenario is missing or of another version.
    """
    path = run_folder(given)
    file = path / "run.mcap" if path.is_dir() else path
    log = read_log(file)
    return file, log, setup_in(log.header, file.parent)


def info(path: LogArgument = None, output: FormatOption = Format.text) -> None:
    """Describe the content of a log, and its gaps.

    Reads a truncated or damaged log as far as possible.

    Example: transport log info runs/20260102-101500-paper
    """
    file, log, setup = _open(path)
    lost = _gaps(log, setup)
    topics = _topics(log)

    control = next(log.of(Control), None)
    about = {
        "file": str(file),
        "bytes": file.stat().st_size,
        **{name: log.header.get(name) for name in ("run_id", "versions", "machine")},
        "scenario": None if setup is None else setup.scenario.name,
        "outcome": "unknown" if control is None else control.outcome,
        "reason": "" if control is None else control.reason,
        "messages": len(log.messages),
        "last_tick": max((topic["last_tick"] for topic in topics), default=None),
        "ticks_of_the_run": None if setup is None else setup.ticks,
        "complete": not lost,
    }

    warnings = [("lost", Text(sentence, "yellow")) for sentence in lost]
    shown = [rows(topics, "topic")] if topics else []
    content = {**about, "lost": lost, "channels": topics}
    show(output, content, facts([*about.items(), *warnings]), *shown)


def _topics(log: RunLog) -> list[dict[str, Any]]:
    """Return a row for each topic of a log: its messages, their mean length, and their ticks."""
    by_topic: dict[str, list[Message]] = {}
    for entry in log.messages:
        by_topic.setdefault(topic_of(entry.message), []).append(entry.message)

    topics = []
    for topic, messages in sorted(by_topic.items()):
        ticks = [message.tick for message in messages]
        lengths = [len(encode(message)) for message in messages]
        topics.append(
            {
                "topic": topic,
                "messages": len(messages),
                "mean_bytes": round(sum(lengths) / len(lengths)),
                "first_tick": min(ticks),
                "last_tick": max(ticks),
            }
        )
    return topics


def _gaps(log: RunLog, setup: Setup | None) -> list[str]:
    """Return what a log lacks, a sentence each: its end, and messages that its run must have."""
    return [sentence for sentence in (log.cut, missing(log, setup)) if sentence]


@dataclass(frozen=True, slots=True, kw_only=True)
class TableOptions:
    """Options of the tables of a log."""

    out: Annotated[
        Path | None,
        Option("--out", metavar="FOLDER", help="Folder for the tables, created if missing."),
    ] = None
    parquet: Annotated[
        bool,
        Option(
            "--parquet/--csv",
            help="Parquet (needs the extra: pip install 'payload-transport[parquet]').",
        ),
    ] = False
    kinds: Annotated[
        list[str] | None,
        Option(
            "--kind",
            metavar="KIND",
            help="Kind of message: plant_state, plan, ... Repeatable.",
        ),
    ] = None

    def check(self) -> None:
        """End the command for options without tables, and for a kind of message that does not exist.

        Loads the package that writes Parquet.
        """
        for option, is_given in (("--kind", bool(self.kinds)), ("--parquet", self.parquet)):
            if is_given and self.out is None:
                fail(f"{option}: expected --out for the tables, got none")
        unknown = sorted(set(self.kinds or []) - set(KINDS))
        if unknown:
            fail(f"--kind: expected one of {', '.join(KINDS)}, got {unknown[0]!r}")
        if self.parquet:
            import pyarrow.parquet  # noqa: F401 - before the log is read, which may take minutes


@with_options(TableOptions)
def export(
    options: TableOptions,
    path: LogArgument = None,
    ros2: Path | None = Option(
        None,
        metavar="FILE",
        help="Write a bag for ROS 2 and Foxglove: an MCAP file with CDR messages.",
    ),
    output: FormatOption = Format.text,
) -> None:
    """Write a log as tables, or as a bag for ROS 2 and Foxglove.

    A table for each kind of message: arrays become columns whose names end in their units;
    docs/log.md lists them.

    Example: transport log export runs/20260102-101500-paper --parquet --out tables
    """
    if options.out is None and ros2 is None:
        fail("expected --out, --ros2 or both, got none")
    options.check()
    if ros2 is not None:
        _check_bag(ros2)

    file, log, setup = _open(path)
    written: list[tuple[Path, int, str]] = []  # file, number of entries, and their kind
    if options.out is not None:
        with blame("--out"):
            for target, count in _export_tables(log, setup, options, options.out):
                written.append((target, count, "rows"))
    if ros2 is not None:
        if setup is None:
            fail(f"--ros2: {file} has no scenario, or one of another version")
        from transport.report.ros2_bag import write_bag
        from transport.scene.scene_at_tick import SceneBuilder

        with blame("--ros2"):
            written.append((ros2, write_bag(SceneBuilder.of(setup, log), log, ros2), "ticks"))

    for sentence in _gaps(log, setup):
        typer.echo(f"warning: {sentence}", err=True)
    content = [{"file": str(target), entries: count} for target, count, entries in written]
    lines = [f" {target}  {count} {entries}" for target, count, entries in written]
    show(output, {"files": content}, *lines)


def _check_bag(target: Path) -> None:
    """End the command if the file of a bag does not end in .mcap or already exists."""
    if target.suffix != ".mcap":  # players tell the format by it
        fail(f"--ros2: expected a file name that ends in .mcap, got {target}")
    if target.exists():
        fail(f"--ros2: expected a file that does not exist yet, got {target}")


def _export_tables(
    log: RunLog, setup: Setup | None, options: TableOptions, out: Path
) -> Iterator[tuple[Path, int]]:
    """Write a table for each kind of message; yield file and number of rows."""
    period_s = None if setup is None else setup.settings.sampling_period_s
    is_rates = setup is not None and setup.system.commands_rates
    commands = RATE_NAMES if is_rates else INPUT_NAMES

    out.mkdir(parents=True, exist_ok=True)
    kinds = options.kinds or KINDS
    for kind, table in tables(log, period_s, commands, kinds).items():
        target = out / f"{kind}.{'parquet' if options.parquet else 'csv'}"
        if options.parquet:
            _write_parquet(target, table, log.header)
        else:
            write_csv(target, table, columns(table))
        yield target, len(table)


def _write_parquet(target: Path, table: list[Row], metadata: Mapping[str, str]) -> None:
    """Write a table as Parquet, with the metadata of the log."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    content = pa.table({name: [row.get(name) for row in table] for name in columns(table)})
    pq.write_table(content.replace_schema_metadata(metadata), target)
