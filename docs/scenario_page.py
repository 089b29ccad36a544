"""Renew the measured tables of docs/scenario.md: part of `make figures`, a minute on two cores."""

from simulations import DIVERGED, Found, Measured, Run, cost, one, or_diverged, renew
from tables import ROOT, table

from transport.experiments.cases import Team

DOCUMENT = ROOT / "docs" / "scenario.md"

TERM = "controller.cost=[{expression='v0[0]',weight=0.1}]"
DAMPED = {
    "`resilient`": Run("resilient"),
    "`resilient` with the term": Run("resilient", (TERM,)),
    "`precise`": Run("precise"),
}


def terms(found: Found) -> str:
    """Return the table of a term of the cost."""
    rows = []
    for text, run in DAMPED.items():
        result = one(found, run)
        swing = or_diverged(result, lambda f: f"{100 * f.swing_m:.1f} cm")
        rows.append([text, swing, f"{100 * result.payload_rms_m:.1f} cm", cost(result)])
    return table(["", "payload error, last 4 s", "payload error, rms", "mean cost of (21)"], rows)


TEAMS = (2, 3, 4, 6, 8, 12)
PAPER_TEAMS = (2, 3, 4, 6, 8)
DELAY = ("links.delay_s=0.1",)


def _team(scenario: str, uavs: int, settings: tuple[str, ...] = ()) -> Run:
    return Run(scenario, settings, Team(uavs, 1))


def teams(found: Found) -> str:
    """Return the table of teams of all sizes."""
    rows = []
    for uavs in TEAMS:
        both = [one(found, _team("resilient", uavs, settings)) for settings in ((), DELAY)]
        cells = [str(uavs)]
        for cell in (
            cost,
            lambda result: f"{result.attitude_deg:.2f}",
            lambda result: f"{result.swing_m:.2f}",
            lambda result: f"{result.separation_m:.3f}",
        ):
            cells.append(", ".join(cell(result) if result.completed else DIVERGED for result in both))
        paper = one(found, _team("paper", uavs)) if uavs in PAPER_TEAMS else None
        cells.append("" if paper is None else or_diverged(paper, cost))
        rows.append(cells)
    quantities = ("mean cost", "payload attitude, deg", "swing, m", "smallest distance, m")
    return table(["UAVs", *quantities, "mean cost with `--from paper`"], rows)


TABLES = (
    Measured("terms", tuple(DAMPED.values()), terms),
    Measured(
        "teams",
        (
            *(_team("resilient", uavs, settings) for uavs in TEAMS for settings in ((), DELAY)),
            *(_team("paper", uavs) for uavs in PAPER_TEAMS),
        ),
        teams,
    ),
)


if __name__ == "__main__":
    renew(DOCUMENT, TABLES)
