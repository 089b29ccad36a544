"""Outputs of the cost and measurements of the UAVs' own sensors, as CasADi expressions of the state."""

import casadi as ca

from transport.model import state
from transport.model.physics.dynamics import uav_drag, uav_velocity
from transport.model.physics.rotations import rotation
from transport.model.physics.symbols import Symbols


def uav_positions(symbols: Symbols) -> list[ca.SX]:
    """Return r_i = r0 + R0 (rho_i - l_i e_i) for each UAV, (3,), inertial frame, m.

    Source: docs/equations.md (14); paper (1).
    """
    x = symbols.x
    R0 = rotation(x[state.THETA0])
    positions = []
    for i in range(symbols.N):
        uav = symbols.uav(i)
        e = x[state.uav_slice(i)][state.E]
        positions.append(x[state.R0] + R0 @ (uav.rho - uav.length * e))
    return positions


def velocities(symbols: Symbols) -> ca.SX:
    """Return the velocities of the centres of mass, (1 + N, 3), inertial frame, m/s.

    Source: docs/equations.md (39).
    """
    x = symbols.x
    R0 = rotation(x[state.THETA0])
    # R0 v0, and R0 (v0 + omega0 x rho_i - l_i Omega_i x e_i) of each UAV.
    rows: list[ca.SX] = [(R0 @ x[state.V0]).T]
    for i in range(symbols.N):
        rows.append((R0 @ uav_velocity(symbols, i)).T)
    return ca.vertcat(*rows)


def outputs(symbols: Symbols) -> ca.SX:
    """Return y = h(x) = [r_1..r_N, Theta_0, yaw rates of UAVs, r_0, r_0'], (4 N + 9), SI, inertial.

    Source: docs/equations.md (14); paper (12).
    """
    x = symbols.x
    yaw_rates = [x[state.uav_slice(i)][state.OMEGA][2] for i in range(symbols.N)]
    payload = [x[state.R0], rotation(x[state.THETA0]) @ x[state.V0]]
    return ca.vertcat(*uav_positions(symbols), x[state.THETA0], *yaw_rates, *payload)


def sensed(symbols: Symbols, tensions: ca.SX) -> ca.SX:
    """Return the measurements of the UAVs' own sensors under tensions, (15 N,).

    In the order of `model.state`.
    Source: docs/equations.md (61).
    """
    x = symbols.x
    R0 = rotation(x[state.THETA0])
    velocity = velocities(symbols)
    measured: list[ca.SX] = []
    for i, position in enumerate(uav_positions(symbols)):
        block = x[state.uav_slice(i)]

        # Specific force (R_i'(T_i R0 e_i + F_i + drag) - f_i b3) / m_i, body frame.
        pull = R0 @ block[state.E] * tensions[i] + symbols.force(i + 1)
        if symbols.drag:
            pull = pull + R0 @ uav_drag(symbols, i, R0)
        lift = ca.vertcat(0.0, 0.0, symbols.u[state.INPUTS * i])
        specific_force = (rotation(block[state.THETA]).T @ pull - lift) / symbols.uav(i).mass

        measured += [position, velocity[i + 1, :].T, block[state.THETA], block[state.OMEGA]]
        measured.append(specific_force)
    return ca.vertcat(*measured)
