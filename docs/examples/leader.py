"""A leader and followers: agent 1 says where the team is to be, the others follow what they have heard last.

In the folder of this file: transport run resilient --set agents.controller=leader:Leader, with
--set 'maneuver.target=[{at_s=5,points_m=[[2,0,-10]],to=[1]}]' and --set links.delay_s=0.2.
"""

from predicting import Predicting

LEADER = 1


class Leader(Predicting):
    """Controller of the UAVs that an agent owns; its reference is that of the leader, as old as the news of it."""

    def start(self, run):
        """Share a reference state with each plan."""
        super().start(run)
        run.share(len(run.x_hover))
        self.led, self.heard = run.reference(0), -1

    def update(self, measurement, messages):
        """Take in the newest states, and a follower the newest reference of the leader."""
        super().update(measurement, messages)
        for plan in messages:
            if plan.agent == LEADER and plan.tick > self.heard and plan.data.size:
                self.led, self.heard = plan.data, plan.tick

    def goal(self):
        """Return the own reference of the leader, and the newest one that a follower has heard."""
        if self.run.agent == LEADER:
            self.led = super().goal()
        return self.led

    def step(self, measurement, messages):
        """Return the inputs, the reference for the others, and how many targets the agent knows for the log."""
        inputs = super().step(measurement, messages)
        return inputs, self.led, {"targets": float(len(self.run.targets))}
