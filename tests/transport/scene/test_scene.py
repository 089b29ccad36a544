"""The scene of a run: positions, predicted paths, links.

And the shapes and colours it is drawn with.
"""

from copy import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from scipy.spatial import ConvexHull

from tests.support import runs
from tests.support.logs import log_of, record_run
from tests.support.messages import sample
from transport.log.run_log import LogError
from transport.model.arrays import Array
from transport.plant.actuator_schedule import FAIL_SAFE
from transport.protocol.scenario.setup.cost_of_run import StageCost
from transport.protocol.wire.messages import Airtime, Target
from transport.scene.drawn_paths_links_and_thrust import ARROW_M, Drawing
from transport.scene.frames_and_poses import TEAM, poses_in_scene
from transport.scene.history import RunHistory
from transport.scene.lines_meshes_and_labels import LineSegments, Mesh
from transport.scene.payload_uav_and_obstacle_meshes import payload_points
from transport.scene.predictions import PredictedPaths, Predictions
from transport.scene.scene_at_tick import Air, SceneBuilder
from transport.scene.uav_and_link_colours import age_colour, uav_colour

# Largest difference between the agent's prediction of a sampling period, one step of a method of
# order 5, and the plant's motion, five such steps; and that of the announced inputs, which are
# rounded.
STEP_M = 1e-7
# Largest error of an agent's prediction over half a second, with small changes of the other plans.
NEAR_M = 1e-2
SOON_M = 3e-4  # the same over three periods on a perfect network
ROUNDING = 1e-9  # of positions, m, and of directions
DARK = "links.override=[{from='agent2',to='agent1',loss=1.0}]"
DELAY_S = 0.2
LATE = f"links.delay_s={DELAY_S}"
# Meshes of a drawing: payload and reference position; of each UAV a hub, two beams, four rotors.
MESHES_OF_PAYLOAD, MESHES_OF_UAV = 2, 7
LINES_OF_ARROW = 5  # the shaft, and four strokes at its tip

# No agent foresees that it will act alone, as agent 1 does that does not hear agent 2.
LAW = (
    "controller.silence=law",
    "controller.prediction=closed_loop",
    "controller.received_plans=by_age",
    "controller.relaxation=auto",
)
MOTORS = ("plant.motors.lag_s=0.05", "controller.motor_lag_s=0.05")


def builder_of(folder: Path, *settings: str) -> SceneBuilder:
    """Return the scene builder of a short run."""
    run = runs.setup(runs.SHORT, *settings)
    history = RunHistory(run)
    history.add(record_run(run, folder))
    return SceneBuilder(run, history)


@pytest.fixture(scope="module")
def distributed(tmp_path_factory: pytest.TempPathFactory) -> SceneBuilder:
    """Delayed plans and one link with 100 % loss, with the shared control law."""
    return builder_of(tmp_path_factory.mktemp("distributed"), DARK, LATE, *LAW)


@pytest.fixture(scope="module")
def lagging(tmp_path_factory: pytest.TempPathFactory) -> SceneBuilder:
    """The same with motors whose lag the agents know."""
    return builder_of(tmp_path_factory.mktemp("lagging"), DARK, LATE, *LAW, *MOTORS)


@pytest.fixture(scope="module")
def centralized(tmp_path_factory: pytest.TempPathFactory) -> SceneBuilder:
    """One agent that owns all UAVs."""
    return builder_of(tmp_path_factory.mktemp("centralized"), "agents.owned=[[1,2,3,4]]")


def test_positions_at_hover(distributed: SceneBuilder) -> None:
    """Rods have their lengths, thrust balances the weight, UAVs and payload are at their references."""
    setup, scene = distributed.setup, distributed.at(0)
    lengths = np.linalg.norm(scene.uavs_I - scene.attachments_I, axis=1)
    np.testing.assert_allclose(
        lengths, [uav.rod_length for uav in setup.system.uavs], atol=ROUNDING
    )
    weight = setup.system.total_mass * setup.system.gravity
    np.testing.assert_allclose(scene.thrusts_I.sum(axis=0), [0.0, 0.0, -weight], atol=1e-2 * weight)
    reference = setup.reference.outputs(np.zeros(1))[0, : 3 * setup.system.N]
    np.testing.assert_allclose(scene.uavs_I.reshape(-1), reference, atol=ROUNDING)
    assert scene.error_m < ROUNDING
    later = distributed.at(25)
    error_I = later.payload_I - later.payload_reference_I
    assert later.error_m == pytest.approx(float(np.sqrt(np.square(error_I).sum())))
    assert later.error_m > 1e3 * ROUNDING
    assert (scene.phase, later.phase) == ("hover", "climb")
    state = distributed.history.plant_states[25]
    y_ref = setup.reference.outputs(np.array([later.time_s]))[0]
    cost = StageCost(setup).at(25, setup.model.outputs(state.x), y_ref, state.u)
    assert later.cost == cost > 0.0
    assert distributed.hover_N == pytest.approx(weight / 4.0)


def test_the_centralized_agent_predicts_the_next_state(centralized: SceneBuilder) -> None:
    """Without other agents the prediction of one sampling period ahead is the next plant state."""
    for tick in (0, 12, 20):
        (prediction,) = centralized.at(tick).predictions
        after = centralized.at(tick + 1)
        assert prediction.uavs_I.shape == (centralized.setup.settings.horizon + 1, 4, 3)
        np.testing.assert_allclose(prediction.uavs_I[0], centralized.at(tick).uavs_I, atol=ROUNDING)
        np.testing.assert_allclose(prediction.uavs_I[1], after.uavs_I, atol=STEP_M)
        np.testing.assert_allclose(prediction.payload_I[1], after.payload_I, atol=STEP_M)


@pytest.mark.parametrize("motors", ["distributed", "lagging"])
def test_agents_predict_half_a_second(motors: str, request: pytest.FixtureRequest) -> None:
    """With the shared control law each agent predicts its own UAV half a second ahead, despite delayed plans."""
    builder: SceneBuilder = request.getfixturevalue(motors)
    before, after = builder.at(14), builder.at(24)
    assert [prediction.agent for prediction in before.predictions] == [1, 2, 3, 4]
    assert np.linalg.norm(after.uavs_I - before.uavs_I, axis=1).min() > 10.0 * NEAR_M
    for prediction in before.predictions:
        np.testing.assert_allclose(
            prediction.uavs_I[10, 0], after.uavs_I[prediction.agent - 1], atol=NEAR_M
        )


@pytest.mark.parametrize("actuation", ["immediate", "next_tick"])
def test_plans_are_predicted_from_their_start(actuation: str, tmp_path: Path) -> None:
    """On a perfect network three periods ahead, also where a plan acts from the next tick on."""
    builder = builder_of(tmp_path, *LAW, f"clock.actuation={actuation}")
    for tick in (5, 10, 14, 20):
        after = builder.at(tick + 3)
        for prediction in builder.at(tick).predictions:
            own_I = after.uavs_I[prediction.agent - 1]
            np.testing.assert_allclose(prediction.uavs_I[3, 0], own_I, atol=SOON_M)
            np.testing.assert_allclose(prediction.payload_I[3], after.payload_I, atol=SOON_M)


def changed(builder: SceneBuilder, tick: int, **of_history: Any) -> tuple[PredictedPaths, ...]:
    """Return the predictions at a tick of a run with another history."""
    history = copy(builder.history)
    for name, value in of_history.items():
        setattr(history, name, value)
    return SceneBuilder(builder.setup, history).at(tick).predictions


def test_an_agent_predicts_with_the_plans_that_it_used(distributed: SceneBuilder) -> None:
    """With plans 0.2 s late, those of four ticks before, and not those of the tick itself."""
    tick, late = 20, round(DELAY_S / 0.05)
    report = distributed.history.reports[1, tick]
    # Ages that it reports, -1 for no plan; the age of a plan that is taken away.
    for ages, age, is_same in (
        (report.plan_ages, 0, True),
        (report.plan_ages, late, False),
        ((0, 0, 0), 0, False),
        ((-1, -1, -1), -1, True),
    ):
        reports = dict(distributed.history.reports)
        reports[1, tick] = structs.replace(report, plan_ages=ages)
        plans = {
            key: plan for key, plan in distributed.history.plans.items() if key != (3, tick - age)
        }
        before = changed(distributed, tick, reports=reports)[0].payload_I
        after = changed(distributed, tick, reports=reports, plans=plans)[0].payload_I
        assert np.array_equal(before, after) is is_same


def test_a_prediction_that_diverges_is_not_drawn(
    distributed: SceneBuilder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is that of an agent without a plan."""
    states = np.tile(distributed.history.plant_states[5].x, (3, 1))
    diverging = states.copy()
    diverging[2, 0] = np.inf
    of_agents = {1: None, 2: diverging, 3: states, 4: None}
    monkeypatch.setattr(Predictions, "_states", lambda _self, agent, _tick: of_agents[agent])
    assert [prediction.agent for prediction in distributed.at(5).predictions] == [3]


def test_inputs_are_those_in_force_until_a_plan_starts() -> None:
    """Of an agent without the shared control law."""
    run = runs.setup()
    history: Any = SimpleNamespace(setup=run)
    asked: list[Any] = []

    def sequence(start: int, steps: int, *, before: int) -> Array:
        asked.append((start, steps, before))
        return np.full((steps, len(run.hover.u)), 7.0)

    plan: Any = SimpleNamespace(tick=5, start_tick=7)
    announced: Any = SimpleNamespace(sequence=sequence)
    state = structs.replace(runs.plant_state(run, 5), u=run.hover.u + 1.0)
    law = Predictions(history)._open_loop(state.x, announced, plan, state)
    np.testing.assert_array_equal(law.u_rest[:2], [state.u, state.u])
    np.testing.assert_array_equal(law.u_rest[2:], 7.0)
    assert asked == [(7, run.settings.horizon - 2, 6)]


def test_the_shared_law_follows_the_newest_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is made once, and told when a target has changed the reference; a class of the user shares none."""

    def setup(reference: str, controller: str = "mpc", prediction: str = "closed_loop") -> Any:
        return SimpleNamespace(
            model=None,
            hover=None,
            scenario=SimpleNamespace(controllers=("mpc", controller)),
            settings=SimpleNamespace(prediction=prediction),
            reference=SimpleNamespace(sampled=reference),
        )

    followed: list[str] = []

    def regulation(_model: Any, _hover: Any, _settings: Any, reference: str) -> Any:
        followed.append(f"from {reference}")
        return SimpleNamespace(follow=followed.append)

    monkeypatch.setattr("transport.scene.predictions.Regulation", regulation)
    history: Any = SimpleNamespace()
    predictions = Predictions(history)
    for other in (setup("a", controller="mine:Mine"), setup("a", prediction="open_loop")):
        history.setup = other
        assert predictions._followed_regulation() is None
    for reference in ("a", "a", "b", "b"):
        history.setup = setup(reference)
        assert predictions._followed_regulation() is not None
    assert followed == ["from a", "b"]


def test_a_log_without_states_has_no_scene() -> None:
    """The log of a run without a plant, or one cut before its first tick."""
    with pytest.raises(LogError, match="expected the states of a run, got none"):
        SceneBuilder.of(runs.setup(), log_of([runs.roster()]))


def test_an_agent_predicts_with_the_force_that_it_estimates(centralized: SceneBuilder) -> None:
    """Inputs without feedback let a force on the payload move it by its share of the team's mass: F t^2 / 2 m."""
    tick, force_N = 20, np.array([0.0, 0.0, 3.0])
    reports = dict(centralized.history.reports)
    reports[1, tick] = structs.replace(reports[1, tick], force=reports[1, tick].force + force_N)
    before = centralized.at(tick).predictions[0].payload_I[1]
    after = changed(centralized, tick, reports=reports)[0].payload_I[1]
    moved_m = force_N / centralized.setup.system.total_mass * 0.05**2 / 2.0
    np.testing.assert_allclose(after - before, moved_m, rtol=1e-2, atol=1e-6)


@pytest.mark.parametrize("gone", [{"incarnations": {1: 1, 2: 1, 4: 1}}, {"off": (3,)}], ids=str)
def test_without_an_agent_or_uav_there_is_no_prediction(
    gone: dict[str, Any], distributed: SceneBuilder
) -> None:
    """Plans of a team that is not complete are not those of the recorded laws."""
    roster = runs.roster(gone.get("incarnations"), k=15, version=2)
    roster = structs.replace(roster, off=gone.get("off", ()))
    rosters = [*distributed.history._rosters, roster]
    assert changed(distributed, 20, _rosters=rosters) == ()
    assert len(changed(distributed, 14, _rosters=rosters)) == 4


def test_links_show_the_age(distributed: SceneBuilder) -> None:
    """The link with 100 % loss never delivered a plan; plans of the others are as old as the delay."""
    for sender, receiver, age_s in distributed.at(25).links:
        if (sender, receiver) == (2, 1):
            assert age_s is None
        else:
            assert age_s == pytest.approx(DELAY_S)


def test_bodies_are_solid(distributed: SceneBuilder) -> None:
    """The mesh of every body is closed and faces outwards, and every rod ends on the payload."""
    system = distributed.setup.system
    meshes = [part for part in Drawing(distributed).fixed if isinstance(part, Mesh)]
    assert len(meshes) == MESHES_OF_PAYLOAD + MESHES_OF_UAV * system.N
    for mesh in meshes:
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        volume = (
            float(np.einsum("ij,ij->", a - mesh.vertices.mean(axis=0), np.cross(b - a, c - a)))
            / 6.0
        )
        assert volume == pytest.approx(ConvexHull(mesh.vertices).volume)
    equations = ConvexHull(payload_points(system)).equations
    assert all(
        (equations[:, :3] @ uav.rho + equations[:, 3] < ROUNDING).all() for uav in system.uavs
    )


@pytest.mark.parametrize("tick", [0, 20])
def test_parts_are_where_the_scene_is(distributed: SceneBuilder, tick: int) -> None:
    """In their poses rods join attachments and UAVs, predicted paths begin at the UAVs, actual paths end there."""
    drawing, scene = Drawing(distributed), distributed.at(tick)
    poses = poses_in_scene(scene)

    def placed(lines: LineSegments) -> Array:
        position, R = poses[lines.frame]
        return np.asarray(lines.segments @ R.T + position)

    rods = [
        placed(part)[0]
        for part in drawing.fixed
        if isinstance(part, LineSegments) and part.name == "rod"
    ]
    ends = np.stack([scene.attachments_I, scene.uavs_I], axis=1)
    np.testing.assert_allclose(np.array(rods), ends, atol=ROUNDING)
    moving = {lines.name: placed(lines) for lines in (*drawing.moving(scene), drawing.flown(scene))}
    horizon = distributed.setup.settings.horizon
    np.testing.assert_allclose(moving["predicted UAVs"][::horizon, 0], scene.uavs_I, atol=ROUNDING)
    np.testing.assert_allclose(
        moving["predicted payload"][::horizon, 0], [scene.payload_I] * 4, atol=ROUNDING
    )
    shafts = moving["thrust"][::LINES_OF_ARROW]
    lengths_I = scene.thrusts_I * (ARROW_M / distributed.hover_N)
    np.testing.assert_allclose(shafts[:, 0], scene.uavs_I, atol=ROUNDING)
    np.testing.assert_allclose(shafts[:, 1], scene.uavs_I + lengths_I, atol=ROUNDING)
    assert (shafts[:, 1, 2] < scene.uavs_I[:, 2] - ARROW_M / 2.0).all()  # up: z is down
    for i, R in enumerate(scene.R_uavs):
        tip_I, barbs_I = shafts[i, 1], moving["thrust"][LINES_OF_ARROW * i + 1 :][:4, 1]
        np.testing.assert_allclose((barbs_I - tip_I) @ R[:, 2], 0.1, atol=ROUNDING)
    if tick:
        flown_I = moving["actual paths"].reshape(-1, 3)
        assert all(
            np.linalg.norm(flown_I - place_I, axis=1).min() < ROUNDING for place_I in scene.uavs_I
        )


def test_a_link_is_drawn_as_its_half_at_the_receiver(distributed: SceneBuilder) -> None:
    """It begins at the receiver's UAV and ends halfway to the sender's."""
    drawing, scene = Drawing(distributed), distributed.at(20)
    origin, _ = poses_in_scene(scene)[TEAM]
    (links,) = (part for part in drawing.moving(scene) if part.name == "links")
    assert len(links.segments) == len(scene.links) == 12
    for (sender, receiver, _), (near, far) in zip(scene.links, links.segments, strict=True):
        of_sender, of_receiver = scene.uavs_I[sender - 1], scene.uavs_I[receiver - 1]
        np.testing.assert_allclose(near + origin, of_receiver, atol=ROUNDING)
        np.testing.assert_allclose(far + origin, (of_sender + of_receiver) / 2.0, atol=ROUNDING)


def test_a_released_uav_is_not_drawn(distributed: SceneBuilder) -> None:
    """It has neither frame nor rod nor thrust; the others keep theirs."""
    drawing = Drawing(distributed)
    scene = replace(distributed.at(20), released=(2,))
    frames = poses_in_scene(scene).keys()
    assert {"uav1", "uav3", "uav4", "rod1", "rod3", "rod4"} <= frames
    assert not {"uav2", "rod2"} & frames

    origin, _ = poses_in_scene(scene)[TEAM]
    (thrust,) = (part for part in drawing.moving(scene) if part.name == "thrust")
    feet_I = thrust.segments[::LINES_OF_ARROW, 0] + origin
    np.testing.assert_allclose(feet_I, np.delete(scene.uavs_I, 1, axis=0), atol=ROUNDING)


def airtime(tick: int, busy_s: float, *arrivals: float) -> Airtime:
    """Return the report of a plan of agent 1: arrivals at some of the other agents, s, or codes of losses."""
    count = len(arrivals) // 4
    message: Airtime = sample(
        Airtime, tick=tick, agents=(1,) * count, plan_ticks=(tick,) * count, exchanges=(0,) * count,
        receivers=runs.ALL, sent=np.zeros(count), arrivals=np.array(arrivals).reshape(count, 4), busy_s=busy_s,
    )  # fmt: skip
    return message


def test_the_radio_is_that_of_the_last_second() -> None:
    """Of 20 ticks, or of those since the first; what was not sent is neither delivered nor lost."""
    run = runs.setup("radio={}")
    history = RunHistory(run)
    history.add(runs.plant_state(run, tick) for tick in (0, 10, 40))
    history.add([airtime(5, 0.1)])
    history.add([airtime(20, 9.0, -9.0, -1.0, -1.0, -1.0), airtime(21, 0.1, -9.0, 0.0, 0.02, -1.0)])
    history.add([airtime(40, 0.2, -9.0, 0.01, -5.0, -9.0)])
    builder = SceneBuilder(run, history)
    assert builder.at(0).air == Air(airtime_share=0.0, delivered_share=None)
    for tick, airtime_share, delivered_share in ((10, 0.2, None), (40, 0.3, 0.75)):
        air = builder.at(tick).air
        assert air is not None
        assert air.airtime_share == pytest.approx(airtime_share)
        assert air.delivered_share == delivered_share
    bare = RunHistory(runs.setup())
    bare.add([runs.plant_state(bare.setup, 0)])
    assert SceneBuilder(bare.setup, bare).at(0).air is None


def test_who_is_off_released_or_on_its_fail_safe_is_told() -> None:
    """From the roster and the state of the tick; without a roster all are on it."""
    run = runs.setup()
    history = RunHistory(run)
    x = run.initial_state()
    x[6:9] = [0.1, -0.2, 0.3]
    state = structs.replace(runs.plant_state(run, 4), x=x, plan_ticks=(4, FAIL_SAFE, 3, FAIL_SAFE))
    history.add([state])
    scene = SceneBuilder(run, history).at(4)
    assert scene.members == {1, 2, 3, 4}
    assert (scene.fail_safe, scene.released) == ((2, 4), ())
    np.testing.assert_allclose(scene.attitude_deg, np.degrees([0.1, -0.2, 0.3]))

    roster = structs.replace(runs.roster({1: 1, 4: 1}, k=2, version=2), released=(3,))
    history.add([roster])
    scene = SceneBuilder(run, history).at(4)
    assert scene.members == {1, 4}
    assert scene.released == (3,)


def test_a_long_path_has_fewer_points_and_ends_at_the_tick(distributed: SceneBuilder) -> None:
    """Of 29 earlier ticks every fifth, and the last one once."""
    payload_I, uavs_I = distributed.paths(29, 5)
    assert (len(payload_I), uavs_I.shape) == (7, (7, 4, 3))
    for place_I, tick in zip(payload_I, (0, 5, 10, 15, 20, 25, 29), strict=True):
        np.testing.assert_array_equal(place_I, distributed.at(tick).payload_I)


def test_lines_have_the_colours_of_their_uavs_and_ages(distributed: SceneBuilder) -> None:
    """Predictions of the UAV that its agent owns, links of the age of the plan; the payload's path is black."""
    drawing, scene = Drawing(distributed), distributed.at(20)
    lines = {line.name: line for line in (*drawing.moving(scene), drawing.flown(scene))}
    horizon = distributed.setup.settings.horizon
    uavs = [uav_colour(i) for i in range(4)]
    for name, each, colours in (
        ("predicted UAVs", horizon, uavs),
        ("predicted payload", horizon, uavs),
        ("thrust", LINES_OF_ARROW, uavs),
        ("actual paths", 20, [(0, 0, 0), *uavs]),
        ("links", 1, [age_colour(age_s, 0.05) for *_, age_s in scene.links]),
    ):
        assert [tuple(row) for row in lines[name].colours[::each].tolist()] == colours
    layers = {name: line.layer for name, line in lines.items()}
    assert (layers["links"], layers["thrust"]) == ("links", "thrust")
    assert {part.layer for part in drawing.fixed if part.name == "rod"} == {""}


def test_a_new_target_has_a_reference_of_its_own() -> None:
    """Drawn once with the next scene, dashed, and fixed from then on; other targets before it stay."""
    run = runs.setup()
    history = RunHistory(run)
    history.add([runs.plant_state(run, 0)])
    builder = SceneBuilder(run, history)
    drawing = Drawing(builder)
    scene = builder.at(0)

    def drawn() -> list[LineSegments]:
        return [part for part in drawing.moving(scene) if part.name == "reference of payload"]

    def fixed() -> LineSegments:
        (found,) = (part for part in drawing.fixed if part.name == "reference of payload")
        assert isinstance(found, LineSegments)
        return found

    before = fixed()
    assert (len(before.segments), drawn()) == (60, [])  # every second one of 119
    for number in range(1, 23):
        target = sample(
            Target, tick=number, number=number, points=np.array([[0.1 * number, 0.0, -10.0]]), times=np.zeros(1),
            approach_s=2.0, approach_ramp_s=1.0, way_s=0.0, way_ramp_s=0.0,
        )  # fmt: skip
        history.add([target])
    (after,) = drawn()
    assert drawn() == []
    np.testing.assert_array_equal(fixed().segments, after.segments)
    assert len(after.segments) > len(before.segments)
    newest = history.setup.maneuver.targets[-1]
    times_s = np.linspace(newest.since_s, newest.ends_s, 30)
    path_I = history.setup.maneuver.path(times_s)[0]
    ends_I = after.segments.reshape(-1, 3)
    is_drawn = [np.abs(ends_I - place_I).max(axis=1).min() < ROUNDING for place_I in path_I]
    assert np.mean(is_drawn) > 0.8
