"""The LQR of lqr.py for a network with delay and packet loss.

Every agent predicts the others instead of waiting.

In the folder of this file: transport run resilient --set agents.controller=predicting:Predicting,
and with --set links.delay_s=0.4 --set links.loss=0.3 the same cost.
"""

from lqr import LQR

CORRECTION = 0.2  # share of a difference that a late state corrects


class Predicting(LQR):
    """Controller of the UAVs that an agent owns, from a model of the whole team under the same gain."""

    def start(self, run):
        """Compute the gain; nothing is predicted yet."""
        super().start(run)
        self.inputs, self.predicted = run.u_hover, {}

    def update(self, measurement, messages):
        """Move the team on by one period, then take in what is measured now and what was true some time ago."""
        if self.predicted:
            self.x = self.run.model.integrate(self.x, self.inputs, self.run.period_s, 2)[0].copy()
        self.x[:12] = measurement.payload
        for plan in (plan for plan in messages if plan.tick in self.predicted):
            for uav, state in zip(plan.uavs, plan.uav_states, strict=True):
                block = slice(12 * uav, 12 * uav + 12)
                self.x[block] += CORRECTION * (state - self.predicted[plan.tick][block])
        for uav, state in zip(measurement.uavs, measurement.uav_states, strict=True):
            self.x[12 * uav : 12 * uav + 12] = state
        self.predicted[self.run.tick] = self.x.copy()
