"""Tables in Markdown, their places between the markers of a document, and where their numbers come from."""

import re
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path

from scipy.special import betaincinv

ROOT = Path(__file__).resolve().parent.parent

# Sources that decide the numbers of a simulation in memory.
FLOWN = (
    *("model", "mpc", "protocol", "agent", "plant", "coordinator", "scenarios", "vehicles"),
    *("transport/flight/memory.py", "transport/analysis", "transport/experiments/cases.py"),
)


def completed_of(completed: int, runs: int) -> str:
    """Return a count of runs with its exact 95 % interval, after Clopper and Pearson."""
    low = betaincinv(completed, runs - completed + 1, 0.025) if completed else 0.0
    high = betaincinv(completed + 1, runs - completed, 0.975) if completed < runs else 1.0
    return f"{completed} of {runs} ({100.0 * low:.0f} to {100.0 * high:.0f} %)"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown; an empty cell takes one blank."""
    lines = [
        "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"
        for cells in (headings, *rows)
    ]
    return "\n".join([lines[0], "|" + "---|" * len(headings), *lines[1:]])


def place(document: Path, name: str) -> re.Match[str]:
    """Return what stands between two markers of a document.

    Raises: SystemExit: the document has no such markers.
    """
    pattern = rf"(?<=<!-- {re.escape(name)} -->\n).*?(?=\n<!-- end of {re.escape(name)} -->)"
    found = re.search(pattern, document.read_text(encoding="utf-8"), re.DOTALL)
    if found is None:
        raise SystemExit(f"{document}: expected the markers of {name!r}, got none")
    return found


def put(document: Path, name: str, content: str) -> None:
    """Replace what stands between two markers of a document.

    Raises: SystemExit: the document has no such markers.
    """
    found = place(document, name)
    document.write_text(
        found.string[: found.start()] + content + found.string[found.end() :], encoding="utf-8"
    )


def commit() -> str:
    """Return the last commit that changed the simulation; "unknown" outside a repository.

    A tree with uncommitted changes there has no commit of its own: its name ends with " and
        changes".
    """

    def git(*arguments: str) -> str:
        command = ["git", *arguments, "--", *FLOWN]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, cwd=ROOT
        ).stdout.strip()

    try:
        return (git("log", "-1", "--format=%h") or "unknown") + " and changes" * bool(
            git("status", "--porcelain")
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
