"""A run across real processes: complete, documented, reproducible, and equal to the in-memory run."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import transport
from tests.mpc.test_published_equations import PUBLISHED
from tests.support import runs
from tests.support.commands import SHORT, Forked, free_base, processes_of, settings
from tests.support.troubles import ITERATIONS
from transport.log.run_log import read_log
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Message

SCHEMA = json.loads(
    (Path(__file__).parents[2] / "transport" / "analysis" / "summary.schema.json").read_text()
)

PAIRS_ON_CHANGE = (
    *(
        "agents.owned=[[1,2],[3,4]]",
        "controller.prediction=closed_loop",
        "controller.received_plans=by_age",
    ),
    *(
        "controller.share=on_change",
        "controller.share_threshold=0.02",
        "controller.share_heartbeat_s=0.4",
    ),
)
FAILURES = (
    "plant.motors={lag_s=0.06,thrust_step_N=0.1}",
    *("controller.relaxation=0.25", "controller.motor_lag_s=0.05", "links.loss=0.3"),
    "faults.event=[{at_s=0.5,do='degrade',target='uav2',efficiency=0.95},{at_s=0.6,do='motor_off',target='uav3'},"
    "{at_s=0.65,do='release',target='uav3'}]",
)

CLOSED_LOOP = "controller.prediction=closed_loop", "controller.received_plans=by_age"
DEATHS = (
    "clock.on_agent_loss=continue",
    "faults.event=[{at_s=0.5,do='kill',target='agent2'},{at_s=0.7,do='restart',target='agent2'},"
    "{at_s=0.9,do='kill',target='agent4'}]",
    "links.change=[{at_s=0.6,delay_s=0.07,jitter_s=0.05,loss=0.2}]",
)
# Of a longer run: the motion to a target takes 4 s.
TOLD = (
    "maneuver.phase=[{name='hover',duration_s=5.5,displacement_m=[0,0,0]}]",
    "maneuver.target=[{at_s=0.5,points_m=[[0.2,0,-10]],to=[2]}]",
)
# UAVs 1 and 2, of two agents, see a wall at the same tick: the team rests before it and goes round it.
SEEN = (
    "agents.owned=[[1,3],[2,4]]",
    "maneuver.phase=[{name='hover',duration_s=0.5,displacement_m=[0,0,0]},"
    "{name='go',kind='spline',points_m=[[3.5,0,0]],speed_mps=0.5,ramp_s=1.5},"
    "{name='hover',duration_s=9.0,displacement_m=[0,0,0]}]",
    "obstacle=[{kind='box',at_m=[1.9,0.5,-10],size_m=[0.2,1,8],margin_m=0.3,seen_within_m=1.2}]",
)
STOP = (
    *("controller.silence=stop", "controller.targets=confirmed"),
    "links.change=[{at_s=0.4,loss=1.0},{at_s=2.4,loss=0.1}]",
    *("clock.on_agent_loss=continue", "faults.event=[{at_s=1.9,do='kill',target='agent4'}]"),
)
# Many plans come later than the next tick, and many are lost.
RADIO = "radio={offsets='random',computation_mean_s=0.02,background=0.3}"

# Expansions with and without response to rod length differ in directions that a state reaches at
# second order only.
SAME_ALGORITHM = 0.02


def run_json(forked: Callable[..., Forked], folder: Path, *arguments: str) -> dict[str, Any]:
    """Run a scenario and return the summary, the last that it prints."""
    options = ["--out", folder.name, "--format", "json", "--no-figures"]
    code, printed = forked("run", *arguments, *options, cwd=folder.parent).end()
    assert code == 0, printed
    summary: dict[str, Any] = json.loads("{" + f"\n{printed}".partition("\n{")[2])
    jsonschema.validate(summary, SCHEMA)
    return summary


def reproducible(messages: list[Message]) -> dict[tuple[str, str], list[bytes]]:
    """Return messages by sender and kind, in the order sent, without the wall-clock times of reports."""
    streams: dict[tuple[str, str], list[bytes]] = {}
    for message in sorted(messages, key=lambda m: (m.sender, m.sequence)):
        streams.setdefault((message.sender, message.kind), []).append(
            encode(runs.reproducible(message))
        )
    return streams


def messages_of(folder: Path) -> list[Message]:
    """Return what a run has recorded, without the recorder's own notes."""
    recorded = [each.message for each in read_log(folder / "run.mcap").messages]
    return [message for message in recorded if message.kind != "fault"]


@pytest.mark.slow
def test_the_papers_maneuver() -> None:
    """Section V: four agents complete 25 s in memory, which processes equal bit for bit.

    Attitude within 2.5 deg, separation kept.
    """
    summary = transport.fly("paper", progress=False).summary
    assert summary["outcome"] == "completed"
    assert summary["ticks"] == 500
    assert summary["attitude_max_deg"] <= 2.5
    assert summary["separation_min_m"] > 0.4
    assert summary["cost"]["mean"] == pytest.approx(PUBLISHED, rel=SAME_ALGORITHM)
    assert summary["solver"]["failures"] == 0


@pytest.mark.slow
def test_the_paper_across_processes(forked: Callable[..., Forked], tmp_path: Path) -> None:
    """Section V as it is, shortened: six processes, no message lost or late, the bits of memory."""
    # Another worker's test may fly a "run" from the same current folder at this moment.
    folder = tmp_path / "across-processes"
    summary = run_json(forked, folder, "paper", *settings(SHORT))
    assert processes_of(folder.name) == {}
    assert summary["processes"] == 6
    assert summary["solver"]["failures"] == 0
    counts = summary["messages"]
    assert counts["lost"] == counts["late"] == counts["rejected"] == 0
    memory = runs.recorded(runs.ready("paper", SHORT))
    assert reproducible(messages_of(folder)) == reproducible(memory)


@pytest.mark.parametrize(
    "changes",
    [
        pytest.param(
            ("clock.actuation=next_tick", "clock.offsets_s=[0.0,0.01,-0.02,0.0]"), id="next tick"
        ),
        pytest.param((ITERATIONS, "clock.speed=2.0"), id="paced negotiation"),
        pytest.param(
            (*runs.VEHICLE, "links.delay_s=0.1", "links.loss=0.3"),
            id="vehicle sensors",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            (RADIO, *CLOSED_LOOP, ITERATIONS, "controller.relaxation=0.25"), id="radio, negotiation"
        ),
        pytest.param(
            (RADIO, *CLOSED_LOOP, *TOLD), id="radio, a target told to one", marks=pytest.mark.slow
        ),
        pytest.param((RADIO, *CLOSED_LOOP, *SEEN), id="radio, a wall seen", marks=pytest.mark.slow),
        pytest.param(
            (*CLOSED_LOOP, *TOLD, *STOP),
            id="stop in silence, confirmed, a death",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            (RADIO, *CLOSED_LOOP, *DEATHS), id="radio, deaths, links", marks=pytest.mark.slow
        ),
        pytest.param(
            (RADIO, "radio.offsets=none", "radio.delivery=unicast", *PAIRS_ON_CHANGE, *FAILURES),
            id="radio, unicast, on change, failures",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            (*PAIRS_ON_CHANGE, *FAILURES), id="pairs, on change, failures", marks=pytest.mark.slow
        ),
    ],
)
def test_network_equals_memory(
    changes: tuple[str, ...], forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """Every message except for the wall-clock times of reports is bitwise equal on the network and in memory."""
    folder = tmp_path / "run"
    assert run_json(forked, folder, "paper", *settings(SHORT, *changes))["rejections"] == []
    memory = runs.recorded(runs.ready("paper", SHORT, *changes))
    assert reproducible(messages_of(folder)) == reproducible(memory)


def test_processes_with_different_scenarios_refuse_each_other(
    forked: Callable[..., Forked], tmp_path: Path
) -> None:
    """An agent started with other settings is refused by name."""
    base = f"network.base_port={free_base()}"
    options = ["--run", "mixed", "--join-timeout", "20"]
    plant = forked("plant", *options, *settings(base), cwd=tmp_path)
    other = forked(
        "agent", "--id", "1", *options, *settings(base, "controller.horizon=30"), cwd=tmp_path
    )
    (plant_code, plant_says), (code, says) = plant.end(), other.end()
    assert (code, plant_code) == (4, 4)
    assert "plant runs another scenario" in says
    assert "agent1 runs another scenario" in plant_says
