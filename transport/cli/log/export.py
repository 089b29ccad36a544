"""The command `transport log export`."""

import csv
import io
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Option

from protocol.wire.exit_codes import EXIT_USAGE
from protocol.wire.messages import KINDS
from transport.cli.log.opening import LogArgument, open_or_fail
from transport.cli.options import FormatOption
from transport.cli.output import Format, exit_on, fail, show_json
from transport.log.info import LogFile, lost
from transport.log.run_log import LogError
from transport.log.tables import Row, columns, tables
from transport.report.foxglove import write_foxglove
from transport.report.report import write_whole
from transport.scene.scene import SceneBuilder


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
    output: FormatOption = Format.text,
) -> None:
    """Write a log as tables, as a copy for Foxglove, or both.

    A table for each kind of message: arrays become columns whose names end in their units; docs/log.md lists them.

    Example: transport log export runs/20260102-101500-paper --parquet --out tables
    """
    if out is None and foxglove is None:
        fail("expected --out, --foxglove or both, got neither", EXIT_USAGE)
    unknown = sorted(set(kinds or []) - set(KINDS))
    if unknown:
        fail(f"--kind: expected one of {', '.join(KINDS)}, got {unknown[0]!r}", EXIT_USAGE)
    if foxglove is not None and foxglove.exists():
        fail(f"--foxglove: expected a file that does not exist yet, got {foxglove}", EXIT_USAGE)
    if parquet:
        try:
            import pyarrow.parquet  # noqa: F401 - before the log is read, which may take minutes
        except ImportError:
            fail("--parquet: needs pyarrow; pip install 'payload-transport[parquet]', or use --csv", EXIT_USAGE)
    file = open_or_fail(path)
    written = [] if out is None else _export_tables(file, out, kinds or [], parquet=parquet)
    written += [] if foxglove is None else _export_foxglove(file, foxglove)
    _warn(file)
    if output is Format.json:
        show_json({"files": written})
        return
    for entry in written:
        file, (unit, count) = entry["file"], list(entry.items())[1]
        typer.echo(f" {file}  {count} {unit}")


def _export_tables(file: LogFile, out: Path, kinds: list[str], *, parquet: bool) -> list[dict[str, Any]]:
    period_s = None if file.setup is None else file.setup.settings.sampling_period_s
    written: list[dict[str, Any]] = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for kind, rows in tables(file.log, period_s).items():
            if kinds and kind not in kinds:
                continue
            target = out / f"{kind}.{'parquet' if parquet else 'csv'}"
            if parquet:
                _write_parquet(rows, target, file)
            else:
                _write_csv(rows, target)
            written.append({"file": str(target), "rows": len(rows)})
    except OSError as error:
        fail(f"--out: cannot write to {out} ({error.strerror or error})", EXIT_USAGE)
    return written


def _export_foxglove(file: LogFile, out: Path) -> list[dict[str, Any]]:
    if file.setup is None:
        fail(f"--foxglove: {file.path} has no scenario, or one of another version", EXIT_USAGE)
    try:
        with exit_on(LogError, code=EXIT_USAGE, option="--foxglove"):
            ticks = write_foxglove(SceneBuilder.of(file.setup, file.log), file.log, out)
    except OSError as error:
        fail(f"--foxglove: cannot write {out} ({error.strerror or error})", EXIT_USAGE)
    return [{"file": str(out), "ticks": ticks}]


def _warn(file: LogFile) -> None:
    if file.log.cut:
        typer.echo(f"warning: {file.log.cut}", err=True)
    for sentence in lost(file):
        typer.echo(f"warning: lost: {sentence}", err=True)


def _write_csv(rows: list[Row], path: Path) -> None:
    text = io.StringIO(newline="")
    # Floats are written by repr: they read back as the same bits.
    writer = csv.DictWriter(text, columns(rows), lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {name: int(value) if isinstance(value, bool) else value for name, value in row.items()} for row in rows
    )
    write_whole(path, text.getvalue().encode())


def _write_parquet(rows: list[Row], path: Path, file: LogFile) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({name: [row.get(name) for row in rows] for name in columns(rows)})
    # The metadata of the file name its run.
    about = {key: value for key, value in file.log.header.items() if key in ("run_id", "scenario", "versions")}
    partial = path.with_name(path.name + ".partial")
    pq.write_table(table.replace_schema_metadata(about), partial)
    partial.replace(path)
