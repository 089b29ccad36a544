"""The model of one system, numerically: derivative, outputs, exact linearisation, integration."""

from dataclasses import dataclass

import casadi as ca

from model.arrays import Array
from model.compiled import Compiled, functions
from model.parameters import System


@dataclass(frozen=True, slots=True, kw_only=True)
class Linearisation:
    """First-order expansion about (x0, u0), which need not be an equilibrium.

    Attributes:
        f: x' at (x0, u0), (n,), SI.
        A_c: df/dx, (n, n), 1/s.
        B_c: df/du, (n, m).
        y: h(x0), (p,).
        C: dh/dx, (p, n).
    Source: docs/equations.md (15); paper (13).
    """

    f: Array
    A_c: Array
    B_c: Array
    y: Array
    C: Array


class Model:
    """Equations of motion of one system, evaluated numerically.

    Args:
        system: Physical parameters.
    """

    def __init__(self, system: System) -> None:
        self.system = system
        self._p = system.vector()
        self._functions = functions(system.N)
        self._derivative = Compiled(self._functions["derivative"])
        self._tensions = Compiled(self._functions["tensions"])
        self._outputs = Compiled(self._functions["outputs"])
        self._linearise = Compiled(self._functions["linearise"])
        self._steps: dict[int, Compiled] = {}

    def derivative(self, x: Array, u: Array) -> Array:
        """x' = f(x, u), (n,), SI. Source: docs/equations.md (4)-(13)."""
        return self._derivative(x, u, self._p)[0]

    def tensions(self, x: Array, u: Array) -> Array:
        """Rod tensions, (N,), N; positive when the rod pulls. Source: docs/equations.md (9)."""
        return self._tensions(x, u, self._p)[0]

    def outputs(self, x: Array) -> Array:
        """y = h(x), (4 N + 3,), SI. Source: docs/equations.md (14)."""
        return self._outputs(x, self._p)[0]

    def linearise(self, x: Array, u: Array) -> Linearisation:
        """Exact derivatives about (x, u). Source: docs/equations.md (15); paper (13)."""
        f, A_c, B_c, y, C = self._linearise(x, u, self._p)
        return Linearisation(f=f, A_c=A_c, B_c=B_c, y=y, C=C)

    def integrate(self, x: Array, u: Array, duration_s: float, steps: int) -> tuple[Array, float]:
        """State after `duration_s` of constant input, by `steps` Dormand-Prince steps of order 5.

        Args:
            x: State, (n,).
            u: Input, held, (m,).
            duration_s: s.
            steps: Number of equal steps, >= 1; the rods are projected back after each.
        Returns: State, (n,), and the largest local error estimate of any step and component, SI.
        """
        if steps not in self._steps:
            chained = self._functions["step"].mapaccum(steps)
            self._steps[steps] = Compiled(_last_and_errors(chained, self.system, steps))
        end, errors = self._steps[steps](x, u, self._p, duration_s / steps)
        return end, float(errors[0])


def _last_and_errors(chained: ca.Function, system: System, steps: int) -> ca.Function:
    x, u = ca.MX.sym("x", system.n), ca.MX.sym("u", system.m)
    p, h = ca.MX.sym("p", 8 + 11 * system.N), ca.MX.sym("h")
    states, errors = chained(x, ca.repmat(u, 1, steps), ca.repmat(p, 1, steps), ca.repmat(h, 1, steps))
    return ca.Function("integrate", [x, u, p, h], [states[:, -1], ca.mmax(ca.fabs(errors))])
