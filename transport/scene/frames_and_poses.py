"""Frames of a drawing and their poses in a scene, relative to the inertial frame, z down; m.

Each UAV and each rod has a frame of its own: `uav1`, `rod1`, ...
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from transport.model.arrays import Array
from transport.model.physics.rotations import rotation
from transport.model.state import StateView
from transport.protocol.scenario.setup.run_setup import Setup
from transport.scene.lines_meshes_and_labels import Pose
from transport.scene.scene_at_tick import Scene

INERTIAL = "inertial"
PAYLOAD = "payload"
# These two move with the middle of the UAVs and with the payload, but do not turn.
TEAM = "team"
LOAD = "load"
GOAL = "goal"  # reference position of the payload
# ROS 2 draws z up: the inertial frame, z down, is this frame turned about x.
ROOT = "map"
UPSIDE_DOWN: Pose = (np.zeros(3), np.diag([1.0, -1.0, -1.0]))


def poses_in_scene(scene: Scene) -> dict[str, Pose]:
    """Return the pose of every frame in a scene.

    Parts in other frames, as those of released UAVs, are not to be seen in it.
    """
    payload = (scene.payload_I, scene.R_payload)
    uavs = list(zip(scene.uavs_I, scene.R_uavs, strict=True))
    poses = _team_poses(payload, uavs, scene.attachments_I)
    for uav in scene.released:
        del poses[f"uav{uav}"]
        del poses[f"rod{uav}"]
    poses[GOAL] = (scene.payload_reference_I, np.eye(3))
    return poses


def poses_at_start(setup: Setup) -> dict[str, Pose]:
    """Return the poses of the frames in the initial state, before a run has its first tick."""
    x = setup.initial_state()
    view = StateView(x)
    R_payload = rotation(view.Theta0)
    attachments_I = [view.r0_I + R_payload @ uav.rho for uav in setup.system.uavs]

    uavs_I = setup.model.outputs(x)[: 3 * setup.system.N].reshape(-1, 3)
    R_uavs = [rotation(Theta) for Theta in view.Theta]
    uavs = list(zip(uavs_I, R_uavs, strict=True))
    return _team_poses((view.r0_I, R_payload), uavs, np.array(attachments_I))


def frames_off_roster(scene: Scene, owned: Sequence[Sequence[int]]) -> frozenset[str]:
    """Return the frames of the UAVs, `owned` by each agent, whose agents are off the roster."""
    off = []
    for agent, uavs in enumerate(owned, start=1):
        if agent not in scene.members:
            off += [f"uav{uav + 1}" for uav in uavs]
    return frozenset(off)


def _team_poses(payload: Pose, uavs: Sequence[Pose], attachments_I: Array) -> dict[str, Pose]:
    """Return the poses of the frames of payload, UAVs and rods, and of those that move along."""
    level = np.eye(3)
    payload_I, _ = payload
    team_I = np.mean([position_I for position_I, _ in uavs], axis=0)
    poses: dict[str, Pose] = {
        INERTIAL: (np.zeros(3), level),
        PAYLOAD: payload,
        TEAM: (team_I, level),
        LOAD: (payload_I, level),
    }
    for i, (pose, attachment_I) in enumerate(zip(uavs, attachments_I, strict=True), start=1):
        poses[f"uav{i}"] = pose

        position_I, _ = pose
        rod_I = position_I - attachment_I
        turn, _ = Rotation.align_vectors(rod_I[None], [[0.0, 0.0, -1.0]])
        poses[f"rod{i}"] = (attachment_I, turn.as_matrix())
    return poses


def tree(poses: Mapping[str, Pose]) -> Iterator[tuple[str, str, Pose]]:
    """Yield parent, child and pose of each frame of a scene.

    The root, whose z points up, is the first.
    """
    yield ROOT, INERTIAL, UPSIDE_DOWN
    yield from ((INERTIAL, name, pose) for name, pose in poses.items() if name != INERTIAL)
