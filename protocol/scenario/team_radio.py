"""The radio of a team in lockstep: plans of a tick in, their arrivals out (docs/radio.md).

The coordinator, which has all plans of a tick, computes it once.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from transport.model import state
from transport.model.arrays import Array
from transport.protocol.radio.background import Background, BackgroundState
from transport.protocol.radio.channel import Channel, ChannelParameters, ChannelState
from transport.protocol.radio.frames import Frame, Outcome, Result
from transport.protocol.radio.propagation import Propagation, milliwatts, noise_mw, ratio
from transport.protocol.radio.sends import SendTimes
from transport.protocol.radio.standard import MESSAGE_BYTES, STANDARDS
from transport.protocol.scenario.radio_section import RadioSection
from transport.protocol.scenario.setup import Setup
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import NO_NEWS, Plan

_NS_PER_S = 1e9
_OTHERS_DB = 20.0  # power of the traffic of others above the sensitivity
_FREE_SPACE_1M_DB = {"802.11a": 46.7, "802.11b": 40.2}  # 5.15 and 2.44 GHz


@dataclass(slots=True)
class _Message:
    """A plan on its way, in one or several frames."""

    plan: tuple[int, int, int]  # agent, tick, exchanges that follow
    sent_ns: int
    missing: dict[int, int]  # frames without an outcome, by receiving station
    results: dict[int, Result] = field(default_factory=dict)  # so far, the first loss counts


class TeamRadio:
    """Channel of one run, and the plans that are on their way; station i is agent i + 1."""

    def __init__(self, setup: Setup, section: RadioSection) -> None:
        self._setup = setup
        self._agents = len(setup.owned)
        self._standard = STANDARDS[section.standard]
        self._channel = Channel(channel_parameters(section, setup.scenario.seed))
        self._propagation = propagation_of(section, setup.scenario.seed)
        self._at_reference = self._propagation.at_reference(self._agents)
        self._sends = send_times(setup, section)
        self._background = Background(
            share=section.background,
            station=self._agents,
            power_mw=milliwatts(section.sensitivity_dbm + _OTHERS_DB),
            seed=setup.scenario.seed,
        )
        # Ends of the rods in the payload frame, whose distances are those of the UAVs.
        uavs = [setup.system.uavs[owned[0]] for owned in setup.owned]
        self._first_owned = [owned[0] for owned in setup.owned]
        self._rho_P = np.array([uav.rho for uav in uavs])
        self._rod_m = np.array([[uav.rod_length] for uav in uavs])

        stations = self._agents + (section.background > 0.0)
        self._state = ChannelState.idle(stations, self._standard)
        self._others = BackgroundState()
        self._waiting: list[Frame] = []  # frames since the last window
        self._sequence = [0] * self._agents  # frames so far, by station
        self._messages: dict[tuple[int, int], _Message] = {}  # by station and sequence of a frame

    def send(self, plan: Plan, members: Collection[int]) -> None:
        """Put a plan that its sender shares on the air, for the other agents on the roster."""
        receivers = tuple(sorted(agent - 1 for agent in members if agent != plan.agent))
        if not plan.shared or not receivers:
            return
        station = plan.agent - 1
        exchange = self._sends.exchanges - 1 - plan.negotiation
        sent_ns = self._sends.instant_ns(station, plan.tick, exchange)
        lengths = frame_lengths(len(encode(plan)))
        message = _Message(
            plan=(plan.agent, plan.tick, plan.negotiation),
            sent_ns=sent_ns,
            missing=dict.fromkeys(receivers, len(lengths)),
        )
        for length in lengths:
            sequence = self._sequence[station]
            self._sequence[station] += 1
            self._waiting.append(Frame(sent_ns, station, sequence, length, receivers))
            self._messages[station, sequence] = message

    def advance(self, tick: int, x: Array, *, negotiation: int = 0) -> dict[str, Any]:
        """Return the fields of `Airtime` for the window that ends at a tick, or with an exchange.

        Args:
            tick: Tick that opens at the end of the window; that of the exchange if there is one.
            x: State of the plant whose positions hold in the window, (12 + 12 N,).
            negotiation: Exchanges that follow after the one that ends; 0: the window ends at the tick.
        """
        until_ns = tick * self._sends.period_ns
        if negotiation > 0:
            until_ns += (self._sends.exchanges - negotiation) * self._sends.exchange_ns
        powers = self._propagation.powers(self._at_reference, self._positions(x))
        others, self._others = self._background.frames(
            self._others, self._standard, self._channel.parameters.rate_mbps, until_ns
        )
        frames = [*self._waiting, *others]
        self._waiting = []
        self._state, outcomes, counts = self._channel.advance(
            self._state, self._background.heard(powers), frames, until_ns
        )
        return {
            "tick": tick,
            "negotiation": negotiation,
            **self._news(outcomes),
            "busy_s": counts.busy_ns / _NS_PER_S,
            "transmissions": counts.transmissions,
            "repetitions": counts.repetitions,
        }

    def _positions(self, x: Array) -> list[list[float]]:
        """Return positions of the stations relative to the payload, payload frame, m."""
        uavs = x[state.PAYLOAD :].reshape(-1, state.PER_UAV)
        e_P = uavs[self._first_owned, state.E]
        positions: list[list[float]] = (self._rho_P - self._rod_m * e_P).tolist()
        return positions

    def _news(self, outcomes: Sequence[Outcome]) -> dict[str, Any]:
        """Return the arrivals and losses of plans that the outcomes decide, a row for each plan."""
        rows: dict[tuple[int, int, int], list[float]] = {}
        sent_s: dict[tuple[int, int, int], float] = {}
        for outcome in outcomes:
            frame = outcome.frame
            message = self._messages[frame.sender, frame.sequence]
            result = self._decided(message, outcome)
            if result is None:
                continue
            begin_ns = message.plan[1] * self._sends.period_ns
            arrivals = rows.setdefault(message.plan, [NO_NEWS] * self._agents)
            sent_s[message.plan] = (message.sent_ns - begin_ns) / _NS_PER_S
            if result is Result.DELIVERED:
                arrivals[outcome.receiver] = (outcome.time_ns - begin_ns) / _NS_PER_S
            else:
                arrivals[outcome.receiver] = -float(result)  # the codes of `Airtime.arrivals`
        self._forget(outcomes)
        plans = sorted(rows)
        agents, ticks, exchanges = zip(*plans, strict=True) if plans else ((), (), ())
        return {
            "agents": agents,
            "plan_ticks": ticks,
            "exchanges": exchanges,
            "receivers": self._setup.agents,
            "sent": [sent_s[plan] for plan in plans],
            "arrivals": np.array([rows[plan] for plan in plans]).reshape(-1, self._agents),
        }

    @staticmethod
    def _decided(message: _Message, outcome: Outcome) -> Result | None:
        """Return the fate of a message at a receiver if this is the last of its frames there."""
        receiver = outcome.receiver
        before = message.results.get(receiver, Result.DELIVERED)
        result = outcome.result if before is Result.DELIVERED else before
        message.results[receiver] = result
        message.missing[receiver] -= 1
        return result if message.missing[receiver] == 0 else None

    def _forget(self, outcomes: Sequence[Outcome]) -> None:
        """Forget the frames that have all their outcomes."""
        for outcome in outcomes:
            key = outcome.frame.sender, outcome.frame.sequence
            message = self._messages.get(key)
            if message is not None and not any(message.missing.values()):
                del self._messages[key]


def frame_lengths(message_bytes: int) -> list[int]:
    """Return the lengths of the frames that carry a message, bytes."""
    full, rest = divmod(message_bytes, MESSAGE_BYTES)
    return [MESSAGE_BYTES] * full + [rest] * (rest > 0)


def channel_parameters(section: RadioSection, seed: int) -> ChannelParameters:
    """Return the settings of the channel."""
    standard = STANDARDS[section.standard]
    return ChannelParameters(
        standard=standard,
        rate_mbps=section.rate_mbps,
        unicast=section.delivery == "unicast",
        queue_length=section.queue_length,
        attempts=section.attempts,
        noise_mw=noise_mw(standard.bandwidth_hz, section.noise_figure_db),
        sensitivity_mw=milliwatts(section.sensitivity_dbm),
        carrier_sense_mw=milliwatts(section.carrier_sense_dbm),
        preamble_ratio=ratio(section.capture_db),
        seed=seed,
    )


def propagation_of(section: RadioSection, seed: int) -> Propagation:
    """Return the path loss."""
    given_db = section.path_loss_1m_db
    return Propagation(
        power_mw=section.power_mw,
        exponent=section.path_loss_exponent,
        reference_loss_db=_FREE_SPACE_1M_DB[section.standard] if given_db is None else given_db,
        shadowing_db=section.shadowing_db,
        seed=seed,
    )


def send_times(setup: Setup, section: RadioSection) -> SendTimes:
    """Return the instants at which the agents send."""
    return SendTimes(
        period_ns=setup.period_ns,
        stations=len(setup.owned),
        exchanges=setup.scenario.controller.negotiation_iterations,
        offsets=section.offsets,
        computation_mean_ns=round(section.computation_mean_s * _NS_PER_S),
        computation_deviation_ns=round(section.computation_deviation_s * _NS_PER_S),
        seed=setup.scenario.seed,
    )
