"""Make every figure and table of results in README and docs.

Part of `make figures`, 45 minutes on two cores.

Runs the experiments, or only those named as arguments, as far as runs/figures/ has no results of
this commit, and writes their parts of docs/results.md, docs/images/ and the tables of the README.
"""

import csv
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from tables import ROOT, commit, place, put, table

RUNS, IMAGES = ROOT / "runs" / "figures", ROOT / "docs" / "images"
PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"

# Network of the README's animation.
NETWORK = ("--set", "links.delay_s=0.2", "--set", "links.loss=0.3")

Row = Mapping[str, str]

# Further arguments of the commands.
EXPERIMENTS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(
        ("paper", "latency", "loss", "jitter", "matrix", "kill", "deaths", "sharing"), ()
    ),
    **dict.fromkeys(("ablation", "horizon", "hover"), ()),
    "agile": ("--speed", "5", "--speed", "6", "--seeds", "1"),
    "scaling": ("--max", "12", "--seeds", "3"),
}


def transport(*arguments: str) -> None:
    """Run a command of the project."""
    command = [sys.executable, "-P", "-m", "transport", *arguments]
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True, cwd=ROOT)


def folder_of(name: str) -> Path:
    """Return the folder of an experiment of this commit."""
    return RUNS / commit() / name


def read(name: str, file: str = "points.csv") -> list[dict[str, str]]:
    """Return the rows of a table of an experiment."""
    with (folder_of(name) / file).open(encoding="utf-8", newline="") as opened:
        return list(csv.DictReader(opened))


def part_of(name: str) -> str:
    """Run an experiment as far as this commit has not run it.

    Return its report and origin, copy the figures.
    """
    sys.stderr.write(f"experiment {name}\n")
    folder = folder_of(name)
    transport("experiment", name, *EXPERIMENTS[name], "--out", str(folder))
    shutil.copy(folder / "figure.png", IMAGES / f"{name}.png")
    if name == "paper":
        shutil.copy(folder / "maneuver.png", IMAGES)
    return f"{(folder / 'report.md').read_text(encoding='utf-8')}\n*Commit {commit()}.*"


def between(values: Sequence[float]) -> str:
    """Return the range of values, two digits each; a single value if both ends round to the same."""
    return " to ".join(dict.fromkeys(f"{end:.2f}" for end in (min(values), max(values))))


# Rows of the README's table on the network: text, experiment, and labels of the points.
GLANCE: Sequence[tuple[str, str, Row]] = (
    ("`transport experiment latency`: 100 ms delay", "latency", {"delay_s": "0.1"}),
    ("400 ms delay", "latency", {"delay_s": "0.4"}),
    (
        "`transport experiment loss`: 10 % packet loss",
        "loss",
        {"loss": "0.1", "model": "bernoulli"},
    ),
    ("60 % burst loss", "loss", {"loss": "0.6", "model": "bursts"}),
    (
        "`transport experiment kill`: an agent killed and restarted after 2 s",
        "kill",
        {"restart_s": "10.0"},
    ),
    ("never restarted", "kill", {"restart_s": "never"}),
    ("`transport experiment deaths`: killed for good at 20 random times", "deaths", {}),
)


def at_a_glance() -> str:
    """Return the README's table: effect of the network on the two algorithms."""

    def cell(name: str, labels: Row) -> str:
        rows = [
            row
            for row in read(name)
            if row.items() >= labels.items() and row.get("agent") != "none"
        ]
        if not rows:
            return ""
        flights, completed = (
            sum(int(row[what]) for row in rows) for what in ("flights", "completed")
        )
        if not completed:
            first = min(float(row["first_lost_s"]) for row in rows)
            return f"{completed} of {flights} complete, the first diverges at {first:.1f} s"
        ratios, attitudes, swings = (
            [float(row[number]) for row in rows if row[number]]
            for number in ("cost_ratio", "attitude_max_deg", "swing_m")
        )
        result = (
            f"cost x{between(ratios)}, attitude {max(attitudes):.1f} deg, swing {between(swings)} m"
        )
        return f"{completed} of {flights} complete: {result}"

    rows = [
        [
            what,
            *(cell(name, {"scenario": scenario, **labels}) for scenario in ("paper", "resilient")),
        ]
        for what, name, labels in GLANCE
    ]
    return table(["", "`paper`: the paper's algorithm with our weights", "`resilient`"], rows)


def claim() -> str:
    """Return the README's table of the paper's algorithm against the centralized controller, one row a comparison."""
    rows = [row for row in read("paper", "verdict.csv") if row["controller"] == "paper's algorithm"]
    weathers = list(dict.fromkeys(row["weather"] for row in rows))
    cells = {
        (row["at"], row["weather"]): ": ".join(filter(None, (row["cost"], row["verdict"])))
        for row in rows
    }
    periods: dict[str, str] = {}
    for row in rows:  # of the first weather
        periods.setdefault(row["at"], f" (T_s {row['T_s']})" * bool(row["T_s"]))
    lines = [
        [f"at {at}{where}", *(cells[at, weather] for weather in weathers)]
        for at, where in periods.items()
    ]
    return table(["the paper's algorithm with our weights", *weathers], lines)


def figures_of_runs() -> None:
    """Copy the figures of the paper's maneuver, and animate fast flight on a late network for the README."""
    run, animated = RUNS / "run", RUNS / "animation"
    for folder in (run, animated):
        shutil.rmtree(folder, ignore_errors=True)
    transport("run", "paper", "--out", str(run))
    for figure in (run / "figures").glob("*.png"):
        shutil.copy(figure, IMAGES / figure.name)
    transport("run", "eight", *NETWORK, "--no-figures", "--out", str(animated))
    transport("plot", str(animated), "--animate", str(IMAGES / "flight.gif"))


def main() -> None:
    """Run the named experiments, all without a name, and write their parts of the page and the README's tables."""
    names = sys.argv[1:] or list(EXPERIMENTS)
    IMAGES.mkdir(exist_ok=True)
    for name in names:
        place(PAGE, name)  # refused before minutes are spent
    figures_of_runs()
    for name in names:
        put(PAGE, name, part_of(name))
    if {"latency", "loss", "kill", "deaths"} <= set(names):
        put(README, "network", at_a_glance())
    if "paper" in names:
        put(README, "claim", claim())
    sys.stderr.write(f"written: {PAGE.name}, images/, {README.name}\n")


if __name__ == "__main__":
    main()
