"""Controllers of a user whose data make an error visible."""

import math
from collections.abc import Sequence

import numpy as np

from transport.agent.own_returned import Step
from transport.agent.own_run import Run
from transport.model.arrays import Array
from transport.protocol.wire.messages import Measurement, Plan


class Chain:
    """A chain over all that was heard: loss, order, repetition or a bit shows in all that follows.

    The data are [[tick, agent], [chain, errors]]; the thrust has a share of the chain, so that the
    plant shows it too.
    """

    version = "1"

    def start(self, run: Run) -> None:
        """Declare the data."""
        run.share((2, 2))
        self.run = run
        self.chain = float(run.agent)
        self.errors = 0

    def step(
        self, measurement: Measurement, messages: Sequence[Plan]
    ) -> tuple[Array, Array, dict[str, float]]:
        """Return inputs, data and numbers for the log."""
        self.hear(messages)
        return self.result()

    def negotiate(
        self, iteration: int, messages: Sequence[Plan]
    ) -> tuple[Array, Array, dict[str, float]]:
        """Return the same, with the proposals of an exchange in the chain."""
        self.chain = math.fmod(self.chain + iteration, 10.0)
        self.hear(messages)
        return self.result()

    def hear(self, messages: Sequence[Plan]) -> None:
        """Take the data of the others into the chain, which depends on their order."""
        for plan in messages:
            if plan.data.size:
                (tick, agent), (chain, _) = plan.data
                self.errors += (tick, agent) != (plan.tick, plan.agent)
                self.chain = math.fmod(1.37 * self.chain + chain + 0.01 * agent, 10.0)

    def result(self) -> tuple[Array, Array, dict[str, float]]:
        """Return hover inputs with a share of the chain, the data, and numbers for the log."""
        run = self.run
        inputs = run.u_hover.reshape(-1, 4)[list(run.owned)].copy()
        inputs[:, 0] += 1e-3 * self.chain
        data = np.array([[run.tick, run.agent], [self.chain, self.errors]], dtype=float)
        return inputs.ravel(), data, {"chain": self.chain, "errors": self.errors}

    def stop(self) -> None:
        """Nothing is open."""


class Seldom(Chain):
    """A class that sends nothing but at every fifth tick."""

    def step(self, measurement: Measurement, messages: Sequence[Plan]) -> Step:  # type: ignore[override]
        """Return the full form of a result."""
        self.hear(messages)
        inputs, data, numbers = self.result()
        numbers |= {"must": self.run.must_send, "heard": len(messages)}
        return Step(inputs=inputs, data=data, numbers=numbers, send=self.run.tick % 5 == 0)


class Estimating:
    """A class that only looks at the project's estimate."""

    def start(self, run: Run) -> None:
        """Ask for the estimate."""
        self.run = run
        self.estimate = run.estimator()

    def step(
        self, measurement: Measurement, messages: Sequence[Plan]
    ) -> tuple[Array, dict[str, float]]:
        """Return level hover by the measurement, and what the estimate says."""
        run = self.run
        u = run.u_hover.reshape(-1, 4)[list(run.owned)].copy()
        for row, uav in enumerate(run.owned):
            turn = -100.0 * run.attitude(uav, measurement) - 16.0 * run.body_rate(uav, measurement)
            u[row, 1:] = run.system.uavs[uav].inertia @ turn
        x = self.estimate.x
        P = self.estimate.covariance
        names = {f"x{i}": value for i, value in enumerate(x[:60])}
        deviation = -1.0 if P is None else float(np.sqrt(P[2, 2]))
        return u.ravel(), {**names, "deviation": deviation}

    def stop(self) -> None:
        """Nothing is open."""
