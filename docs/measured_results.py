"""Measured tables of docs/record/results.md (claims of the paper, the gap, fast flight) and docs/record/radio.md."""

import math
from collections.abc import Mapping
from functools import partial
from itertools import product

import numpy as np
from table_rows_and_cells import (
    COST,
    ESTIMATE,
    HEAVIER,
    LATE,
    MUJOCO,
    UNKNOWN_DRAG,
    Cell,
    Flown,
    Run,
    Table,
    cell,
    completed,
    events,
    interval,
    listed,
    outcome,
    values,
)

DEATH = events((8.0, "kill", "agent3"))
AGILE: Mapping[str, tuple[str, ...]] = {
    "200 ms delay, 30 % loss": LATE,
    "400 ms delay, 60 % loss": ("links.delay_s=0.4", "links.loss=0.6"),
    "perfect network": (),
    "one agent for all UAVs": ("agents.owned=[[1,2,3]]",),
    "5.5 m/s, 8.1 m/s², late": (*LATE, "maneuver.phase.2.speed_mps=5.5"),
    "payload 43 % heavier, estimated, late": (*LATE, ESTIMATE, f"{HEAVIER}=1.43"),
    "wind of 5 m/s, estimated, late": (*LATE, ESTIMATE, "plant.wind.speed_mps=[5.0,0.0,0.0]"),
    "agent 3 dies, late": (*LATE, *DEATH),
    "5 s without any message, late": (
        *LATE,
        "links.change=[{at_s=8.0,loss=1.0},{at_s=13.0,loss=0.3}]",
    ),
    "half the known drag, estimated, late": (*LATE, ESTIMATE, "plant.drag_factor=0.5"),
    "1.5 times the known drag, estimated, late": (*LATE, ESTIMATE, "plant.drag_factor=1.5"),
    "1.5 times the known drag, late": (*LATE, "plant.drag_factor=1.5"),
    "unknown drag, estimated, late": (*LATE, ESTIMATE, UNKNOWN_DRAG),
    "unknown drag, late": (*LATE, UNKNOWN_DRAG),
    "the engine MuJoCo, late": (*LATE, MUJOCO),
}
GAP = {
    "the scenario, 20 seeds": Run("gap", seeds=20),
    "perfect network, 5 seeds": Run("gap", ("links.delay_s=0.0", "links.loss=0.0"), seeds=5),
    "gusts of 1.5 m/s, estimated, 5 seeds": Run(
        "gap", ("plant.wind.gust_mps=[1.5,1.5,1.5]", ESTIMATE), seeds=5
    ),
}


def least(name: str) -> Cell:
    """Return the smallest distance of all seeds from the walls."""
    return cell(name, "{:.1f}", 100.0, np.min)


# The map of the claims: weights on attitude (that on positions is 1), terminal weights, horizons.
ATTITUDES, TERMINALS, HORIZONS = (0.5, 1.0, 5.0), (10.0, 50.0, 100.0), (6, 8, 10, 14)
KINDS = (("centralized", 0.05), ("paper", 0.05), ("paper", 0.04))
# "Slightly worse" and "slightly better" in the paper's claims: relative differences of the mean cost.
SLIGHTLY = (0.005, 0.1)


def kinds(attitude: float, terminal: float, horizon: int) -> list[Run]:
    """Return the runs of a point.

    Both controllers at 50 ms, the paper's at 40 ms with a horizon as long in seconds.
    """
    weights = (f"controller.weights.attitude={attitude}", f"controller.weights.terminal={terminal}")
    return [
        Run(
            name,
            (
                *weights,
                f"controller.horizon={round(horizon * 0.05 / s)}",
                f"controller.sampling_period_s={s}",
            ),
        )
        for name, s in KINDS
    ]


def ratios(place: int, *results: Flown) -> str:
    """Return the paper's costs over the centralized controller's at a horizon, bold where both claims hold.

    Args:
        place: Of the horizon among `HORIZONS`.
        results: Those of `kinds` of all horizons, one after another.
    """
    of_horizon = results[len(KINDS) * place : len(KINDS) * (place + 1)]
    centralized, same_rate, same_computation = (_cost(flown) for flown in of_horizon)
    text = ", ".join(
        "diverges" if math.isinf(cost) else f"{cost / centralized:.3f}"
        for cost in (same_rate, same_computation)
    )
    least, most = SLIGHTLY
    is_worse = least < same_rate / centralized - 1.0 <= most
    is_better = least <= 1.0 - same_computation / centralized < most
    return f"**{text}**" if is_worse and is_better else text


def _cost(flown: Flown) -> float:
    """Return the mean cost of the one run of a kind; infinite if it diverges."""
    costs = values("cost_mean", flown)
    return costs[0] if costs else math.inf


RESULTS = (
    Table(
        "claims",
        ["attitude, Q_f"],
        {
            f"{attitude:g}, {terminal:g}": [
                run for N_p in HORIZONS for run in kinds(attitude, terminal, N_p)
            ]
            for attitude, terminal in product(ATTITUDES, TERMINALS)
        },
        {f"N_p {N_p}": partial(ratios, i) for i, N_p in enumerate(HORIZONS)},
    ),
    listed(
        "gap",
        "case",
        GAP,
        {
            "completed": completed,
            "UAVs, cm": least("uav"),
            "rods, cm": least("rod"),
            "payload, cm": least("payload"),
            "worst error rms, cm": cell("payload_rms_m", "{:.2f}", 100.0, np.max),
        },
    ),
    listed(
        "fast",
        "case",
        {text: Run("eight", settings, seeds=10) for text, settings in AGILE.items()},
        {
            "completed": completed,
            "error rms, mean, cm": interval("payload_rms_m", 2, 100.0),
            "worst rms, cm": cell("payload_rms_m", "{:.2f}", 100.0, np.max),
            "largest error, cm": cell("payload_max_m", "{:.1f}", 100.0, np.max),
            "attitude, deg": cell("attitude_max_deg", "{:.1f}", of=np.max),
        },
    ),
)


# docs/record/radio.md

ON_CHANGE = "controller.share=on_change"
FLIGHTS: Mapping[str, tuple[int | None, tuple[str, ...]]] = {
    "4 UAVs, no radio": (None, ()),
    "4 UAVs, 6 Mb/s": (None, ("radio={}",)),
    "4 UAVs, 6 Mb/s, on change": (None, ("radio={}", ON_CHANGE)),
    "16 UAVs, no radio": (16, ()),
    "16 UAVs, 24 Mb/s": (16, ("radio={rate_mbps=24.0}",)),
    "16 UAVs, 6 Mb/s, on change": (16, ("radio={}", ON_CHANGE)),
    "32 UAVs, 24 Mb/s": (32, ("radio={rate_mbps=24.0}",)),
    "32 UAVs, 6 Mb/s, on change": (32, ("radio={}", ON_CHANGE)),
}
RADIO = (
    listed(
        "flights",
        "`resilient`",
        {text: Run("resilient", settings, uavs) for text, (uavs, settings) in FLIGHTS.items()},
        {
            "result": outcome,
            "mean cost": COST,
            "airtime": cell("airtime_share", "{:.1f} %", 100.0),
            "delivered": cell("air_delivered_share", "{:.1f} %", 100.0),
            "delay, 99th percentile": cell("air_delay_p99_ms", "{:.2f} ms"),
            "largest payload error": cell("payload_max_m", "{:.1f} cm", 100.0),
        },
    ),
)
