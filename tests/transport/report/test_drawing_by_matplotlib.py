"""Drawings by matplotlib of parts in their frames: altitude up, and the highest on top from above."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.report.drawing_by_matplotlib import UP, draw_parts, frame, line
from transport.scene.lines_meshes_and_labels import (
    Label,
    LineSegments,
    Mesh,
    Part,
    Pose,
    ball,
    lines,
    solid,
)

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
# Coordinates of up to 3 m in double precision.
ROUNDING_M = 1e-12
STILL: Pose = (np.zeros(3), np.eye(3))


@dataclass(frozen=True, slots=True)
class Drawn:
    """What is drawn from above: faces, (k, 3, 2), and their colours, (k, 4), in drawing order."""

    faces: Array
    colours: Array


def from_above(parts: list[Part], poses: dict[str, Pose]) -> Drawn:
    """Draw parts from above."""
    axes = Figure().add_subplot()
    draw_parts(axes, parts, poses, above=True, width=1.0)
    (faces,) = (found for found in axes.collections if isinstance(found, PolyCollection))
    corners = np.array([np.asarray(path.vertices)[:3] for path in faces.get_paths()])
    return Drawn(corners, np.asarray(faces.get_facecolor()))


def cube(name: str, down_m: float, colour: tuple[int, int, int]) -> Mesh:
    """A small ball at a depth below the origin, in its own frame."""
    return solid(name, name, ball(0.1) + np.array([0.0, 0.0, down_m]), colour)


@pytest.mark.parametrize("order", [1, -1])
def test_from_above_the_highest_faces_are_drawn_last(order: int) -> None:
    """z points down: the body of least z lies on top, in whatever order the parts come."""
    parts: list[Part] = [
        cube("low", 2.0, RED),
        cube("middle", 0.0, GREEN),
        cube("high", -2.0, BLUE),
    ]
    drawn = from_above(parts[::order], dict.fromkeys(("low", "middle", "high"), STILL))
    each = len(drawn.colours) // 3
    for k, colour in enumerate((RED, GREEN, BLUE)):
        own = drawn.colours[k * each : (k + 1) * each, :3]
        np.testing.assert_array_equal(own, np.tile(np.array(colour) / 255.0, (each, 1)))
    assert (drawn.colours[:, 3] < 1.0).all(), "nothing is hidden from above"


def test_parts_are_drawn_in_the_poses_of_their_frames() -> None:
    """A point p of a frame at r with rotation R is drawn at r + R p, altitude up; frames without pose are not."""
    R = rotation([0.1, -0.4, 0.8])
    r_I = np.array([1.0, -2.0, -3.0])
    ends = np.array([[[0.3, 0.0, 0.0], [0.0, 0.2, 0.1]]])
    body = cube("body", 0.0, RED)
    rod_lines = lines("rod", "body", "", 3.0, [(GREEN, ends)])
    parts: list[Part] = [rod_lines, body, cube("absent", 0.0, BLUE)]
    drawn = from_above(parts, {"body": (r_I, R)})
    vertices = (body.vertices @ R.T + r_I)[:, :2]
    nearest = np.linalg.norm(drawn.faces[:, :, None] - vertices, axis=-1).min(axis=-1)
    assert len(drawn.faces) == len(body.faces)
    assert nearest.max() < ROUNDING_M

    axes: Any = Figure().add_subplot()
    draw_parts(axes, parts, {"body": (r_I, R)}, above=True, width=2.0)
    (rod,) = (found for found in axes.collections if isinstance(found, LineCollection))
    (segment,) = rod.get_segments()
    np.testing.assert_allclose(segment, [(r_I + R @ end)[:2] for end in ends[0]], atol=ROUNDING_M)
    assert np.asarray(rod.get_linewidth()) == [2.0 * 3.0]
    np.testing.assert_array_equal(np.asarray(rod.get_edgecolor())[0, :3], [0.0, 1.0, 0.0])


def test_a_label_stands_beside_its_frame_and_does_not_turn_with_it() -> None:
    """The place of a name is in inertial directions; in space no names are drawn."""
    label = Label("name", "body", "names", "UAV7", np.array([0.5, 0.0, 0.0]), RED)
    turned = (np.array([1.0, 2.0, 3.0]), rotation([0.0, 0.0, np.pi / 2.0]))
    figure = Figure()
    above: Any = figure.add_subplot(1, 2, 1)
    space: Any = figure.add_subplot(1, 2, 2, projection="3d")
    no_lines = LineSegments("none", "body", "", 1.0, np.zeros((0, 2, 3)), np.zeros((0, 3)))
    artists = []
    for axes in (above, space):
        parts: list[Part] = [label, no_lines, cube("body", 0.0, RED)]
        artists.append(draw_parts(axes, parts, {"body": turned}, above=axes is above, width=1.0))
    (text,) = above.texts
    assert text in artists[0]  # so that it can be removed
    assert text.zorder > max(found.zorder for found in above.collections)
    assert text.get_text() == "UAV7"
    assert text.get_position() == (1.5, 2.0)
    assert not space.texts


def test_in_space_altitude_points_up_and_all_axes_have_one_scale() -> None:
    """The box holds all points, and a metre is as long along each axis."""
    points = np.array([[0.0, 0.0, 0.0], [4.0, 2.0, -3.0]]) * UP
    axes: Any = Figure().add_subplot(projection="3d")
    frame(axes, points)
    low, high = axes.get_zlim()
    assert low < 0.0 < 3.0 < high
    axes.set_proj_type("ortho")
    metres = np.linalg.norm(axes.get_proj()[:3, :3], axis=0)
    assert metres == pytest.approx(np.full(3, metres[0]), rel=1e-9)
    # A drawing with x to the right and altitude up is a mirror image unless y points to the reader.
    assert axes.get_xlim()[0] < axes.get_xlim()[1]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]


def test_the_box_has_a_margin_and_no_thin_side() -> None:
    """A twentieth of the longest side and 0.1 m at each end; a side is 0.3 of the longest at least."""
    axes: Any = Figure().add_subplot(projection="3d")
    frame(axes, np.array([[0.0, 0.0, 1.0], [4.0, 2.0, 1.0]]))
    assert axes.get_xlim() == pytest.approx((-0.3, 4.3))
    assert axes.get_ylim() == pytest.approx((2.3, -0.3))
    assert axes.get_zlim() == pytest.approx((1.0 - 0.69, 1.0 + 0.69))  # 0.3 of 4.6 m
    assert len(axes.get_zticks()) < len(axes.get_yticks()) < len(axes.get_xticks())


def test_in_space_bodies_are_as_opaque_as_they_say_and_paths_have_their_altitude() -> None:
    """A path of z = -2 m, which points down, is 2 m high."""
    axes: Any = Figure().add_subplot(projection="3d")
    glass = cube("body", 0.0, RED)._replace(opacity=0.5)
    _, faces = draw_parts(axes, [glass], {"body": STILL}, above=False, width=1.0)
    assert set(faces.get_facecolor()[:, 3].tolist()) == {0.5}
    line(axes, np.array([[0.0, 1.0, -2.0], [3.0, 4.0, -5.0]]))
    x, y, z = axes.lines[0].get_data_3d()
    assert (list(x), list(y), list(z)) == ([0.0, 3.0], [1.0, 4.0], [2.0, 5.0])
