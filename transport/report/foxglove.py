"""Copy of a log for Foxglove: messages as JSON, and additional channels for transforms, 3D scene and numbers.

Additional messages follow Foxglove's schemas
(https://docs.foxglove.dev/docs/visualization/message-schemas/introduction).
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import orjson
from mcap.writer import CompressionType, Writer

from model.arrays import Array
from protocol.scenario.setup import Setup
from transport.log.channels import topic_of
from transport.log.run_log import RunLog
from transport.log.writer import LAST_TIME_NS, SEQUENCES
from transport.report.foxglove_schemas import NUMBERS, SCHEMAS
from transport.report.json_messages import JsonChannels, to_json
from transport.scene.geometry import (
    ARM,
    BODY,
    ROTOR,
    Colour,
    agent_positions,
    link_segments,
    payload_mesh,
    quaternion,
    rotor_centres,
    segments,
    uav_colour,
    uav_span,
)
from transport.scene.scene import Scene, SceneBuilder

# Foxglove draws z up; the inertial frame, z down, is its root turned about x.
ROOT, INERTIAL, PAYLOAD = "map", "inertial", "payload"
_UPSIDE_DOWN = {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}
_GREY, _DARK, _GROUND, _CONTACT = (140, 140, 140), (60, 60, 60), (225, 222, 214), (178, 24, 43)
# Thickness of lines, m, and length of a thrust arrow at hover, m.
_LINE_M, _ARROW_M = 0.02, 0.6
_LINE_LIST = 2
# Thickness of the drawn ground, its margin around the path, and radius of a mark where the payload touches it, m.
_GROUND_M, _MARGIN_M, _CONTACT_M = 0.02, 3.0, 0.03

# Additional channels and their schemas.
CHANNELS: Mapping[str, str] = {
    "/tf": "foxglove.FrameTransforms",
    "/scene/bodies": "foxglove.SceneUpdate",
    "/scene/reference": "foxglove.SceneUpdate",
    "/scene/now": "foxglove.SceneUpdate",
    "/numbers": NUMBERS,
}

# Metadata record with the header of the log; another name than in a log, which the copy is not.
METADATA = "exported run"

Json = dict[str, Any]


def write_foxglove(builder: SceneBuilder, log: RunLog, out: Path) -> int:
    """Write the copy of a log, complete or cut; return the number of ticks with a scene.

    Args:
        builder: Scenes of the run, its whole log read.
        log: The run's log.
        out: File to write or replace.
    Raises: OSError: it cannot be written.
    """
    period_ns = builder.setup.period_ns
    partial = out.with_name(out.name + ".partial")
    with partial.open("wb") as file:
        copy = Writer(file, compression=CompressionType.ZSTD)
        channels = JsonChannels(copy)
        copy.start(library="payload-transport")
        copy.add_metadata(METADATA, log.header)
        for entry in log.messages:
            message = entry.message
            copy.add_message(
                channels.of_message(topic_of(message), message.kind),
                min(message.tick * period_ns, LAST_TIME_NS),
                to_json(message),
                publish_time=entry.received_ns,
                sequence=message.sequence % SEQUENCES,
            )

        def put(topic: str, at_ns: int, content: Json) -> None:
            name = CHANNELS[topic]
            data = orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
            channel = channels.number(topic, name, lambda: SCHEMAS[name])
            copy.add_message(channel, at_ns, data, publish_time=at_ns)

        ticks = sorted(builder.history.plant_states)
        for tick in ticks:
            scene, at_ns = builder.at(tick), tick * period_ns
            if tick == ticks[0]:
                put("/scene/bodies", at_ns, _update(_bodies(builder, at_ns)))
                put("/scene/reference", at_ns, _update(_reference(builder, at_ns)))
            put("/tf", at_ns, {"transforms": list(_transforms(scene, at_ns))})
            put("/scene/now", at_ns, _update(_now(builder, scene, at_ns)))
            put("/numbers", at_ns, _numbers(scene))
        copy.finish()  # type: ignore[no-untyped-call]
    partial.replace(out)
    return len(ticks)


def _transforms(scene: Scene, at_ns: int) -> Iterator[Json]:
    time = _time(at_ns)
    yield _transform(time, ROOT, INERTIAL, np.zeros(3), _UPSIDE_DOWN)
    yield _transform(time, INERTIAL, PAYLOAD, scene.payload_I, _rotation(scene.R_payload))
    for i, (place, R) in enumerate(zip(scene.uavs_I, scene.R_uavs, strict=True)):
        yield _transform(time, INERTIAL, _frame(i), place, _rotation(R))


def _transform(time: Json, parent: str, child: str, translation: Array, rotation: Json) -> Json:
    return {
        "timestamp": time,
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": _vector(translation),
        "rotation": rotation,
    }


def _bodies(builder: SceneBuilder, at_ns: int) -> Iterator[Json]:
    """Yield payload and UAVs, each in its own frame, which the transforms move."""
    system = builder.setup.system
    ground_m = builder.setup.scenario.plant.ground_m
    vertices, faces = payload_mesh(system, grounded=ground_m is not None)
    mesh = {
        "pose": _pose(np.zeros(3)),
        "points": [_vector(point) for point in vertices],
        "color": _colour(_DARK),
        "colors": [],
        "indices": faces.reshape(-1).tolist(),
    }
    yield _entity("payload", PAYLOAD, at_ns, locked=True, triangles=[mesh])
    if ground_m is not None:
        yield _entity("ground", INERTIAL, at_ns, cubes=[_ground(builder.setup, ground_m)])
    span = uav_span(builder.start_I)
    for i in range(system.N):
        parts = [(2.0 * BODY, BODY, np.zeros(3), uav_colour(i))]
        parts += [(ROTOR, 0.02, c, _DARK if c[0] > 0.0 else uav_colour(i)) for c in rotor_centres()]
        cylinders = [
            {
                "pose": _pose(span * centre),
                "size": _vector(span * np.array([2.0 * radius, 2.0 * radius, height])),
                "bottom_scale": 1.0,
                "top_scale": 1.0,
                "color": _colour(colour),
            }
            for radius, height, centre, colour in parts
        ]
        beams = [_line([span * c, -span * c * [1, 1, -1]], _DARK, span * 0.04) for c in rotor_centres()[:2]]
        name = {
            "pose": _pose(np.array([0.0, 0.0, -span * (ARM + 0.2)])),
            "billboard": True,
            "font_size": 14.0,
            "scale_invariant": True,
            "color": _colour((0, 0, 0)),
            "text": f"UAV{i + 1}",
        }
        yield _entity(f"uav{i + 1}", _frame(i), at_ns, locked=True, cylinders=cylinders, lines=beams, texts=[name])


def _reference(builder: SceneBuilder, at_ns: int) -> Iterator[Json]:
    setup = builder.setup
    times_s = np.linspace(0.0, setup.ticks * setup.settings.sampling_period_s, 240)
    path = setup.maneuver.path(times_s)[0]
    yield _entity("reference", INERTIAL, at_ns, lines=[_line(segments(path)[::2].reshape(-1, 3), _GREY)])


def _now(builder: SceneBuilder, scene: Scene, at_ns: int) -> Iterator[Json]:
    """Yield the entities that change at every tick: rods, thrust, predicted paths, links."""
    setup = builder.setup
    rods = np.stack([scene.uavs_I, scene.attachments_I], axis=1)
    rods = np.delete(rods, [uav - 1 for uav in scene.released], axis=0).reshape(-1, 3)
    yield _entity("rods", INERTIAL, at_ns, lines=[_line(rods, _GREY)])
    thrusts = enumerate(zip(scene.uavs_I, scene.thrusts_I, strict=True))
    arrows = [_arrow(tail, thrust, builder.hover_N, uav_colour(i)) for i, (tail, thrust) in thrusts]
    yield _entity("thrust", INERTIAL, at_ns, arrows=arrows)
    if setup.scenario.plant.ground_m is not None:
        marks = [_sphere(corner, _CONTACT, 2.0 * _CONTACT_M) for corner in scene.contacts_I]
        yield _entity("contacts", INERTIAL, at_ns, spheres=marks)
    for prediction in scene.predictions:
        own = setup.owned[prediction.agent - 1]
        paths = [(prediction.payload_I, own[0]), *((prediction.uavs_I[:, k], uav) for k, uav in enumerate(own))]
        lines = [_line(segments(path).reshape(-1, 3), uav_colour(uav)) for path, uav in paths]
        yield _entity(f"predicted by agent {prediction.agent}", INERTIAL, at_ns, lines=lines)
    pieces, colours = link_segments(scene.links, agent_positions(scene, setup.owned), setup.settings.sampling_period_s)
    line = _line(pieces.reshape(-1, 3), _GREY)
    line["colors"] = [_colour(colour) for colour in np.repeat(colours, 2, axis=0).tolist()]
    yield _entity("links", INERTIAL, at_ns, lines=[line])


def _numbers(scene: Scene) -> Json:
    roll, pitch, yaw = scene.attitude_deg.tolist()
    return {
        "cost": scene.cost,
        "attitude_deg": {"roll": roll, "pitch": pitch, "yaw": yaw},
        "payload_error_m": scene.error_m,
        "phase": scene.phase,
        "step_ms": [None if a.report is None else float(a.report.times_ms[-1]) for a in scene.agents],
        "oldest_plan_s": max((link.age_s for link in scene.links if link.age_s is not None), default=None),
    }


def _update(entities: Iterator[Json]) -> Json:
    return {"deletions": [], "entities": list(entities)}


def _entity(name: str, frame: str, at_ns: int, *, locked: bool = False, **primitives: Sequence[Json]) -> Json:
    kinds = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
    return {
        "timestamp": _time(at_ns),
        "frame_id": frame,
        "id": name,
        "lifetime": _time(0),
        "frame_locked": locked,
        "metadata": [],
        **{kind: list(primitives.get(kind, [])) for kind in kinds},
    }


def _line(points: Any, colour: Colour, thickness_m: float = _LINE_M) -> Json:
    """Return line segments between pairs of points, (2 k, 3)."""
    return {
        "type": _LINE_LIST,
        "pose": _pose(np.zeros(3)),
        "thickness": thickness_m,
        "scale_invariant": False,
        "points": [_vector(point) for point in points],
        "color": _colour(colour),
        "colors": [],
        "indices": [],
    }


def _ground(setup: Setup, ground_m: float) -> Json:
    """Return a thin slab whose top is the ground, below the whole maneuver."""
    times_s = setup.settings.sampling_period_s * np.arange(setup.ticks, dtype=np.float64)
    way_I = setup.maneuver.path(times_s)[0]
    low, high = way_I.min(axis=0) - _MARGIN_M, way_I.max(axis=0) + _MARGIN_M
    middle = np.array([*(low + high)[:2] / 2.0, ground_m + _GROUND_M / 2.0])
    return {"pose": _pose(middle), "size": _vector([*(high - low)[:2], _GROUND_M]), "color": _colour(_GROUND)}


def _sphere(centre: Array, colour: Colour, diameter_m: float) -> Json:
    return {"pose": _pose(centre), "size": _vector([diameter_m] * 3), "color": _colour(colour)}


def _arrow(tail: Array, force: Array, hover: float, colour: Colour) -> Json:
    """Return an arrow along a force; its pose turns the x axis into the direction of the force."""
    size = float(np.linalg.norm(force))
    along = force / size if size > 0.0 else np.array([1.0, 0.0, 0.0])
    aside = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 else [0.0, 1.0, 0.0])
    aside /= np.linalg.norm(aside)
    length = _ARROW_M * size / hover
    return {
        "pose": {
            "position": _vector(tail),
            "orientation": _rotation(np.column_stack([along, aside, np.cross(along, aside)])),
        },
        "shaft_length": 0.8 * length,
        "shaft_diameter": 0.04,
        "head_length": 0.2 * length,
        "head_diameter": 0.09,
        "color": _colour(colour),
    }


def _frame(i: int) -> str:
    return f"uav{i + 1}"


def _pose(position: Array) -> Json:
    return {"position": _vector(position), "orientation": _rotation(np.eye(3))}


def _rotation(R: Array) -> Json:
    w, x, y, z = quaternion(R).tolist()
    return {"x": x, "y": y, "z": z, "w": w}


def _vector(value: Any) -> Json:
    x, y, z = (float(component) for component in value)
    return {"x": x, "y": y, "z": z}


def _colour(colour: Sequence[int]) -> Json:
    r, g, b = (channel / 255.0 for channel in colour)
    return {"r": r, "g": g, "b": b, "a": 1.0}


def _time(at_ns: int) -> Json:
    return {"sec": at_ns // 10**9, "nsec": at_ns % 10**9}
