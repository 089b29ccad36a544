"""The commands `transport log ...`: what is in a log, and getting it out."""

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from protocol.wire.exit_codes import EXIT_USAGE
from transport.cli.answers import Format, fail, show_json

if TYPE_CHECKING:
    from transport.log.info import LogFile
    from transport.log.tables import Row


log_app = typer.Typer(
    help="Look into the log of a run, and get it out.",
    no_args_is_help=True,
    rich_markup_mode=None,
    epilog="Exit codes: 0 done, also for a log that is not whole; 2 it cannot be read.",
)

LogArgument = Annotated[Path, typer.Argument(metavar="RUN|FILE", help="Run folder, or MCAP file.")]


@log_app.command("info")
def info(
    path: LogArgument,
    output: Annotated[Format, typer.Option("--format", help="What goes to standard output.")] = Format.text,
) -> None:
    """Say what a log holds, and what it lacks.

    Reads a log that was cut off or damaged as far as it goes.

    Example: transport log info runs/20260102-101500-paper
    """
    from transport.log.info import describe

    file = _open(path)
    if output is Format.json:
        show_json(describe(file))
    else:
        _show(describe(file))


@log_app.command("export")
def export(
    path: LogArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for the tables; created if need be.")
    ] = None,
    parquet: Annotated[
        bool,
        typer.Option("--parquet/--csv", help="Parquet (needs the extra: pip install 'payload-transport[parquet]')."),
    ] = False,
    kinds: Annotated[
        list[str] | None, typer.Option("--kind", help="Only messages of this kind: truth, plan, ... Repeatable.")
    ] = None,
    foxglove: Annotated[
        Path | None,
        typer.Option("--foxglove", metavar="FILE", help="Write a copy with transforms and a 3D scene for Foxglove."),
    ] = None,
) -> None:
    """Write a log as tables, or as a copy for Foxglove.

    A table for each kind of message: arrays become columns whose names end in their units; docs/log.md lists them.

    Example: transport log export runs/20260102-101500-paper --parquet --out tables
    """
    if (out is None) == (foxglove is None):
        fail(f"expected either --out or --foxglove, got {'neither' if out is None else 'both'}", EXIT_USAGE)
    if out is not None:
        _export_tables(path, out, kinds or [], parquet=parquet)
    if foxglove is not None:
        _export_foxglove(path, foxglove)


def _export_tables(path: Path, out: Path, kinds: list[str], *, parquet: bool) -> None:
    from protocol.wire.messages import KINDS
    from transport.log.tables import tables

    unknown = sorted(set(kinds) - set(KINDS))
    if unknown:
        fail(f"--kind: expected one of {', '.join(KINDS)}, got {unknown[0]!r}", EXIT_USAGE)
    if parquet:
        try:
            import pyarrow.parquet  # noqa: F401 - before minutes are spent on reading
        except ImportError:
            fail("--parquet: needs pyarrow; pip install 'payload-transport[parquet]', or take --csv", EXIT_USAGE)
    file = _open(path)
    period_s = None if file.setup is None else file.setup.settings.sampling_period_s
    try:
        out.mkdir(parents=True, exist_ok=True)
        for kind, rows in tables(file.log, period_s).items():
            if kinds and kind not in kinds:
                continue
            target = out / f"{kind}.{'parquet' if parquet else 'csv'}"
            (_parquet if parquet else _csv)(rows, target, file)
            typer.echo(f" {target}  {len(rows)} rows")
    except OSError as error:
        fail(f"--out: cannot write to {out} ({error.strerror or error})", EXIT_USAGE)
    _warn(file)


def _export_foxglove(path: Path, out: Path) -> None:
    from transport.log.run_log import LogError
    from transport.report.foxglove import write_foxglove
    from transport.scene.scene import SceneBuilder

    if out.exists():
        fail(f"--foxglove: expected a file that does not exist yet, got {out}", EXIT_USAGE)
    file = _open(path)
    if file.setup is None:
        fail(f"--foxglove: {file.path} has lost its scenario, or it is of another version", EXIT_USAGE)
    try:
        ticks = write_foxglove(SceneBuilder.of(file.setup, file.log), file.path, out)
    except LogError as error:
        fail(f"--foxglove: {error}", EXIT_USAGE)
    except OSError as error:
        fail(f"--foxglove: cannot write {out} ({error.strerror or error})", EXIT_USAGE)
    typer.echo(f" {out}  {ticks} ticks")
    _warn(file)


def _open(path: Path) -> "LogFile":
    from transport.log.info import open_log
    from transport.log.run_log import LogError

    try:
        return open_log(path)
    except LogError as error:
        fail(str(error), EXIT_USAGE)


def _warn(file: "LogFile") -> None:
    from transport.log.info import lost

    if file.log.cut:
        typer.echo(f"warning: {file.log.cut}", err=True)
    for sentence in lost(file):
        typer.echo(f"warning: lost: {sentence}", err=True)


def _show(what: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from transport.log.gaps import ranges

    console = Console()
    whole = Text("whole", "bold green") if what["complete"] else Text("not whole", "bold red")
    head = Table(box=None, show_header=False, title=Text.assemble((what["file"], "bold"), " ", whole))
    head.title_justify = "left"
    head.add_column(style="cyan", no_wrap=True)
    head.add_column()
    period_s, last, ticks = what["sampling_period_s"], what["last_tick"], what["ticks_of_the_run"]
    span = "no message is readable" if last is None else f"{what['first_tick']} to {last}"
    if last is not None and ticks is not None:
        flown = what["ticks_flown"]
        span += f"; {flown} of {ticks} flown ({flown * period_s:.2f} of {ticks * period_s:.2f} s of scenario time)"
    reason = f": {what['reason']}" if what["reason"] else ""
    lines = [
        ("run", f"{what['run_id'] or 'unknown'}, scenario {what['scenario'] or 'unknown'}"),
        ("ended", f"{what['outcome']}{reason}"),
        ("ticks", span),
        ("received", "-" if what["wall_time_s"] is None else f"within {what['wall_time_s']:.2f} s of wall time"),
        ("size", f"{what['bytes'] / 1e3:.0f} kB, {what['messages']} messages"),
        ("recorded with", what["versions"] or "unknown"),
        ("on", what["machine"] or "unknown"),
        *([("log", what["cut"])] if what["cut"] else []),
        *[("lost", sentence) for sentence in what["lost"]],
    ]
    for name, text in lines:
        head.add_row(name, Text(text, "yellow" if name in ("log", "lost") else ""))
    console.print(head)
    if not what["channels"]:
        return
    table = Table(box=None)
    for column in ("channel", "messages", "first tick", "last tick", "ticks without"):
        table.add_column(column, justify="left" if column in ("channel", "ticks without") else "right")
    for channel in what["channels"]:
        table.add_row(
            channel["topic"],
            str(channel["messages"]),
            str(channel["first_tick"]),
            str(channel["last_tick"]),
            ranges(channel["ticks_without"]),
        )
    console.print(table)


def _csv(rows: "list[Row]", path: Path, _: "LogFile") -> None:
    from transport.log.tables import columns
    from transport.report.report import write_whole

    text = io.StringIO(newline="")
    # Floats are written by repr: they read back as the same bits.
    writer = csv.DictWriter(text, columns(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {name: int(value) if isinstance(value, bool) else value for name, value in row.items()} for row in rows
    )
    write_whole(path, text.getvalue().encode())


def _parquet(rows: "list[Row]", path: Path, file: "LogFile") -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from transport.log.tables import columns

    table = pa.table({name: [row.get(name) for row in rows] for name in columns(rows)})
    # The file tells by itself which run it is of.
    about = {key: value for key, value in file.log.header.items() if key in ("run_id", "scenario", "versions")}
    partial = path.with_name(path.name + ".partial")
    pq.write_table(table.replace_schema_metadata(about), partial)
    partial.replace(path)
