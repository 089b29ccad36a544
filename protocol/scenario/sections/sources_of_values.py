"""Sources of the values of a merged scenario, so that an error names the right one."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Source of the value of one key, or of all keys of one section."""

    key: str  # dotted, with list entries from 1
    source: str  # file or option, as errors name it

    def gave(self, field: str) -> bool:
        """Return whether it gave the whole of a field."""
        return f"{field}.".startswith(f"{self.key}.")

    def gave_part_of(self, field: str) -> bool:
        """Return whether it gave something within a field."""
        return self.key.startswith(f"{field}.")


def source_of(field: str, source: str, origins: Sequence[Origin]) -> str:
    """Return the most specific source of a field, else the given one with those of parts."""
    whole = [origin for origin in origins if origin.gave(field)]
    if whole:
        return max(whole, key=lambda origin: len(origin.key)).source

    parts = [origin.source for origin in origins if origin.gave_part_of(field)]
    return " with ".join(dict.fromkeys([source, *parts]))


def origins_in(tree: Any, source: str, key: str = "") -> Iterator[Origin]:
    """Yield an origin for every value of a tree of plain data, whose lists are values."""
    if not isinstance(tree, dict):
        yield Origin(key=key, source=source)
        return
    for name, value in tree.items():
        yield from origins_in(value, source, f"{key}.{name}".lstrip("."))
