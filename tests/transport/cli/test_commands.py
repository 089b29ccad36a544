"""The command line: commands are imported when they are called, and their help texts agree and can be followed."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.command_tree import command_of
from transport.cli.lazy import LazyGroup

# Names the modules and the top-level packages that a program imports, on its last line.
IMPORTED = """
import contextlib, json, sys
from importlib import import_module
{program}
packages = {{name.partition(".")[0] for name in sys.modules}}
print("\\n" + json.dumps(sorted(packages | sys.modules.keys())))
"""
HELP = """
from transport.cli.main import app
with contextlib.suppress(SystemExit):
    app(["--help"])
"""
BASE = {"transport.cli.lazy", "transport.cli.main"}
# Packages and modules that no process of a run needs.
FOREIGN = {
    "matplotlib",
    "pandas",
    "viser",
    "joblib",
    "distributed",
    "pyarrow",
    "mcap",
    "selenium",
    "prometheus_client",
}


def group_of(names: tuple[str, ...]) -> LazyGroup:
    """Return the group that names lead to."""
    group, _, _ = command_of(names)
    assert isinstance(group, LazyGroup)
    return group


GROUPS = [(), ("link",), ("experiment",), ("scenario",), ("log",), ("deploy",)]
COMMANDS = [(*names, name) for names in GROUPS for name in group_of(names).table]


def imported(program: str) -> set[str]:
    """Return the modules, and their top-level packages, that a program imports."""
    code = IMPORTED.format(program=program)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_help_imports_no_command() -> None:
    """`transport --help` imports the table of commands and nothing of the project below the command line."""
    names = imported(HELP)
    assert {name for name in names if name.startswith("transport.cli.")} == BASE
    assert not names & {
        "numpy",
        "casadi",
        "pydantic",
        "zenoh",
        "rich",
        "model",
        "protocol",
        "agent",
        *FOREIGN,
    }


@pytest.mark.parametrize("role", ["agent", "plant", "coordinator"])
def test_processes_of_a_run_import_only_what_they_need(role: str) -> None:
    """The command of a role imports neither reports, viewer, tables nor another command."""
    names = imported(
        f'import_module("transport.cli.hosts.processes"); import_module("{role}.node")'
    )
    modules = ("hosts", "hosts.processes", "lazy", "options", "output", "setting_words")
    own = {f"transport.cli.{name}" for name in modules}
    assert {name for name in names if name.startswith("transport.cli.")} == own
    assert not names & {"rich", *FOREIGN}


def test_a_run_imports_viewer_and_report_when_needed() -> None:
    """The start of `transport run` imports neither the viewer nor figures, nor an agent.

    The processes of the run wait for it. Before it is forked into their server it imports no recorder
    and no console either, which they do not need.
    """
    before = imported('import_module("transport.cli.commands.run")')
    names = imported('import_module("transport.cli.local_run")')
    assert not names & {
        "transport.cli.commands.view",
        "transport.cli.commands.plot",
        *FOREIGN - {"mcap"},
    }
    assert "transport.agent.node" not in names
    assert not before & {"rich", "mcap"}

    reads = 'import_module("transport.cli.options").read_setup("resilient")'
    assert "numpy.ma" not in imported(reads)


def test_an_agent_starts_without_what_its_run_does_not_have() -> None:
    """Before its first tick an agent of `paper` has imported no radio, no class of the user and no masked arrays."""
    starts = """
from transport.cli.hosts.fork_server_process import import_processes
from transport.cli.options import read_setup
from transport.agent.node import AgentNode
import_processes()
AgentNode(read_setup("paper").run, 1).warm_up()
"""
    names = imported(starts)
    assert "transport.agent.node" in names
    assert not names & {
        "numpy.ma",
        "transport.agent.user_class.user_planner",
        "transport.protocol.scenario.radio.team_radio",
    }


def test_docs_list_every_command() -> None:
    """docs/reference/commands.md has a section with name and line of each command."""
    document = (
        Path(__file__).resolve().parents[3] / "docs" / "reference" / "commands.md"
    ).read_text(encoding="utf-8")
    rows = re.findall(r"^## `transport ([a-z0-9 ]+)`\n\n(.+)$", document, re.MULTILINE)
    expected = [(" ".join(names), group_of(names[:-1]).table[names[-1]][1]) for names in COMMANDS]
    assert set(expected) <= set(rows)


@pytest.mark.parametrize("names", COMMANDS, ids=" ".join)
def test_help_has_an_example(names: tuple[str, ...]) -> None:
    """The help of a command has an example of itself, whose arguments and options parse."""
    command, _, _ = command_of(names)
    found = re.search(r"^Example: transport (.+)$", command.help or "", re.MULTILINE)
    assert found is not None
    example, path, rest = command_of(shlex.split(found[1]))
    assert tuple(path) == names
    assert example.make_context(names[-1], rest).params is not None
