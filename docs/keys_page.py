"""Make docs/keys.md from the schema and protocol/scenario/keys.toml: part of `make reference`."""

import sys

from tables import ROOT, table

from protocol.scenario.keys import Key, KeySection, sections

DOCUMENT = ROOT / "docs" / "keys.md"
HEAD = """\
# Keys of a scenario

Made by `make reference` from the schema and `protocol/scenario/keys.toml`. Files, `--set` and the ready scenarios:
[scenario.md](scenario.md).

A default of "required" means that the key must be given where its section is used; "left out" that there is no value
unless one is given. Double brackets mark sections that may be given several times.
"""


def page() -> str:
    """Return the page."""
    return HEAD + "\n" + "\n".join(map(_section, sections()))


def _section(section: KeySection) -> str:
    if not section.path:
        heading = "## Top level"
    else:
        heading = f"## `[[{section.path}]]`" if section.is_list else f"## `[{section.path}]`"
    columns = ["key", "type", "unit", "default", "meaning"]
    rows = table(columns, map(_row, section.keys)) if section.keys else ""
    return "\n\n".join(part for part in (heading, section.about, rows, section.after) if part) + "\n"


def _row(key: Key) -> list[str]:
    default = key.default if key.default in ("required", "left out") else f"`{key.default}`"
    return [f"`{key.name}`", key.type, key.unit, default, key.meaning]


if __name__ == "__main__":
    DOCUMENT.write_text(page(), encoding="utf-8")
    sys.stdout.write(f"{DOCUMENT}\n")
