"""Arguments of the Python interface: settings by dotted key or short name, and their errors."""

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Literal, TypedDict

import numpy as np
from rich.console import Console, RenderableType

from transport.protocol.scenario.sections.scenario_errors import PythonSetting, hint
from transport.protocol.scenario.sections.scenario_keys import short_names
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.wire.errors_and_exit_codes import TransportError

Settings = Mapping[str, Any]


class ArgumentError(TransportError, TypeError):
    """An argument of the Python interface that is refused.

    Its text is one line with argument, expected and got.
    """


def names_of(value: str | Sequence[str]) -> tuple[str, ...]:
    """Return names that are a sequence, or one text with commas between them."""
    if isinstance(value, str):
        return tuple(name.strip() for name in value.split(",") if name.strip())
    return tuple(value)


def import_pandas() -> Any:
    """Return the package pandas. Raises: ArgumentError: it is not installed."""
    try:
        import pandas as pd
    except ModuleNotFoundError as error:
        remedy = "pip install 'payload-transport[pandas]'"
        raise ArgumentError(f"expected the package pandas, got none: {remedy}") from error
    return pd


class ShortSettings(TypedDict, total=False):
    """Keyword arguments that stand for keys of the scenario.

    `KEY_OF` has the keys, docs/scenario.md their meaning.
    """

    seed: int
    horizon: int
    sampling_period_s: float
    relaxation: float | Literal["auto"]
    solver: Literal["daqp", "clarabel"]
    prediction: Literal["open_loop", "closed_loop"]
    share: Literal["always", "on_change"]
    estimate_disturbance: bool
    owned: Sequence[Sequence[int]]
    controller: str | type
    delay_s: float
    jitter_s: float
    loss: float
    on_agent_loss: Literal["abort", "continue"]
    faults: Sequence[Mapping[str, Any]]
    phases: Sequence[Mapping[str, Any]]
    obstacles: Sequence[Mapping[str, Any]]
    payload_mass_factor: float
    wind_mps: Sequence[float]
    gust_mps: Sequence[float]


KEY_OF: Mapping[str, str] = short_names(Scenario)  # keys of the scenario
_SECTIONS = frozenset(field.alias or name for name, field in Scenario.model_fields.items())


def key_of(name: str) -> str:
    """Return the dotted key of a setting given by its key or its short name.

    Raises: ArgumentError: it is another name.
    """
    if name in KEY_OF:
        return KEY_OF[name]
    if "." in name or name in _SECTIONS:
        return name
    expected = "expected a dotted key such as 'links.delay_s' or a short name"
    raise ArgumentError(f"{name}: {expected}; {hint(name, KEY_OF)}")


def settings_of(settings: Settings | None, short: Mapping[str, Any]) -> list[str]:
    """Return settings by dotted key, then keyword arguments.

    Raises: ArgumentError: a key is unknown or repeated.
    """
    by_key: dict[str, PythonSetting] = {}
    for name, given in [*(settings or {}).items(), *short.items()]:
        key = key_of(name)
        if key in by_key:
            raise ArgumentError(f"{name}: expected each key once, got {key} twice")

        value = plain(given)
        setting = PythonSetting(f"{key}={value!r}")
        setting.value = value
        by_key[key] = setting
    return list(by_key.values())


def plain(value: Any) -> Any:
    """Return a value without types of NumPy, paths and classes.

    A class, such as that of a controller, is named.
    """
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple | range):
        return [plain(part) for part in value]
    if isinstance(value, type):
        return f"{value.__module__}:{value.__qualname__}"
    return str(value) if isinstance(value, PathLike) else value


def printed(table: RenderableType, width: int) -> str:
    """Return a table as text of a width, characters."""
    console = Console(width=width, force_jupyter=False, force_terminal=False, no_color=True)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())
