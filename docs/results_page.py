"""Make every figure and table of results in README and docs: `make figures`.

Flies what is missing, keeps it in runs/figures/ (delete a folder there to measure anew), and writes docs/results.md,
docs/images/ and what the README says of them. Some forty minutes on two cores from nothing.
"""

import csv
import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tables import ROOT, commit, put, table

RUNS, IMAGES = ROOT / "runs" / "figures", ROOT / "docs" / "images"
PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"

Row = Mapping[str, str]

# Columns of a table: heading, and what stands below it.
Columns = Mapping[str, Callable[[Row], str]]


def number(name: str, factor: float = 1.0, digits: int = 2) -> Callable[[Row], str]:
    """A number of a row, with half its confidence interval where there is one."""

    def cell(row: Row) -> str:
        if not row[name]:
            return ""
        text = f"{factor * float(row[name]):.{digits}f}"
        interval = row.get(f"{name}_ci95", "")
        return f"{text} ± {factor * float(interval):.{digits}f}" if interval else text

    return cell


def plain(name: str) -> Callable[[Row], str]:
    """A word or number as it is."""
    return lambda row: row[name]


def share(name: str) -> Callable[[Row], str]:
    """A share as a percentage."""
    return lambda row: f"{100.0 * float(row[name]):g} %"


def milliseconds(name: str) -> Callable[[Row], str]:
    """A time in s as ms."""
    return lambda row: f"{1e3 * float(row[name]):g}"


def done(row: Row) -> str:
    """How many flights came to their end, and when the first of the others did not."""
    lost = f", diverged at {float(row['first_lost_s']):.1f} s" if row["first_lost_s"] else ""
    return f"{row['completed']} of {row['flights']}{lost}"


def spread(name: str, digits: int = 2) -> Callable[[Row], str]:
    """The median of repetitions, with the smallest and the largest."""
    return lambda row: (
        f"{float(row[name]):.{digits}f} ({float(row[f'{name}_min']):.{digits}f} to "
        f"{float(row[f'{name}_max']):.{digits}f})"
    )


def periods(row: Row) -> str:
    """The sampling periods of equal computation, ms; an end beyond those measured is left open."""
    low, high = (f"{1e3 * float(row[name]):.3g}" if row[name] else "" for name in ("period_low_s", "period_high_s"))
    if low == high:
        return low or "none of the grid"
    return f"{low} to {high}" if low and high else f"from {low}" if low else f"up to {high}"


def cost_range(row: Row) -> str:
    """The range of cost ratios at these periods."""
    if not row["cost_ratio_low"]:
        return ""
    ratios = [float(row[name]) for name in ("cost_ratio_low", "cost_ratio_high")]
    low, high = (f"{ratio:.2f}" if math.isfinite(ratio) else "diverged" for ratio in ratios)
    return low if low == high else f"{low} to {high}"


# Rows of the paper's comparison: what both controllers have in common, and what the horizon keeps.
COMPARED_AT = {
    ("same rate", "steps"): "the same rate",
    ("same rate", "seconds"): "the same rate",
    ("whole team", "steps"): "the same computation of the whole team, as many steps of horizon",
    ("whole team", "seconds"): "the same computation of the whole team, as many seconds of horizon",
    ("one agent", "steps"): "the same computation of one agent, as many steps of horizon",
    ("one agent", "seconds"): "the same computation of one agent, as many seconds of horizon",
}

OUTCOME: Columns = {
    "completed": done,
    "cost over unimpaired": number("cost_ratio"),
    "cost, 1e-3": number("cost_mean", 1e3),
    "attitude, deg": number("attitude_max_deg"),
    "swing, m": number("swing_m"),
}

COMPARED: Columns = {
    "weather": plain("weather"),
    "controller": plain("controller"),
    "horizon kept": plain("kept"),
    "T_s, ms": milliseconds("period_s"),
    "N_p": plain("horizon"),
    "completed": done,
    "cost, 1e-3": lambda row: number("cost_mean", 1e3, 3)(row).partition(" ")[0],
    "over centralized": number("cost_mean_ratio", digits=3),
    "peak over centralized": number("cost_max_ratio", digits=3),
    "attitude, deg": lambda row: number("attitude_max_deg")(row).partition(" ")[0],
    "swing, m": lambda row: number("swing_m")(row).partition(" ")[0],
    "CPU of a step, ms": spread("cpu_step_ms"),
    "of an agent, s/s": spread("cpu_agent_s_per_s", digits=3),
    "of the team, s/s": spread("cpu_team_s_per_s", digits=3),
}

VERDICT: Columns = {
    "weather": plain("weather"),
    "controller": plain("controller"),
    "compared at": lambda row: COMPARED_AT[row["budget"], row["kept"]],
    "T_s, ms": periods,
    "cost over centralized": cost_range,
    "verdict": plain("verdict"),
}

GROWTH: Columns = {
    "UAVs": plain("uavs"),
    "agents": plain("ownership"),
    "CPU of a step, ms": number("cpu_step_p50_ms"),
    "99th percentile": lambda row: number("cpu_step_p99_ms")(row).partition(" ")[0],
    "team per tick, ms": number("cpu_team_tick_ms", digits=1),
    "plans, kB/s": lambda row: number("plan_bytes_per_s", 1e-3, 0)(row).partition(" ")[0],
    "cost, 1e-3": lambda row: number("cost_mean", 1e3)(row).partition(" ")[0],
    "over centralized": number("cost_ratio"),
    "swing, m": lambda row: number("swing_m")(row).partition(" ")[0],
}


# What happens to the network in the README's moving picture.
MOVING = (
    "links.delay_s=0.1",
    "links.loss=0.1",
    "links.change=[{at_s=8.0,from='agent2',loss=1.0},{at_s=15.0,from='agent2',loss=0.0}]",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One experiment on the page.

    Attributes:
        name: Of the command.
        title: Heading.
        text: What is asked.
        columns: Of the table.
        table: File it is made of.
        figure: File that is shown.
        alt: What the figure shows, for those who cannot see it.
        before: A table ahead of the other, its file and columns.
        second: A second figure: its file, its name in docs/images, and what it shows.
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


SCENARIO: Columns = {"scenario": plain("scenario")}

HOVER_TITLE = "Is a long hover stable?"

SECTIONS = (
    Section(
        name="paper",
        title="Is distributed worse at the same rate, and better at the same computation?",
        text="The paper's comparison over a grid of sampling periods. `paper's algorithm` is its distributed algorithm "
        "with our weights, as it prints none; `closed loop` is that of `resilient`. Costs are deterministic. Processor "
        "time is that of the whole step, measured in turns, and has a spread: the range of its repetitions gives a "
        "range of periods at which a controller computes as much per second as the centralized one at 50 ms, and by "
        "the cost curve a range of cost ratios. `the whole team` counts all agents together, `one agent` each for "
        "itself. At another rate a horizon of as many steps is longer or shorter in time, so horizons of as many "
        "seconds are run, too. In the figure vertical lines are the computation of the "
        "centralized controller at 50 ms, crosses are periods with a diverged run, arrows costs above the axis.",
        columns=COMPARED,
        table="curves.csv",
        before=("verdict.csv", VERDICT),
        alt="Mean cost over processor time of the whole team and of one agent, a curve for each controller and horizon",
        second=(
            "maneuver.png",
            "maneuver.png",
            "Position errors, payload attitude and cost of the centralized controller, and of the paper's algorithm at "
            "the same rate and at the same computation",
        ),
    ),
    Section(
        name="latency",
        title="How much delay is tolerated?",
        text="The same delay for every plan. A plan is used at the next tick at the earliest, so 50 ms change nothing.",
        columns={**SCENARIO, "delay, ms": milliseconds("delay_s"), **OUTCOME},
        alt="Survival, mean cost and payload attitude over the delay of plans",
    ),
    Section(
        name="loss",
        title="How much packet loss is tolerated?",
        text="Independent losses, and the same share of losses in bursts of five ticks on average (Gilbert-Elliott).",
        columns={**SCENARIO, "losses": plain("model"), "lost": share("loss"), **OUTCOME},
        alt="Survival, mean cost and payload attitude over the share of lost plans",
    ),
    Section(
        name="jitter",
        title="How much jitter is tolerated?",
        text="Random delays with a mean of 160 ms from four distributions.",
        columns={
            **SCENARIO,
            "distribution": plain("distribution"),
            "mean, ms": milliseconds("mean_s"),
            "std, ms": milliseconds("std_s"),
            **OUTCOME,
        },
        alt="Survival, mean cost and payload attitude over the standard deviation of the delay",
    ),
    Section(
        name="matrix",
        title="Delay and packet loss together",
        text="Every delay with every share of losses.",
        columns={**SCENARIO, "delay, ms": milliseconds("delay_s"), "lost": share("loss"), **OUTCOME},
        alt="Maps of mean cost and survival over delay and loss",
    ),
    Section(
        name="kill",
        title="An agent killed, restarted or not",
        text="Each agent killed at 8 s, and restarted at 10 s or never.",
        columns={**SCENARIO, "killed": plain("agent"), "back at, s": plain("restart_s"), **OUTCOME},
        alt="Survival, mean cost and payload attitude for each agent killed",
    ),
    Section(
        name="deaths",
        title="An agent killed for good, at any time",
        text="Random agents killed at random times, one in each run, never restarted. Their UAVs play the last plan "
        "and then hold hover thrust and level attitude.",
        columns={**SCENARIO, "killed": plain("agent"), "at, s": plain("killed_s"), **OUTCOME},
        alt="Survival, mean cost and payload attitude over the time of death",
    ),
    Section(
        name="sharing",
        title="How few plans have to be sent?",
        text="A plan is sent to the other agents when its corrections to the shared control law change by more than a "
        "threshold, a share of the input's range, and at least once a second. Threshold 0: all plans are sent; the "
        "costs on each network are over those of that row.",
        columns={
            **SCENARIO,
            "network": plain("network"),
            "threshold": plain("share_threshold"),
            "plans sent, %": number("plans_shared_share", 100.0, 1),
            "completed": done,
            "cost over all sent": number("cost_ratio", digits=3),
            "cost, 1e-3": number("cost_mean", 1e3),
            "attitude, deg": number("attitude_max_deg"),
            "swing, m": number("swing_m"),
        },
        alt="Mean cost over that with all plans sent, and payload attitude, over the share of plans sent",
    ),
    Section(
        name="ablation",
        title="What each part contributes",
        text="One setting changed at a time, on a perfect network and on one with 200 ms delay and 30 % loss.",
        columns={
            **SCENARIO,
            "network": plain("network"),
            "changed": plain("part"),
            "to": lambda row: f"`{row['value']}`" if row["value"] else "",
            **OUTCOME,
        },
        alt="Cost of every variant over that of the scenario as it is",
    ),
    Section(
        name="horizon",
        title="What horizon and terminal weight decide",
        text="The paper's N_p = 20 is a choice, and it prints no terminal weight. Each horizon with each weight where "
        "the prediction is open loop, on a perfect network and with a delay of 200 ms.",
        columns={
            **SCENARIO,
            "network": plain("network"),
            "N_p": plain("horizon"),
            "terminal weight": lambda row: f"{float(row['terminal']):g}",
            **OUTCOME,
        },
        alt="Cost of every horizon and terminal weight over that of the scenario as it is",
    ),
    Section(
        name="hover",
        title=HOVER_TITLE,
        text="The paper's maneuver with a longer and longer hover as its last phase, on a perfect network. Costs are "
        "means over runs of different length: compare them between controllers.",
        columns={
            **SCENARIO,
            "last hover, s": lambda row: f"{float(row['hover_s']):g}",
            **{heading: cell for heading, cell in OUTCOME.items() if heading != "cost over unimpaired"},
        },
        alt="Survival, mean cost and payload attitude over the duration of the last hover",
    ),
    Section(
        name="scaling",
        title="Growth with the team",
        text="Teams of 2 to 12 UAVs over 10 s, with an agent for each, for two, and for all. What is behind the "
        "numbers: [performance.md](performance.md).",
        columns=GROWTH,
        alt="Processor time of a step and of the team, volume of the plans and mean cost over the number of UAVs",
        arguments=("--max", "12", "--seeds", "3"),
    ),
)


def simulate(section: Section, renewed: Collection[str]) -> list[str]:
    """Run an experiment as far as this commit has not run it, and return the sentences it ends with.

    Args:
        section: Of the experiment.
        renewed: Experiments that are run again if they are of another commit; none for all.
    """
    sys.stderr.write(f"experiment {section.name}\n")
    folder, now = RUNS / section.name, commit()
    if not folder.exists() or (commit_of(section) != now and (not renewed or section.name in renewed)):
        shutil.rmtree(folder, ignore_errors=True)
        _commit_file(section).write_text(now, encoding="utf-8")
    command = ["transport", "experiment", section.name, *section.arguments, "--out", str(folder)]
    executable = str(Path(sys.executable).parent / "transport")
    done = subprocess.run([executable, *command[1:]], stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT)
    shutil.copy(folder / section.figure, IMAGES / f"{section.name}.png")
    if section.second is not None:
        shutil.copy(folder / section.second[0], IMAGES / section.second[1])
    # The last paragraph in front of the machine and the files.
    return done.stdout.rpartition("\nmachine: ")[0].rstrip().rpartition("\n\n")[2].splitlines()


def read(section: Section, table: str | None = None) -> list[dict[str, str]]:
    """The rows of an experiment's table, or of another of its files."""
    with (RUNS / section.name / (table or section.table)).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def section_of(name: str) -> Section:
    """The section of an experiment."""
    return next(section for section in SECTIONS if section.name == name)


def listed(columns: Columns, rows: Iterable[Row]) -> str:
    """Return rows as a table in Markdown."""
    return table(columns, ([cell(row) for cell in columns.values()] for row in rows))


def page(sections: Sequence[tuple[Section, list[str], str]]) -> str:
    """docs/results.md."""
    parts = [
        "# Results\n\n<!-- Made by `make figures` (docs/results_page.py): do not edit. -->\n\n"
        "Every number here comes from the command above it, and `make figures` makes them all again. Costs, attitudes "
        "and survival are the same on every machine; processor times are of the machine named below a table. Costs are "
        "means over a flight of the team's cost at each tick ([equations.md](equations.md) (21)), ± half the 95 % "
        "confidence interval where chance plays a part. `swing` is the largest distance of the payload from its "
        "reference in the last 4 s of a flight. How experiments work: [experiments.md](experiments.md)."
    ]
    for section, sentences, machine in sections:
        command = " ".join(("transport experiment", section.name, *section.arguments))
        pieces = [f"## {section.title}", f"```\n{command}\n```", section.text]
        pieces.append(f"![{section.alt}](images/{section.name}.png)")
        pieces.append("\n".join(f"- {sentence}" for sentence in sentences))
        if section.before is not None:
            file, columns = section.before
            pieces.append(listed(columns, read(section, file)))
        pieces.append(listed(section.columns, read(section)))
        if section.second is not None:
            _, image, alt = section.second
            pieces.append(f"![{alt}](images/{image})")
        parts.append("\n\n".join([*pieces, f"*Commit {commit_of(section)}. {machine}*"]))
    return "\n\n".join(parts) + "\n"


def commit_of(section: Section) -> str:
    """The commit whose simulation an experiment has run; "unknown" if none is noted."""
    file = _commit_file(section)
    return file.read_text(encoding="utf-8") if file.exists() else "unknown"


def _commit_file(section: Section) -> Path:
    return RUNS / f"{section.name}.commit"


def machine_of(section: Section) -> str:
    """Where an experiment was begun."""
    identity: dict[str, str] = json.loads((RUNS / section.name / "experiment.json").read_text(encoding="utf-8"))
    return identity["machine"]


def between(values: Sequence[float]) -> str:
    """The range of values, two digits each; a single value where both ends round to the same."""
    low, high = f"{min(values):.2f}", f"{max(values):.2f}"
    return high if low == high else f"{low} to {high}"


def at_a_glance() -> str:
    """The table of the README: what the network does to the two algorithms."""
    by_name = {section.name: read(section) for section in SECTIONS}

    def cell(name: str, scenario: str, **labels: str) -> str:
        rows = [
            row
            for row in by_name[name]
            if row["scenario"] == scenario and all(row[label] == value for label, value in labels.items())
            if row.get("agent") != "none"  # the run without a death
        ]
        flights, completed = (sum(int(row[what]) for row in rows) for what in ("flights", "completed"))
        ratios = [float(row["cost_ratio"]) for row in rows if row["cost_ratio"]]
        if not rows:
            return ""
        if not completed:
            first = min(float(row["first_lost_s"]) for row in rows)
            return f"diverges at {first:.1f} s" if flights == 1 else f"all {flights} diverge, from {first:.1f} s on"
        count = "completes" if flights == 1 else f"{completed} of {flights} complete"
        attitude = max(float(row["attitude_max_deg"]) for row in rows if row["attitude_max_deg"])
        swings = [float(row["swing_m"]) for row in rows if row["swing_m"]]
        return f"{count}: cost x{between(ratios)}, attitude {attitude:.1f} deg, swing {between(swings)} m"

    lines = ["| | `paper`: the paper's algorithm with our weights | `resilient` |", "|---|---|---|"]
    for what, name, labels in (
        ("`transport experiment latency`: 100 ms delay", "latency", {"delay_s": "0.1"}),
        ("400 ms delay", "latency", {"delay_s": "0.4"}),
        ("`transport experiment loss`: 10 % packet loss", "loss", {"loss": "0.1", "model": "bernoulli"}),
        ("60 % burst loss", "loss", {"loss": "0.6", "model": "bursts"}),
        ("`transport experiment kill`: an agent killed and restarted after 2 s", "kill", {"restart_s": "10.0"}),
        ("never restarted", "kill", {"restart_s": "never"}),
        ("`transport experiment deaths`: killed for good at 20 random times", "deaths", {}),
    ):
        lines.append(f"| {what} | {cell(name, 'paper', **labels)} | {cell(name, 'resilient', **labels)} |")
    return "\n".join(lines)


def claim() -> str:
    """The paper's algorithm against the centralized controller, for the README: a row for each way to compare."""
    rows = [row for row in read(section_of("paper"), "verdict.csv") if row["controller"] == "paper's algorithm"]
    weathers = list(dict.fromkeys(row["weather"] for row in rows))
    lines = [f"| the paper's algorithm with our weights | {' | '.join(weathers)} |", "|" + "---|" * (1 + len(weathers))]
    for key in dict.fromkeys((row["budget"], row["kept"]) for row in rows):
        found = {row["weather"]: row for row in rows if (row["budget"], row["kept"]) == key}
        cells = [
            f"{cost_range(found[weather])}: {found[weather]['verdict']}"
            if cost_range(found[weather]) not in ("", "diverged")
            else found[weather]["verdict"]
            for weather in weathers
        ]
        period = periods(found[weathers[0]])
        where = f" (T_s {period} ms)" if period != "none of the grid" else ""
        lines.append(f"| at {COMPARED_AT[key]}{where} | {' | '.join(cells)} |")
    return "\n".join(lines)


def hover() -> str:
    """Whether the paper's algorithm is stable in a long hover, for the README."""
    rows = read(section_of("hover"))
    longest = max(float(row["hover_s"]) for row in rows)
    by_scenario = {row["scenario"]: row for row in rows if float(row["hover_s"]) == longest}
    own = by_scenario.pop("paper")
    anchor = re.sub(r"[^\w -]", "", HOVER_TITLE.lower()).replace(" ", "-")
    if own["first_lost_s"]:
        found = f"is unstable: it diverges at {float(own['first_lost_s']):.1f} s"
    else:
        found = f"completes, with a payload attitude of up to {number('attitude_max_deg')(own)} deg"
    others = "; ".join(
        f"`{name}` {'diverges' if row['first_lost_s'] else 'completes'}" for name, row in by_scenario.items()
    )
    return (
        f"In a hover of {longest:g} s at the end of the maneuver the paper's algorithm with our weights {found}; "
        f"{others} ([table](docs/results.md#{anchor}))."
    )


def figures_of_a_run() -> None:
    """The paper's maneuver, with processes: the figures of a run."""
    folder = RUNS / "run"
    shutil.rmtree(folder, ignore_errors=True)
    executable = str(Path(sys.executable).parent / "transport")
    subprocess.run([executable, "run", "paper", "--out", str(folder)], check=True, cwd=ROOT)
    for figure in (folder / "figures").glob("*.png"):
        shutil.copy(figure, IMAGES / figure.name)


def moving_picture() -> None:
    """A flight on a network that is late, lossy, and deaf to one agent for a while: the README's first picture."""
    folder = RUNS / "moving"
    shutil.rmtree(folder, ignore_errors=True)
    executable = str(Path(sys.executable).parent / "transport")
    flown = [part for setting in MOVING for part in ("--set", setting)]
    subprocess.run([executable, "run", "resilient", *flown, "--no-figures", "--out", str(folder)], check=True, cwd=ROOT)
    subprocess.run([executable, "plot", str(folder), "--animate", str(IMAGES / "flight.gif")], check=True, cwd=ROOT)


def main() -> None:
    """Run the experiments, or the named ones alone where the others have results; draw, write."""
    renewed = sys.argv[1:]
    strange = set(renewed) - {section.name for section in SECTIONS}
    if strange:
        raise SystemExit(f"expected names of experiments, got {', '.join(sorted(strange))}")
    IMAGES.mkdir(parents=True, exist_ok=True)
    RUNS.mkdir(parents=True, exist_ok=True)
    figures_of_a_run()
    moving_picture()
    flown = [(section, simulate(section, renewed), machine_of(section)) for section in SECTIONS]
    PAGE.write_text(page(flown), encoding="utf-8")
    put(README, "network", at_a_glance())
    put(README, "claim", claim())
    put(README, "hover", hover())
    sys.stderr.write(f"written: {PAGE.name}, images/, {README.name}\n")


if __name__ == "__main__":
    main()
