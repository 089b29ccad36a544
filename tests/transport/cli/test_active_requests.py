"""Requests that the commands for an active run send, without a run."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from transport.cli.main import app
from transport.flight import active_runs

# Ends of a request that is accepted.
ANSWER = {"tick": 12, "t_s": 0.6, "reached_s": 4.0, "ends_s": 5.0, "point_m": [3.0, -4.0, 0.0]}
GROUPS = {"groups": [["agent1", "agent2"], ["agent3"]], "settings": {"loss": 1.0}}


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, Any]]:
    """Return the list of process, kind and content of each request, which the test fills."""
    requests: list[tuple[str, str, Any]] = []

    def accept(
        run: str, endpoints: Sequence[str], name: str, what: str, given: Any, keys: Path | None
    ) -> dict[str, Any]:
        assert (run, list(endpoints), keys) == ("hover", ["tcp/127.0.0.1:1"], None)
        requests.append((name, what, given))
        return ANSWER

    monkeypatch.setattr(active_runs, "request", accept)
    return requests


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("status", ("coordinator", "status", {})),
        ("status --process plant", ("plant", "health", {})),
        ("status --process 2", ("agent2", "health", {})),
        ("fault kill 2", ("recorder", "fault", {"do": "kill", "target": "agent2"})),
        ("fault kill agent2", ("recorder", "fault", {"do": "kill", "target": "agent2"})),
        (
            "link set --from plant --to 2 --delay 0.1 --distribution normal",
            (
                "coordinator",
                "link",
                {
                    "from": "plant",
                    "to": "agent2",
                    "settings": {"delay_s": 0.1, "distribution": "normal"},
                },
            ),
        ),
        ("link set --between 1,2/3 --loss 1", ("coordinator", "link", GROUPS)),
        ("link set --between 1,2|agent3 --loss 1", ("coordinator", "link", GROUPS)),
        ("target 3 0 -12", ("coordinator", "target", {"points_m": [[3.0, 0.0, -12.0]]})),
        (
            "target 3 0 -12 --speed 1.5 --to 2 --to 3",
            (
                "coordinator",
                "target",
                {"points_m": [[3.0, 0.0, -12.0]], "speed_mps": 1.5, "to": [2, 3]},
            ),
        ),
        ("land", ("coordinator", "target", {"land": True})),
        (
            "land 3 -4 --speed 0.25",
            ("coordinator", "target", {"land": True, "land_at_m": [3.0, -4.0], "speed_mps": 0.25}),
        ),
        ("land 0 -4", ("coordinator", "target", {"land": True, "land_at_m": [0.0, -4.0]})),
        ("land 0 0", ("coordinator", "target", {"land": True, "land_at_m": [0.0, 0.0]})),
        ("abort", ("coordinator", "abort", {})),
        ("release", ("coordinator", "release", {})),
    ],
)
def test_requests(
    words: str, expected: tuple[str, str, Any], sent: list[tuple[str, str, Any]]
) -> None:
    """Agents are named by number or name, and groups are divided by a slash or a bar."""
    arguments = [*words.split(), "--run", "hover", "--connect", "tcp/127.0.0.1:1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.stderr
    assert sent == [expected]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("fault kill 2", "kill agent2: done at tick 12"),
        (
            "target 3 0 -12",
            "target from tick 12 on (t = 0.60 s), reached at t = 4.00 s, the last way point at t = 5.00 s",
        ),
        ("land", "landing from tick 12 on (t = 0.60 s), at (3, -4, 0) m at t = 5.00 s"),
        ("abort", "landing from tick 12 on (t = 0.60 s), at (3, -4, 0) m at t = 5.00 s"),
        ("release", "released at tick 12 (t = 0.60 s)"),
    ],
)
@pytest.mark.usefixtures("sent")
def test_answers_are_told(words: str, text: str) -> None:
    """When the request takes effect, where and until when, as text; or the answer as JSON."""
    arguments = [*words.split(), "--run", "hover", "--connect", "tcp/127.0.0.1:1"]
    assert CliRunner().invoke(app, arguments).stdout == f"{text}\n"
    as_json = CliRunner().invoke(app, [*arguments, "--format", "json"])
    assert json.loads(as_json.stdout) == ANSWER


@pytest.mark.parametrize(
    ("head", "options", "expected"),
    [
        ("t,x,y,z\n0,1,2,-3\n4,5,6,-7", [], {"points_m": [[1, 2, -3], [5, 6, -7]], "times_s": [0, 4]}),
        ("x,y,z\n1,2,-3", ["--speed", "2"], {"points_m": [[1, 2, -3]], "speed_mps": 2.0}),
    ],
    ids=["timed", "with a speed"],
)  # fmt: skip
def test_way_points_come_from_a_file(
    head: str,
    options: Sequence[str],
    expected: Any,
    sent: list[tuple[str, str, Any]],
    tmp_path: Path,
) -> None:
    """With times, or without and with a speed; not beside a position, nor with both."""
    file = tmp_path / "points.csv"
    file.write_text(head, encoding="ascii")
    common = ["--file", str(file), *options, "--run", "hover", "--connect", "tcp/127.0.0.1:1"]
    result = CliRunner().invoke(app, ["target", *common])
    assert result.exit_code == 0, result.stderr
    assert sent == [("coordinator", "target", expected)]
    both = CliRunner().invoke(app, ["target", "1", "2", "-3", *common])
    assert "expected X Y Z, or --file, got 3 numbers and --file" in both.stderr


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        ("link set --loss 2", "loss: expected a share, at most 1, got 2"),
        ("link set --distribution empirical", "samples_s: expected measured delays"),
        ("link set --delay nan", "delay_s: "),
        ("link set --between 1,2 --loss 1", "--between: expected groups with a slash or |"),
        ("link set", "expected at least one of --delay"),
        ("target 3 0", "expected X Y Z, or --file, got 2 numbers"),
        ("target 3 0 nan", "points_m"),
        ("land 3", "expected X Y, or none of them, got 1 number"),
    ],
)
def test_refused_without_asking(words: str, problem: str, sent: list[tuple[str, str, Any]]) -> None:
    """Values that no run accepts are refused before the run is asked."""
    arguments = [*words.split(), "--run", "hover", "--connect", "tcp/127.0.0.1:1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert problem in result.stderr
    assert sent == []
