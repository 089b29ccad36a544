"""Sections of a scenario about the payload's path: phases, targets, obstacles."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from pydantic import Field, ValidationInfo, model_validator

from transport.model.path.curves import Curve, ShapeKind
from transport.model.path.phase import PhaseKind, Profile
from transport.model.section import Key, NotNegative, Positive, PositiveVector, Section, Vector
from transport.protocol.scenario.files.named_files import TableError, way_of
from transport.protocol.scenario.sections.path_instants import WayPointError, check_way_points
from transport.protocol.wire.messages import MAX_POINTS


class PhaseSection(Section):
    """One piece of the payload's path; tables and curves define displacement and duration."""

    name: str
    """name of the phase in progress display and figures"""
    duration_s: Positive
    """duration of the phase"""
    # That of a path from a file is a difference of its rows.
    displacement_m: Annotated[Vector, Key(within=(0.0, 1e5))]
    """displacement of the payload over the phase, inertial frame; up is negative z"""
    kind: PhaseKind = "move"
    """take_off and land are vertical, from and to the ground, where the payload stands for a
    quarter of the phase; circle, eight and spline are curves from rest to rest
    ([own-maneuver.md](../own-maneuver.md#your-own-maneuver))"""
    way: Annotated[
        list[list[float]] | None, Key(type="rows of 4 numbers", unit="s and m", within=(0.0, 1e9))
    ] = None
    """the table of `file` after reading, or in its place: times since the start of the phase and
    positions relative to it, from zeros to duration and displacement, which can then be omitted;
    between rows at constant speed"""
    file: str | None = None
    """path of the phase as a table, instead of duration and displacement: CSV with the columns
    `t_s,x_m,y_m,z_m`, relative to the scenario's folder
    ([own-maneuver.md](../own-maneuver.md#your-own-maneuver))"""
    size_m: Annotated[Vector, Key(within=(0.0, 1e5))] = (0.0, 0.0, 0.0)
    """a, b, c of a circle, (a sin A, b (1 - cos A), c sin A), or an eight, (a sin A, b sin 2 A, c
    sin A), with the angle A from 0 to 2 pi `laps`"""
    laps: Annotated[Positive, Key(within=(1e-3, 1e4))] = 1.0
    """of a circle or eight"""
    points_m: Annotated[list[Vector] | None, Key(type="list of lists of 3 numbers", unit="m")] = (
        None
    )
    """way points of a spline after its start, relative to that"""
    times_s: Annotated[list[Positive] | None, Key(type="list of numbers > 0, rising", unit="s")] = (
        None
    )
    """times of the way points of a spline since its start; they define its duration"""
    speed_mps: Annotated[Positive | None, Key(label="largest speed")] = None
    """largest speed on a circle, eight or spline without times; it decides over `duration_s`"""
    ramp_s: Positive = 3.0
    """time in which a circle, eight or spline speeds up at its start, and slows down at its end"""
    formation: Annotated[list[Vector] | None, Key(type="rows of 3 numbers", unit="shares")] = None
    """rods lean out or in, with `reference` flat: rows of a share of the phase's duration, and
    length and width of a team from then on over those at hover
    ([equations](../equations/flat.md#references-that-a-team-can-fly), (66a))"""

    @model_validator(mode="before")
    @classmethod
    def _timed(cls, value: Any, info: ValidationInfo) -> Any:
        """Read the file; fill in duration and displacement of a valid table or curve."""
        if isinstance(value, dict) and isinstance(value.get("file"), str):
            value = _with_table(value, Path(info.context or ""))
        try:
            if value.get("way"):
                duration_s, *displacement_m = value["way"][-1]
                return {"duration_s": duration_s, "displacement_m": displacement_m, **value}
            return cls._with_ends_of_curve(value)
        except WayPointError:
            raise
        except (TypeError, ValueError, AttributeError, LookupError):
            return value  # a wrong field is refused by its own check

    @classmethod
    def _with_ends_of_curve(cls, value: dict[str, Any]) -> dict[str, Any]:
        """Return the fields of a phase with duration and displacement of its curve, if it has one.

        Raises: WayPointError: no spline passes its points. Other exceptions of invalid fields.
        """
        given = cls.model_construct(**value)  # not validated yet, as that needs the duration
        # Without a duration any that has room for both ramps: shape and end do not depend on it.
        curve = given.curve(value.get("duration_s", 2.0 * given.ramp_s))
        if curve is None:
            return value

        if given.times_s is not None:
            curve = replace(curve, duration_s=float(given.times_s[-1]))
        if curve.kind == "spline":
            check_way_points(curve)
        if given.times_s is None and given.speed_mps is not None:
            # The share s of the path rises by at most 1 / (T - t_ramp), so the payload has the speed
            # v at most with  T = max |dr/ds| / v + t_ramp.
            duration_s = float(curve.fastest() / given.speed_mps + given.ramp_s)
            curve = replace(curve, duration_s=duration_s)

        if given.times_s is not None or given.speed_mps is not None:
            value = {**value, "duration_s": curve.duration_s}
        end_m = curve.path(np.array([curve.duration_s]), 1)[0, 0].tolist()
        # A given displacement stays as it is.
        return {"displacement_m": end_m, **value}

    def curve(self, duration_s: float | None = None) -> Curve | None:
        """Return the curve of a circle, eight or spline, over its own duration by default.

        None for other kinds.
        """
        if self.kind not in get_args(ShapeKind):
            return None

        return Curve(
            kind=self.kind,  # type: ignore[arg-type]  # one of those
            duration_s=self.duration_s if duration_s is None else duration_s,
            ramp_s=self.ramp_s,
            size_I=tuple(self.size_m),
            laps=self.laps,
            points_I=self.points_m or (),
            times_s=self.times_s,
        )


class TargetSection(Section):
    """A target of the payload, given during the flight."""

    points_m: Annotated[
        list[Vector],
        Field(max_length=MAX_POINTS - 2),
        Key(type=f"at most {MAX_POINTS - 2} lists of 3 numbers"),
    ] = []
    """the target, inertial frame (z down), or way points of a spline that is run through from the
    first one on; required, but for a landing"""
    land: bool = False
    """true: the team comes down after the last point, or where it is, and rests: on `plant.ground_m`,
    or without a ground at the height at which the payload would stand on z = 0"""
    land_at_m: Annotated[
        Annotated[list[float], Field(min_length=2, max_length=2)] | None, Key(type="2 numbers")
    ] = None
    """with land: x and y of the place, to which the payload first goes at its height"""
    speed_mps: Annotated[Positive | None, Key(label="largest speed")] = None
    """largest speed on the way; if omitted, that which the team can fly, at most 1 m/s, and down to the
    ground 0.5 m/s"""
    times_s: Annotated[list[NotNegative] | None, Key(type="list of rising numbers", unit="s")] = (
        None
    )
    """times of the points instead of a speed; they count from that of the first one"""
    to: Annotated[list[Annotated[int, Field(ge=1)]], Key(type="list of agents")] = []
    """agents that are told, such as [2]; the others learn the target from plans
    ([active-runs.md](../active-runs.md#targets)). If omitted, all are told at the same tick"""

    @model_validator(mode="after")
    def _points_differ_and_times_rise(self) -> Self:
        times_s = self.times_s
        if not self.points_m and not self.land:
            raise ValueError("points_m: expected at least one point, or land = true, got none")
        if self.land_at_m is not None and not self.land:
            raise ValueError("land_at_m: expected none without land = true, got a place")
        if times_s is not None and self.land:
            raise ValueError("times_s: expected speed_mps with land = true, got times")
        if times_s is not None:
            if self.speed_mps is not None:
                expected = "speed_mps: expected none next to times_s, which define the speed"
                raise ValueError(f"{expected}, got {self.speed_mps:g}")
            if len(times_s) != len(self.points_m):
                expected = f"times_s: expected a time for each of {len(self.points_m)} way points"
                raise ValueError(f"{expected}, got {len(times_s)}")
            if any(earlier >= later for earlier, later in pairwise(times_s)):
                raise ValueError(f"times_s: expected rising times, got {times_s}")

        if any(here == after for here, after in pairwise(self.points_m)):
            expected = "points_m: expected each way point away from the one before"
            raise ValueError(f"{expected}, got the same twice")
        return self


class ScriptedTargetSection(TargetSection):
    """A target that the coordinator announces at an instant, as it does for `transport target`."""

    at_s: NotNegative
    """time from which on the controllers know it"""


class ManeuverSection(Section):
    """Path of the payload."""

    start_m: Vector = (0.0, 0.0, -10.0)
    """payload position at t = 0, inertial frame; the run starts there at rest in hover"""
    reference: Literal["hover", "flat"] = "hover"
    """hover moved along the path, or the motion of the whole team that carries the payload along a
    smooth one ([equations](../equations/flat.md#references-that-a-team-can-fly)); needs closed_loop,
    along, riccati, preview"""
    profile: Profile = "ramp"
    """speed along a straight segment: constant, minimum jerk, a step, or smooth to the seventh
    derivative. smooth also replaces tables by splines from rest to rest, which round corners within
    some 0.5 s"""
    press_m: NotNegative = 0.2
    """distance of the controllers' reference below the payload that stands on the ground
    ([equations](../equations/plant.md#on-the-ground)): the larger, the less of its weight the team
    holds"""
    phase: Annotated[list[PhaseSection], Field(min_length=1), Key(short="phases")]
    target: list[ScriptedTargetSection] = []


class ObstacleSection(Section):
    """A body to keep clear of, in the reference and, with a flat one, in every agent's program."""

    kind: Literal["sphere", "cylinder", "box", "gap"]
    """a cylinder is upright and without ends; a gap is the opening between two walls without other
    ends"""
    at_m: Annotated[Vector, Key(within=(0.0, 1e6))]
    """its centre, that of the opening of a gap; inertial frame, z down"""
    margin_m: Positive
    """smallest distance of the centre of a UAV, which holds half its size"""
    load_margin_m: NotNegative = 0.0
    """smallest distance of rods and of the payload, a box as far as its attachments"""
    radius_m: Positive | None = None
    """of a sphere or cylinder"""
    size_m: PositiveVector | None = None
    """edges of a box, along its heading, across, vertical"""
    width_m: Positive | None = None
    """of the opening of a gap"""
    thickness_m: Positive = 0.2
    """of the walls of a gap"""
    heading_deg: float = 0.0
    """direction of the first edge of a box, or of the passage through a gap, from x towards y"""
    penalty: Annotated[Positive, Key(unit="1/m", within=(1e-12, 1e8))] = 100.0
    """penalty on the largest violation of a margin over the horizon; only with a flat reference"""
    seen_within_m: Positive | None = None
    """no agent knows the obstacle before a UAV of its own is that near its surface; it then hands a way
    round, or a stop, to the team ([equations](../equations/information.md#obstacles-seen-in-flight)).
    If omitted, all know it"""


def _with_table(phase: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the fields of a phase with the rows of its file, relative to a folder.

    Raises: TableError: it cannot be read, or a field contradicts it.
    """
    for key in ("duration_s", "displacement_m", "way"):
        if key in phase:
            raise TableError(f"expected no {key} next to `file`, which defines it")

    rest = {key: value for key, value in phase.items() if key != "file"}
    return {**rest, "way": way_of(folder / phase["file"])}
