"""Fly the arena with all ready algorithms and renew docs/arena.md and docs/record/arena.md.

Its results are kept for each commit. `--part information` flies the tasks of which one agent knows the goal or the way,
`--part results` the others. Further arguments go to `transport arena`.
"""

import argparse
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from tables import ROOT, commit, put, table

from transport.experiments.arena.arena_tasks_and_networks import NETWORK_TEXTS, NETWORKS, TASKS

PAGE, RECORD = ROOT / "docs" / "arena.md", ROOT / "docs" / "record" / "arena.md"
IMAGES = ROOT / "docs" / "images"
FOLDER = ROOT / "examples" / "controllers"

OUT = "--out"
# Tasks of each part of the record, with the name of its figure.
INFORMATION = ("told", "follow", "blocked")
PARTS: Mapping[str, tuple[str, Sequence[str]]] = {
    "results": ("arena", [name for name in TASKS if name not in INFORMATION]),
    "information": ("arena_information", INFORMATION),
}

# The paper's algorithm as a class is left out: its numbers are those of `paper`.
ENTERED = (
    "alone:Alone",
    "sequential:Sequential",
    "event_triggered:EventTriggered",
    "admm:ADMM",
    "nmpc:NMPC",
)


def tasks() -> str:
    """Return the table of the tasks."""
    rows = [
        [f"`{name}`", str(task.version), str(task.uavs), task.text] for name, task in TASKS.items()
    ]
    return table(["task", "version", "UAVs", ""], rows)


def networks() -> str:
    """Return the table of the networks."""
    rows = [
        [f"`{name}`", NETWORK_TEXTS[name], ", ".join(f"`{one}`" for one in settings)]
        for name, settings in NETWORKS.items()
    ]
    return table(["network", "", "settings"], rows)


def results(part: str, arguments: Sequence[str]) -> str:
    """Fly a part of the arena as far as this commit has not, copy its figure and return the report."""
    image, names = PARTS[part]
    entered = [word for name in ENTERED for word in ("--controller", name)]
    chosen = [*([] if "--controller" in arguments else entered), *arguments]
    if "--task" not in arguments:
        chosen += [word for name in names for word in ("--task", name)]
    folder = ROOT / "runs" / "figures" / commit() / f"arena-{part}"
    if OUT in chosen:
        place = chosen.index(OUT)
        folder = Path(chosen[place + 1])
        del chosen[place : place + 2]
    command = [sys.executable, "-m", "transport", "arena", *chosen, OUT, str(folder)]
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True, cwd=FOLDER)

    shutil.copy(folder / "figure.png", IMAGES / f"{image}.png")
    report = (folder / "report.md").read_text(encoding="utf-8").strip()
    figure = f"![Tasks by algorithms, a mark for each network: filled where all runs complete](../images/{image}.png)"
    flown = f"In examples/controllers:\n\n```\ntransport arena {shlex.join(chosen)}\n```"
    return f"{flown}\n\n{figure}\n\n{report}"


def main() -> None:
    """Renew the tables of both pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=PARTS, action="append", help="of the tasks; default: all")
    given, arguments = parser.parse_known_args()
    put(PAGE, "tasks", tasks())
    put(PAGE, "networks", networks())
    for part in given.part or PARTS:
        put(RECORD, part, results(part, arguments))


if __name__ == "__main__":
    main()
