"""The path by which the payload is judged, and the path that the fail-safe of the UAVs follows.

They are two, as not all that one agent is told is known to all:

    given    every target from its tick on, told to all agents or some; a run diverges too far from it.
    shared   the targets that the whole team knows, with its stops in silence. UAVs without an agent follow it.

A target that only some agents are told enters the shared path once the plans of all agents on the roster have
carried it. One that agents make because of an obstacle comes with plans only, and enters both then.
"""

from collections.abc import Collection, Sequence

import numpy as np

from transport.model.path.maneuver import Maneuver
from transport.mpc.alone.fail_safe import FailSafe
from transport.protocol.admission.known_targets import KnownTargets
from transport.protocol.admission.stop_in_silence import Stopping
from transport.protocol.admission.targets_in_plans import Place, carried_by, is_of_sight, place_of
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import Plan, Target


class TeamPaths:
    """The given and the shared path of a run.

    Attributes:
        given_I: Places of the payload on the given path at the sampling instants, (ticks + 1, 3), m.
    """

    def __init__(self, run: TeamRun) -> None:
        self._run = run  # with every target, for the given path
        self._period_s = run.settings.sampling_period_s
        instants_s = self._period_s * np.arange(run.rules.ticks + 1, dtype=np.float64)
        self.given_I, _ = run.maneuver.path(instants_s)

        self._whole_team = run.whole_team()
        self._shared = KnownTargets(run)
        self._informed: dict[
            Place, set[int]
        ] = {}  # by target, the agents whose plans have carried it
        self._stopping: Stopping | None = None
        if run.settings.silence == "stop":
            self._stopping = Stopping(self._period_s, run.ticks)

    @property
    def fail_safe(self) -> FailSafe:
        """The fail-safe of the whole team, along the shared path."""
        return self._whole_team.law.fail_safe

    def tell(self, target: Target, k: int) -> bool:
        """Take in a target of the coordinator at tick k; return whether the shared path is a new one."""
        self._run = self._run.led_to(target)
        self._give(self._run.maneuver, target.tick)
        return not target.to and self._share(target, k)

    def hear(self, plans: Sequence[Plan], k: int, roster: Collection[int]) -> bool:
        """Take in plans that become usable at tick k; return whether the shared path is a new one."""
        is_new = False
        for plan in plans:
            for target in carried_by(plan):
                is_waiting = target.informed and not target.begins
                if is_waiting or self._shared.knows(target):
                    continue
                informed = self._informed.setdefault(place_of(target), set())
                informed.add(plan.agent)
                if informed.issuperset(roster):
                    is_new |= self._share(target, k)
        return self._keep_pace(plans, k, roster) or is_new

    def _share(self, target: Target, k: int) -> bool:
        """Lead the shared path to a target; return whether it does not already."""
        if not self._shared.add(target):
            return False
        self._follow_shared()
        if is_of_sight(target):
            self._give(self._shared.setup.maneuver, k)
        return True

    def _keep_pace(self, plans: Sequence[Plan], k: int, roster: Collection[int]) -> bool:
        """Stop the shared path in silence, and go on with the agents on the roster; return whether it is new."""
        if self._stopping is None:
            return False
        self._stopping.hear(plans)
        _, v_I = self._shared.setup.maneuver.path(np.array([k * self._period_s]))
        loss = self._stopping.advance(
            k,
            is_alone=self._stopping.is_any_alone(roster),
            roster=roster,
            speed_mps=float(np.linalg.norm(v_I)),
        )
        if loss is None:
            return False
        self._shared.slow(loss)
        self._follow_shared()
        return True

    def _follow_shared(self) -> None:
        """Let the law of the whole team follow the newest change of the shared path."""
        reference = self._shared.setup.reference.sampled
        if reference.change is not None:
            self._whole_team.follow(reference, reference.change)

    def _give(self, maneuver: Maneuver, since: int) -> None:
        """Take a maneuver as the given path from a tick on; before it the path stays the same, bit for bit."""
        instants = np.arange(since, len(self.given_I), dtype=np.float64)
        self.given_I[since:], _ = maneuver.path(self._period_s * instants)
