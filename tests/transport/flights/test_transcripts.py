"""Transcripts of whole runs on the in-memory bus, as text files that people read.

`python -m pytest tests/transport/flights/test_transcripts.py --rewrite` renews the files; a change of one is
a change of the protocol's behaviour and belongs into a review. Only what is equal on every machine
is written: who takes part, which plans arrive when, and what the actuators follow; no numbers that
the last bit of a computation decides.
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.runs import ready
from transport.flight.memory import simulate
from transport.protocol.wire.messages import (
    Control,
    LinkChange,
    Message,
    Plan,
    PlantState,
    Roster,
    StepReport,
    Target,
)

FOLDER = Path(__file__).parent / "transcripts"
TICKS = 12  # written of each run: every event and its consequences
SURVIVES = "clock.on_agent_loss=continue"


def hover(duration_s: float) -> str:
    """Return the setting of a run that hovers."""
    return f"maneuver.phase=[{{name='hover',duration_s={duration_s},displacement_m=[0,0,0]}}]"


# What a transcript is about, and the settings that make it happen.
CASES: dict[str, tuple[str, tuple[str, ...]]] = {
    "join": ("Start of a run: the roster, then first plans, which arrive one tick later.", ()),
    "death_and_return": (
        "Agent 3 is killed at 0.2 s and started again at 0.4 s. UAV 3 follows its last plan, then "
        "the fail-safe; the returned agent has a new incarnation.",
        (
            SURVIVES,
            "controller.horizon=2",
            "faults.event=[{at_s=0.2,do='kill',target='agent3'},"
            "{at_s=0.4,do='restart',target='agent3'}]",
        ),
    ),
    "target": (
        "A target is announced at 0.2 s and holds from that tick on for all.",
        (hover(6.0), "maneuver.target=[{at_s=0.2,points_m=[[0.2,0.0,-10.0]]}]"),
    ),
    "partition": (
        "Agents 1 and 2 do not reach agents 3 and 4 from 0.2 to 0.4 s: ages grow across the cut only.",
        ("links.partition=[{start_s=0.2,end_s=0.4,between=['agent1','agent2']}]",),
    ),
    "negotiation": (
        "Three iterations of negotiation: three plans of each agent in a tick, the last one acts.",
        ("controller.negotiation_iterations=3",),
    ),
    "late_plan": (
        "Plans of agent 2 are 120 ms late at agent 1: three ticks old when they are used there.",
        ("links.override=[{from='agent2',to='agent1',delay_s=0.12}]",),
    ),
}


def lines(messages: Sequence[Message]) -> Iterator[str]:
    """Yield the lines of a transcript: a heading for each tick, its events, and what each agent did."""
    tick = -1
    for message in messages:
        if type(message) not in WRITERS:
            continue
        if isinstance(message, Plan | StepReport | PlantState | Roster | Target):
            if message.tick >= TICKS:
                yield "..."
                return
            if message.tick > tick:
                tick = message.tick
                yield f"tick {tick}"
        yield f"  {WRITERS[type(message)](message)}"


def of_roster(roster: Roster) -> str:
    """Return who takes part from now on, and why that changed."""
    members = [
        f"agent{agent}.{incarnation}"
        for agent, incarnation in zip(roster.agents, roster.incarnations, strict=True)
    ]
    return f"roster {roster.version}: {' '.join(members)}  ({roster.reason or 'start'})"


def of_plan(plan: Plan) -> str:
    """Return for which ticks a plan is, and which exchange of the tick it belongs to."""
    last = plan.start_tick + len(plan.inputs) - 1
    left = f", {plan.negotiation} exchanges to follow" if plan.negotiation else ""
    shared = "" if plan.shared else ", unshared"
    return f"agent{plan.agent} plans ticks {plan.start_tick} to {last}: {plan.status}{left}{shared}"


def of_report(report: StepReport) -> str:
    """Return how old the newest plans of the others are that an agent has used."""
    ages = [
        f"agent{peer} {'none' if age < 0 else age}"
        for peer, age in zip(report.peers, report.plan_ages, strict=True)
    ]
    lost = f", {report.lost} lost" if report.lost else ""
    return f"agent{report.agent} has plans aged {', '.join(ages)}{lost}"


def of_plant(state: PlantState) -> str:
    """Return which plan each UAV follows until the next tick."""
    names = {-1: "hover", -2: "fail-safe", -3: "motors off"}
    followed = [
        f"uav{number} {names.get(tick, f'plan {tick}')}"
        for number, tick in enumerate(state.plan_ticks, start=1)
    ]
    return f"plant follows {', '.join(followed)}"


WRITERS: dict[type[Message], Callable[[Any], str]] = {
    Roster: of_roster,
    Plan: of_plan,
    StepReport: of_report,
    PlantState: of_plant,
    Target: lambda target: f"target {target.number} at {target.points.tolist()}",
    LinkChange: lambda change: f"links {change.source} to {change.target}: {change.settings}",
    Control: lambda control: f"end: {control.outcome} {control.reason}".rstrip(),
}


@pytest.mark.parametrize("name", CASES)
def test_a_run_is_as_written(name: str, request: pytest.FixtureRequest) -> None:
    """The order of messages, rosters and ages of a run is that of its transcript (docs/time.md)."""
    title, settings = CASES[name]
    recorded: list[Message] = []
    simulate(ready("resilient", hover(TICKS * 0.05), *settings), recorded.append)
    transcript = "\n".join([f"# {title}", *(line.rstrip() for line in lines(recorded)), ""])

    file = FOLDER / f"{name}.txt"
    if request.config.getoption("--rewrite"):
        file.write_text(transcript, encoding="utf-8")
    assert transcript == file.read_text(encoding="utf-8"), f"{file.name}: renew it with --rewrite"
