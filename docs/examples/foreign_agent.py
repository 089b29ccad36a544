"""An agent that shares no code with the others, made from Zenoh, msgpack, numpy and docs/protocol.md.

It does not know the maneuver. It keeps its rod parallel to the others', whose states are in their
plans, and its corner of the payload as high as the middle, and carries its share. It shares the
height of its UAV as own data and, if the others share theirs, keeps to their mean. `pip install
eclipse-zenoh msgpack numpy` installs all that it needs. Start all but
agent 3 as in docs/bring-your-own.md, with `--scenario resilient`, and this in its place;
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


def pack(value):
    """Return an array as the protocol's extension type 1."""
    header = struct.pack("<4I", value.ndim, *value.shape, *[0] * (3 - value.ndim))
    return msgpack.ExtType(1, header + np.ascontiguousarray(value, "<f8").tobytes())


def unpack(_, data):
    """Return the array of an extension type 1."""
    axes, *shape = struct.unpack_from("<4I", data)
    return np.frombuffer(data, "<f8", offset=16).reshape(shape[:axes])


def messages(data, shared=None):
    """Yield the messages in some bytes as lists, those of a bundle one by one.

    Add its plans to a list, if given.
    """
    kind, *fields = msgpack.unpackb(data[1:], ext_hook=unpack)
    if kind in ("instant", "relay"):
        for key, part in zip(*fields[4:6], strict=True):
            if shared is not None and key.startswith("plan/"):
                shared.append((key, part))
            yield from messages(part)
    else:
        yield kind, *fields


def message(kind, *fields):
    """Return the bytes of a message."""
    return bytes([VERSION]) + msgpack.packb([kind, *fields])


def control(payload, uav, team):
    """Return the inputs that follow rods and tilt of the others, by two cascaded loops."""
    (roll, pitch, _), (p, q, _) = payload[6:9], payload[9:12]
    low = RHO[1] * (roll + 0.3 * p) - RHO[0] * (pitch + 0.3 * q)  # height of the corner in 0.3 s
    (e, rod_rate, attitude, rate), (e_team, rod_rate_team, attitude_team, _) = (
        uav.reshape(4, 3),
        team.reshape(4, 3),
    )
    behind = 40.0 * (e - e_team) + 20.0 * (np.cross(rod_rate, e) - np.cross(rod_rate_team, e_team))
    tilt = attitude_team[:2] + MASS / THRUST * np.array([behind[1], -behind[0]])
    turn = np.append(np.clip(tilt, -0.3, 0.3) - attitude[:2], 0.0)
    moments = INERTIA * (100.0 * turn - 16.0 * rate)
    return np.append(THRUST + np.clip(100.0 * low, -10.0, 10.0), np.clip(moments, -0.5, 0.5))


def height(payload, uav):
    """Return z of the UAV (inertial, down, m): r_z = r0_z + k' R(Theta0) (rho - l e)."""
    roll, pitch = payload[6:8]
    down = [-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]
    return payload[2] + down @ (np.append(RHO, RHO_Z) - LENGTH * uav[:3])


def main(run, digest, agent, port, exchange="relayed"):
    """Take part until the run ends."""
    me, prefix, inbox, alive, plans = int(agent), f"transport/{run}", queue.SimpleQueue(), set(), {}
    heights = {}  # own data of the others, if they share a height, by agent
    ports = [
        f"tcp/127.0.0.1:{int(port) + i}" for i in range(2 + me)
    ]  # it connects to those before its own
    config = {
        "mode": "peer",
        "listen": {"endpoints": ports[-1:]},
        "connect": {"endpoints": ports[:-1]},
    }
    config["scouting"] = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}

    def watch(sample):
        name = str(sample.key_expr).split("/")[3]
        alive.add(name)
        if sample.kind == zenoh.SampleKind.DELETE and name == "coordinator":
            inbox.put(None)

    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        keys = [f"{prefix}/{key}" for key in (f"measurement/{me}", "plan/*", "instant", "control")]
        kept = [session.declare_subscriber(key, inbox.put) for key in keys]
        kept.append(
            session.liveliness().declare_subscriber(f"{prefix}/alive/**", watch, history=True)
        )
        kept.append(
            session.liveliness().declare_token(f"{prefix}/alive/agent{me}/0/{digest}/{VERSION}")
        )
        while not alive >= {"coordinator", "plant", *[f"agent{i + 1}" for i in range(AGENTS)]}:
            time.sleep(0.01)
        kept.append(session.liveliness().declare_token(f"{prefix}/ready/agent{me}/0"))
        measured = None
        while (sample := inbox.get()) is not None:
            for kind, _, _, _, tick, *fields in messages(sample.payload.to_bytes()):
                if kind == "control":
                    return
                if kind == "plan":
                    plans[tick, fields[0]] = fields[5].mean(
                        axis=0
                    )  # e, Omega, Theta, omega of its UAVs
                    if fields[0] != me and len(fields) > 10 and fields[10].size == 1:
                        heights[fields[0]] = fields[10][0]
                elif kind == "measurement" and fields[0] == me:
                    measured = tick, fields
            if measured is None or any(
                (measured[0] - 1, a) not in plans for a in measured[1][2] if a != me
            ):
                continue  # nothing to answer, or plans of the tick before are still on their way
            (tick, (_, _, shared, _, payload, _, states, _)), measured = measured, None
            others = [plans.pop((tick - 1, a)) for a in shared if a != me]
            inputs = np.tile(
                [THRUST, 0.0, 0.0, 0.0], (STEPS, 1)
            )  # what it will do after this tick it cannot tell
            inputs[0] = control(
                payload, states[0], np.mean(others, axis=0) if others else states[0]
            )
            z = height(payload, states[0])
            if heights:
                inputs[0, 0] += 20.0 * (z - np.mean([z, *heights.values()]))
            head, key = [f"agent{me}", 0, tick, tick], f"plan/{me}"
            fields = [
                me,
                tick,
                0,
                True,
                [me],
                pack(states),
                pack(inputs),
                pack(np.zeros((0, 4))),
                "solved",
                0.0,  # no part of the inputs is by the control law of a UAV alone
                pack(np.array([z])),  # own data, which classes of the user find as plan.data
            ]
            data = message("plan", *head, *fields)
            if exchange == "relayed":
                key, data = f"answer/{me}", message("answer", *head, [key], [data], me)
            session.put(f"{prefix}/{key}", data, congestion_control=zenoh.CongestionControl.BLOCK)


if __name__ == "__main__":
    main(*sys.argv[1:])
