"""An agent that shares no code with the others: Zenoh, msgpack and docs/protocol.md are enough.

It keeps its rod upright and carries its share of the load; where to fly it leaves to the others. Start all but
agent 3 as in README ("by hand") and this in its place:

    python docs/examples/foreign_agent.py RUN DIGEST 3 MASS_KG THRUST_N tcp/127.0.0.1:7451 tcp/127.0.0.1:7447 ...

DIGEST and the hover thrust are what `transport validate` prints; the first endpoint is this agent's own.
"""

import json
import queue
import struct
import sys
import time

import msgpack
import numpy as np
import zenoh

VERSION, STEPS, INERTIA = 2, 20, np.array([0.029, 0.029, 0.055])


def pack(value):
    """An array as the protocol's extension type 1."""
    header = struct.pack("<4I", value.ndim, *value.shape, *[0] * (3 - value.ndim))
    return msgpack.ExtType(1, header + value.astype("<f8").tobytes())


def unpack(_, data):
    """And back."""
    axes, *shape = struct.unpack_from("<4I", data)
    return np.frombuffer(data, "<f8", offset=16).reshape(shape[:axes])


def control(payload, uav, mass, thrust):
    """Inputs that level the UAV where its rod is upright: thrust, and moments of a cascade of two PD loops."""
    e, rod_rate, attitude, rate = uav[:3], uav[3:6], uav[6:9], uav[9:12]
    swing = np.cross(rod_rate - payload[9:12], e)
    acceleration = 4.0 * e[:2] + 6.0 * swing[:2]
    wanted = np.array([acceleration[1], -acceleration[0], 0.0]) * mass / thrust
    angles = np.clip(wanted, -0.2, 0.2) - attitude * [1.0, 1.0, 0.0]
    return np.concatenate([[thrust], np.clip(INERTIA * (60.0 * angles - 12.0 * rate), -0.5, 0.5)])


def main(run, digest, agent, mass, thrust, own, *others):
    """Take part until the run ends."""
    name, prefix, inbox, alive = f"agent{agent}", f"transport/{run}", queue.SimpleQueue(), set()
    config = {"mode": "peer", "listen": {"endpoints": [own]}, "connect": {"endpoints": others}}
    config["scouting"] = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        watch = lambda sample: alive.add(str(sample.key_expr).split("/")[3])  # noqa: E731
        kept = [session.declare_subscriber(f"{prefix}/{k}", inbox.put) for k in (f"measurement/{agent}", "control")]
        kept.append(session.liveliness().declare_subscriber(f"{prefix}/alive/*/**", watch, history=True))
        kept.append(session.liveliness().declare_token(f"{prefix}/alive/{name}/0/{digest}"))
        while len(alive) < len(others) + 1:  # everybody, this agent too
            time.sleep(0.01)
        kept.append(session.liveliness().declare_token(f"{prefix}/ready/{name}/0"))
        while True:
            data = inbox.get().payload.to_bytes()
            kind, _, _, _, tick, *fields = msgpack.unpackb(data[1:], ext_hook=unpack)
            if kind == "control":
                return
            payload, states = fields[3], fields[5]
            inputs = np.tile(control(payload, states[0], float(mass), float(thrust)), (STEPS, 1))
            plan = [int(agent), tick, 0, [int(agent)], pack(states), pack(inputs), pack(np.zeros((0, 4))), "solved"]
            message = ["plan", name, 0, tick, tick, *plan]
            session.put(f"{prefix}/plan/{agent}", bytes([VERSION]) + msgpack.packb(message))


if __name__ == "__main__":
    main(*sys.argv[1:])
