"""One valid message of every kind, as the fields it is built from."""

from typing import Any

import numpy as np

from protocol.wire.messages import (
    KINDS,
    STAGES,
    Control,
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    Plan,
    PlantState,
    Rejected,
    Roster,
    StepReport,
    Tick,
)

HEAD: dict[str, Any] = {"incarnation": 1, "sequence": 7, "tick": 3}


def fields(kind: type[Message]) -> dict[str, Any]:
    """Valid fields of a message class, fresh on every call."""
    states, inputs = np.arange(24.0).reshape(2, 12), np.arange(8.0).reshape(2, 4)
    own: dict[type[Message], dict[str, Any]] = {
        Tick: {
            "sender": "coordinator",
            "members": (1, 2),
            "answered": (2,),
            "shared": (2,),
            "roster": 3,
            "late_ns": 50_000,
            "overrun_ns": 1_200_000,
        },
        Roster: {
            "sender": "coordinator",
            "version": 2,
            "agents": (1, 3),
            "incarnations": (0, 5),
            "off": (2, 3),
            "released": (3,),
            "reason": "ready",
        },
        LinkChange: {
            "sender": "coordinator",
            "number": 2,
            "source": "agent1",
            "target": "",
            "settings": '{"delay_s": 0.1}',
        },
        Measurement: {
            "sender": "plant",
            "agent": 2,
            "answered": (1, 2),
            "shared": (1,),
            "roster": 3,
            "payload": np.arange(12.0),
            "uavs": (2, 4),
            "uav_states": states,
            "inputs": inputs,
        },
        Plan: {
            "sender": "agent2",
            "agent": 2,
            "start_tick": 4,
            "negotiation": 1,
            "shared": True,
            "uavs": (2, 4),
            "uav_states": states,
            "inputs": np.arange(24.0).reshape(3, 8),
            "corrections": np.arange(24.0).reshape(3, 8) / 8.0,
            "status": "solved",
        },
        StepReport: {
            "sender": "agent2",
            "agent": 2,
            "status": "limit",
            "solver": "daqp",
            "fallback": True,
            "iterations": 12,
            "residual": 1e-9,
            "peers": (1, 3),
            "plan_ages": (1, -1),
            "state_ages": (2, -1),
            "measurement_age": 1,
            "delivered": 2,
            "lost": 1,
            "late": 1,
            "force": np.array([0.5, -1.0, 4.4]),
            "times_ms": np.arange(float(len(STAGES))),
        },
        PlantState: {
            "sender": "plant",
            "x": np.arange(36.0),
            "u": np.arange(8.0),
            "plan_ticks": (3, -2),
            "local_error": 1e-12,
            "diverged": "",
        },
        FaultNote: {"sender": "recorder", "target": "agent3", "what": "killed", "origin": "person"},
        Rejected: {
            "sender": "agent2",
            "offender": "agent3",
            "reason": "not_finite",
            "count": 3,
            "example": "inputs: expected finite numbers, got nan",
        },
        Control: {"sender": "coordinator", "outcome": "aborted", "reason": "agent1 is gone", "exit_code": 4},
    }
    return HEAD | own[kind]


def sample(kind: type[Message], **changes: Any) -> Message:
    """A valid message, some of its fields changed."""
    return kind(**fields(kind) | changes)


def samples() -> list[Message]:
    """One of every kind."""
    return [sample(kind) for kind in KINDS.values()]
