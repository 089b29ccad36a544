"""Random runs of the crash fuzzer: settings and signals drawn from a seed and a number."""

import random
import signal
from dataclasses import dataclass
from typing import Literal

# The command itself, which contains the recorder; its exit code is the run's.
COMMAND = "transport"
_TARGETS = ("coordinator", "plant", "agent1", "agent2", "agent3", "agent4", COMMAND, COMMAND)

# Share of injections during the start, and latest time after start or first tick: a run takes about 3 s, so some
# injections come after its end, while the report is written.
_AT_START, _LATEST_S = 0.2, 3.5
_PACED = "maneuver.phase=[{name='climb',duration_s=3.0,displacement_m=[0,0,-1.5]}]"
_UNPACED = "maneuver.phase=[{name='climb',duration_s=12.0,displacement_m=[0,0,-6.0]}]"
_IMPAIRED = (
    "links={delay_s=0.06,jitter_s=0.05,loss=0.1}",
    "links={delay_s=0.02,loss=0.05,duplicate=0.2,reorder=0.2,reorder_s=0.1,measurement={loss=0.1},actuation={loss=0.1}}",
    "links.partition=[{between=['agent1','agent2'],start_s=0.5,end_s=1.0}]",
    "links.change=[{at_s=0.5,delay_s=0.1},{at_s=1.5,delay_s=0.0}]",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Injection:
    """A signal sent to one process.

    Attributes:
        target: Process name, or `COMMAND`.
        signal: The signal.
        since: Whether `after_s` counts from the start of the command or from the first tick.
        after_s: Time of the signal, s.
        resumed_s: Time from a SIGSTOP to its SIGCONT, s; None for never.
    """

    target: str
    signal: signal.Signals
    since: Literal["start", "first tick"]
    after_s: float
    resumed_s: float | None = None

    def __str__(self) -> str:
        resumed = "" if self.resumed_s is None else f", SIGCONT {self.resumed_s:.2f} s later"
        return f"{self.signal.name} to {self.target} {self.after_s:.2f} s after the {self.since}{resumed}"


@dataclass(frozen=True, slots=True, kw_only=True)
class FuzzRun:
    """A run as drawn: its number, changes of the scenario, and injections in any order."""

    number: int
    settings: tuple[str, ...]
    injections: tuple[Injection, ...]


def random_run(seed: int, number: int) -> FuzzRun:
    """Draw a run from the seed and its number."""
    rng = random.Random(f"{seed}/{number}")  # noqa: S311  # no secret
    pace = rng.choice(("fast", "paced", "realtime"))
    settings = ["clock.barrier_timeout_s=1.0", "clock.join_timeout_s=10.0"]
    settings += [f"clock.on_agent_loss={rng.choice(('abort', 'continue'))}"]
    settings += [_UNPACED] if pace == "fast" else [_PACED, "clock.speed=1.0"]
    if pace == "realtime":
        settings += ["clock.mode=realtime", f"clock.on_overrun={rng.choice(('continue', 'continue', 'hold'))}"]
    elif rng.random() < 0.2:
        settings += ["controller.negotiation_iterations=2"]
    if rng.random() < 0.3:
        settings += [rng.choice(_IMPAIRED)]
    if pace != "realtime" and rng.random() < 0.3:
        settings += ["clock.exchange=direct"]
    count = 2 if rng.random() < 0.3 else 1
    return FuzzRun(
        number=number, settings=tuple(settings), injections=tuple(_random_injection(rng) for _ in range(count))
    )


def _random_injection(rng: random.Random) -> Injection:
    target = rng.choice(_TARGETS)
    number = rng.choice((signal.SIGKILL, signal.SIGSTOP, signal.SIGSTOP, signal.SIGTERM, signal.SIGINT))
    return Injection(
        target=target,
        signal=number,
        since="start" if rng.random() < _AT_START else "first tick",
        after_s=rng.uniform(0.0, _LATEST_S),
        resumed_s=rng.uniform(0.1, 4.0) if number == signal.SIGSTOP and rng.random() < 0.5 else None,
    )
