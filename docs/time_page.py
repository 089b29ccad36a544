"""Renew the measured table of docs/time.md: part of `make figures`, half a minute on two cores."""

from simulations import Measured, Run, attitude, cost, each, renew
from tables import ROOT

DOCUMENT = ROOT / "docs" / "time.md"
SCENARIOS = ("paper", "resilient", "centralized")


def _run(scenario: str, count: int) -> Run | None:
    if count == 1:  # the default: the same simulation as elsewhere
        return Run(scenario)
    return None if scenario == "centralized" else Run(scenario, (f"controller.negotiation_iterations={count}",))


TABLES = (
    Measured(
        "negotiation_iterations",
        ["iterations", *(f"`{name}`" for name in SCENARIOS)],
        {str(count): [_run(name, count) for name in SCENARIOS] for count in (1, 2, 4)},
        each(lambda result: f"{cost(result)}, {attitude(result)}"),
    ),
)


if __name__ == "__main__":
    renew(DOCUMENT, TABLES)
