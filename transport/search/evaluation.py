"""Evaluation of a candidate: simulated in memory, ended as soon as it has failed for certain."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from typing import Any

import msgspec
import numpy as np

from transport.agent.planner import PROJECT
from transport.analysis.analysed_run import AnalysedRun
from transport.analysis.summary_assembly import summarise
from transport.flight.memory import simulate
from transport.log.run_log import Recorded, RunLog
from transport.model.state import StateView
from transport.protocol.scenario.faults.faults_by_tick import OF_PLANT
from transport.protocol.scenario.scenario_file import validate
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Message, PlantState
from transport.search.candidate import Base, Candidate
from transport.search.objective import SearchObjective

REFUSED = "refused"  # outcome of a candidate that the scenario refuses


class _Decided(Exception):  # noqa: N818 - no error: the run has failed, the rest of it tells nothing
    """Ends a run whose attitude has passed the limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """Result of a candidate."""

    key: str  # of candidate, scenario and objective
    robustness: float
    value: float  # of the objective
    outcome: str  # as in a summary; "failed" where the run was ended at its limit; "refused"
    end_s: float  # scenario time of the end
    reason: str = ""  # why it was refused
    # When the objective first passed its limit, s; None where it did not, or is of the whole run.
    passed_s: float | None = None

    @staticmethod
    def of(line: bytes) -> "Evaluation":
        """Return an evaluation from a line of JSON, in which an infinite value is null.

        Raises: ValueError: the line is none.
        """
        tree = msgspec.json.decode(line, type=dict[str, Any])
        if tree.get("value", 0.0) is None:
            tree["value"] = math.inf
        return msgspec.convert(tree, Evaluation)

    @property
    def failed(self) -> bool:
        """Return whether the run has failed; a refused candidate has not been flown."""
        return self.robustness < 0.0 and self.outcome != REFUSED

    @property
    def failed_s(self) -> float:
        """Return when a run has failed, s: at its limit, or at its end."""
        return self.end_s if self.passed_s is None else self.passed_s


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseVerdict:
    """Whether a case that fails is beyond physics and the control law, not a fault of the network."""

    # The project's centralized controller with perfect information fails as well; None: not known.
    beyond_physics: bool | None
    reason: str = ""  # why it is not known


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchProblem:
    """Scenario and objective of a search: what turns a candidate into a number."""

    base: Base
    objective: SearchObjective

    def key(self, candidate: Candidate) -> str:
        """Return the fingerprint of a candidate."""
        events = [(type(event).__name__, asdict(event)) for event in candidate.events]
        content = [self.base.digest, asdict(self.objective), events]
        text = json.dumps(content, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def evaluate(self, candidate: Candidate) -> Evaluation:
        """Simulate a candidate.

        One that the scenario refuses, or a class of the user when it starts, is as far from failing
        as can be.
        """
        key = self.key(candidate)
        try:
            scenario = candidate.scenario(self.base)
            return self.flown(key, Setup.of(scenario, self.base.source))
        except ScenarioError as error:
            return _refusal(key, error)

    def flown(self, key: str, setup: Setup) -> Evaluation:
        """Simulate a run. Raises: ScenarioError: a class of the user cannot be used."""
        period_s = setup.settings.sampling_period_s
        messages: list[Recorded] = []
        end_tick = 0

        def record(message: Message) -> None:
            nonlocal end_tick
            messages.append(Recorded(message=message, received_ns=0))
            if isinstance(message, PlantState):
                end_tick = message.tick
                if self._decides(message):
                    raise _Decided

        try:
            control = simulate(setup, record)
        except _Decided:
            outcome = "failed"
        else:
            outcome = control.outcome

        log = RunLog(header={}, messages=tuple(messages), cut="")
        run = AnalysedRun.of(setup, log)
        summary = summarise(run)
        value = self.objective.value(summary)
        survived = 1.0 if outcome == "completed" else end_tick / setup.ticks
        if summary["collision"]:
            survived = min(survived, summary["collision"]["at_s"] / (setup.ticks * period_s))

        return Evaluation(
            key=key,
            robustness=self.objective.robustness(value, survived),
            value=value,
            outcome=outcome,
            end_s=round(end_tick * period_s, 6),
            passed_s=self.objective.passed_s(run.series),
        )

    def _decides(self, state: PlantState) -> bool:
        """Return whether a state alone is a failure."""
        if self.objective.measure != "attitude":
            return False
        attitude_rad = np.abs(StateView(state.x).Theta0).max()
        return bool(np.degrees(attitude_rad) > self.objective.limit)

    def with_perfect_information(self, candidate: Candidate) -> Evaluation:
        """Evaluate the events with one agent for all UAVs, the plant's state, and a perfect network.

        The agent has the project's controller: a class of the user may be one for a single UAV.
        """
        try:
            scenario = _centralized(self.base)
        except ScenarioError as error:
            return _refusal(self.key(candidate), error)
        base = Base(scenario=scenario, source=self.base.source)
        problem = SearchProblem(base=base, objective=self.objective)
        return problem.evaluate(candidate.beyond_network())

    def verdict(self, candidate: Candidate) -> CaseVerdict:
        """Return whether a case that fails does so with perfect information as well."""
        with_events = self.with_perfect_information(candidate)
        if with_events.outcome == REFUSED:
            return CaseVerdict(beyond_physics=None, reason=with_events.reason)
        if not with_events.failed:
            return CaseVerdict(beyond_physics=False)
        if self.with_perfect_information(Candidate(())).failed:
            return CaseVerdict(beyond_physics=None, reason="it fails without any event as well")
        return CaseVerdict(beyond_physics=True)


def _refusal(key: str, error: ScenarioError) -> Evaluation:
    """Return the evaluation of a candidate that is refused."""
    return Evaluation(
        key=key, robustness=1.0, value=0.0, outcome=REFUSED, end_s=0.0, reason=str(error)
    )


def _centralized(base: Base) -> Scenario:
    """Return a scenario with the project's controller for all UAVs, which knows the state at once.

    Raises: ScenarioError: there is no such scenario.
    """
    tree: dict[str, Any] = base.scenario.tree()
    tree["agents"]["controller"] = PROJECT
    tree["agents"]["owned"] = [[uav["id"] for uav in tree["system"]["uav"]]]
    tree.pop("links", None)
    tree.pop("radio", None)
    tree["faults"]["event"] = [
        fault
        for fault in tree["faults"]["event"]
        if fault["do"] in OF_PLANT and fault["do"] != "sensors_off"
    ]
    tree["plant"]["sensors"] = "state"
    tree["plant"].pop("noise", None)
    tree["controller"]["estimator"] = "measured"

    return validate(tree, base.source)
