"""Tables in Markdown, their places between the markers of a document, and where their numbers come from."""

import re
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# Sources that decide the numbers of a simulation in memory.
FLOWN = (
    *("model", "mpc", "protocol", "agent", "plant", "coordinator", "scenarios", "vehicles"),
    "transport/flight/memory.py",
    *(f"transport/analysis/{name}.py" for name in ("metrics", "series")),
)


def table(headings: Iterable[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    columns = list(headings)
    lines = [columns, *map(list, rows)]
    for line in lines:
        if len(line) != len(columns):
            raise ValueError(f"row {line}: expected {len(columns)} cells, got {len(line)}")
    return "\n".join([bar(columns), "|" + "---|" * len(columns), *map(bar, lines[1:])])


def bar(cells: Sequence[str]) -> str:
    """Return a row in Markdown; an empty cell takes one blank."""
    return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"


def place(document: Path, name: str) -> re.Pattern[str]:
    """Return the pattern of what stands between two markers of a document.

    Raises: SystemExit: the document has no such markers, or there is none.
    """
    if not document.exists():
        raise SystemExit(f"{document}: no such file")
    pattern = re.compile(rf"(<!-- {re.escape(name)} -->\n).*?(\n<!-- end of {re.escape(name)} -->)", re.DOTALL)
    if not pattern.search(document.read_text(encoding="utf-8")):
        raise SystemExit(f"{document}: expected the markers of {name!r}, got none")
    return pattern


def put(document: Path, name: str, content: str) -> None:
    """Replace what stands between two markers of a document.

    Raises: SystemExit: the document has no such markers.
    """
    text = place(document, name).sub(lambda found: found[1] + content + found[2], document.read_text(encoding="utf-8"))
    document.write_text(text, encoding="utf-8")


def commit() -> str:
    """Return the last commit that changed the simulation; "unknown" outside a repository.

    A tree with uncommitted changes there has no commit of its own: its name ends with " and changes".
    """

    def git(*arguments: str) -> str:
        command = ["git", *arguments, "--", *FLOWN]
        return subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout.strip()

    try:
        return (git("log", "-1", "--format=%h") or "unknown") + " and changes" * bool(git("status", "--porcelain"))
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
