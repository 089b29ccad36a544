"""The program, controller, scenarios and engine of docs/own-*.md work."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.runs import SCENARIOS, plant_states, recorded, ticks
from transport.protocol.scenario.scenario_file import read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Plan

# The engine of the document and the one here, both far below what a controller notices.
ENGINES_M = 1e-5
CLIMB = "maneuver.phase=[{name='climb',duration_s=3.0,displacement_m=[0.5,0.0,-1.5]}]"

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = [
    DOCS / f"own-{subject}.md" for subject in ("controller", "algorithm", "maneuver", "process")
]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(language: str) -> list[str]:
    """The fenced blocks of a language."""
    found = [
        text
        for page in PAGES
        for name, text in FENCE.findall(page.read_text(encoding="utf-8"))
        if name == language
    ]
    assert found
    return found


def test_the_path_of_the_document(tmp_path: Path) -> None:
    """An eight of 2 m, from rest to rest, where the phase before ended.

    The scenario around it is valid.
    """
    _, _, program, _ = blocks("python")
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True, timeout=60)
    phases, *_ = blocks("toml")
    ready = (SCENARIOS / "resilient.toml").read_text(encoding="utf-8")
    begin, end = ready.index("[[maneuver.phase]]"), ready.index("[controller]")
    (tmp_path / "mine.toml").write_text(ready[:begin] + phases + ready[end:], encoding="utf-8")
    run = Setup.of(read_scenario(tmp_path / "mine.toml"), str(tmp_path / "mine.toml"))
    assert run.maneuver.duration_s == pytest.approx(26.0)
    r, v = run.maneuver.path(0.025 + 0.05 * np.arange(520, dtype=np.float64))
    assert np.ptp(r, axis=0) == pytest.approx([2.0, 1.0, 0.0], abs=0.01)
    assert r[[0, -1]] == pytest.approx(np.tile(run.maneuver.start_I, (2, 1)), abs=1e-3)
    # No jump of the speed anywhere: 0.05 s of the largest acceleration, that of the turns.
    assert np.linalg.norm(np.diff(v, axis=0), axis=1).max() < 0.05
    assert np.linalg.norm(v[[0, -1]], axis=1).max() < 0.01


def test_the_data_of_the_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The class that shares a height flies, and shares it in every plan."""
    controller, even, *_ = blocks("python")
    # Names of their own: an imported module stays, and other tests have another "mine".
    (tmp_path / "my_base.py").write_text(controller, encoding="utf-8")
    text = even.replace("from mine import", "from my_base import")
    (tmp_path / "my_even.py").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    path = SCENARIOS / "resilient.toml"
    run = Setup.of(read_scenario(path, ["agents.controller=my_even:Even", ticks(20)]), str(path))
    messages = recorded(run)
    plans = [message for message in messages if isinstance(message, Plan)]
    assert len(plans) == 4 * 20
    assert {plan.data.shape for plan in plans} == {(1,)}
    assert {plan.status for plan in plans} == {"solved"}


def test_the_controller_of_the_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The class hovers, from Python by name and from the command line's setting alike."""
    controller, *_ = blocks("python")
    (tmp_path / "my_level.py").write_text(controller, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    path = SCENARIOS / "resilient.toml"
    run = Setup.of(read_scenario(path, ["agents.controller=my_level:Level", ticks(20)]), str(path))
    x = np.array([entry.x for entry in plant_states(recorded(run))])
    assert len(x) == 20
    assert np.abs(x - run.initial_state()).max() < ENGINES_M


@pytest.mark.slow
def test_the_engine_of_the_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The class integrates the beginning of the paper's maneuver like the engine of the project."""
    *_, engine = blocks("python")
    (tmp_path / "mine.py").write_text(engine, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    path = SCENARIOS / "resilient.toml"
    paths = []
    for name in ("mine:Adaptive", "rods"):
        run = Setup.of(read_scenario(path, [f"plant.engine={name}", CLIMB]), str(path))
        paths.append(np.array([entry.x for entry in plant_states(recorded(run))]))
    assert len(paths[0]) == 60
    assert np.abs(paths[0] - paths[1]).max() < ENGINES_M
