"""The radio of a team in lockstep: plans of a tick in, their arrivals out (docs/radio.md).

The coordinator, which has all plans of a tick, computes it once.

    period       from a tick to the next; it has `exchanges` of equal length, one without negotiation
    negotiation  of a plan or a window: exchanges of the same tick that still follow, 0 for the last
    cycle        periods in which each station has its turn to send once; 1 where all send in each
    window       what one call of `advance` covers: it ends with an exchange, or with the next tick
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.protocol.radio.background_traffic import Background, BackgroundState
from transport.protocol.radio.channel_settings_and_state import ChannelState
from transport.protocol.radio.frames import Frame, FrameOutcome, FrameResult
from transport.protocol.radio.medium_access_and_retries import Channel
from transport.protocol.radio.propagation import Powers, PowersWhenNeeded, milliwatts
from transport.protocol.radio.slot_length import frame_lengths
from transport.protocol.radio.standards_80211 import STANDARDS
from transport.protocol.scenario.radio.radio_parameters import (
    NS_PER_S,
    PlanShape,
    channel_parameters,
    length_on_air,
    propagation_of,
    send_times,
)
from transport.protocol.scenario.sections.radio_section import RadioSection
from transport.protocol.scenario.setup.team_run import TeamRun
from transport.protocol.wire.messages import UNREPORTED, Plan

_OTHERS_DB = 20.0  # power of the traffic of others above the sensitivity
_ROUNDING = 1.01  # of distances: integrated rods are unit vectors only nearly


@dataclass(slots=True)
class _Message:
    """A plan on its way, in one or several frames."""

    plan: tuple[int, int, int]  # agent, tick, exchanges that follow
    begin_ns: int  # of its tick
    sent_ns: int
    lengths: list[int]  # of its frames, bytes
    # Number of frames without an outcome, by receiving station that lacks some.
    missing: dict[int, int]
    sequences: list[int] = field(default_factory=list)  # numbers of its frames, once on the air
    # The first loss of one of its frames, by receiving station.
    losses: dict[int, FrameResult] = field(default_factory=dict)

    @property
    def station(self) -> int:
        """Station of its sender."""
        return self.plan[0] - 1

    def decide(self, receiver: int, result: FrameResult) -> FrameResult | None:
        """Note the fate of a frame at a receiver; return that of the message if it was the last."""
        if result is not FrameResult.DELIVERED:
            self.losses.setdefault(receiver, result)
        left = self.missing[receiver] - 1
        if left:
            self.missing[receiver] = left
            return None
        del self.missing[receiver]
        return self.losses.get(receiver, FrameResult.DELIVERED)


class TeamRadio:
    """Channel of one run, and the plans that are on their way; station i is agent i + 1."""

    def __init__(self, setup: TeamRun, section: RadioSection) -> None:
        self._setup = setup
        self._section = section
        self._agents = len(setup.owned)
        self._standard = STANDARDS[section.standard]
        self._channel = Channel(channel_parameters(section, setup.rules.seed))
        self._propagation = propagation_of(section, setup.rules.seed)
        self._at_reference = self._propagation.at_reference(self._agents)
        self._shape = PlanShape.of(setup)  # that holds all plans so far
        self._sends = send_times(setup, section, self._shape)
        self._background = Background(
            share=section.background,
            station=self._agents,
            power_mw=milliwatts(section.sensitivity_dbm + _OTHERS_DB),
            seed=setup.rules.seed,
        )
        # Each agent has one radio, on the first of its UAVs (docs/radio.md).
        radio_uavs = [owned[0] for owned in setup.owned]
        uavs = [setup.system.uavs[uav] for uav in radio_uavs]
        self._rho_P = np.array([uav.rho for uav in uavs])
        self._rod_m = np.array([[uav.rod_length] for uav in uavs])
        # Places of their rod directions in the state of the plant, (agents, 3).
        in_block = np.arange(state.E.start, state.E.stop)
        self._places_of_e = np.array(
            [state.PAYLOAD + state.PER_UAV * uav + in_block for uav in radio_uavs]
        )

        stations = self._agents + 1 if section.background > 0.0 else self._agents
        self._state = ChannelState.idle(stations, self._standard)
        self._is_near = self._all_are_near()
        self._others = BackgroundState()
        self._sequence = [0] * self._agents  # frames so far, by station
        self._waiting: list[_Message] = []  # for the next turns of their stations
        self._replaced: list[_Message] = []  # since the last window
        self._messages: dict[tuple[int, int], _Message] = {}  # by station and sequence of a frame

    def fit_slots(self, plans: Sequence[Plan]) -> None:
        """Make the slots long enough for plans that are sent next; they never become shorter.

        Own data, and the inputs of a class of the user, are known from its plans.
        """
        shape = self._shape.holding(plans)
        if shape == self._shape:
            return
        self._shape = shape
        self._sends = send_times(self._setup, self._section, shape)
        for message in self._waiting:
            _, tick, _ = message.plan
            message.sent_ns = self._sends.instant_ns(message.station, tick)

    def send(self, plan: Plan, members: Collection[int]) -> None:
        """Take in a plan that its sender shares, for the other agents on the roster.

        It is put on the air at the next turn of its station, unless a newer one replaces it there.
        """
        receivers = tuple(sorted([agent - 1 for agent in members if agent != plan.agent]))
        if not plan.shared or not receivers:
            return
        station = plan.agent - 1
        exchange = self._sends.exchanges - 1 - plan.negotiation  # from 0
        lengths = frame_lengths(length_on_air(plan, self._section))
        if self._sends.cycle > 1:
            self._replace(station)
        self._waiting.append(
            _Message(
                plan=(plan.agent, plan.tick, plan.negotiation),
                begin_ns=plan.tick * self._sends.period_ns,
                sent_ns=self._sends.instant_ns(station, plan.tick, exchange),
                lengths=lengths,
                missing=dict.fromkeys(receivers, len(lengths)),
            )
        )

    def _replace(self, station: int) -> None:
        """Take back the plan of a station that waits for its turn: a newer one is here."""
        waiting = self._waiting
        self._waiting = [message for message in waiting if message.station != station]
        self._replaced += [message for message in waiting if message.station == station]

    def advance(self, tick: int, x: Array, *, negotiation: int = 0) -> dict[str, Any]:
        """Return the fields of `Airtime` for the window that ends at a tick, or with an exchange.

        Args:
            tick: Tick that opens at the end of the window; that of the exchange if there is one.
            x: State of the plant whose positions hold in the window, (12 + 12 N,).
            negotiation: Exchanges that follow after the one that ends; 0: the window ends at the tick.
        """
        until_ns = tick * self._sends.period_ns
        if negotiation > 0:
            ended_exchanges = self._sends.exchanges - negotiation
            until_ns += ended_exchanges * self._sends.exchange_ns
        powers = PowersWhenNeeded(partial(self._powers, x), len(self._state.stations))
        others, self._others = self._background.frames(
            self._others, self._standard, self._channel.parameters.rate_mbps, until_ns
        )
        # A window ends with a period, that of the tick before, or with an exchange in the tick's own.
        period_tick = tick if negotiation > 0 else tick - 1
        frames = [*self._put_on_air(period_tick), *others]
        self._state, outcomes, counts = self._channel.advance(
            self._state, powers, frames, until_ns, near=self._is_near
        )
        return {
            "tick": tick,
            "negotiation": negotiation,
            **self._reported(outcomes),
            "busy_s": counts.busy_ns / NS_PER_S,
            "transmissions": counts.transmissions,
            "repetitions": counts.repetitions,
        }

    def _put_on_air(self, tick: int) -> list[Frame]:
        """Return the frames of the plans whose stations have their turn in the period of a tick."""
        frames = []
        later = []
        for message in self._waiting:
            station = message.station
            if self._sends.turn(station, tick) > tick:
                later.append(message)
                continue
            receivers = tuple(message.missing)
            for length in message.lengths:
                sequence = self._sequence[station]
                self._sequence[station] += 1
                self._messages[station, sequence] = message
                message.sequences.append(sequence)
                frames.append(Frame(message.sent_ns, station, sequence, length, receivers))
        self._waiting = later
        return frames

    def _all_are_near(self) -> bool:
        """Return whether all stations hear each other well in any state of the team.

        Two UAVs are at most their rods and the distance of their attachment points apart.
        """
        powers_mw = []
        if self._background.share > 0.0:
            powers_mw.append(self._background.power_mw)
        for one, other in combinations(range(self._agents), 2):
            apart_m = float(np.linalg.norm(self._rho_P[one] - self._rho_P[other]))
            farthest_m = _ROUNDING * (apart_m + float(self._rod_m[one, 0] + self._rod_m[other, 0]))
            reference_mw = self._at_reference[one][other]
            powers_mw.append(self._propagation.power_mw_at(reference_mw, farthest_m * farthest_m))
        return all([self._channel.is_near(power_mw) for power_mw in powers_mw])

    def _powers(self, x: Array) -> Powers:
        """Return the powers of all stations, those of others included, mW."""
        powers = self._propagation.powers(self._at_reference, self._positions(x))
        return self._background.heard(powers)

    def _positions(self, x: Array) -> list[list[float]]:
        """Return positions of the stations relative to the payload, payload frame, m."""
        # r_i - r_0 = rho_i - l_i e_i, payload frame: (14).
        relative = self._rho_P - self._rod_m * x[self._places_of_e]
        positions: list[list[float]] = relative.tolist()
        return positions

    def _reported(self, outcomes: Sequence[FrameOutcome]) -> dict[str, Any]:
        """Return the arrivals and losses of plans that the outcomes decide, a row for each plan."""
        told: dict[tuple[int, int, int], _Message] = {}
        rows: dict[tuple[int, int, int], list[float]] = {}
        for message, receiver, result, time_ns in self._fates(outcomes):
            plan = message.plan
            if plan not in rows:
                told[plan] = message
                rows[plan] = [UNREPORTED] * self._agents
            if result is FrameResult.DELIVERED:
                rows[plan][receiver] = (time_ns - message.begin_ns) / NS_PER_S
            else:
                rows[plan][receiver] = -float(result)  # the codes of `Airtime.arrivals`

        plans = sorted(rows)
        agents, ticks, exchanges = zip(*plans, strict=True) if plans else ((), (), ())
        sent_s = [(told[plan].sent_ns - told[plan].begin_ns) / NS_PER_S for plan in plans]
        return {
            "agents": agents,
            "plan_ticks": ticks,
            "exchanges": exchanges,
            "receivers": self._setup.agents,
            "sent": sent_s,
            "arrivals": [rows[plan] for plan in plans] if plans else np.zeros((0, self._agents)),
        }

    def _fates(
        self, outcomes: Sequence[FrameOutcome]
    ) -> list[tuple[_Message, int, FrameResult, int]]:
        """Return the messages decided at a receiver, with their fate there and its instant, ns."""
        fates = [
            (message, receiver, FrameResult.REPLACED, message.sent_ns)
            for message in self._replaced
            for receiver in message.missing
        ]
        self._replaced.clear()

        for frame, receiver, outcome, time_ns in outcomes:
            message = self._messages[frame.sender, frame.sequence]
            result = message.decide(receiver, outcome)
            if result is not None:
                fates.append((message, receiver, result, time_ns))
            if not message.missing:
                self._forget(message)
        return fates

    def _forget(self, message: _Message) -> None:
        """Forget the frames of a message that is decided at all receivers."""
        for sequence in message.sequences:
            del self._messages[message.station, sequence]
