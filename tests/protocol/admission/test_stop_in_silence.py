"""Stop in silence: docs/equations.md, "Stop in silence"."""

import numpy as np

from tests.support import logs, runs
from tests.support.runs import plan, setup
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.model.state import R0
from transport.protocol.admission.stop_in_silence import Stopping
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Message, Plan, PlantState

RUN = setup("controller.horizon=5")
PERIOD_S = 0.05
TICKS = 400
STOP = "controller.silence=stop"
AWAY = (
    "maneuver.phase=[{name='hover',duration_s=1,displacement_m=[0,0,0]},"
    "{name='go',duration_s=14,displacement_m=[6,0,0]},{name='rest',duration_s=8,displacement_m=[0,0,0]}]"
)
SILENT = "links.change=[{at_s=5,loss=1.0},{at_s=9,loss=0.0}]"


def said(agent: int, tick: int, lag: int, alone: float) -> Plan:
    """Return a plan that says how far behind its sender is."""
    made = plan(RUN, agent, tick)
    return Plan(
        **{field: getattr(made, field) for field in made.__struct_fields__}
        | {"lag": lag, "alone": alone}
    )


def test_all_end_at_the_least_progress_on_random_networks() -> None:
    """Whichever agents are cut off, and at any time, all are equally far behind a while after the last silence."""
    rng = np.random.default_rng(68)
    stops = 0
    for _ in range(20):
        agents = {agent: Stopping(PERIOD_S, TICKS) for agent in range(1, 5)}
        delay = int(rng.integers(1, 6))
        silences = rng.integers(20, 200, size=(4, 4))  # first tick of each link's silence
        lengths = rng.integers(0, 60, size=(4, 4))
        sent: dict[int, list[Plan]] = {}
        heard = {(a, b): 0 for a in agents for b in agents if a != b}
        lags: dict[int, int] = {}
        for k in range(TICKS):
            alone = {}
            for receiver, stopping in agents.items():
                for one in sent.get(k - delay, []):
                    first = silences[one.agent - 1, receiver - 1]
                    is_silent = first <= one.tick < first + lengths[one.agent - 1, receiver - 1]
                    if one.agent != receiver and not is_silent:
                        stopping.hear([one])
                        heard[receiver, one.agent] = k
                alone[receiver] = any(k - heard[pair] > 10 for pair in heard if pair[0] == receiver)
                loss = stopping.advance(k, is_alone=alone[receiver], roster=agents, speed_mps=0.5)
                assert loss is None or loss.lost_s > 0.0
                assert stopping.lag >= lags.get(receiver, 0)
                lags[receiver] = stopping.lag
            sent[k] = [said(a, k, one.lag, float(alone[a])) for a, one in agents.items()]
        assert len(set(lags.values())) == 1
        stops += max(lags.values()) > 0
    assert stops > 15


def test_an_agent_that_starts_is_as_far_behind_as_the_others_at_once() -> None:
    """It has not flown along its path before; one that has loses the time bit by bit."""
    new, old = Stopping(PERIOD_S, TICKS), Stopping(PERIOD_S, TICKS)
    assert old.advance(0, is_alone=False, roster=(2,), speed_mps=0.5) is None
    assert new.advance(99, is_alone=False, roster=(2,), speed_mps=0.5) is None
    for stopping in (new, old):
        stopping.hear([said(2, 99, 30, 0.0)])
    at_once = new.advance(100, is_alone=False, roster=(2,), speed_mps=0.5)
    assert at_once is not None
    times = np.array([5.0, 9.0])
    assert np.allclose(at_once.warped(times, 1)[0], times - 30 * PERIOD_S)
    later = old.advance(100, is_alone=False, roster=(2,), speed_mps=0.5)
    assert later is not None
    assert np.allclose(later.warped(times, 1)[0], times - [0.0, 30 * PERIOD_S])


def flown(*settings: str) -> tuple[list[Message], float]:
    """Return the messages of a run, and the largest attitude, deg."""
    run = runs.ready("precise", AWAY, *settings)
    made = runs.completed(run)
    return made, summarise(AnalysedRun.of(run, logs.log_of(made)))["attitude_max_deg"]


def test_in_silence_the_payload_rests_and_goes_on_later() -> None:
    """It rests 1 s after the agents act alone, goes on from there without a jump, and arrives by their lag later."""
    silent, attitude_deg = flown(STOP, SILENT)
    undisturbed, _ = flown(STOP)
    path = np.array([one.x[R0] for one in silent if isinstance(one, PlantState)])
    whole = np.array([one.x[R0] for one in undisturbed if isinstance(one, PlantState)])
    (lag,) = {one.lag for one in silent if isinstance(one, Plan) and one.tick == len(path) - 1}
    assert 40 < lag < 80
    # Alone by half after 0.75 s (OVERDUE_S), and 1 s later the path rests; the load's swing fades until 9 s.
    assert np.linalg.norm(path[180] - path[170]) < 0.1
    assert np.linalg.norm(path[280:] - whole[280 - lag : -lag], axis=1).max() < 0.05
    assert attitude_deg < 3.0


def test_a_target_told_to_one_in_silence_waits_for_the_others() -> None:
    """With stop the agent that is told does not run ahead; the team goes there once there is information."""
    told = "maneuver.target=[{at_s=7,points_m=[[6,2,-10]],to=[1]}]"
    made, attitude_deg = flown(STOP, SILENT, told)
    path = np.array([one.x[R0] for one in made if isinstance(one, PlantState)])
    assert np.abs(path[:180, 1]).max() < 0.05
    assert np.linalg.norm(path[-1] - [6.0, 2.0, -10.0]) < 0.05
    assert attitude_deg < 2.0


def test_a_death_in_the_silence_does_not_keep_the_others_from_going_on() -> None:
    """The agents that are left rest, are equally far behind, and arrive; the UAV without an agent goes with them."""
    died = "faults.event=[{at_s=6.5,do='kill',target='agent3'}]"
    made, attitude_deg = flown(STOP, SILENT, died, "clock.on_agent_loss=continue")
    path = np.array([one.x[R0] for one in made if isinstance(one, PlantState)])
    last = [one for one in made if isinstance(one, Plan) and one.tick == len(path) - 1]
    assert {one.agent for one in last} == {1, 2, 4}
    assert len({one.lag for one in last}) == 1
    assert 40 < last[0].lag < 80
    assert np.linalg.norm(path[180] - path[170]) < 0.1
    assert np.linalg.norm(path[-1] - [6.0, 0.0, -10.0]) < 0.05
    assert attitude_deg < 5.0


def test_without_silence_a_run_keeps_its_bits() -> None:
    """Stop costs nothing where there is information: not a bit of any message differs."""
    short = "maneuver.phase=[{name='hover',duration_s=3,displacement_m=[0,0,0]}]"
    one, other = (
        [
            encode(runs.reproducible(message))
            for message in runs.completed(runs.ready("precise", short, mode))
        ]
        for mode in (STOP, "controller.silence=alone")
    )
    assert one == other
