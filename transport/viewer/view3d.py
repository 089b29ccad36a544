"""3D view: the nodes of a viser scene that show the scene of a run.

A page applies the poses of a frame at once, but the points of lines one drawing later. Rods are therefore rigid nodes
fixed to the payload, and lines lie below nodes that move with the team ("/team") or the payload ("/load").
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from model.arrays import Array
from model.shape import payload_corners
from transport.scene.geometry import (
    ARM,
    BEAM,
    BODY,
    ROTOR,
    Colour,
    agent_positions,
    link_segments,
    name_offsets,
    payload_mesh,
    quaternion,
    quaternion_from_up,
    rotor_centres,
    segments,
    simplified,
    uav_colour,
    uav_span,
)
from transport.scene.scene import Scene, SceneBuilder

if TYPE_CHECKING:
    import viser

# Layers that can be shown and hidden, and whether they are shown at first.
LAYERS: Mapping[str, bool] = {
    "predictions": True,
    "actual paths": True,
    "reference": True,
    "links": True,
    "thrust": True,
    "names": True,
}

_CONTACT = (178, 24, 43)
_PAYLOAD, _ROD, _REFERENCE, _FLOWN = (60, 60, 60), (90, 90, 90), (150, 150, 150), (0, 0, 0)
# Length of a thrust arrow at hover, m.
_ARROW_M = 0.6
# Camera offsets in parts of the size of the maneuver, and of the team; vertical field of view, rad. Links and predicted
# paths lie in the plane of the UAVs, so both look from well above; from +y, x is to the right as in the figures.
_VIEW, _VIEW_TEAM, _FOV = np.array([0.5, 1.1, -0.6]), np.array([0.9, 1.9, -2.2]), 0.75
# Points of a flown and of a reference path, and tolerance of the former in parts of the maneuver's size: wide lines are
# a third of the work of a browser without a graphics processor.
_POINTS, _POINTS_REFERENCE, _TOLERANCE = 240, 120, 5e-4
# Colour and thickness of the drawn ground, m, as far below the grid; radius of a mark where the payload touches it, m.
_GROUND, _GROUND_M, _CONTACT_M = (225, 222, 214), 0.02, 0.03
_NO_SEGMENTS = np.zeros((1, 2, 3))


class View3D:
    """3D view of one run."""

    def __init__(self, server: "viser.ViserServer", builder: SceneBuilder) -> None:
        self._server, self._builder = server, builder
        self._setup = setup = builder.setup
        self._N = setup.system.N
        self._shown = dict(LAYERS)
        scene = server.scene
        scene.set_up_direction("-z")
        self._add_surroundings()
        self._span_m = uav_span(builder.start_I)
        self._payload = self._add_body("/payload")
        vertices, faces = payload_mesh(setup.system, grounded=setup.scenario.plant.ground_m is not None)
        scene.add_mesh_simple("/payload/body", vertices, faces, color=_PAYLOAD, flat_shading=True, side="double")
        self._rods = [self._add_rod(i) for i in range(self._N)]
        self._uavs = [self._add_uav(i) for i in range(self._N)]
        self._names = [
            scene.add_label(
                f"/uav{i + 1}/name", f"UAV{i + 1}", anchor="bottom-center", font_screen_scale=0.9, position=offset
            )
            for i, offset in enumerate(name_offsets(builder.start_I))
        ]
        grounded = setup.scenario.plant.ground_m is not None
        self._contacts = [
            scene.add_icosphere(f"/contact{k}", radius=_CONTACT_M, color=_CONTACT, visible=False, cast_shadow=False)
            for k in range(len(payload_corners(setup.system)) if grounded else 0)
        ]
        self._goal = scene.add_icosphere("/goal", radius=0.07, color=_REFERENCE, cast_shadow=False)
        self._paths = self._add_lines("/paths", 2.0)
        self._team = self._add_body("/team")
        self._load = self._add_body("/load")
        self._uav_predictions = self._add_lines("/team/predictions", 4.0)
        self._payload_predictions = self._add_lines("/load/predictions", 4.0)
        self._links = self._add_lines("/team/links", 5.0)
        width = 0.03 * self._span_m
        self._thrust = scene.add_arrows(
            "/team/thrust",
            _NO_SEGMENTS,
            (0, 0, 0),
            shaft_radius=width,
            head_radius=2.5 * width,
            head_length=6.0 * width,
        )

    @property
    def payload_I(self) -> Array:
        """Position at which the payload is drawn, (3,), inertial frame, m."""
        return np.array(self._payload.position)

    def show_layer(self, name: str, shown: bool) -> None:
        """Show or hide one of `LAYERS`."""
        self._shown[name] = shown
        nodes: Mapping[str, list[Any]] = {
            "predictions": [self._uav_predictions, self._payload_predictions],
            "actual paths": [self._paths],
            "reference": [*self._references, self._goal],
            "links": [self._links],
            "thrust": [self._thrust],
            "names": list(self._names),
        }
        for node in nodes[name]:
            node.visible = shown

    def show(self, scene: Scene) -> None:
        """Move all nodes to a scene."""
        centre_I = scene.uavs_I.mean(axis=0)
        self._team.position, self._load.position = centre_I, scene.payload_I
        self._payload.position, self._payload.wxyz = scene.payload_I, quaternion(scene.R_payload)
        self._goal.position = scene.payload_reference_I
        for i, (uav, rod) in enumerate(zip(self._uavs, self._rods, strict=True)):
            uav.position, uav.wxyz = scene.uavs_I[i], quaternion(scene.R_uavs[i])
            rod.wxyz = quaternion_from_up(scene.R_payload.T @ (scene.uavs_I[i] - scene.attachments_I[i]))
        for k, mark in enumerate(self._contacts):
            mark.visible = k < len(scene.contacts_I)
            if mark.visible:
                mark.position = scene.contacts_I[k]
        for node in (self._team, self._load, self._payload, *self._uavs):
            node.visible = True
        for uav in scene.released:
            self._uavs[uav - 1].visible = False
        for i, rod in enumerate(self._rods):
            rod.visible = i + 1 not in scene.released
        if self._shown["thrust"]:
            tips_I = scene.uavs_I + scene.thrusts_I * (_ARROW_M / self._builder.hover_N)
            self._thrust.points = (np.stack([scene.uavs_I, tips_I], axis=1) - centre_I).astype(np.float32)
            self._thrust.colors = _linear([uav_colour(i) for i in range(self._N)])
        if self._shown["links"]:
            pieces, colours = link_segments(
                scene.links,
                agent_positions(scene, self._setup.owned) - centre_I,
                self._setup.settings.sampling_period_s,
            )
            _set_lines(self._links, pieces, colours)
        if self._shown["predictions"]:
            self._show_predictions(scene)
        if self._shown["actual paths"]:
            _set_paths(self._paths, self._flown_paths(scene))

    def look_at(self, scene: Scene | None) -> None:
        """Turn the camera of every browser to the team in a scene, or, for None, to the whole maneuver."""
        target, position = self._overview
        if scene is not None:
            size = max(float(np.linalg.norm(np.ptp(scene.uavs_I, axis=0))), 1.0)
            target = scene.uavs_I.mean(axis=0)
            position = target + _VIEW_TEAM * size
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position = position  # moves look_at along
                client.camera.look_at = target

    def _show_predictions(self, scene: Scene) -> None:
        centre_I, uav_paths, payload_paths = scene.uavs_I.mean(axis=0), [], []
        for prediction in scene.predictions:
            own = self._setup.owned[prediction.agent - 1]
            uav_paths += [(uav_colour(uav), prediction.uavs_I[:, k] - centre_I) for k, uav in enumerate(own)]
            payload_paths.append((uav_colour(own[0]), prediction.payload_I - scene.payload_I))
        _set_paths(self._uav_predictions, uav_paths)
        _set_paths(self._payload_predictions, payload_paths)

    def _flown_paths(self, scene: Scene) -> list[tuple[Colour, Array]]:
        """Colours and points, (k, 3), inertial frame, m."""
        payload_I, uavs_I = self._builder.paths(scene.tick, _POINTS)
        paths = [(_FLOWN, payload_I), *((uav_colour(i), uavs_I[:, i]) for i in range(self._N))]
        return [(colour, simplified(path, _TOLERANCE * self._size_m)) for colour, path in paths]

    def _add_surroundings(self) -> None:
        """Add grid, reference, lights and the first camera, around the whole maneuver."""
        setup, scene = self._setup, self._server.scene
        duration_s = setup.ticks * setup.settings.sampling_period_s
        times_s = np.linspace(0.0, duration_s, _POINTS_REFERENCE)
        payload_I = setup.maneuver.path(times_s)[0]
        uavs_I = setup.reference.outputs(times_s)[:, : 3 * self._N].reshape(len(times_s), self._N, 3)
        self._references = []
        for name, path in [("payload", payload_I), *((f"uav{i + 1}", uavs_I[:, i]) for i in range(self._N))]:
            node = self._add_lines(f"/reference/{name}", 1.5 if name == "payload" else 1.0)
            _set_lines(node, segments(path)[::2], _REFERENCE)
            self._references.append(node)
        above = uavs_I.reshape(-1, 3) - np.array([0.0, 0.0, 2.0 * _ARROW_M])  # thrust and names
        everything = np.vstack([payload_I, above])
        low, high = everything.min(axis=0), everything.max(axis=0)
        size, middle = float(np.linalg.norm(high - low)), (low + high) / 2.0
        self._size_m = size
        ground_m = setup.scenario.plant.ground_m
        floor = float(high[2]) + 0.5 if ground_m is None else ground_m
        width = 2.0 * np.ceil(0.7 * size)
        if ground_m is not None:
            below = (round(middle[0]), round(middle[1]), ground_m + _GROUND_M)
            scene.add_box("/ground", dimensions=(width, width, _GROUND_M), position=below, color=_GROUND)
        scene.add_grid(
            "/grid",
            width=width,
            height=width,
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
        # No reflections or shadows: colours are those of the figures, and drawing without a graphics processor is fast.
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light", intensity=1.5)
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        self._overview = middle, middle + _VIEW * size
        camera = self._server.initial_camera
        camera.position = self._overview[1]
        camera.look_at = self._overview[0]
        camera.up, camera.fov = (0.0, 0.0, -1.0), _FOV

    def _add_body(self, name: str) -> Any:
        """Add a moving node, hidden until the first frame."""
        return self._server.scene.add_frame(name, show_axes=False, visible=False)

    def _add_rod(self, i: int) -> Any:
        """Add a rod of fixed length that points up from its attachment to the payload."""
        uav = self._setup.system.uavs[i]
        rod = np.array([[(0.0, 0.0, 0.0), (0.0, 0.0, -uav.rod_length)]], dtype=np.float32)
        return self._server.scene.add_line_segments(
            f"/payload/rod{i + 1}", rod, _ROD, thickness=3.0, thickness_units="screen", position=uav.rho
        )

    def _add_uav(self, i: int) -> Any:
        """Add a quadrotor; its front rotors are dark."""
        scene, name, colour, span = self._server.scene, f"/uav{i + 1}", uav_colour(i), self._span_m
        node = self._add_body(name)
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

    def _add_lines(self, name: str, width_px: float) -> Any:
        # A colour per point from the start: viser draws lines white that get them after their first drawing.
        colours = np.zeros(_NO_SEGMENTS.shape, dtype=np.uint8)
        return self._server.scene.add_line_segments(
            name, _NO_SEGMENTS, colours, thickness=width_px, thickness_units="screen"
        )


def _set_paths(node: Any, paths: Sequence[tuple[Colour, Array]]) -> None:
    """Set the lines of a node to paths, (k, 3), each in its colour."""
    pieces = [segments(path) for _, path in paths]
    colours = [np.tile(colour, (len(piece), 1)) for (colour, _), piece in zip(paths, pieces, strict=True)]
    _set_lines(node, np.concatenate(pieces or [_NO_SEGMENTS]), np.concatenate(colours or [np.array([_FLOWN])]))


def _set_lines(node: Any, pieces: Array, colours: Any) -> None:
    """Set the lines of a node to segments, (k, 2, 3), in one colour or one each, (k, 3)."""
    if not len(pieces):  # viser takes at least one segment
        pieces, colours = _NO_SEGMENTS, _FLOWN
    each = np.broadcast_to(np.asarray(colours, dtype=np.uint8), (len(pieces), 3))
    node.points = pieces.astype(np.float32)
    node.colors = np.repeat(_linear(each)[:, None], 2, axis=1)


def _linear(colours: Any) -> npt.NDArray[np.uint8]:
    """Convert sRGB colours, (..., 3), to linear ones, which lines and arrows take, unlike meshes."""
    return np.round(255.0 * (np.asarray(colours) / 255.0) ** 2.2).astype(np.uint8)
