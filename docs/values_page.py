"""Renew the measured tables of docs/values.md, docs/scenario.md and docs/time.md, or those named as arguments.

Part of `make figures`, four minutes on two cores.
"""

from functools import partial

import numpy as np
from simulations import COST, Run, cell, completed, grid, listed, renew, unless_diverged

IMPAIRED = ("links.delay_s=0.1", "links.loss=0.3")
COMPARED = ("paper", "centralized", "resilient", "centralized_lq", "precise")
ESTIMATE = "controller.disturbance.estimate=true"

ATTITUDE = cell("attitude_max_deg", "{:.2f} deg")
SWING = cell("swing_m", "{:.1f} cm", 100.0)
DISTANCE = cell("separation_min_m", "{:.3f} m", of=np.min)
PAYLOAD_RMS = cell("payload_rms_m", "{:.1f} cm", 100.0)

WEIGHTS = (
    "controller.weights.attitude=0.5",
    "controller.weights.attitude=50",
    "controller.weights.acceleration=5e-4",
    "controller.weights.acceleration=5e-2",
    "controller.weights.angular_acceleration=1.7e-4",
    "controller.weights.angular_acceleration=1.7e-2",
    "controller.weights.terminal=1",
    "controller.weights.terminal=25",
    "controller.horizon=5",
    "controller.horizon=10",
    "controller.horizon=30",
    "maneuver.profile=min_jerk",
    "maneuver.profile=step",
)


def changed(setting: str) -> list[Run | None]:
    """Return the runs with one setting changed in `paper` and `resilient`; None where it has no effect."""
    without_effect = setting.startswith("controller.weights.terminal")  # `resilient` has the cost-to-go
    return [Run("paper", (setting,)), None if without_effect else Run("resilient", (setting,))]


PLANTS = {"15 % more payload": "plant.payload_mass_factor=1.15", "wind of 5 m/s": "plant.wind.speed_mps=[5,0,0]"}
STILL = "maneuver.phase=[{name='hover',duration_s=20,displacement_m=[0,0,0]}]"
ESTIMATES = {
    "without estimate": (),
    "with estimate": (ESTIMATE,),
    "with estimate, 100 ms delay, 30 % loss": (ESTIMATE, *IMPAIRED),
}

PENALTIES = ("separation.penalty", "constraint.1.penalty", "constraint.2.penalty")
COLLISION = {
    "as it is": (),
    "`controller.separation.minimum_m=0.001`": ("controller.separation.minimum_m=0.001",),
    "`agents.owned=[[1,2,3,4]]`": ("agents.owned=[[1,2,3,4]]",),
    "all three penalties 60": tuple(f"controller.{key}=60" for key in PENALTIES),
}

windy = partial(Run, "windy", seeds=8)
WINDY = {
    "as it is, 16 seeds": Run("windy", seeds=16),
    "as it is": windy(),
    "without the estimate": windy(("controller.disturbance.estimate=false",)),
    "100 ms delay, 30 % loss": windy(IMPAIRED),
    "a tenth of the weight on moments": windy(("controller.weights.angular_acceleration=1.7e-4",)),
    "open-loop prediction": windy(
        ("controller.prediction=open_loop", "controller.terminal=multiple", "controller.preview=false")
    ),
}

VALUES = (
    listed(
        "follows",
        "",
        {f"`{name}`": Run(name) for name in COMPARED},
        {
            "cost, mean": COST,
            "largest": cell("cost_max"),
            "payload attitude": ATTITUDE,
            "UAV error, rms": cell("uav_rms_m", "{:.1f} cm", 100.0),
            "payload error, rms": PAYLOAD_RMS,
            "largest payload error": cell("payload_max_m", "{:.1f} cm", 100.0),
            "the same in the last 4 s": SWING,
            "smallest distance of two UAVs": DISTANCE,
        },
    ),
    grid(
        "weights",
        ["`--set`"],
        ["`paper`", "`resilient`"],
        {"nothing": [Run("paper"), Run("resilient")], **{f"`{setting}`": changed(setting) for setting in WEIGHTS}},
        unless_diverged(ATTITUDE, cell("swing_m", "{:.0f} cm", 100.0)),
    ),
    listed(
        "hover",
        "",
        {f"`{name}`": Run(name, ("maneuver.phase.5.duration_s=60",)) for name in COMPARED},
        {"payload attitude, payload error in the last 4 s": unless_diverged(ATTITUDE, SWING)},
    ),
    grid(
        "plant_state",
        [""],
        list(ESTIMATES),
        {
            text: [Run("resilient", (STILL, setting, *changes)) for changes in ESTIMATES.values()]
            for text, setting in PLANTS.items()
        },
        unless_diverged(cell("uav_last_m", "{:.2f} cm", 100.0), COST),
    ),
    listed(
        "collision",
        "",
        {text: Run("collision", settings) for text, settings in COLLISION.items()},
        {"smallest distance": DISTANCE, "front pair, largest x": cell("front_m", "{:.3f} m"), "attitude": ATTITUDE},
    ),
    listed(
        "windy",
        "",
        WINDY,
        {
            "completed": completed,
            "attitude, mean": ATTITUDE,
            "largest": cell("attitude_max_deg", "{:.2f} deg", of=np.max),
            "mean cost": cell("cost_mean", "{:.2f}"),
            "smallest distance": cell("separation_min_m", "{:.2f} m", of=np.min),
            "largest swing": cell("swing_m", "{:.2f} m", of=np.max),
        },
    ),
)

TERM = "controller.cost=[{expression='v0[0]',weight=0.1}]"
TERMS = {
    "`resilient`": Run("resilient"),
    "`resilient` with the term": Run("resilient", (TERM,)),
    "`precise`": Run("precise"),
}


def team(uavs: int) -> list[Run | None]:
    """Return the runs of a team size: without delay, with it, and those of the paper's algorithm up to eight UAVs."""
    resilient = partial(Run, "resilient", uavs=uavs)
    return [resilient(), resilient(("links.delay_s=0.1",)), Run("paper", (), uavs) if uavs <= 8 else None]


SCENARIO = (
    listed(
        "terms",
        "",
        TERMS,
        {"payload error, last 4 s": SWING, "payload error, rms": PAYLOAD_RMS, "mean cost of (21)": COST},
    ),
    grid(
        "teams",
        ["UAVs"],
        ["without delay", "0.1 s", "`--from paper`"],
        {str(uavs): team(uavs) for uavs in (2, 3, 4, 6, 8, 12)},
        unless_diverged(COST, ATTITUDE),
    ),
)


def negotiating(scenario: str, count: int) -> Run | None:
    """Return the run with a number of iterations, without a setting for the default."""
    if count == 1:
        return Run(scenario)
    return None if scenario == "centralized" else Run(scenario, (f"controller.negotiation_iterations={count}",))


SCENARIOS = ("paper", "resilient", "centralized")
TIME = (
    grid(
        "negotiation_iterations",
        ["iterations"],
        [f"`{name}`" for name in SCENARIOS],
        {str(count): [negotiating(name, count) for name in SCENARIOS] for count in (1, 2, 4)},
        unless_diverged(COST, ATTITUDE),
    ),
)

PAGES = {"values.md": VALUES, "scenario.md": SCENARIO, "time.md": TIME}

if __name__ == "__main__":
    renew(PAGES)
