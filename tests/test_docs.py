"""Documents against the code.

Equations, scenario keys, links and command lines that they name exist.
"""

import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import pytest
from typer.core import TyperGroup

from tests.support.command_tree import Command, below, command_of, every_command, root
from tests.support.runs import PAPER
from transport.protocol.scenario.file import find_scenario, read_scenario, validate
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.errors import Reason

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = (
    "model",
    "mpc",
    "protocol",
    "agent",
    "plant",
    "coordinator",
    "deploy",
    "transport",
    "benchmarks",
    "tests",
)
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
EQUATIONS = ROOT / "docs" / "equations.md"
SCENARIO = ROOT / "docs" / "scenario.md"
KEYS = ROOT / "docs" / "keys.md"

# A citation is the document's name, as text or as a link, and then numbers and ranges; or one
# number "in" it.
NUMBERS = r"\(\d+[a-z]?\)(?:-\(\d+[a-z]?\))?"
CITATION = re.compile(
    rf"equations\.md\)?\s+({NUMBERS}(?:,\s+{NUMBERS})*)|({NUMBERS}) (?:of|in) docs/equations\.md"
)
RANGE = re.compile(r"\((\d+)([a-z]?)\)(?:-\((\d+)[a-z]?\))?")

FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
CODE_SPAN = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
SETTING = re.compile(r"[a-z_]+(\.\w+)+ ?= ?\S.*")


def prose(document: Path) -> str:
    """A document without its fenced blocks."""
    return FENCE.sub("", document.read_text(encoding="utf-8"))


def tags() -> list[str]:
    """Numbers of the equations, in order."""
    return re.findall(r"\\tag\{(\w+)\}", EQUATIONS.read_text(encoding="utf-8"))


def cited(text: str) -> Iterator[str]:
    """Every equation a text cites, ranges spelled out."""
    for behind, ahead in CITATION.findall(text):
        for first, letter, last in RANGE.findall(behind or ahead):
            yield from (
                (str(n) for n in range(int(first), int(last) + 1)) if last else (first + letter,)
            )


def test_cited_equations_exist() -> None:
    """Whatever a docstring or document cites as docs/equations.md (n), or as a range of such, has a tag there."""
    known = set(tags())
    sources = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    found = 0
    for path in [*sources, *DOCUMENTS]:
        for number in cited(path.read_text(encoding="utf-8")):
            assert number in known, f"{path.relative_to(ROOT)} cites equation ({number})"
            found += 1
    assert found > 50  # the search does find citations


def test_equations_are_numbered_without_gaps() -> None:
    """Tags count 1, 2, 3, ...

    Up to the number the document opens with, helpers with a letter after their number.
    """
    numbers = tags()
    plain = [int(tag) for tag in numbers if tag.isdecimal()]
    assert plain == list(range(1, len(plain) + 1))
    assert f"(1)-({plain[-1]})" in EQUATIONS.read_text(encoding="utf-8")
    assert len(set(numbers)) == len(numbers)
    assert {tag[:-1] for tag in numbers if not tag.isdecimal()} <= {str(n) for n in plain}


def test_scenario_examples_are_valid() -> None:
    """TOML in docs/scenario.md and docs/keys.md, put after the paper's scenario, makes one that can be flown."""
    for document in (SCENARIO, KEYS):
        blocks = [
            text
            for language, text in FENCE.findall(document.read_text(encoding="utf-8"))
            if language == "toml"
        ]
        assert blocks
        for block in blocks:
            tree = tomllib.loads(PAPER.read_text(encoding="utf-8") + "\n" + block)
            Setup.of(validate(tree, document.name), document.name)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_settings_in_text_are_valid(document: Path) -> None:
    """Whatever a document writes as `section.key=value` is a setting that the paper's scenario takes."""
    for span in CODE_SPAN.findall(prose(document)):
        if SETTING.fullmatch(span):
            read_scenario(PAPER, [span])


def anchors(document: Path) -> set[str]:
    """Anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", prose(document), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_relative_links_resolve(document: Path) -> None:
    """Links within the project lead to a file of it, and to a heading of that file when they name one."""
    for target in LINK.findall(CODE_SPAN.sub("", prose(document))):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        path = (document.parent / name).resolve() if name else document
        assert path.is_relative_to(ROOT), target
        assert path.exists(), f"{document.name} links to {target}, which is not there"
        assert not anchor or anchor in anchors(path), (
            f"{document.name} links to {target}, which has no such heading"
        )


def test_measured_tables_have_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    """A document has markers for each part that its program or a benchmark renews, and no others.

    All runs are scenarios.
    """
    monkeypatch.syspath_prepend(ROOT / "docs")
    pages: dict[str, Any] = import_module("measured_pages").PAGES
    rows = [runs for tables in pages.values() for table in tables for runs in table.rows.values()]
    for run in {run for runs in rows for run in runs if run}:
        run.point().read()
    experiments = import_module("results_page").EXPERIMENTS
    page_of = import_module("results_page").page_of
    derived = import_module("results_page").DERIVED
    for document, tables in pages.items():
        names = ["origin", *(table.name for table in tables)]
        names += [name for name in experiments if page_of(name).name == document]
        names += [one.name for one in derived if one.document.name == document]
        names += ["deferral", "validation", "computation", "bytes"] * (document == "radio.md")
        names += ["together", "ready"] * (document == "guarantees.md")
        text = (ROOT / "docs" / document).read_text(encoding="utf-8")
        begun = re.findall(r"^<!-- (\w+) -->$", text, re.MULTILINE)
        assert sorted(begun) == sorted(names), document
        assert re.findall(r"^<!-- end of (\w+) -->$", text, re.MULTILINE) == begun, document


def command_lines(document: Path) -> list[list[str]]:
    """Arguments of every line `transport ...` in the fenced blocks of a document."""
    blocks = "\n".join(text for _, text in FENCE.findall(document.read_text(encoding="utf-8")))
    lines = blocks.replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("transport ")]


WRITTEN = [
    (document.name, arguments) for document in DOCUMENTS for arguments in command_lines(document)
]


@pytest.mark.parametrize(
    ("document", "arguments"), WRITTEN, ids=[f"{name}: {' '.join(a)}" for name, a in WRITTEN]
)
def test_command_lines_parse(document: str, arguments: list[str]) -> None:
    """A command line of a document is one.

    Command, options, required arguments and the scenario it asks for.
    """
    found, names, rest = command_of(arguments)
    assert not isinstance(found, TyperGroup), f"{document}: {arguments} is no whole command"
    parameters = found.make_context(names[-1], rest).params
    scenario, settings = parameters.get("scenario"), parameters.get("settings")
    if scenario in {path.stem for path in PAPER.parent.glob("*.toml")}:
        Setup.of(read_scenario(find_scenario(scenario), settings or []), scenario)


def options_of(*some: Command) -> set[str]:
    """Options of some commands."""
    parameters = [parameter for command in some for parameter in command.params]
    return {"--help"}.union(
        *([*parameter.opts, *parameter.secondary_opts] for parameter in parameters)
    )


@cache
def every_option() -> set[str]:
    """Options of all commands."""
    return options_of(*every_command(root()))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_commands_in_text_exist(document: Path) -> None:
    """`transport ...` within a sentence names commands and options that exist, `--option ...` one of some command."""
    for span in CODE_SPAN.findall(prose(document)):
        words = span.split()
        if (
            words[0] == "transport" and len(words) > 1 and not words[1].isupper()
        ):  # capitals stand for a value
            found, names, _ = command_of(words[1:])
            assert names or words[1].startswith("--"), f"{document.name}: {span}"
            known = options_of(found)
        elif words[0].startswith("--"):
            known = every_option()
        else:
            continue
        assert {word for word in words if word.startswith("--")} <= known, (
            f"{document.name}: {span}"
        )


def test_help_shows_whole_sentences() -> None:
    """The lists of commands in `--help` cut nothing off on a terminal of 80 columns."""
    for group in every_command(root()):
        if not isinstance(group, TyperGroup):
            continue
        room = (
            80 - 8 - max(map(len, group.commands))
        )  # 8: blanks before and between the columns, and at the right
        for name, command in below(group).items():
            assert not command.get_short_help_str(room).endswith("..."), name


def test_reasons_of_refusals_are_described() -> None:
    """The table in docs/protocol.md has a row for each reason a message is refused for, and for no other."""
    _, _, section = (
        (ROOT / "docs" / "protocol.md")
        .read_text(encoding="utf-8")
        .partition("## Refused messages\n")
    )
    assert re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) == list(get_args(Reason))


def test_pictures_and_first_steps_need_no_other_host() -> None:
    """Pictures are files of the source folder, nothing is to be cloned, and `make run` names a next run."""
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        assert not re.findall(r"!\[[^\]]*\]\(\w+:", text), document
        assert "git clone" not in text, document
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(re.findall(r"!\[[^\]]*\]\(docs/images/[\w.]+\)", readme)) == 1
    steps = subprocess.run(
        ["make", "-n", "run"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert re.search(r"transport run paper\n.*next: \S*transport run resilient", steps, re.DOTALL)
