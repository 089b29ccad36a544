"""A small experiment that tests run with different executors."""

from collections.abc import Sequence
from pathlib import Path

from typer.testing import CliRunner, Result

from tests.support.runs import ticks
from transport.cli.main import app

# Half a second of hover with packet loss: 5 runs, two of them random with two seeds each.
TICKS = 10
FLIGHTS = 5
SMALL = (
    *("experiment", "loss", "--scenario", "resilient", "--loss", "0.5", "--seeds", "2"),
    *("--set", ticks(TICKS)),
)


def here(*arguments: str | Path) -> Result:
    """Run the command within this process."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def tables(folder: Path) -> Sequence[bytes]:
    """Return the tables in an experiment's folder."""
    return [(folder / name).read_bytes() for name in ("points.csv", "cases.csv")]


def kept(folder: Path) -> int:
    """Return the number of results in an experiment's folder."""
    path = folder / "results.jsonl"
    return path.read_bytes().count(b"\n") if path.exists() else 0
