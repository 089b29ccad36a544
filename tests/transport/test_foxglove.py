"""The copy of a log for Foxglove holds the whole log, and its additional messages are valid by their schemas."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from protocol.wire.messages import PlantState
from tests.support import runs
from tests.support.logs import record_run
from transport.cli.main import app
from transport.log.channels import topic_of
from transport.log.run_log import read_log
from transport.report.foxglove import CHANNELS, METADATA
from transport.report.json_messages import to_json

EXACT = 1e-12
TICKS = 6
# The payload starts 10 m up, its box reaches 0.125 m further down: it stands on this ground.
ON_THE_GROUND = ("plant.engine=mujoco", "plant.ground_m=-9.875")


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run folder with the copy beside its log."""
    folder = tmp_path_factory.mktemp("foxglove")
    record_run(runs.setup(runs.ticks(TICKS)), folder)
    result = CliRunner().invoke(app, ["log", "export", str(folder), "--foxglove", str(folder / "foxglove.mcap")])
    assert result.exit_code == 0, result.stderr
    assert f"{TICKS} ticks" in result.stdout
    return folder


def added(folder: Path) -> Iterator[tuple[str, int, dict[str, Any], str, dict[str, Any]]]:
    """Yield the additional messages: topic, time in ns, message, name and content of the schema."""
    with (folder / "foxglove.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
            if schema.name.startswith("foxglove.") or schema.name == "transport.Numbers":
                yield channel.topic, message.log_time, json.loads(message.data), schema.name, json.loads(schema.data)


def test_the_copy_holds_the_log(copied: Path) -> None:
    """Every message of the log is in the copy as JSON, in order, with its times; and so is the header."""
    log = read_log(copied / "run.mcap")
    with (copied / "foxglove.mcap").open("rb") as file:
        copy = make_reader(file)
        found = [
            (channel.topic, entry.log_time, entry.publish_time, entry.data)
            for _, channel, entry in copy.iter_messages(log_time_order=False)
            if channel.topic not in CHANNELS
        ]
        assert {record.name: record.metadata for record in copy.iter_metadata()} == {METADATA: log.header}
    assert found == [
        (topic_of(entry.message), entry.message.tick * 50_000_000, entry.received_ns, to_json(entry.message))
        for entry in log.messages
    ]


def test_the_copy_is_no_log(copied: Path) -> None:
    """The commands for logs refuse the copy in one line."""
    result = CliRunner().invoke(app, ["log", "info", str(copied / "foxglove.mcap")])
    assert result.exit_code == 2
    assert "an MCAP file, but not the log of a run" in result.stderr


def test_additional_messages_are_valid(copied: Path) -> None:
    """Transforms, scenes and numbers are valid by their schemas, which have Foxglove's names."""
    names = set()
    for _, _, message, name, schema in added(copied):
        jsonschema.validate(message, schema)
        names.add(name)
    assert names == {"foxglove.FrameTransforms", "foxglove.SceneUpdate", "transport.Numbers"}


def test_transforms_lead_to_the_plant_state(copied: Path) -> None:
    """From the root, z up, through the inertial frame, z down, the payload is at its position in the plant state."""
    plant_states = {plant_state.tick: plant_state for plant_state in read_log(copied / "run.mcap").of(PlantState)}
    frames = [(at_ns, message["transforms"]) for topic, at_ns, message, _, _ in added(copied) if topic == "/tf"]
    assert len(frames) == TICKS
    for at_ns, transforms in frames:
        root, payload, *uavs = transforms
        assert [t["child_frame_id"] for t in uavs] == ["uav1", "uav2", "uav3", "uav4"]
        assert (root["child_frame_id"], payload["parent_frame_id"]) == ("inertial", "inertial")
        turn = Rotation.from_quat([root["rotation"][axis] for axis in "xyzw"])
        place = turn.apply([payload["translation"][axis] for axis in "xyz"])
        x, y, z = plant_states[at_ns // 50_000_000].x[:3]
        np.testing.assert_allclose(place, [x, -y, -z], atol=EXACT)


def test_every_tick_has_a_scene(copied: Path) -> None:
    """Bodies are sent once, in their own frames; rods, thrust, predictions and links at every tick."""
    scenes = [(topic, message["entities"]) for topic, _, message, name, _ in added(copied) if "Scene" in name]
    (bodies,) = [entities for topic, entities in scenes if topic == "/scene/bodies"]
    assert [entity["frame_id"] for entity in bodies] == ["payload", "uav1", "uav2", "uav3", "uav4"]
    now = [{entity["id"] for entity in entities} for topic, entities in scenes if topic == "/scene/now"]
    agents = {f"predicted by agent {agent}" for agent in (1, 2, 3, 4)}
    assert now == [{"rods", "thrust", "links"} | agents] * TICKS


def test_no_file_is_overwritten(copied: Path) -> None:
    """An existing file is refused in one line."""
    result = CliRunner().invoke(app, ["log", "export", str(copied), "--foxglove", str(copied / "run.mcap")])
    assert result.exit_code == 2
    assert result.stderr.startswith("transport: --foxglove: expected a file that does not exist yet, got ")


@pytest.mark.parametrize(
    ("outputs", "message"), [([], "got neither"), (["--out", "t", "--foxglove", "f.mcap"], "got both")]
)
def test_exactly_one_output(copied: Path, outputs: list[str], message: str) -> None:
    """Either tables or a copy must be requested."""
    result = CliRunner().invoke(app, ["log", "export", str(copied), *outputs])
    assert result.exit_code == 2
    assert message in result.stderr


def test_ground_and_contacts(tmp_path: Path) -> None:
    """The top of a slab below the whole path is the ground; marks are where the payload's box touches it."""
    record_run(runs.setup(runs.ticks(2), *ON_THE_GROUND), tmp_path)
    result = CliRunner().invoke(app, ["log", "export", str(tmp_path), "--foxglove", str(tmp_path / "foxglove.mcap")])
    assert result.exit_code == 0, result.stderr
    slabs: list[Any] = []
    marks: list[Any] = []
    for topic, _, message, _, _ in added(tmp_path):
        for entity in message.get("entities", ()) if topic.startswith("/scene") else ():
            slabs += entity["cubes"] if entity["id"] == "ground" else []
            if entity["id"] == "contacts":
                marks.append([sphere["pose"]["position"] for sphere in entity["spheres"]])
    (slab,) = slabs
    top_m = slab["pose"]["position"]["z"] - slab["size"]["z"] / 2.0
    assert top_m == pytest.approx(-9.875)
    assert len(marks) == 2
    assert sorted((mark["x"], mark["y"]) for mark in marks[0]) == [(x, y) for x in (-0.25, 0.25) for y in (-0.25, 0.25)]
    assert {mark["z"] for mark in marks[0]} == {-9.875}
