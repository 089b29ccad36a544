"""3D view in the browser: the nodes of a viser scene that show a drawing, and the cameras.

All nodes lie in one frame, the world. A view that follows the team moves this frame instead of the
cameras: the team stays where the cameras look, whenever a page connects, however late its messages
about its camera are, and while a user turns it.
"""

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np

from transport.model.arrays import Array
from transport.scene.drawn_paths_links_and_thrust import ARROW_M, LAYERS, Drawing
from transport.scene.frames_and_poses import (
    INERTIAL,
    frames_off_roster,
    poses_at_start,
    poses_in_scene,
)
from transport.scene.lines_meshes_and_labels import (
    Label,
    LineSegments,
    Mesh,
    Part,
    Pose,
    quaternion,
)
from transport.scene.scene_at_tick import Scene, SceneBuilder
from transport.scene.uav_and_link_colours import OFF_COLOUR
from transport.viewer.camera import ASPECT, FIELD_OF_VIEW, Camera, camera_that_sees

# Directions from what is shown to the camera. Links and predicted paths lie in the plane of the
# UAVs, so both look from above; from +y, x is to the right as in the figures.
_TOWARDS_CAMERA = (0.5, 1.1, -0.6)
_TOWARDS_CAMERA_TEAM = (0.9, 1.9, -1.6)
_WORLD = "/world"
# The lowest and highest points of the world that a view of the whole path holds may be this many
# sizes of the maneuver away from it: a run that diverges would make everything else a dot.
_FAR = 1.0
_FLOWN_POINTS = 160


class View3D:
    """3D view of one run."""

    def __init__(
        self, server: Any, drawing: Drawing, builder: SceneBuilder, *, follows: bool
    ) -> None:
        self._server = server
        self._drawing = drawing
        self._builder = builder
        self.shown: Scene | None = None  # the newest one

        self._frames: dict[str, Any] = {}  # by name
        self._lines: dict[str, Any] = {}  # by name of the node
        self._layers: dict[str, list[Any]] = {name: [] for name in ("", *LAYERS)}
        self._parts: dict[str, list[tuple[Any, Mesh | Label]]] = {}  # by frame
        self._off: frozenset[str] = frozenset()  # frames of UAVs that are drawn as off

        self._follows = follows  # whether the team stays in its place of the view
        self._anchor_I = drawing.team_I  # this place, (3,)
        server.scene.set_up_direction("-z")
        self._world = server.scene.add_frame(_WORLD, show_axes=False)
        self._add_surroundings()
        for part in drawing.fixed:
            self._add(part)
        self._pose_frames(poses_at_start(builder.setup))
        self._set_first_camera()

    def show_layer(self, name: str, shown: bool) -> None:
        """Show or hide one of `LAYERS`."""
        for node in self._layers[name]:
            node.visible = shown

    def show(self, scene: Scene) -> None:
        """Move all nodes to a scene."""
        self.shown = scene
        self._move_world()

        self._pose_frames(poses_in_scene(scene))
        for lines in (*self._drawing.moving(scene), self._drawing.flown(scene)):
            name = f"{_WORLD}/{lines.frame}/{lines.name}"
            if name in self._lines:
                _set_lines(self._lines[name], lines)
            else:
                self._add(lines)
        self._mark_off(frames_off_roster(scene, self._builder.setup.owned))

    def _pose_frames(self, poses: Mapping[str, Pose]) -> None:
        """Move the frames, and hide those without a pose."""
        for name in {*self._frames, *poses}:
            frame = self._frame(name)
            pose = poses.get(name)
            frame.visible = pose is not None
            if pose is not None:
                frame.position = pose[0]
                frame.wxyz = quaternion(pose[1])

    def look_at(self, *, team: bool) -> None:
        """Turn the camera of every page to the team and keep the team there, or to the maneuver."""
        self._follows = team
        self._move_world()
        self._set_first_camera()
        for client in self._server.get_clients().values():
            self.place_camera(client)

    def place_camera(self, client: Any) -> None:
        """Put the camera of a page where the view begins, wherever the page says that it is."""
        width, height = client.camera.image_width, client.camera.image_height
        camera = self._camera(width / height if width and height else ASPECT)
        with client.atomic():
            client.camera.up_direction = (0.0, 0.0, -1.0)
            client.camera.position = camera.position_I  # moves look_at along
            client.camera.look_at = camera.look_at_I

    def _move_world(self) -> None:
        """Move the world so that the middle of all UAVs is in its place, if the team is to be followed."""
        position_I = np.zeros(3)
        if self._follows and self.shown is not None:
            position_I = self._anchor_I - self.shown.uavs_I.mean(axis=0)
        self._world.position = position_I

    def _set_first_camera(self) -> None:
        """Set the camera of pages that connect from now on, and that of "Reset View"."""
        camera = self._camera(ASPECT)
        first = self._server.initial_camera
        first.up = (0.0, 0.0, -1.0)
        first.fov = FIELD_OF_VIEW
        first.position = camera.position_I
        first.look_at = camera.look_at_I

    def _camera(self, aspect: float) -> Camera:
        """Return the camera of the present view for pages of an aspect ratio."""
        if self._follows:
            return camera_that_sees(self._team_points(), _TOWARDS_CAMERA_TEAM, aspect=aspect)
        return camera_that_sees(self._path_points(), _TOWARDS_CAMERA, aspect=aspect)

    def _team_points(self) -> Array:
        """Return the points of the team to be seen, (k, 3), m, with the team in its place."""
        uavs_I = self._builder.start_I
        payload_I = self._drawing.start_I
        middle_I = uavs_I.mean(axis=0)
        if self.shown is not None:
            released = [uav - 1 for uav in self.shown.released]
            uavs_I = np.delete(self.shown.uavs_I, released, axis=0)
            payload_I = self.shown.payload_I
            middle_I = self.shown.uavs_I.mean(axis=0)  # as the world is moved
        arrows_I = uavs_I - [0.0, 0.0, 2.0 * ARROW_M]
        points_I = np.vstack([payload_I, uavs_I, arrows_I])
        return np.asarray(points_I - middle_I + self._anchor_I)

    def _path_points(self) -> Array:
        """Return the corners around reference and actual paths of the whole team, (8, 3), m."""
        low_I, high_I = self._drawing.low, self._drawing.high
        last = self._builder.history.last
        if last >= 0:
            payload_I, uavs_I = self._builder.paths(last, _FLOWN_POINTS)
            flown_I = np.vstack([payload_I, uavs_I.reshape(-1, 3)])
            margin_m = _FAR * self._drawing.size
            flown_I = np.clip(np.nan_to_num(flown_I), low_I - margin_m, high_I + margin_m)
            low_I = np.minimum(low_I, flown_I.min(axis=0))
            high_I = np.maximum(high_I, flown_I.max(axis=0))
        corners = product(*zip(low_I, high_I, strict=True))
        return np.array(list(corners))

    def _frame(self, name: str) -> Any:
        """Return the node of a frame, hidden until it has a pose."""
        if name not in self._frames:
            self._frames[name] = self._server.scene.add_frame(
                f"{_WORLD}/{name}", show_axes=False, visible=name == INERTIAL
            )
        return self._frames[name]

    def _add(self, part: Part) -> None:
        """Add a part of the drawing to its frame."""
        self._frame(part.frame)
        scene = self._server.scene
        name = f"{_WORLD}/{part.frame}/{part.name}"
        match part:
            case LineSegments():
                # A colour per point from the start: viser draws lines white that get them after
                # their first drawing.
                none = np.zeros((1, 2, 3))
                node = scene.add_line_segments(
                    name,
                    none,
                    none.astype(np.uint8),
                    thickness=part.width,
                    thickness_units="screen",
                )
                self._lines[name] = node
                _set_lines(node, part)
            case Mesh():
                node = scene.add_mesh_simple(
                    name,
                    part.vertices,
                    part.faces,
                    color=part.colour,
                    opacity=None if part.opacity == 1.0 else part.opacity,
                    flat_shading=True,
                    side="double",
                )
                self._parts.setdefault(part.frame, []).append((node, part))
            case Label():
                node = scene.add_label(
                    name,
                    part.text,
                    position=part.position,
                    anchor="bottom-center",
                    font_screen_scale=0.9,
                )
                self._parts.setdefault(part.frame, []).append((node, part))
        self._layers[part.layer].append(node)

    def _mark_off(self, off: frozenset[str]) -> None:
        """Draw the UAVs in some frames as off: grey, and named so."""
        for frame in off ^ self._off:
            for node, part in self._parts.get(frame, []):
                if isinstance(part, Label):
                    node.text = f"{part.text} off" if frame in off else part.text
                else:
                    node.color = OFF_COLOUR if frame in off else part.colour
        self._off = off

    def _add_surroundings(self) -> None:
        """Add grid, axes and lights."""
        drawing = self._drawing
        scene = self._server.scene
        middle_I = (drawing.low + drawing.high) / 2.0
        width_m = 2.0 * np.ceil(0.7 * drawing.size)
        scene.add_grid(
            f"{_WORLD}/grid",
            position=(round(middle_I[0]), round(middle_I[1]), drawing.floor),
            width=width_m,
            height=width_m,
            infinite_grid=False,
            fade_distance=100.0,
            cell_color=(235, 235, 235),
            section_color=(210, 210, 210),
        )
        start_I = (*drawing.start_I[:2], drawing.floor)
        scene.add_frame(f"{_WORLD}/axes", axes_length=0.5, axes_radius=0.015, position=start_I)

        # No reflections or shadows: colours are those of the figures, and drawing without a
        # graphics processor is fast.
        scene.configure_environment_map(None)
        scene.add_light_ambient("/light", intensity=1.5)
        scene.configure_default_lights(enabled=True, cast_shadow=False)


def _set_lines(node: Any, lines: LineSegments) -> None:
    """Set points and colours of a node.

    viser needs at least one segment, and colours of lines that are linear, unlike those of meshes.
    """
    segments = lines.segments if len(lines.segments) else np.zeros((1, 2, 3))
    colours = lines.colours if len(lines.segments) else np.zeros((1, 3))
    linear = np.round(255.0 * (colours / 255.0) ** 2.2).astype(np.uint8)
    node.points = segments.astype(np.float32)
    node.colors = np.repeat(linear[:, None], 2, axis=1)
