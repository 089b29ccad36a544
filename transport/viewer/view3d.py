"""The 3D part of the viewer: nodes of a viser scene that follow the scene of a run."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from model.arrays import Array
from transport.scene.geometry import (
    ARM,
    BEAM,
    BODY,
    ROTOR,
    agent_places,
    dashed,
    link_segments,
    name_places,
    payload_mesh,
    quaternion,
    rotor_centres,
    segments,
    simplified,
    span_m,
    uav_colour,
)
from transport.scene.scene import Scene, Scenes

if TYPE_CHECKING:
    import viser

# What can be shown and hidden: name, and whether it is shown at first.
LAYERS: Mapping[str, bool] = {
    "predictions": True,
    "flown paths": True,
    "reference": True,
    "links": True,
    "thrust": True,
    "names": True,
}

_PAYLOAD, _ROD, _REFERENCE, _FLOWN = (60, 60, 60), (90, 90, 90), (150, 150, 150), (0, 0, 0)
# Length of a thrust arrow at hover, m.
_ARROW_M = 0.6
# From where the maneuver is looked at, in parts of its size, and the team in parts of its own: links and predicted
# paths lie in the plane of the UAVs, so that both are seen from well above it. Seen from +y, x is to the right as it is
# in the figures. With the camera's vertical angle, rad.
_VIEW, _VIEW_TEAM, _FOV = np.array([0.5, 1.1, -0.6]), np.array([0.9, 1.9, -2.2]), 0.75
# Points of a path that is flown and of one asked for, and how far the former may be from what is drawn, in parts of the
# maneuver's size: more cannot be told apart, and wide lines are a third of what a browser without a graphics processor
# works at.
_POINTS, _POINTS_ASKED, _TOLERANCE = 240, 120, 5e-4
_NOTHING = np.zeros((1, 2, 3))


class Stage:
    """What is drawn of one run.

    Args:
        server: Where.
        scenes: Of the run.
    """

    def __init__(self, server: "viser.ViserServer", scenes: Scenes) -> None:
        self._server, self._scenes = server, scenes
        self._setup = scenes.setup
        self._N = self._setup.system.N
        self._shown = dict(LAYERS)
        self._hover = float(np.mean(self._setup.hover.u[::4]))
        scene = server.scene
        scene.set_up_direction("-z")
        self._furnish()
        vertices, faces = payload_mesh(self._setup.system)
        self._payload = scene.add_frame("/payload", show_axes=False)
        scene.add_mesh_simple("/payload/body", vertices, faces, color=_PAYLOAD, flat_shading=True, side="double")
        self._span_m = span_m(self._setup.reference.outputs(np.zeros(1))[0, : 3 * self._N].reshape(self._N, 3))
        self._uavs = [self._uav(i) for i in range(self._N)]
        self._goal = scene.add_icosphere("/goal", radius=0.07, color=_REFERENCE, cast_shadow=False)
        self._rods = self._lines("rods", 3.0)
        self._flown = self._lines("flown", 2.0)
        self._expected = self._lines("expected", 4.0)
        self._links = self._lines("links", 5.0)
        width = 0.03 * self._span_m
        self._thrust = scene.add_arrows(
            "/thrust", _NOTHING, (0, 0, 0), shaft_radius=width, head_radius=2.5 * width, head_length=6.0 * width
        )
        self._labels = [
            scene.add_label(f"/name{i + 1}", f"UAV{i + 1}", anchor="bottom-center", font_screen_scale=0.9)
            for i in range(self._N)
        ]

    @property
    def payload_I(self) -> Array:
        """Where the payload is drawn, (3,), inertial frame, m."""
        return np.array(self._payload.position)

    def show_layer(self, name: str, shown: bool) -> None:
        """Show or hide one of `LAYERS`."""
        self._shown[name] = shown
        nodes: Mapping[str, list[Any]] = {
            "predictions": [self._expected],
            "flown paths": [self._flown],
            "reference": [*self._references, self._goal],
            "links": [self._links],
            "thrust": [self._thrust],
            "names": list(self._labels),
        }
        for node in nodes[name]:
            node.visible = shown

    def show(self, scene: Scene) -> None:
        """Draw a scene."""
        with self._server.atomic():
            self._payload.position, self._payload.wxyz = scene.payload_I, quaternion(scene.R_payload)
            self._goal.position = scene.payload_reference_I
            for i, node in enumerate(self._uavs):
                node.position, node.wxyz = scene.uavs_I[i], quaternion(scene.R_uavs[i])
            for label, place in zip(self._labels, name_places(scene), strict=True):
                label.position = place
            _put(self._rods, np.stack([scene.uavs_I, scene.attachments_I], axis=1), _ROD)
            if self._shown["thrust"]:
                tips = scene.uavs_I + scene.thrusts_I * (_ARROW_M / self._hover)
                self._thrust.points = np.stack([scene.uavs_I, tips], axis=1).astype(np.float32)
                self._thrust.colors = _linear([uav_colour(i) for i in range(self._N)])
            if self._shown["links"]:
                _put(self._links, *link_segments(scene.links, agent_places(scene, self._setup.owned)))
            if self._shown["predictions"]:
                self._show_expectations(scene)
            if self._shown["flown paths"]:
                self._show_flown(scene)

    def look_at(self, scene: Scene | None) -> None:
        """Turn every browser's camera to the team in a scene, or to the whole maneuver."""
        target, position = self._overview
        if scene is not None:
            size = max(float(np.linalg.norm(np.ptp(scene.uavs_I, axis=0))), 1.0)
            target = scene.uavs_I.mean(axis=0)
            position = target + _VIEW_TEAM * size
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position = position  # which takes along what is looked at
                client.camera.look_at = target

    def _show_expectations(self, scene: Scene) -> None:
        pieces, colours = [], []
        for expected in scene.expectations:
            own = self._setup.owned[expected.agent - 1]
            paths = [(uav_colour(uav), expected.uavs_I[:, k]) for k, uav in enumerate(own)]
            for colour, path in [*paths, (uav_colour(own[0]), expected.payload_I)]:
                pieces.append(segments(path))
                colours.append(np.tile(colour, (len(pieces[-1]), 1)))
        if pieces:
            _put(self._expected, np.concatenate(pieces), np.concatenate(colours))
        else:
            _put(self._expected, _NOTHING, _FLOWN)

    def _show_flown(self, scene: Scene) -> None:
        payload_I, uavs_I = self._scenes.flown(scene.tick, _POINTS)
        paths = [payload_I, *(uavs_I[:, i] for i in range(self._N))]
        pieces = [segments(simplified(path, _TOLERANCE * self._size_m)) for path in paths]
        colours = [_FLOWN, *(uav_colour(i) for i in range(self._N))]
        _put(
            self._flown,
            np.concatenate(pieces),
            np.concatenate([np.tile(c, (len(p), 1)) for c, p in zip(colours, pieces, strict=True)]),
        )

    def _furnish(self) -> None:
        """Grid, reference and camera, around the whole maneuver."""
        setup, scene = self._setup, self._server.scene
        duration_s = setup.ticks * setup.settings.sampling_period_s
        times_s = np.linspace(0.0, duration_s, _POINTS_ASKED)
        payload_I = setup.maneuver.path(times_s)[0]
        uavs_I = setup.reference.outputs(times_s)[:, : 3 * self._N].reshape(len(times_s), self._N, 3)
        self._references = []
        for name, path in [("payload", payload_I), *((f"uav{i + 1}", uavs_I[:, i]) for i in range(self._N))]:
            node = self._lines(f"reference/{name}", 1.5 if name == "payload" else 1.0)
            _put(node, dashed(path), _REFERENCE)
            self._references.append(node)
        above = uavs_I.reshape(-1, 3) - np.array([0.0, 0.0, 2.0 * _ARROW_M])  # thrust and names
        everything = np.vstack([payload_I, above])
        low, high = everything.min(axis=0), everything.max(axis=0)
        size, middle = float(np.linalg.norm(high - low)), (low + high) / 2.0
        self._size_m = size
        floor = float(high[2]) + 0.5
        scene.add_grid(
            "/grid",
            width=2.0 * np.ceil(0.7 * size),
            height=2.0 * np.ceil(0.7 * size),
            position=(round(middle[0]), round(middle[1]), floor),
            cell_size=0.5,
            section_size=1.0,
            cell_color=(235, 235, 235),
            section_color=(210, 210, 210),
            infinite_grid=False,
            fade_distance=100.0,
        )
        start = (*payload_I[0, :2], floor)
        scene.add_frame("/axes", axes_length=0.5, axes_radius=0.015, position=start)
        # Colours are to be those of the figures, and hosts without a graphics processor are to keep up: no surroundings
        # that are mirrored, no shadows.
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light", intensity=1.5)
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        self._overview = middle, middle + _VIEW * size
        camera = self._server.initial_camera
        camera.position = self._overview[1]
        camera.look_at = self._overview[0]
        camera.up, camera.fov = (0.0, 0.0, -1.0), _FOV

    def _uav(self, i: int) -> Any:
        scene, name, colour, span = self._server.scene, f"/uav{i + 1}", uav_colour(i), self._span_m
        node = scene.add_frame(name, show_axes=False)
        scene.add_cylinder(f"{name}/body", radius=2.0 * BODY * span, height=BODY * span, color=colour)
        for k, yaw in enumerate((45.0, 135.0)):
            half = np.radians(yaw) / 2.0
            scene.add_box(
                f"{name}/beam{k}",
                dimensions=span * np.array([2.0 * ARM, 2.0 * BEAM, BEAM]),
                color=_ROD,
                wxyz=(np.cos(half), 0.0, 0.0, np.sin(half)),
                position=(0.0, 0.0, -span * BODY / 2.0),
            )
        for k, centre in enumerate(rotor_centres()):
            # The two in front are dark: which way it faces can be seen.
            scene.add_cylinder(
                f"{name}/rotor{k}",
                radius=ROTOR * span,
                height=0.02 * span,
                color=_PAYLOAD if centre[0] > 0.0 else colour,
                opacity=0.6,
                position=span * centre,
                cast_shadow=False,
            )
        return node

    def _lines(self, name: str, width_px: float) -> Any:
        return self._server.scene.add_line_segments(
            f"/{name}", _NOTHING, (0, 0, 0), thickness=width_px, thickness_units="screen"
        )


def _put(node: Any, pieces: Array, colours: Any) -> None:
    """Draw segments, (k, 2, 3), in one colour or one each, (k, 3); none as one without length."""
    if not len(pieces):
        pieces, colours = _NOTHING, _FLOWN
    each = np.broadcast_to(np.asarray(colours, dtype=np.uint8), (len(pieces), 3))
    node.points = pieces.astype(np.float32)
    node.colors = np.repeat(_linear(each)[:, None], 2, axis=1)


def _linear(colours: Any) -> npt.NDArray[np.uint8]:
    """Colours, (k, 3), as lines and arrows take them: linear, which those of bodies are not."""
    return np.round(255.0 * (np.asarray(colours) / 255.0) ** 2.2).astype(np.uint8)
