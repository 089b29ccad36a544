"""Reading a scenario: from TOML and command-line settings to a `Setup`, or one clear line saying what is wrong."""

import difflib
import importlib.resources
import re
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from model.arrays import ShapeError
from model.parameters import ParameterError
from mpc.feedback import FeedbackError
from mpc.settings import SettingsError
from protocol.scenario.path_file import PathFileError, with_paths
from protocol.scenario.schema import LinkChangeSection, LinkOverrideSection, Scenario

T = TypeVar("T")

# How far from the origin a path may lead along any axis, m.
FURTHEST_M = 1e5


class ScenarioError(ValueError):
    """A scenario that cannot be flown: `file: field: expected ..., got ...`.

    Args:
        source: File it comes from, or the option.
        field: Dotted path of the key, list entries counted from 1; may be empty.
        problem: What was expected and what came.
    """

    def __init__(self, source: str, field: str, problem: str) -> None:
        text = ": ".join(part for part in (source, field, problem) if part)
        super().__init__(" ".join(text.splitlines()))
        self.field, self.problem = field, problem

    def blaming(self, settings: Sequence[str]) -> "ScenarioError":
        """The same error, naming the settings in place of the file if they gave the field, or part of it.

        Args:
            settings: As `read_scenario` takes them.
        """
        given: list[str] = []
        for setting in reversed(settings):
            key = _key(setting)
            around = f"{self.field}.".startswith(f"{key}.")
            if around or key.startswith(f"{self.field}."):
                given.insert(0, setting)
            if around:
                break  # it replaced whatever settings before it had given
        if not given:
            return self
        field = "" if [_key(setting) for setting in given] == [self.field] else self.field
        return ScenarioError(" ".join(map(_option, given)), field, self.problem)


def find_scenario(name: str) -> Path:
    """The file a person means: a path, or the name of a scenario that comes with the package.

    Raises: ScenarioError: neither exists; the text lists the names.
    """
    path = Path(name)
    if path.exists() or path.suffix == ".toml" or "/" in name:
        return path
    folder = Path(str(importlib.resources.files("scenarios")))
    known = sorted(file.stem for file in folder.glob("*.toml"))
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        raise ScenarioError(name, "", f"expected a scenario file or the name of a ready one; {hint}")
    return folder / f"{name}.toml"


def read_scenario(path: Path, settings: Sequence[str] = ()) -> Scenario:
    """Read and validate a scenario file.

    Args:
        path: TOML file.
        settings: Changes on top of it, "dotted.key=value" with a TOML value; list entries by number from 1.
    Raises: ScenarioError: naming file, field, expected and got; the setting in place of the file if it gave the field.
    """
    source = str(path)
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ScenarioError(source, "", "no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(source, "", f"cannot be read ({error})") from error
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(source, "", f"not valid TOML: {error}") from error
    for setting in settings:
        _apply(tree, setting)
    try:
        return validate(tree, source)
    except ScenarioError as error:
        raise error.blaming(settings) from error.__cause__


def validate(tree: dict[str, Any], source: str) -> Scenario:
    """Check a tree of plain data against the scenario's schema, then the relations between its fields.

    Args:
        tree: The data; files of its maneuver are read here.
        source: The scenario's file, from whose folder on those are named.
    """
    try:
        tree = with_paths(tree, Path(source).parent)
    except PathFileError as error:
        number, _, problem = str(error).partition(" ")
        raise ScenarioError(source, f"maneuver.phase.{number}.file", problem) from error
    try:
        scenario = Scenario.model_validate(tree)
    except ValidationError as error:
        raise _first(error, source) from error
    _check_relations(scenario, source)
    return scenario


def building(source: str, field: str, build: Callable[[], T]) -> T:
    """Build a model object from a scenario's values; what it refuses becomes a `ScenarioError` of that field."""
    try:
        return build()
    except (FeedbackError, ParameterError, SettingsError, ShapeError) as error:
        raise ScenarioError(source, field, str(error)) from error


def _check_relations(scenario: Scenario, source: str) -> None:
    ids = [uav.id for uav in scenario.system.uav]
    if ids != list(range(1, len(ids) + 1)):
        raise ScenarioError(source, "system.uav.id", f"expected 1, 2, ... {len(ids)} in order, got {ids}")
    owners: dict[int, int] = {}
    for agent, group in enumerate(scenario.owned, start=1):
        for uav in group:
            if uav not in ids:
                raise ScenarioError(source, f"agents.owned.{agent}", f"expected ids of UAVs 1..{len(ids)}, got {uav}")
            if uav in owners:
                raise ScenarioError(
                    source,
                    f"agents.owned.{agent}",
                    f"expected each UAV once, got UAV{uav}, owned by agent {owners[uav]}",
                )
            owners[uav] = agent
    missing = [uav for uav in ids if uav not in owners]
    if missing:
        raise ScenarioError(source, "agents.owned", f"expected each UAV once, got none for UAV{missing[0]}")
    names = [f"agent{agent}" for agent in range(1, len(scenario.owned) + 1)]
    _check_links(scenario, source, names)
    _check_controller(scenario, source)
    _check_clock(scenario, source)
    _check_faults(scenario, source, names)
    _check_sharing(scenario, source)
    low, high = scenario.controller.limits.thrust_N
    if low >= high:
        raise ScenarioError(source, "controller.limits.thrust_N", f"expected smallest < largest, got {[low, high]}")
    period_s, step_s = scenario.controller.sampling_period_s, scenario.plant.step_s
    if step_s > period_s:
        raise ScenarioError(source, "plant.step_s", f"expected at most the sampling period {period_s}, got {step_s}")
    _check_drag(scenario, source)
    _check_path(scenario, source)
    _check_network(scenario, source)


def _check_controller(scenario: Scenario, source: str) -> None:
    section = scenario.controller
    if section.terminal == "riccati" and section.weights.penalised_input == "absolute":
        expected = "expected 'deviation' with controller.terminal = 'riccati', whose optimum rests at hover"
        raise ScenarioError(source, "controller.weights.penalised_input", f"{expected}, got 'absolute'")
    if section.preview and section.prediction == "open_loop" and section.terminal == "multiple":
        expected = "expected controller.prediction = 'closed_loop' or controller.terminal = 'riccati' with it"
        raise ScenarioError(source, "controller.preview", f"{expected}, got neither")


def _check_links(scenario: Scenario, source: str, agents: list[str]) -> None:
    links, names = scenario.links, ["plant", *agents]
    expected = f"expected one of {', '.join(names)}"
    for place, section in links.all().items():
        field = ".".join(part for part in ("links", place) if part)
        if isinstance(section, LinkOverrideSection):
            for key, name in (("from", section.from_), ("to", section.to)):
                if name is not None and name not in names:
                    raise ScenarioError(source, f"{field}.{key}", f"{expected}, got {name!r}")
        if section.distribution == "empirical" and section.samples is None:
            raise ScenarioError(source, f"{field}.samples", "expected a file of measured delays, got nothing")
        changed = isinstance(section, LinkChangeSection) and section.samples is not None
        if changed and section.distribution != "empirical":
            expected = "expected 'empirical' with samples, as a change says all that is to be other"
            raise ScenarioError(source, f"{field}.distribution", f"{expected}, got {section.distribution!r}")
    for i, partition in enumerate(links.partition, start=1):
        for name in partition.between:
            if name not in names:
                raise ScenarioError(source, f"links.partition.{i}.between", f"{expected}, got {name!r}")
        if partition.end_s <= partition.start_s:
            expected_end = f"expected more than start_s {partition.start_s}, got {partition.end_s}"
            raise ScenarioError(source, f"links.partition.{i}.end_s", expected_end)


def _check_clock(scenario: Scenario, source: str) -> None:
    clock = scenario.clock
    if clock.mode != "realtime":
        return
    if clock.speed == 0.0:
        raise ScenarioError(source, "clock.speed", "expected a number > 0 with mode realtime, such as 1, got 0")
    if clock.actuation == "immediate":
        expected = "expected 'next_tick' with mode realtime, where a step takes time, got 'immediate'"
        raise ScenarioError(source, "clock.actuation", expected)
    if scenario.controller.negotiation_iterations > 1:
        raise ScenarioError(
            source,
            "controller.negotiation_iterations",
            f"expected 1 with mode realtime, where nobody waits, got {scenario.controller.negotiation_iterations}",
        )


def _check_sharing(scenario: Scenario, source: str) -> None:
    """Sharing on change requires receivers that can predict the sender between two of its plans."""
    controller = scenario.controller
    if controller.share == "always":
        return
    for key, expected, why in (
        ("prediction", "closed_loop", "where the others know the law that acts between two plans"),
        ("received_plans", "by_age", "as plans are used for longer than a period"),
        ("received_states", "predicted", "as states are used for longer than a period"),
        ("negotiation_iterations", 1, "as each round exchanges every plan"),
    ):
        got = getattr(controller, key)
        if got != expected:
            text = f"expected {expected!r} with controller.share 'on_change', {why}, got {got!r}"
            raise ScenarioError(source, f"controller.{key}", text)


def _check_faults(scenario: Scenario, source: str, agents: list[str]) -> None:
    names = ["coordinator", "plant", *agents]
    uavs = [f"uav{section.id}" for section in scenario.system.uav]
    state = dict.fromkeys([*names, *uavs], "running")
    # What may follow what: nothing can be stopped that is not running.
    allowed = {
        "kill": ("running", "stopped"),
        "stop": ("running",),
        "continue": ("stopped",),
        "restart": ("running", "stopped", "killed"),
        "motor_off": ("running",),
        "release": ("running", "off"),  # of a running one: its motors go off with it
    }
    after = {"kill": "killed", "stop": "stopped", "continue": "running", "restart": "running"}
    after |= {"motor_off": "off", "release": "released"}
    events = list(enumerate(scenario.faults.event, start=1))
    for i, event in sorted(events, key=lambda entry: entry[1].at_s):
        field = f"faults.event.{i}"
        possible = uavs if event.do in ("motor_off", "release") else names
        if event.target not in possible:
            raise ScenarioError(
                source, f"{field}.target", f"expected one of {', '.join(possible)}, got {event.target!r}"
            )
        if event.do == "restart" and event.target not in agents:
            expected = f"expected an agent to restart, as a run ends with its {event.target}, got 'restart'"
            raise ScenarioError(source, f"{field}.do", expected)
        if state[event.target] not in allowed[event.do]:
            expected = f"expected what can be done to {event.target}, which is {state[event.target]} by then"
            raise ScenarioError(source, f"{field}.do", f"{expected}, got {event.do!r}")
        state[event.target] = after[event.do]
    if uavs and all(state[uav] in ("off", "released") for uav in uavs):
        expected = "expected at least one UAV that keeps its motors"
        raise ScenarioError(source, "faults.event", f"{expected}, got motor_off or release for all {len(uavs)}")


def _check_drag(scenario: Scenario, source: str) -> None:
    """Drag is held over a period: more than this would turn the motion it brakes around. Without wind there is none."""
    plant, system, period_s = scenario.plant, scenario.system, scenario.controller.sampling_period_s
    if not any([*plant.wind.speed_mps, *plant.wind.gust_mps]):
        return
    lightest = min(uav.mass_kg for uav in system.uav)
    for key, drag, mass in (
        ("drag_payload_kgps", plant.wind.drag_payload_kgps, plant.payload_mass_factor * system.payload.mass_kg),
        ("drag_uav_kgps", plant.wind.drag_uav_kgps, plant.uav_mass_factor * lightest),
    ):
        if drag * period_s > mass:
            expected = f"expected at most mass over sampling period {mass / period_s:g}"
            raise ScenarioError(source, f"plant.wind.{key}", f"{expected}, got {drag}")


def _check_path(scenario: Scenario, source: str) -> None:
    """A path stays where positions have millimetres to spare, and in what a measurement may say."""
    expected = f"expected a path within {FURTHEST_M:g} m of the origin"
    reached = scenario.maneuver.start_m
    if max(map(abs, reached)) > FURTHEST_M:
        raise ScenarioError(source, "maneuver.start_m", f"{expected}, got {reached}")
    for i, phase in enumerate(scenario.maneuver.phase, start=1):
        places = [place for _, *place in phase.way or [] if len(place) == len(reached)]
        for way in [*places, phase.displacement_m]:
            furthest = max(abs(a + b) for a, b in zip(reached, way, strict=True))
            if furthest > FURTHEST_M:
                key = "way" if phase.way else "displacement_m"
                raise ScenarioError(source, f"maneuver.phase.{i}.{key}", f"{expected}, got {furthest:g} m")
        reached = [a + b for a, b in zip(reached, phase.displacement_m, strict=True)]


def _check_network(scenario: Scenario, source: str) -> None:
    """A router is an endpoint; whether what listens may listen there is seen to when it does."""
    router = scenario.network.router
    if router is not None and not re.fullmatch(r"(tcp|tls)/\S+:\d+", router):
        expected = f"expected an endpoint such as tls/192.0.2.1:7447, got {router!r}"
        raise ScenarioError(source, "network.router", expected)


def _apply(tree: dict[str, Any], setting: str) -> None:
    key, (_, separator, text) = _key(setting), setting.partition("=")
    if not separator or not key:
        raise ScenarioError(_option(setting), "", "expected key=value")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()  # bare words are text: solver=clarabel
    *parents, last = key.split(".")
    node: Any = tree
    for part in parents:
        node = _child(node, part, setting)
    if isinstance(node, list):
        index = _index(node, last, setting)
        node[index] = value
    else:
        node[last] = value


def _child(node: Any, part: str, setting: str) -> Any:
    child = node[_index(node, part, setting)] if isinstance(node, list) else node.setdefault(part, {})
    if not isinstance(child, dict | list):
        raise ScenarioError(_option(setting), "", f"expected {part!r} to be a section, got the value {child!r}")
    return child


def _index(node: list[Any], part: str, setting: str) -> int:
    if not (part.isdecimal() and 1 <= int(part) <= len(node)):
        raise ScenarioError(_option(setting), "", f"expected an entry from 1 to {len(node)}, got {part!r}")
    return int(part) - 1


def _key(setting: str) -> str:
    return setting.partition("=")[0].strip()


def _option(setting: str) -> str:
    """A setting as it was given on the command line, shortened when it is long."""
    return f"--set {_short(setting) or repr(setting)}"


def _short(text: str) -> str:
    return text if len(text) <= 80 else text[:77] + "..."


def _first(error: ValidationError, source: str) -> ScenarioError:
    """The first problem pydantic found, in our words."""
    # Unknown keys first: a mistyped key is also a missing one, and the typo is what helps.
    problems = sorted(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    problem = problems[0]
    *above, last = problem["loc"]
    # Pydantic names the branch of a union it tried; an unknown key may be called anything and comes last.
    known_last = problem["type"] == "extra_forbidden" or not _is_union_branch(last)
    location = [part for part in above if not _is_union_branch(part)] + ([last] if known_last else [])
    field = ".".join(str(part + 1) if isinstance(part, int) else part for part in location)
    kind, context, value = problem["type"], problem.get("ctx", {}), problem["input"]
    if kind == "extra_forbidden":
        known = _known_keys(location[:-1])
        near = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        return ScenarioError(source, field, f"unknown key; {hint}")
    if kind == "missing":
        return ScenarioError(source, field, "expected a value, got nothing")
    expected = _expected(kind, context, problem["msg"])
    return ScenarioError(source, field, f"{expected}, got {_short(repr(value))}")


def _expected(kind: str, context: dict[str, Any], message: str) -> str:
    bounds = {
        "greater_than": "> {gt}",
        "greater_than_equal": ">= {ge}",
        "less_than": "< {lt}",
        "less_than_equal": "<= {le}",
    }
    if kind in bounds:
        return "expected a number " + bounds[kind].format(**context)
    if kind in ("too_short", "too_long"):
        limit = context.get("min_length", context.get("max_length"))
        return f"expected {'at least' if kind == 'too_short' else 'at most'} {limit} list entries"
    words = {
        "int_type": "expected an integer",
        "int_from_float": "expected an integer",
        "float_type": "expected a number",
        "finite_number": "expected a finite number",
        "string_type": "expected text",
        "bool_type": "expected true or false",
        "list_type": "expected a list",
        "model_type": "expected a section",
        "dict_type": "expected a section",
    }
    if kind == "literal_error":
        return f"expected {context['expected']}"
    if kind == "string_pattern_mismatch":
        return f"expected text matching {context['pattern']}"
    return words.get(kind, message[0].lower() + message[1:])


def _is_union_branch(part: int | str) -> bool:
    """Whether a part of an error's location is not from the scenario but from the types it was tried against."""
    return isinstance(part, str) and (part in ("float", "constrained-float", "int", "str") or "[" in part)


def _known_keys(location: Iterable[int | str]) -> list[str]:
    section: type[BaseModel] = Scenario
    for part in location:
        if isinstance(part, int):
            continue
        section = _section_of(section.model_fields[part].annotation)
    return [field.alias or name for name, field in section.model_fields.items()]


def _section_of(annotation: Any) -> type[BaseModel]:
    """The section class inside an annotation such as `Annotated[list[UavSection], ...]` or `X | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in get_args(annotation):
        found = _section_of(argument) if argument is not type(None) else None
        if found is not None:
            return found
    return Scenario
