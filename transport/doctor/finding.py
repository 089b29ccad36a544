"""Finding of a check."""

from typing import Literal, NamedTuple


class Finding(NamedTuple):
    """Result of a check.

    Attributes:
        status: ok; warn: a run works, with restrictions; fail: a run does not work.
        found: What was found.
        advice: What to do; empty for nothing.
    """

    status: Literal["ok", "warn", "fail"]
    found: str
    advice: str = ""
