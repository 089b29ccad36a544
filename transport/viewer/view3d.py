"""3D view in the browser: the nodes of a viser scene that show a drawing."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from model.arrays import Array
from transport.scene.drawing import INERTIAL, LAYERS, PAYLOAD, Drawing, Label, Lines, Mesh, Part, quaternion
from transport.scene.scene import Scene

if TYPE_CHECKING:
    import viser

# Camera offsets in parts of the size of the maneuver, and of the team; vertical field of view, rad. Links and predicted
# paths lie in the plane of the UAVs, so both look from well above; from +y, x is to the right as in the figures.
_VIEW, _VIEW_TEAM, _FOV = np.array([0.5, 1.1, -0.6]), np.array([0.9, 1.9, -2.2]), 0.75
# The camera follows a team that has moved by this, m, and stays while a user turns it by this part of its distance.
_MOVED_M, _TURNED = 0.01, 1e-3


class View3D:
    """3D view of one run."""

    def __init__(self, server: "viser.ViserServer", drawing: Drawing) -> None:
        self._server, self._drawing = server, drawing
        self._shown = dict(LAYERS)
        self._frames: dict[str, Any] = {}
        self._nodes: dict[str, Any] = {}
        self._layers: dict[str, list[Any]] = {name: [] for name in ("", *LAYERS)}
        server.scene.set_up_direction("-z")
        self._add_surroundings()
        for part in drawing.fixed:
            self._add(part)
        # Where the team was when the camera of each browser was moved last, and that camera relative to what it sees.
        self._follows, self._seen_I, self._offset = False, dict[int, Array](), dict[int, Array]()
        self._start_I = drawing.team_I

    @property
    def payload_I(self) -> Array:
        """Position at which the payload is drawn, (3,), inertial frame, m."""
        return np.array(self._frames[PAYLOAD].position)

    def show_layer(self, name: str, shown: bool) -> None:
        """Show or hide one of `LAYERS`."""
        self._shown[name] = shown
        for node in self._layers[name]:
            node.visible = shown

    def show(self, scene: Scene) -> None:
        """Move all nodes to a scene, and the cameras that follow the team."""
        poses = self._drawing.poses(scene)
        for name in {*self._frames, *poses}:
            frame, pose = self._frame(name), poses.get(name)
            frame.visible = pose is not None
            if pose is not None:
                frame.position, frame.wxyz = pose[0], quaternion(pose[1])
        for lines in self._drawing.moving(scene):
            self._set(lines)
        for node in (self._grid, self._axes):
            if node.position[2] != self._drawing.floor:  # a target is below everything before
                node.position = (*node.position[:2], self._drawing.floor)
        if self._follows:
            self._follow(scene)

    def look_at(self, scene: Scene | None) -> None:
        """Turn the camera of every browser to the team in a scene, or, for None, to the maneuver."""
        view = self._overview
        if scene is not None:
            centre_I = scene.uavs_I.mean(axis=0)
            size = max(float(np.linalg.norm(np.ptp(scene.uavs_I, axis=0))), 1.0)
            view = centre_I, centre_I + _VIEW_TEAM * size
        for number, client in self._server.get_clients().items():
            _turn(client, *view)
            self._seen_I[number], self._offset[number] = view[0], view[1] - view[0]

    def follow(self, wanted: bool, scene: Scene | None = None) -> None:
        """Move the cameras with the team from a scene on, from its start if none is shown yet, or leave them."""
        self._follows = wanted
        if scene is not None:
            self._seen_I = dict.fromkeys(self._server.get_clients(), scene.uavs_I.mean(axis=0))

    def _follow(self, scene: Scene) -> None:
        """Move the cameras with the team, from where the users have turned them, and not while they turn them."""
        centre_I = scene.uavs_I.mean(axis=0)
        for number, client in self._server.get_clients().items():
            seen_I, camera = self._seen_I.get(number, self._start_I), client.camera
            offset = camera.position - camera.look_at
            turned = np.linalg.norm(offset - self._offset.get(number, offset)) > _TURNED * np.linalg.norm(offset)
            self._offset[number] = offset
            if not turned and np.linalg.norm(centre_I - seen_I) < _MOVED_M:
                continue
            if not turned:
                moved = centre_I - seen_I
                _turn(client, camera.look_at + moved, camera.position + moved)
            self._seen_I[number] = centre_I

    def _frame(self, name: str) -> Any:
        """Return the node of a frame, hidden until it has a pose."""
        if name not in self._frames:
            self._frames[name] = self._server.scene.add_frame(f"/{name}", show_axes=False, visible=name == INERTIAL)
        return self._frames[name]

    def _add(self, part: Part) -> None:
        self._frame(part.frame)
        scene, name = self._server.scene, f"/{part.frame}/{part.name}"
        node: Any
        match part:
            case Lines():
                # A colour per point from the start: viser draws lines white that get them after their first drawing.
                node = self._nodes[part.name] = scene.add_line_segments(
                    name,
                    np.zeros((1, 2, 3)),
                    np.zeros((1, 2, 3), dtype=np.uint8),
                    thickness=part.width,
                    thickness_units="screen",
                )
                _set_lines(node, part)
            case Mesh():
                opacity = None if part.opacity == 1.0 else part.opacity
                node = scene.add_mesh_simple(
                    name,
                    part.vertices,
                    part.faces,
                    color=part.colour,
                    opacity=opacity,
                    flat_shading=True,
                    side="double",
                )
            case Label():
                node = scene.add_label(
                    name, part.text, anchor="bottom-center", font_screen_scale=0.9, position=part.position
                )
        self._layers[part.layer].append(node)

    def _set(self, lines: Lines) -> None:
        """Set the segments of lines, unless their layer is hidden."""
        if lines.name not in self._nodes:
            self._add(lines)
        elif self._shown[lines.layer]:
            _set_lines(self._nodes[lines.name], lines)

    def _add_surroundings(self) -> None:
        """Add grid, axes, lights and the first camera, around the whole maneuver."""
        drawing, scene = self._drawing, self._server.scene
        middle = (drawing.low + drawing.high) / 2.0
        width = 2.0 * np.ceil(0.7 * drawing.size)
        self._grid = scene.add_grid(
            "/grid",
            width=width,
            height=width,
            position=(round(middle[0]), round(middle[1]), drawing.floor),
            cell_size=0.5,
            section_size=1.0,
            cell_color=(235, 235, 235),
            section_color=(210, 210, 210),
            infinite_grid=False,
            fade_distance=100.0,
        )
        self._axes = scene.add_frame(
            "/axes", axes_length=0.5, axes_radius=0.015, position=(*drawing.start_I[:2], drawing.floor)
        )
        # No reflections or shadows: colours are those of the figures, and drawing without a graphics processor is fast.
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light", intensity=1.5)
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        self._overview = middle, middle + _VIEW * drawing.size
        camera = self._server.initial_camera
        camera.look_at, camera.position = self._overview
        camera.up, camera.fov = (0.0, 0.0, -1.0), _FOV


def _turn(client: Any, look_at: Array, position: Array) -> None:
    with client.atomic():
        client.camera.position = position  # moves look_at along
        client.camera.look_at = look_at


def _set_lines(node: Any, lines: Lines) -> None:
    some = len(lines.segments) > 0  # viser takes at least one segment
    node.points = (lines.segments if some else np.zeros((1, 2, 3))).astype(np.float32)
    node.colors = np.repeat(_linear(lines.colours if some else np.zeros((1, 3)))[:, None], 2, axis=1)


def _linear(colours: Array) -> npt.NDArray[np.uint8]:
    """Convert sRGB colours, (..., 3), to linear ones, which lines take, unlike meshes."""
    return np.round(255.0 * (colours / 255.0) ** 2.2).astype(np.uint8)
