"""Motion of the team over a sampling period: motors, inner loops and engine in turn.

A period has equal parts, one for each update of the inner loops, and just one without them. In a part the command
is held; the motors turn it into actual inputs, each held for a while (`plant.rotors_and_motors`), over which the
engine integrates.
"""

import math
from dataclasses import dataclass

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.plant.engines import UNKNOWN_ERROR, Engine
from transport.plant.inner_loops import INNER_STEP_S, inner_loop
from transport.plant.plant_run import PlantRun
from transport.plant.rotors_and_motors import Motors

_ROUNDING = 1e-9  # of a ratio of two times


@dataclass(frozen=True, slots=True, kw_only=True)
class Integrated:
    """The plant after some part of a sampling period, or all of it.

    Attributes:
        x: State at its end, (12 + 12 N,), SI.
        error: Largest local error of a component, -1 if it is unknown.
        actual: Thrust and moments of the motors at its end, (4 N,), N and N m.
        mean: Their mean over the period; until its end the sum of the parts so far.
        tensions: Least tension of each cable, N, 0 while slack; none with rods.
    """

    x: Array
    error: float
    actual: Array
    mean: Array
    tensions: Array


class PeriodMotion:
    """Motors, inner loops and engine of a run.

    Attributes:
        engine: Integration of the bodies.
        motors: From commands to actual inputs.
        inner_loop: From commanded body rates to moments; None where moments are commanded.
    """

    def __init__(self, setup: PlantRun, engine: Engine) -> None:
        section = setup.section
        self.engine = engine
        self._period_s = setup.run.settings.sampling_period_s
        self._parts = 1
        if setup.run.settings.inputs != "moments":
            self._parts = _at_least(self._period_s / INNER_STEP_S)
        self._part_s = self._period_s / self._parts
        self._steps = _at_least(self._part_s / section.step_s)  # of integration, in a part
        self.inner_loop = inner_loop(setup, self._part_s)

        # Motors that will degrade tell what they give from the first tick on.
        degrades = any(fault.do == "degrade" for fault in setup.run.rules.faults)
        factors = np.ones(setup.run.system.N)
        for one in section.uav:
            factors[one.id - 1] = one.thrust_factor
        self.motors = Motors(section.motors, setup.run.hover.u, fails=degrades, factors=factors)

    @property
    def follows_commands(self) -> bool:
        """Whether actual inputs are the commands."""
        return self.motors.ideal and self.inner_loop is None

    @property
    def failure(self) -> str:
        """Why the run ends, as the engine or an inner loop has failed; empty while both work."""
        if self.engine.failure or self.inner_loop is None:
            return self.engine.failure
        return self.inner_loop.failure

    def over_period(self, x: Array, u: Array, forces: Array | None) -> Integrated:
        """Return the plant after a period from state x, (12 + 12 N,).

        Args:
            x: State at its beginning.
            u: Commands over it, (4 N,).
            forces: External forces, (3 + 3 N,), N; None without wind.
        """
        end = self.begin(x, u)
        for _ in range(self._parts):
            command = u
            if self.inner_loop is not None:
                rates = u.reshape(-1, state.INPUTS)
                command = self.inner_loop.moments(rates, end.x).reshape(-1)
            end = self.part(end, command, forces, self._part_s, self._steps)
        return end

    def begin(self, x: Array, u: Array) -> Integrated:
        """Return the plant at the beginning of a period in state x under commands u, (4 N,)."""
        return Integrated(
            x=x,
            error=UNKNOWN_ERROR,  # less than any error
            actual=u,
            mean=np.zeros_like(u),
            tensions=np.array([np.inf]),  # the least ones have the shape of the engine's
        )

    def part(
        self, until: Integrated, command: Array, forces: Array | None, part_s: float, steps: int
    ) -> Integrated:
        """Integrate a part of a period, s, with thrust and moments commanded, (4 N,), in some steps."""
        x, error, actual = until.x, until.error, until.actual
        mean, tensions = until.mean, until.tensions
        for actual, duration_s in self.motors.inputs(command, part_s, steps):
            x, local_error = self.engine.advance(actual, forces, duration_s)
            error = max(local_error, error)
            mean = mean + duration_s / self._period_s * actual
            tensions = np.minimum(tensions, self.engine.tensions)
        return Integrated(x=x, error=error, actual=actual, mean=mean, tensions=tensions)


def _at_least(ratio: float) -> int:
    """Return a ratio rounded up, but not for its rounding error."""
    return math.ceil(ratio - _ROUNDING)
