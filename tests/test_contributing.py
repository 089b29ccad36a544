"""The recipes of docs/development/recipes.md, followed on a copy of the sources."""

import os
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from transport.protocol.wire.messages import KINDS, Message

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "development" / "recipes.md"
PROTOCOL = ROOT / "docs" / "reference" / "protocol.md"

# Everything the examples import: a package may not hide another copy of itself.
PACKAGES = (
    "model",
    "mpc",
    "protocol",
    "agent",
    "plant",
    "coordinator",
    "deploy",
    "transport",
    "scenarios",
    "vehicles",
    "tests/support",
)

EDIT = re.compile(
    r" *In (?:the new file )?`([\w/.]+)`(?:, (?:after `([^`]+)`|at the end))?:\n\n"
    r"( *)```python\n(.*?)\n *```",
    re.DOTALL,
)
NEW = re.compile(r"In the new file `([\w/.]+)`")
NAMED = re.compile(r"`([a-z_]+/[\w/]+\.(?:py|md))`")
SEEN = re.compile(r"`(\w+)`")

# A link as the scenario describes it, a run in memory over such links, and the option, which takes
# whole numbers and lacks nothing but a run.
IMPAIRMENT = """
from typer.testing import CliRunner
from transport.cli.main import app
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.flight.memory import simulate

path = find_scenario("resilient")
hover = 'maneuver.phase=[{name="hover",duration_s=1.0,displacement_m=[0,0,0]}]'
settings = ["links.lose_every=3", "links.change=[{at_s=0.6,lose_every=2}]", hover]
setup = Setup.of(read_scenario(path, settings), str(path))
lost = [tick for tick in range(20) if not setup.rules.link("agent1", "agent2").delays(tick)]
assert lost == [0, 3, 6, 9, 12, 14, 16, 18], lost
reports = []
assert simulate(setup, reports.append).outcome == "completed"
assert sum(getattr(message, "lost", 0) for message in reports) > 0

for value, problem in {"3": "no active run in nowhere", "2.5": "--lose-every"}.items():
    arguments = ["link", "set", "--lose-every", value, "--run", "nowhere"]
    errors = CliRunner().invoke(app, arguments).stderr
    assert problem in errors, errors
"""

# The key of a scenario, rows about the present state and along a reference, and their effect.
CONSTRAINT = """
import numpy as np
from transport.flight.memory import simulate
from transport.model.state import THETA0
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import PlantState

MOVE = "{name='move',duration_s=2.4,displacement_m=[1.2,0,0]}"

def largest_deg(name, *settings):
    path = find_scenario(name)
    setup = Setup.of(read_scenario(path, [f"maneuver.phase=[{MOVE}]", *settings]), name)
    angles = []
    def take(message):
        if isinstance(message, PlantState):
            angles.append(np.abs(message.x[THETA0][:2]).max())
    assert simulate(setup, take).outcome == "completed"
    return float(np.degrees(max(angles)))

free = largest_deg("resilient")
limits = ["controller.payload_tilt.limit_deg=%g" % (free / 2), "controller.payload_tilt.penalty=1e4"]
kept = largest_deg("resilient", *limits)
assert kept < 0.8 * free, (free, kept)

# Along a flat reference the load is level but for gusts: the same rows, and another plan.
gusts = ["maneuver.profile=smooth", "plant.wind.gust_mps=[1.0,1.0,1.0]"]
free = largest_deg("eight", *gusts)
limits = ["controller.payload_tilt.limit_deg=%g" % (free / 4), "controller.payload_tilt.penalty=1e4"]
assert largest_deg("eight", *gusts, *limits) != free
"""

# From the sender's outbox over key, bytes and checks to the table of the log.
MESSAGE = """
from transport.protocol.wire.codec import decode, encode
from transport.protocol.wire.messages import Battery, MessageError
from transport.protocol.wire.key_expressions import Keys, matches
from transport.protocol.wire.outbox import Outbox
from tests.support.messages import sample

keys = Keys("run")
message = Outbox("agent2", 0).stamp(Battery, tick=3, agent=2, charge_As=7e3)
key, data = keys.of(message), encode(message)
assert message.place == (3, 0)
hears = {name for name in ("coordinator", "plant", "agent1", "agent2", "recorder")
         if any(matches(expression, key) for expression in keys.subscriptions(name))}
assert (key, hears) == ("transport/run/battery/2", {"recorder"})
assert key in keys.publications("agent2") and key not in keys.publications("agent1")
assert decode(data) == message
keys.check_sender(key, message)
try:
    keys.check_sender(key, Outbox("agent1", 0).stamp(Battery, tick=3, agent=2, charge_As=7e3))
except MessageError as error:
    assert error.reason == "wrong_sender"
else:
    raise AssertionError("a forged sender was accepted")
assert sample(Battery).sender == "agent2"
"""

# The command with its option, and the points that it simulates.
EXPERIMENT = """
from typer.testing import CliRunner
from transport.experiments.network_experiments import reorder
from transport.experiments.declaration import EXPERIMENTS
from transport.cli.main import app
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario

shown = CliRunner().invoke(app, ["experiment", "--help"]).output
assert "Effect of plans that are held back." in shown, shown
name = "resilient"
scenarios = {name: read_scenario(find_scenario(name))}
points = EXPERIMENTS[reorder.__name__].experiment(scenarios, {"reorder": [0.5]}).points
assert [(point.labels["links.reorder"], point.baseline) for point in points] == [(0.0, True), (0.5, False)]
assert read_scenario(find_scenario(name), points[1].settings).links.reorder == 0.5
"""


def section(heading: str) -> str:
    """Text below a heading of the page."""
    return PAGE.read_text(encoding="utf-8").partition(f"## {heading}\n")[2].partition("\n## ")[0]


@pytest.mark.parametrize(
    ("heading", "script"),
    [
        ("A new link impairment", IMPAIRMENT),
        ("A new constraint", CONSTRAINT),
        ("A new message", MESSAGE),
        ("A new experiment", EXPERIMENT),
    ],
    ids=["link", "constraint", "message", "experiment"],
)
def test_recipe(heading: str, script: str, tmp_path: Path) -> None:
    """With the edits of a recipe, and no others, the example works from its definition to the result."""
    for package in PACKAGES:
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, tmp_path / package, symlinks=True, ignore=ignore)
    edits = EDIT.findall(section(heading))
    assert edits
    for file, anchor, indent, block in edits:
        path = tmp_path / file
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        added = "\n".join(line.removeprefix(indent) for line in block.splitlines())
        if anchor:
            assert text.count(f"{anchor}\n") == 1, f"{file} has no single line {anchor!r}"
            text = text.replace(f"{anchor}\n", f"{anchor}\n{added}\n")
        elif text:
            text = f"{text}\n\n{added}\n"
        else:
            text = f"{added}\n"
        path.write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-P", "-c", textwrap.dedent(script)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "heading", re.findall(r"^## (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
)
def test_files_of_a_recipe_exist(heading: str) -> None:
    """Every file that a recipe names exists."""
    made = set(NEW.findall(section(heading)))
    for file in set(NAMED.findall(section(heading))) - made:
        assert (ROOT / file).is_file(), f"docs/development/recipes.md names {file}"


@pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))
def test_messages_are_described(kind: type[Message]) -> None:
    """docs/reference/protocol.md has each message's fields, in the order in which they are sent."""
    row = re.search(
        rf"^\| `{kind.kind}` \| (.*) \|$", PROTOCOL.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert row is not None, f"docs/reference/protocol.md has no row for {kind.kind}"
    names = kind.__struct_fields__[len(Message.__struct_fields__) :]
    assert [name for name in SEEN.findall(row[1]) if name in names] == list(names)
