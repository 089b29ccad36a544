"""An agent without code of the project controls UAV 3 among real processes.

The protocol page suffices.
"""

import ast
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.commands import command, free_base, settings
from tests.support.runs import ready
from tests.test_architecture import LAYERS
from transport.model.parameters import table_1
from transport.protocol.scenario.file import find_scenario, read_scenario
from transport.protocol.wire.codec import VERSION

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "foreign_agent.py"


def simulate(folder: Path, *changes: str) -> dict[str, Any]:
    """Run `resilient` with the foreign agent as agent 3 and return the recorder's summary."""
    base = free_base()
    given = [*changes, f"network.base_port={base}"]
    digest = read_scenario(find_scenario("resilient"), given).digest()
    options = ["--run", "mixed-team", "--scenario", "resilient", *settings(*given)]
    roles = [
        ["record", "--out", "recorded", "--no-figures"],
        ["coordinator", "--observer", "recorder"],
        ["plant"],
        *[["agent", "--id", str(agent)] for agent in (1, 2, 4)],
    ]
    commands = [command(*role, *options) for role in roles]
    commands.append([sys.executable, str(EXAMPLE), "mixed-team", digest, "3", str(base)])
    started = [
        subprocess.Popen(
            words, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for words in commands
    ]
    try:
        outputs = [process.communicate(timeout=150) for process in started]
    finally:
        for process in started:
            process.kill()
    assert [process.returncode for process in started] == [0] * len(started), outputs
    summary: dict[str, Any] = json.loads((folder / "recorded" / "summary.json").read_text())
    assert summary["outcome"] == "completed"
    assert summary["rejections"] == []
    return summary


@pytest.mark.slow
def test_a_foreign_agent_flies_the_maneuver(tmp_path: Path) -> None:
    """In the paper's 25 s the agent knows only the others' plans.

    Payload attitude and separation stay in bounds.
    """
    summary = simulate(tmp_path)
    assert summary["ticks"] == 500
    assert summary["attitude_max_deg"] < 5.0
    assert summary["separation_min_m"] > 0.35


def test_it_imports_nothing_of_the_project() -> None:
    """The example imports only the standard library, msgpack, numpy and zenoh."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(EXAMPLE.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).partition(".")[0])
    assert not names & {*LAYERS, "tests", "scenarios"}
    assert names <= {*sys.stdlib_module_names, "msgpack", "numpy", "zenoh"}


def test_its_numbers_are_those_of_the_scenario() -> None:
    """The literals of the example equal the values of scenario and protocol version."""
    values: dict[str, Any] = {}
    for node in ast.parse(EXAMPLE.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            names = [ast.unparse(target) for target in node.targets[0].elts]
            assert isinstance(node.value, ast.Tuple)
            texts = [ast.unparse(value).removeprefix("np.array") for value in node.value.elts]
            values |= {
                name: ast.literal_eval(text) for name, text in zip(names, texts, strict=True)
            }
    run = ready("resilient")
    uav = table_1().uavs[2]
    assert values["VERSION"] == VERSION
    assert (values["AGENTS"], values["STEPS"]) == (len(run.agents), run.settings.horizon)
    assert values["MASS"] == uav.mass
    assert values["INERTIA"] == pytest.approx(uav.inertia.diagonal())
    assert values["THRUST"] == pytest.approx(run.hover.u[8])
    assert values["RHO"] == pytest.approx(uav.rho[:2])
