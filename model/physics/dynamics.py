"""The equations of motion as CasADi expressions.

A 6 x 6 system in the payload's acceleration (docs/equations.md).
"""

from dataclasses import dataclass

import casadi as ca

from transport.model import state
from transport.model.physics.rotations import euler_rates, rotation
from transport.model.physics.symbols import Symbols


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Right-hand side and rod tensions, SI."""

    derivative: ca.SX  # x' = f(x, u, F), (12 + 12 N,)
    tensions: ca.SX  # (N,), positive when the rod pulls
    # Payload's acceleration and angular acceleration alpha, payload frame, (6,), that balances it, also
    # where another one is given: all that a UAV and its rod notice of the other UAVs.
    acceleration: ca.SX
    mass: ca.SX  # M of the equation M alpha = b, (6, 6)
    unbalanced: ca.SX  # b - M alpha, zero unless alpha is given, (6,)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Balance:
    """The equation M alpha = b of the payload's acceleration alpha, (6,): (11)."""

    M: ca.SX  # (6, 6)
    b: ca.SX  # (6,)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Rod:
    """A UAV and its rod as the payload notices them, payload frame, SI."""

    m: ca.SX  # mass of the UAV
    rho: ca.SX  # attachment point, (3,)
    length: ca.SX
    e: ca.SX  # direction, (3,)
    Omega: ca.SX  # angular velocity, (3,)
    s_P: ca.SX  # specific force of the UAV without rod, (3,)
    centripetal: ca.SX  # omega0 x (omega0 x rho), (3,)
    along: ca.SX  # kappa of (11): tension per mass with the payload at rest
    wrench: ca.SX  # w of (11): force and moment on the payload per tension, (6,)


def motion(symbols: Symbols, given: ca.SX | None = None) -> Motion:
    """Return the right-hand side, also under a given payload acceleration, (6,).

    The payload's acceleration alpha = [a0, omega0'], a0 = v0' + omega0 x v0, solves a 6 x 6
    system.
    Source: docs/equations.md (4)-(13), (37), (57).
    """
    R0 = rotation(symbols.x[state.THETA0])
    g_P = symbols.gravity * R0[2, :].T  # gravity in the payload frame

    alone = _payload_alone(symbols, R0, g_P)
    rods = [_rod(symbols, i, R0, g_P) for i in range(symbols.N)]
    balance = _with_rods(alone, rods)
    solved = solve_positive_definite(balance.M, balance.b)
    acceleration = solved if given is None else given

    # T_i = m_i (w_i' alpha + kappa_i); what it leaves of the payload's own balance: (11).
    tensions = []
    unbalanced = alone.b - alone.M @ acceleration
    for rod in rods:
        tension = rod.m * (rod.along + ca.dot(rod.wrench, acceleration))
        tensions.append(tension)
        unbalanced = unbalanced - tension * rod.wrench

    blocks = _payload_derivative(symbols, R0, acceleration)
    for i, rod in enumerate(rods):
        blocks.extend(_uav_derivative(symbols, i, rod, acceleration))
    return Motion(
        derivative=ca.vertcat(*blocks),
        tensions=ca.vertcat(*tensions),
        acceleration=solved,
        mass=balance.M,
        unbalanced=unbalanced,
    )


def _payload_alone(symbols: Symbols, R0: ca.SX, g_P: ca.SX) -> _Balance:
    """Return the payload's balance without rods.

    M = [m0 I, 0; 0, J0],  b = [m0 g R0'k + R0'F_0 - d0 v0, -omega0 x J0 omega0]: (11), (37), (42).
    """
    payload = symbols.payload()
    omega0 = symbols.x[state.OMEGA0]

    force = payload.mass * g_P + R0.T @ symbols.force(0)
    if symbols.drag:
        force = force - symbols.payload_drag * symbols.x[state.V0]
    gyroscopic = -ca.cross(omega0, payload.inertia @ omega0)
    M = ca.diagcat(payload.mass * ca.SX.eye(3), payload.inertia)
    return _Balance(M=M, b=ca.vertcat(force, gyroscopic))


def _with_rods(alone: _Balance, rods: list[_Rod]) -> _Balance:
    """Return the balance with rods: M += m_i w_i w_i',  b -= m_i kappa_i w_i: (11)."""
    M = alone.M
    b = alone.b
    for rod in rods:
        M = M + rod.m * (rod.wrench @ rod.wrench.T)
        b = b - rod.m * rod.along * rod.wrench
    return _Balance(M=M, b=b)


def _payload_derivative(symbols: Symbols, R0: ca.SX, acceleration: ca.SX) -> list[ca.SX]:
    """Return the derivatives of the payload's states.

    r0' = R0 v0,  v0' = a0 - omega0 x v0,  Theta0' = E omega0,  and omega0': (4), (12).
    """
    x = symbols.x
    v0 = x[state.V0]
    omega0 = x[state.OMEGA0]
    return [
        R0 @ v0,
        acceleration[:3] - ca.cross(omega0, v0),
        euler_rates(x[state.THETA0]) @ omega0,
        acceleration[3:],
    ]


def _rod(symbols: Symbols, i: int, R0: ca.SX, g_P: ca.SX) -> _Rod:
    """Return a UAV and its rod, 0-based.

    s = g R0'k - f/m R0' R_i k + R0' F_i / m + drag / m,
    kappa = e . (omega0 x (omega0 x rho) - s) + l |Omega|^2,  w = [e, rho x e]: (6), (11), (37), (42).
    """
    m, _, rho, length = symbols.uav(i)
    omega0 = symbols.x[state.OMEGA0]
    block = symbols.x[state.uav_slice(i)]
    e = block[state.E]
    Omega = block[state.ROD_RATE]
    thrust = symbols.u[state.INPUTS * i]

    # Specific force without rod: gravity, lift along -b3 of the body, external force.
    lift = thrust / m * (R0.T @ rotation(block[state.THETA])[:, 2])
    s_P = g_P - lift + R0.T @ symbols.force(i + 1) / m
    if symbols.drag:
        s_P = s_P + uav_drag(symbols, i, R0) / m
    centripetal = ca.cross(omega0, ca.cross(omega0, rho))
    return _Rod(
        m=m,
        rho=rho,
        length=length,
        e=e,
        Omega=Omega,
        s_P=s_P,
        centripetal=centripetal,
        along=ca.dot(e, centripetal - s_P) + length * ca.dot(Omega, Omega),
        wrench=ca.vertcat(e, ca.cross(rho, e)),
    )


def uav_drag(symbols: Symbols, i: int, R0: ca.SX) -> ca.SX:
    """Return the drag of a UAV in still air, 0-based, (3,), payload frame, N.

    F = -d v - (d^z - d) (b . v) b,  b = R0' R_i k: the rotors' plane and their axis. Source:
    docs/equations.md (42).
    """
    drag = symbols.uav_drag(i)
    v_P = uav_velocity(symbols, i)
    b_P = R0.T @ rotation(symbols.x[state.uav_slice(i)][state.THETA])[:, 2]
    along = (drag.along - drag.across) * ca.dot(b_P, v_P)
    force: ca.SX = -drag.across * v_P - along * b_P
    return force


def uav_velocity(symbols: Symbols, i: int) -> ca.SX:
    """Return the velocity of a UAV, 0-based: v0 + omega0 x rho - l Omega x e, payload frame."""
    uav = symbols.uav(i)
    block = symbols.x[state.uav_slice(i)]
    swing = uav.length * ca.cross(block[state.ROD_RATE], block[state.E])
    v0 = symbols.x[state.V0]
    return v0 + ca.cross(symbols.x[state.OMEGA0], uav.rho) - swing


def _uav_derivative(symbols: Symbols, i: int, rod: _Rod, acceleration: ca.SX) -> list[ca.SX]:
    """Return the derivatives of a UAV's states: rod, rod rate, attitude and body rates.

    e' = (Omega - omega0) x e,  Omega' = e x (a_attachment - s) / l - omega0 x Omega,
    omega' = J^-1 (tau - omega x J omega), or by the inner loop K (command - omega)
    Source: docs/equations.md (5), (6), (12), (13), (57).
    """
    J = symbols.uav(i).inertia
    omega0 = symbols.x[state.OMEGA0]
    block = symbols.x[state.uav_slice(i)]
    omega = block[state.OMEGA]
    command = symbols.u[state.INPUTS * i + 1 : state.INPUTS * (i + 1)]

    attachment = acceleration[:3] + ca.cross(acceleration[3:], rod.rho) + rod.centripetal
    Omega_dot = ca.cross(rod.e, attachment - rod.s_P) / rod.length - ca.cross(omega0, rod.Omega)
    if symbols.rates:
        omega_dot = symbols.rate_gains * (command - omega)
    else:
        omega_dot = solve_positive_definite(J, command - ca.cross(omega, J @ omega))
    return [
        ca.cross(rod.Omega - omega0, rod.e),
        Omega_dot,
        euler_rates(block[state.THETA]) @ omega,
        omega_dot,
    ]


def solve_positive_definite(M: ca.SX, b: ca.SX) -> ca.SX:
    """Return M^-1 b, (size, columns), by an unrolled L D L' factorisation.

    Its expressions are short and have exact derivatives.
    """
    size = M.shape[0]

    # D_j = M_jj - sum_k L_jk^2 D_k,  L_ij = (M_ij - sum_k L_ik L_jk D_k) / D_j,  k < j
    L = [[ca.SX(0)] * size for _ in range(size)]
    D: list[ca.SX] = []
    for j in range(size):
        D.append(M[j, j] - sum(L[j][k] ** 2 * D[k] for k in range(j)))
        for i in range(j + 1, size):
            L[i][j] = (M[i, j] - sum(L[i][k] * L[j][k] * D[k] for k in range(j))) / D[j]

    # L z = b
    z: list[ca.SX] = []
    for i in range(size):
        z.append(b[i, :] - sum(L[i][k] * z[k] for k in range(i)))

    # L' solution = D^-1 z
    solution: list[ca.SX] = [ca.SX(0)] * size
    for i in reversed(range(size)):
        solution[i] = z[i] / D[i] - sum(L[k][i] * solution[k] for k in range(i + 1, size))
    return ca.vertcat(*solution)
