"""Arguments of the Python interface: settings by dotted key or short name, and errors about them."""

import difflib
import json
from collections.abc import Mapping, Sequence
from importlib import import_module
from os import PathLike
from typing import Any, Literal, TypedDict

import numpy as np
import tomli_w
from rich.console import Console, RenderableType

from protocol.scenario.errors import PythonSetting
from protocol.scenario.keys import short_names
from protocol.wire.errors import TransportError

Settings = Mapping[str, Any]


class ArgumentError(TransportError, TypeError):
    """An argument of the Python interface that is refused: its text is one line with argument, expected and got."""


class ShortSettings(TypedDict, total=False):
    """Keyword arguments that stand for keys of the scenario; `KEY_OF` has the keys, docs/scenario.md their meaning."""

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


# Keys of the scenario by their short names.
KEY_OF: Mapping[str, str] = short_names()


def key_of(name: str) -> str:
    """Return the dotted key of a setting given by its key or its short name.

    Raises: ArgumentError: a name without a dot that is neither a short name nor a key of the top level.
    """
    if name in KEY_OF:
        return KEY_OF[name]
    if "." in name or name in ("name", "seed", "schema", "obstacle"):
        return name
    near = difflib.get_close_matches(name, KEY_OF, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(KEY_OF)}"
    raise ArgumentError(f"{name}: expected a dotted key such as 'links.delay_s' or a short name; {hint}")


def settings_of(settings: Settings | None, short: Mapping[str, Any]) -> list[str]:
    """Return settings by dotted key, then keyword arguments, in the form of the command line.

    Raises: ArgumentError: an unknown keyword argument, a key given twice, or a value that TOML cannot hold.
    """
    found: dict[str, str] = {}
    for name, value in [*(settings or {}).items(), *short.items()]:
        key = key_of(name)
        if key in found:
            raise ArgumentError(f"{name}: expected each key once, got {key} twice")
        if isinstance(value, type):  # a controller or an engine
            value = f"{value.__module__}:{value.__qualname__}"
        found[key] = PythonSetting(f"{key}={_toml(value, name)}")
    return list(found.values())


def printed(table: RenderableType, width: int) -> str:
    """Return a table as text of a width, characters."""
    console = Console(width=width, force_jupyter=False, force_terminal=False, no_color=True)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().rstrip().splitlines())


def require_pandas() -> Any:
    """Return the module pandas; raise ArgumentError if it is not installed."""
    try:
        return import_module("pandas")
    except ModuleNotFoundError as error:
        raise ArgumentError("pandas is not installed: pip install 'payload-transport[pandas]'") from error


def _toml(value: Any, name: str) -> str:
    """Return a value as TOML on one line; floats keep their bits."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        parts = (f"{json.dumps(str(key), ensure_ascii=False)} = {_toml(part, name)}" for key, part in value.items())
        return f"{{{', '.join(parts)}}}"
    if isinstance(value, list | tuple | range):
        return f"[{', '.join(_toml(part, name) for part in value)}]"
    if isinstance(value, PathLike):
        value = str(value)
    if isinstance(value, bool | int | float | str):
        return tomli_w.dumps({"_": value}).removeprefix("_ = ").rstrip("\n")
    expected = "expected a number, text, true or false, or lists and dictionaries of these"
    raise ArgumentError(f"{name}: {expected}, got {type(value).__name__} {value!r:.60}")
