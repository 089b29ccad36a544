"""Controllers of a user whose data make an error visible."""

import math
from collections.abc import Sequence

import numpy as np

from transport.agent.user_class.returned_values import Step
from transport.agent.user_class.run_for_user import Run
from transport.model.arrays import Array
from transport.protocol.wire.messages import Measurement, Plan

HEIGHT = 2  # place of the payload's height in the state
SWAY_N = 0.5  # changes of the thrust of `Estimating`, a few per cent of the hover's


class Chain:
    """A chain over all that was heard: loss, order, repetition or a bit shows in all that follows.

    The data are [[tick, agent], [chain, errors]]; the thrust has a share of the chain, so that the
    plant shows it too.
    """

    version = "1"
    shape = (2, 2)  # of the data

    def start(self, run: Run) -> None:
        """Declare the data."""
        run.share(self.shape)
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


class Bulky(Chain):
    """A class with as many data as a plan may have, and the inputs of ten ticks from tick 5 on."""

    shape = (512, 1)

    def hear(self, messages: Sequence[Plan]) -> None:
        """Hear nothing."""

    def result(self) -> tuple[Array, Array, dict[str, float]]:
        """Return hover inputs and the data."""
        u = self.run.u_hover.reshape(-1, 4)[list(self.run.owned)].ravel()
        rows = 1 if self.run.tick < 5 else 10
        return np.tile(u, (rows, 1)), np.full(self.shape, float(self.run.tick)), {}


class Seldom(Chain):
    """A class that sends nothing but at every fifth tick."""

    every = 5  # ticks

    def step(self, measurement: Measurement, messages: Sequence[Plan]) -> Step:  # type: ignore[override]
        """Return the full form of a result."""
        self.hear(messages)
        inputs, data, numbers = self.result()
        numbers |= {"must_send": self.run.must_send, "heard": len(messages)}
        send = self.run.tick % self.every == 0
        return Step(inputs=inputs, data=data, numbers=numbers, send=send)


class Estimating:
    """A class that moves its UAVs a little and logs the project's estimate.

    The state is logged as x0, x1, ..., the deviation is that of the payload's height.
    """

    def start(self, run: Run) -> None:
        """Ask for the estimate."""
        self.run = run
        self.estimate = run.estimator()

    def step(
        self, measurement: Measurement, messages: Sequence[Plan]
    ) -> tuple[Array, dict[str, float]]:
        """Return level attitudes with a swaying thrust, by the measurement, and the estimate.

        At rest an estimate that never changes would be right.
        """
        run = self.run
        u = run.u_hover.reshape(-1, 4)[list(run.owned)].copy()
        for row, uav in enumerate(run.owned):
            turn = -100.0 * run.attitude(uav, measurement) - 16.0 * run.body_rate(uav, measurement)
            u[row, 0] += SWAY_N * math.sin(run.tick + uav)
            u[row, 1:] = run.system.uavs[uav].inertia @ turn
        x = self.estimate.x
        P = self.estimate.covariance
        numbers = {f"x{i}": value for i, value in enumerate(x[: run.system.n])}
        # -1: an estimator without covariance.
        deviation = -1.0 if P is None else float(np.sqrt(P[HEIGHT, HEIGHT]))
        return u.ravel(), {**numbers, "deviation": deviation}

    def stop(self) -> None:
        """Nothing is open."""
