"""Relations between the fields of the maneuver's phases and of obstacles, and those of the rest of a scenario."""

from itertools import pairwise

from transport.protocol.scenario.faults.fault_relations import Problems
from transport.protocol.scenario.sections.maneuver_sections import PhaseSection
from transport.protocol.scenario.sections.schema import Scenario


def phase_problems(scenario: Scenario) -> Problems:
    """Yield phases whose fields contradict each other, or the rest of the maneuver."""
    maneuver = scenario.maneuver
    for i, phase in enumerate(maneuver.phase, start=1):
        field = f"maneuver.phase.{i}"
        if phase.kind in ("take_off", "land"):
            yield from _vertical(phase, field, has_ground=scenario.plant.ground_m is not None)
        yield from _curve(phase, field)

        if phase.formation and maneuver.reference == "hover":
            yield f"{field}.formation", "maneuver.reference = 'flat' with it", "'hover'"
        is_last = not any(later.formation for later in maneuver.phase[i:])
        if phase.formation and is_last and phase.formation[-1][1:] != (1.0, 1.0):
            got = list(phase.formation[-1][1:])
            yield f"{field}.formation", "1, 1 at the end of the maneuver", got


def _vertical(phase: PhaseSection, field: str, *, has_ground: bool) -> Problems:
    """Yield what is wrong with a take-off or landing."""
    if not has_ground:
        yield f"{field}.kind", "plant.ground_m with it", f"{phase.kind!r} without a ground"

    x, y, z = phase.displacement_m
    is_take_off = phase.kind == "take_off"
    is_right_way = z < 0.0 if is_take_off else z > 0.0
    if x != 0.0 or y != 0.0 or not is_right_way:
        direction = "up, negative z" if is_take_off else "down, positive z"
        yield f"{field}.displacement_m", f"a path straight {direction}", [x, y, z]


def _curve(phase: PhaseSection, field: str) -> Problems:
    """Yield what is wrong with the table, the way points or the ramps of a phase."""
    if phase.kind != "move" and phase.way is not None:
        yield f"{field}.kind", "'move' with a path from a file", repr(phase.kind)

    points = phase.points_m or []
    if phase.kind == "spline" and not points:
        yield f"{field}.points_m", "way points with kind 'spline'", "none"
    if phase.kind != "spline":
        for key in ("points_m", "times_s"):
            if getattr(phase, key) is not None:
                yield f"{field}.{key}", "it only with kind 'spline'", f"kind {phase.kind!r}"

    times = phase.times_s
    if times is not None:
        is_rising = all(earlier < later for earlier, later in pairwise(times))
        if len(times) != len(points) or not is_rising:
            expected = f"{len(points)} rising times, one for each way point"
            yield f"{field}.times_s", expected, times

    longest_s = phase.duration_s / 2.0
    if phase.curve() is not None and phase.ramp_s > longest_s:
        yield f"{field}.ramp_s", f"at most half the duration, {longest_s:g} s", phase.ramp_s


def obstacle_problems(scenario: Scenario) -> Problems:
    """Yield sizes that an obstacle of its kind lacks or does not have."""
    sizes = {"radius_m": ("sphere", "cylinder"), "size_m": ("box",), "width_m": ("gap",)}
    for i, section in enumerate(scenario.obstacle, start=1):
        for key, kinds in sizes.items():
            given = getattr(section, key)
            is_missing = given is None
            if is_missing == (section.kind in kinds):
                article = "a" if is_missing else "no such"
                expected = f"{article} size with kind {section.kind!r}"
                yield f"obstacle.{i}.{key}", expected, given or "nothing"
        if section.seen_within_m is not None:
            if section.seen_within_m <= section.margin_m:
                expected = f"more than its margin_m, {section.margin_m:g}"
                yield f"obstacle.{i}.seen_within_m", expected, section.seen_within_m
            if scenario.has_vehicles:
                expected = "no value where UAVs have processes of their own, which see nothing"
                yield f"obstacle.{i}.seen_within_m", expected, section.seen_within_m
