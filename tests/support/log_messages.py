"""Messages with numbers known in advance, of which tests of the analysis compose a log."""

from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec.structs import replace

from tests.support import runs
from transport.agent.estimation.estimate_notes import NAMES, POSE
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.radio.frames import FrameResult
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import (
    STAGES,
    UNREPORTED,
    Airtime,
    Note,
    PlantState,
    StepReport,
    agent_name,
)

# Times of the stages of a step, ms. No two are equal, so that no stage passes for another. The
# total is that of the computation: estimate to solve.
STAGE_TIMES_MS = {
    "wait": 0.6,
    "estimate": 0.1,
    "linearise": 0.2,
    "discretise": 0.3,
    "condense": 0.4,
    "solve": 0.5,
    "publish": 0.7,
    "total": 1.5,
}

# Error of each entry of an estimated payload pose, m or rad, and its standard deviation.
POSE_ERROR = 0.1
# Squared innovation of the measurements of a tick, in units of its covariance, and their number:
# 2 each.
SQUARED_INNOVATION = 30.0
MEASUREMENTS = 15.0

# Instants of a plan on the radio, s after the tick of the plan.
SENT_S = 0.001
ARRIVED_S = 0.003


def report(run: Setup, agent: int, tick: int, **fields: Any) -> StepReport:
    """Return an agent's report of a successful step on a perfect network, with other `fields` if given.

    Every tick has the plans of the others from the tick before; the first has none.
    """
    peers = tuple(other for other in run.agents if other != agent)
    is_first = tick == 0
    age = -1 if is_first else 1

    usual: dict[str, Any] = {
        "status": "solved",
        "solver": "daqp",
        "fallback": False,
        "iterations": 2,
        "residual": 1e-12,
        "peers": peers,
        "plan_ages": (age,) * len(peers),
        "state_ages": (age,) * len(peers),
        "measurement_age": 0,
        "delivered": 0 if is_first else len(peers),
        "lost": 0,
        "late": 0,
        "force": np.zeros(3),
        "times_ms": np.array([STAGE_TIMES_MS[stage] for stage in STAGES]),
    }
    return StepReport(
        sender=agent_name(agent),
        incarnation=runs.INCARNATION,
        sequence=2 * tick + 1,  # directly after the plan of the tick, `runs.plan`
        tick=tick,
        agent=agent,
        **(usual | fields),
    )


def on_reference(
    run: Setup, tick: int, change: Callable[[Array, Array], None] = lambda x, u: None
) -> PlantState:
    """Return the plant state of a team on its reference at hover inputs, after `change` of x and u in place."""
    x = run.hover.x.copy()
    x[state.R0] += _reference_displacement(run, tick)
    u = run.hover.u.copy()
    change(x, u)
    return replace(runs.plant_state(run, tick), x=x, u=u)


def estimate_note(run: Setup, agent: int, tick: int) -> Note:
    """Return a Kalman filter's note whose payload pose is `POSE_ERROR` off the reference in every entry."""
    pose = np.concatenate([run.hover.x[state.R0], run.hover.x[state.THETA0]])
    pose[:3] += _reference_displacement(run, tick)
    covariance = POSE_ERROR**2 * np.eye(len(POSE))
    upper_triangle = covariance[np.triu_indices(len(POSE))]
    innovation = [SQUARED_INNOVATION, MEASUREMENTS]

    # In the order of NAMES.
    values = np.concatenate([pose + POSE_ERROR, upper_triangle, innovation])
    return Note(
        sender=agent_name(agent),
        incarnation=runs.INCARNATION,
        sequence=tick,
        tick=tick,
        agent=agent,
        problem="",
        names=NAMES,
        values=values,
    )


def radio_report(run: Setup, tick: int) -> Airtime:
    """Return the coordinator's report that agent 1's last plan reached agent 2 and was lost at agent 3.

    For the other agents nothing is reported of it.
    """
    arrivals = np.full((1, len(run.agents)), UNREPORTED)
    arrivals[0, run.agents.index(2)] = ARRIVED_S
    arrivals[0, run.agents.index(3)] = -float(FrameResult.COLLISION)
    return Airtime(
        sender="coordinator",
        incarnation=0,
        sequence=tick,
        tick=tick,
        negotiation=0,
        agents=(1,),
        plan_ticks=(tick - 1,),
        exchanges=(0,),
        receivers=run.agents,
        sent=np.array([SENT_S]),
        arrivals=arrivals,
        busy_s=0.002,
        transmissions=1,
        repetitions=0,
    )


def _reference_displacement(run: Setup, tick: int) -> Array:
    """Return the reference position of the payload at a tick relative to the hover at the origin, (3,), m."""
    times_s = np.array([tick * run.settings.sampling_period_s])
    positions, *_ = run.maneuver.path(times_s)
    return np.asarray(positions[0])
