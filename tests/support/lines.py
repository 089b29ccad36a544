"""Lines of Python by folder beside their budget: `make lines`.

A budget is no limit: it tells that a feature has to say in its commit what it removes, or why it may add.
"""

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def lines_of(pattern: str) -> int:
    """Return the lines of all tracked Python files that match a pattern of git."""
    command = ["git", "ls-files", "-z", "--", pattern]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    return sum((ROOT / name).read_bytes().count(b"\n") for name in names if name and (ROOT / name).exists())


def main() -> None:
    """Print the table."""
    budgets: dict[str, int] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["lines"]
    found = {folder: lines_of(f"{folder}/*.py") for folder in budgets}
    code = [folder for folder in budgets if folder != "tests"]
    rows = [(folder, found[folder], budgets[folder]) for folder in budgets]
    # Also files of folders without a budget.
    rows.append(("outside tests", lines_of("*.py") - found["tests"], sum(budgets[folder] for folder in code)))
    sys.stdout.write(f"{'lines of Python':<24}{'now':>8}{'budget':>8}\n")
    for folder, now, budget in rows:
        sys.stdout.write(f"{folder:<24}{now:>8,}{budget:>8,}{'  over' if now > budget else ''}\n")


if __name__ == "__main__":
    main()
