"""Path of a recorded run: the maneuver with the targets in its log, for analysis.

The log holds a target in one of two ways. The coordinator sends one that a user tells as a `target` message.
One that an agent makes of an obstacle it sees exists only inside plans: copies travel from agent to agent,
and each copy carries what its sender knows of the others. While copies say who has the target (`informed`,
`got`), the team only brakes; once all have it, copies say from which tick on its way is followed (`begins`).
"""

import dataclasses
from collections.abc import Iterable

from msgspec.structs import replace

from transport.log.run_log import RunLog
from transport.protocol.admission.known_targets import KnownTargets
from transport.protocol.admission.targets_in_plans import (
    Place,
    carried_by,
    is_of_sight,
    place_of,
)
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.messages import Plan, Target


def led_as_logged(setup: Setup, log: RunLog) -> Setup:
    """Return a run with the targets in its log: those told, and those that agents made of what they saw.

    A run that has them already is returned as it is. Targets of agents are followed from their own ticks on,
    as if all agents had heard of them at once.
    """
    if any(target.brakes for target in setup.maneuver.targets):
        return setup
    of_sight = _made_of_sight(log.of(Plan))
    if not of_sight:
        return setup.after(log.of(Target))

    # A target of sight can replace one that was told, and the reverse: `KnownTargets` has the order by
    # tick that all agents use. `Setup.after` has that of the coordinator's numbers alone.
    known = KnownTargets(setup.run)
    for target in (*log.of(Target), *of_sight):
        known.add(target)
    return dataclasses.replace(setup, run=known.setup)


def _made_of_sight(plans: Iterable[Plan]) -> list[Target]:
    """Return the targets that agents made of what they saw, each once, in the order of their first plans.

    Of the copies of a target, the first that says from which tick on its way is followed counts. Where none
    does (the run ended before all had it, or follows targets without confirmation), the first copy counts.
    The agents that have it are left out: with them `KnownTargets` would only brake until `begins` is known.
    """
    copies: dict[Place, Target] = {}
    for plan in plans:
        for target in filter(is_of_sight, carried_by(plan)):
            place = place_of(target)
            kept = copies.setdefault(place, target)
            if target.begins and not kept.begins:
                copies[place] = target
    return [replace(target, informed=(), got=()) for target in copies.values()]
