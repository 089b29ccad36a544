"""Docstrings of the project as the site shows them: examples as code, short sections such as `Raises: X` as text."""

import re
from typing import Any

from griffe import Extension, Object

_SECTION = re.compile(r"(Raises|Returns|Source): (.+)")


class ProjectDocstrings(Extension):
    """Rewrites each docstring for the parser, which knows neither doctests outside of a section nor short sections."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite the docstring of a module, class, function or attribute."""
        if obj.docstring is not None:
            obj.docstring.value = rewritten(obj.docstring.value)


def rewritten(text: str) -> str:
    """Return a docstring with fenced examples, and each short section as one paragraph."""
    lines: list[str] = []
    is_example = is_section = False
    for line in text.splitlines():
        if is_example and not line.strip():
            lines.append("```")
            is_example = False
        elif not is_example and line.startswith(">>> "):
            lines += ["", "```pycon"]
            is_example = True
        section = _SECTION.fullmatch(line)
        if section and not is_example:
            lines += ["", f"**{section[1]}:** {section[2]}"]
            is_section = True
        elif is_section and line.startswith("    "):
            lines.append(line.strip())
        else:
            is_section = False
            lines.append(line)
    return "\n".join([*lines, "```"] if is_example else lines)
