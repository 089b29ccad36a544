"""Measured tables of docs/record/guarantees.md: networks, deaths, returns, outages of sensors, failed UAVs."""

import numpy as np
from table_rows_and_cells import (
    ATTITUDE,
    COST,
    Run,
    cell,
    events,
    grid,
    listed,
    outcome,
    unless_diverged,
)

from transport.experiments.weather_experiment import SENSORS

DETAILS = {
    "result": outcome,
    "mean cost": COST,
    "payload attitude": ATTITUDE,
    "smallest distance of two UAVs": cell("separation_min_m", "{:.2f} m", of=np.min),
    "largest distance of a UAV from its reference": cell("uav_max_m", "{:.2f} m"),
}

NETWORKS = {
    "perfect": (),
    "200 ms delay": ("links.delay_s=0.2",),
    "30 % packet loss": ("links.loss=0.3",),
    "agents 1, 2 cut off from 3, 4 from 8 to 12 s": (
        'links.partition=[{between=["agent1","agent2"],start_s=8.0,end_s=12.0}]',
    ),
    "no plan arrives (`links.loss=1`)": ("links.loss=1",),
}


def killed(*agents: int, at_s: float = 8.0, settings: tuple[str, ...] = ()) -> Run:
    """Return the run in which agents are killed for good."""
    return Run(
        "resilient", (*events(*((at_s, "kill", f"agent{agent}") for agent in agents)), *settings)
    )


def returning(at_s: float, scenario: str = "resilient") -> Run:
    """Return the run in which agent 3 is killed at 8 s and restarted."""
    return Run(scenario, events((8.0, "kill", "agent3"), (at_s, "restart", "agent3")))


def failed(uavs: int, **actions_s: float) -> Run:
    """Return the run of a team of some size in which UAV 3 fails."""
    return Run(
        "resilient",
        events(*((s, do, "uav3") for do, s in actions_s.items())),
        None if uavs == 4 else uavs,
    )


LEVEL = ("controller.fail_safe=level",)
DEATHS = {
    **{f"3, at {at_s:g} s": killed(3, at_s=at_s) for at_s in (1.0, 8.0, 16.0)},
    "3 and 4 (neighbours), at 8 s": killed(3, 4),
    "1 and 3 (opposite), at 8 s": killed(1, 3),
    "1, 2 and 3, at 8 s": killed(1, 2, 3),
    "3, at 8 s, `fail_safe=level`": killed(3, settings=LEVEL),
    "1 and 3, at 8 s, `fail_safe=level`": killed(1, 3, settings=LEVEL),
}
RETURNS = {
    **{f"{back_s:g} s": returning(back_s) for back_s in (8.5, 9.0, 10.0, 12.0, 17.0)},
    "never": killed(3),
    "10 s, `paper`": returning(10.0, "paper"),
}


def without(sensors: tuple[str, ...], uavs: tuple[int, ...], lasting_s: float | None) -> Run:
    """Return the run of `precise` with a filter in which sensors of UAVs fail at 8 s."""
    lasting = "" if lasting_s is None else f",duration_s={lasting_s}"
    names = ",".join(f'"{sensor}"' for sensor in sensors)
    outages = [
        f"{{at_s=8.0,do='sensors_off',target='uav{uav}',sensors=[{names}]{lasting}}}"
        for uav in uavs
    ]
    return Run("precise", (*SENSORS, f"faults.event=[{','.join(outages)}]"))


TEAM = (1, 2, 3, 4)
NAVIGATION = ("position", "velocity")
OUTAGES = {
    "none": Run("precise", SENSORS),
    "position of UAV 2, 10 s": without(("position",), (2,), 10.0),
    "position of UAV 2, for good": without(("position",), (2,), None),
    "position of UAV 2 to 4, for good": without(("position",), (2, 3, 4), None),
    "position and velocity of UAV 2, for good": without(NAVIGATION, (2,), None),
    "position of all, 3 s": without(("position",), TEAM, 3.0),
    "position and velocity of all, 3 s": without(NAVIGATION, TEAM, 3.0),
    "attitude of UAV 2, for good": without(("attitude",), (2,), None),
    "body rates of UAV 2, for good": without(("rate",), (2,), None),
    "specific force of UAV 2, for good": without(("specific_force",), (2,), None),
    "all sensors of UAV 2, for good": without(
        (*NAVIGATION, "attitude", "rate", "specific_force"), (2,), None
    ),
}
# Runs of four, five and six UAVs.
FAILURES = {
    "released at once": [failed(4, release=8.0), None, failed(6, release=8.0)],
    "motors off, released 0.1 s later": [failed(4, motor_off=8.0, release=8.1), None, None],
    "motors off, released 0.5 s later": [failed(4, motor_off=8.0, release=8.5), None, None],
    "motors off, never released": [failed(uavs, motor_off=8.0) for uavs in (4, 5, 6)],
}
GUARANTEES = (
    listed(
        "network",
        "network",
        {text: Run("resilient", settings) for text, settings in NETWORKS.items()},
        DETAILS,
    ),
    grid(
        "failures",
        ["permanent failure of UAV 3"],
        [f"{uavs} UAVs" for uavs in (4, 5, 6)],
        FAILURES,
        unless_diverged(ATTITUDE),
    ),
    listed("killed", "agent killed", DEATHS, DETAILS),
    listed("returns", "restarted at", RETURNS, DETAILS),
    listed(
        "outages",
        "sensors that fail at 8 s",
        OUTAGES,
        {
            "result": outcome,
            "payload error": cell("payload_rms_m", "{:.1f} cm rms", 100.0),
            "payload attitude": ATTITUDE,
        },
    ),
)
