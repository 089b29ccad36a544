"""docs/getting-started.md and docs/python.md do what they say.

Runs with processes are simulated in memory.
"""

import doctest
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from typer.testing import CliRunner

import transport
from tests.support.command_tree import command_of
from transport.cli.main import app
from transport.interface.run_series import QUANTITIES
from transport.interface.setting_arguments import KEY_OF
from transport.report.report import write_report

ROOT = Path(__file__).resolve().parent.parent
PAGE, PYTHON = ROOT / "docs" / "getting-started.md", ROOT / "docs" / "python.md"

# Lines of outputs that depend on the host's speed.
WALL_CLOCK = re.compile(r"^ *(simulated|agent step|rest of tick|real-time factor)\b|\(ms\)")


@pytest.fixture(scope="module")
def program() -> ModuleType:
    """Return the program that renews the page."""
    spec = importlib.util.spec_from_file_location(
        "getting_started_page", ROOT / "docs" / "getting_started_page.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def blocks(program: ModuleType) -> list[tuple[str, str]]:
    """Return language and text of the page's blocks."""
    found: list[tuple[str, str]] = program.BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    return found


def timeless(text: str) -> list[str]:
    """Return the lines of an output that are equal on every host."""
    return [
        line.rstrip() for line in text.splitlines() if line.strip() and not WALL_CLOCK.search(line)
    ]


def in_memory(command: str) -> str:
    """Return the output of a command of the page, with runs simulated in memory."""
    words = shlex.split(command)[1:]
    if words[0] != "run":
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, result.output
        return result.output
    found, names, rest = command_of(words)
    given = found.make_context(names[-1], rest).params
    settings: dict[str, Any] = {}
    for setting in given["settings"] or []:
        key, _, value = setting.partition("=")
        settings[key] = tomllib.loads(f"value = {value}")["value"]
    run = transport.fly(given["scenario"], settings, progress=False)
    folder = run.save(given["out"], figures=False)
    write_report(folder)
    files = [
        "summary.json",
        "steps.csv",
        "run.mcap",
        *[f"figures/{p.name}" for p in folder.glob("figures/*.png")],
    ]
    return "\n".join([str(run), *(f" {folder / file}" for file in files)])


@pytest.mark.slow
@pytest.mark.pages
def test_the_page(program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands and Python examples of the page, in order in an empty folder, give the outputs that stand there."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    compared = 0
    for language, text in blocks(program):
        if language == "python":
            for one in doctest.DocTestParser().get_examples(text):
                lines = len(one.source.splitlines())
                got = "\n".join(program.example(one, names).splitlines()[lines:])
                assert timeless(one.want) == timeless(got), one.source
                compared += 1
            continue
        for command, output in program.commands(text):
            if not command.startswith(program.SKIPPED):
                assert sorted(timeless(in_memory(command))) == sorted(timeless(output)), command
                compared += 1
    assert compared > 15
    for name in ("first.png", "delay.png", "six.toml", "heavy.toml"):
        assert (tmp_path / name).exists(), name


def commands(program: ModuleType) -> Iterator[str]:
    """Yield the commands of the page."""
    for language, text in blocks(program):
        if language == "console":
            yield from (command for command, _ in program.commands(text))


def test_commands_parse(program: ModuleType) -> None:
    """Every command of the page that is one of ours exists, with its options."""
    ours = [
        shlex.split(command)[1:]
        for command in commands(program)
        if command.startswith("transport ")
    ]
    assert len(ours) > 3
    for words in ours:
        found, names, rest = command_of(words)
        found.make_context(names[-1], rest)


def test_names_of_the_python_page() -> None:
    """docs/python.md has a row for every short name and error, docs/reference/series.md for every series."""
    text = PYTHON.read_text(encoding="utf-8")
    assert dict(re.findall(r"^- `(\w+)`: `([\w.]+)`$", text, re.MULTILINE)) == dict(KEY_OF)
    series = (ROOT / "docs" / "reference" / "series.md").read_text(encoding="utf-8")
    table = series.partition("<!-- series -->")[2].partition("<!-- end of series -->")[0]
    rows = re.findall(r"^- `(\w+)` \(([^;)]+)(?:; ([^)]+))?\): (.*)$", table, re.MULTILINE)
    assert [(name, unit, meaning) for name, _, unit, meaning in rows] == [
        (name, quantity.unit, quantity.meaning) for name, quantity in QUANTITIES.items()
    ]
    for name in transport.__all__:
        assert f"`{name}" in text, name
