"""Finding of a check."""

from typing import Literal, NamedTuple


class Finding(NamedTuple):
    """Result of a check: its status, the measured state, and advice if there is any."""

    status: Literal["ok", "warn", "fail"]  # warn: a run works, with restrictions; fail: a run does not work
    found: str
    advice: str = ""
