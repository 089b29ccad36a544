"""Documents against the code.

Equations, scenario keys, links and command lines that they name exist.
"""

import re
import shlex
import subprocess
import textwrap
import tomllib
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import pytest
from typer.core import TyperGroup

from tests.support.command_tree import Command, below, command_of, every_command, root
from tests.support.runs import PAPER
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario, validate
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import Reason
from transport.protocol.wire.key_expressions import ACTING, READING

ROOT = Path(__file__).resolve().parent.parent
# Folders with sources that cite equations, and the endings of such files.
FOLDERS = (
    *("model", "mpc", "protocol", "agent", "plant", "coordinator", "deploy", "transport"),
    *("benchmarks", "tests", "docs", "examples", "scenarios", "vehicles"),
)
ENDINGS = {".py", ".c", ".toml", ".ipynb", ".json"}
GUIDE = sorted((ROOT / "docs").glob("*.md"))
EQUATIONS = sorted((ROOT / "docs" / "equations").glob("*.md"))
REFERENCE = [*sorted((ROOT / "docs" / "reference").glob("*.md")), *EQUATIONS]
DEVELOPMENT = sorted((ROOT / "docs" / "development").glob("*.md"))
RECORD = sorted((ROOT / "docs" / "record").glob("*.md"))
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *GUIDE, *REFERENCE, *DEVELOPMENT, *RECORD]
HISTORY = ROOT / "CHANGELOG.md"  # also names options that are gone
NUMBERS = ROOT / "docs" / "equations.md"  # which page has which equation
SCENARIO = ROOT / "docs" / "scenario.md"
KEYS = ROOT / "docs" / "reference" / "keys.md"

# Sources cite equations by numbers in brackets alone: so any such number is one, but for arguments
# of calls (a name before the bracket), numbers beside another one in a cell, (2p)^m, and years.
CITATION = re.compile(r"(?<![\w\])])(?<!\d )\(([1-9]\d{0,2}[a-z]?)\)(?!\^)")

# Parts of documents that other programs than docs/figures.py renew, or that a test compares.
OTHER_PARTS: list[tuple[str, str, tuple[str, ...]]] = [
    ("docs/arena.md", "docs/arena_page.py", ("tasks", "networks")),
    ("docs/record/arena.md", "docs/arena_page.py", ("results", "information")),
    ("docs/record/algorithms.md", "docs/algorithm_figures.py", ("ready algorithms",)),
    ("docs/record/guarantees.md", "benchmarks/silence.py", ("bench: silence",)),
    ("docs/record/guarantees.md", "benchmarks/walls.py", ("bench: walls",)),
    (
        "docs/record/guarantees.md",
        "benchmarks/clock_and_actuation_offsets.py",
        ("bench: spread", "bench: clocks"),
    ),
    ("docs/record/guarantees.md", "benchmarks/teams.py", ("bench: teams alone", "bench: teams")),
    ("README.md", "benchmarks/teams.py", ("bench: teams",)),
    (
        "docs/record/measured.md",
        "benchmarks/autopilots.py",
        ("bench: autopilots stand_in", "bench: autopilots ardupilot"),
    ),
    ("docs/record/guarantees.md", "benchmarks/worst.py", ("together", "ready")),
    (
        "docs/record/performance.md",
        "benchmarks/__main__.py",
        ("step", "widths", "shares", "start", "solvers", "parts", "loop"),
    ),
    ("docs/record/performance.md", "benchmarks/peers/__main__.py", ("bench: peers",)),
    ("docs/reference/series.md", "tests/test_getting_started.py", ("series",)),
    ("docs/record/radio.md", "benchmarks/radio/__main__.py", ("deferral", "validation")),
    ("docs/record/radio.md", "benchmarks/radio/computation.py", ("computation",)),
    ("docs/record/radio.md", "benchmarks/radio/plan_bytes.py", ("bytes",)),
    ("docs/record/measured.md", "benchmarks/estimates.py", ("bench: estimates",)),
    ("docs/record/measured.md", "benchmarks/worst.py", ("planted",)),
]

# A fenced block: indentation, as within an entry of a list, language, and text.
FENCE = re.compile(r"^([ ]*)```(\w*)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
CODE_SPAN = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
SETTING = re.compile(r"[a-z_]+(\.\w+)+ ?= ?\S.*")


def prose(document: Path) -> str:
    """A document without its fenced blocks."""
    return FENCE.sub("", document.read_text(encoding="utf-8"))


def blocks(document: Path) -> list[tuple[str, str]]:
    """Language and text of each fenced block of a document."""
    found = FENCE.findall(document.read_text(encoding="utf-8"))
    return [(language, textwrap.dedent(text)) for _, language, text in found]


def tags() -> list[str]:
    """Numbers of the equations, page by page."""
    return [
        number
        for page in EQUATIONS
        for number in re.findall(r"\\tag\{(\w+)\}", page.read_text(encoding="utf-8"))
    ]


def cited(text: str) -> list[str]:
    """Every equation that a text cites."""
    return CITATION.findall(text)


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("docs/equations.md (22)-(24z)", ["22", "24z"]),
        ("[(b)](information.md#silence) (31z)", ["31z"]),
        ("docs/equations.md (1) and (99)", ["1", "99"]),
        ("docs/equations.md, (99)", ["99"]),
        ("docs/equations.md (12),\n    # (13a); paper (2)", ["12", "13a", "2"]),
        ("# x' = f: (56)", ["56"]),
        ("/* [A - I, B]: (15b). */", ["15b"]),
        ("f(3), x[1](2), 101 (105) ms, (1 - (2p)^m), Autom. Control 58 (2013), payload (0)", []),
    ],
)
def test_citations_are_found(text: str, numbers: list[str]) -> None:
    """A citation is a number in brackets, also at the end of a range and without the document's name."""
    assert cited(text) == numbers


def test_cited_equations_exist() -> None:
    """Each number that a source or document cites, alone or at an end of a range, has a tag in docs/equations."""
    known = set(tags())
    files = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*"))]
    sources = [path for path in files if path.suffix in ENDINGS and path != Path(__file__)]
    assert ROOT / "model" / "kernels" / "kernels.c" in sources
    for path in [*sources, *DOCUMENTS]:
        for number in cited(path.read_text(encoding="utf-8")):
            assert number in known, f"{path.relative_to(ROOT)} cites equation ({number})"


def test_equations_are_numbered_without_gaps() -> None:
    """Tags of all pages count 1, 2, 3, ...

    Up to the number the list of pages opens with, helpers with a letter after their number.
    """
    numbers = tags()
    plain = sorted(int(tag) for tag in numbers if tag.isdecimal())
    assert plain == list(range(1, len(plain) + 1))
    opening, _, _ = NUMBERS.read_text(encoding="utf-8").partition("\n## ")
    assert f"(1)-({plain[-1]})" in opening
    assert len(set(numbers)) == len(numbers)
    assert {tag[:-1] for tag in numbers if not tag.isdecimal()} <= {str(n) for n in plain}


def test_scenario_examples_are_valid() -> None:
    """TOML in docs/scenario.md and the page of keys, put after the paper's scenario, makes one that can be flown."""
    for document in (SCENARIO, KEYS):
        examples = [text for language, text in blocks(document) if language == "toml"]
        assert examples
        for block in examples:
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


# A file of the source in the text of a document; several pages name those of the filter briefly.
NAMED = re.compile(r"(?:[\w.-]+/)+[\w.-]+\.(?:py|c|toml)")
SHORT = ROOT / "agent" / "estimation"


@pytest.mark.parametrize(
    "document", [path for path in DOCUMENTS if path != HISTORY], ids=lambda path: path.name
)
def test_files_in_text_exist(document: Path) -> None:
    """Source files that a document names by their folder exist, but for those that a recipe makes."""
    made = set(re.findall(r"the new file `([^`]+)`", document.read_text(encoding="utf-8")))
    for span in set(CODE_SPAN.findall(prose(document))) - made:
        if NAMED.fullmatch(span):
            assert any((folder / span).is_file() for folder in (ROOT, SHORT)), span


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_tables_begin_a_paragraph(document: Path) -> None:
    """An empty line precedes each table; without it the rows are a paragraph of bars."""
    joined = re.findall(r"^[^|\n<].*\n\|.*\n *\|[-:| ]+\|$", prose(document), re.MULTILINE)
    assert not joined, joined[0]


GUIDE_WORDS, ALL_WORDS = 1500, 60_000


def words(document: Path) -> int:
    """Words of a document as `wc -w` counts them."""
    return len(document.read_text(encoding="utf-8").split())


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_fence_of_code_is_closed(document: Path) -> None:
    """After one fence too many a page has text as code and code as text."""
    fences = re.findall(r"^ *```", document.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(fences) % 2 == 0


@pytest.mark.parametrize("document", [*GUIDE, *DEVELOPMENT], ids=lambda path: path.name)
def test_a_page_that_teaches_is_short(document: Path) -> None:
    """A page has one subject: at most 1,500 words; what was measured belongs to docs/record."""
    assert words(document) <= GUIDE_WORDS


def test_guide_and_reference_can_be_read() -> None:
    """Guide and reference have at most 60,000 words together; development and record count apart."""
    assert sum(map(words, [*GUIDE, *REFERENCE])) <= ALL_WORDS


@pytest.fixture
def docs_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Import modules of the folder docs."""
    monkeypatch.syspath_prepend(ROOT / "docs")


@pytest.mark.usefixtures("docs_on_path")
def test_measured_runs_are_scenarios() -> None:
    """All runs of measured tables are scenarios."""
    pages: dict[str, Any] = import_module("measured_pages").PAGES
    rows = [runs for tables in pages.values() for table in tables for runs in table.rows.values()]
    for run in {run for runs in rows for run in runs if run}:
        run.point().read()


@pytest.mark.usefixtures("docs_on_path")
def test_measured_parts_have_a_place() -> None:
    """A document has markers for each part that its program or a benchmark renews, and no others."""
    pages: dict[str, Any] = import_module("measured_pages").PAGES
    results_page = import_module("results_page")

    parts: dict[Path, list[str]] = {document: [] for document in DOCUMENTS}
    for page, tables in pages.items():
        parts[ROOT / "docs" / page] += ["origin", *(table.name for table in tables)]
    for name in results_page.EXPERIMENTS:
        parts[results_page.page_of(name)].append(name)
    for derived in import_module("derived_tables").DERIVED:
        parts[derived.document].append(derived.name)
    for page, program, names in OTHER_PARTS:
        is_bench = program == "benchmarks/__main__.py"
        parts[ROOT / page] += [f"bench: {name}" if is_bench else name for name in names]

    for document, expected in parts.items():
        text = document.read_text(encoding="utf-8")
        markers = re.findall(r"^<!-- (?!keys of )(.+) -->$", text, re.MULTILINE)
        begun = [marker for marker in markers if not marker.startswith("end of ")]
        assert sorted(begun) == sorted(expected), document
        if document != KEYS:  # with markers of its own, of docs/reference_page.py
            assert markers == [one for name in begun for one in (name, f"end of {name}")], document


@pytest.mark.parametrize(("page", "program", "names"), OTHER_PARTS)
def test_programs_name_their_parts(page: str, program: str, names: tuple[str, ...]) -> None:
    """The program that renews a part has the name of its markers, as a text or in the markers themselves."""
    source = (ROOT / program).read_text(encoding="utf-8")
    for name in names:
        assert f'"{name}"' in source or f"<!-- {name} -->" in source, (page, program)


def command_lines(document: Path) -> list[list[str]]:
    """Arguments of every line `transport ...` in the fenced blocks of a document."""
    text = "\n".join(text for _, text in blocks(document))
    lines = text.replace("\\\n", " ").splitlines()
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


@pytest.mark.parametrize(
    "document", [path for path in DOCUMENTS if path != HISTORY], ids=lambda path: path.name
)
def test_commands_in_text_exist(document: Path) -> None:
    """`transport ...` within a sentence names commands and options that exist, `--option ...` one of some command."""
    for span in CODE_SPAN.findall(prose(document)):
        words = span.split()
        command = words[0] if words else ""
        is_value = len(words) > 1 and words[1].isupper()  # capitals stand for a value
        if command == "transport" and len(words) > 1 and not is_value:
            found, names, _ = command_of(words[1:])
            assert names or words[1].startswith("--"), f"{document.name}: {span}"
            known = options_of(found)
        elif command.startswith("--"):
            known = every_option()
        else:
            continue
        options = {word for word in words if word.startswith("--")}
        assert options <= known, f"{document.name}: {span}"


def test_help_shows_whole_sentences() -> None:
    """The lists of commands in `--help` cut nothing off on a terminal of 80 columns."""
    blanks = 8  # before and between the columns, and at the right
    for group in every_command(root()):
        if not isinstance(group, TyperGroup):
            continue
        room = 80 - blanks - max(map(len, group.commands))
        for name, command in below(group).items():
            assert not command.get_short_help_str(room).endswith("..."), name


def test_reasons_of_refusals_are_described() -> None:
    """The table in docs/reference/protocol.md has a row for each reason a message is refused for, and for no other."""
    _, _, section = (
        (ROOT / "docs" / "reference" / "protocol.md")
        .read_text(encoding="utf-8")
        .partition("## Refused messages\n")
    )
    assert re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) == list(get_args(Reason))


def test_requests_are_described_and_permitted() -> None:
    """Each request in the table of docs/reference/protocol.md is one that access control lets pass, and no other."""
    _, _, section = (
        (ROOT / "docs" / "reference" / "protocol.md")
        .read_text(encoding="utf-8")
        .partition("## Requests\n")
    )
    table, _, _ = section.partition("\n## ")
    _, *described = re.findall(r"^\| [^|]+ \| `(\w+)` \|", table, re.MULTILINE)
    assert sorted(described) == sorted((*READING, *ACTING))


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
