"""Renew the tables of fast flight, a gap and the paper's claims in docs/results.md.

Part of `make figures`, ten minutes on two cores; arguments name some of the tables. Seeds draw noise, delays, losses
and gusts.
"""

import math
from collections.abc import Mapping
from functools import partial
from itertools import product

import numpy as np
from simulations import Cell, Flown, Run, Table, cell, completed, events, listed, renew, values

from transport.experiments.comparison import grade

LATE = ("links.delay_s=0.2", "links.loss=0.3")
ESTIMATE = "controller.disturbance.estimate=true"


def uav(number: int, x_m: float, y_m: float) -> str:
    """Return a UAV of four; the fourth is above the payload, which the others can carry without it."""
    place = f"rho_m=[{x_m},{y_m},-0.05],rod_length_m=1.0"
    return f"{{id={number},mass_kg=0.6,inertia_kgm2=[0.003,0.003,0.005],{place}}}"


PLACES = [(0.4, 0.0), (-0.2, 0.35), (-0.2, -0.35), (0.0, 0.0)]
FOUR = (
    f"system.uav=[{','.join(uav(number, *place) for number, place in enumerate(PLACES, start=1))}]",
    "agents.owned=[[1],[2],[3],[4]]",
)


def faults(**targets: str) -> tuple[str, ...]:
    """Return settings of faults from the middle of the second lap on, a second apart."""
    return events(*((8.0 + i, do, target) for i, (do, target) in enumerate(targets.items())))


AGILE: Mapping[str, tuple[str, ...]] = {
    "200 ms delay, 30 % loss": LATE,
    "400 ms delay, 60 % loss": ("links.delay_s=0.4", "links.loss=0.6"),
    "perfect network": (),
    "one agent for all UAVs": ("agents.owned=[[1,2,3]]",),
    "5.5 m/s, 8.1 m/s², late": (*LATE, "maneuver.phase.2.speed_mps=5.5"),
    "payload 43 % heavier, estimated, late": (*LATE, ESTIMATE, "plant.payload_mass_factor=1.43"),
    "wind of 5 m/s, estimated, late": (*LATE, ESTIMATE, "plant.wind.speed_mps=[5.0,0.0,0.0]"),
    "agent 3 dies, late": (*LATE, *faults(kill="agent3")),
    "agent 3 of four dies, late": (*LATE, *FOUR, *faults(kill="agent3")),
    "UAV 4 of four is released, late": (*LATE, *FOUR, *faults(release="uav4")),
    "the same, then agent 2 dies": (*LATE, *FOUR, *faults(release="uav4", kill="agent2")),
}
GAP: Mapping[str, Run] = {
    "the scenario, 20 seeds": Run("gap", seeds=20),
    "perfect network, 5 seeds": Run("gap", ("links.delay_s=0.0", "links.loss=0.0"), seeds=5),
    "gusts of 1.5 m/s, estimated, 5 seeds": Run("gap", ("plant.wind.gust_mps=[1.5,1.5,1.5]", ESTIMATE), seeds=5),
}


def least(name: str) -> Cell:
    """Return the smallest distance of all seeds from the walls."""
    return cell(name, "{:.1f}", 100.0, np.min)


# The map of the claims: weights on attitude (that on positions is 1), terminal weights, horizons.
ATTITUDES, TERMINALS, HORIZONS = (0.5, 1.0, 5.0), (10.0, 50.0, 100.0), (6, 8, 10, 14)
KINDS = (("centralized", 0.05), ("paper", 0.05), ("paper", 0.04))


def kinds(attitude: float, terminal: float, horizon: int) -> list[Run]:
    """Return the runs of a point: both controllers at 50 ms, the paper's at 40 ms with a horizon as long in seconds."""
    weights = (f"controller.weights.attitude={attitude}", f"controller.weights.terminal={terminal}")
    return [
        Run(
            scenario,
            (*weights, f"controller.horizon={round(horizon * 0.05 / s)}", f"controller.sampling_period_s={s}"),
        )
        for scenario, s in KINDS
    ]


def ratios(index: int, *results: Flown) -> str:
    """Return the paper's costs over that of the centralized controller, bold where both claims hold."""
    (reference,), *own = (values("cost_mean", flown) for flown in results[len(KINDS) * index :][: len(KINDS)])
    found = [costs[0] / reference if costs else math.inf for costs in own]
    text = ", ".join("diverges" if ratio == math.inf else f"{ratio:.3f}" for ratio in found)
    return f"**{text}**" if [grade(ratio) for ratio in found] == ["slightly worse", "slightly better"] else text


PAGES = {
    "results.md": (
        Table(
            "claims",
            ["attitude, Q_f"],
            {
                f"{attitude:g}, {terminal:g}": [run for N_p in HORIZONS for run in kinds(attitude, terminal, N_p)]
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
                "error rms, mean, cm": cell("payload_rms_m", "{:.2f}", 100.0),
                "worst rms, cm": cell("payload_rms_m", "{:.2f}", 100.0, np.max),
                "largest error, cm": cell("payload_max_m", "{:.1f}", 100.0, np.max),
                "attitude, deg": cell("attitude_max_deg", "{:.1f}", of=np.max),
            },
        ),
    ),
}

if __name__ == "__main__":
    renew(PAGES)
