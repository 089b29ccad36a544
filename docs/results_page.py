"""Make every figure and table of results in README and docs: part of `make figures`, 45 minutes on two cores.

Runs the experiments, or only those named as arguments, as far as runs/figures/ has no results of this commit, and
writes their parts of docs/results.md, docs/images/ and the tables of the README.
"""

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from tables import ROOT, commit, place, put, table

RUNS, IMAGES = ROOT / "runs" / "figures", ROOT / "docs" / "images"
PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"

# Network of the README's animation.
NETWORK = ("links.delay_s=0.2", "links.loss=0.3")

Row = Mapping[str, str]
# Columns of a table: heading, and field of a row or function of it.
Columns = Mapping[str, str | Callable[[Row], str]]


def number(name: str, factor: float = 1.0, digits: int = 2, *, interval: bool = True) -> Callable[[Row], str]:
    """Return a cell with a number of a row, ± half its confidence interval if it has one."""

    def cell(row: Row) -> str:
        found = [row[name], row.get(f"{name}_ci95", "") if interval else ""]
        return " ± ".join(f"{factor * float(value):.{digits}f}" for value in found if value)

    return cell


def mean(name: str, factor: float = 1.0, digits: int = 2) -> Callable[[Row], str]:
    """Return a cell with a number of a row alone."""
    return number(name, factor, digits, interval=False)


def plain(name: str, factor: float = 1.0, unit: str = "") -> Callable[[Row], str]:
    """Return a cell with a value of a row in another unit."""
    return lambda row: f"{factor * float(row[name]):g}{unit}"


def done(row: Row) -> str:
    """Return the number of completed runs and the first time of divergence."""
    lost = f", diverged at {float(row['first_lost_s']):.1f} s" if row["first_lost_s"] else ""
    return f"{row['completed']} of {row['flights']}{lost}"


def spread(name: str, digits: int = 2) -> Callable[[Row], str]:
    """Return a cell with median, smallest and largest of repetitions."""
    return lambda row: "{} ({} to {})".format(*(f"{float(row[name + end]):.{digits}f}" for end in ("", "_min", "_max")))


def periods(row: Row) -> str:
    """Return the sampling periods of equal computation, ms; an end beyond the grid is left open."""
    low, high = (f"{1e3 * float(row[name]):.3g}" if row[name] else "" for name in ("period_low_s", "period_high_s"))
    if low == high:
        return low or "none of the grid"
    return f"{low} to {high}" if low and high else f"from {low}" if low else f"up to {high}"


def cost_range(row: Row) -> str:
    """Return the range of cost ratios at these periods."""
    ratios = (row["cost_ratio_low"], row["cost_ratio_high"])
    return " to ".join(dict.fromkeys(f"{float(ratio):.2f}".replace("inf", "diverged") for ratio in ratios if ratio))


def compared_at(row: Row) -> str:
    """Return what both controllers of a comparison have in common."""
    if row["budget"] == "same rate":
        return "the same rate"
    whose = "the whole team" if row["budget"] == "whole team" else row["budget"]
    return f"the same computation of {whose}, as many {row['kept']} of horizon"


SCENARIO: Columns = {"scenario": "scenario"}
WITHOUT_RATIO: Columns = {
    "completed": done,
    "cost, 1e-3": number("cost_mean", 1e3),
    "attitude, deg": number("attitude_max_deg"),
    "swing, m": number("swing_m"),
}
OUTCOME: Columns = {"completed": done, "cost over unimpaired": number("cost_ratio"), **WITHOUT_RATIO}

COMPARED: Columns = {
    "weather": "weather",
    "controller": "controller",
    "horizon kept": "kept",
    "T_s, ms": plain("period_s", 1e3),
    "N_p": "horizon",
    "completed": done,
    "cost, 1e-3": mean("cost_mean", 1e3, 3),
    "over centralized": number("cost_mean_ratio", digits=3),
    "peak over centralized": number("cost_max_ratio", digits=3),
    "attitude, deg": mean("attitude_max_deg"),
    "swing, m": mean("swing_m"),
    "CPU of a step, ms": spread("cpu_step_ms"),
    "of an agent, s/s": spread("cpu_agent_s_per_s", 3),
    "of the team, s/s": spread("cpu_team_s_per_s", 3),
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
SHARED: Columns = {
    **SCENARIO,
    "network": "network",
    "threshold": "share_threshold",
    "plans sent, %": number("plans_shared_share", 100.0, 1),
    "completed": done,
    "cost over all sent": number("cost_ratio", digits=3),
    **WITHOUT_RATIO,
}
TRACKED: Columns = {
    "case": "case",
    "speed, m/s": plain("speed_mps"),
    "completed": done,
    "error rms, cm": number("payload_rms_m", 100.0),
    "largest, cm": mean("payload_max_m", 100.0, 1),
    "attitude, deg": mean("attitude_max_deg", digits=1),
    "cost over perfect network": number("cost_ratio"),
}
DELAY, LOST = {"delay, ms": plain("delay_s", 1e3)}, {"lost": plain("loss", 100.0, " %")}
NETWORK_OF: Columns = {**SCENARIO, "network": "network"}


class Section(NamedTuple):
    """An experiment: tables by the file that the command writes, its further arguments, and further figures."""

    tables: Mapping[str, Columns]
    arguments: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()


def points(columns: Columns, outcome: Columns = OUTCOME) -> Section:
    """Return a section with the table of points: the columns that tell them apart, and their outcome."""
    return Section({"points.csv": {**columns, **outcome}})


SECTIONS: Mapping[str, Section] = {
    "paper": Section({"curves.csv": COMPARED}, figures=("maneuver.png",)),
    "latency": points({**SCENARIO, **DELAY}),
    "loss": points({**SCENARIO, "losses": "model", **LOST}),
    "jitter": points(
        {
            **SCENARIO,
            "distribution": "distribution",
            "mean, ms": plain("mean_s", 1e3),
            "std, ms": plain("std_s", 1e3),
        }
    ),
    "matrix": points({**SCENARIO, **DELAY, **LOST}),
    "kill": points({**SCENARIO, "killed": "agent", "back at, s": "restart_s"}),
    "deaths": points({**SCENARIO, "killed": "agent", "at, s": "killed_s"}),
    "sharing": Section({"points.csv": SHARED}),
    "ablation": points(
        {**NETWORK_OF, "changed": "part", "to": lambda row: f"`{row['value']}`" if row["value"] else ""}
    ),
    "horizon": points(
        {**NETWORK_OF, "N_p": "horizon", "terminal weight": lambda row: row["terminal"].removesuffix(".0")}
    ),
    "hover": points({**SCENARIO, "last hover, s": plain("hover_s")}, WITHOUT_RATIO),
    "agile": Section({"points.csv": TRACKED}, ("--speed", "5", "--speed", "6", "--seeds", "1")),
    "scaling": Section({"points.csv": GROWTH}, ("--max", "12", "--seeds", "3")),
}


def transport(*arguments: str) -> str:
    """Run a command of the project and return its standard output."""
    command = [sys.executable, "-P", "-m", "transport", *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT).stdout


def read(name: str, file: str = "points.csv") -> list[dict[str, str]]:
    """Return the rows of a table of an experiment."""
    with (RUNS / name / file).open(encoding="utf-8", newline="") as opened:
        return list(csv.DictReader(opened))


def part_of(name: str) -> str:
    """Run an experiment as far as this commit has not run it; return sentences, tables and origin, copy the figures."""
    sys.stderr.write(f"experiment {name}\n")
    section, folder, now = SECTIONS[name], RUNS / name, commit()
    begun_with = RUNS / f"{name}.commit"
    if not folder.exists() or not begun_with.exists() or begun_with.read_text(encoding="utf-8") != now:
        shutil.rmtree(folder, ignore_errors=True)
        begun_with.write_text(now, encoding="utf-8")
    output = transport("experiment", name, *section.arguments, "--out", str(folder))
    shutil.copy(folder / "figure.png", IMAGES / f"{name}.png")
    for figure in section.figures:
        shutil.copy(folder / figure, IMAGES / figure)
    # The last paragraph in front of the machine and the files.
    sentences = output.rpartition("\nmachine: ")[0].rstrip().rpartition("\n\n")[2].splitlines()
    parts = ["\n".join(f"- {sentence}" for sentence in sentences)]
    for file, columns in section.tables.items():
        cells = columns.values()
        rows = [[row[cell] if isinstance(cell, str) else cell(row) for cell in cells] for row in read(name, file)]
        parts.append(table(columns, rows))
    machine = json.loads((folder / "experiment.json").read_text(encoding="utf-8"))["machine"]
    return "\n\n".join([*parts, f"*Commit {now}. {machine}*"])


def between(values: Sequence[float]) -> str:
    """Return the range of values, two digits each; a single value if both ends round to the same."""
    return " to ".join(dict.fromkeys(f"{end:.2f}" for end in (min(values), max(values))))


# Rows of the README's table on the network: text, experiment, and labels of the points.
GLANCE: Sequence[tuple[str, str, Row]] = (
    ("`transport experiment latency`: 100 ms delay", "latency", {"delay_s": "0.1"}),
    ("400 ms delay", "latency", {"delay_s": "0.4"}),
    ("`transport experiment loss`: 10 % packet loss", "loss", {"loss": "0.1", "model": "bernoulli"}),
    ("60 % burst loss", "loss", {"loss": "0.6", "model": "bursts"}),
    ("`transport experiment kill`: an agent killed and restarted after 2 s", "kill", {"restart_s": "10.0"}),
    ("never restarted", "kill", {"restart_s": "never"}),
    ("`transport experiment deaths`: killed for good at 20 random times", "deaths", {}),
)


def at_a_glance() -> str:
    """Return the README's table: effect of the network on the two algorithms."""

    def cell(name: str, labels: Row) -> str:
        rows = [row for row in read(name) if row.items() >= labels.items() and row.get("agent") != "none"]
        if not rows:
            return ""
        flights, completed = (sum(int(row[what]) for row in rows) for what in ("flights", "completed"))
        ratios, attitudes, swings = (
            [float(row[number]) for row in rows if row[number]]
            for number in ("cost_ratio", "attitude_max_deg", "swing_m")
        )
        if not completed:
            first = min(float(row["first_lost_s"]) for row in rows)
            return f"diverges at {first:.1f} s" if flights == 1 else f"all {flights} diverge, from {first:.1f} s on"
        count = "completes" if flights == 1 else f"{completed} of {flights} complete"
        return f"{count}: cost x{between(ratios)}, attitude {max(attitudes):.1f} deg, swing {between(swings)} m"

    rows = [
        [what, *(cell(name, {"scenario": scenario, **labels}) for scenario in ("paper", "resilient"))]
        for what, name, labels in GLANCE
    ]
    return table(["", "`paper`: the paper's algorithm with our weights", "`resilient`"], rows)


def claim() -> str:
    """Return the README's table of the paper's algorithm against the centralized controller, one row a comparison."""
    rows = [row for row in read("paper", "verdict.csv") if row["controller"] == "paper's algorithm"]
    weathers = list(dict.fromkeys(row["weather"] for row in rows))
    lines = []
    for key in dict.fromkeys((row["budget"], row["kept"]) for row in rows):
        found = {row["weather"]: row for row in rows if (row["budget"], row["kept"]) == key}
        cells = [
            f"{ratios}: {row['verdict']}" if (ratios := cost_range(row)) not in ("", "diverged") else row["verdict"]
            for row in (found[weather] for weather in weathers)
        ]
        period = periods(found[weathers[0]])
        where = f" (T_s {period} ms)" if period != "none of the grid" else ""
        lines.append([f"at {compared_at(found[weathers[0]])}{where}", *cells])
    return table(["the paper's algorithm with our weights", *weathers], lines)


def hover() -> str:
    """Return the README's sentence about the stability of the paper's algorithm in a long hover."""
    rows = read("hover")
    longest = max(float(row["hover_s"]) for row in rows)
    own, *others = (row for row in rows if float(row["hover_s"]) == longest)
    if own["first_lost_s"]:
        found = f"is unstable: it diverges at {float(own['first_lost_s']):.1f} s"
    else:
        found = f"completes, with a payload attitude of up to {number('attitude_max_deg')(own)} deg"
    ends = "; ".join(f"`{row['scenario']}` {'diverges' if row['first_lost_s'] else 'completes'}" for row in others)
    return (
        f"In a hover of {longest:g} s at the end of the maneuver the paper's algorithm with our weights {found}; "
        f"{ends} ([table](docs/results.md#is-a-long-hover-stable))."
    )


def figures_of_runs() -> None:
    """Copy the figures of the paper's maneuver, and animate fast flight on a late network for the README."""
    run, animated = RUNS / "run", RUNS / "animation"
    for folder in (run, animated):
        shutil.rmtree(folder, ignore_errors=True)
    transport("run", "paper", "--out", str(run))
    for figure in (run / "figures").glob("*.png"):
        shutil.copy(figure, IMAGES / figure.name)
    options = [part for setting in NETWORK for part in ("--set", setting)]
    transport("run", "eight", *options, "--no-figures", "--out", str(animated))
    transport("plot", str(animated), "--animate", str(IMAGES / "flight.gif"))


def main() -> None:
    """Run the named experiments, all without a name, and write their parts of the page and the README's tables."""
    names = sys.argv[1:] or list(SECTIONS)
    strange = set(names) - SECTIONS.keys()
    if strange:
        raise SystemExit(f"expected names of experiments, got {', '.join(sorted(strange))}")
    for folder in (IMAGES, RUNS):
        folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        place(PAGE, name)  # refused before minutes are spent
    figures_of_runs()
    for name in names:
        put(PAGE, name, part_of(name))
    for mark, content, needed in (
        ("network", at_a_glance, {"latency", "loss", "kill", "deaths"}),
        ("claim", claim, {"paper"}),
        ("hover", hover, {"hover"}),
    ):
        if needed <= set(names):
            put(README, mark, content())
    sys.stderr.write(f"written: {PAGE.name}, images/, {README.name}\n")


if __name__ == "__main__":
    main()
