"""Map of the paper's claims: `python -m benchmarks.claims` compares both controllers over weights and horizon.

The paper publishes neither weights nor timings. For each weight on the payload's attitude (that on positions is 1),
terminal weight Q_f and horizon N_p: mean cost of the paper's algorithm over that of the centralized controller at
50 ms, at the same rate, and at 40 ms with a horizon of as many seconds.
"""

import math

import transport
from benchmarks.campaign import completed, options, runs, say
from docs.tables import bar
from transport.experiments.comparison import grade

ATTITUDES, TERMINALS, HORIZONS = (0.5, 1.0, 5.0), (10.0, 50.0, 100.0), (6, 8, 10, 14)
PERIOD_S, SHORTER_S = 0.05, 0.04
CLAIMS = ["slightly worse", "slightly better"]


def of(scenario: str, attitude: float, terminal: float, horizon: int, period_s: float) -> transport.Scenario:
    """Return a scenario at a sampling period, whose horizon is as long as so many steps of 50 ms."""
    settings = {
        "controller.weights.attitude": attitude,
        "controller.weights.terminal": terminal,
        "controller.horizon": round(horizon * PERIOD_S / period_s),
        "controller.sampling_period_s": period_s,
    }
    return transport.Scenario(scenario).copy(settings)


def main() -> None:
    """Simulate the grid and print it as a table."""
    parser = options("claims", __doc__)
    parser.add_argument("--attitude", type=float, action="append", help="this weight; may be repeated")
    attitudes = parser.parse_args().attitude or ATTITUDES
    say(bar(["attitude, Q_f", *(f"N_p {horizon}" for horizon in HORIZONS)]) + "\n|" + "---|" * (1 + len(HORIZONS)))
    both = 0
    kinds = (("centralized", PERIOD_S), ("paper", PERIOD_S), ("paper", SHORTER_S))
    for attitude in attitudes:
        for terminal in TERMINALS:
            point = [(attitude, terminal, horizon) for horizon in HORIZONS]
            found = runs([of(name, *weights, period_s) for weights in point for name, period_s in kinds])
            costs = [[run["cost_mean"] for run in completed(own)] for own in found]
            cells = []
            for i in range(0, len(costs), len(kinds)):
                (reference,), *own = costs[i : i + len(kinds)]
                ratios = [cost[0] / reference if cost else math.inf for cost in own]
                text = ", ".join("diverges" if ratio == math.inf else f"{ratio:.3f}" for ratio in ratios)
                hold = [grade(ratio) for ratio in ratios] == CLAIMS
                both += hold
                cells.append(f"**{text}**" if hold else text)
            say(bar([f"{attitude:g}, {terminal:g}", *cells]))
    say(f"both claims hold at {both} of {len(attitudes) * len(TERMINALS) * len(HORIZONS)}")


if __name__ == "__main__":
    main()
