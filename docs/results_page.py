"""Make every figure and table of results in README and docs: `make figures`.

Runs the experiments, or only those named as arguments, as far as runs/figures/ has no results of this commit, and
writes their parts of docs/results.md, docs/images/ and the tables of the README. All take 50 minutes on two cores.
"""

import csv
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from results_sections import HOVER_TITLE, SECTIONS, Columns, Row, Section, compared_at, cost_range, number, periods
from tables import ROOT, commit, put, table

RUNS, IMAGES = ROOT / "runs" / "figures", ROOT / "docs" / "images"
PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"

# Network of the README's animation.
NETWORK = (
    "links.delay_s=0.1",
    "links.loss=0.1",
    "links.change=[{at_s=8.0,from='agent2',loss=1.0},{at_s=15.0,from='agent2',loss=0.0}]",
)


def transport(*arguments: str) -> str:
    """Run a command of the project and return its standard output."""
    command = [sys.executable, "-P", "-m", "transport", *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT).stdout


def simulate(section: Section) -> list[str]:
    """Run an experiment as far as this commit has not run it, and return the sentences it ends with."""
    sys.stderr.write(f"experiment {section.name}\n")
    folder, now = RUNS / section.name, commit()
    if not folder.exists() or commit_of(section) != now:
        shutil.rmtree(folder, ignore_errors=True)
        _commit_file(section).write_text(now, encoding="utf-8")
    done = transport("experiment", section.name, *section.arguments, "--out", str(folder))
    shutil.copy(folder / section.figure, IMAGES / f"{section.name}.png")
    if section.second is not None:
        shutil.copy(folder / section.second[0], IMAGES / section.second[1])
    # The last paragraph in front of the machine and the files.
    return done.rpartition("\nmachine: ")[0].rstrip().rpartition("\n\n")[2].splitlines()


def read(section: Section, table: str | None = None) -> list[dict[str, str]]:
    """Return the rows of an experiment's table, or of another of its files."""
    with (RUNS / section.name / (table or section.table)).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def section_of(name: str) -> Section:
    """Return the section of an experiment."""
    return next(section for section in SECTIONS if section.name == name)


def listed(columns: Columns, rows: Iterable[Row]) -> str:
    """Return rows as a table in Markdown."""
    cells = columns.values()
    return table(columns, ([row[cell] if isinstance(cell, str) else cell(row) for cell in cells] for row in rows))


def page(sections: Mapping[str, str]) -> str:
    """Return docs/results.md with the given parts, by the name of the experiment, and its present other parts."""
    parts = [
        "# Results\n\n<!-- Made by `make figures` (docs/results_page.py): do not edit. -->\n\n"
        "This page has the results of all experiments. Every number comes from the command above it, and `make "
        "figures` repeats all of them. Costs, attitudes and survival are the same on every machine; processor times "
        "are of the machine named below a table. Costs are means over a run of the team's cost at each tick "
        "([equations.md](equations.md) (21)), ± half the 95 % confidence interval for random runs. `swing` is the "
        "largest distance of the payload from its reference in the last 4 s of a run. "
        "[experiments.md](experiments.md) describes the experiments."
    ]
    present = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
    for section in SECTIONS:
        found = re.search(rf"^## {re.escape(section.title)}\n.*?(?=^## |\Z)", present, re.DOTALL | re.MULTILINE)
        part = sections.get(section.name) or (found[0].strip() if found else "")
        if not part:
            raise SystemExit(f"{PAGE.name}: expected a part on {section.name}, got none: run it as well")
        parts.append(part)
    return "\n\n".join(parts) + "\n"


def part_of_page(section: Section, sentences: Sequence[str]) -> str:
    """Return the part of docs/results.md on an experiment, given the sentences its command ends with."""
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
    return "\n\n".join([*pieces, f"*Commit {commit_of(section)}. {machine_of(section)}*"])


def commit_of(section: Section) -> str:
    """Return the commit an experiment was run with; "unknown" if none is noted."""
    file = _commit_file(section)
    return file.read_text(encoding="utf-8") if file.exists() else "unknown"


def _commit_file(section: Section) -> Path:
    return RUNS / f"{section.name}.commit"


def machine_of(section: Section) -> str:
    """Return the machine on which an experiment was started."""
    identity: dict[str, str] = json.loads((RUNS / section.name / "experiment.json").read_text(encoding="utf-8"))
    return identity["machine"]


def between(values: Sequence[float]) -> str:
    """Return the range of values, two digits each; a single value if both ends round to the same."""
    low, high = f"{min(values):.2f}", f"{max(values):.2f}"
    return high if low == high else f"{low} to {high}"


def at_a_glance() -> str:
    """Return the README's table: effect of the network on the two algorithms."""
    by_name = {name: read(section_of(name)) for name in ("latency", "loss", "kill", "deaths")}

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
    """Return the README's table of the paper's algorithm against the centralized controller, one row a comparison."""
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
        lines.append(f"| at {compared_at(found[weathers[0]])}{where} | {' | '.join(cells)} |")
    return "\n".join(lines)


def hover() -> str:
    """Return the README's sentence about the stability of the paper's algorithm in a long hover."""
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
    """Run the paper's maneuver with processes; copy the figures of `paper`, and of `resilient` the README's."""
    for scenario in ("paper", "resilient"):
        folder = RUNS / f"run-{scenario}"
        shutil.rmtree(folder, ignore_errors=True)
        transport("run", scenario, "--out", str(folder))
    for figure in (RUNS / "run-paper" / "figures").glob("*.png"):
        shutil.copy(figure, IMAGES / figure.name)
    shutil.copy(RUNS / "run-resilient" / "figures" / "performance.png", IMAGES / "resilient.png")


def animation() -> None:
    """Animate a run with delay, packet loss and one unreachable agent: the README's first picture."""
    folder = RUNS / "animation"
    shutil.rmtree(folder, ignore_errors=True)
    options = [part for setting in NETWORK for part in ("--set", setting)]
    transport("run", "resilient", *options, "--no-figures", "--out", str(folder))
    transport("plot", str(folder), "--animate", str(IMAGES / "flight.gif"))


def main() -> None:
    """Run the named experiments, all without a name, and write their parts of the page and the README's tables."""
    names = sys.argv[1:] or [section.name for section in SECTIONS]
    strange = set(names) - {section.name for section in SECTIONS}
    if strange:
        raise SystemExit(f"expected names of experiments, got {', '.join(sorted(strange))}")
    IMAGES.mkdir(parents=True, exist_ok=True)
    RUNS.mkdir(parents=True, exist_ok=True)
    figures_of_a_run()
    animation()
    parts = {name: part_of_page(section_of(name), simulate(section_of(name))) for name in names}
    PAGE.write_text(page(parts), encoding="utf-8")
    for place, content, needed in (
        ("network", at_a_glance, {"latency", "loss", "kill", "deaths"}),
        ("claim", claim, {"paper"}),
        ("hover", hover, {"hover"}),
    ):
        if needed <= set(names):
            put(README, place, content())
    sys.stderr.write(f"written: {PAGE.name}, images/, {README.name}\n")


if __name__ == "__main__":
    main()
