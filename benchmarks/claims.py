"""Map of the paper's claims: `python -m benchmarks.claims` compares both controllers over weights and horizon.

The paper publishes neither weights nor timings. For each weight on the payload's attitude (that on positions is 1),
terminal weight Q_f and horizon N_p: mean cost of the paper's algorithm over that of the centralized controller at
50 ms, at the same rate, and at 40 ms with a horizon of as many seconds.
"""

import argparse
import sys
from collections.abc import Sequence

import transport
from transport.experiments.comparison import grade

ATTITUDES, TERMINALS, HORIZONS = (0.5, 1.0, 5.0), (10.0, 50.0, 100.0), (6, 8, 10, 14)
PERIOD_S, SHORTER_S = 0.05, 0.04
CLAIMS = ("slightly worse", "slightly better")


def cost(scenario: str, period_s: float, weights: dict[str, float]) -> float:
    """Return the mean cost of a run; infinite if it diverges."""
    run = transport.fly(scenario, {**weights, "controller.sampling_period_s": period_s}, progress=False)
    return float(run.summary["cost"]["mean"]) if run.completed else float("inf")


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate the grid and print it as a table; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.claims", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--attitude", type=float, action="append", help="this weight; may be repeated")
    options = parser.parse_args(arguments)
    names = [f"N_p {horizon}" for horizon in HORIZONS]
    sys.stdout.write(f"| attitude, Q_f | {' | '.join(names)} |\n{'|---' * (1 + len(names))}|\n")
    both = count = 0
    for attitude in options.attitude or ATTITUDES:
        for terminal in TERMINALS:
            cells = []
            for horizon in HORIZONS:
                weights = {
                    "controller.weights.attitude": attitude,
                    "controller.weights.terminal": terminal,
                    "controller.horizon": horizon,
                }
                reference = cost("centralized", PERIOD_S, weights)
                shorter = {**weights, "controller.horizon": round(horizon * PERIOD_S / SHORTER_S)}
                runs = (PERIOD_S, weights), (SHORTER_S, shorter)
                ratios = [cost("paper", period_s, settings) / reference for period_s, settings in runs]
                hold = [grade(ratio) == claim for ratio, claim in zip(ratios, CLAIMS, strict=True)]
                both, count = both + all(hold), count + 1
                text = ", ".join("diverges" if ratio == float("inf") else f"{ratio:.3f}" for ratio in ratios)
                cells.append(f"**{text}**" if all(hold) else text)
            sys.stdout.write(f"| {attitude:g}, {terminal:g} | {' | '.join(cells)} |\n")
            sys.stdout.flush()
    sys.stdout.write(f"both claims hold at {both} of {count}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
