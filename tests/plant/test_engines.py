"""The engine of the plant.

Found by name, checked in all it returns; an error of it ends the run in one line.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support.nodes import PlantNode
from tests.support.runs import SHORT, integrated, plant_states, recorded, reproducible, setup, ticks
from transport.flight.memory import simulate
from transport.flight.roles import plant_run
from transport.model.arrays import Array
from transport.model.state import StateView
from transport.plant.engines import Engine, checked_engine, engine_version
from transport.plant.wind_and_noise import Environment
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import EXIT_DIVERGED
from transport.protocol.wire.messages import ActualInputs, Control, Message

# An engine of a person: another integrator of the same equations, to its tolerance.
OWN = """
from scipy.integrate import solve_ivp
from transport.model.linear.linearisation import Model

class Own:
    version = "1.2"
    def __init__(self, system, section):
        self.model = Model(system)
    def reset(self, x):
        self.x = x
    def advance(self, u, forces, duration_s):
        def f(t, x): return self.model.derivative(x, u, forces=forces)
        self.x = solve_ivp(f, (0.0, duration_s), self.x, rtol=1e-10, atol=1e-12).y[:, -1]
    def state(self):
        return self.x
"""
# Both integrate to 1e-9 a period; the controllers answer the difference.
AGREEMENT = 1e-6
IMPORT = "its import from {folder} or the installed packages raised "
# What is wrong with an engine: its `advance` and `state`, and the text of the run's end.
FAILURES = {
    "raises": (
        "raise ZeroDivisionError('no air')",
        "return self.x",
        "advance raised ZeroDivisionError: no air (mine_raises.py:4)",
    ),
    "exits": (
        "import sys; sys.exit(3)",
        "return self.x",
        "advance raised SystemExit: 3 (mine_exits.py:4)",
    ),
    "shape": ("self.x = self.x[:-1]", "return self.x", "state: expected shape (60,), got (59,)"),
    "texts": (
        "self.x = 'up'",
        "return self.x",
        "state raised TypeError: Cannot cast scalar from dtype('<U2')",
    ),
    "rods": (
        "self.x[12:15] *= 0.5",
        "return self.x",
        "expected a unit vector as rod direction of UAV1, got length 0.5",
    ),
    "tensions": (
        "self.tensions = [1.0]",
        "return self.x",
        "tensions: expected shape (0,) or (4,), got (1,)",
    ),
    "nan": ("self.x[5] = float('nan')", "return self.x", "the state is no longer finite"),
    "long": ("raise ValueError('x' * 100_000)", "return self.x", "xxx (mine_long.py:4)"),
    "control": (
        r"raise ValueError('a\x1b[31m\ud800b')",
        "return self.x",
        "ValueError: a?[31m?b (mine_control.py:4)",
    ),
    "error": (
        "return 'small'",
        "return self.x",
        "advance raised TypeError: must be real number, not str at",
    ),
}


def module(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str) -> None:
    """Write a module into a folder, and go there."""
    (folder / f"{name}.py").write_text(text, encoding="utf-8")
    monkeypatch.chdir(folder)


def broken(advance: str = "pass", state: str = "return self.x", reset: str = "self.x = x") -> str:
    """The text of a module with a class whose methods are given."""
    return (
        "class Mine:\n"
        "    def __init__(self, system, section): pass\n"
        f"    def reset(self, x): {reset}\n"
        f"    def advance(self, u, forces, duration_s): {advance}\n"
        f"    def state(self): {state}\n"
    )


def refusal(run: Setup) -> str:
    """Return the text with which an engine is refused, wherever it is built."""
    with pytest.raises(ScenarioError) as checked:
        checked_engine(plant_run(run))
    with pytest.raises(ScenarioError) as built:
        PlantNode(run)
    assert str(checked.value) == str(built.value)
    assert checked.value.field == "plant.engine"
    return checked.value.problem


def ended(run: Setup) -> Control:
    """Return how a run ends in memory."""
    return simulate(run)


def states(messages: list[Message]) -> Array:
    """Plant states, (ticks, n)."""
    return np.array([plant_state.x for plant_state in plant_states(messages)])


def test_rods_is_the_model() -> None:
    """The default engine integrates the controllers' equations: the same bits as the model itself."""
    run = setup(SHORT)
    engine = Engine(plant_run(run), Environment(plant_run(run)).system)
    u = run.hover.u * 1.02
    found, error = engine.advance(u, None, 0.05)
    np.testing.assert_array_equal(found, integrated(run, run.initial_state(), u))
    assert 0.0 <= error < 1e-6
    assert checked_engine(plant_run(run)) == f"rods {engine_version('rods')}"


def test_an_engine_of_a_person_flies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A class in the current folder integrates the plant, wind and masses included, as the engine here does."""
    module(tmp_path, monkeypatch, "mine_flies", OWN)
    effects = (
        "plant.payload_mass_factor=1.1",
        "plant.wind.speed_mps=[2.0,0.0,0.0]",
        "plant.noise.position_m=0.01",
    )
    path = list(sys.path)
    run = setup(SHORT, *effects, "plant.engine=mine_flies:Own")
    own = recorded(run)
    assert sys.path == path
    assert checked_engine(plant_run(run)) == "mine_flies:Own 1.2"
    assert np.abs(states(own) - states(recorded(setup(SHORT, *effects)))).max() < AGREEMENT
    assert {plant_state.local_error for plant_state in plant_states(own)} == {-1.0}
    # And once more: the same bits.
    assert list(map(reproducible, own))[-1] == list(map(reproducible, recorded(run)))[-1]
    assert states(own).tobytes() == states(recorded(run)).tobytes()


@pytest.mark.parametrize("failure", FAILURES)
def test_a_failing_engine_ends_the_run(
    failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever an engine does, the run ends at its first interval with one line that names engine and error."""
    advance, state, text = FAILURES[failure]
    name = f"mine_{failure}"
    module(tmp_path, monkeypatch, name, broken(advance, state))
    control = ended(setup(SHORT, f"plant.engine={name}:Mine"))
    assert (control.outcome, control.exit_code) == ("diverged", EXIT_DIVERGED)
    assert text in control.reason
    assert control.reason.isprintable()
    assert f"engine {name}:Mine" in control.reason or failure == "nan"
    assert control.reason.endswith("at t = 0.00 s")


@pytest.mark.parametrize(
    ("engine", "text"),
    [
        ("mine_none:Mine", IMPORT + "ModuleNotFoundError: No module named 'mine_none'"),
        ("mine.none:Mine", IMPORT + "ModuleNotFoundError: No module named 'mine'"),
        ("mine_bad:Yours", IMPORT + "AttributeError: module 'mine_bad' has no attribute 'Yours'"),
        ("mine_bad:number", "the constructor raised TypeError: 'int' object is not callable"),
        ("mine_bad:Unready", "the constructor raised RuntimeError: no licence (mine_bad.py:2)"),
        ("mine_bad:Half", "expected the methods reset, advance, state, got no advance"),
        (
            "mine_bad:Late",
            "state: expected the state given to reset, got 0 instead of -10 at index 2",
        ),
        ("mine_broken:Mine", IMPORT + "SyntaxError: "),
        ("mine_needs:Mine", IMPORT + "ModuleNotFoundError: No module named 'bullet_4711'"),
        ("numpy:nothing_like_it", IMPORT + "AttributeError: "),
    ],
)
def test_an_engine_that_cannot_be_used(
    engine: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is refused before anything starts: naming the key, what was expected, and what came."""
    lines = [
        "class Unready:",
        "    def __init__(self, system, section): raise RuntimeError('no licence')",
        "number = 3",
    ]
    lines += [
        "class Half:",
        "    def __init__(self, system, section): pass",
        "    def reset(self, x): pass",
    ]
    lines += ["    def state(self): pass"]
    late = broken(state="return self.x", reset="x[2] = 0.0; self.x = x").replace("Mine", "Late")
    module(tmp_path, monkeypatch, "mine_bad", "\n".join(lines) + "\n" + late)
    module(tmp_path, monkeypatch, "mine_broken", "class Mine(\n")
    module(tmp_path, monkeypatch, "mine_needs", "import bullet_4711\n")
    assert refusal(setup(SHORT, f"plant.engine={engine}")).startswith(text.format(folder=tmp_path))


@pytest.mark.parametrize(
    "name",
    [
        "bullet",
        "mine",
        "mine:",
        ":Mine",
        "mine:Mine()",
        "a b:C",
        "../mine:Mine",
        "Rods",
        "",
        "mine.:Mine",
    ],
)
def test_a_name_that_is_none(name: str) -> None:
    """Anything but the two engines and a class is refused when the scenario is read."""
    with pytest.raises(
        ScenarioError, match=r"expected 'rods', 'mujoco' or 'package\.module:Class', got"
    ):
        setup(f"plant.engine='{name}'")


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        (["plant.ground_m=0.0"], "plant.ground_m"),
        (["plant.mujoco.rod_mass_kg=0.1"], "plant.mujoco"),
        (["plant.engine=mujoco", "plant.mujoco.step_s=0.011"], "plant.mujoco.step_s"),
        (
            [
                "plant.engine=mujoco",
                "plant.mujoco.suspension=cables",
                "faults.event=[{at_s=0.1,do='release',target='uav3'}]",
            ],
            "plant.mujoco.suspension",
        ),
    ],
)
def test_settings_without_effect(settings: list[str], field: str) -> None:
    """A setting that the engine cannot follow is refused instead of ignored."""
    with pytest.raises(ScenarioError) as refused:
        setup(*settings)
    # As it was given on the command line: the key may stand in the setting.
    assert field in str(refused.value)


def test_a_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the package of an engine, the line says how to install it."""
    monkeypatch.setattr("transport.plant.engines.find_spec", lambda _: None)
    problem = refusal(setup(SHORT, "plant.engine=mujoco"))
    assert (
        problem == "expected the package mujoco, got none; pip install 'payload-transport[mujoco]'"
    )


def made(
    folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, text: str
) -> tuple[Engine, Array]:
    """Return an engine of a text, and the inputs of hover."""
    module(folder, monkeypatch, name, text)
    run = plant_run(setup(SHORT, f"plant.engine={name}:Mine"))
    return Engine(run, Environment(run).system), run.run.hover.u


def test_the_first_failure_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An engine that has failed is not asked to go on; its last state stays, and its words."""
    text = broken(
        "self.x[:3] += 0.1; self.n = [*getattr(self, 'n', ()), 1]; 1 / (2 - len(self.n))",
        reset="self.x = x; open('fails').close() if getattr(self, 'n', 0) else None",
    )
    engine, u = made(tmp_path, monkeypatch, "mine_fails_twice", text)
    found = [engine.advance(u, None, 0.05) for _ in range(3)]
    np.testing.assert_array_equal(found[1][0], found[0][0])
    np.testing.assert_array_equal(found[2][0], found[0][0])
    assert [error for _, error in found] == [-1.0] * 3
    assert "ZeroDivisionError" in engine.failure
    engine.restart(found[0][0], engine._system)
    assert "ZeroDivisionError" in engine.failure
    assert engine._physics.n == [1, 1]  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("advance", "error", "failure"),
    [
        ("return 0.25", 0.25, ""),
        ("return float('nan')", -1.0, ""),
        ("self.x[12:15] *= 1.0009", -1.0, ""),
        ("self.x[12:15] *= 1.0011", -1.0, "unit vector as rod direction of UAV1"),
        # Of a state that is not finite nothing else is told.
        ("self.x[24:27] *= 2.0; self.x[5] = float('inf')", -1.0, ""),
        ("self.x[5] = float('inf'); self.tensions = [float('nan')] * 4", -1.0, ""),
        ("self.tensions = [] if hasattr(self, 'tensions') else [1.0] * 4", -1.0, "shape (4,), got (0,)"),
    ],
)  # fmt: skip
def test_what_an_engine_tells_is_checked(
    advance: str, error: float, failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A local error that is no number is unknown; rods have a length of 1 to a thousandth; cables stay."""
    name = f"mine_tells_{abs(hash(advance))}"
    engine, u = made(tmp_path, monkeypatch, name, broken(advance))
    found = [engine.advance(u, None, 0.05)[1] for _ in range(1 if "1.0009" in advance else 2)]
    assert found == [error] * len(found)
    assert failure in engine.failure
    assert bool(failure) == bool(engine.failure)


@pytest.mark.parametrize(("off", "is_taken"), [(9e-7, True), (1.1e-6, False)])
def test_the_state_given_is_taken_to_a_millionth(
    off: float, is_taken: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rounding of other coordinates is no difference."""
    text = broken(reset=f"self.x = x + {off}")
    module(tmp_path, monkeypatch, f"mine_off_{is_taken}", text)
    run = setup(SHORT, f"plant.engine=mine_off_{is_taken}:Mine")
    if is_taken:
        checked_engine(plant_run(run))
    else:
        assert "expected the state given to reset" in refusal(run)


def test_rods_halve_steps_until_they_are_exact_enough() -> None:
    """The local error of a team that swings fast is within `plant.tolerance`, and beyond it with a larger one."""
    errors = []
    for tolerance in (1e-9, 1.0):
        run = plant_run(setup(SHORT, f"plant.tolerance={tolerance}"))
        engine = Engine(run, Environment(run).system)
        x = run.run.initial_state()
        StateView(x).Omega_P[:, 0] = 20.0
        engine.restart(x, engine._system)
        errors.append(engine.advance(run.run.hover.u, None, 0.05)[1])
    assert errors[0] < 1e-9 < errors[1]


def test_other_bodies_move_as_those_of_a_new_engine() -> None:
    """From the state at which they change."""
    run = plant_run(setup(SHORT))
    x, u = run.run.initial_state(), run.run.hover.u
    system = Environment(run).system
    heavier = replace(system, payload=replace(system.payload, mass=5.0))
    changed, made = Engine(run, system), Engine(run, heavier)
    changed.restart(x, heavier)
    np.testing.assert_array_equal(changed.advance(u, None, 0.05)[0], made.advance(u, None, 0.05)[0])


@pytest.mark.parametrize("engine", ["rods", "mujoco"])
def test_warming_up_changes_nothing(engine: str) -> None:
    """The first period of a run is the same after it."""
    run = plant_run(setup(SHORT, f"plant.engine={engine}"))
    fresh, warm = (Engine(run, Environment(run).system) for _ in range(2))
    warm.warm_up(run)
    (x, error), (other, warm_error) = (
        one.advance(1.1 * run.run.hover.u, None, 0.05) for one in (fresh, warm)
    )
    np.testing.assert_array_equal(x, other)
    assert error == warm_error


# An engine that does not move the team, and works on the arrays that it is given.
IN_PLACE = """
class Mine:
    def __init__(self, system, section): pass
    def reset(self, x): self.x = x
    def advance(self, u, forces, duration_s):
        u *= 0.5
        if forces is not None:
            forces *= 0.5
    def state(self): return self.x
"""


def test_an_engine_that_works_in_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It changes neither the plant's record of inputs nor the forces."""
    module(tmp_path, monkeypatch, "mine_in_place", IN_PLACE)
    module(tmp_path, monkeypatch, "mine_rests", broken())
    runs = [
        setup(SHORT, f"plant.engine={name}:Mine", "plant.wind.speed_mps=[2.0,0.0,0.0]")
        for name in ("mine_in_place", "mine_rests")
    ]
    in_place, resting = (plant_states(recorded(run)) for run in runs)
    for found, expected in zip(in_place, resting, strict=True):
        np.testing.assert_array_equal(found.u, expected.u)

    run = runs[0]
    u = run.hover.u.copy()
    forces = np.ones(3 + 3 * run.system.N)
    Engine(plant_run(run), Environment(plant_run(run)).system).advance(u, forces, 0.05)
    np.testing.assert_array_equal(u, run.hover.u)
    np.testing.assert_array_equal(forces, 1.0)


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_tensions_that_are_not_finite(
    number: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They end the run in one line that names engine and cable."""
    name = f"mine_cables_{number.strip('-')}"
    module(
        tmp_path, monkeypatch, name, broken(f"self.tensions = [1.0, float('{number}'), 1.0, 1.0]")
    )
    control = ended(setup(SHORT, f"plant.engine={name}:Mine"))
    assert (control.outcome, control.exit_code) == ("diverged", EXIT_DIVERGED)
    text = f"tensions: expected a finite number for the cable of UAV2, got {number}"
    assert f"engine {name}:Mine: {text}" in control.reason


def test_tensions_of_an_engine_with_cables_are_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The least of each period, with the inputs, also where these are the commands; rods have none."""
    text = broken("self.tensions = [4.0, 3.0, 2.0, 1.0]")
    module(tmp_path, monkeypatch, "mine_cables", text)
    module(tmp_path, monkeypatch, "mine_rods", broken())
    for name, tensions in (("mine_cables", [4.0, 3.0, 2.0, 1.0]), ("mine_rods", [])):
        messages = recorded(setup(ticks(3), f"plant.engine={name}:Mine"))
        found = [one for one in messages if isinstance(one, ActualInputs)]
        assert len(found) == (len(plant_states(messages)) if tensions else 0)
        for one, commands in zip(found, plant_states(messages), strict=False):
            assert (one.tick, one.uavs, one.cables) == (commands.tick, (1, 2, 3, 4), (1, 2, 3, 4))
            np.testing.assert_array_equal(one.tensions, tensions)
            np.testing.assert_allclose(one.inputs.reshape(-1), commands.u)
