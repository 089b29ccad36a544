"""Renew the measured tables of docs/guarantees.md, or those named as arguments: part of `make figures`, ten minutes."""

from collections.abc import Mapping, Sequence

import numpy as np
from simulations import (
    ATTITUDE,
    COST,
    Run,
    Table,
    cell,
    completed,
    events,
    grid,
    listed,
    outcome,
    renew,
    unless_diverged,
)

DISTANCE = cell("separation_min_m", "{:.2f} m", of=np.min)
DETAILS = {
    "result": outcome,
    "mean cost": COST,
    "payload attitude": ATTITUDE,
    "smallest distance of two UAVs": DISTANCE,
    "largest distance of a UAV from its reference": cell("uav_max_m", "{:.2f} m"),
}


def resilient(*settings: str) -> Run:
    """Return a run of `resilient`."""
    return Run("resilient", settings)


LATE = ("links.delay_s=0.2", "links.loss=0.3")
NETWORKS = {
    "perfect": resilient(),
    "200 ms delay": resilient("links.delay_s=0.2"),
    "30 % packet loss": resilient("links.loss=0.3"),
    "agents 1, 2 cut off from 3, 4 from 8 to 12 s": resilient(
        'links.partition=[{between=["agent1","agent2"],start_s=8.0,end_s=12.0}]'
    ),
    "no plan arrives (`links.loss=1`)": resilient("links.loss=1"),
}


def killed(*agents: int, at_s: float = 8.0, back_s: float | None = None, scenario: str = "resilient") -> Run:
    """Return the run in which agents are killed and, unless `back_s` is None, restarted."""
    lost = [(at_s, "kill", f"agent{agent}") for agent in agents]
    return Run(scenario, events(*lost, *((back_s, "restart", target) for _, _, target in lost if back_s is not None)))


RETURNS = {
    **{f"{back_s:g} s": killed(3, back_s=back_s) for back_s in (8.5, 9.0, 10.0, 11.0, 12.0, 14.0, 17.0)},
    "never": killed(3),
    "10 s, `paper`": killed(3, back_s=10.0, scenario="paper"),
}


def also(run: Run, *settings: str) -> Run:
    """Return a run with further settings."""
    return run._replace(settings=(*run.settings, *settings))


LEVEL = "controller.fail_safe=level"
DEATHS = {
    **{f"{a}, at {at_s:g} s": killed(a, at_s=at_s) for at_s in (1.0, 8.0, 16.0) for a in (1, 3)},
    "3 and 4 (neighbours), at 8 s": killed(3, 4),
    "1 and 3 (opposite), at 8 s": killed(1, 3),
    "1, 2 and 3, at 8 s": killed(1, 2, 3),
    "3, at 8 s, `fail_safe=level`": also(killed(3), LEVEL),
    "1 and 3, at 8 s, `fail_safe=level`": also(killed(1, 3), LEVEL),
}


def failed(uavs: int, *given: tuple[float, str], settings: tuple[str, ...] = ()) -> Run:
    """Return the run of a team of some size in which UAV 3 fails."""
    _, faults = events(*((at_s, do, "uav3") for at_s, do in given))
    return Run("resilient", (faults, *settings), None if uavs == 4 else uavs)


OFF, RELEASED = (8.0, "motor_off"), (8.0, "release")
# Runs of four, five and six UAVs.
FAILURES: Mapping[str, Sequence[Run | None]] = {
    "agent killed (`kill` agent3, `clock.on_agent_loss=continue`), motors on": [
        killed(3),
        None,
        killed(3)._replace(uavs=6),
    ],
    "released at once": [failed(4, RELEASED), None, failed(6, RELEASED)],
    "the same with 200 ms delay and 30 % packet loss": [failed(4, RELEASED, settings=LATE), None, None],
    "motors off, released 0.1 s later": [failed(4, OFF, (8.1, "release")), None, None],
    "motors off, released 0.5 s later": [failed(4, OFF, (8.5, "release")), None, None],
    "motors off, never released": [failed(uavs, OFF) for uavs in (4, 5, 6)],
    "the same with 100 ms delay": [None, None, failed(6, OFF, settings=("links.delay_s=0.1",))],
}

SHORT = (
    'maneuver.phase=[{name="hover",duration_s=1.0,displacement_m=[0,0,0]},'
    '{name="climb",duration_s=3.0,displacement_m=[0,0,-1.5]},{name="translate",duration_s=3.0,displacement_m=[1.5,0,0]},'
    '{name="hover",duration_s=2.5,displacement_m=[0,0,0]}]'
)
INSTANTS: Mapping[float, str] = {
    0.9: "hover",
    2.0: "climb",
    3.5: "climb",
    4.0: "change from climb to translation",
    5.0: "translation",
    7.0: "change from translation to hover",
    7.5: "swing after the translation",
}

NEXT = "clock.actuation=next_tick"
ACTUATION = ("links.actuation.delay_s=0.05", "links.actuation.delay_s=0.1", "links.actuation.loss=0.3")
KNOWN: Mapping[str, tuple[str, ...]] = {
    "unknown": (),
    "unknown, `next_tick`": (NEXT,),
    "known": ("controller.motor_lag_s={lag_s:g}",),
    "assumed 50 ms": ("controller.motor_lag_s=0.05",),
}


def lagging(lag_s: float, known: tuple[str, ...]) -> Run:
    """Return the run with a motor lag."""
    return resilient(f"plant.motors.lag_s={lag_s:g}", *(setting.format(lag_s=lag_s) for setting in known))


def degraded(share: float, *settings: str) -> Run:
    """Return the run of a UAV whose motors degrade."""
    return resilient(f'faults.event=[{{at_s=10.0,do="degrade",target="uav3",efficiency={share}}}]', *settings)


ROTORS = "plant.motors.rotors={{arm_m=0.25,drag_to_thrust_m=0.016,thrust_N=[0.0,{:g}]}}"
LIMITED = {
    **{f"rotors with at most {most_N:g} N": resilient(ROTORS.format(most_N)) for most_N in (12.0, 6.0, 5.8, 5.7)},
    **{
        f"thrust in steps of {step_N:g} N": resilient(f"plant.motors.thrust_step_N={step_N:g}")
        for step_N in (0.1, 1.0, 8.0)
    },
}


def two_deaths(uavs: int, number: int) -> Run:
    """Return the run in which two random agents die.

    The first dies at any time from 1 s to 20 s, the second some seconds later (exponential, mean 3 s).
    """
    draw = np.random.default_rng([7, uavs, number])
    agents = draw.choice(uavs, 2, replace=False) + 1
    first_s = draw.uniform(1.0, 20.0)
    times_s = np.minimum((first_s, first_s + draw.exponential(3.0)), 23.0)
    at_s = [round(round(time_s / 0.05) * 0.05, 3) for time_s in times_s]
    return Run("resilient", events(*((t, "kill", f"agent{a}") for a, t in zip(agents, at_s, strict=True))), uavs)


TEAMS = {
    f"{uavs} UAVs, {network}": [also(two_deaths(uavs, number), *settings) for number in range(30)]
    for uavs in (4, 6)
    for network, settings in {"perfect network": (), "200 ms delay, 30 % packet loss": LATE}.items()
}

PAGES = {
    "guarantees.md": (
        listed("network", "network", NETWORKS, DETAILS),
        grid(
            "failures",
            ["permanent failure of UAV 3"],
            [f"{uavs} UAVs" for uavs in (4, 5, 6)],
            FAILURES,
            unless_diverged(ATTITUDE),
        ),
        Table(
            "instants",
            ["motors off at", "during"],
            {(f"{s:g} s", where): [failed(6, (s, "motor_off"), settings=(SHORT,))] for s, where in INSTANTS.items()},
            {"payload attitude": unless_diverged(ATTITUDE)},
        ),
        listed("deaths", "agent killed", DEATHS, DETAILS),
        listed("returns", "restarted at", RETURNS, DETAILS),
        Table(
            "two_deaths",
            ["team"],
            TEAMS,
            {
                "complete": completed,
                "payload attitude, median": cell("attitude_max_deg", "{:.1f} deg", of=np.median),
                "largest": ATTITUDE,
                "smallest distance of two UAVs, median": cell("separation_min_m", "{:.2f} m", of=np.median),
                "least": DISTANCE,
            },
        ),
        grid(
            "actuation",
            ["`transport run resilient --set`"],
            ["`immediate`", "`next_tick`"],
            {f"`{setting}`": [resilient(setting), resilient(setting, NEXT)] for setting in ACTUATION},
            unless_diverged(COST, DISTANCE),
        ),
        grid(
            "lags",
            ["`plant.motors.lag_s`"],
            list(KNOWN),
            {
                f"{1e3 * lag_s:g} ms": [lagging(lag_s, known) for known in KNOWN.values()]
                for lag_s in (0.02, 0.03, 0.035, 0.04, 0.05, 0.1)
            },
            unless_diverged(COST),
        ),
        grid(
            "degraded",
            ["efficiency of UAV 3 from 10 s on"],
            ["no estimate", "estimate"],
            {
                f"{share:g}": [degraded(share), degraded(share, "controller.disturbance.estimate=true")]
                for share in (0.9, 0.8, 0.6, 0.4)
            },
            unless_diverged(COST, ATTITUDE),
        ),
        listed("limited", "motors", LIMITED, DETAILS),
    )
}

if __name__ == "__main__":
    renew(PAGES)
