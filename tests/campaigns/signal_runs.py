"""Random runs of the signals campaign: settings and signals drawn from a seed and a number."""

import random
import signal
from dataclasses import dataclass
from typing import Literal

from tests.campaigns.inspection import COMMAND, DRAWING, FORK_SERVER, REPORT, VIEWER

# The start of agent 2 that waits until the scenario kills the first one.
SUCCESSOR = "agent2-1"
TARGETS = (
    *("coordinator", "plant", "agent1", "agent2", "agent3", "agent4", SUCCESSOR),
    *(FORK_SERVER, REPORT, DRAWING, VIEWER, COMMAND),
)
# How often each of them is a target.
_WEIGHTS = {COMMAND: 2, REPORT: 2, DRAWING: 2}

# Signals that are sent. A stop ends after a time, or never.
Kind = Literal["KILL", "STOP", "SEGV", "TERM", "INT", "HUP"]
KINDS: tuple[Kind, ...] = ("KILL", "STOP", "SEGV", "TERM", "INT", "HUP")
# Times after which a stopped process goes on, s: within every timeout, near Zenoh's 10 s, beyond; None for never, but
# for processes that the command waits for without a look at their state.
RESUMED_S: tuple[float | None, ...] = (None, 1.0, 7.0, 20.0)

# Share of injections before the run, and latest time after the start of their process, s.
_BEFORE, _JOINING_S = 0.3, 1.5
# The same for injections into command, report and viewer while the report is made, after its begin: it takes 1 s.
_REPORTING, _REPORTED_S = 0.4, 1.5
# Latest time after the start of a process that draws, s.
_DRAWN_S = 0.7
# Share of runs with figures and with a viewer, where no target needs them.
_FIGURES, _VIEWER = 0.2, 0.05
# Latest time after the first tick, s: a run takes about 3 s, so some injections come while the report is written.
_LATEST_S = 3.5
_PACED = "maneuver.phase=[{name='climb',duration_s=3.0,displacement_m=[0,0,-1.5]}]"
_UNPACED = "maneuver.phase=[{name='climb',duration_s=12.0,displacement_m=[0,0,-6.0]}]"
RESTART = 'faults.event=[{at_s=0.4,do="restart",target="agent2"}]'
_IMPAIRED = (
    "links={delay_s=0.06,jitter_s=0.05,loss=0.1}",
    "links={delay_s=0.02,loss=0.05,duplicate=0.2,reorder=0.2,reorder_s=0.1,measurement={loss=0.1},actuation={loss=0.1}}",
    "links.partition=[{between=['agent1','agent2'],start_s=0.5,end_s=1.0}]",
    "links.change=[{at_s=0.5,delay_s=0.1},{at_s=1.5,delay_s=0.0}]",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Injection:
    """A signal to one process.

    Attributes:
        target: One of `TARGETS`.
        kind: What is sent.
        since: Begin of `after_s`: the start of the process, the first tick, or the begin of the report.
        after_s: Time of the signal, s.
        resumed_s: Time from a stop to its end, s; None for never.
    """

    target: str
    kind: Kind
    since: Literal["start", "first tick", "report"]
    after_s: float
    resumed_s: float | None = None

    @property
    def is_final_stop(self) -> bool:
        """Whether it stops the process for good."""
        return self.kind == "STOP" and self.resumed_s is None

    @property
    def sent(self) -> str:
        """The signal sent, and when a stop ends."""
        return self.kind if self.resumed_s is None else f"{self.kind}, CONT after {self.resumed_s:g} s"

    @property
    def number(self) -> signal.Signals:
        """The signal."""
        return signal.Signals[f"SIG{self.kind}"]

    def __str__(self) -> str:
        return f"{self.sent} to {self.target} {self.after_s:.2f} s after the {self.since}"


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalRun:
    """A run as drawn: its number, changes of the scenario, injections in any order, with figures, with a viewer."""

    number: int
    settings: tuple[str, ...]
    injections: tuple[Injection, ...]
    figures: bool = False
    viewer: bool = False


def random_run(seed: int, number: int) -> SignalRun:
    """Draw a run from the seed and its number."""
    rng = random.Random(f"{seed}/{number}")  # noqa: S311  # no secret
    pace = rng.choice(("fast", "paced", "realtime"))
    settings = ["clock.barrier_timeout_s=1.0", f"clock.join_timeout_s={rng.choice(('10.0', '30.0'))}"]
    settings += [f"clock.on_agent_loss={rng.choice(('abort', 'continue'))}"]
    settings += [_UNPACED] if pace == "fast" else [_PACED, "clock.speed=1.0"]
    if pace == "realtime":
        settings += ["clock.mode=realtime", f"clock.on_overrun={rng.choice(('continue', 'continue', 'hold'))}"]
    elif rng.random() < 0.2:
        settings += ["controller.negotiation_iterations=2"]
    if rng.random() < 0.3:
        settings += [rng.choice(_IMPAIRED)]
    if pace != "realtime" and rng.random() < 0.3:
        settings += ["controller.negotiation_iterations=2"]
    count = 2 if rng.random() < 0.3 else 1
    injections = tuple(_random_injection(rng) for _ in range(count))
    targets = {injection.target for injection in injections}
    if SUCCESSOR in targets:
        settings += [RESTART]
    return SignalRun(
        number=number,
        settings=tuple(settings),
        injections=injections,
        figures=bool({REPORT, DRAWING} & targets) or rng.random() < _FIGURES,
        viewer=VIEWER in targets or rng.random() < _VIEWER,
    )


def _random_injection(rng: random.Random) -> Injection:
    target = rng.choices(TARGETS, [_WEIGHTS.get(name, 1) for name in TARGETS])[0]
    kind = rng.choice((*KINDS, "STOP", "STOP"))
    since = _random_begin(rng, target)
    latest_s = {"start": _JOINING_S, "first tick": _LATEST_S, "report": _REPORTED_S}[since]
    return Injection(
        target=target,
        kind=kind,
        since=since,
        after_s=rng.uniform(0.0, latest_s) if target != DRAWING else rng.uniform(0.0, _DRAWN_S),
        resumed_s=rng.choice(RESUMED_S[target in (FORK_SERVER, REPORT, DRAWING) :]) if kind == "STOP" else None,
    )


def _random_begin(rng: random.Random, target: str) -> Literal["start", "first tick", "report"]:
    """Draw what the time of an injection counts from."""
    if target in (DRAWING, FORK_SERVER):  # the fork server has done its work by the first tick
        return "start"
    if target in (COMMAND, REPORT, VIEWER) and rng.random() < _REPORTING:
        return "report"
    return "start" if rng.random() < _BEFORE else "first tick"
