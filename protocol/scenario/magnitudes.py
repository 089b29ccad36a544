"""Ranges of all numbers of a scenario, by the unit at the end of their key.

The ranges are far wider than anything that flies. Beyond them float64 overflows or loses all digits somewhere in the
model, the QP or the clock, so such numbers are refused by name.
"""

from collections.abc import Iterator

from pydantic import BaseModel

# Smallest magnitude apart from zero, and largest.
Range = tuple[float, float]

# Longest duration and delay: decades, still countable in ticks and nanoseconds.
LONGEST_S = 1e9

WEIGHTS: Range = (1e-12, 1e8)

# By the end of the key; the longest one that fits counts.
RANGES: dict[str, Range] = {
    "": (1e-12, 1e12),
    # Weights of the cost: the condition of the QP is about their ratio.
    "position": WEIGHTS,
    "attitude": WEIGHTS,
    "yaw_rate": WEIGHTS,
    "payload_velocity": WEIGHTS,
    "terminal": WEIGHTS,
    "thrust": WEIGHTS,
    "moments": WEIGHTS,
    "weight": WEIGHTS,
    "penalty": WEIGHTS,
    "_s": (1e-9, LONGEST_S),
    "sampling_period_s": (1e-5, 10.0),
    "barrier_timeout_s": (1e-3, 1e6),
    "join_timeout_s": (1e-3, 1e6),
    "overrun_limit_s": (1e-9, 1e6),
    "_hz": (1e-9, 1e9),
    "speed": (1e-4, 1e4),
    "_m": (1e-12, 1e6),
    "way": (0.0, LONGEST_S),
    "displacement_m": (0.0, 1e6),  # that of a path from a file is a difference of its rows
    "_mps": (1e-12, 1e4),
    "_mps2": (1e-6, 1e4),
    "_rad": (1e-12, 1e4),
    "_rads": (1e-12, 1e4),
    "position_m": (1e-12, 1e4),
    "_kg": (1e-9, 1e6),
    "_kgm2": (1e-12, 1e9),
    "rod_length_m": (1e-3, 1e4),
    "rho_m": (1e-12, 1e4),
}


def out_of_range(section: BaseModel, place: str = "") -> Iterator[tuple[str, str]]:
    """Yield field, and expected and got, of each number of a section beyond its range.

    List entries count from 1. `place` is the section's own field, empty for the whole scenario.
    """
    for name, field in type(section).model_fields.items():
        if name in section.model_fields_set:
            key = field.alias or name
            yield from _checked(key, f"{place}.{key}" if place else key, getattr(section, name))


def _checked(key: str, place: str, value: object) -> Iterator[tuple[str, str]]:
    if isinstance(value, BaseModel):
        yield from out_of_range(value, place)
    elif isinstance(value, list):
        for number, entry in enumerate(value, start=1):
            yield from _checked(key, f"{place}.{number}", entry)
    elif isinstance(value, float):
        smallest, largest = RANGES[max((end for end in RANGES if key.endswith(end)), key=len)]
        if abs(value) > largest:
            yield place, f"expected a magnitude of at most {largest:g}, got {value:g}"
        elif 0.0 < abs(value) < smallest:
            yield place, f"expected a magnitude of at least {smallest:g}, got {value:g}"
