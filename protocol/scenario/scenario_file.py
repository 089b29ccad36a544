"""Reading of scenarios: from TOML and command-line settings to a validated `Scenario`."""

import importlib.resources
import os
import tomllib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from transport.protocol.scenario.checks.relations import check_relations
from transport.protocol.scenario.files.bounded_reading import TooLargeError, read_text
from transport.protocol.scenario.files.named_files import anchored
from transport.protocol.scenario.sections.limits_on_size import check_size
from transport.protocol.scenario.sections.scenario_errors import (
    PythonSetting,
    ScenarioError,
    dotted_key,
    hint,
    option,
    validated,
)
from transport.protocol.scenario.sections.scenario_keys import is_list
from transport.protocol.scenario.sections.schema import Scenario

_MOST_DIGITS = 9  # of the number of an entry of a list, and characters of one that an error repeats

__all__ = [
    "ScenarioError",
    "find_ready",
    "find_scenario",
    "read_scenario",
    "read_tree",
    "validate",
    "with_settings",
]


def find_scenario(name: str) -> Path:
    """Return the file of a scenario, by its path or the name of a ready one.

    Raises: ScenarioError: neither.
    """
    return find_ready(name, "scenarios", "scenario")


def find_ready(name: str, folder: str, kind: str) -> Path:
    """Return a file by its path, or by its name among the ready ones of a folder.

    `kind` is the kind of file, as errors call it. Raises: ScenarioError: neither.
    """
    path = Path(name)
    is_there = os.path.exists(name)  # noqa: PTH110 - false for impossible names
    if is_there or path.suffix == ".toml" or "/" in name:
        return path

    place = Path(str(importlib.resources.files(f"transport.{folder}"))).resolve()
    ready = sorted(file.stem for file in place.glob("*.toml"))
    if name not in ready:
        expected = f"expected a {kind} file or the name of a ready one"
        raise ScenarioError(name, "", f"{expected}; {hint(name, ready)}")
    return place / f"{name}.toml"


def read_scenario(
    path: Path, settings: Sequence[str] = (), *, allow_large: bool = False
) -> Scenario:
    """Read and validate a TOML file with settings "dotted.key=value" on top.

    Entries of lists count from 1.

    Raises: ScenarioError: naming the file or the setting that gave the field, field, expected, got.
    """
    return with_settings(read_tree(path), settings, str(path), allow_large=allow_large)


def read_tree(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file.

    Raises: ScenarioError: it cannot be read.
    """
    source = str(path)
    try:
        return tomllib.loads(read_text(path))
    except FileNotFoundError as error:
        raise ScenarioError(source, "", "no such file") from error
    except (OSError, TooLargeError) as error:
        raise ScenarioError(source, "", f"cannot be read ({error})") from error
    except (ValueError, RecursionError) as error:  # also thousands of digits, and deep nesting
        raise ScenarioError(source, "", f"not valid TOML: {error}") from error


def with_settings(
    tree: dict[str, Any], settings: Sequence[str], source: str, *, allow_large: bool = False
) -> Scenario:
    """Return the scenario in a tree of plain data, which is changed, with settings on top.

    Raises: ScenarioError: as `read_scenario`.
    """
    for setting in settings:
        _apply(tree, setting)
    _run_realtime_at_speed_1(tree, [dotted_key(setting) for setting in settings])

    try:
        scenario = validate(tree, source)
        if not allow_large:
            check_size(scenario, source)
        return scenario
    except ScenarioError as error:
        raise error.blaming(settings) from error.__cause__


def validate(tree: dict[str, Any], source: str) -> Scenario:
    """Check a tree against the schema and the relations of its fields.

    Files are relative to the folder of `source`. Raises: ScenarioError: as `read_scenario`.
    """
    scenario = validated(Scenario, tree, source, Path(source).parent)
    check_relations(scenario, source)
    return scenario


def _run_realtime_at_speed_1(tree: dict[str, Any], keys_set: Collection[str]) -> None:
    """Set speed 1 where settings ask for real time alone: the file's 0 was meant for lockstep."""
    clock = tree.get("clock")
    if "clock.mode" not in keys_set or "clock.speed" in keys_set or not isinstance(clock, dict):
        return
    if clock.get("mode") == "realtime" and clock.get("speed") == 0.0:
        clock["speed"] = 1.0


def _apply(tree: dict[str, Any], setting: str) -> None:
    """Set one value in a tree of plain data."""
    parts = dotted_key(setting).split(".")
    last = parts[-1]

    section: Any = tree
    for depth, below in enumerate(parts[1:], start=1):
        section = _child(section, parts[:depth], below, setting)

    place = _index(section, last, setting) if isinstance(section, list) else last
    # Its files are relative to the current folder, unlike those of the scenario's file.
    section[place] = anchored(_value(setting), last)


def _child(section: Any, path: Sequence[str], below: str, setting: str) -> Any:
    """Return a section or list within another one, by number, or by name and made if missing.

    `path` are the parts of the key as far as it, `below` is the one after it: a list that is missing
    has no entry to be numbered.
    """
    part = path[-1]
    if isinstance(section, list):
        return section[_index(section, part, setting)]
    if part not in section and below.isdecimal() and is_list(Scenario, path):
        expected = f"expected a list that the file gives, got {part!r} left out"
        raise ScenarioError(option(setting), "", f"{expected}: set the whole list")

    child = section.setdefault(part, {})
    if not isinstance(child, dict | list):
        problem = f"expected {part!r} to be a section, got the value {child!r}"
        raise ScenarioError(option(setting), "", problem)
    return child


def _value(setting: str) -> Any:
    """Return the value of a setting: TOML, or else a text."""
    if isinstance(setting, PythonSetting):
        return setting.value

    key, separator, text = setting.partition("=")
    if not separator or not key.strip():
        raise ScenarioError(option(setting), "", "expected key=value")
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()  # bare words are text: solver=clarabel
    except (ValueError, RecursionError) as error:
        raise ScenarioError(option(setting), "", f"not valid TOML: {error}") from error


def _index(entries: list[Any], part: str, setting: str) -> int:
    """Return the index of an entry of a list, given from 1."""
    # Python refuses to read numbers of thousands of digits: none of them is an entry.
    is_short = part.isdecimal() and len(part) <= _MOST_DIGITS
    if not (is_short and 1 <= int(part) <= len(entries)):
        expected = f"expected an entry from 1 to {len(entries)}"
        raise ScenarioError(option(setting), "", f"{expected}, got {part[:_MOST_DIGITS]!r}")
    return int(part) - 1
