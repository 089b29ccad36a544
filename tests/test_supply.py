"""Dependencies are pinned and their licences are listed."""

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PINNED = re.compile(r"^([A-Za-z0-9_.-]+)==([^\s;]+)(?:.* \\)?(?: ;.*)?$", re.MULTILINE)


def pinned(lock: str) -> list[tuple[str, str]]:
    """Packages and versions of a lock file."""
    return PINNED.findall((ROOT / lock).read_text(encoding="utf-8"))


def asked_for(*extras: str) -> list[Requirement]:
    """Return the requirements of the project with some extras."""
    texts = [
        *PROJECT["dependencies"],
        *[text for extra in extras for text in PROJECT["optional-dependencies"][extra]],
    ]
    return [found for text in texts if (found := Requirement(text)).name != "payload-transport"]


def test_locks_fit_the_project() -> None:
    """Every package that is asked for is in the lock, in a version that is allowed.

    Else run `make lock`.
    """
    for lock, extras in (
        ("requirements.lock", ("deploy", "metrics")),
        (
            "requirements-dev.lock",
            tuple(extra for extra in PROJECT["optional-dependencies"] if extra != "firmware"),
        ),
    ):
        versions = pinned(lock)
        for requirement in asked_for(*extras):
            name = requirement.name.lower().replace("_", "-")
            found = [version for package, version in versions if package == name]
            assert found, f"{lock}: {name} is missing: make lock"
            assert all(requirement.specifier.contains(version) for version in found), (
                f"{lock}: {requirement}"
            )


def test_every_pin_has_hashes() -> None:
    """No line of a lock is without a hash, so that nothing but what was pinned can be installed."""
    for lock in ("requirements.lock", "requirements-dev.lock"):
        text = (ROOT / lock).read_text(encoding="utf-8")
        for entry in re.split(r"\n(?=[a-z0-9])", text)[1:]:
            assert "--hash=sha256:" in entry, entry[:80]


def test_licences_are_listed() -> None:
    """docs/record/licences.md has a row for each pinned package; else run `make licences`."""
    rows = (ROOT / "docs" / "record" / "licences.md").read_text(encoding="utf-8")
    for lock in ("requirements.lock", "requirements-dev.lock"):
        missing = [package for package, _ in pinned(lock) if f"\n| {package} |" not in rows]
        assert missing == [], "make licences"
