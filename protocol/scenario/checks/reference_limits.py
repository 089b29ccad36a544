"""Checks of a run that its objects allow: ground, limits at hover, and limits along the reference.

Each yields the field of the scenario, and what was expected there and came.
"""

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import combinations

import numpy as np

from transport.model.arrays import Array, ascending
from transport.model.linear.linearisation import Model
from transport.model.path.curves import Curve
from transport.model.path.maneuver import Maneuver
from transport.model.physics.hover import Hover
from transport.model.physics.obstacles import Obstacle
from transport.model.physics.parameters import ParameterError, System, resting_height
from transport.model.state import INPUTS
from transport.mpc.reference import Reference
from transport.mpc.settings_period_horizon_weights import ControllerSettings
from transport.protocol.scenario.checks.feasibility import (
    ON_GROUND_M,
    RemainingTeam,
    exceeded,
    least_factor,
    least_slowing,
    remaining_teams,
)
from transport.protocol.scenario.checks.obstacle_margins import first_blocked
from transport.protocol.scenario.faults.faults_by_tick import Fault
from transport.protocol.scenario.sections.path_instants import maneuver_instants
from transport.protocol.scenario.sections.plant_sections import PlantSection

Problems = Iterator[tuple[str, str]]  # field of a scenario; expected and got


def off_ground(system: System, maneuver: Maneuver, ground_m: float | None) -> Problems:
    """Yield take-offs and landings that are not from or on the ground, and phases below it."""
    if ground_m is None:
        return  # without take-offs and landings: maneuver_and_obstacle_relations
    resting_m = resting_height(system, ground_m)
    ground = f"z = {resting_m:g} m, where the payload stands on the ground"
    height_m = float(maneuver.start_I[2])
    if height_m > resting_m + ON_GROUND_M:
        yield "maneuver.start_m", f"expected a start above {ground}, got {height_m:g}"

    for number, phase in enumerate(maneuver.phases, start=1):
        field = f"maneuver.phase.{number}"
        before_m = height_m
        height_m = height_m + float(phase.displacement_I[2])
        on_ground = {"take_off": ("a take-off from", before_m), "land": ("a landing at", height_m)}
        kind, got_m = on_ground.get(phase.kind, ("", resting_m))
        if abs(got_m - resting_m) > ON_GROUND_M:
            yield field, f"expected {kind} {ground}, got {got_m:g}"
        elif height_m > resting_m + ON_GROUND_M:
            yield field, f"expected a path above {ground}, got {height_m:g}"


def off_hover(hover: Hover, settings: ControllerSettings, plant: PlantSection) -> Problems:
    """Yield limits on thrust and tension that hover exceeds, by the masses of the bodies."""
    rotors = plant.motors.rotors
    for uav, thrust_N in enumerate(hover.u[::INPUTS], start=1):
        limits = settings.limits.thrust_N
        if not limits[0] <= thrust_N <= limits[1]:
            problem = f"the hover thrust {thrust_N:.2f} N of UAV{uav}"
            yield "controller.limits.thrust_N", _not_within(problem, limits)
        quarter_N = thrust_N / 4.0  # of each of the four rotors
        if rotors and not rotors.thrust_N[0] <= quarter_N <= rotors.thrust_N[1]:
            problem = f"a quarter of the hover thrust {quarter_N:.2f} N of UAV{uav}"
            yield "plant.motors.rotors.thrust_N", _not_within(problem, rotors.thrust_N)

    tension = settings.tension
    least_N = float(hover.tensions.min())
    if tension is not None and least_N <= tension.minimum_N:
        uav = int(hover.tensions.argmin()) + 1
        expected = f"expected less than {least_N:.2f} N (rod of UAV{uav} at hover)"
        yield "controller.tension.minimum_N", f"{expected}, got {tension.minimum_N}"


def touching_at_hover(model: Model, hover: Hover, radii_m: Sequence[float | None]) -> Problems:
    """Yield the radii of UAVs that touch at hover."""
    for (one, other), apart_m in _distances_at_hover(model, hover).items():
        radius_m = radii_m[one - 1]
        other_radius_m = radii_m[other - 1]
        if radius_m and other_radius_m and apart_m <= radius_m + other_radius_m:
            pair = f"UAV{one} and UAV{other} at hover"
            expected = f"expected less than {apart_m:.3f} m in all ({pair})"
            got = f"got {radius_m + other_radius_m:.3f} m"
            yield f"system.uav.{other}.radius_m", f"{expected}, {got}"


def too_close_at_hover(model: Model, hover: Hover, settings: ControllerSettings) -> Problems:
    """Yield the least distance of UAVs if they are closer at hover."""
    if settings.separation is not None:
        minimum_m = settings.separation.minimum_m
        distances_m = _distances_at_hover(model, hover)
        pair = min(distances_m, key=distances_m.__getitem__, default=None)
        if pair is not None and distances_m[pair] < minimum_m:
            apart = f"{distances_m[pair]:.3f} m (UAV{pair[0]} and UAV{pair[1]} at hover)"
            remedy = "move their attachments apart, or take a smaller minimum"
            problem = f"expected at most {apart}, got {minimum_m}; {remedy}"
            yield "controller.separation.minimum_m", problem


def _distances_at_hover(model: Model, hover: Hover) -> dict[tuple[int, int], float]:
    """Return the distance of each pair of UAVs, counted from 1, at hover, m."""
    r_I = model.outputs(hover.x)[: 3 * model.system.N].reshape(-1, 3)
    return {
        (one, other): float(np.linalg.norm(r_one - r_other))
        for (one, r_one), (other, r_other) in combinations(enumerate(r_I, start=1), 2)
    }


def _not_within(quantity: str, limits: Sequence[float]) -> str:
    """Return the text for a range that does not contain a quantity."""
    return f"expected a range that contains {quantity}, got {list(limits)}"


def off_limits(
    reference: Reference,
    system: System,
    hover: Hover,
    settings: ControllerSettings,
    faults: Sequence[Fault],
) -> Problems:
    """Yield how a flat reference exceeds the limits, and the least slowing with which it does not.

    Also after each scripted release, for the remaining UAVs. Source: docs/equations.md (69).
    """
    if not reference.is_flat:
        return
    field = "maneuver.profile"  # blamed for an error of the path itself
    try:
        instants_s = checked_instants(reference)
        path = reference.maneuver.jets(instants_s)
        field = "maneuver.phase"
        for team in remaining_teams(system, hover, faults):
            after = instants_s >= team.tick * settings.sampling_period_s
            when = partial(_words_of_instant, reference.maneuver, instants_s[after])
            problem = exceeded(path[:, after], team, settings, when)
            if problem:
                # After slowing, the release may be anywhere on the path.
                factor = least_slowing(path, team, settings)
                phase = None
                if not team.released:
                    phase = least_longer(reference, team, settings)
                yield field, problem + _slower(reference.maneuver, factor, phase)
            field = "faults.event"  # of the teams after releases
    except ParameterError as error:
        yield field, str(error)


def _words_of_instant(maneuver: Maneuver, instants_s: Array, instant: int) -> str:
    return instant_in_words(maneuver, float(instants_s[instant]))


def instant_in_words(maneuver: Maneuver, t_s: float) -> str:
    """Return a time of a maneuver and its phase in words, after the name of a UAV."""
    number = phase_number(maneuver, t_s)
    return f" at {t_s:.2f} s in phase {number} ({maneuver.phases[number - 1].name})"


def phase_number(maneuver: Maneuver, t_s: float) -> int:
    """Return the number of the phase, from 1, that a time of a maneuver without targets belongs to."""
    ends_s = np.cumsum([phase.duration_s for phase in maneuver.phases])
    return min(int(np.searchsorted(ends_s, t_s, side="right")), len(ends_s) - 1) + 1


def least_longer(
    reference: Reference, team: RemainingTeam, settings: ControllerSettings
) -> tuple[int, float] | None:
    """Return the only phase that exceeds limits, from 1, and the factor on its duration with which none does.

    None if several phases exceed limits, or no longer duration helps.
    """
    maneuver = reference.maneuver
    instants_s = checked_instants(reference)
    numbers = np.array([phase_number(maneuver, t_s) for t_s in instants_s])
    path = maneuver.jets(instants_s)
    too_fast = [
        number
        for number in np.unique(numbers)
        if exceeded(path[:, numbers == number], team, settings) is not None
    ]
    if len(too_fast) != 1:
        return None

    number = int(too_fast[0])
    phase = maneuver.phases[number - 1]
    if isinstance(phase.way, np.ndarray) or (isinstance(phase.way, Curve) and len(phase.way.table)):
        return None  # a table has its own times

    def keeps(factor: float) -> bool:
        longer = maneuver.with_longer(number, factor)
        end_s = longer.duration_s
        ticks_s = np.arange(0.0, end_s, settings.sampling_period_s)
        own_s = ascending(maneuver_instants(longer), ticks_s)
        return exceeded(longer.jets(own_s), team, settings) is None

    factor = least_factor(keeps)
    return None if factor is None else (number, factor)


def _slower(maneuver: Maneuver, factor: float | None, phase: tuple[int, float] | None) -> str:
    """Return the remedies for a reference that exceeds limits, if there are any.

    Args:
        maneuver: The maneuver.
        factor: On the durations of all phases; None if none helps.
        phase: One phase, from 1, that may be longer in their place, and the factor on its duration.
    """
    if factor is None:
        return ""
    text = f"; feasible if all phases take {factor:.3f} times as long"
    if phase is None:
        return text
    number, longer = phase
    # Rounded up: the factor in the text is large enough.
    times = f"{math.ceil(1e3 * longer) / 1e3:.3f} times"
    name = maneuver.phases[number - 1].name
    keys = "its duration_s (or 1 / speed_mps), ramp_s and times_s times this"
    return f"{text}, or phase {number} ({name}) alone {times}: {keys}"


def blocked(
    reference: Reference, obstacles: Sequence[Obstacle], system: System
) -> tuple[int, str] | None:
    """Return the number, from 1, of the first obstacle that is too near, and the problem."""
    return first_blocked(system, obstacles, reference.states, checked_instants(reference))


def checked_instants(reference: Reference) -> Array:
    """Return the sampling instants, and those between them at which a path is checked, (k,), s."""
    return ascending(reference.times_s, maneuver_instants(reference.maneuver))
