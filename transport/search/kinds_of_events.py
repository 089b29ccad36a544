"""Events that a search draws: silences, deaths, weather, model errors and targets.

Each says what it is (`in_words`) and yields simpler versions of itself (`simpler`), from which the
minimal case is made. Each but `Silence` changes the tree of a scenario by `apply`; silences, which may
overlap, become changes of links together (`silent_links.py`). A further kind is added to `Event` and
needs its bounds in space.py and a row in docs/worst.md; one with a time, its mark in report.py; one
that names agents, its part of `Candidate.smaller_teams`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from transport.protocol.scenario.teams.drawn_team import put_drawn_vehicles
from transport.protocol.wire.names import PLANT

Tree = dict[str, Any]

# A silence shorter than this is not tried any more when a case is made minimal, s.
_SHORTEST_SILENCE_S = 0.1


def _rounder(value: float) -> Iterator[float]:
    """Yield a number with fewer digits, the roundest first, each once: 7.3172 becomes 7, 7.5, 7.3."""
    rounded = [round(round(value / step) * step, 6) for step in (1.0, 0.5, 0.1, 0.05)]
    for one in dict.fromkeys(rounded):
        if one != value:
            yield one


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnSilence:
    """A window in which messages between agents are lost.

    `who` names the links: "all"; "mute 3": those from agent 3; "deaf 3": those to it; "cut 1 2":
    those between agents 1, 2 and all others.
    """

    # Whether one agent for all UAVs, with perfect information, does not meet such an event.
    of_network: ClassVar[bool] = True

    start_s: float
    duration_s: float
    who: str = "all"
    loss: float = 1.0  # share of the messages

    @property
    def end_s(self) -> float:
        """Return when messages pass again."""
        return round(self.start_s + self.duration_s, 6)

    @property
    def agents(self) -> tuple[int, ...]:
        """Return the agents that `who` names."""
        return tuple(int(word) for word in self.who.split()[1:])

    def silences(self, sender: int, receiver: int) -> bool:
        """Return whether a link between two agents is silent."""
        match self.who.split()[0]:
            case "mute":
                return sender in self.agents
            case "deaf":
                return receiver in self.agents
            case "cut":
                return (sender in self.agents) != (receiver in self.agents)
            case "all":
                return True
        raise ValueError(self.who)

    def in_words(self) -> str:
        """Return the event as a phrase."""
        names = " and ".join(f"agent {agent}" for agent in self.agents)
        what = {
            "all": "the whole network is silent",
            "mute": f"{names} is not heard",
            "deaf": f"{names} hears nothing",
            "cut": f"{names} are cut off from the others",
        }[self.who.split()[0]]
        share = "" if self.loss == 1.0 else f" ({100.0 * self.loss:.0f} % of the messages)"

        return f"from {self.start_s:g} to {self.end_s:g} s {what}{share}"

    def simpler(self) -> Iterator["DrawnSilence"]:
        """Yield simpler versions: a shorter window, all messages, round numbers."""
        if self.duration_s / 2.0 >= _SHORTEST_SILENCE_S:
            half_s = round(self.duration_s / 2.0, 6)
            yield replace(self, duration_s=half_s)
            yield replace(self, start_s=round(self.start_s + half_s, 6), duration_s=half_s)

        if self.loss < 1.0:
            yield replace(self, loss=1.0)
        for start_s in _rounder(self.start_s):
            yield replace(self, start_s=max(0.0, start_s))
        for duration_s in _rounder(self.duration_s):
            if duration_s >= _SHORTEST_SILENCE_S:
                yield replace(self, duration_s=duration_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Death:
    """An agent that is killed, and perhaps started again."""

    of_network: ClassVar[bool] = True

    agent: int
    at_s: float
    back_after_s: float | None = None  # None: for good

    def apply(self, tree: Tree) -> None:
        """Add the faults, with which the run goes on."""
        name = f"agent{self.agent}"
        events = tree["faults"]["event"]
        events.append({"at_s": self.at_s, "do": "kill", "target": name})
        if self.back_after_s is not None:
            back_s = round(self.at_s + self.back_after_s, 6)
            events.append({"at_s": back_s, "do": "restart", "target": name})
        tree["clock"]["on_agent_loss"] = "continue"

    def in_words(self) -> str:
        """Return the event as a phrase."""
        back = (
            "for good"
            if self.back_after_s is None
            else f"and is back after {self.back_after_s:g} s"
        )
        return f"at {self.at_s:g} s agent {self.agent} dies {back}"

    def simpler(self) -> Iterator["Death"]:
        """Yield simpler versions: an agent that stays away, round times."""
        if self.back_after_s is not None:
            yield replace(self, back_after_s=None)
            for after_s in _rounder(self.back_after_s):
                if after_s > 0.0:
                    yield replace(self, back_after_s=after_s)
        for at_s in _rounder(self.at_s):
            yield replace(self, at_s=max(0.0, at_s))


@dataclass(frozen=True, slots=True, kw_only=True)
class Links:
    """Delay, jitter and loss of every link between agents, for the whole run."""

    of_network: ClassVar[bool] = True

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0

    def apply(self, tree: Tree) -> None:
        """Set the keys of the links, of exceptions between agents too, in place of recorded delays."""
        links = tree["links"]
        exceptions = [
            one for one in links["override"] if PLANT not in (one.get("from"), one.get("to"))
        ]
        for section in (links, *exceptions):
            section |= {"delay_s": self.delay_s, "jitter_s": self.jitter_s, "loss": self.loss}
            section.pop("trace", None)
            if section["distribution"] == "empirical":
                section["distribution"] = "uniform"

    def in_words(self) -> str:
        """Return the event as a phrase."""
        return (
            f"links with {1e3 * self.delay_s:g} ms of delay, {1e3 * self.jitter_s:g} ms of jitter "
            f"and {100.0 * self.loss:g} % of loss"
        )

    def simpler(self) -> Iterator["Links"]:
        """Yield simpler versions: without one impairment, round numbers."""
        for key in ("jitter_s", "loss", "delay_s"):
            value = getattr(self, key)
            if value > 0.0:
                yield replace(self, **{key: 0.0})
            for rounded in _rounder(value):
                if 0.0 < rounded < value:
                    yield replace(self, **{key: rounded})


@dataclass(frozen=True, slots=True, kw_only=True)
class Gusts:
    """Gusts of a standard deviation, in the draws of a seed."""

    of_network: ClassVar[bool] = False

    speed_mps: float
    seed: int

    def apply(self, tree: Tree) -> None:
        """Set wind and seed of the run."""
        tree["plant"]["wind"]["gust_mps"] = [self.speed_mps] * 3
        tree["seed"] = self.seed

    def in_words(self) -> str:
        """Return the event as a phrase."""
        return f"gusts of {self.speed_mps:g} m/s, seed {self.seed}"

    def simpler(self) -> Iterator["Gusts"]:
        """Yield simpler versions: round speeds, small seeds."""
        for speed_mps in _rounder(self.speed_mps):
            if 0.0 < speed_mps < self.speed_mps:
                yield replace(self, speed_mps=speed_mps)
        if self.seed > 0:
            yield replace(self, seed=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelError:
    """What the controllers do not know of the plant: the payload's mass, the lag of the motors."""

    of_network: ClassVar[bool] = False

    mass_factor: float = 1.0  # actual over known mass of the payload
    motor_lag_s: float = 0.0

    def apply(self, tree: Tree) -> None:
        """Set the plant's keys."""
        tree["plant"]["payload_mass_factor"] = self.mass_factor
        tree["plant"]["motors"]["lag_s"] = self.motor_lag_s

    def in_words(self) -> str:
        """Return the event as a phrase."""
        return (
            f"a payload of {100.0 * self.mass_factor:g} % of the known mass, "
            f"{1e3 * self.motor_lag_s:g} ms of motor lag"
        )

    def simpler(self) -> Iterator["ModelError"]:
        """Yield simpler versions: one error alone, round numbers."""
        if self.mass_factor != 1.0:
            yield replace(self, mass_factor=1.0)
            for factor in _rounder(self.mass_factor):
                yield replace(self, mass_factor=factor)
        if self.motor_lag_s != 0.0:
            yield replace(self, motor_lag_s=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorsOff:
    """White noise of all sensors, as a multiple of the scenario's, in the draws of a seed.

    Biases and delays stay.
    """

    of_network: ClassVar[bool] = False

    factor: float
    seed: int | None  # None: that of the gusts beside it

    def apply(self, tree: Tree) -> None:
        """Scale the standard deviations and set the seed of the run."""
        noise = tree["plant"]["noise"]
        for key, value in noise.items():
            if isinstance(value, float):
                noise[key] = value * self.factor
        if self.seed is not None:
            tree["seed"] = self.seed

    def in_words(self) -> str:
        """Return the event as a phrase."""
        seed = "" if self.seed is None else f", seed {self.seed}"
        return f"sensor noise of {self.factor:g} times the scenario's{seed}"

    def simpler(self) -> Iterator["SensorsOff"]:
        """Yield simpler versions: the scenario's noise, small seeds."""
        if self.factor != 1.0:
            yield replace(self, factor=1.0)
        if self.seed:
            yield replace(self, seed=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class TargetEvent:
    """A target of the payload that is given during the run, relative to where the maneuver begins."""

    of_network: ClassVar[bool] = False

    at_s: float
    offset_m: tuple[float, float, float]

    def apply(self, tree: Tree) -> None:
        """Add the target."""
        start_m = tree["maneuver"]["start_m"]
        point_m = [a + b for a, b in zip(start_m, self.offset_m, strict=True)]
        tree["maneuver"]["target"].append({"at_s": self.at_s, "points_m": [point_m]})

    def in_words(self) -> str:
        """Return the event as a phrase."""
        x, y, z = self.offset_m
        return f"at {self.at_s:g} s a target ({x:g}, {y:g}, {z:g}) m from the start"

    def simpler(self) -> Iterator["TargetEvent"]:
        """Yield simpler versions: a target on an axis, round numbers."""
        for axis in range(3):
            if self.offset_m[axis] != 0.0:
                kept = [0.0 if i == axis else value for i, value in enumerate(self.offset_m)]
                if any(kept):
                    yield replace(self, offset_m=(kept[0], kept[1], kept[2]))

        x, y, z = (round(value) * 1.0 for value in self.offset_m)
        if (x, y, z) != self.offset_m and any((x, y, z)):
            yield replace(self, offset_m=(x, y, z))
        for at_s in _rounder(self.at_s):
            yield replace(self, at_s=max(0.0, at_s))


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnTeam:
    """Vehicles and payload drawn by a seed, as many UAVs as in the scenario."""

    of_network: ClassVar[bool] = False

    seed: int

    def apply(self, tree: Tree) -> None:
        """Replace the bodies, with period, horizon, inputs and limits."""
        put_drawn_vehicles(tree, self.seed)

    def in_words(self) -> str:
        """Return the event as a phrase."""
        return f"the drawn team {self.seed}"

    def simpler(self) -> Iterator["DrawnTeam"]:
        """Yield nothing: no team is simpler than another."""
        yield from ()


Event = DrawnSilence | Death | Links | Gusts | ModelError | SensorsOff | TargetEvent | DrawnTeam
