"""The path that one agent follows: targets told to it, heard in plans or made by it, and stops in silence.

A target comes to the agent in one of three ways:

    told    by the coordinator; it begins at its tick
    heard   in a plan of another agent, which was told it or made it; checked, refused with a note
    made    by this agent, where its path comes too near to an obstacle that its UAVs have seen

With `controller.targets = "confirmed"` one that only some agents are told waits until all on the roster have
it (`agent.communication.target_confirmation`). Two agents that know the same targets have the same path
(`protocol.admission.known_targets`), whenever each heard of them. Stops in silence delay it
(`protocol.admission.stop_in_silence`). Whatever changes the path is handed to the planner at once.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from operator import itemgetter
from typing import Any

import numpy as np
from msgspec.structs import replace

from transport.agent.communication.target_confirmation import Unconfirmed
from transport.agent.planner import AgentPlanner
from transport.agent.planning.sight import Sight
from transport.agent.planning.step_report import numbers_note
from transport.agent.received import Received
from transport.protocol.admission.known_targets import KnownTargets, braking_only
from transport.protocol.admission.stop_in_silence import MOSTLY, Stopping
from transport.protocol.admission.targets_in_plans import Place, carried_by, is_of_sight, place_of
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.errors_and_exit_codes import MessageError
from transport.protocol.wire.messages import Message, Plan, Target
from transport.protocol.wire.names import agent_name
from transport.protocol.wire.outbox import Outbox

_ROUNDING_TICKS = 1e-6  # of a time over the sampling period


class FollowedPath:
    """The path of one agent, 1-based, and the targets that lead it.

    Attributes of a tick come with `begin`; the planner is told of each change of the path.
    """

    def __init__(self, setup: TeamRun, agent: int, planner: AgentPlanner[Any]) -> None:
        self._agent = agent
        self._planner = planner
        self._ticks = setup.ticks
        self._period_s = setup.settings.sampling_period_s

        self._targets = KnownTargets(setup)
        self._told: deque[Target] = deque()  # to this agent, still to come
        self._own_targets: set[Place] = set()  # told to it and begun, or made by it
        self._refused: set[tuple[int, Place]] = set()  # by the agent whose plan carried it
        self._confirms = setup.settings.targets == "confirmed"
        self._unconfirmed = Unconfirmed(agent)

        self._sight = Sight(agent)
        self._is_path_new = False  # since what has been seen was compared with it
        self._stopping: Stopping | None = None
        if setup.settings.silence == "stop":
            self._stopping = Stopping(self._period_s, setup.ticks)

    def tell(self, target: Target) -> None:
        """Keep a target that this agent is told until its tick."""
        if not target.to or self._agent in target.to:
            self._told.append(target)

    def return_to_roster(self, tick: int) -> None:
        """Go on as a new process of the run: with the targets, but with the progress of the others."""
        self._unconfirmed.returned(tick)
        if self._stopping is not None:
            self._stopping.begin_anew()

    def begin(self, received: Received, since: Mapping[int, int], out: Outbox) -> list[Message]:
        """Lead the path to the newest target that has begun by a tick; return notes of what was refused or made.

        Targets are followed in turn: the motion of the team to the newest one began on the way to those before.
        One that is heard late is followed where its motion is by now.

        Args:
            received: Messages of the tick.
            since: Ticks since which the agents on the roster take part.
            out: Makes the notes.
        """
        tick = received.tick
        while self._told and self._told[0].tick <= tick:
            target = self._told.popleft()
            self._own_targets.add(place_of(target))
            self._learn(target, tick)
        notes = self._hear(received.plans, tick, since, out)
        for target in self._unconfirmed.confirmed(tick, received.agents, since):
            self._learn(self._begun(target, tick), tick)
        self._keep_pace(received)
        return notes + self._keep_clear(received, out)

    def with_targets(self, messages: Sequence[Message], tick: int) -> list[Message]:
        """Return the messages of a step; its plan, if there is one, carries targets and the lag of the path."""
        stopping = self._stopping
        lag = 0 if stopping is None else stopping.lag
        behind = 0 if stopping is None else stopping.behind(tick)
        carried = self._targets.carried(tick - behind, self._unconfirmed.carried())
        if not carried and not lag:
            return list(messages)
        return [
            replace(message, targets=carried, lag=lag) if _is_plan_of_tick(message) else message
            for message in messages
        ]

    # Targets

    def _learn(self, target: Target, tick: int) -> None:
        """Follow a target unless it is known, or keep it until all on the roster have it.

        One because of an obstacle is followed up to its rest at once.
        """
        place = place_of(target)
        if self._confirms and target.to and not target.begins:
            is_new = place > self._targets.newest or self._unconfirmed.has(place)
            if is_new and self._unconfirmed.take(target, tick):
                self._planner.announce()
            if is_of_sight(target) and self._unconfirmed.has(place):
                self._follow(braking_only(target))
            return
        self._follow(target)
        self._unconfirmed.forget(place)
        self._unconfirmed.forget_before(self._targets.newest)

    def _follow(self, target: Target) -> None:
        """Lead the path to a target, unless it does already."""
        if self._targets.add(target):
            self._is_path_new = True
            self._planner.follow(self._targets.setup)

    def _begun(self, target: Target, tick: int) -> Target:
        """Return a target that all have; one because of an obstacle begins by the own progress."""
        if not is_of_sight(target):
            return target
        progress_s = self._targets.setup.maneuver.progress(tick * self._period_s)
        progress = math.ceil(progress_s / self._period_s - _ROUNDING_TICKS)
        return replace(target, begins=max(progress, target.tick, 1))  # 0: not begun

    def _hear(
        self, plans: Sequence[Plan], tick: int, since: Mapping[int, int], out: Outbox
    ) -> list[Message]:
        """Follow the targets that plans carry; return a note for each that is refused."""
        notes: list[Message] = []
        carried = [
            (place_of(target), plan.agent, target) for plan in plans for target in carried_by(plan)
        ]
        for place, sender, target in sorted(carried, key=itemgetter(0, 1)):
            is_known = self._targets.knows(target) and not self._unconfirmed.has(place)
            if is_known or (sender, place) in self._refused:
                continue
            try:
                self._check_heard(target, since.get(self._agent, tick))
            except MessageError as error:
                self._refused.add((sender, place))
                problem = f"target of tick {target.tick} in a plan of {agent_name(sender)}: {error}"
                notes.append(numbers_note(tick, self._agent, {}, out, problem))
                continue
            self._learn(target, tick)
        return notes

    def _check_heard(self, target: Target, here_since: int) -> None:
        """Refuse a target that this agent would have been told itself, or that is out of reach.

        Raises: MessageError: with the reason.
        """
        was_here = target.tick >= here_since
        if self._agent in target.to and was_here and place_of(target) not in self._own_targets:
            name = agent_name(self._agent)
            raise MessageError(
                "wrong_sender", f"expected one told to {name}, which has not been told"
            )
        self._targets.check(target)

    # Stops and obstacles

    def _keep_pace(self, received: Received) -> None:
        """Stop the path in silence, and go on with the others after it."""
        if self._stopping is None:
            return
        self._stopping.hear(received.plans)
        now_s = np.array([received.tick * self._period_s])
        _, v_I = self._targets.setup.maneuver.path(now_s)
        loss = self._stopping.advance(
            received.tick,
            is_alone=self._planner.share_alone > MOSTLY,  # until now
            roster=received.agents,
            speed_mps=float(np.linalg.norm(v_I)),
        )
        if loss is not None:
            self._is_path_new = True
            self._targets.slow(loss)
            self._planner.follow(self._targets.setup)

    def _keep_clear(self, received: Received, out: Outbox) -> list[Message]:
        """Make a target that keeps clear of what has been seen, where the path does not; return a note.

        A path is compared once with the same obstacles.
        """
        sees_more = self._sight.take(received.measurement)
        if sees_more:
            self._planner.see(self._sight.seen)
        if not self._sight.seen or not (sees_more or self._is_path_new):
            return []

        now_s = received.tick * self._period_s
        left_s = (self._ticks - 1) * self._period_s - now_s
        along_s = self._targets.setup.maneuver.progress(now_s)
        avoidance = self._sight.avoid(self._targets.without_stops, along_s, left_s)
        if avoidance is None:
            self._is_path_new = False
            return []
        self._own_targets.add(place_of(avoidance.target))
        self._learn(avoidance.target, received.tick)
        self._is_path_new = False  # the target keeps clear itself
        return [numbers_note(received.tick, self._agent, {}, out, avoidance.text)]


def _is_plan_of_tick(message: Message) -> bool:
    """Return whether a message is the plan of a tick, not a proposal of a negotiation."""
    return isinstance(message, Plan) and message.negotiation == 0
