"""An agent that shares no code with the others, made from Zenoh, msgpack, numpy and docs/reference/protocol.md.

It does not know the maneuver. It keeps its rod parallel to the others', whose states are in their
plans, and its corner of the payload as high as the middle, and carries its share. It shares the
height of its UAV as own data and, if the others share theirs, keeps to their mean. `pip install
eclipse-zenoh msgpack numpy` installs all that it needs. Start all but agent 3 as in
docs/own-process.md, with `--scenario resilient`, and this in its place;
`transport validate resilient` prints the digest:

    python docs/examples/foreign_agent.py resilient DIGEST 3 7447

In lockstep plans come with the measurement; for a run in real time add the word direct.
"""

import json
import queue
import struct
import sys
import time

import msgpack
import numpy as np
import zenoh

AGENTS, VERSION, STEPS = 4, 7, 20
# Mass, inertia and hover thrust of UAV 3, and its corner of the payload.
MASS, INERTIA, THRUST, RHO = 1.5, np.array([0.029, 0.029, 0.055]), 22.0725, (-0.25, -0.25)
RHO_Z, LENGTH = -0.125, 3.2
# Gains of the loops: rods (1/s^2, 1/s), attitude (1/s^2, 1/s), height of the corner and of the UAVs (N/m).
ROD, ROD_RATE = 40.0, 20.0
ATTITUDE, RATE = 100.0, 16.0
CORNER, HEIGHT = 100.0, 20.0
AHEAD_S = 0.3  # of the corner's height that is fed back
MOST_TILT, MOST_MOMENT, MOST_FORCE = 0.3, 0.5, 10.0  # rad, N m, N

# Fields of messages behind the header, in the order of docs/reference/protocol.md.
MEASUREMENT = ("agent", "answered", "shared", "roster", "payload", "uavs", "uav_states", "inputs")
PLAN = (
    *("agent", "start_tick", "negotiation", "shared", "uavs", "uav_states", "inputs"),
    *("corrections", "status", "alone", "data", "stale"),
)


def pack(value):
    """Return an array as the protocol's extension type 1."""
    header = struct.pack("<4I", value.ndim, *value.shape, *[0] * (3 - value.ndim))
    return msgpack.ExtType(1, header + np.ascontiguousarray(value, "<f8").tobytes())


def unpack(_, data):
    """Return the array of an extension type 1."""
    axes, *shape = struct.unpack_from("<4I", data)
    return np.frombuffer(data, "<f8", offset=16).reshape(shape[:axes])


def messages(data):
    """Yield the messages in some bytes as lists, those of a bundle one by one."""
    kind, *fields = msgpack.unpackb(data[1:], ext_hook=unpack)
    if kind in ("instant", "relay"):
        for part in fields[5]:
            yield from messages(part)
    else:
        yield kind, *fields


def message(kind, *fields):
    """Return the bytes of a message."""
    return bytes([VERSION]) + msgpack.packb([kind, *fields])


def control(payload, uav, team):
    """Return the inputs that follow rods and tilt of the others, by two cascaded loops."""
    roll, pitch = payload[6:8]
    p, q = payload[9:11]
    # How far the corner will be below the middle, m.
    low = RHO[1] * (roll + AHEAD_S * p) - RHO[0] * (pitch + AHEAD_S * q)
    e, rod_rate, attitude, rate = uav.reshape(4, 3)
    e_team, rod_rate_team, attitude_team, _ = team.reshape(4, 3)
    turning = np.cross(rod_rate, e) - np.cross(rod_rate_team, e_team)
    behind = ROD * (e - e_team) + ROD_RATE * turning
    tilt = attitude_team[:2] + MASS / THRUST * np.array([behind[1], -behind[0]])
    turn = np.append(np.clip(tilt, -MOST_TILT, MOST_TILT) - attitude[:2], 0.0)
    moments = INERTIA * (ATTITUDE * turn - RATE * rate)
    force = np.clip(CORNER * low, -MOST_FORCE, MOST_FORCE)
    return np.append(THRUST + force, np.clip(moments, -MOST_MOMENT, MOST_MOMENT))


def height(payload, uav):
    """Return z of the UAV (inertial, down, m): r_z = r0_z + k' R(Theta0) (rho - l e)."""
    roll, pitch = payload[6:8]
    down = [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]
    return payload[2] + down @ (np.append(RHO, RHO_Z) - LENGTH * uav[:3])


def configuration(port, me):
    """Return Zenoh's configuration: listen at an own port, connect to those before it."""
    ports = [f"tcp/127.0.0.1:{port + i}" for i in range(2 + me)]
    return {
        "mode": "peer",
        "listen": {"endpoints": ports[-1:]},
        "connect": {"endpoints": ports[:-1]},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }


def answer(me, tick, measured, others, heights):
    """Return the fields of the plan that answers a measurement, given the others' mean states."""
    states = measured["uav_states"]
    team = np.mean(others, axis=0) if others else states[0]

    # This agent cannot tell what it will do after this tick: hover.
    inputs = np.tile([THRUST, 0.0, 0.0, 0.0], (STEPS, 1))
    inputs[0] = control(measured["payload"], states[0], team)
    z = height(measured["payload"], states[0])
    if heights:
        inputs[0, 0] += HEIGHT * (z - np.mean([z, *heights]))

    plan = {
        "agent": me,
        "start_tick": tick,
        "negotiation": 0,
        "shared": True,
        "uavs": [me],
        "uav_states": pack(states),
        "inputs": pack(inputs),
        "corrections": pack(np.zeros((0, 4))),
        "status": "solved",
        "alone": 0.0,  # no part of the inputs is by the control law of a UAV alone
        "data": pack(np.array([z])),  # own data, which classes of the user find as plan.data
        "stale": 0,  # ticks since the inputs were fresh: those of this tick are
    }
    return [plan[name] for name in PLAN]


def join(session, prefix, me, digest, inbox):
    """Take part in a run once all its processes are there; return what has to be kept until the end."""
    alive = set()

    def watch(sample):
        name = str(sample.key_expr).split("/")[3]
        if sample.kind == zenoh.SampleKind.PUT:
            alive.add(name)
        elif name == "coordinator":
            inbox.put(None)

    heard = (f"measurement/{me}", "plan/*", "instant", "control")
    kept = [session.declare_subscriber(f"{prefix}/{key}", inbox.put) for key in heard]
    tokens = session.liveliness()
    kept.append(tokens.declare_subscriber(f"{prefix}/alive/**", watch, history=True))
    kept.append(tokens.declare_token(f"{prefix}/alive/agent{me}/0/{digest}/{VERSION}"))
    while not alive >= {"coordinator", "plant", *[f"agent{i + 1}" for i in range(AGENTS)]}:
        time.sleep(0.01)
    kept.append(tokens.declare_token(f"{prefix}/ready/agent{me}/0"))
    return kept


def main(run, digest, agent, port, exchange="relayed"):
    """Take part until the run ends."""
    me = int(agent)
    prefix = f"transport/{run}"
    inbox = queue.SimpleQueue()

    config = zenoh.Config.from_json5(json.dumps(configuration(int(port), me)))
    with zenoh.open(config) as session:
        kept = join(session, prefix, me, digest, inbox)  # noqa: F841 - what is not kept ends
        for tick, measured, others, heights in measurements(me, inbox):
            plan = answer(me, tick, measured, others, heights)
            head = [f"agent{me}", 0, tick, tick]
            key = f"plan/{me}"
            data = message("plan", *head, *plan)
            if exchange == "relayed":
                data = message("answer", *head, [key], [data], me)
                key = f"answer/{me}"
            session.put(f"{prefix}/{key}", data, congestion_control=zenoh.CongestionControl.BLOCK)
        session.put(f"{prefix}/left/agent{me}", b"")


def measurements(me, inbox):
    """Yield each measurement with what the others' plans of the tick before say, until the run ends.

    That is the mean state of each one's UAVs (e, Omega, Theta, omega), and the height that each
    shares, if it does.
    """
    states = {}  # by tick and agent
    heights = {}  # by agent
    waiting = None  # a measurement whose plans are still on their way
    while (sample := inbox.get()) is not None:
        for kind, _, _, _, tick, *fields in messages(sample.payload.to_bytes()):
            if kind == "control":
                return
            if kind == "plan":
                plan = dict(zip(PLAN, fields, strict=False))
                states[tick, plan["agent"]] = plan["uav_states"].mean(axis=0)
                if plan["agent"] != me and plan.get("data") is not None and plan["data"].size == 1:
                    heights[plan["agent"]] = plan["data"][0]
            elif kind == "measurement" and fields[0] == me:
                waiting = tick, dict(zip(MEASUREMENT, fields, strict=True))

        if waiting is None:
            continue
        tick, measured = waiting
        awaited = [(tick - 1, agent) for agent in measured["shared"] if agent != me]
        if all(plan in states for plan in awaited):
            waiting = None
            yield tick, measured, [states.pop(plan) for plan in awaited], heights.values()


if __name__ == "__main__":
    main(*sys.argv[1:])
