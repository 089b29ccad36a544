"""Sections of docs/results.md: one experiment each, with the columns of its tables."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

Row = Mapping[str, str]

# Columns of a table: heading, and field of a row or function of it.
Columns = Mapping[str, str | Callable[[Row], str]]


def number(name: str, factor: float = 1.0, digits: int = 2) -> Callable[[Row], str]:
    """Return a cell with a number of a row, ± half its confidence interval if it has one."""

    def cell(row: Row) -> str:
        if not row[name]:
            return ""
        text = f"{factor * float(row[name]):.{digits}f}"
        interval = row.get(f"{name}_ci95", "")
        return f"{text} ± {factor * float(interval):.{digits}f}" if interval else text

    return cell


def mean(name: str, factor: float = 1.0, digits: int = 2) -> Callable[[Row], str]:
    """Return a cell with a number of a row alone."""
    return lambda row: number(name, factor, digits)(row).partition(" ")[0]


def share(name: str) -> Callable[[Row], str]:
    """Return a cell with a share as a percentage."""
    return lambda row: f"{100.0 * float(row[name]):g} %"


def milliseconds(name: str) -> Callable[[Row], str]:
    """Return a cell with a time in s as ms."""
    return lambda row: f"{1e3 * float(row[name]):g}"


def done(row: Row) -> str:
    """Return the number of completed runs and the first time of divergence."""
    lost = f", diverged at {float(row['first_lost_s']):.1f} s" if row["first_lost_s"] else ""
    return f"{row['completed']} of {row['flights']}{lost}"


def spread(name: str, digits: int = 2) -> Callable[[Row], str]:
    """Return a cell with median, smallest and largest of repetitions."""
    return lambda row: (
        f"{float(row[name]):.{digits}f} ({float(row[f'{name}_min']):.{digits}f} to "
        f"{float(row[f'{name}_max']):.{digits}f})"
    )


def periods(row: Row) -> str:
    """Return the sampling periods of equal computation, ms; an end beyond the grid is left open."""
    low, high = (f"{1e3 * float(row[name]):.3g}" if row[name] else "" for name in ("period_low_s", "period_high_s"))
    if low == high:
        return low or "none of the grid"
    return f"{low} to {high}" if low and high else f"from {low}" if low else f"up to {high}"


def cost_range(row: Row) -> str:
    """Return the range of cost ratios at these periods."""
    if not row["cost_ratio_low"]:
        return ""
    ratios = [float(row[name]) for name in ("cost_ratio_low", "cost_ratio_high")]
    low, high = (f"{ratio:.2f}" if math.isfinite(ratio) else "diverged" for ratio in ratios)
    return low if low == high else f"{low} to {high}"


def compared_at(row: Row) -> str:
    """Return what both controllers of a comparison have in common."""
    if row["budget"] == "same rate":
        return "the same rate"
    whose = "the whole team" if row["budget"] == "whole team" else row["budget"]
    return f"the same computation of {whose}, as many {row['kept']} of horizon"


OUTCOME: Columns = {
    "completed": done,
    "cost over unimpaired": number("cost_ratio"),
    "cost, 1e-3": number("cost_mean", 1e3),
    "attitude, deg": number("attitude_max_deg"),
    "swing, m": number("swing_m"),
}

COMPARED: Columns = {
    "weather": "weather",
    "controller": "controller",
    "horizon kept": "kept",
    "T_s, ms": milliseconds("period_s"),
    "N_p": "horizon",
    "completed": done,
    "cost, 1e-3": mean("cost_mean", 1e3, 3),
    "over centralized": number("cost_mean_ratio", digits=3),
    "peak over centralized": number("cost_max_ratio", digits=3),
    "attitude, deg": mean("attitude_max_deg"),
    "swing, m": mean("swing_m"),
    "CPU of a step, ms": spread("cpu_step_ms"),
    "of an agent, s/s": spread("cpu_agent_s_per_s", digits=3),
    "of the team, s/s": spread("cpu_team_s_per_s", digits=3),
}

VERDICT: Columns = {
    "weather": "weather",
    "controller": "controller",
    "compared at": compared_at,
    "T_s, ms": periods,
    "cost over centralized": cost_range,
    "verdict": "verdict",
}

GROWTH: Columns = {
    "UAVs": "uavs",
    "agents": "ownership",
    "CPU of a step, ms": number("cpu_step_p50_ms"),
    "99th percentile": mean("cpu_step_p99_ms"),
    "team per tick, ms": number("cpu_team_tick_ms", digits=1),
    "plans, kB/s": mean("plan_bytes_per_s", 1e-3, 0),
    "cost, 1e-3": mean("cost_mean", 1e3),
    "over centralized": number("cost_ratio"),
    "swing, m": mean("swing_m"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One experiment on the page.

    Attributes:
        name: Name of the command.
        title: Heading.
        text: Question and method.
        columns: Columns of the table.
        table: Result file of the table.
        figure: Result file of the figure.
        alt: Description of the figure for readers who cannot see it.
        before: An additional table ahead of the other: result file and columns.
        second: A second figure: result file, name in docs/images, description.
        arguments: Further arguments of the command.
    """

    name: str
    title: str
    text: str
    columns: Columns
    table: str = "points.csv"
    figure: str = "figure.png"
    alt: str
    before: tuple[str, Columns] | None = None
    second: tuple[str, str, str] | None = None
    arguments: tuple[str, ...] = ()


SCENARIO: Columns = {"scenario": "scenario"}

HOVER_TITLE = "Is a long hover stable?"

SECTIONS = (
    Section(
        name="paper",
        title="Is distributed worse at the same rate, and better at the same computation?",
        text="The paper's comparison over a grid of sampling periods. `paper's algorithm` is its distributed "
        "algorithm with our weights, since the paper gives none; `closed loop` is that of `resilient`. Costs are "
        "deterministic. Processor time is that of the whole step, measured in turns. The range of its repetitions "
        "gives a range of periods at which a controller computes as much per second as the centralized one at 50 ms, "
        "and the cost curve gives a range of cost ratios. `the whole team` counts all agents together, `one agent` "
        "each agent separately. At another rate a horizon of as many steps is longer or shorter in time, so horizons "
        "of as many seconds are also run. In the figure hollow markers are periods with a diverged run, "
        "arrows are costs above the axis.",
        columns=COMPARED,
        table="curves.csv",
        before=("verdict.csv", VERDICT),
        alt="Mean cost over that of the centralized controller at 50 ms, over processor time of the team and of one "
        "agent, in still air and in gusts: a curve for each controller and horizon; periods with a diverged run",
        second=(
            "maneuver.png",
            "maneuver.png",
            "Largest UAV position error, payload position error, payload attitude and cost over time: the centralized "
            "controller, and the paper's algorithm at the same rate and at the same computation",
        ),
    ),
    Section(
        name="latency",
        title="How much delay is tolerated?",
        text="The same delay for every plan. A plan is used at the next tick at the earliest, so 50 ms change nothing.",
        columns={**SCENARIO, "delay, ms": milliseconds("delay_s"), **OUTCOME},
        alt="Time of divergence, mean cost and payload attitude over the delay of plans",
    ),
    Section(
        name="loss",
        title="How much packet loss is tolerated?",
        text="Independent losses, and the same share of losses in bursts of five ticks on average (Gilbert-Elliott).",
        columns={**SCENARIO, "losses": "model", "lost": share("loss"), **OUTCOME},
        alt="Time of divergence, mean cost and payload attitude over the share of lost plans",
    ),
    Section(
        name="jitter",
        title="How much jitter is tolerated?",
        text="Random delays with a mean of 160 ms from four distributions.",
        columns={
            **SCENARIO,
            "distribution": "distribution",
            "mean, ms": milliseconds("mean_s"),
            "std, ms": milliseconds("std_s"),
            **OUTCOME,
        },
        alt="Time of divergence, mean cost and payload attitude over the standard deviation of the delay",
    ),
    Section(
        name="matrix",
        title="Delay and packet loss together",
        text="Every delay with every share of losses.",
        columns={**SCENARIO, "delay, ms": milliseconds("delay_s"), "lost": share("loss"), **OUTCOME},
        alt="Maps of mean cost, or time of divergence, over delay and loss, one for each scenario",
    ),
    Section(
        name="kill",
        title="An agent killed, restarted or not",
        text="Each agent is killed at 8 s, and restarted at 10 s or never.",
        columns={**SCENARIO, "killed": "agent", "back at, s": "restart_s", **OUTCOME},
        alt="Time of divergence, mean cost and payload attitude for each agent killed, restarted or not",
    ),
    Section(
        name="deaths",
        title="An agent killed without a restart, at any time",
        text="In each run a random agent is killed at a random time and never restarted. Its UAVs apply the last plan "
        "and then hold hover thrust and level attitude.",
        columns={**SCENARIO, "killed": "agent", "at, s": "killed_s", **OUTCOME},
        alt="Mean cost and payload attitude over the time at which the agent is killed, beside those without a kill",
    ),
    Section(
        name="sharing",
        title="How few plans have to be sent?",
        text="A plan is sent to the other agents when its corrections to the shared control law change by more than a "
        "threshold, a share of the input's range, and at least once a second. With threshold 0 all plans are sent; "
        "the costs on each network are relative to that row.",
        columns={
            **SCENARIO,
            "network": "network",
            "threshold": "share_threshold",
            "plans sent, %": number("plans_shared_share", 100.0, 1),
            "completed": done,
            "cost over all sent": number("cost_ratio", digits=3),
            "cost, 1e-3": number("cost_mean", 1e3),
            "attitude, deg": number("attitude_max_deg"),
            "swing, m": number("swing_m"),
        },
        alt="Plans sent, mean cost over that with all plans sent, and payload attitude, over the threshold",
    ),
    Section(
        name="ablation",
        title="Contribution of each part",
        text="One setting is changed at a time, on a perfect network and on one with 200 ms delay and 30 % loss.",
        columns={
            **SCENARIO,
            "network": "network",
            "changed": "part",
            "to": lambda row: f"`{row['value']}`" if row["value"] else "",
            **OUTCOME,
        },
        alt="Cost of every variant over that of the scenario as it is, on both networks; diverged runs beside it",
    ),
    Section(
        name="horizon",
        title="Effect of horizon and terminal weight",
        text="The paper's N_p = 20 is a choice, and the paper gives no terminal weight. Each horizon is run with each "
        "weight, or with the cost-to-go of the scenario, on a perfect network and with a delay of 200 ms.",
        columns={
            **SCENARIO,
            "network": "network",
            "N_p": "horizon",
            "terminal weight": lambda row: row["terminal"].removesuffix(".0"),
            **OUTCOME,
        },
        alt="Cost of every horizon and terminal weight over that of the scenario as it is, without and with delay; "
        "diverged runs beside it",
    ),
    Section(
        name="hover",
        title=HOVER_TITLE,
        text="The paper's maneuver with hovers of increasing duration as its last phase, on a perfect network. Costs "
        "are means over runs of different length: compare them between controllers.",
        columns={
            **SCENARIO,
            "last hover, s": lambda row: f"{float(row['hover_s']):g}",
            **{heading: cell for heading, cell in OUTCOME.items() if heading != "cost over unimpaired"},
        },
        alt="Time of divergence, mean cost and payload attitude over the duration of the last hover",
    ),
    Section(
        name="scaling",
        title="Growth with the team",
        text="Teams of 2 to 12 UAVs over 10 s, with an agent for each UAV, for two, and for all. "
        "[performance.md](performance.md) explains the numbers.",
        columns=GROWTH,
        alt="Processor time of a step and of the team, volume of the plans and mean cost over the number of UAVs, with "
        "powers of that number for comparison",
        arguments=("--max", "12", "--seeds", "3"),
    ),
)
