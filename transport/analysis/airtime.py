"""Numbers of the team's radio over a run, from the coordinator's reports (docs/radio.md)."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from transport.log.run_log import RunLog
from transport.model.arrays import Array
from transport.protocol.radio.frames import FrameResult
from transport.protocol.scenario.radio.radio_parameters import PlanShape, slot_lengths
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import REPLACED, UNREPORTED, Airtime, Plan
from transport.protocol.wire.names import agent_name

_MS_PER_S = 1e3
# Losses in the summary.
_LOSSES = {
    "collisions": FrameResult.COLLISION,
    "weak": FrameResult.WEAK,
    "queue_drops": FrameResult.QUEUE,
    "given_up": FrameResult.RETRIES,
}


def radio_of(setup: Setup, log: RunLog) -> dict[str, Any] | None:
    """Return what the team's radio carried, as JSON data; None without one."""
    section = setup.scenario.radio
    if section is None:
        return None

    reports = list(log.of(Airtime))
    fates = _Fates(reports)
    exchanges = setup.scenario.controller.negotiation_iterations
    ends = [_end_ticks(one, exchanges) for one in reports]
    duration_s = max(ends, default=0.0) * setup.settings.sampling_period_s
    busy_s = sum(one.busy_s for one in reports)
    losses = {name: fates.count(result) for name, result in _LOSSES.items()}

    return {
        "standard": section.standard,
        "rate_mbps": section.rate_mbps,
        "airtime_share": busy_s / duration_s if duration_s else None,
        "delivered_share": fates.delivered_share(),
        "delay_ms": fates.delays_ms(),
        **losses,
        "transmissions": sum(one.transmissions for one in reports),
        "repetitions": sum(one.repetitions for one in reports),
        "replaced": fates.replaced,
        "slots": _slots(setup, log),
        "links": _links(setup, fates),
    }


class _Fates:
    """Arrivals and losses of plans, a row for each plan and receiver (see `_rows`)."""

    def __init__(self, reports: Iterable[Airtime]) -> None:
        rows = [_rows(one) for one in reports if one.agents]
        told: Array = np.vstack(rows) if rows else np.zeros((0, 4))
        is_replaced = told[:, 2] == REPLACED
        self.table: Array = told[~is_replaced]  # of plans that were sent
        self.replaced = int(np.count_nonzero(is_replaced))

    def of_link(self, sender: int, receiver: int) -> "_Fates":
        """Return those of one link."""
        is_link = (self.table[:, 0] == sender) & (self.table[:, 1] == receiver)
        part = _Fates([])
        part.table = self.table[is_link]
        return part

    def count(self, result: FrameResult) -> int:
        """Return the number of losses of a kind."""
        return int(np.count_nonzero(self.table[:, 2] == -float(result)))

    def delivered_share(self) -> float | None:
        """Return delivered plans over all; None without any."""
        return float(np.mean(self.table[:, 2] >= 0.0)) if len(self.table) else None

    def delays_ms(self) -> dict[str, float | None]:
        """Return quantiles of the time from the send to the arrival, ms."""
        delays_ms = _MS_PER_S * self.table[self.table[:, 2] >= 0.0, 3]
        if not len(delays_ms):
            return {"p50": None, "p99": None, "max": None}

        p50, p99 = np.percentile(delays_ms, [50.0, 99.0])
        return {"p50": float(p50), "p99": float(p99), "max": float(delays_ms.max())}


def _rows(reports: Airtime) -> Array:
    """Return sender, receiver, arrival or loss, and delay of the plans with reports, (F, 4)."""
    agents = np.repeat(np.array(reports.agents, dtype=np.float64), len(reports.receivers))
    receivers = np.tile(np.array(reports.receivers, dtype=np.float64), len(reports.agents))
    arrivals = reports.arrivals.ravel()
    delays = (reports.arrivals - reports.sent[:, None]).ravel()
    rows = np.column_stack([agents, receivers, arrivals, delays])

    decided: Array = rows[arrivals != UNREPORTED]
    return decided


def _end_ticks(reports: Airtime, exchanges: int) -> float:
    """Return the end of the window of reports, ticks: a tick, or an exchange that ends within one."""
    if reports.negotiation == 0:
        return reports.tick
    ended_exchanges = exchanges - reports.negotiation
    return reports.tick + ended_exchanges / exchanges


def _slots(setup: Setup, log: RunLog) -> dict[str, Any] | None:
    """Return the slots of the agents and what a plan needs of them, as JSON data; None without.

    They are those of the end of the run: plans of a class of the user may have become longer.
    """
    shape = (PlanShape.of(setup.run) | log.plans_sent).holding(log.of(Plan))
    slots = slot_lengths(setup.run, shape)
    if slots is None:
        return None
    return {
        "cycle_ticks": slots.cycle_ticks,
        "slot_ms": _MS_PER_S * slots.slot_s,
        "plan_ms": _MS_PER_S * slots.plan_s,
    }


def _links(setup: Setup, fates: _Fates) -> list[dict[str, Any]]:
    """Return share and delays of the delivered plans of each link, as JSON data."""
    links = []
    for sender in setup.agents:
        for receiver in setup.agents:
            if sender == receiver:
                continue

            link = fates.of_link(sender, receiver)
            links.append(
                {
                    "from": agent_name(sender),
                    "to": agent_name(receiver),
                    "delivered_share": link.delivered_share(),
                    "delay_ms": link.delays_ms(),
                }
            )
    return links
