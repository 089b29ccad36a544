"""3D view in the browser: the nodes of a viser scene that show a drawing."""

from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.scene.bodies import INERTIAL
from transport.scene.drawing import LAYERS, Drawing
from transport.scene.parts import Label, Lines, Mesh, Part, quaternion
from transport.scene.scene import Scene

# Camera offsets in parts of the size of the maneuver, and of the team; vertical field of view, rad.
# Links and predicted paths lie in the plane of the UAVs, so both look from well above; from +y, x
# is to the right as in the figures.
_VIEW, _VIEW_TEAM, _FOV = np.array([0.5, 1.1, -0.6]), np.array([0.9, 1.9, -2.2]), 0.75
# A camera that has been turned by this part of its distance since the last frame is being turned.
_TURNED = 1e-3


class View3D:
    """3D view of one run."""

    def __init__(self, server: Any, drawing: Drawing, *, follows: bool) -> None:
        self._server, self._drawing = server, drawing
        self.shown: Scene | None = None  # in the current frame
        self._frames: dict[str, Any] = {}
        self._nodes: dict[str, Any] = {}
        self._layers: dict[str, list[Any]] = {name: [] for name in ("", *LAYERS)}
        server.scene.set_up_direction("-z")
        self._add_surroundings()
        for part in drawing.fixed:
            self._add(part)
        # Whether cameras move with the team, where it was in the frame before, and from where each
        # camera saw it.
        self._follows, self._team_I, self._offset = follows, drawing.team_I, dict[int, Array]()

    def show_layer(self, name: str, shown: bool) -> None:
        """Show or hide one of `LAYERS`."""
        for node in self._layers[name]:
            node.visible = shown

    def show(self, scene: Scene) -> None:
        """Move all nodes to a scene, and the cameras that follow the team."""
        self.shown = scene
        poses = self._drawing.poses(scene)
        for name in {*self._frames, *poses}:
            frame, pose = self._frame(name), poses.get(name)
            frame.visible = pose is not None
            if pose is not None:
                frame.position, frame.wxyz = pose[0], quaternion(pose[1])
        for lines in (*self._drawing.moving(scene), self._drawing.flown(scene)):
            if lines.name not in self._nodes:
                self._add(lines)
            else:
                _set_lines(self._nodes[lines.name], lines)
        moved, self._team_I = scene.uavs_I.mean(axis=0) - self._team_I, scene.uavs_I.mean(axis=0)
        if self._follows:
            self._server.initial_camera.look_at = self._server.initial_camera.look_at + moved
            self._server.initial_camera.position = self._server.initial_camera.position + moved
            for number, client in self._server.get_clients().items():
                offset = client.camera.position - client.camera.look_at
                turned = np.linalg.norm(offset - self._offset.get(number, offset))
                self._offset[number] = offset
                if turned <= _TURNED * np.linalg.norm(offset):  # not while a user turns it
                    _turn(client, client.camera.look_at + moved, client.camera.position + moved)

    def look_at(self, *, team: bool) -> None:
        """Turn the camera of every browser to the team and follow it, or else to the maneuver."""
        view, self._follows = self._overview, team
        if team and self.shown is not None:
            size = max(float(np.linalg.norm(np.ptp(self.shown.uavs_I, axis=0))), 1.0)
            view = self._team_I, self._team_I + _VIEW_TEAM * size
        for number, client in self._server.get_clients().items():
            _turn(client, *view)
            self._offset[number] = view[1] - view[0]

    def _frame(self, name: str) -> Any:
        """Return the node of a frame, hidden until it has a pose."""
        if name not in self._frames:
            self._frames[name] = self._server.scene.add_frame(
                f"/{name}", show_axes=False, visible=name == INERTIAL
            )
        return self._frames[name]

    def _add(self, part: Part) -> None:
        self._frame(part.frame)
        scene, name = self._server.scene, f"/{part.frame}/{part.name}"
        match part:
            case Lines():
                # A colour per point from the start: viser draws lines white that get them after
                # their first drawing.
                none = np.zeros((1, 2, 3))
                width: Any = {"thickness": part.width, "thickness_units": "screen"}
                node = self._nodes[part.name] = scene.add_line_segments(
                    name, none, none.astype(np.uint8), **width
                )
                _set_lines(node, part)
            case Mesh():
                look: Any = {
                    "color": part.colour,
                    "opacity": None if part.opacity == 1.0 else part.opacity,
                }
                look |= {"flat_shading": True, "side": "double"}
                node = scene.add_mesh_simple(name, part.vertices, part.faces, **look)
            case Label():
                look = {"anchor": "bottom-center", "font_screen_scale": 0.9}
                node = scene.add_label(name, part.text, position=part.position, **look)
        self._layers[part.layer].append(node)

    def _add_surroundings(self) -> None:
        """Add grid, axes, lights and the first camera, around the whole maneuver."""
        drawing, scene = self._drawing, self._server.scene
        middle = (drawing.low + drawing.high) / 2.0
        width = 2.0 * np.ceil(0.7 * drawing.size)
        place, size = (
            (round(middle[0]), round(middle[1]), drawing.floor),
            {"width": width, "height": width},
        )
        greys = {"cell_color": (235, 235, 235), "section_color": (210, 210, 210)}
        scene.add_grid(
            "/grid", position=place, infinite_grid=False, fade_distance=100.0, **size, **greys
        )
        start = (*drawing.start_I[:2], drawing.floor)
        scene.add_frame("/axes", axes_length=0.5, axes_radius=0.015, position=start)
        # No reflections or shadows: colours are those of the figures, and drawing without a
        # graphics processor is fast.
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
    """Set points and colours, of which viser takes those of one segment at least, and linear ones, unlike meshes."""
    some = len(lines.segments) > 0
    colours = np.round(
        255.0 * ((lines.colours if some else np.zeros((1, 3))) / 255.0) ** 2.2
    ).astype(np.uint8)
    node.points = (lines.segments if some else np.zeros((1, 2, 3))).astype(np.float32)
    node.colors = np.repeat(colours[:, None], 2, axis=1)
