"""Key expressions: the only place that knows under which key a message travels and who listens to it.

transport/{run}/tick                     coordinator -> plant
transport/{run}/measurement/{agent}      plant -> that agent
transport/{run}/plan/{agent}             agent -> other agents, plant, coordinator
transport/{run}/unshared/{agent}         agent -> plant, coordinator: plans that the other agents do not get
transport/{run}/roster, .../control      coordinator -> everybody; changes of links come under the key of the roster
transport/{run}/plant_state                    plant -> coordinator, recorder
transport/{run}/report/{agent}           agent -> recorder
transport/{run}/rejected/{name}          anybody -> recorder
transport/{run}/ask/{name}/{what}        queryable: every process answers requests, each thing under a key of its own
transport/{run}/alive/{name}/{incarnation}/{digest}/{version}     liveliness token: the process is up
transport/{run}/ready/{name}/{incarnation}              liveliness token: it has seen all the others
"""

import re
from dataclasses import dataclass, field

from protocol.wire.messages import (
    Control,
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    MessageError,
    Plan,
    PlantState,
    Rejected,
    Roster,
    StepReport,
    Tick,
)

_RUN = re.compile(r"[A-Za-z0-9_.-]{1,80}")
_ALIVE = re.compile(r"alive/([^/]+)/([0-9]{1,15})/([^/]+)(?:/([0-9]{1,5}))?")
_READY = re.compile(r"ready/([^/]+)/([0-9]{1,15})()()")
# Where plans travel that are not shared with the other agents: they have no subscription that covers it.
_UNSHARED = "unshared"
# One key per agent or process.
_SEVERAL = (Measurement.kind, Plan.kind, _UNSHARED, StepReport.kind, Rejected.kind)

# Name of the process that records a run and takes no other part in it.
RECORDER = "recorder"
# Name of those who look on, say nothing and announce no token: nobody in the run knows of them.
WATCHER = "watcher"
# Who also changes what it sees: links, faults. It says nothing either, it asks.
OPERATOR = "operator"
# Who passes on what others say, where hosts do not reach each other.
ROUTER = "router"

# What anybody may ask for, and what is asked by those who act on a run.
READING, ACTING = ("status", "health"), ("link", "fault")

# Processes of before version 3 did not say theirs.
_UNTOLD_VERSION = 2


class RunNameError(ValueError):
    """A run name that cannot be part of a key expression."""


@dataclass(frozen=True, slots=True)
class Token:
    """What a liveliness token says.

    Attributes:
        name: Process name.
        incarnation: Which start of it.
        digest: Of its scenario, or None for a token that does not say.
        version: Of the protocol it speaks, where it says its scenario.
    """

    name: str
    incarnation: int
    digest: str | None
    version: int | None


@dataclass(frozen=True, slots=True)
class Keys:
    """Key expressions of one run.

    Args:
        run: Name of the run: letters, digits, underscore, dot, dash.

    Attributes:
        prefix: Everything of this run is below it.
    """

    run: str
    prefix: str = field(init=False)

    def __post_init__(self) -> None:
        if not self.allows(self.run):
            raise RunNameError(f"run name: expected at most 80 letters, digits, '_', '.', '-', got {self.run!r}")
        object.__setattr__(self, "prefix", f"transport/{self.run}")

    @classmethod
    def below(cls, prefix: str) -> "Keys":
        """Key expressions below a prefix that may stand for several runs, `transport/*`: nothing is sent under them."""
        keys = cls("any")
        object.__setattr__(keys, "prefix", prefix)
        return keys

    @staticmethod
    def allows(run: str) -> bool:
        """Whether a run can have this name."""
        return _RUN.fullmatch(run) is not None

    def of(self, message: Message) -> str:
        """Key a message travels under."""
        match message:
            case Plan(agent=agent, shared=False):
                return f"{self.prefix}/{_UNSHARED}/{agent}"
            case Measurement(agent=agent) | Plan(agent=agent) | StepReport(agent=agent):
                return f"{self.prefix}/{message.kind}/{agent}"
            case Rejected(sender=sender):
                return f"{self.prefix}/{message.kind}/{sender}"
            case LinkChange():
                # Order holds under one key alone: who has the roster that follows a change has the change.
                return f"{self.prefix}/{Roster.kind}"
        return f"{self.prefix}/{message.kind}"

    def subscriptions(self, name: str) -> list[str]:
        """Key expressions a process listens to, by its name."""
        everybody = [f"{self.prefix}/{kind}" for kind in (Roster.kind, Control.kind)]
        plans, unshared = f"{self.prefix}/{Plan.kind}/*", f"{self.prefix}/{_UNSHARED}/*"
        if name == RECORDER:
            return [
                *everybody,
                *[f"{self.prefix}/{kind}" for kind in (Tick.kind, PlantState.kind)],
                *[f"{self.prefix}/{kind}/*" for kind in _SEVERAL],
            ]
        if name == WATCHER:  # what it shows is in the reports: plans and measurements would only be a load
            return [
                *everybody,
                *[f"{self.prefix}/{kind}" for kind in (Tick.kind, PlantState.kind)],
                *[f"{self.prefix}/{kind}/*" for kind in (StepReport.kind, Rejected.kind)],
            ]
        if name == "coordinator":
            return [plans, unshared, f"{self.prefix}/{PlantState.kind}"]
        if name == "plant":
            return [*everybody, plans, unshared, f"{self.prefix}/{Tick.kind}"]
        return [*everybody, plans, f"{self.prefix}/{Measurement.kind}/{name.removeprefix('agent')}"]

    def publications(self, name: str) -> list[str]:
        """Key expressions a process may publish under, by its name; those that look on have none."""
        if name == "coordinator":
            kinds = [Tick.kind, Roster.kind, Control.kind]
        elif name == "plant":
            kinds = [f"{Measurement.kind}/*", PlantState.kind]
        elif name.startswith("agent"):
            kinds = [f"{kind}/{name.removeprefix('agent')}" for kind in (Plan.kind, _UNSHARED, StepReport.kind)]
        else:
            return []
        return [f"{self.prefix}/{end}" for end in (*kinds, f"{Rejected.kind}/{name}")]

    def alive(self, name: str, incarnation: int, digest: str, version: int) -> str:
        """Liveliness token of a process that is up; digest of its scenario, version of the protocol it speaks."""
        return f"{self.prefix}/alive/{name}/{incarnation}/{digest}/{version}"

    def ready(self, name: str, incarnation: int) -> str:
        """Liveliness token of a process that has seen all the others."""
        return f"{self.prefix}/ready/{name}/{incarnation}"

    def is_token(self, key: str) -> bool:
        """Whether a key is that of a liveliness token."""
        return self.end(key).startswith(("alive/", "ready/"))

    def is_ready(self, key: str, name: str) -> bool:
        """Whether a key is the `ready` token of a process."""
        return key.startswith(f"{self.prefix}/ready/{name}/")

    def request(self, name: str, what: str) -> str:
        """Where a process is asked for something; `*` for everything it can be asked for."""
        return f"{self.prefix}/ask/{name}/{what}"

    def token(self, key: str) -> Token:
        """What the key of a liveliness token says.

        Raises: MessageError: it is none of this run.
        """
        end = self.end(key)
        found = _ALIVE.fullmatch(end) or _READY.fullmatch(end)
        if found is None:
            raise MessageError("malformed", f"expected the key of a token, got {key}")
        digest = found[3] or None
        version = None if digest is None else int(found[4]) if found[4] else _UNTOLD_VERSION
        return Token(found[1], int(found[2]), digest, version)

    def end(self, key: str) -> str:
        """A key without what is the same for all keys of the run."""
        return key.removeprefix(f"{self.prefix}/")

    def check_sender(self, key: str, message: Message) -> None:
        """Refuse a message that travels under a key its sender does not own.

        Raises: MessageError: with the key and the sender.
        """
        if key != self.of(message):
            text = f"{message.kind} of {message.sender} under the key {key}"
            raise MessageError("wrong_sender", text, message.sender)
        if isinstance(message, Rejected):
            return  # the key is the sender's
        owner = _OWNERS.get(message.kind) or f"agent{key.rsplit('/', 1)[1]}"
        if message.sender != owner:
            text = f"{message.kind} from {message.sender}, expected it from {owner}"
            raise MessageError("wrong_sender", text, message.sender)


def matches(expression: str, key: str) -> bool:
    """Whether a key expression of `Keys.subscriptions` covers a key (a trailing `*` is one chunk)."""
    if not expression.endswith("/*"):
        return expression == key
    head, _, last = key.rpartition("/")
    return head == expression[:-2] and bool(last)


_OWNERS = {
    Tick.kind: "coordinator",
    Roster.kind: "coordinator",
    LinkChange.kind: "coordinator",
    Control.kind: "coordinator",
    FaultNote.kind: "recorder",
    Measurement.kind: "plant",
    PlantState.kind: "plant",
}
