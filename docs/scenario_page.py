"""Renew the measured tables of docs/scenario.md: part of `make figures`, a minute on two cores."""

from simulations import DIVERGED, Flown, Measured, Run, cost, or_diverged, renew
from tables import ROOT

from transport.experiments.cases import Team

DOCUMENT = ROOT / "docs" / "scenario.md"

TERM = "controller.cost=[{expression='v0[0]',weight=0.1}]"
LARGEST_OF_PAPER = 8


def terms(_: str, result: Flown) -> list[str]:
    """Return swing, error and cost."""
    swing = or_diverged(result, lambda f: f"{100 * f.swing_m:.1f} cm")
    return [swing, f"{100 * result.payload_rms_m:.1f} cm", cost(result)]


def team(_: str, perfect: Flown, delayed: Flown, paper: Flown | None) -> list[str]:
    """Return the numbers of a team without and with delay, and the cost of the paper's algorithm."""
    cells = [
        cost,
        lambda result: f"{result.attitude_max_deg:.2f}",
        lambda result: f"{result.swing_m:.2f}",
        lambda result: f"{result.separation_min_m:.3f}",
    ]
    both = [
        ", ".join(cell(result) if result.completed else DIVERGED for result in (perfect, delayed)) for cell in cells
    ]
    return [*both, "" if paper is None else or_diverged(paper, cost)]


def runs_of(uavs: int) -> list[Run | None]:
    """Return the runs of a team size."""
    own = Team(uavs, 1)
    paper = Run("paper", (), own) if uavs <= LARGEST_OF_PAPER else None
    return [Run("resilient", (), own), Run("resilient", ("links.delay_s=0.1",), own), paper]


TABLES = (
    Measured(
        "terms",
        ["", "payload error, last 4 s", "payload error, rms", "mean cost of (21)"],
        {
            "`resilient`": [Run("resilient")],
            "`resilient` with the term": [Run("resilient", (TERM,))],
            "`precise`": [Run("precise")],
        },
        terms,
    ),
    Measured(
        "teams",
        [
            "UAVs", "mean cost", "payload attitude, deg", "swing, m", "smallest distance, m",
            "mean cost with `--from paper`",
        ],
        {str(uavs): runs_of(uavs) for uavs in (2, 3, 4, 6, 8, 12)},
        team,
    ),
)  # fmt: skip


if __name__ == "__main__":
    renew(DOCUMENT, TABLES)
