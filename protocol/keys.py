"""Key expressions: the only place that knows under which key a message travels and who listens to it.

transport/{run}/tick                     coordinator -> plant
transport/{run}/measurement/{agent}      plant -> that agent
transport/{run}/plan/{agent}             agent -> other agents, plant, coordinator
transport/{run}/roster, .../link, .../control     coordinator -> everybody
transport/{run}/truth                    plant -> coordinator, recorder
transport/{run}/report/{agent}           agent -> recorder
transport/{run}/ask/{name}               queryable: coordinator and recorder answer requests
transport/{run}/alive/{name}/{incarnation}/{digest}     liveliness token: the process is up
transport/{run}/ready/{name}/{incarnation}              liveliness token: it has seen all the others
"""

import re
from dataclasses import dataclass

from protocol.messages import (
    Control,
    FaultNote,
    LinkChange,
    Measurement,
    Message,
    MessageError,
    Plan,
    Roster,
    StepReport,
    Tick,
    Truth,
)

_RUN = re.compile(r"[A-Za-z0-9_.-]{1,80}")
_PER_AGENT = ("measurement", "plan", "report")


class RunNameError(ValueError):
    """A run name that cannot be part of a key expression."""


@dataclass(frozen=True, slots=True)
class Keys:
    """Key expressions of one run.

    Args:
        run: Name of the run: letters, digits, underscore, dot, dash.
    """

    run: str

    def __post_init__(self) -> None:
        if not self.allows(self.run):
            raise RunNameError(f"run name: expected at most 80 letters, digits, '_', '.', '-', got {self.run!r}")

    @staticmethod
    def allows(run: str) -> bool:
        """Whether a run can have this name."""
        return _RUN.fullmatch(run) is not None

    @property
    def prefix(self) -> str:
        """Everything of this run is below it."""
        return f"transport/{self.run}"

    def of(self, message: Message) -> str:
        """Key a message travels under."""
        match message:
            case Measurement(agent=agent) | Plan(agent=agent) | StepReport(agent=agent):
                return f"{self.prefix}/{message.kind}/{agent}"
        return f"{self.prefix}/{message.kind}"

    def subscriptions(self, name: str) -> list[str]:
        """Key expressions a process listens to, by its name."""
        everybody = [f"{self.prefix}/{kind}" for kind in (Roster.kind, LinkChange.kind, Control.kind)]
        plans = f"{self.prefix}/{Plan.kind}/*"
        if name == "recorder":
            return [
                *everybody,
                *[f"{self.prefix}/{kind}" for kind in (Tick.kind, Truth.kind)],
                *[f"{self.prefix}/{kind}/*" for kind in _PER_AGENT],
            ]
        if name == "coordinator":
            return [plans, f"{self.prefix}/{Truth.kind}"]
        if name == "plant":
            return [*everybody, plans, f"{self.prefix}/{Tick.kind}"]
        return [*everybody, plans, f"{self.prefix}/{Measurement.kind}/{name.removeprefix('agent')}"]

    def alive(self, name: str, incarnation: int, digest: str) -> str:
        """Liveliness token of a process that is up; the digest is its scenario's."""
        return f"{self.prefix}/alive/{name}/{incarnation}/{digest}"

    def ready(self, name: str, incarnation: int) -> str:
        """Liveliness token of a process that has seen all the others."""
        return f"{self.prefix}/ready/{name}/{incarnation}"

    def is_ready(self, key: str, name: str) -> bool:
        """Whether a key is the `ready` token of a process."""
        return key.startswith(f"{self.prefix}/ready/{name}/")

    def requests(self, name: str) -> str:
        """Where a process answers requests."""
        return f"{self.prefix}/ask/{name}"

    def check_sender(self, key: str, message: Message) -> None:
        """Refuse a message that travels under a key its sender does not own.

        Raises: MessageError: with the key and the sender.
        """
        if key != self.of(message):
            raise MessageError(f"{message.kind} of {message.sender} under the key {key}")
        owner = _OWNERS.get(message.kind) or f"agent{key.rsplit('/', 1)[1]}"
        if message.sender != owner:
            raise MessageError(f"{message.kind} from {message.sender}, expected it from {owner}")


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
    Truth.kind: "plant",
}
