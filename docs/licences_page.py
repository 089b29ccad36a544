"""Makes docs/licences.md: every package that gets installed, by whom it is asked for, and under which licence.

From the metadata of what is installed and pinned; run by `make licences`.
"""

import re
import sys
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DOCUMENT = ROOT / "docs" / "licences.md"
LOCKS = {"to run": "requirements.lock", "to develop and test": "requirements-dev.lock"}
PINNED = re.compile(r"^([A-Za-z0-9_.-]+)==(\S+)", re.MULTILINE)

# Licences missing in the metadata of packages, or given there as a page of text: read in their own files.
TOLD = {
    "casadi": "LGPL-3.0-or-later",
    "clarabel": "Apache-2.0",
    "eclipse-zenoh": "EPL-2.0 OR Apache-2.0",
    "daqp": "MIT",
    "quadprog": "GPL-2.0-or-later",
    "proxsuite": "BSD-2-Clause",
}


def pinned(lock: str) -> dict[str, str]:
    """Versions by package of a lock file; several where versions of Python differ."""
    found: dict[str, str] = {}
    for package, version in PINNED.findall((ROOT / lock).read_text(encoding="utf-8")):
        found[package] = f"{found[package]}, {version}" if package in found else version
    return found


def licence(package: str) -> str:
    """A package's licence by its own account."""
    if package in TOLD:
        return TOLD[package]
    try:
        told = metadata(package)
    except PackageNotFoundError:
        return "not installed here (another platform's, or optional)"
    expression = told.get("License-Expression")
    if expression:
        return str(expression)
    classified = [
        line.rpartition(" :: ")[2] for line in told.get_all("Classifier") or [] if line.startswith("License ::")
    ]
    short = str(told.get("License") or "").strip()
    if classified:
        return ", ".join(classified)
    return short if short and len(short) < 60 else "see the package"


def main() -> None:
    """Write the document."""
    lines = [
        "# Licences",
        "",
        "Every package that `make lock` pins, and its licence by its own metadata; made by `make licences`. Which are",
        "asked for, and why: [decisions.md](decisions.md#dependencies). The project itself: Apache-2.0.",
        "The extra `firmware`, under the GPL-3, is not pinned: separate processes, which the user installs.",
    ]
    seen: set[str] = set()
    for purpose, lock in LOCKS.items():
        lines += ["", f"## Needed {purpose}", "", "| package | version | licence |", "|---|---|---|"]
        for package, version in sorted(pinned(lock).items()):
            if package not in seen:
                lines.append(f"| {package} | {version} | {licence(package)} |")
        seen |= set(pinned(lock))
    DOCUMENT.write_text("\n".join(lines) + "\n", encoding="utf-8")
    sys.stdout.write(f"{DOCUMENT}\n")


if __name__ == "__main__":
    main()
