"""Make every figure and table of results in README and docs: `make figures`.

Flies what is missing, keeps it in runs/figures/ (delete a folder there to measure anew), and writes docs/results.md,
docs/images/ and what the README says of them. Some forty minutes on two cores from nothing.
"""

import csv
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
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
    lost = f", lost at {float(row['first_lost_s']):.1f} s" if row["first_lost_s"] else ""
    return f"{row['completed']} of {row['flights']}{lost}"


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
    "computation": plain("budget"),
    "T_s, ms": milliseconds("period_s"),
    "N_p": plain("horizon"),
    "completed": done,
    "cost, 1e-3": lambda row: number("cost_mean", 1e3, 3)(row).partition(" ")[0],
    "over centralized": number("cost_mean_ratio", digits=3),
    "peak over centralized": number("cost_max_ratio", digits=3),
    "attitude, deg": lambda row: number("attitude_max_deg")(row).partition(" ")[0],
    "swing, m": lambda row: number("swing_m")(row).partition(" ")[0],
    "CPU of a step, ms": lambda row: number("cpu_step_p50_ms")(row).partition(" ")[0],
    "of the team, s/s": lambda row: number("cpu_team_s_per_s")(row).partition(" ")[0],
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
        arguments: Further arguments of the command.
    """

    name: str
    title: str
    text: str
    columns: Columns
    table: str = "points.csv"
    figure: str = "figure.png"
    alt: str
    arguments: tuple[str, ...] = ()


SCENARIO: Columns = {"scenario": plain("scenario")}

SECTIONS = (
    Section(
        name="paper",
        title="Is distributed worse at the same rate, and better at the same computation?",
        text="The paper's comparison. `as printed` is its distributed controller, `closed loop` that of `resilient`. "
        "Computation is processor time of the whole step, measured first; `one processor`: the team together computes "
        "as much per second as the centralized controller, `one each`: each agent does. At a higher rate a horizon of "
        "as many steps is a shorter one, so both are flown: as many steps, as in the paper, and as many seconds.",
        columns=COMPARED,
        table="comparison.csv",
        figure="maneuver.png",
        alt="Position errors, payload attitude and cost of the centralized controller, and of the distributed one at "
        "the same rate and at the same computation",
    ),
    Section(
        name="latency",
        title="How late may plans be?",
        text="Every plan late by the same time. Plans wait for the next tick anyway, so 50 ms are none.",
        columns={**SCENARIO, "delay, ms": milliseconds("delay_s"), **OUTCOME},
        alt="Survival, mean cost and payload attitude over the delay of plans",
    ),
    Section(
        name="loss",
        title="How many may be lost?",
        text="Each on its own, and as many in bursts of five ticks on average in which everything is lost.",
        columns={**SCENARIO, "losses": plain("model"), "lost": share("loss"), **OUTCOME},
        alt="Survival, mean cost and payload attitude over the share of lost plans",
    ),
    Section(
        name="jitter",
        title="How irregular may delays be?",
        text="Delays of 160 ms on average, of four distributions.",
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
        title="Late and lost",
        text="Every delay with every loss.",
        columns={**SCENARIO, "delay, ms": milliseconds("delay_s"), "lost": share("loss"), **OUTCOME},
        alt="Maps of mean cost and survival over delay and loss",
    ),
    Section(
        name="kill",
        title="What an agent's death does",
        text="Each agent killed at 8 s, and started again at 10 s, or never.",
        columns={**SCENARIO, "killed": plain("agent"), "back at, s": plain("restart_s"), **OUTCOME},
        alt="Survival, mean cost and payload attitude for each agent killed",
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
        },
        alt="Mean cost over that with all plans sent, and payload attitude, over the share of plans sent",
    ),
    Section(
        name="ablation",
        title="What each part is worth",
        text="One setting changed at a time, on a perfect network and on one that is 0.2 s late and loses 30 %.",
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
        name="scaling",
        title="How it grows with the team",
        text="Teams of 2 to 12 UAVs over 10 s, with an agent for each, for two, and for all. What is behind the "
        "numbers: [performance.md](performance.md).",
        columns=GROWTH,
        alt="Processor time of a step and of the team, volume of the plans and mean cost over the number of UAVs",
        arguments=("--max", "12", "--seeds", "3"),
    ),
)


def fly(section: Section) -> list[str]:
    """Fly an experiment as far as it has not been flown, and return the sentences it ends with."""
    sys.stderr.write(f"experiment {section.name}\n")
    folder = RUNS / section.name
    command = ["transport", "experiment", section.name, *section.arguments, "--out", str(folder)]
    executable = str(Path(sys.executable).parent / "transport")
    done = subprocess.run([executable, *command[1:]], stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT)
    shutil.copy(folder / section.figure, IMAGES / f"{section.name}.png")
    # Behind the table, in front of the machine and the files.
    behind = done.stdout.rpartition("\nmachine: ")[0].rstrip().split("\n\n")
    paragraphs = behind[2:] if section.table == "comparison.csv" else behind[-1:]
    return [line for paragraph in paragraphs for line in paragraph.splitlines()]


def read(section: Section) -> list[dict[str, str]]:
    """The rows of an experiment's table."""
    with (RUNS / section.name / section.table).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def table(columns: Columns, rows: Iterable[Row]) -> str:
    """A table in Markdown."""
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    lines += [f"| {' | '.join(cell(row) for cell in columns.values())} |" for row in rows]
    return "\n".join(lines)


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
        parts.append(
            f"## {section.title}\n\n```\n{command}\n```\n\n{section.text}\n\n"
            f"![{section.alt}](images/{section.name}.png)\n\n"
            + "\n".join(f"- {sentence}" for sentence in sentences)
            + f"\n\n{table(section.columns, read(section))}\n\n*{machine}*"
        )
    return "\n\n".join(parts) + "\n"


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
        ]
        flights, completed = (sum(int(row[what]) for row in rows) for what in ("flights", "completed"))
        ratios = [float(row["cost_ratio"]) for row in rows if row["cost_ratio"]]
        if not completed:
            first = min(float(row["first_lost_s"]) for row in rows)
            return f"lost, at {first:.1f} s" if flights == 1 else f"all {flights} lost, from {first:.1f} s on"
        count = "completes" if flights == 1 else f"{completed} of {flights} complete"
        swings = [float(row["swing_m"]) for row in rows if row["swing_m"]]
        return f"{count}, {between(ratios)} times the cost, swing {between(swings)} m"

    lines = ["| | `paper`, as printed | `resilient` |", "|---|---|---|"]
    for what, name, labels in (
        ("`transport experiment latency`: plans 0.1 s late", "latency", {"delay_s": "0.1"}),
        ("0.4 s late", "latency", {"delay_s": "0.4"}),
        ("`transport experiment loss`: 10 % of them lost", "loss", {"loss": "0.1", "model": "bernoulli"}),
        ("60 % lost, in bursts", "loss", {"loss": "0.6", "model": "bursts"}),
        ("`transport experiment kill`: an agent killed, and back after 2 s", "kill", {"restart_s": "10.0"}),
        ("never back", "kill", {"restart_s": "never"}),
    ):
        lines.append(f"| {what} | {cell(name, 'paper', **labels)} | {cell(name, 'resilient', **labels)} |")
    return "\n".join(lines)


def claim() -> str:
    """What the paper's distributed controller costs, for the README: a row for each reading of its two statements."""
    readings = {
        ("same rate", "steps"): "at the same rate",
        ("one processor", "steps"): "same computation of the whole team, as many steps of horizon",
        ("one processor", "seconds"): "the same, as many seconds of horizon",
        ("one each", "steps"): "same computation of each agent, as many steps",
        ("one each", "seconds"): "the same, as many seconds",
    }
    rows = [row for row in read(SECTIONS[0]) if row["controller"] == "as printed"]
    weathers = list(dict.fromkeys(row["weather"] for row in rows))
    lines = [f"| distributed, as printed | {' | '.join(weathers)} |", "|" + "---|" * (1 + len(weathers))]
    for (budget, kept), text in readings.items():
        found = {row["weather"]: row for row in rows if (row["budget"], row["kept"]) == (budget, kept)}
        if not found:
            lines.append(f"| {text} | no such rate |" + " |" * (len(weathers) - 1))
            continue
        period = milliseconds("period_s")(next(iter(found.values())))
        cells = [
            f"{number('cost_mean_ratio')(row)}: {row['judged']}" if row["cost_mean_ratio"] else row["judged"]
            for row in (found[weather] for weather in weathers)
        ]
        lines.append(f"| {text} (every {period} ms) | {' | '.join(cells)} |")
    return "\n".join(lines)


def put(document: Path, name: str, content: str) -> None:
    """Replace what stands between two markers of a document."""
    text = document.read_text(encoding="utf-8")
    pattern = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end of {name} -->)", re.DOTALL)
    if not pattern.search(text):
        raise SystemExit(f"{document}: expected the markers of {name!r}, got none")
    document.write_text(pattern.sub(lambda found: found[1] + content + found[2], text), encoding="utf-8")


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
    """Fly, draw, write."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    RUNS.mkdir(parents=True, exist_ok=True)
    figures_of_a_run()
    moving_picture()
    flown = [(section, fly(section), machine_of(section)) for section in SECTIONS]
    PAGE.write_text(page(flown), encoding="utf-8")
    put(README, "network", at_a_glance())
    put(README, "claim", claim())
    sys.stderr.write(f"written: {PAGE.name}, images/, {README.name}\n")


if __name__ == "__main__":
    main()
