"""A scenario as a readable TOML file: a comment on top, every list on one line."""

from collections.abc import Iterator, Sequence
from typing import Any

import tomli_w


def scenario_text(tree: dict[str, Any], comment: Sequence[str]) -> str:
    """Return a scenario in TOML.

    Args:
        tree: The scenario as plain data; its keys are bare words.
        comment: Lines for the top; TOML forbids most unprintable characters, so each becomes a question mark.
    """
    top = ["# " + "".join(c if c.isprintable() else "?" for c in line) for line in comment]
    return "\n".join([*top, *_table(tree, ""), ""])


def _table(tree: dict[str, Any], path: str) -> Iterator[str]:
    """Yield the lines of a table: its values first, as everything after a heading belongs to that heading."""
    tables: list[tuple[str, str, dict[str, Any]]] = []
    for key, value in tree.items():
        name = path + key
        if isinstance(value, dict):
            tables.append((f"[{name}]", name, value))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            tables += [(f"[[{name}]]", name, entry) for entry in value]
        else:
            yield f"{key} = {_value(value)}"
    for heading, name, table in tables:
        yield from ("", heading)
        yield from _table(table, f"{name}.")


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return tomli_w.dumps({"_": value}).removeprefix("_ = ").rstrip("\n")
