"""Control of each UAV alone, without any message.

Every UAV keeps to its own part of the reference. With r_i, its position, s_i, the lower end of its
rod relative to it, and f_i, its share of the weight, the force of its thrust is

    F_i   =  F_i^hover + M_i (K_P (r_i^ref - r_i) + K_V (dr_i^ref - dr_i) - K_S sqrt(l_i) E_xy ds_i) + h_i
    dh_i  =  K_I M_i (r_i^ref - r_i) - h_i / FORGETS,         M_i = diag(m_i, m_i, f_i / g)

Sideways the rod gives way, which damps its swing; upwards the UAV lifts its share of the payload.
The integral h_i finds wind and mass errors, and forgets, as UAVs on a rigid body could hold any force
against each other. Roll and pitch, Theta_d, are those whose thrust has the direction of F_i:

    f_i = -(R_i k)' F_i,    tau_i = -J_i (W^2 diag(1, 1, 0.08) (Theta_i - Theta_d) + 2 ZETA W omega_i)

No plan is used, and only those are sent that must be.

In this folder: transport run paper --set agents.controller=alone:Alone
Source: docs/equations.md (31a), (31b); Mellinger, Kumar, Minimum snap trajectory generation and
control for quadrotors, ICRA 2011, for thrust and attitude from a force.
"""

import math

import numpy as np

from transport import Step
from transport.model.physics.rotations import rotation

K_P, K_V, K_S, K_I = 6.0, 5.0, 0.5, 2.5  # 1/s^2, 1/s, 1/(s sqrt(m)), 1/s^3
FORGETS = 20.0  # s
W, ZETA = 6.0, 0.8  # attitude loop, rad/s
STIFFNESS = W**2 * np.array([1.0, 1.0, 0.08])
STEEPEST = 0.5  # rad, largest roll and pitch asked for
MOST_HELD = 0.4  # largest integral, as a share of the hover thrust


class Alone:
    """Controller of the UAVs that an agent owns, each by itself."""

    version = "1"
    arena = {"tuned": "gains of the project's `alone`: by hand, in gusts and after deaths"}

    def start(self, run):
        """Hold nothing yet."""
        self.run = run
        self.held = {uav: np.zeros(3) for uav in run.owned}
        self.hover = run.u_hover.reshape(-1, 4)[:, 0]

    def step(self, measurement, messages):  # noqa: ARG002  # alone
        """Return the inputs of all own UAVs, which no other agent needs."""
        inputs = [self.inputs(uav, measurement) for uav in self.run.owned]
        return Step(inputs=np.concatenate(inputs), send=False)

    def inputs(self, uav, measurement):
        """Return thrust and moments of a UAV, (4,), N and N m."""
        run = self.run
        force = self.force(uav, measurement)
        Theta = run.attitude(uav, measurement)
        Theta_d = attitude(force, Theta[2])
        Theta_d[:2] = np.clip(Theta_d[:2], -STEEPEST, STEEPEST)

        error = Theta - Theta_d
        error[2] = math.remainder(error[2], 2.0 * math.pi)
        turning = STIFFNESS * error + 2.0 * ZETA * W * run.body_rate(uav, measurement)
        thrust = -rotation(Theta)[:, 2] @ force
        return np.append(thrust, -run.system.uavs[uav].inertia @ turning)

    def force(self, uav, measurement):
        """Return F_i, (3,), inertial frame, N, and renew the integral."""
        run = self.run
        r, dr, ds = self.motion(uav, measurement)
        r_ref, dr_ref, _ = self.motion(uav, run.reference(run.tick))
        body = run.system.uavs[uav]
        M = np.array([body.mass, body.mass, self.hover[uav] / run.system.gravity])
        ds[2] = 0.0  # E_xy

        error = r_ref - r
        swing = K_S * math.sqrt(body.rod_length) * ds
        force = M * (K_P * error + K_V * (dr_ref - dr) - swing) + self.held[uav]
        force[2] -= self.hover[uav]  # z points down

        change = K_I * M * error - self.held[uav] / FORGETS
        most = MOST_HELD * self.hover[uav]
        self.held[uav] = np.clip(self.held[uav] + run.period_s * change, -most, most)
        return force

    def motion(self, uav, source):
        """Return r_i, its derivative and that of s_i, (3,) each, inertial frame, SI."""
        run = self.run
        body = run.system.uavs[uav]
        R = rotation(run.payload_attitude(source))
        swing = np.cross(
            run.rod_rate(uav, source), body.rod_length * run.rod_direction(uav, source)
        )
        return run.position(uav, source), run.velocity(uav, source), R @ swing

    def stop(self):
        """Nothing is open."""


def attitude(force, yaw):
    """Return roll, pitch and yaw, whose thrust has the direction of a force at a yaw, (3,), rad."""
    x, y, z = force
    forward = math.cos(yaw) * x + math.sin(yaw) * y
    right = math.cos(yaw) * y - math.sin(yaw) * x
    return np.array([math.asin(right / np.linalg.norm(force)), math.atan2(-forward, -z), 0.0])
