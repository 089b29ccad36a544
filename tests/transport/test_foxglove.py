"""The copy of a log for Foxglove holds the whole log, and its additional messages are valid by their schemas."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import orjson
import pytest
from hypothesis import given
from jsonschema import Draft202012Validator
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from tests.support import runs
from tests.support.logs import record_run
from tests.support.messages import messages as any_message
from transport.cli.main import app
from transport.log.run_log import open_run, read_log, topic_of
from transport.protocol.wire.codec import encode
from transport.protocol.wire.messages import Message, PlantState
from transport.report.foxglove import NUMBERS, json_schema, to_json
from transport.report.mcap_copy import METADATA
from transport.scene.drawing import Drawing
from transport.scene.scene import SceneBuilder

EXACT = 1e-12
# Additional channels and their schemas (docs/viewer.md).
CHANNELS = {
    "/tf": "foxglove.FrameTransforms",
    **{f"/scene/{name}": "foxglove.SceneUpdate" for name in ("bodies", "paths", "now")},
    "/numbers": NUMBERS,
}
TICKS = 6


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run folder with the copy beside its log."""
    folder = tmp_path_factory.mktemp("foxglove")
    record_run(runs.setup(runs.ticks(TICKS)), folder)
    result = CliRunner().invoke(
        app, ["log", "export", str(folder), "--foxglove", str(folder / "foxglove.mcap")]
    )
    assert result.exit_code == 0, result.stderr
    assert f"{TICKS} ticks" in result.stdout
    return folder


def added(folder: Path) -> Iterator[tuple[str, int, Any]]:
    """Yield the additional messages, decoded with the schemas in the file.

    Topic, time in ns, message.
    """
    with (folder / "foxglove.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.topic not in CHANNELS:
                continue
            assert schema.name == CHANNELS[channel.topic]
            decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
            content = json.loads(message.data) if decode is None else decode(message.data)
            if decode is None:
                jsonschema.validate(content, json.loads(schema.data))
            yield channel.topic, message.log_time, content


def test_the_copy_holds_the_log(copied: Path) -> None:
    """Every message of the log is in the copy as JSON, in order, with its times.

    And so is the header.
    """
    log = read_log(copied / "run.mcap")
    with (copied / "foxglove.mcap").open("rb") as file:
        copy = make_reader(file)
        found = [
            (channel.topic, entry.log_time, entry.publish_time, entry.data)
            for _, channel, entry in copy.iter_messages(log_time_order=False)
            if channel.topic not in CHANNELS
        ]
        assert {record.name: record.metadata for record in copy.iter_metadata()} == {
            METADATA: log.header
        }
    assert found == [
        (
            topic_of(entry.message),
            entry.message.tick * 50_000_000,
            entry.received_ns,
            to_json(entry.message),
        )
        for entry in log.messages
    ]


def test_the_copy_is_no_log(copied: Path) -> None:
    """The commands for logs refuse the copy in one line."""
    result = CliRunner().invoke(app, ["log", "info", str(copied / "foxglove.mcap")])
    assert result.exit_code == 2
    assert "an MCAP file, but not the log of a run" in result.stderr


def test_transforms_lead_to_the_plant_state(copied: Path) -> None:
    """From the root, z up, through the inertial frame, z down, the payload is at its position in the plant state."""
    plant_states = {
        plant_state.tick: plant_state
        for plant_state in read_log(copied / "run.mcap").of(PlantState)
    }
    frames = [
        (at_ns, message.transforms) for topic, at_ns, message in added(copied) if topic == "/tf"
    ]
    assert len(frames) == TICKS
    for at_ns, transforms in frames:
        root, payload, *others = transforms
        assert {f"{name}{i}" for name in ("uav", "rod") for i in (1, 2, 3, 4)} < {
            t.child_frame_id for t in others
        }
        assert (root.child_frame_id, payload.parent_frame_id) == ("inertial", "inertial")
        turn = Rotation.from_quat([getattr(root.rotation, axis) for axis in "xyzw"])
        place = turn.apply([getattr(payload.translation, axis) for axis in "xyz"])
        x, y, z = plant_states[at_ns // 50_000_000].x[:3]
        np.testing.assert_allclose(place, [x, -y, -z], atol=EXACT)


def test_every_part_of_the_drawing_is_sent(copied: Path) -> None:
    """Bodies are sent once, in their own frames.

    Lines that change at every tick, with their points and colours.
    """
    run = open_run(copied)
    builder = SceneBuilder.of(run.setup, run.log)
    drawing, sent = Drawing(builder), list(added(copied))
    (bodies,) = [message.entities for topic, _, message in sent if topic == "/scene/bodies"]
    assert [(entity.frame_id, entity.id) for entity in bodies] == [
        (p.frame, f"{p.frame}/{p.name}") for p in drawing.fixed
    ]
    now = [message.entities for topic, _, message in sent if topic == "/scene/now"]
    assert len(now) == TICKS
    for tick, entities in enumerate(now):
        for entity, part in zip(entities, drawing.moving(builder.at(tick)), strict=True):
            (line,) = entity.lines
            assert (entity.frame_id, entity.id) == (part.frame, f"{part.frame}/{part.name}")
            points = np.array([[point.x, point.y, point.z] for point in line.points]).reshape(
                -1, 2, 3
            )
            np.testing.assert_array_equal(points, part.segments)
            assert len(line.colors) == len(line.points)
    assert [message["phase"] for topic, _, message in sent if topic == "/numbers"] == [
        "hover"
    ] * TICKS


def test_one_output_at_least(copied: Path, tmp_path: Path) -> None:
    """Tables and a copy can be requested in one call.

    Neither is refused, and so is an existing file.
    """
    result = CliRunner().invoke(app, ["log", "export", str(copied)])
    assert result.exit_code == 2
    assert "expected --out, --foxglove, --ros2 or several of them, got none" in result.stderr
    result = CliRunner().invoke(
        app, ["log", "export", str(copied), "--foxglove", str(copied / "run.mcap")]
    )
    assert result.exit_code == 2
    assert result.stderr.startswith(
        "transport: --foxglove: expected a file that does not exist yet, got "
    )
    both = ["--out", str(tmp_path / "tables"), "--foxglove", str(tmp_path / "f.mcap")]
    result = CliRunner().invoke(app, ["log", "export", str(copied), *both])
    assert result.exit_code == 0, result.stderr
    assert (tmp_path / "tables" / "plant_state.csv").exists()
    assert (tmp_path / "f.mcap").read_bytes() == (copied / "foxglove.mcap").read_bytes()


@given(any_message)
def test_json_keeps_every_bit(message: Message) -> None:
    """A message rebuilt from its JSON has the same bits.

    The JSON is valid by its schema, without nested lists.
    """
    content, schema = orjson.loads(to_json(message)), json_schema(message.kind)
    Draft202012Validator.check_schema(schema)
    Draft202012Validator(schema).validate(content)
    assert all(
        field.get("items", {}).get("type") != "array" for field in schema["properties"].values()
    )
    values = {}
    for field in message.__struct_fields__:
        value = content[field]
        if isinstance(getattr(message, field), np.ndarray):
            value = np.array(value, dtype=np.float64).reshape(content.get(f"{field}_shape", -1))
        if field == "targets":
            value = tuple(map(bytes.fromhex, value))
        values[field] = value
    assert encode(type(message)(**values)) == encode(message)
