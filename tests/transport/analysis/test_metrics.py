"""Metrics: cases small enough to compute by hand."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from tests.support import runs
from tests.support.log_messages import (
    MEASUREMENTS,
    POSE_ERROR,
    SQUARED_INNOVATION,
    estimate_note,
    on_reference,
    report,
)
from tests.support.logs import log_of
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.communication_metrics import (
    deadline,
    links_of_plant,
    plans_between_agents,
    rest_of_tick_ms,
)
from transport.analysis.cost_and_tracking_metrics import cost_and_tracking, swing_of, targets
from transport.analysis.events import events
from transport.analysis.series import series_of
from transport.analysis.steps import steps_columns, steps_rows
from transport.analysis.summary_assembly import summarise
from transport.cli.commands.top import Watch
from transport.model import state
from transport.model.arrays import Array
from transport.model.physics.hover import released_state
from transport.protocol.admission.targets_in_plans import number_of_sight
from transport.protocol.scenario.sections.maneuver_sections import TargetSection
from transport.protocol.scenario.sections.scenario_errors import requested
from transport.protocol.scenario.setup.collisions import Contact
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.targets.target_checks import target_fields
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import (
    ActualInputs,
    Control,
    FaultNote,
    FaultOrigin,
    Message,
    Outcome,
    PlantState,
    Rejected,
    Target,
)
from transport.protocol.wire.outbox import Outbox
from transport.report.summary_table import summary_table
from transport.report.summary_texts import limits_text, plans_text

# A few roundings of numbers of order one to a hundred.
ROUNDING = 1e-12

HOVER = runs.ticks(10)


def control(k: int, outcome: Outcome = "completed", reason: str = "") -> Control:
    """Return the end of a run at tick k."""
    return replace(runs.end(), tick=k, outcome=outcome, reason=reason, exit_code=6 if reason else 0)


def perfect(ticks: int) -> list[Message]:
    """Return all messages but measurements of a run of the paper's team at hover over a perfect network."""
    run = runs.setup(HOVER)
    messages: list[Message] = [runs.roster()]
    for k in range(ticks):
        messages.append(runs.tick(k))
        messages += [runs.plan(run, agent, k) for agent in run.agents]
        messages += [report(run, agent, k) for agent in run.agents]
        messages.append(on_reference(run, k))
    return [*messages, control(ticks - 1)]


def test_estimates_against_their_covariance() -> None:
    """Errors of one standard deviation in six entries have a NEES of 6.

    Without notes there is no estimate.
    """
    run = runs.setup(runs.SHORT)
    flown = [
        *perfect(10),
        estimate_note(run, 1, 4),
        estimate_note(run, 2, 8),
        estimate_note(run, 2, 400),  # left out: no state of this tick is recorded
    ]
    found = summarise(AnalysedRun.of(run, log_of(flown)))["estimate"]
    assert found["nees"] == pytest.approx(6.0)
    # Tabulated quantiles of chi-square with 6 degrees of freedom.
    assert found["nees_band"] == pytest.approx([1.237, 14.449], abs=5e-4)
    assert found["nis"] == pytest.approx(SQUARED_INNOVATION / MEASUREMENTS)
    error = POSE_ERROR * np.sqrt(3.0)  # of three entries
    assert found["position_rms_m"] == pytest.approx(error)
    assert found["attitude_rms_deg"] == pytest.approx(np.degrees(error))
    assert summarise(AnalysedRun.of(run, log_of(perfect(10))))["estimate"] is None


def test_cost_of_a_displaced_team() -> None:
    """The whole team 0.2 m off costs 4 x 0.2^2 x 1, and a newton more of thrust 1e-3.

    Docs/equations.md (21).
    """
    run = runs.setup(HOVER)

    def change(x: Array, u: Array) -> None:
        x[1] += 0.2
        u[4] += 1.0

    summary = summarise(
        AnalysedRun.of(run, log_of([on_reference(run, 0), on_reference(run, 1, change)]))
    )
    assert summary["cost"]["max"] == pytest.approx(4 * 0.2**2 + 1e-3, rel=ROUNDING)
    assert summary["cost"]["mean"] == pytest.approx((4 * 0.2**2 + 1e-3) / 2, rel=ROUNDING)
    for tracking in ("uav_tracking", "payload_tracking"):
        assert summary[tracking]["max_m"] == pytest.approx(0.2, rel=ROUNDING)
        assert summary[tracking]["rms_m"] == pytest.approx(np.sqrt(0.2**2 / 2), rel=ROUNDING)
    series = series_of(run, log_of([on_reference(run, 1, change)]))
    assert series.uav_errors_I == pytest.approx(np.tile([0.0, 0.2, 0.0], (1, 4, 1)), abs=ROUNDING)


def test_a_released_uav_does_not_count() -> None:
    """From its release on a UAV changes no cost and no UAV error, wherever it is.

    Before, it does; its curve ends.
    """
    run = runs.setup(HOVER, "faults.event=[{at_s=0.25,do='release',target='uav3'}]")

    def away(x: Array, u: Array) -> None:
        x[state.uav_slice(2)][state.E] = [0.0, 0.6, 0.8]
        x[state.uav_slice(2)][state.OMEGA] = 1.0
        u[state.input_slice(2)] = [30.0, 0.1, 0.2, 0.3]

    there = series_of(run, log_of([on_reference(run, 4), on_reference(run, 5)]))
    off = series_of(run, log_of([on_reference(run, 4, away), on_reference(run, 5, away)]))
    assert off.cost[0] > there.cost[0] + 0.1
    assert off.cost[1] == there.cost[1]
    assert np.isnan(off.uav_errors_I).all(axis=2).tolist() == [
        [False] * 4,
        [False, False, True, False],
    ]
    summary = summarise(
        AnalysedRun.of(run, log_of([on_reference(run, 4), on_reference(run, 5, away)]))
    )
    assert summary["uav_tracking"] == pytest.approx({"rms_m": 0.0, "max_m": 0.0}, abs=ROUNDING)
    (_, row) = [
        r
        for r in steps_rows(AnalysedRun.of(run, log_of(perfect(6))))
        if r["agent"] == 3 and r["tick"] > 3
    ]
    assert (row["tick"], row["uav_error_max_m"]) == (5, None)


def test_after_a_delivery_only_the_payload_counts() -> None:
    """Once all UAVs are released, the cost is that of the payload, and the live cost of `transport top` is the same."""
    run = runs.ready("delivery")
    tick = 430  # 0.5 s after the release, on the ground

    def delivered(x: Array, u: Array) -> None:
        x[state.R0] = run.maneuver.path(np.array([tick * 0.05]))[0][0] + np.array([0.1, 0.0, 0.0])
        for uav in range(4):
            x[:] = released_state(x, uav)
        u[:] = 0.0

    left = on_reference(run, tick, delivered)
    assert series_of(run, log_of([left])).cost == pytest.approx([0.1**2], rel=1e-9)
    watch = Watch(run)
    watch.plant_state = left
    assert watch.content()["cost"] == pytest.approx(0.1**2, rel=1e-9)
    assert summarise(AnalysedRun.of(run, log_of([left])))["uav_tracking"] == {
        "rms_m": None,
        "max_m": None,
    }


def leaving(run: Setup, ticks: int, from_tick: int = 0) -> list[PlantState]:
    """Return plant states whose payload is 1 cm further below its reference at each tick."""

    def at(k: int) -> PlantState:
        def change(x: Array, u: Array) -> None:
            x[state.R0][2] += 0.01 * k

        return on_reference(run, k, change)

    return [at(k) for k in range(from_tick, ticks)]


def test_the_largest_cost_after_the_hover_is_apart() -> None:
    """From the end of the first phase on, at 0.5 s: the formation has settled about its hover."""
    run = runs.setup(runs.SHORT)

    def away(distance_m: float) -> Callable[[Array, Array], None]:
        def change(x: Array, u: Array) -> None:
            x[1] += distance_m

        return change

    log = log_of([on_reference(run, 9, away(0.3)), on_reference(run, 10, away(0.2))])
    cost = summarise(AnalysedRun.of(run, log))["cost"]
    assert cost["max"] == pytest.approx(4 * 0.3**2, rel=ROUNDING)
    assert cost["max_after_hover"] == pytest.approx(4 * 0.2**2, rel=ROUNDING)


def test_the_smallest_distances_from_obstacles_are_by_body() -> None:
    """Each over all ticks; and the largest error of the integration, of the ticks that have one."""
    run = runs.setup(
        HOVER, "obstacle=[{kind='sphere',at_m=[9.0,0.0,-10.0],radius_m=0.5,margin_m=0.3}]"
    )
    states = [replace(on_reference(run, k), local_error=1e-9 * (k - 1)) for k in range(3)]
    series = series_of(run, log_of(states))
    assert series.local_error.tolist() == [0.0, 1e-9]  # a negative one is none
    clearance_m = np.array([[3.0, 2.0, 1.0], [4.0, 1.5, 2.0], [5.0, 2.5, np.inf]])
    found = cost_and_tracking(run, dataclasses.replace(series, clearance_m=clearance_m))
    assert found["clearance_min_m"] == {"uav": 3.0, "rod": 1.5, "payload": 1.0}
    assert found["local_error_max"] == 1e-9


def test_a_target_is_judged_before_the_next_one_and_the_end_of_the_run() -> None:
    """Else 2 s after its path has ended, without which it has not been reached."""
    run = runs.setup(runs.ticks(400))

    def told(number: int, tick: int) -> Target:
        given = {"points_m": [[0.5 * number, 0.0, -10.0]]}
        fields = target_fields(run, requested(TargetSection, given), tick)
        return Outbox("coordinator", 0).stamp(Target, number=number, **fields)

    def errors_m(told: Sequence[Target], ticks: int) -> list[float | None]:
        led = run.after(told)
        found = targets(led, series_of(led, log_of(leaving(led, ticks))), log_of(told))
        return [one["error_m"] for one in found]

    first = told(1, 20)
    (path,) = run.after([first]).maneuver.targets
    end = math.ceil(path.ends_s / 0.05)  # the first tick at the end of its path
    second = told(2, end + 20)
    assert errors_m([first], 400) == pytest.approx([0.01 * (end + 40)])
    assert errors_m([first], end + 31) == pytest.approx([0.01 * (end + 30)])
    assert errors_m([first], end - 1) == [None]
    assert errors_m([first, second], end + 31) == [pytest.approx(0.01 * (end + 20)), None]


def test_the_time_until_all_know_a_target_is_that_of_the_last_roster() -> None:
    """From its tick to the first plans of all agents with it; at once if it is told to all, never if one lacks it.

    A stop by an agent, between two of them, has no number and no such time.
    """
    run = runs.setup(runs.ticks(400))

    def told(number: int, tick: int, *to: int) -> Target:
        given = {"points_m": [[0.5 * number, 0.0, -10.0]]}
        fields = {**target_fields(run, requested(TargetSection, given), tick), "to": to}
        return Outbox("coordinator", 0).stamp(Target, number=number, **fields)

    first, second, third = told(1, 20, 1), told(2, 200), told(3, 300, 1)
    stop = replace(first, sender="agent2", number=number_of_sight(2), tick=80, to=(2,), brakes=True)
    had = (
        *((1, first, 20), (2, first, 22), (3, first, 24), (2, first, 30), (4, first, 40)),
        *((2, stop, 80), (1, third, 300), (2, third, 302)),
    )
    plans = [
        replace(runs.plan(run, agent, k), targets=(encode(target),)) for agent, target, k in had
    ]
    three = dict.fromkeys((1, 2, 3), runs.INCARNATION)
    rosters = [runs.roster(three, k=50, version=2), runs.roster()]
    log = log_of([*rosters, first, second, third, *plans, on_reference(run, 0)])
    found = summarise(AnalysedRun.of(run, log))["targets"]
    assert [one["t_s"] for one in found] == [1.0, 4.0, 10.0, 15.0]
    assert [one["known_s"] for one in found] == [0.2, None, 0.0, None]


def test_the_swing_is_that_of_the_last_four_seconds() -> None:
    """Of 80 periods up to the last tick; larger errors before do not count."""
    run = runs.setup(runs.ticks(400))

    def away(distance_m: float) -> Callable[[Array, Array], None]:
        def change(x: Array, u: Array) -> None:
            x[state.R0][1] += distance_m

        return change

    ticks = ((119, 0.5), (120, 0.3), (139, 0.2), (140, 0.1), (199, 0.05))
    log = log_of([on_reference(run, k, away(distance_m)) for k, distance_m in ticks])
    assert swing_of(run, series_of(run, log)) == pytest.approx(0.3)


def test_states_count_once_for_each_tick_in_their_order() -> None:
    """Those of another team are left out; a UAV on its reference has no error, not none."""
    run = runs.setup(HOVER)
    single = runs.setup(HOVER, *runs.SINGLE_UAV)
    log = log_of([on_reference(run, 3), on_reference(single, 2), on_reference(run, 1)])
    series = series_of(run, log)
    assert series.ticks.tolist() == [1, 3]
    exact = dataclasses.replace(series, uavs_I=series.uav_references_I)
    assert exact.uav_error_max_m(run.owned).tolist() == [[0.0] * 4] * 2


def test_a_contact_and_the_ages_of_plans_are_those_of_the_run() -> None:
    """UAVs by their ids; a plan of the same tick has the age 0 and counts, an agent never heard does not."""
    run = runs.setup(HOVER)
    ages = [report(run, 1, 0, plan_ages=(0, 2, -1)), report(run, 2, 0, plan_ages=(-1, -1, 4))]
    analysed = AnalysedRun.of(run, log_of([on_reference(run, 0), *ages]))
    contact = Contact(at_s=1.23456789012, uavs=(1, 3), distance_m=0.4)
    series = dataclasses.replace(analysed.series, contact=contact)
    summary = summarise(dataclasses.replace(analysed, series=series))
    assert summary["collision"] == {"at_s": 1.23456789, "uavs": [1, 3], "distance_m": 0.4}
    assert summary["plan_age_ticks"] == {"mean": 2.0, "max": 4}


def test_the_velocity_of_the_payload_is_turned_into_the_inertial_frame() -> None:
    """Forwards of a payload that is turned by 90 deg about z is along y."""
    run = runs.setup(HOVER)

    def turned(x: Array, u: Array) -> None:
        x[state.THETA0] = [0.0, 0.0, np.pi / 2.0]
        x[state.V0] = [2.0, 0.0, 0.5]

    series = series_of(run, log_of([on_reference(run, 0, turned)]))
    assert series.payload_velocity_I == pytest.approx(np.array([[0.0, 2.0, 0.5]]), abs=ROUNDING)


def test_attitude_is_the_largest_angle() -> None:
    """The maximum is over roll, pitch, yaw and time, by magnitude, in degrees."""
    run = runs.setup(HOVER)

    def tilt(x: Array, u: Array) -> None:
        x[state.THETA0] = np.radians([1.0, -3.0, 2.0])

    summary = summarise(
        AnalysedRun.of(
            run, log_of([on_reference(run, 0), on_reference(run, 1, tilt), on_reference(run, 2)])
        )
    )
    assert summary["attitude_max_deg"] == pytest.approx(3.0, rel=ROUNDING)


def test_separation_is_the_closest_pair() -> None:
    """The UAVs of Table I hover 0.5 m apart; a single UAV has no separation."""
    run = runs.setup(HOVER)
    assert summarise(AnalysedRun.of(run, log_of([on_reference(run, 0)])))[
        "separation_min_m"
    ] == pytest.approx(0.5, rel=ROUNDING)
    single = runs.setup(HOVER, *runs.SINGLE_UAV)
    assert (
        summarise(AnalysedRun.of(single, log_of([on_reference(single, 0)])))["separation_min_m"]
        is None
    )


def test_violations_are_shares_of_the_range() -> None:
    """A violation is a share of the range between the two limits.

    Of a bound: excess / (upper - lower). Of a rate: excess / (2 x step). Of a distance: what it
    lacks / smallest distance.
    """
    run = runs.setup(HOVER)  # thrust in 0..45 N, 5 N per tick; at least 0.4 m

    def above(x: Array, u: Array) -> None:
        u[0] = 45.0 + 4.5

    def jump(x: Array, u: Array) -> None:
        u[0] += 5.0 + 2.0

    def close(x: Array, u: Array) -> None:
        # UAV1 (at y = +0.25 m) leans its rod towards UAV2 until 0.3 m are left.
        x[state.uav_slice(0)][state.E] = [0.0, 0.2 / 3.2, np.sqrt(1.0 - (0.2 / 3.2) ** 2)]

    def worst(*messages: Message) -> float:
        summary = summarise(AnalysedRun.of(run, log_of(messages)))
        value = summary["constraint_violation_max"]
        assert isinstance(value, float)
        return value

    def limit(*messages: Message) -> tuple[str, float] | None:
        summary = summarise(AnalysedRun.of(run, log_of(messages)))
        worst = summary["constraint_violation"]
        return None if worst is None else (worst["limit"], worst["at_s"])

    assert limit(on_reference(run, 0), on_reference(run, 2, above)) == ("inputs", 0.1)
    assert limit(on_reference(run, 0), on_reference(run, 1, jump)) == ("change of inputs", 0.05)
    assert limit(on_reference(run, 0), on_reference(run, 1, close)) == ("separation", 0.05)
    assert limit(on_reference(run, 0), on_reference(run, 1)) is None

    # After a gap in the record only the bound is judged.
    assert worst(on_reference(run, 0), on_reference(run, 2, above)) == pytest.approx(
        4.5 / 45.0, rel=ROUNDING
    )
    assert worst(on_reference(run, 0), on_reference(run, 1, jump)) == pytest.approx(
        2.0 / 10.0, rel=1e-9
    )
    assert worst(on_reference(run, 0, jump)) == pytest.approx(2.0 / 10.0, rel=1e-9)
    assert worst(on_reference(run, 2, jump)) == 0.0
    distance_m = series_of(run, log_of([on_reference(run, 0, close)])).separation_m[0]
    assert distance_m < 0.4
    assert worst(on_reference(run, 0, close)) == pytest.approx(
        (0.4 - distance_m) / 0.4, rel=ROUNDING
    )


def test_a_saturated_uav_is_named() -> None:
    """A limit that an input stays at holds: the summary says who was at it for which share of the ticks.

    Ticks with motors off do not count, changes across a gap in the record are at no limit.
    """
    run = runs.setup(HOVER, "faults.event=[{at_s=0.1,do='motor_off',target='uav2'}]")

    def saturated(x: Array, u: Array) -> None:
        u[8] = 45.0  # largest thrust of UAV3
        u[9] = -run.settings.limits.moments_Nm[0]

    def off(x: Array, u: Array) -> None:
        u[4:8] = 0.0  # UAV2

    ticks = [
        on_reference(run, 0),
        on_reference(run, 1, saturated),
        on_reference(run, 3, off),
        on_reference(run, 5, saturated),
    ]
    summary = summarise(AnalysedRun.of(run, log_of(ticks)))
    assert summary["limits_reached"] == [
        {"uav": 3, "limit": "largest thrust", "share": 0.5},
        {"uav": 3, "limit": "smallest roll moment", "share": 0.5},
        {"uav": 3, "limit": "change of thrust", "share": 0.25},
        {"uav": 3, "limit": "change of roll moment", "share": 0.25},
    ]
    assert "at the largest thrust UAV3 50% of the ticks" in limits_text(summary)
    assert summarise(AnalysedRun.of(run, log_of(ticks[:1])))["limits_reached"] == []


REALTIME = ("clock.mode=realtime", "clock.speed=1", "clock.actuation=next_tick")


def test_slack_cables_are_counted() -> None:
    """A cable slack for two periods, one slack at the end.

    Nothing without cables. The report says so.
    """
    run = runs.setup(HOVER)
    tensions = [
        [5.0, 4.0, 7.0, 7.0],
        [5.0, 0.0, 7.0, 7.0],
        [3.0, 0.0, 7.0, 7.0],
        [3.0, 2.0, 7.0, 0.0],
    ]
    messages: list[Message] = [on_reference(run, k) for k in range(4)]
    messages += [
        ActualInputs(
            sender="plant",
            incarnation=0,
            sequence=k,
            tick=k,
            uavs=runs.ALL,
            inputs=np.zeros((4, 4)),
            cables=runs.ALL,
            tensions=np.array(found),
        )
        for k, found in enumerate(tensions)
    ]
    summary = summarise(AnalysedRun.of(run, log_of(messages)))
    assert summary["cables"] == {
        "tension_min_N": 0.0, "slack": 2, "slack_longest_s": pytest.approx(0.1), "slack_at_end": 1
    }  # fmt: skip
    lines = [str(cell) for column in summary_table(summary).columns for cell in column.cells]
    assert "min tension 0.00 N, slack 2 times, at most 0.10 s, 1 slack at the end" in lines
    assert summarise(AnalysedRun.of(run, log_of([on_reference(run, 0)])))["cables"] is None


def test_deadlines_of_plans_by_hand() -> None:
    """Without `hold`, every member of a tick owes a plan until the next tick opens.

    Four members at ticks 0 and 1, two at 2 (tick 3 is the last recorded one, whose plans are not due), of
    which agent 3 misses ticks 0 and 1 and agent 4 misses 1: 3 of 10. Ticks opened 0, 2, 4, 8 ms late.
    """
    run = runs.setup(HOVER, *REALTIME)
    ticks = [
        runs.tick(0),
        replace(runs.tick(1, answered=(1, 2, 4)), late_ns=2_000_000),
        replace(
            runs.tick(2, answered=(1, 2), members=(1, 2)), late_ns=4_000_000, overrun_ns=7_500_000
        ),
        replace(runs.tick(3, answered=(1, 2), members=(1, 2)), late_ns=8_000_000),
    ]
    found = deadline(run, log_of(ticks))
    assert [found[name] for name in ("plans", "missed", "worst_ms")] == [10, 3, 7.5]
    assert found["share"] == pytest.approx(0.3)
    late_ms = found["tick_late_ms"]
    assert (late_ms["p50"], late_ms["max"]) == (3.0, 8.0)

    never_came = [replace(tick, overrun_ns=0) for tick in ticks]
    assert deadline(run, log_of(never_came))["worst_ms"] is None
    assert deadline(run, log_of(ticks[:1]))["share"] is None  # none was due
    found = deadline(run, log_of([runs.tick(0), runs.tick(1)]))
    assert (found["missed"], found["worst_ms"]) == (0, 0.0)
    with_gap = [tick for tick in ticks if tick.tick != 1]
    assert deadline(run, log_of(with_gap))["plans"] == 2  # those of tick 2


def test_plans_count_from_the_start_of_an_agent_in_real_time() -> None:
    """Two agents share a plan at ticks 0 to 3. Agent 2 joins at tick 2 and takes step 3.

    It can use the plans of agent 1 from ticks 2 and 3; agent 1, with steps 0, 1 and 3, those of agent 2 from
    all ticks: it skips step 2, but not its plans. Plans of a negotiation are no plans between agents. Replaced
    ones are not in transit. A restarted agent counts twice: in transit is at least 0.
    """
    run = runs.setup(HOVER, *REALTIME)
    steps = [report(run, 1, k, delivered=0) for k in (0, 1, 3)]
    steps.append(report(run, 2, 3, delivered=2))
    messages: list[Message] = [
        runs.roster({1: runs.INCARNATION}),
        runs.roster({1: runs.INCARNATION, 2: runs.INCARNATION}, k=2, version=2),
        *(runs.plan(run, agent, k) for agent in (1, 2) for k in range(4)),
        replace(runs.plan(run, 1, 3), negotiation=1),
    ]
    found = plans_between_agents(run, log_of(messages), steps, replaced=0)
    # Agent 2 receives 2, agent 1 receives 4.
    assert [found[name] for name in ("planned", "sent", "delivered", "in_transit")] == [8, 6, 2, 4]
    assert links_of_plant(log_of(messages), [])["commands"]["sent"] == 8
    assert plans_between_agents(run, log_of(messages), steps, replaced=3)["in_transit"] == 1

    twice = [report(run, 2, k, delivered=9) for k in (2, 3)]
    assert plans_between_agents(run, log_of(messages), twice, replaced=0)["in_transit"] == 0


@pytest.mark.parametrize(
    ("late_ms", "missed"),
    [((0, 0, 2900, 0), 1), ((0, 0, 0, 2900), 1), ((0, 2900, 0, 1e-6), 2), ((2900, 0, 0, 0), 0)],
)
def test_held_ticks_are_missed_deadlines(late_ms: tuple[float, ...], missed: int) -> None:
    """With `hold` every plan has arrived when a tick opens.

    The ticks that waited for one are counted, also the last; the first one waits for no plan.
    """
    run = runs.setup(HOVER, *REALTIME, "clock.on_overrun=hold")
    messages = [replace(runs.tick(k), overrun_ns=round(1e6 * ms)) for k, ms in enumerate(late_ms)]
    found = deadline(run, log_of(messages))
    assert [found[name] for name in ("plans", "missed", "worst_ms")] == [3, missed, 2900.0]
    assert found["share"] == pytest.approx(missed / 3)


def test_times_by_hand() -> None:
    """Wall time is from first tick to control.

    The rest of a tick is its length minus its slowest step, at least 0.
    """
    run = runs.setup(HOVER)
    slow = report(run, 2, 1, times_ms=np.array([2.0, 1.0, 1.0, 1.0, 1.0, 4.0, 0.5, 8.0]))
    messages = [
        runs.tick(0),
        report(run, 1, 0),
        runs.tick(1),
        report(run, 1, 1),
        slow,
        runs.tick(2),
        control(2),
    ]
    log = log_of(
        [*messages, on_reference(run, 0), on_reference(run, 1)],
        [10, 11, 14, 15, 16, 18, 60, 61, 62],
    )
    assert rest_of_tick_ms(run, log) == pytest.approx({0: 4.0 - 1.5, 1: 0.0})
    assert rest_of_tick_ms(run, log_of([runs.tick(0), runs.tick(1)])) == {}  # without a step
    summary = summarise(AnalysedRun.of(run, log))
    assert summary["rest_of_tick_ms"] == pytest.approx({"p50": 1.25, "p99": 2.475, "max": 2.5})
    assert summary["wall_time_s"] == pytest.approx(0.050)
    assert summary["startup_s"] == pytest.approx(0.010)
    assert summary["real_time_factor"] == pytest.approx(0.1 / 0.050)
    assert summary["agent_step_ms"]["max"] == 8.0
    assert summary["agent_step_ms"]["p50"] == 1.5
    assert summary["agent_step_ms"]["by_stage"]["solve"] == 0.5
    paced = runs.setup(HOVER, "clock.speed=1.0")
    assert summarise(AnalysedRun.of(paced, log))["rest_of_tick_ms"] == {
        "p50": None,
        "p99": None,
        "max": None,
    }


def test_an_empty_log_has_no_numbers() -> None:
    """Without any message every measured number is null and every count 0."""
    summary = summarise(AnalysedRun.of(runs.setup(HOVER), log_of([])))
    assert summary["outcome"] == "unknown"
    assert summary["ticks"] == 0
    for number in ("wall_time_s", "real_time_factor", "attitude_max_deg", "separation_min_m"):
        assert summary[number] is None
    for part in ("cost", "uav_tracking", "payload_tracking"):
        assert set(summary[part].values()) == {None}
    assert summary["messages"]["sent"] == 0


def test_plans_that_never_arrive_are_told() -> None:
    """Plans behind a delay longer than the run are neither lost nor late: the report says that they did not arrive."""
    settings = (runs.ticks(10), "links.delay_s=10.0")
    run = runs.setup(*settings)
    summary = summarise(AnalysedRun.of(run, log_of(runs.recorded(run))))
    messages = summary["messages"]
    assert (messages["sent"], messages["lost"], messages["late"]) == (9 * 12, 0, 0)
    assert messages["in_transit"] == 9 * 12
    cells = [str(cell) for column in summary_table(summary).columns for cell in column.cells]
    assert any("0 of 108 lost, 108 not arrived at the end, 0 late" in cell for cell in cells)


def test_losses_from_and_to_the_plant_are_counted() -> None:
    """Each link of the plant loses the messages of the ticks at which it is cut, and the report says so.

    Cut are from 0.1 to 0.3 s, four ticks, all links of the plant with agents 1 and 2.
    """
    cut = "links.partition=[{between=['plant','agent3','agent4'],start_s=0.1,end_s=0.3}]"
    settings = (runs.ticks(10), cut)
    run = runs.setup(*settings)
    summary = summarise(AnalysedRun.of(run, log_of(runs.recorded(run))))
    messages = summary["messages"]
    assert messages["measurements"] == {"sent": 40, "lost": 4 * 2}
    assert messages["commands"] == {"sent": 40, "lost": 4 * 2}
    text = "measurements 8 of 40 lost; commands 8 of 40 lost"
    assert plans_text(messages, summary["plan_age_ticks"]).endswith(text)

    perfect = runs.setup(runs.ticks(10))
    summary = summarise(AnalysedRun.of(perfect, log_of(runs.recorded(perfect))))
    assert summary["messages"]["measurements"] == {"sent": 40, "lost": 0}
    assert plans_text(summary["messages"], summary["plan_age_ticks"]).endswith("max 1")


def test_failed_steps_are_counted_by_agent() -> None:
    """Fallbacks and failures of all, and the agents with some; a share that is allowed is not beyond it."""
    run = runs.setup(HOVER, "agents.failed_share=0.25")
    reports = [report(run, agent, k, fallback=k == 1) for agent in (1, 2) for k in range(4)]
    failed = [*reports[:-1], replace(reports[-1], status="infeasible")]
    solver = summarise(AnalysedRun.of(run, log_of(failed)))["solver"]
    assert solver == {
        "fallbacks": 2,
        "failures": 1,
        "failed_agents": [{"agent": 2, "steps": 4, "failures": 1}],
        "beyond_share": False,
    }
    failed[4] = replace(failed[4], status="infeasible")
    assert summarise(AnalysedRun.of(run, log_of(failed)))["solver"]["beyond_share"]


def test_rejections_are_added_up_and_the_most_come_first() -> None:
    """By receiver, sender and reason."""
    told = (
        *(("agent1", "agent2", 2), ("plant", "agent3", 4)),
        *(("agent1", "agent4", 4), ("agent1", "agent2", 3)),
    )
    notices = [
        Rejected(
            sender=receiver,
            incarnation=0,
            sequence=number,
            tick=0,
            offender=sender,
            reason="malformed",
            count=count,
            example="",
        )
        for number, (receiver, sender, count) in enumerate(told)
    ]
    found = summarise(AnalysedRun.of(runs.setup(HOVER), log_of(notices)))["rejections"]
    assert found == [
        {"by": "agent1", "sender": "agent2", "reason": "malformed", "count": 5},
        # Of equal counts by receiver and sender.
        {"by": "agent1", "sender": "agent4", "reason": "malformed", "count": 4},
        {"by": "plant", "sender": "agent3", "reason": "malformed", "count": 4},
    ]


def test_plans_of_agents_that_are_gone_have_no_age() -> None:
    """After the death of an agent its last plan is not in use: on a perfect network plans stay one tick old."""
    death = (
        "clock.on_agent_loss=continue",
        "faults.event=[{at_s=0.2,do='kill',target='agent3'}]",
    )
    run = runs.setup(runs.ticks(20), *death)
    summary = summarise(AnalysedRun.of(run, log_of(runs.recorded(run))))
    assert summary["plan_age_ticks"] == {"mean": 1.0, "max": 1}


def test_one_row_for_each_agent_and_tick() -> None:
    """Rows are sorted by tick and agent.

    Inputs appear in the columns of the UAVs the agent owns, else nothing.
    """
    run = runs.setup(HOVER, "agents.owned=[[1,3],[2,4]]")

    def change(x: Array, u: Array) -> None:
        u[:] = np.arange(16.0)
        x[state.uav_slice(2)][state.E] = [0.0, 0.6, 0.8]  # of UAV3, in place of [0, 0, 1]

    pulled = report(run, 2, 1, plan_ages=(3,), force=np.array([0.5, -1.0, 4.4]))
    messages = [pulled, report(run, 1, 1), report(run, 1, 0), on_reference(run, 1, change)]
    rows = list(steps_rows(AnalysedRun.of(run, log_of(messages))))
    assert [(row["tick"], row["agent"]) for row in rows] == [(0, 1), (1, 1), (1, 2)]
    assert [list(row) for row in rows] == [steps_columns(run)] * 3
    assert (rows[0]["plan_age_max"], rows[1]["plan_age_max"], rows[2]["plan_age_max"]) == (-1, 1, 3)
    assert rows[0]["cost"] is None  # the log has no plant state of tick 0
    first, second = rows[1], rows[2]
    assert (first["thrust1_N"], first["moment3_z_Nm"], first["thrust2_N"]) == (0.0, 11.0, None)
    assert (second["thrust2_N"], second["moment4_z_Nm"], second["thrust3_N"]) == (4.0, 15.0, None)
    assert first["cost"] == second["cost"] > 0.0
    # The largest of UAV1, on its reference, and UAV3, with its rod of 3.2 m.
    assert first["uav_error_max_m"] == pytest.approx(3.2 * np.hypot(0.6, 0.2), rel=ROUNDING)
    assert second["uav_error_max_m"] == pytest.approx(0.0, abs=ROUNDING)
    assert [second[f"force_{axis}_N"] for axis in "xyz"] == [0.5, -1.0, 4.4]
    assert [first[f"force_{axis}_N"] for axis in "xyz"] == [0.0, 0.0, 0.0]


def test_scripted_changes_of_links_are_events_as_far_as_the_run_came() -> None:
    """A change at the last tick and the begin of a partition are told, its end after that is not."""
    run = runs.setup(
        runs.SHORT,
        "links.change=[{at_s=0.45,from='agent2',loss=1.0}]",
        "links.partition=[{between=['agent1','agent2'],start_s=0.12,end_s=0.9}]",
    )
    log = log_of([on_reference(run, k) for k in range(10)])
    events = summarise(AnalysedRun.of(run, log))["faults"]
    assert [(event["time_s"], event["kind"], event["what"]) for event in events] == [
        (0.15, "notice", "agent1, agent2 cut off by script"),
        (0.45, "notice", "links from agent2: loss 1.0 by script"),
    ]


def test_changes_of_the_roster_are_events() -> None:
    """Who has left or is back, UAVs that are off by script, once each, and the end with its reason; by wall time, too.

    A roster with the same agents is a notice, and the first one no event.
    """
    run = runs.setup(runs.SHORT)
    three = dict.fromkeys((1, 2, 4), runs.INCARNATION)
    all_four = {**three, 3: 2}
    rosters = [
        runs.roster(),
        replace(runs.roster(three, k=4, version=2), reason="agent3 is gone"),
        replace(runs.roster(all_four, k=6, version=3), reason="agent3 is back"),
        replace(runs.roster(all_four, k=7, version=4), reason="uav2 off", off=(2,)),
        replace(runs.roster(all_four, k=8, version=5), reason="uav2 free", off=(2,), released=(2,)),
        replace(runs.roster(all_four, k=9, version=6), reason="other", off=(2,), released=(2,)),
    ]
    messages = [runs.tick(0), runs.tick(1), *rosters, control(9, "aborted", "stopped by hand")]
    times_ms = [1000.0 * number for number in range(len(messages))]
    events = summarise(AnalysedRun.of(run, log_of(messages, times_ms)))["faults"]
    assert [tuple(event.values()) for event in events] == [
        (4, 0.2, 3.0, "detected", ["agent3"], "agent3 is gone"),
        (6, 0.3, 4.0, "rejoined", ["agent3"], "agent3 is back"),
        (7, 0.35, 5.0, "fault", ["uav2"], "uav2 off by script"),
        (8, 0.4, 6.0, "fault", ["uav2"], "uav2 free by script"),
        (9, 0.45, 7.0, "notice", [], "other"),
        (9, 0.45, 8.0, "end", [], "stopped by hand"),
    ]


def test_faults_are_told_in_the_words_of_their_kind() -> None:
    """Those of the plant at their ticks, with their numbers; those of processes by their notes, with the origin.

    Sensors that measure again are told as well.
    """
    run = runs.setup(
        *(runs.SHORT, *runs.VEHICLE),
        "faults.event=[{at_s=0.1,do='degrade',target='uav2',efficiency=0.8},"
        "{at_s=0.2,do='sensors_off',target='uav3',sensors=['position','velocity'],duration_s=0.1},"
        "{at_s=0.25,do='load',target='payload',mass_kg=2.5},"
        "{at_s=0.35,do='load',target='payload',mass_kg=2.0,duration_s=0.1}]",
    )
    origins: tuple[FaultOrigin, ...] = ("script", "person", "unknown")
    notes = [
        FaultNote(
            sender="recorder", incarnation=0, sequence=k, tick=k, target=f"agent{k}", what="killed",
            origin=origin,
        )
        for k, origin in enumerate(origins, start=1)
    ]  # fmt: skip
    log = log_of([*(on_reference(run, k) for k in range(12)), *notes])
    told = events(run, log, None)
    assert {event["kind"] for event in told} == {"fault"}
    assert [(event["tick"], event["processes"], event["what"]) for event in told] == [
        (1, ["agent1"], "agent1 killed by script"),
        (2, ["uav2"], "motors of uav2 degraded to 0.8 of their inputs by script"),
        (2, ["agent2"], "agent2 killed by hand"),
        (3, ["agent3"], "agent3 killed"),
        (4, ["uav3"], "uav3 without position, velocity by script"),
        (5, ["payload"], "payload changes: 2.5 kg by script"),
        (6, ["uav3"], "uav3 has position, velocity again by script"),
        (7, ["payload"], "payload changes gradually: 2 kg by script"),
    ]


def test_problems_of_a_kind_are_one_event_of_all_agents_that_have_it() -> None:
    """A kind of a class is its exception at one line, or its text but for numbers; of the project the text itself."""
    run = runs.setup(runs.SHORT)
    at_3 = "controller mine:Mine: step raised ValueError: got 3 (mine.py:12)"
    at_4 = "controller mine:Mine: step raised ValueError: got 4 (mine.py:12)"
    below = "controller mine:Mine: step raised ValueError: got 4 (mine.py:13)"
    slow, slower = (f"controller mine:Mine: step took {taken_s} s" for taken_s in (0.2, 0.3))
    reported = [
        *((2, at_3), (1, at_4), (1, below), (3, slow), (1, slower)),
        *((3, "plan 1 is late"), (3, "plan 2 is late"), (4, "")),
    ]
    notes = [
        replace(estimate_note(run, agent, k), problem=problem)
        for k, (agent, problem) in enumerate(reported)
    ]
    told = events(run, log_of(notes), control(9))
    assert {event["kind"] for event in told} == {"notice"}
    assert [(event["tick"], event["processes"], event["what"]) for event in told] == [
        (0, ["agent1", "agent2"], f"agent1, agent2: {at_3} (and 1 like it)"),
        (2, ["agent1"], f"agent1: {below}"),
        (3, ["agent1", "agent3"], f"agent1, agent3: {slow} (and 1 like it)"),
        (5, ["agent3"], "agent3: plan 1 is late"),
        (6, ["agent3"], "agent3: plan 2 is late"),
    ]


def test_a_roster_names_uavs_that_are_off_from_the_beginning_and_departures_before_joins() -> None:
    """They are a fault of the first roster, and no fault of the next; who departs is told, not who joins instead."""
    run = runs.setup(runs.SHORT)
    rosters = [
        replace(runs.roster(dict.fromkeys((1, 2, 4), 1)), reason="uav3 off", off=(3,)),
        replace(runs.roster(dict.fromkeys((1, 2, 3), 1), k=1, version=2), reason="new", off=(3,)),
    ]
    told = events(run, log_of(rosters), None)
    assert [(event["kind"], event["processes"], event["what"]) for event in told] == [
        ("fault", ["uav3"], "uav3 off by script"),
        ("detected", ["agent4"], "new"),
    ]


def test_the_header_tells_what_ran() -> None:
    """Processes, versions by name, controller and engine of the log; without them those that are known."""
    run = runs.setup(
        *(HOVER, "agents.owned=[[1,3],[2,4]]", "controller.horizon=7"),
        *("controller.negotiation_iterations=2", "controller.relaxation=0.5"),
        *("controller.solver=clarabel", "controller.prediction=closed_loop", "seed=4"),
    )
    told = {
        "run_id": "r7", "processes": "6", "versions": "python 3.12.1, libc of x 2.3, unknown",
        "controller": "mine:Mine 1", "engine": "mujoco 3", "machine": "a machine",
    }  # fmt: skip
    log = dataclasses.replace(log_of([]), header=told)
    summary = summarise(AnalysedRun.of(run, log))
    assert {key: summary[key] for key in ("run_id", "processes", "engine", "machine", "seed")} == {
        "run_id": "r7", "processes": 6, "engine": "mujoco 3", "machine": "a machine", "seed": 4,
    }  # fmt: skip
    assert summary["versions"] == {"python": "3.12.1", "libc of x": "2.3"}
    assert summary["controller"] == {
        "name": "mine:Mine 1", "agents": 2, "owned": [[1, 3], [2, 4]], "prediction": "closed_loop",
        "relaxation": 0.5, "negotiation_iterations": 2, "sampling_period_s": 0.05, "horizon": 7,
        "solver": "clarabel",
    }  # fmt: skip

    nothing = summarise(AnalysedRun.of(run, dataclasses.replace(log, header={})))
    unknown = [nothing[key] for key in ("processes", "versions", "engine", "startup_s")]
    assert unknown == [None, {}, run.scenario.plant.engine, None]
    assert nothing["controller"]["name"] == "mpc"


def test_a_log_without_the_end_lasts_until_its_last_message() -> None:
    """From the first tick on, in the order in which messages were received."""
    run = runs.setup(HOVER)
    log = log_of([runs.roster(), runs.tick(0), runs.tick(1), on_reference(run, 0)], [5, 10, 14, 30])
    summary = summarise(AnalysedRun.of(run, log))
    assert (summary["outcome"], summary["exit_code"]) == ("unknown", None)
    assert summary["wall_time_s"] == pytest.approx(0.020)


def test_plans_that_are_late_and_messages_that_are_rejected_are_counted() -> None:
    """Each by its own number; in real time an agent on no roster can use plans from its first step on."""
    run = runs.setup(HOVER, *REALTIME)
    refused = Rejected(
        sender="agent1", incarnation=0, sequence=0, tick=0, offender="agent2", reason="malformed",
        count=7, example="",
    )  # fmt: skip
    plans = [runs.plan(run, 1, k) for k in range(4)]
    unshared = runs.plan(run, 1, 3, shared=False)
    steps = [report(run, 2, k, delivered=1, lost=2, late=4) for k in (2, 3)]
    found = plans_between_agents(run, log_of([*plans, unshared, refused]), steps, replaced=0)
    assert found == {
        "planned": 5, "shared": 4, "sent": 2, "delivered": 2, "lost": 4, "in_transit": 0, "late": 8,
        "rejected": 7,
    }  # fmt: skip


def test_the_error_of_an_agent_is_that_of_its_uavs_on_their_rods() -> None:
    """One of two that has been released leaves that of the other; both released leave none."""
    release = ",".join(
        f"{{at_s={at_s},do='release',target='uav{uav}'}}" for uav, at_s in ((3, 0.1), (1, 0.2))
    )
    run = runs.setup(HOVER, "agents.owned=[[1,3],[2,4]]", f"faults.event=[{release}]")

    def away(x: Array, u: Array) -> None:
        x[state.R0][0] += 0.25

    series = series_of(run, log_of([on_reference(run, k, away) for k in (0, 3, 5)]))
    assert series.uav_error_max_m(run.owned) == pytest.approx(
        np.array([[0.25, 0.25], [0.25, 0.25], [np.nan, 0.25]]), nan_ok=True
    )
