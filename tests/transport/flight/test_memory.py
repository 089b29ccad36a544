"""The in-memory runtime: complete runs, their reproducibility, and their references."""

import time
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest

from tests.support.runs import SHORT, integrated, plant_states, recorded, reproducible, setup
from tests.support.shuffled import fly_shuffled
from transport.flight import memory
from transport.model.arrays import Array
from transport.mpc.controller import Controller, Horizon
from transport.plant.node import PlantNode
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.codec import decode, encode
from transport.protocol.wire.key_expressions import Keys
from transport.protocol.wire.messages import (
    KINDS,
    STAGES,
    Control,
    Message,
    Plan,
    Presence,
    Roster,
    StepReport,
)

PERIOD_S = 0.05
TICKS = 30
FOUR, PAIRS, ALL = (
    "agents.owned=[[1],[2],[3],[4]]",
    "agents.owned=[[1,2],[3,4]]",
    "agents.owned=[[1,2,3,4]]",
)
NEXT_TICK, CLOSED_LOOP = "clock.actuation=next_tick", "controller.prediction=closed_loop"

# A network with every impairment; only the shared control law tolerates it.
BAD_NETWORK = (
    "links={delay_s=0.08,jitter_s=0.1,loss=0.2,duplicate=0.2,reorder=0.2,reorder_s=0.1}",
    CLOSED_LOOP,
    "controller.relaxation=0.5",
)

# The agents' estimates take fewer integration steps per period than the plant: 1e-11 m and rad
# apart on this gentle flight, and what the controllers make of that, 1e-10 N and N m at most, stays
# of that size.
DISTRIBUTED_TOLERANCE = 1e-8

# DAQP and Clarabel meet the optimality conditions to 1e-6, in units of half an actuator's range.
SOLVER_TOLERANCE = 1e-3


@lru_cache
def run_messages(*settings: str) -> tuple[Message, ...]:
    """Return every message of a short run."""
    return tuple(recorded(setup(SHORT, *settings)))


def contents(messages: Sequence[Message]) -> dict[tuple[str, int], bytes]:
    """Return all messages by sender and number, without wall-clock times."""
    return {
        (message.sender, message.sequence): encode(reproducible(message)) for message in messages
    }


def states(messages: Sequence[Message]) -> Array:
    """True states, (ticks, n)."""
    return np.array([plant_state.x for plant_state in plant_states(messages)])


@pytest.mark.parametrize(
    "settings",
    [
        (FOUR,),
        (PAIRS,),
        (ALL,),
        (NEXT_TICK,),
        (CLOSED_LOOP,),
        (CLOSED_LOOP, NEXT_TICK),
        BAD_NETWORK,
    ],
)
def test_a_run_completes(settings: tuple[str, ...]) -> None:
    """A short maneuver is completed.

    One plant state, one plan and one report per agent and tick, all solved.
    """
    messages = run_messages(*settings)
    agents = setup(SHORT, *settings).agents
    assert [plant_state.tick for plant_state in plant_states(messages)] == list(range(TICKS))
    for kind in (Plan, StepReport):
        made = sorted((m.tick, m.agent) for m in messages if isinstance(m, kind))
        assert made == [(k, agent) for k in range(TICKS) for agent in agents]
    reports = [message for message in messages if isinstance(message, StepReport)]
    assert {report.status for report in reports} == {"solved"}
    end = messages[-1]
    assert isinstance(end, Control)
    assert (end.outcome, end.exit_code, end.tick) == ("completed", 0, TICKS - 1)
    # 0.5 m in a second, followed within a payload's width.
    assert np.abs(states(messages)[-1, :3] - [0.0, 0.0, -10.5]).max() < 0.25


def test_the_other_solver_finds_the_same_flight() -> None:
    """Clarabel in place of DAQP flies the same path, to what the optimality conditions of both leave open."""
    clarabel = run_messages(FOUR, "controller.solver=clarabel")
    assert np.abs(states(clarabel) - states(run_messages(FOUR))).max() < SOLVER_TOLERANCE


@pytest.mark.parametrize("settings", [(FOUR,), (NEXT_TICK,), (CLOSED_LOOP,)])
def test_two_runs_are_equal(settings: tuple[str, ...]) -> None:
    """Two runs of one scenario send the same bytes in the same order, but for the wall-clock times in reports."""
    again = recorded(setup(SHORT, *settings))
    assert [encode(reproducible(m)) for m in again] == [
        encode(reproducible(m)) for m in run_messages(*settings)
    ]


def test_every_message_could_travel() -> None:
    """Everything sent decodes to the same bytes, under a key its sender owns, numbered without a gap."""
    keys = Keys("paper")
    messages = run_messages(FOUR)
    for message in messages:
        data = encode(message)
        assert encode(decode(data)) == data
        keys.check_sender(keys.of(message), message)
    for sender in {message.sender for message in messages}:
        numbers = [message.sequence for message in messages if message.sender == sender]
        assert numbers == list(range(len(numbers)))
    # No link change, no target, no fault, no rejection; motors are ideal, and no class controls.
    never = {"link", "target", "fault", "rejected", "actual_inputs", "note"}
    never |= {"airtime", "schedule", "vehicle"}  # the team has no radio and no autopilots
    assert {message.kind for message in messages} == set(KINDS) - never


@pytest.mark.parametrize("settings", [(FOUR,), (NEXT_TICK,), BAD_NETWORK])
def test_order_of_delivery_does_not_matter(settings: tuple[str, ...]) -> None:
    """All messages are equal bit for bit in any order of delivery.

    Lockstep does not depend on the network.
    """
    in_order = run_messages(*settings)
    shuffled = recorded(setup(SHORT, *settings), lambda run, record: fly_shuffled(run, record, 1))
    assert [encode(m) for m in shuffled if m.kind != "tick"] != [
        encode(m) for m in in_order if m.kind != "tick"
    ]
    np.testing.assert_array_equal(states(shuffled), states(in_order))
    assert contents(shuffled) == contents(in_order)


def plain_loop(run: Setup) -> Iterator[tuple[Array, Array]]:
    """Yield states and inputs of the plain loop.

    All agents plan at once from the plans of the last tick.
    """
    team = [Controller(run.model, run.hover, run.settings, owned) for owned in run.owned]
    x, u = run.initial_state(), run.hover.u
    U = np.tile(u, (run.settings.horizon, 1))
    c = np.zeros_like(U)
    for k in range(run.ticks):
        times = PERIOD_S * np.arange(k, k + len(U) + 1, dtype=np.float64)
        y_ref, x_ref = run.reference.outputs(times), run.reference.states(times[:-1])
        plans, corrections = np.empty_like(U), np.zeros_like(U)
        for controller in team:
            horizon = Horizon(U=U, y_ref=y_ref, law=controller.law(x, x_ref, c))
            optimum = controller.step(x, u, horizon, ticks_since_start=k)
            plans[:, controller.own] = optimum.U
            corrections[: len(optimum.c), controller.own] = optimum.c
        u = plans[0]
        yield x, u
        x = integrated(run, x, u)
        U = np.vstack([plans[1:], plans[-1:]])
        c = np.vstack([corrections[1:], np.zeros((1, len(u)))])


@pytest.mark.parametrize("settings", [(ALL,), (ALL, CLOSED_LOOP)])
def test_one_agent_is_the_plain_controller(settings: tuple[str, ...]) -> None:
    """With one agent owning all, the run is the plain loop of controller and model, bit for bit."""
    for plant_state, (x, u) in zip(
        plant_states(run_messages(*settings)), plain_loop(setup(SHORT, *settings)), strict=True
    ):
        np.testing.assert_array_equal(plant_state.x, x)
        np.testing.assert_array_equal(plant_state.u, u)


@pytest.mark.parametrize(
    "settings", [(FOUR,), (PAIRS,), (FOUR, CLOSED_LOOP, "controller.relaxation=0.5")]
)
def test_a_team_is_the_papers_iteration(settings: tuple[str, ...]) -> None:
    """On a perfect network several agents are the paper's update.

    All plan at once, from the plans of the last tick.
    """
    for plant_state, (x, u) in zip(
        plant_states(run_messages(*settings)), plain_loop(setup(SHORT, *settings)), strict=True
    ):
        np.testing.assert_allclose(plant_state.x, x, rtol=0.0, atol=DISTRIBUTED_TOLERANCE)
        np.testing.assert_allclose(plant_state.u, u, rtol=0.0, atol=DISTRIBUTED_TOLERANCE)


def test_inputs_keep_the_rate_limits() -> None:
    """Applied inputs change from tick to tick within the rate limits."""
    run = setup(SHORT)
    U = np.array(
        [run.hover.u, *[plant_state.u for plant_state in plant_states(run_messages(FOUR))]]
    )
    slack = 1e-6  # N and N m: the solver's tolerance on its rows
    assert (np.abs(np.diff(U, axis=0)) <= run.settings.largest_step(4) + slack).all()


def test_truth_is_a_trajectory_of_the_model() -> None:
    """Each true state is the one before, integrated under the recorded inputs.

    The record explains itself.
    """
    run = setup(SHORT)
    for before, after in pairwise(plant_states(run_messages(FOUR))):
        np.testing.assert_array_equal(integrated(run, before.x, before.u), after.x)


def test_divergence_ends_a_run() -> None:
    """A run that leaves its limits ends at once, with the reason and exit code 6, in any order of delivery."""
    run = setup(SHORT, "plant.max_error_m=0.02")
    messages: list[Message] = []
    control = memory.simulate(run, messages.append)
    assert (control.outcome, control.exit_code) == ("diverged", 6)
    last = plant_states(messages)[-1]
    assert last.diverged == "payload position error of 0.0 m exceeds 0.02 m"
    assert control.reason == f"{last.diverged} at t = {PERIOD_S * last.tick:.2f} s"
    assert 0 < last.tick < TICKS - 1
    for seed in range(3):
        shuffled: list[Message] = []
        end = fly_shuffled(run, shuffled.append, seed)
        np.testing.assert_array_equal(states(shuffled), states(messages))
        assert (end.outcome, end.reason, end.exit_code) == (
            control.outcome,
            control.reason,
            control.exit_code,
        )


@pytest.fixture
def deaf_plant(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plant that receives no plans, and so never reaches the second tick."""
    receive = PlantNode.receive

    def deaf(self: PlantNode, event: Message | Presence, now_ns: int) -> Sequence[Message]:
        return () if isinstance(event, Plan) else receive(self, event, now_ns)

    monkeypatch.setattr(PlantNode, "receive", deaf)


@pytest.mark.usefixtures("deaf_plant")
def test_timeouts_cost_nothing() -> None:
    """A run that a timeout ends, here of 1000 hours, is over at once.

    Virtual time jumps to the next wake-up.
    """
    began_s = time.monotonic()
    end = memory.simulate(setup(SHORT, "clock.barrier_timeout_s=1e6"))
    assert (end.outcome, end.exit_code, end.tick) == ("aborted", 4, 1)
    assert end.reason == "no agent answered tick 1 in time: is the plant alive?"
    assert time.monotonic() - began_s < 60.0


@pytest.mark.parametrize("do", ["kill", "stop"])
def test_a_run_whose_coordinator_is_gone_is_aborted(do: str) -> None:
    """The others end the run: one end is recorded, as the last message, and it is what is returned."""
    messages: list[Message] = []
    fault = f"faults.event=[{{target='coordinator',do='{do}',at_s=0.5}}]"
    end = memory.simulate(setup(SHORT, fault), messages.append)
    assert end.outcome == "aborted"
    assert "coordinator is gone" in end.reason
    assert [message for message in messages if isinstance(message, Control)] == [end]
    assert messages[-1] is end


@pytest.mark.parametrize("do", ["kill", "stop"])
def test_a_run_whose_plant_is_gone_is_aborted(do: str) -> None:
    """The coordinator ends the run once, at the tick after that of the last plant state or at it."""
    messages: list[Message] = []
    fault = f"faults.event=[{{target='plant',do='{do}',at_s=0.5}}]"
    end = memory.simulate(setup(SHORT, fault), messages.append)
    assert end.outcome == "aborted"
    assert "plant" in end.reason
    assert [message for message in messages if isinstance(message, Control)] == [end]
    assert plant_states(messages)[-1].tick in {9, 10}


def test_a_restarted_agent_has_the_tick_of_its_return() -> None:
    """Killed at its measurement of tick 6, it is on the roster and plans from tick 10 on, not from 11."""
    events = "{target='agent2',do='kill',at_s=0.3},{target='agent2',do='restart',at_s=0.5}"
    settings = (SHORT, "clock.on_agent_loss=continue", f"faults.event=[{events}]")
    messages = recorded(setup(*settings))
    own = [plan for plan in messages if isinstance(plan, Plan) and plan.agent == 2]
    assert {plan.incarnation for plan in own if plan.tick < 6} == {0}
    assert {plan.incarnation for plan in own if plan.tick > 6} == {1}
    planned = {plan.tick for plan in own}
    assert planned == {*range(TICKS)} - {6, 7, 8, 9}


@pytest.mark.parametrize(
    ("do", "reason"),
    [("kill", "agent2 is gone at"), ("stop", "agent2 did not answer tick 6 in time")],
)
def test_the_end_of_an_agent_is_told_and_its_stop_is_not(do: str, reason: str) -> None:
    """A stopped process keeps its connections: the coordinator waits for its answer before it goes on."""
    fault = f"faults.event=[{{target='agent2',do='{do}',at_s=0.3}}]"
    messages: list[Message] = []
    memory.simulate(setup(SHORT, "clock.on_agent_loss=continue", fault), messages.append)
    rosters = [message for message in messages if isinstance(message, Roster)]
    assert [roster.agents for roster in rosters] == [(1, 2, 3, 4), (1, 3, 4)]
    assert rosters[-1].reason.startswith(reason)


@pytest.mark.parametrize("target", ["coordinator", "plant"])
def test_coordinator_or_plant_that_was_continued_can_be_killed_later(target: str) -> None:
    """A stop that ends changes nothing in memory; the kill after it ends the run at its tick."""
    events = "".join(
        f"{{target='{target}',do='{do}',at_s={at_s}}},"
        for do, at_s in (("stop", 0.2), ("continue", 0.4), ("kill", 0.8))
    )
    messages: list[Message] = []
    end = memory.simulate(setup(SHORT, f"faults.event=[{events}]"), messages.append)
    assert end.outcome == "aborted"
    # 0.8 s is tick 16; a killed coordinator has sent that tick or not.
    assert plant_states(messages)[-1].tick in {15, 16}


def test_a_run_in_which_every_node_waits_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plant that never answers, and no wake-up of any node: an error names the deadlock, no endless loop."""
    monkeypatch.setattr(PlantNode, "receive", lambda *_: ())
    monkeypatch.setattr(memory.InMemoryRun, "_wait", lambda _: False)
    with pytest.raises(RuntimeError, match=r"deadlock at tick .*every node waits"):
        memory.simulate(setup(SHORT))


def test_stopwatch_is_only_for_reports() -> None:
    """A stopwatch that runs fast changes the times in the reports and nothing else."""
    now = iter(range(0, 10**15, 10**9))
    messages = recorded(
        setup(SHORT), lambda run, record: memory.simulate(run, record, stopwatch=lambda: next(now))
    )
    assert contents(messages) == contents(run_messages(FOUR))
    reports = [message for message in messages if isinstance(message, StepReport)]
    times_ms = dict(zip(STAGES, reports[0].times_ms, strict=True))
    assert times_ms.pop("wait") > 0.0
    assert times_ms.pop("publish") == 0.0  # nothing is sent anywhere
    assert times_ms.pop("total") == 6e3
    assert times_ms.pop("solve") == 2e3  # the solution, and what a hand-over makes of it
    assert set(times_ms.values()) == {1e3}
