"""Pages made from the code: up to date, and whole."""

import re
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from annotated_types import Interval, Len

from transport.model.section import Vector
from transport.protocol.scenario.sections.link_sections import LinkSection
from transport.protocol.scenario.sections.scenario_keys import fields, section_in, unit_of
from transport.protocol.scenario.sections.schema import Scenario

ROOT = Path(__file__).resolve().parent.parent


def test_made_files_are_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of docs/ that are made from the code are what the code makes of them.

    Else run `make reference`.
    """
    monkeypatch.syspath_prepend(ROOT / "docs")
    program: Any = import_module("reference_page")
    for page, made in (
        (program.KEYS, program.keys_page()),
        (program.COMMANDS, program.commands_page()),
    ):
        assert made == page.read_text(encoding="utf-8"), "make reference"


def test_every_key_is_on_the_page() -> None:
    """docs/reference/keys.md has an entry with a meaning for each key of the scenario.

    Default, type and unit are the schema's.
    """
    text = (ROOT / "docs" / "reference" / "keys.md").read_text(encoding="utf-8")
    rows: dict[str, tuple[str, ...]] = {}
    for path, entries in re.findall(
        r"<!-- keys of (\S+) -->\n(.*?)\n<!-- end of keys -->", text, re.DOTALL
    ):
        for name, facts, meaning in re.findall(
            r"^- `(\w+)` \((.+?)\): (.+)$", entries, re.MULTILINE
        ):
            kind, default = facts.rsplit("; ", 1)
            rows[f"{path}.{name}".removeprefix("scenario.")] = kind, default, meaning
    like_links = re.compile(r"links\.(measurement|actuation|override|change)\.")
    for key, field in fields(Scenario).items():
        repeated = like_links.match(key) and key.rpartition(".")[2] in {
            *LinkSection.model_fields,
            "enter",
            "leave",
        }
        if section_in(field.annotation) is not None or repeated:
            continue
        kind, default, meaning = rows.pop(key)
        unit = unit_of(key, field)
        assert kind.removesuffix(f"; {unit}") != (unit and kind), key
        assert meaning, key
        if field.is_required() or field.default is None:
            assert default == ("required" if field.is_required() else "left out")
        else:
            value = tomllib.loads(f"value = {default.strip('`')}")["value"]
            known = tuple(field.default) if isinstance(field.default, list) else field.default
            assert (tuple(value) if isinstance(value, list) else value) == known, key
    assert not rows


@pytest.mark.parametrize(
    ("annotation", "text"),
    [
        (bool, "true, false"),
        (float | None, "number"),
        (Annotated[float, Interval(gt=0.0, lt=90.0)], "number > 0, < 90"),
        (Annotated[int, Interval(ge=1, le=65_535)], "integer, 1 to 65 535"),
        # The limit of a key is that of its own, on top of that of its type.
        (Annotated[Annotated[float, Interval(ge=0.0)], Interval(ge=2.0)], "number >= 2"),
        (Literal["daqp", "clarabel"], "daqp, clarabel"),
        (Vector, "3 numbers"),
        (list[Annotated[float, Interval(ge=0.0)]], "list of numbers >= 0"),
        (Annotated[tuple[int, ...], Len(2, 2)], "2 integers"),
    ],
)
def test_types_and_ranges_as_text(
    monkeypatch: pytest.MonkeyPatch, annotation: Any, text: str
) -> None:
    """A value that may be left out has the text of its type; lists have their number of entries."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    assert import_module("reference_page").type_of(annotation) == text


def test_a_list_of_many_commands_is_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to ten are named, commands of a group as the group."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    of_group = import_module("reference_page")._of_group
    names = [f"group{number % 10} command{number}" for number in range(20)]
    assert of_group(names) == [f"group{number}" for number in range(10)]
    assert of_group([*names, "another"]) == ["most"]


def test_a_key_without_a_meaning_or_a_place_ends_the_program(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """It is named, and no page is written without it."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    program: Any = import_module("reference_page")
    page = tmp_path / "keys.md"
    text = program.KEYS.read_text(encoding="utf-8")
    page.write_text(text.replace("<!-- keys of radio -->", ""), encoding="utf-8")
    monkeypatch.setattr(program, "KEYS", page)
    with pytest.raises(SystemExit, match=r"keys\.md: expected a list of radio, got none"):
        program.keys_page()
    monkeypatch.setattr(program, "meanings", lambda _: {})
    with pytest.raises(SystemExit, match=r"Scenario, \w+: expected a docstring, got none"):
        program.keys_page()
