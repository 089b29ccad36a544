"""Tables in Markdown, their places between the markers of a document, and where their numbers come from."""

import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from scipy.special import betaincinv

ROOT = Path(__file__).resolve().parent.parent

# Sources that decide the numbers of a simulation in memory.
FLOWN = (
    *("model", "mpc", "protocol", "agent", "plant", "coordinator", "scenarios", "vehicles"),
    *("transport/flight/memory.py", "transport/analysis"),
    *(f"transport/experiments/{name}.py" for name in ("cases", "simulation", "run_numbers")),
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


def put_rows(
    document: Path,
    name: str,
    headings: Sequence[str],
    order: Sequence[str],
    rows: Mapping[str, Sequence[str]],
    source: str,
) -> None:
    """Renew rows of a table between two markers, by their first cells; the others stay.

    Args:
        document: Markdown file.
        name: Of the markers.
        headings: Of all columns.
        order: First cells of all rows.
        rows: The other cells of the new rows.
        source: Said below the table.
    """
    whole = place(document, name).group().partition("\n\n")[0]
    before = [line.strip("| ").split(" | ") for line in whole.splitlines()[2:]]
    found = {cells[0]: cells for cells in before}
    found |= {first: [first, *cells] for first, cells in rows.items()}
    shown = [found[first] for first in order if first in found]
    put(document, name, f"{table(headings, shown)}\n\n*{source}.*")


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
