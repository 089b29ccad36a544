"""Make docs/record/licences.md, every pinned package with its licence by its own metadata.

`make licences`.
"""

import re
from importlib.metadata import PackageNotFoundError, metadata

from tables import ROOT, table

LOCKS = {"to run": "requirements.lock", "to develop and test": "requirements-dev.lock"}
HEAD = """\
# Licences

Every package that `make lock` pins, and its licence by its own metadata; made by `make licences`. Which are
asked for, and why: [decisions.md](decisions.md#dependencies). The project itself: Apache-2.0.
The extra `firmware`, under the GPL-3, is not pinned: separate processes, which the user installs.
"""

# Licences missing in the metadata of packages, or given there as a page of text: read in their own
# files.
TOLD = {
    "casadi": "LGPL-3.0-or-later",
    "clarabel": "Apache-2.0",
    "eclipse-zenoh": "EPL-2.0 OR Apache-2.0",
    "daqp": "MIT",
}


def licence(package: str) -> str:
    """Return a package's licence by its own account."""
    if package in TOLD:
        return TOLD[package]
    try:
        told = metadata(package)
    except PackageNotFoundError:
        return "not installed here (another platform's, or optional)"
    classifiers = told.get_all("Classifier") or []
    classified = ", ".join(
        line.rpartition(" :: ")[2] for line in classifiers if line.startswith("License ::")
    )
    short = str(told.get("License") or "").strip()
    return str(
        told.get("License-Expression")
        or classified
        or (short if 0 < len(short) < 60 else "see the package")
    )


def main() -> None:
    """Write the document."""
    text, seen = HEAD, set[str]()
    for purpose, lock in LOCKS.items():
        content = (ROOT / lock).read_text(encoding="utf-8")
        # A package is pinned twice where its versions differ with those of Python.
        pinned = re.findall(r"^([A-Za-z0-9_.-]+)==(\S+)", content, re.MULTILINE)
        rows = [
            [name, version, licence(name)] for name, version in sorted(pinned) if name not in seen
        ]
        text += f"\n## Needed {purpose}\n\n{table(['package', 'version', 'licence'], rows)}\n"
        seen |= {name for name, _ in pinned}
    (ROOT / "docs" / "record" / "licences.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
