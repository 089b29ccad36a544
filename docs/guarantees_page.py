"""Renew the measured tables of docs/guarantees.md: part of `make figures`, four minutes on two cores."""

from collections.abc import Mapping, Sequence

from simulations import Flown, Measured, Run, cost, each, renew
from tables import ROOT

from transport.experiments.cases import Team

DOCUMENT = ROOT / "docs" / "guarantees.md"

DETAILS = (
    "result",
    "mean cost",
    "payload attitude",
    "smallest distance of two UAVs",
    "largest distance of a UAV from its reference",
)


def diverges(result: Flown) -> str:
    """Return when a run diverged."""
    return f"**diverges** at {result.lost_s:.1f} s"


def attitude(result: Flown) -> str:
    """Return the largest payload attitude; empty for a run that diverged, where it has no meaning."""
    return f"{result.attitude_max_deg:.1f} deg" if result.completed else ""


def brief(result: Flown) -> str:
    """Return outcome and payload attitude in one cell."""
    return f"completes, {attitude(result)}" if result.completed else diverges(result)


def costly(result: Flown) -> str:
    """Return outcome and mean cost in one cell."""
    return f"completes, {cost(result)}" if result.completed else diverges(result)


def details(_: str, result: Flown) -> list[str]:
    """Return the cells of a run below `DETAILS`."""
    if not result.completed:
        return [f"{diverges(result)} ({result.phase})", "", "", "", ""]
    distances = (result.separation_min_m, result.uav_max_m)
    return ["completes", cost(result), attitude(result), *(f"{distance:.2f} m" for distance in distances)]


def detailed(name: str, heading: str, runs: Mapping[str, Run]) -> Measured:
    """Return a table with the details of a run in each row."""
    return Measured(name, [heading, *DETAILS], {text: [run] for text, run in runs.items()}, details)


def resilient(*settings: str) -> Run:
    """Return a run of `resilient`."""
    return Run("resilient", settings)


NETWORKS = {
    "perfect": resilient(),
    "200 ms delay": resilient("links.delay_s=0.2"),
    "30 % packet loss": resilient("links.loss=0.3"),
    "agents 1, 2 cut off from 3, 4 from 8 to 12 s": resilient(
        'links.partition=[{between=["agent1","agent2"],start_s=8.0,end_s=12.0}]'
    ),
    "no plan arrives (`links.loss=1`)": resilient("links.loss=1"),
}

KILLED_S = 8.0


def killed(
    scenario: str,
    *agents: int,
    at_s: float = KILLED_S,
    back_s: float | None = None,
    settings: tuple[str, ...] = (),
    team: Team | None = None,
) -> Run:
    """Return the run in which agents are killed and, unless `back_s` is None, restarted."""
    events = [f'{{at_s={at_s},do="kill",target="agent{agent}"}}' for agent in agents]
    if back_s is not None:
        events += [f'{{at_s={back_s},do="restart",target="agent{agent}"}}' for agent in agents]
    return Run(scenario, ("clock.on_agent_loss=continue", f"faults.event=[{','.join(events)}]", *settings), team)


BACK_S = (8.5, 9.0, 10.0, 11.0, 12.0, 14.0, 17.0)
RETURNS = {
    **{f"{back_s:g} s": killed("resilient", 3, back_s=back_s) for back_s in BACK_S},
    "never": killed("resilient", 3),
    "10 s, `paper`": killed("paper", 3, back_s=10.0),
}

DEATHS = {
    **{f"{a}, at {at_s:g} s": killed("resilient", a, at_s=at_s) for at_s in (1.0, KILLED_S, 16.0) for a in (1, 3)},
    "3 and 4 (neighbours), at 8 s": killed("resilient", 3, 4),
    "1 and 3 (opposite), at 8 s": killed("resilient", 1, 3),
    "1, 2 and 3, at 8 s": killed("resilient", 1, 2, 3),
    "3, at 8 s, `fail_safe=level`": killed("resilient", 3, settings=("controller.fail_safe=level",)),
    "1 and 3, at 8 s, `fail_safe=level`": killed("resilient", 1, 3, settings=("controller.fail_safe=level",)),
}


def failed(uavs: int, *events: tuple[float, str], settings: tuple[str, ...] = ()) -> Run:
    """Return the run of a team of some size in which UAV 3 fails."""
    text = ",".join(f'{{at_s={at_s},do="{do}",target="uav3"}}' for at_s, do in events)
    return Run("resilient", (f"faults.event=[{text}]", *settings), None if uavs == 4 else Team(uavs, 1))


OFF, RELEASED = (KILLED_S, "motor_off"), (KILLED_S, "release")
LATE_AND_LOSSY = ("links.delay_s=0.2", "links.loss=0.3")
# Runs of four, five and six UAVs.
FAILURES: Mapping[str, Sequence[Run | None]] = {
    "agent killed (`kill` agent3, `clock.on_agent_loss=continue`), motors on": [
        killed("resilient", 3),
        None,
        killed("resilient", 3, team=Team(6, 1)),
    ],
    "released at once": [failed(4, RELEASED), None, failed(6, RELEASED)],
    "the same with 200 ms delay and 30 % packet loss": [failed(4, RELEASED, settings=LATE_AND_LOSSY), None, None],
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

KNOWN: Mapping[str, str] = {
    "unknown": "",
    "unknown, `next_tick`": "clock.actuation=next_tick",
    "known": "controller.motor_lag_s={lag_s:g}",
    "assumed 50 ms": "controller.motor_lag_s=0.05",
}


def lagging(lag_s: float, known: str) -> Run:
    """Return the run with a motor lag."""
    return resilient(f"plant.motors.lag_s={lag_s:g}", *([known.format(lag_s=lag_s)] if known else []))


def degraded(share: float) -> str:
    """Return the setting of a UAV whose motors degrade."""
    return f'faults.event=[{{at_s=10.0,do="degrade",target="uav3",efficiency={share}}}]'


def actuated(_: str, *results: Flown) -> list[str]:
    """Return outcome, cost and distance; or the phase in which a run diverged."""
    return [
        f"{costly(result)}, {result.separation_min_m:.2f} m" if result.completed else details("", result)[0]
        for result in results
    ]


ROTORS = "plant.motors.rotors={{arm_m=0.25,drag_to_thrust_m=0.016,thrust_N=[0.0,{most_N:g}]}}"

TABLES = (
    detailed("network", "network", NETWORKS),
    Measured(
        "failures", ["permanent failure of UAV 3", *(f"{uavs} UAVs" for uavs in (4, 5, 6))], FAILURES, each(brief)
    ),
    Measured(
        "instants",
        ["motors off at", "during", "result"],
        {(f"{s:g} s", where): [failed(6, (s, "motor_off"), settings=(SHORT,))] for s, where in INSTANTS.items()},
        each(brief),
    ),
    detailed("deaths", "agent killed", DEATHS),
    detailed("returns", "restarted at", RETURNS),
    Measured(
        "actuation",
        ["`transport run resilient --set`", "`immediate`", "`next_tick`"],
        {
            f"`{setting}`": [resilient(setting), resilient(setting, "clock.actuation=next_tick")]
            for setting in ("links.actuation.delay_s=0.05", "links.actuation.delay_s=0.1", "links.actuation.loss=0.3")
        },
        actuated,
    ),
    Measured(
        "lags",
        ["`plant.motors.lag_s`", *KNOWN],
        {
            f"{1e3 * lag_s:g} ms": [lagging(lag_s, known) for known in KNOWN.values()]
            for lag_s in (0.02, 0.03, 0.035, 0.04, 0.05, 0.1)
        },
        each(costly),
    ),
    Measured(
        "degraded",
        ["efficiency of UAV 3 from 10 s on", "no estimate", "estimate"],
        {
            f"{share:g}": [
                resilient(degraded(share)),
                resilient(degraded(share), "controller.disturbance.estimate=true"),
            ]
            for share in (0.9, 0.8, 0.6, 0.4)
        },
        each(lambda result: f"{costly(result)}, {attitude(result)}".rstrip(", ")),
    ),
    detailed(
        "limited",
        "motors",
        {
            **{
                f"rotors with at most {most_N:g} N": resilient(ROTORS.format(most_N=most_N))
                for most_N in (12.0, 6.0, 5.8, 5.7)
            },
            **{
                f"thrust in steps of {step_N:g} N": resilient(f"plant.motors.thrust_step_N={step_N:g}")
                for step_N in (0.1, 1.0, 8.0)
            },
        },
    ),
)


if __name__ == "__main__":
    renew(DOCUMENT, TABLES)
