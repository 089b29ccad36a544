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
from operator import itemgetter

from tables import ROOT, commit, place, put, table

RUNS, IMAGES = ROOT / "runs" / "figures", ROOT / "docs" / "images"
PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"

# Network of the README's animation.
NETWORK = ("links.delay_s=0.2", "links.loss=0.3")

Row = Mapping[str, str]
# Columns of a table: heading, and function of a row.
Columns = Mapping[str, Callable[[Row], str]]


def number(name: str, factor: float = 1.0, digits: int = 2, *, interval: bool = True) -> Callable[[Row], str]:
    """Return a cell with a number of a row, ± half its confidence interval if it has one."""

    def cell(row: Row) -> str:
        found = [row[name], row.get(f"{name}_ci95", "") if interval else ""]
        return " ± ".join(f"{factor * float(value):.{digits}f}" for value in found if value)

    return cell


def done(row: Row) -> str:
    """Return the number of completed runs and the first time of divergence."""
    lost = f", diverged at {float(row['first_lost_s']):.1f} s" if row["first_lost_s"] else ""
    return f"{row['completed']} of {row['flights']}{lost}"


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


VERDICT: Columns = {
    "compared at": compared_at,
    "T_s, ms": periods,
    "cost over centralized": cost_range,
    "verdict": itemgetter("verdict"),
}
# What follows the labels of a point, by experiment; "" for those that are not named.
POINTS: Mapping[str, Columns] = {
    "": {
        "completed": done,
        "cost over unimpaired": number("cost_ratio"),
        "cost, 1e-3": number("cost_mean", 1e3),
        "attitude, deg": number("attitude_max_deg"),
        "swing, m": number("swing_m"),
    },
    "sharing": {
        "plans sent, %": number("plans_shared_share", 100.0, 1),
        "completed": done,
        "cost over all sent": number("cost_ratio", digits=3),
        "attitude, deg": number("attitude_max_deg"),
        "swing, m": number("swing_m"),
    },
    "agile": {
        "completed": done,
        "error rms, cm": number("payload_rms_m", 100.0),
        "largest, cm": number("payload_max_m", 100.0, 1, interval=False),
        "attitude, deg": number("attitude_max_deg", digits=1, interval=False),
        "cost over perfect network": number("cost_ratio"),
    },
    "scaling": {
        "CPU of a step, ms": number("cpu_step_p50_ms"),
        "99th percentile": number("cpu_step_p99_ms", interval=False),
        "team per tick, ms": number("cpu_team_tick_ms", digits=1),
        "plans, kB/s": number("plan_bytes_per_s", 1e-3, 0, interval=False),
        "cost over centralized": number("cost_ratio"),
    },
}
# Further arguments of the commands.
EXPERIMENTS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("paper", "latency", "loss", "jitter", "matrix", "kill", "deaths", "sharing"), ()),
    **dict.fromkeys(("ablation", "horizon", "hover"), ()),
    "agile": ("--speed", "5", "--speed", "6", "--seeds", "1"),
    "scaling": ("--max", "12", "--seeds", "3"),
}


def table_of(name: str) -> str:
    """Return the table of an experiment: the labels of each point, with the names of points.csv, and its numbers."""
    rows = read(name, "verdict.csv" if name == "paper" else "points.csv")
    labels = ["weather", "controller"] if name == "paper" else list(rows[0])[: list(rows[0]).index("flights")]
    columns = VERDICT if name == "paper" else POINTS.get(name, POINTS[""])
    columns = {heading: cell for heading, cell in columns.items() if any(map(cell, rows))}
    lines = [[*(short(row[label]) for label in labels), *(cell(row) for cell in columns.values())] for row in rows]
    return table([*labels, *columns], lines)


def short(text: str) -> str:
    """Return a value of a table, numbers with as few digits as they need."""
    try:
        return f"{float(text):g}"
    except ValueError:
        return text


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
    folder, now = RUNS / name, commit()
    begun_with = RUNS / f"{name}.commit"
    if not folder.exists() or not begun_with.exists() or begun_with.read_text(encoding="utf-8") != now:
        shutil.rmtree(folder, ignore_errors=True)
        begun_with.write_text(now, encoding="utf-8")
    output = transport("experiment", name, *EXPERIMENTS[name], "--out", str(folder))
    shutil.copy(folder / "figure.png", IMAGES / f"{name}.png")
    if name == "paper":
        shutil.copy(folder / "maneuver.png", IMAGES)
    # The last paragraph in front of the machine and the files.
    sentences = output.rpartition("\nmachine: ")[0].rstrip().rpartition("\n\n")[2].splitlines()
    text = "\n".join(f"- {sentence}" for sentence in sentences)
    machine = json.loads((folder / "experiment.json").read_text(encoding="utf-8"))["machine"]
    return f"{text}\n\n{table_of(name)}\n\n*Commit {now}. {machine}*"


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
    names = sys.argv[1:] or list(EXPERIMENTS)
    strange = set(names) - EXPERIMENTS.keys()
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
    ):
        if needed <= set(names):
            put(README, mark, content())
    sys.stderr.write(f"written: {PAGE.name}, images/, {README.name}\n")


if __name__ == "__main__":
    main()
