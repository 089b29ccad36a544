"""A plant that shares no code with the project, made from Zenoh, numpy, docs/protocol.md and docs/equations.md.

It reads the scenario of the run, integrates the equations of motion and answers each tick with measurements. Start it
beside `transport run SCENARIO --external plant --set network.base_port=7447 --out runs/mine`, which prints the digest:

    python docs/examples/foreign_plant.py runs/mine/scenario.toml mine DIGEST 7447

The agent beside it, foreign_agent.py, has its functions for messages. A plan is played on for as long as no newer one
comes. Wind, noise, failures and links are left out.
"""

import json
import queue
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import zenoh
from foreign_agent import VERSION, message, messages, pack

STEPS = 5  # steps of integration in a sampling period


class Bodies:
    """Parameters of the bodies, and the equations of motion: docs/equations.md (2)-(13)."""

    def __init__(self, system):
        uavs, payload = system["uav"], system["payload"]
        self.g, self.m0, self.J0 = system["gravity_mps2"], payload["mass_kg"], matrix(payload["inertia_kgm2"])
        self.m, self.l = (np.array([uav[key] for uav in uavs])[:, None] for key in ("mass_kg", "rod_length_m"))
        self.J, self.rho = np.array([matrix(uav["inertia_kgm2"]) for uav in uavs]), np.array([u["rho_m"] for u in uavs])

    def derivative(self, x, u):
        """Return x' of payload and UAVs at inputs of shape (N, 4)."""
        v0, Theta0, w0 = x[3:6], x[6:9], x[9:12]
        e, Omega, Theta, omega = x[12:].reshape(-1, 4, 3).swapaxes(0, 1)
        R0, b3 = rotation(Theta0), np.array([rotation(angles)[:, 2] for angles in Theta])
        s = (self.g * np.array([0.0, 0.0, 1.0]) - u[:, :1] / self.m * b3) @ R0  # (6), payload frame
        centripetal = np.cross(w0, np.cross(w0, self.rho))
        known = dot(e, centripetal - s) + self.l * dot(Omega, Omega)
        w = np.hstack([e, np.cross(self.rho, e)])
        M, b = np.zeros((6, 6)), np.zeros(6)  # six unknowns: acceleration and angular acceleration of the payload
        M[:3, :3], M[3:, 3:] = self.m0 * np.eye(3), self.J0
        b[:3], b[3:] = self.m0 * self.g * R0[2], -np.cross(w0, self.J0 @ w0)
        a = np.linalg.solve(M + (self.m * w).T @ w, b - (self.m * known * w).sum(axis=0))
        attachment = a[:3] + np.cross(a[3:], self.rho) + centripetal
        Omega_dot = np.cross(e, attachment - s) / self.l - np.cross(w0, Omega)
        gyroscopic = np.cross(omega, np.einsum("ijk,ik->ij", self.J, omega))
        omega_dot = np.linalg.solve(self.J, (u[:, 1:] - gyroscopic)[..., None])[..., 0]
        turns = [rates(angles) @ rate for angles, rate in zip(Theta, omega, strict=True)]
        uavs = np.stack([np.cross(Omega - w0, e), Omega_dot, turns, omega_dot], axis=1)
        return np.concatenate([R0 @ v0, a[:3] - np.cross(w0, v0), rates(Theta0) @ w0, a[3:], uavs.ravel()])

    def integrate(self, x, u, period_s):
        """Return the state a sampling period later, by Runge-Kutta steps of order 4."""
        h = period_s / STEPS
        for _ in range(STEPS):
            k1 = self.derivative(x, u)
            k2 = self.derivative(x + h / 2 * k1, u)
            k3 = self.derivative(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + self.derivative(x + h * k3, u))
            e, Omega = x[12:].reshape(-1, 4, 3)[:, 0], x[12:].reshape(-1, 4, 3)[:, 1]
            e /= np.linalg.norm(e, axis=1, keepdims=True)
            Omega -= e * dot(e, Omega)
        return x


def dot(a, b):
    """Return the scalar products of rows, (N, 1)."""
    return (a * b).sum(axis=1, keepdims=True)


def matrix(inertia):
    """Return an inertia, three principal moments or a matrix, as a matrix."""
    return np.array(inertia) if np.ndim(inertia) == 2 else np.diag(inertia)


def rotation(angles):
    """Return the rotation matrix of roll, pitch, yaw."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    rows = [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, sy * cp, sy * sp * sr + cy * cr]
    return np.array([*rows, sy * sp * cr - cy * sr, -sp, cp * sr, cp * cr]).reshape(3, 3)


def rates(angles):
    """Return the matrix from body rates to the rates of roll, pitch, yaw."""
    cr, sr, cp, tp = np.cos(angles[0]), np.sin(angles[0]), np.cos(angles[1]), np.tan(angles[1])
    return np.array([[1.0, sr * tp, cr * tp], [0.0, cr, -sr], [0.0, sr / cp, cr / cp]])


class Plant:
    """State of the plant at tick k, what it has received, and what it answers."""

    def __init__(self, scenario, publish):
        self.bodies, self.period_s = Bodies(scenario["system"]), scenario["controller"]["sampling_period_s"]
        self.owned, self.N = scenario["agents"]["owned"], len(scenario["system"]["uav"])
        upright = np.tile([0.0, 0.0, 1.0, *[0.0] * 9], self.N)  # rods point down from the UAVs, all at rest
        self.x = np.concatenate([scenario["maneuver"]["start_m"], np.zeros(9), upright])
        weight = self.bodies.g * (self.bodies.m0 / self.N + self.bodies.m[:, 0])
        self.u, self.plan_ticks = np.column_stack([weight, np.zeros((self.N, 3))]), [-1] * self.N
        self.k, self.measured, self.ticks, self.plans, self.answered = 0, -1, {}, {}, {}
        self.publish, self.count, self.bundles, self.kept, self.shared = publish, 0, 0, [], []

    def take(self, kind, head, fields):
        """Take in a tick or a plan, and answer what can be answered."""
        tick = head[-1]
        if kind == "tick":
            self.ticks[tick] = fields
        elif kind == "plan" and fields[2] == 0:
            agent, start, _, _, uavs, _, inputs, *_ = fields
            self.plans |= {uav: (start, tick, inputs[:, 4 * i : 4 * i + 4]) for i, uav in enumerate(uavs)}
            self.answered.setdefault(tick, set()).add(agent)

    def work(self):
        """Measure and integrate in turn, as far as the messages allow."""
        while True:
            if self.measured < self.k and self.k in self.ticks:
                self.measure()
            elif self.measured == self.k and self.is_decided():
                self.advance()
            else:
                break
        measured = [entry for entry in self.kept if entry[0].startswith("measurement/")]
        if measured:  # the agents receive plans of the tick before and measurements in one message
            self.bundle("instant", self.shared + measured)
            self.shared.clear()
        if self.kept:
            self.bundle("record", self.kept)
            self.kept = []

    def bundle(self, kind, entries):
        """Publish messages in a bundle."""
        keys, parts = zip(*entries, strict=True)
        self.publish(kind, message(kind, "plant", 0, self.bundles, self.measured, list(keys), list(parts)))
        self.bundles += 1

    def is_decided(self):
        """Return whether the plans of tick k are here: of its members, or of those that the next tick names."""
        members, named = self.ticks[self.k][0], self.ticks.get(self.k + 1, [None, None])[1]
        return self.answered.get(self.k, set()) >= set(members if named is None else named)

    def measure(self):
        """Answer tick k with measurements."""
        members, answered, shared, roster, *_ = self.ticks[self.k]
        for agent in members:
            rows = [uav - 1 for uav in self.owned[agent - 1]]
            states = pack(self.x[12:].reshape(self.N, 12)[rows])
            fields = [agent, answered, shared, roster, pack(self.x[:12]), self.owned[agent - 1], states]
            self.send(f"measurement/{agent}", "measurement", *fields, pack(self.u[rows]))
        self.measured = self.k

    def advance(self):
        """Integrate [k, k + 1), with state and inputs for the record; a plan is played on until the next one."""
        for uav, (start, tick, inputs) in self.plans.items():
            if start <= self.k:
                self.u[uav - 1] = inputs[min(self.k - start, len(inputs) - 1)]
                self.plan_ticks[uav - 1] = tick
        end = self.bodies.integrate(self.x, self.u, self.period_s)
        why = "" if np.isfinite(end).all() else "the state is no longer finite"
        self.send("plant_state", "plant_state", pack(self.x), pack(self.u.ravel()), list(self.plan_ticks), -1.0, why)
        self.x, self.k = end, self.k + 1

    def send(self, key, kind, *fields):
        """Keep a message of tick k for the next bundle."""
        self.kept.append((key, message(kind, "plant", 0, self.count, self.k, *fields)))
        self.count += 1


def main(file, run, digest, port):
    """Take part until the run ends."""
    scenario = tomllib.loads(Path(file).read_text(encoding="utf-8"))
    if scenario["clock"]["mode"] != "lockstep" or scenario["clock"].get("actuation", "immediate") != "immediate":
        sys.exit("foreign_plant.py: expected clock.mode lockstep and clock.actuation immediate")
    prefix, inbox, alive = f"transport/{run}", queue.SimpleQueue(), set()
    coordinator, own = (f"tcp/127.0.0.1:{int(port) + i}" for i in range(2))
    config = {"mode": "peer", "listen": {"endpoints": [own]}, "connect": {"endpoints": [coordinator]}}
    config["scouting"] = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    secret = Path(file).parent / "keys" / "secret.txt"  # `transport run` lets only processes with it connect
    if secret.exists():
        user, password = secret.read_text(encoding="utf-8").strip().split(":", 1)
        login = {"user": user, "password": password, "dictionary_file": str(secret.resolve())}
        config["transport"] = {"auth": {"usrpwd": login}}

    def watch(sample):
        name = str(sample.key_expr).split("/")[3]
        (alive.discard if sample.kind == zenoh.SampleKind.DELETE else alive.add)(name)
        if name == "coordinator" and name not in alive:
            inbox.put(None)

    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:

        def publish(key, data):
            session.put(f"{prefix}/{key}", data, congestion_control=zenoh.CongestionControl.BLOCK)

        plant = Plant(scenario, publish)
        keys = [f"{prefix}/{key}" for key in ("relay", "control")]
        kept = [session.declare_subscriber(key, inbox.put) for key in keys]
        kept.append(session.liveliness().declare_subscriber(f"{prefix}/alive/**", watch, history=True))
        kept.append(session.liveliness().declare_token(f"{prefix}/alive/plant/0/{digest}/{VERSION}"))
        while not alive >= {"coordinator", "plant", *[f"agent{i + 1}" for i in range(len(plant.owned))]}:
            time.sleep(0.01)
        kept.append(session.liveliness().declare_token(f"{prefix}/ready/plant/0"))
        over = False
        while not over and (sample := inbox.get()) is not None:
            for kind, *fields in messages(sample.payload.to_bytes(), plant.shared):
                over = over or kind == "control"
                plant.take(kind, fields[:4], fields[4:])
            plant.work()
        publish("left/plant", b"")
        deadline = time.monotonic() + 10.0
        while "recorder" in alive and time.monotonic() < deadline:
            time.sleep(0.01)  # closing the session would drop what the recorder has not read yet


if __name__ == "__main__":
    main(*sys.argv[1:])
