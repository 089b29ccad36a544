"""Refused scenarios, options and addresses.

One line and the documented exit code, before any process starts.
"""

import socket
from pathlib import Path

import pytest

from tests.support.commands import processes_of, settings, transport
from tests.support.results import here

USAGE, SCENARIO, LOST = 2, 3, 4


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (
            ("paper", "--set", "controller.horizn=3"),
            "--set controller.horizn=3: unknown key; did you mean 'horizon'?",
        ),
        (("nowhere.toml",), "nowhere.toml: no such file"),
    ],
)
def test_scenario_that_cannot_be_is_refused_in_one_line(
    arguments: tuple[str, ...], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong value or file ends with exit code 3 and one line, without a run folder.

    All others are as this one.
    """
    monkeypatch.chdir(tmp_path)
    result = here("run", *arguments, "--out", "out")
    assert (result.exit_code, result.stdout, result.stderr) == (
        SCENARIO,
        "",
        f"transport: {expected}\n",
    )
    assert list(tmp_path.iterdir()) == []


def test_agent_that_is_not_in_the_scenario_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`--id 9` of four agents is a usage error."""
    monkeypatch.chdir(tmp_path)
    result = here("agent", "--id", "9")
    assert (result.exit_code, result.stderr) == (
        USAGE,
        "transport: --id: expected an agent from 1 to 4 of scenario paper, got 9\n",
    )


def test_existing_run_folder_is_not_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An existing run folder is refused, and its content stays."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "keep.txt").write_text("mine")
    result = here("run", "paper", "--out", "out")
    assert result.exit_code == USAGE
    assert "expected a folder that does not exist yet, got out" in result.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["keep.txt"]


@pytest.mark.slow
def test_port_in_use_is_named(tmp_path: Path) -> None:
    """A port in use is named before any process starts, for a whole run and for a single process."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        base = min(port, 65_000)
        whole = transport(
            "run", "paper", *settings(f"network.base_port={base}"), "--out", "out", cwd=tmp_path
        )
        single = transport("coordinator", "--listen", f"tcp/127.0.0.1:{port}", cwd=tmp_path)
    assert whole.returncode == LOST
    assert "network.base_port: expected free ports, got" in whole.stderr
    assert not (tmp_path / "out").exists()
    assert single.returncode == LOST
    assert "address already in use" in single.stderr
    assert "Traceback" not in whole.stderr + single.stderr


@pytest.mark.parametrize("command", [["agent", "--id", "1"], ["router"]], ids=["agent", "router"])
def test_the_option_with_a_wrong_endpoint_is_named(command: list[str], tmp_path: Path) -> None:
    """Each process that takes endpoints refuses one without a protocol, by its option."""
    endpoints = ["--listen", "tcp/127.0.0.1:0", "--connect", "127.0.0.1"]
    result = transport(*command, *endpoints, cwd=tmp_path)
    assert result.returncode == 2
    assert (
        "--connect: expected an endpoint such as tcp/127.0.0.1:7447, got '127.0.0.1'"
        in result.stderr
    )


def test_connecting_to_nothing_ends_by_name(tmp_path: Path) -> None:
    """An agent without connections names the missing processes and its endpoints within the join timeout."""
    options = [
        "--listen",
        "tcp/127.0.0.1:0",
        "--connect",
        "tcp/127.0.0.1:9",
        "--join-timeout",
        "1",
        "--run",
        "alone",
    ]
    result = transport("agent", "--id", "1", *options, cwd=tmp_path)
    assert result.returncode == LOST
    last = result.stderr.strip().splitlines()[-1]
    assert "no sign of agent2, agent3, agent4, coordinator, plant within 1 s" in last
    assert "connecting to tcp/127.0.0.1:9" in last
    assert "Traceback" not in result.stderr
    assert processes_of("alone") == {}
