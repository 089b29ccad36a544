"""Errors of scenarios: one line with file, field, what was expected and what came, also from pydantic's problems."""

import difflib
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from transport.model.arrays import ShapeError
from transport.model.parameters import ParameterError
from transport.mpc.feedback import FeedbackError
from transport.mpc.settings import SettingsError
from transport.protocol.scenario.keys import names_of, out_of_range, section_in
from transport.protocol.wire.errors import MessageError, TransportError
from transport.protocol.wire.exit_codes import EXIT_SCENARIO

T = TypeVar("T")
S = TypeVar("S", bound=BaseModel)


class ScenarioError(TransportError, ValueError):
    """An invalid scenario: `file or option.

    Dotted key, with list entries from 1: expected ..., got ...`.
    """

    exit_code = EXIT_SCENARIO

    def __init__(self, source: str, field: str, problem: str) -> None:
        text = ": ".join(part for part in (source, field, problem) if part)
        super().__init__(" ".join(text.splitlines()))
        self.field, self.problem = field, problem

    def blaming(self, settings: Sequence[str]) -> "ScenarioError":
        """Return the same error, with the settings in place of the file if they gave the field or part of it."""
        own = f"{self.field}."
        given = [
            s
            for s in settings
            if own.startswith(f"{key_of(s)}.") or f"{key_of(s)}.".startswith(own)
        ]
        if not given:
            return self
        field = "" if [key_of(setting) for setting in given] == [self.field] else self.field
        return ScenarioError(" ".join(map(option, given)), field, self.problem)


class RequestError(TransportError, MessageError):
    """A change of links or a target that is refused; the text says what was expected and what came."""

    def __init__(self, text: str) -> None:
        super().__init__("out_of_range", text)


def building(source: str, field: str, build: Callable[[], T]) -> T:
    """Return a model object built from a scenario's values.

    Its errors become a `ScenarioError` of that field.
    """
    try:
        return build()
    except (FeedbackError, ParameterError, RequestError, SettingsError, ShapeError) as error:
        raise ScenarioError(source, field, str(error)) from error


def key_of(setting: str) -> str:
    """Return the dotted key of a setting "key=value"."""
    return setting.partition("=")[0].strip()


class PythonSetting(str):
    """A setting that was given in Python.

    It has its value, and errors name no option of the command line.
    """

    value: Any


def option(setting: str) -> str:
    """Return a setting as it was given on the command line or in Python, shortened when it is long."""
    text = _short(setting) or repr(setting)
    return text if isinstance(setting, PythonSetting) else f"--set {text}"


def hint(name: str, known: Collection[str]) -> str:
    """Return the known name that a mistyped one may stand for, or all."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known) or 'none'}"


def _short(text: str) -> str:
    return text if len(text) <= 80 else text[:77] + "..."


def validated(section: type[S], tree: Any, source: str = "", folder: Path | None = None) -> S:
    """Return a section of plain data, with files relative to a folder.

    Raise ScenarioError with the first problem.
    """
    try:
        found = section.model_validate(tree, context=folder)
    except ValidationError as error:
        # An unknown key first: a mistyped one is also missing.
        problem = min(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
        raise ScenarioError(source, *_problem(problem, section)) from error
    for field, text in out_of_range(found):
        raise ScenarioError(source, field, text)
    return found


def requested(section: type[S], tree: Any) -> S:
    """Return what a request asks for. Raises: RequestError: it is not valid, whatever the run."""
    try:
        return validated(section, tree)
    except ScenarioError as error:
        raise RequestError(str(error)) from error


def _problem(problem: Any, section: type[BaseModel]) -> tuple[str, str]:
    """Return the field of one of pydantic's problems, and the problem."""
    kind, message, value = problem["type"], problem["msg"], problem["input"]
    last = problem["loc"][-1] if problem["loc"] else ""
    field: list[str] = []
    for part in problem[
        "loc"
    ]:  # pydantic also names the branch of a union that it tried, which is no key
        names = names_of(section)
        if part in names:
            section = section_in(section.model_fields[names[part]].annotation) or section
        if isinstance(part, int):
            field.append(str(part + 1))
        elif part in names or (kind == "extra_forbidden" and part is last):
            field.append(part)
    if kind == "extra_forbidden":
        return ".".join(field), f"unknown key; {hint(str(last), names_of(section))}"
    if kind == "missing":
        return ".".join(field), "expected a value, got nothing"
    if kind == "value_error":  # of a validator, whose text says all
        return ".".join(field), str(problem["ctx"]["error"])
    expected = message.replace("Input should be", "expected")
    shown = list(value) if isinstance(value, tuple) else value  # lists of numbers become tuples
    return ".".join(field), f"{expected[0].lower()}{expected[1:]}, got {_short(repr(shown))}"
