"""Fly the arena with all ready algorithms and renew docs/arena.md and docs/record/arena.md.

Part of `make figures`. Results are kept for each commit. Further arguments go to
`transport arena`.
"""

import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tables import ROOT, commit, put, table

from transport.experiments.arena.arena_tasks_and_networks import NETWORK_TEXTS, NETWORKS, TASKS

PAGE, RECORD = ROOT / "docs" / "arena.md", ROOT / "docs" / "record" / "arena.md"
IMAGES = ROOT / "docs" / "images"
FOLDER = ROOT / "examples" / "controllers"

OUT = "--out"

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


def results(arguments: Sequence[str]) -> str:
    """Fly the arena as far as this commit has not, copy the figure and return the report."""
    entered = [word for name in ENTERED for word in ("--controller", name)]
    chosen = [*([] if "--controller" in arguments else entered), *arguments]
    folder = ROOT / "runs" / "figures" / commit() / "arena"
    if OUT in chosen:
        place = chosen.index(OUT)
        folder = Path(chosen[place + 1])
        del chosen[place : place + 2]
    command = [sys.executable, "-m", "transport", "arena", *chosen, OUT, str(folder)]
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True, cwd=FOLDER)

    shutil.copy(folder / "figure.png", IMAGES / "arena.png")
    report = (folder / "report.md").read_text(encoding="utf-8").strip()
    figure = "![Tasks by algorithms, a mark for each network: filled where all runs complete](../images/arena.png)"
    flown = f"In examples/controllers:\n\n```\ntransport arena {shlex.join(chosen)}\n```"
    return f"{flown}\n\n{figure}\n\n{report}"


def main() -> None:
    """Renew the tables of both pages."""
    put(PAGE, "tasks", tasks())
    put(PAGE, "networks", networks())
    put(RECORD, "results", results(sys.argv[1:]))


if __name__ == "__main__":
    main()
