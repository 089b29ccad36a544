"""Reading of scenarios: from TOML and command-line settings to a validated `Scenario`."""

import importlib.resources
import os
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from transport.protocol.scenario.budget import check_budget
from transport.protocol.scenario.errors import (
    PythonSetting,
    ScenarioError,
    hint,
    key_of,
    option,
    validated,
)
from transport.protocol.scenario.files import anchored
from transport.protocol.scenario.relations import check_relations
from transport.protocol.scenario.schema import Scenario

__all__ = [
    "ScenarioError",
    "find_scenario",
    "read_scenario",
    "read_tree",
    "validate",
    "with_settings",
]


def find_scenario(name: str, package: str = "scenarios") -> Path:
    """Return the file of a scenario or of another package.

    A path, or the name of a ready one, else ScenarioError.
    """
    path = Path(name)
    if os.path.exists(name) or path.suffix == ".toml" or "/" in name:  # noqa: PTH110 - false for impossible names
        return path
    folder = Path(str(importlib.resources.files(f"transport.{package}"))).resolve()
    known = sorted(file.stem for file in folder.glob("*.toml"))
    if name not in known:
        expected = f"expected a {package[:-1]} file or the name of a ready one"
        raise ScenarioError(name, "", f"{expected}; {hint(name, known)}")
    return folder / f"{name}.toml"


def read_scenario(
    path: Path, settings: Sequence[str] = (), *, allow_large: bool = False
) -> Scenario:
    """Read and validate a TOML file with settings "dotted.key=value" on top.

    Entries of lists count from 1.

    Raises: ScenarioError: naming file, or the setting that gave the field, field, expected and got.
    """
    return with_settings(read_tree(path), settings, str(path), allow_large=allow_large)


def read_tree(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raises: ScenarioError: it cannot be read."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        problem = (
            "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error})"
        )
        raise ScenarioError(str(path), "", problem) from error
    except (
        ValueError,
        RecursionError,
    ) as error:  # also of integers of thousands of digits, and of deep nesting
        raise ScenarioError(str(path), "", f"not valid TOML: {error}") from error


def with_settings(
    tree: dict[str, Any], settings: Sequence[str], source: str, *, allow_large: bool = False
) -> Scenario:
    """Return the scenario in a tree of plain data, which is changed, with settings on top as in `read_scenario`."""
    for setting in settings:
        _apply(tree, setting)
    try:
        scenario = validate(tree, source)
        if not allow_large:
            check_budget(scenario, source)
        return scenario
    except ScenarioError as error:
        raise error.blaming(settings) from error.__cause__


def validate(tree: dict[str, Any], source: str) -> Scenario:
    """Check a tree against the schema and the relations of its fields.

    Files are relative to the folder of `source`.
    """
    scenario = validated(Scenario, tree, source, Path(source).parent)
    check_relations(scenario, source)
    return scenario


def _apply(tree: dict[str, Any], setting: str) -> None:
    *parents, last = key_of(setting).split(".")
    node: Any = tree
    for part in parents:
        child = (
            node[_index(node, part, setting)]
            if isinstance(node, list)
            else node.setdefault(part, {})
        )
        if not isinstance(child, dict | list):
            raise ScenarioError(
                option(setting), "", f"expected {part!r} to be a section, got the value {child!r}"
            )
        node = child
    node[_index(node, last, setting) if isinstance(node, list) else last] = anchored(
        _value(setting), last
    )


def _value(setting: str) -> Any:
    key, separator, text = setting.partition("=")
    if isinstance(setting, PythonSetting):
        return setting.value
    if not separator or not key.strip():
        raise ScenarioError(option(setting), "", "expected key=value")
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()  # bare words are text: solver=clarabel
    except (ValueError, RecursionError) as error:
        raise ScenarioError(option(setting), "", f"not valid TOML: {error}") from error


def _index(node: list[Any], part: str, setting: str) -> int:
    if not (part.isdecimal() and 1 <= int(part) <= len(node)):
        raise ScenarioError(
            option(setting), "", f"expected an entry from 1 to {len(node)}, got {part!r}"
        )
    return int(part) - 1
