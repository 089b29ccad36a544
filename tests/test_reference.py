"""Pages and pictures made from the code: up to date, and whole."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from protocol.scenario import keys
from protocol.scenario.keys import MeaningError, schema_sections, sections, toml, type_of
from protocol.scenario.link_sections import LinkSection
from protocol.scenario.schema import Scenario
from tests.support.command_tree import every_command, root

ROOT = Path(__file__).resolve().parent.parent

# Prints what the program of a page would write.
MADE = {
    "keys.md": "import keys_page; print(keys_page.page(), end='')",
    "commands.md": "import commands_page; print(commands_page.page(), end='')",
    "images/architecture.svg": "import pictures; print(pictures.architecture(), end='')",
    "images/frames.svg": "import pictures; print(pictures.frames(), end='')",
}


@pytest.mark.parametrize("name", MADE)
def test_made_files_are_up_to_date(name: str) -> None:
    """A file of docs/ that is made from the code is what the code makes of it; else run `make reference`."""
    done = subprocess.run(
        [sys.executable, "-c", MADE[name]], stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT / "docs"
    )
    assert done.stdout == (ROOT / "docs" / name).read_text(encoding="utf-8"), "make reference"


def test_every_key_has_a_meaning() -> None:
    """keys.toml has an entry for each key of the schema and no other; the walk goes through the whole schema."""
    found = {(section.path, key.name) for section in sections() for key in section.keys}
    assert found == {(path, name) for path, _, fields in schema_sections() for name in fields}
    top = {field.alias or name for name, field in Scenario.model_fields.items()}
    assert {path.partition(".")[0] for path, _, _ in schema_sections()} - {""} <= top
    assert {("links", name) for name in LinkSection.model_fields if name != "gilbert_elliott"} <= found
    assert ("controller.weights", "payload_velocity") in found


@pytest.mark.parametrize("change", ["lacks", "invents"])
def test_wrong_meanings_are_refused(change: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A key without an entry and an entry without a key are named."""
    text = keys.MEANINGS.read_text(encoding="utf-8")
    line = next(line for line in text.splitlines() if line.startswith("horizon = "))
    other = tmp_path / "keys.toml"
    other.write_text(text.replace(line, "" if change == "lacks" else f"{line}\nwarp = {{ meaning = 'speed' }}"))
    monkeypatch.setattr(keys, "MEANINGS", other)
    with pytest.raises(MeaningError, match=r"\[controller\].*wrong: " + ("horizon" if change == "lacks" else "warp")):
        sections()


def test_defaults_are_toml() -> None:
    """A default as the page shows it is read as the default."""
    for section, (_, _, fields) in zip(sections(), schema_sections(), strict=True):
        for key in section.keys:
            field = fields[key.name]
            if field.is_required() or field.default is None:
                assert key.default == ("required" if field.is_required() else "left out")
            else:
                value = tomllib.loads(f"value = {key.default}")["value"]
                assert (value, type(value)) == (field.default, type(field.default)), f"{section.path}.{key.name}"
    assert toml(["a", 1.0, True]) == '["a", 1.0, true]'


def test_types_show_the_limits() -> None:
    """Type and range of a key are those that the schema checks."""
    shown = {(section.path, key.name): key.type for section in sections() for key in section.keys}
    assert shown["links", "loss"] == "number, 0 to 1"
    assert shown["controller", "horizon"] == "integer, 1 to 10 000"
    assert shown["controller.tilt", "limit_deg"] == "number > 0, < 90"
    assert shown["controller.limits", "moments_Nm"] == "3 numbers > 0"
    assert shown["clock", "mode"] == "lockstep, realtime"
    assert type_of(list[float] | list[list[float]]) == ""  # decided by code: keys.toml says so


def test_the_page_of_commands_names_every_option() -> None:
    """docs/commands.md has every option of every command."""
    text = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    options = {option for command in every_command(root()) for parameter in command.params for option in parameter.opts}
    long = {option for option in options if option.startswith("--")} - {
        "--version",
        "--help",
        "--install-completion",
        "--show-completion",
    }
    assert len(long) > 30
    assert [option for option in sorted(long) if f"`{option}" not in text] == []
