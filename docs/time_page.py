"""Renew the measured table of docs/time.md: part of `make figures`, half a minute on two cores."""

from simulations import Found, Measured, Run, attitude, cost, one, renew
from tables import ROOT, table

DOCUMENT = ROOT / "docs" / "time.md"

SCENARIOS = ("paper", "resilient")
ITERATIONS = (1, 2, 4)
CENTRALIZED = Run("centralized")


def _run(scenario: str, count: int) -> Run:
    # One is the default: the same simulation as elsewhere.
    return Run(scenario, () if count == 1 else (f"controller.negotiation_iterations={count}",))


def negotiation_iterations(found: Found) -> str:
    """Return the table of iterations of negotiation, beside the centralized controller, which needs none."""
    rows = []
    for count in ITERATIONS:
        runs = [*(_run(name, count) for name in SCENARIOS), *([CENTRALIZED] if count == 1 else [])]
        cells = [f"{cost(result)}, {attitude(result)}" for result in (one(found, run) for run in runs)]
        rows.append([str(count), *cells, *([] if count == 1 else [""])])
    return table(["iterations", *(f"`{name}`" for name in (*SCENARIOS, CENTRALIZED.scenario))], rows)


TABLES = (
    Measured(
        "negotiation_iterations",
        (*(_run(name, count) for count in ITERATIONS for name in SCENARIOS), CENTRALIZED),
        negotiation_iterations,
    ),
)


if __name__ == "__main__":
    renew(DOCUMENT, TABLES)
