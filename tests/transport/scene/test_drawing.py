"""Drawing of a run before its first tick: sizes and places of what is drawn, and the box around it."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from tests.support import runs
from transport.model.arrays import Array
from transport.model.physics.parameters import resting_height
from transport.scene.drawn_paths_links_and_thrust import Drawing
from transport.scene.frames_and_poses import poses_at_start
from transport.scene.history import RunHistory
from transport.scene.lines_meshes_and_labels import Label, Mesh
from transport.scene.scene_at_tick import SceneBuilder

ROUNDING = 1e-9  # m
TWICE_HOVER_M = 1.2  # length of the arrow of a thrust of twice that at hover


@cache
def drawing_of(name: str) -> tuple[SceneBuilder, Drawing]:
    """Return scene builder and drawing of a ready scenario."""
    setup = runs.ready(name)
    builder = SceneBuilder(setup, RunHistory(setup))
    return builder, Drawing(builder)


def meshes(drawing: Drawing, frame: str) -> list[Array]:
    """Return the vertices of the meshes in a frame."""
    return [
        part.vertices for part in drawing.fixed if isinstance(part, Mesh) and part.frame == frame
    ]


@pytest.mark.parametrize("name", ["paper", "gap", "delivery"])
def test_drawn_uavs_touch_neither_each_other_nor_an_obstacle(name: str) -> None:
    """Their spans are below the smallest gap between UAVs, and below twice the margins of obstacles."""
    builder, drawing = drawing_of(name)
    reach_m = max(np.linalg.norm(mesh[:, :2], axis=1).max() for mesh in meshes(drawing, "uav1"))
    gaps_m = [pdist(builder.start_I).min()]
    gaps_m += [2.0 * obstacle.margin_m for obstacle in builder.setup.obstacles]
    assert 0.2 * min(gaps_m) < 2.0 * reach_m < min(gaps_m)


@pytest.mark.parametrize("name", ["paper", "delivery"])
def test_the_drawn_payload_stands_on_the_ground(name: str) -> None:
    """At rest its lowest corners are at the ground; without a ground it is a plate of 12 cm below the attachments."""
    builder, drawing = drawing_of(name)
    system = builder.setup.system
    (body,) = meshes(drawing, "payload")
    top_m = np.mean([uav.rho[2] for uav in system.uavs])
    assert body[:, 2].min() == pytest.approx(top_m)
    ground_m = builder.setup.scenario.plant.ground_m
    if ground_m is None:
        assert body[:, 2].max() == pytest.approx(top_m + 0.12)
    else:
        lowest_m = resting_height(system, ground_m) + body[:, 2].max()
        assert lowest_m == pytest.approx(ground_m)
        assert body[:, 2].max() != pytest.approx(top_m + 0.12)


def test_names_stand_outside_and_above() -> None:
    """0.3 m farther from the middle of the team than the UAV, and 0.1 m above it."""
    builder, drawing = drawing_of("paper")
    middle_I = builder.start_I.mean(axis=0)
    labels = [part for part in drawing.fixed if isinstance(part, Label)]
    assert [label.text for label in labels] == ["UAV1", "UAV2", "UAV3", "UAV4"]
    for label, uav_I in zip(labels, builder.start_I, strict=True):
        outside_m = np.linalg.norm(uav_I + label.position - middle_I, axis=0)
        assert label.position[2] == pytest.approx(-0.1)
        assert np.linalg.norm(label.position[:2]) == pytest.approx(0.3)
        assert outside_m > np.linalg.norm(uav_I - middle_I) + 0.2


@pytest.mark.parametrize("name", ["paper", "gap", "delivery"])
def test_the_box_holds_the_reference_and_the_arrows(name: str) -> None:
    """Up to arrows of twice the thrust at hover; the floor is the ground, or 0.5 m below."""
    builder, drawing = drawing_of(name)
    setup = builder.setup
    t = np.linspace(0.0, setup.maneuver.duration_s, 20)
    payload_I = setup.maneuver.path(t)[0]
    uavs_I = setup.reference.outputs(t)[:, : 3 * setup.system.N].reshape(-1, 3)
    for points_I in (payload_I, uavs_I - [0.0, 0.0, TWICE_HOVER_M]):
        assert (points_I > drawing.low - 1e-2).all()
        assert (points_I < drawing.high + 1e-2).all()
    assert drawing.low[2] == pytest.approx(uavs_I[:, 2].min() - TWICE_HOVER_M, abs=1e-2)
    ground_m = setup.scenario.plant.ground_m
    assert drawing.floor == (drawing.high[2] + 0.5 if ground_m is None else ground_m)


def test_endless_obstacles_end_beyond_the_box() -> None:
    """The walls of a gap of 0.96 m, 0.4 m thick: 1 m beyond the box sideways, from its top to the floor."""
    _, drawing = drawing_of("gap")
    left, right = sorted(meshes(drawing, "inertial"), key=lambda mesh: float(mesh[:, 1].mean()))
    low_y, high_y = drawing.low[1] - 1.0, drawing.high[1] + 1.0
    low_z, high_z = drawing.low[2], drawing.floor
    for wall, y in ((left, (low_y, -0.48)), (right, (0.48, high_y))):
        np.testing.assert_allclose(wall.min(axis=0), [5.8, y[0], low_z], atol=ROUNDING)
        np.testing.assert_allclose(wall.max(axis=0), [6.2, y[1], high_z], atol=ROUNDING)


def test_the_team_stands_at_its_start() -> None:
    """Each UAV is at the end of its rod, above its attachment, and in no frame of a released one."""
    builder, _ = drawing_of("paper")
    poses = poses_at_start(builder.setup)
    for i, uav in enumerate(builder.setup.system.uavs, start=1):
        attachment_I, R = poses[f"rod{i}"]
        payload_I, R_payload = poses["payload"]
        np.testing.assert_allclose(attachment_I, payload_I + R_payload @ uav.rho, atol=ROUNDING)
        end_I = attachment_I + R @ [0.0, 0.0, -uav.rod_length]
        np.testing.assert_allclose(end_I, poses[f"uav{i}"][0], atol=ROUNDING)
