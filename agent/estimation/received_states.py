"""All that messages have told an agent of its team, once, by tick and UAV."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from transport.agent.communication.announced_inputs import AnnouncedInputs
from transport.model import state
from transport.model.arrays import Array
from transport.protocol.wire.messages import Measurement, Plan


class UavReport(NamedTuple):
    """A UAV at a tick."""

    values: Array  # its state, (12,), or the measurements of its sensors, (15,), SI
    # Inputs that its actuators applied until then, (4,); None if not told.
    inputs: Array | None = None
    missing: int = 0  # sensors without a measurement, as bits (`model.state.SENSORS`)


@dataclass(slots=True)
class _Tick:
    payload: Array | None = None  # measured state of the payload, (12,)
    uavs: dict[int, UavReport] = field(default_factory=dict)


class Reports:
    """Reports by tick and UAV, 0-based.

    The first report of a UAV at a tick counts: later ones are repeats of it.
    """

    def __init__(self) -> None:
        self._ticks: dict[int, _Tick] = {}
        self._first = 0  # nothing is kept of ticks before

    def has(self, tick: int, uav: int) -> bool:
        """Return whether a UAV has been told of at a tick."""
        told = self._ticks.get(tick)
        return told is not None and uav in told.uavs

    def tell(self, tick: int, uav: int, report: UavReport) -> None:
        """Keep a report, unless there is one."""
        self._of(tick).uavs.setdefault(uav, report)

    def tell_payload(self, tick: int, payload: Array) -> None:
        """Keep the measured state of the payload, (12,), at a tick."""
        self._of(tick).payload = payload

    def _of(self, tick: int) -> _Tick:
        told = self._ticks.get(tick)
        if told is None:
            told = _Tick()
            self._ticks[tick] = told
        return told

    def payload(self, tick: int) -> Array | None:
        """Return the measured state of the payload at a tick, (12,); None without one."""
        told = self._ticks.get(tick)
        return None if told is None else told.payload

    def uavs(self, tick: int) -> Mapping[int, UavReport]:
        """Return the reports of a tick by UAV."""
        told = self._ticks.get(tick)
        return {} if told is None else told.uavs

    def apply_inputs(self, tick: int, u: Array) -> None:
        """Replace inputs until a tick, (m,), in place, by those that actuators have reported."""
        for uav, report in self.uavs(tick).items():
            if report.inputs is not None:
                u[state.input_slice(uav)] = report.inputs

    def inputs_until(self, k: int, newest: Array | None, announced: AnnouncedInputs) -> Array:
        """Return the inputs in force until tick k, (4 N,): the announced ones, or those reported.

        `newest` are the announced ones over the newest period of an estimate, (4 N,), where there is
        one: they answer to its states.
        """
        u = announced.in_force(k - 1, before=k) if newest is None else newest.copy()
        self.apply_inputs(k, u)
        return u

    def rows(self, k: int, uavs: Sequence[int]) -> Array:
        """Return measurements and inputs of some UAVs for a plan of tick k, (uavs, 80).

        Each plan repeats those of the last ticks: the loss of one plan loses no measurement.
        """
        rows = np.zeros((len(uavs), state.REPORTS, state.REPORTED))
        for age in range(state.REPORTS):
            reports = self.uavs(k - age)
            for index, uav in enumerate(uavs):
                report = reports.get(uav)
                if report is not None:
                    rows[index, age, state.IS_KNOWN] = 1.0 + report.missing
                    rows[index, age, state.SENSED_VALUES] = report.values
                    rows[index, age, state.REPORTED_INPUTS] = report.inputs
        return rows.reshape(len(uavs), -1)

    def forget_before(self, tick: int) -> None:
        """Forget all reports of earlier ticks."""
        for earlier in range(self._first, tick):
            self._ticks.pop(earlier, None)
        self._first = max(self._first, tick)


class NewStates:
    """Newest ticks that an agent has heard of."""

    def __init__(self) -> None:
        self.measured = -1  # tick of the newest own measurement; -1 for none
        self._newest: dict[int, int] = {}  # tick of the newest plan, by agent

    def take(self, message: Plan | Measurement) -> None:
        """Take note of a message."""
        if isinstance(message, Measurement):
            self.measured = max(message.tick, self.measured)
        else:
            newest = self._newest.get(message.agent, -1)
            self._newest[message.agent] = max(message.tick, newest)

    def age(self, agent: int, tick: int) -> int:
        """Return the ticks since the newest state received from another agent; -1 for none."""
        return tick - self._newest[agent] if agent in self._newest else -1


def by_uav(measurement: Measurement) -> Sequence[tuple[int, UavReport]]:
    """Return the reports of a measurement with their UAVs, 0-based."""
    missing = measurement.missing or (0,) * len(measurement.uavs)
    rows = zip(measurement.uavs, measurement.uav_states, measurement.inputs, missing, strict=True)
    return [(uav - 1, UavReport(*report)) for uav, *report in rows]
