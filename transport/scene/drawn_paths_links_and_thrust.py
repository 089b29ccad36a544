"""Drawing of a run in moving frames, which browser, bags and figures show alike.

Bodies are fixed in their frames; lines that change lie in frames that move with the team or the
payload, as a browser draws their points later than poses. The frames and their poses:
`frames_and_poses.py`; lengths in m.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.distance import pdist

from transport.model.arrays import Array
from transport.scene.frames_and_poses import GOAL, INERTIAL, LOAD, PAYLOAD, TEAM
from transport.scene.lines_meshes_and_labels import (
    Colour,
    Label,
    LineSegments,
    Part,
    ball,
    lines,
    segments,
    solid,
)
from transport.scene.payload_uav_and_obstacle_meshes import (
    DARK_GREY,
    GREY,
    obstacles,
    payload_points,
    quadrotor,
)
from transport.scene.scene_at_tick import Scene, SceneBuilder
from transport.scene.uav_and_link_colours import age_colour, uav_colour

# Layers that can be shown and hidden; parts of no layer are always shown.
LAYERS = ("predictions", "actual paths", "reference", "links", "thrust", "names")

_REFERENCE: Colour = (150, 150, 150)
_ACTUAL: Colour = (0, 0, 0)

# Span of a drawn UAV, m, at most this part of the smallest gap between UAVs.
_SPAN_M = 0.9
_SPAN_OF_GAP = 0.7
# Length of a thrust arrow at hover, and of the strokes at its tip, m.
ARROW_M = 0.6
_BARB_M = 0.05
_BARBS = np.array([[1, 0, 2], [-1, 0, 2], [0, 1, 2], [0, -1, 2]])
_GOAL_M = 0.07  # radius of the reference position, m
_BELOW_M = 0.5  # distance of the plane below everything where there is no ground, m
# Place of a name, outside the formation and above the UAV, m.
_NAME_OUTSIDE_M = 0.3
_NAME_ABOVE_M = 0.1

# Points of an actual path, of the reference, and of the reference to a target.
_POINTS = 160
_POINTS_REFERENCE = 120
_POINTS_TARGET = 30
_DRAWN_TARGETS = 20  # the newest ones


class Drawing:
    """Drawing of one run: parts that are `fixed` in their frames, and those of a scene."""

    def __init__(self, builder: SceneBuilder) -> None:
        self._builder = builder
        # For what no target changes; `builder.setup` is the setup with the targets so far.
        self._setup_at_start = builder.setup
        self._N = self._setup_at_start.system.N

        # Start of the payload and of the middle of the UAVs, (3,).
        payload_I, uavs_I = self._reference()
        self.start_I = payload_I[0]
        self.team_I = uavs_I[0].mean(axis=0)

        # Box around the maneuver and the arrows, its diagonal, and the plane below it.
        arrow_tips_I = uavs_I.reshape(-1, 3) - np.array([0.0, 0.0, 2.0 * ARROW_M])
        everything = np.vstack([payload_I, arrow_tips_I])
        self.low = everything.min(axis=0)
        self.high = everything.max(axis=0)
        self.size = float(np.linalg.norm(self.high - self.low))
        ground_m = self._setup_at_start.scenario.plant.ground_m
        self.floor = float(self.high[2]) + _BELOW_M if ground_m is None else ground_m

        # No drawn UAV touches another, or an obstacle at its margin.
        gap_m = pdist(builder.start_I).min(initial=np.inf)
        margins_m = [2.0 * obstacle.margin_m for obstacle in self._setup_at_start.obstacles]
        self.span = min([_SPAN_M, _SPAN_OF_GAP * float(gap_m), *margins_m])

        self._targets = len(self._setup_at_start.maneuver.targets)  # that are drawn
        self.fixed: tuple[Part, ...] = tuple(self._fixed())

    def moving(self, scene: Scene) -> Iterator[LineSegments]:
        """Yield the lines of a scene except the actual paths.

        The first call after a new target also renews `fixed`, and yields the reference once: a
        drawing has one reader.
        """
        targets = len(self._builder.setup.maneuver.targets)
        if targets != self._targets:
            self._targets = targets
            self.fixed = tuple(self._fixed())
            yield from self._reference_lines()

        yield lines("thrust", TEAM, "thrust", 3.0, self._arrows(scene))
        yield lines("links", TEAM, "links", 5.0, self._links(scene))
        yield from self._predicted(scene)

    def flown(self, scene: Scene) -> LineSegments:
        """Return the actual paths until a scene."""
        payload_I, uavs_I = self._builder.paths(scene.tick, _POINTS)
        paths = [(_ACTUAL, segments(payload_I))]
        paths += [(uav_colour(i), segments(uavs_I[:, i])) for i in range(self._N)]
        return lines("actual paths", INERTIAL, "actual paths", 2.0, paths)

    def _reference(self) -> tuple[Array, Array]:
        """Return the reference paths of payload, (k, 3), and UAVs, (k, N, 3), inertial frame, m."""
        setup = self._builder.setup
        end_s = setup.ticks * setup.settings.sampling_period_s
        times_s = [np.linspace(0.0, end_s, _POINTS_REFERENCE)]
        for target in setup.maneuver.targets[-_DRAWN_TARGETS:]:
            times_s.append(np.linspace(target.since_s, target.ends_s, _POINTS_TARGET))
        t = np.unique(np.concatenate(times_s))

        payload_I = setup.maneuver.path(t)[0]
        uavs_I = setup.reference.outputs(t)[:, : 3 * self._N]
        return payload_I, uavs_I.reshape(-1, self._N, 3)

    def _reference_lines(self) -> Iterator[LineSegments]:
        """Yield the reference of payload and UAVs as dashed lines."""
        payload_I, uavs_I = self._reference()
        paths = {PAYLOAD: payload_I}
        paths |= {f"uav{i + 1}": uavs_I[:, i] for i in range(self._N)}
        for name, path_I in paths.items():
            width = 1.5 if name == PAYLOAD else 1.0
            dashes = [(_REFERENCE, segments(path_I)[::2])]
            yield lines(f"reference of {name}", INERTIAL, "reference", width, dashes)

    def _predicted(self, scene: Scene) -> Iterator[LineSegments]:
        """Yield the predicted paths of UAVs and payload, in the colours of the agents' UAVs."""
        team_I = scene.uavs_I.mean(axis=0)
        uavs: list[tuple[Colour, Array]] = []
        payload: list[tuple[Colour, Array]] = []
        for prediction in scene.predictions:
            owned = self._setup_at_start.owned[prediction.agent - 1]
            for k, uav in enumerate(owned):
                uavs.append((uav_colour(uav), segments(prediction.uavs_I[:, k] - team_I)))
            path = prediction.payload_I - scene.payload_I
            payload.append((uav_colour(owned[0]), segments(path)))
        yield lines("predicted UAVs", TEAM, "predictions", 4.0, uavs)
        yield lines("predicted payload", LOAD, "predictions", 4.0, payload)

    def _arrows(self, scene: Scene) -> Iterator[tuple[Colour, Array]]:
        """Yield the thrust of each UAV in the frame of the team.

        Each is an arrow with four strokes at its tip.
        """
        feet = scene.uavs_I - scene.uavs_I.mean(axis=0)
        thrusts = zip(feet, scene.thrusts_I, scene.R_uavs, strict=True)
        for i, (foot, thrust_I, R) in enumerate(thrusts):
            if i + 1 in scene.released:
                continue
            tip = foot + thrust_I * (ARROW_M / self._builder.hover_N)
            barbs = tip + _BARB_M * _BARBS @ R.T
            yield uav_colour(i), np.array([(foot, tip), *((tip, barb) for barb in barbs)])

    def _links(self, scene: Scene) -> Iterator[tuple[Colour, Array]]:
        """Yield the links in the frame of the team: the half next to the receiver."""
        positions = np.array(
            [scene.uavs_I[list(uavs)].mean(axis=0) for uavs in self._setup_at_start.owned]
        )
        positions -= scene.uavs_I.mean(axis=0)
        for sender, receiver, age_s in scene.links:
            near = positions[receiver - 1]
            far = positions[sender - 1]
            colour = age_colour(age_s, self._setup_at_start.settings.sampling_period_s)
            yield colour, np.array([(near, (near + far) / 2.0)])

    def _fixed(self) -> Iterator[Part]:
        """Yield the parts that stay as they are in their frames."""
        setup = self._setup_at_start
        yield from self._reference_lines()
        yield solid("reference position", GOAL, ball(_GOAL_M), _REFERENCE, layer="reference")

        is_grounded = setup.scenario.plant.ground_m is not None
        yield solid("body", PAYLOAD, payload_points(setup.system, grounded=is_grounded), DARK_GREY)

        places = self._name_places()
        for i, uav in enumerate(setup.system.uavs):
            name = f"uav{i + 1}"
            rod = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, -uav.rod_length]]])
            yield lines("rod", f"rod{i + 1}", "", 3.0, [(GREY, rod)])
            yield from quadrotor(name, self.span, uav_colour(i))
            yield Label("name", name, "names", f"UAV{i + 1}", places[i], uav_colour(i))

        yield from obstacles(setup, self.low, np.array([*self.high[:2], self.floor]))

    def _name_places(self) -> Array:
        """Return the place of each UAV's name in its frame, (N, 3).

        It is outside the formation and above the UAV.
        """
        outwards = self._builder.start_I - self._builder.start_I.mean(axis=0)
        distances = np.linalg.norm(outwards, axis=1, keepdims=True)
        outwards *= _NAME_OUTSIDE_M / np.maximum(distances, 1e-6)
        places: Array = outwards - np.array([0.0, 0.0, _NAME_ABOVE_M])
        return places
