"""The lines between the packages.

Who may import whom, who may know a clock, what must be described.
"""

import ast
import re
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# Imports run downwards only: a module may import its own package and those of smaller numbers.
LAYERS = {
    "model": 0,
    "mpc": 1,
    "protocol": 2,
    "agent": 3,
    "plant": 3,
    "coordinator": 3,
    "vehicle": 3,
    "deploy": 3,
    "transport": 4,
}

# Rooms of the large packages, floor by floor from the lowest: a room imports its own modules
# and lower floors only.
ROOMS = {
    "model": ({"physics"}, {"kernels", "path"}, {"linear"}),
    "mpc": ({"program", "alone"}, {"law"}, {"margins"}),
    "agent": ({"silence"}, {"communication"}, {"estimation"}, {"planning"}, {"user_class"}),
    "protocol": ({"wire", "radio"}, {"scenario"}, {"admission"}, {"network"}),
    "protocol/scenario": (
        {"files", "user_class"},
        {"sections"},
        {"links", "faults"},
        {"checks"},
        {"targets"},
        {"setup"},
        {"radio", "teams"},
    ),
    "transport": (
        {"log"},
        {"flight", "analysis", "scene"},
        {"report", "viewer", "doctor"},
        {"experiments"},
        {"search"},
        {"interface"},
        {"cli"},
    ),
}
MOST_ROOMS = 14  # more cannot be taken in at a glance
MOST_FILES_OF_COORDINATOR = 45
MOST_FILES = 14  # of a folder, besides __init__.py and __main__.py
MOST_FILES_AT_ROOT = 4  # besides __init__.py and __main__.py

# Files of `model` about numbers and keys, not about bodies.
WITHOUT_PHYSICS = {f"model/{file}.py" for file in ("__init__", "arrays", "section", "state")}

# Base names of files for the same role in different processes.
SAME_ROLE = {"node.py", "radio.py"}
# Classes of the Python interface that wrap one of the same name: people write both the same way.
WRAPPED = {"Run", "Scenario"}

# Packages beside the sources, which no source imports.
NOT_FOR_SOURCES = {"benchmarks", "docs", "examples", "tests"}

# Modules that make a computation depend on more than its arguments, by dotted name.
OUTSIDE_WORLD = {
    "asyncio",
    "concurrent",
    "datetime",
    "http",
    "logging",
    "multiprocessing",
    "numpy.random",
    "os",
    "pathlib",
    "platform",
    "psutil",
    "queue",
    "random",
    "secrets",
    "select",
    "selectors",
    "shutil",
    "signal",
    "socket",
    "socketserver",
    "ssl",
    "subprocess",
    "tempfile",
    "threading",
    "time",
    "urllib",
    "uuid",
    "zenoh",
}

# Files that may import some of these modules, as their results depend on their arguments all the
# same.
EXCEPTIONS = {
    # The first import compiles kernels and model, and later ones load them: what they compute is
    # what Python computes without them (tests/model/kernels/test_native.py). So a node, which computes by
    # the model, may reach the compiler.
    "model/kernels/compiler.py": {"os", "pathlib", "platform", "shutil", "subprocess", "tempfile"},
    # Sources whose content names the compiled file.
    "model/kernels/casadi_functions.py": {"pathlib"},
    "model/kernels/native.py": {"pathlib"},
    # Generators keyed by seed, sender, receiver and tick.
    "protocol/radio/radio_random_numbers.py": {"numpy.random"},
    "protocol/scenario/links/random_streams.py": {"numpy.random"},
    # Files that a scenario names are read with it, before the run.
    "protocol/scenario/files/bounded_reading.py": {"pathlib"},
    "protocol/scenario/sections/scenario_errors.py": {"pathlib"},
    "protocol/scenario/sections/maneuver_sections.py": {"pathlib"},
    "protocol/scenario/files/named_files.py": {"pathlib"},
    "protocol/scenario/user_class/user_import.py": {"pathlib"},
    # Names the line of an error in a class of the user.
    "protocol/scenario/user_class/user_errors.py": {"pathlib"},
}

SOURCES = sorted(path for package in LAYERS for path in (ROOT / package).rglob("*.py"))
NODES = [ROOT / role / "node.py" for role in ("agent", "plant", "coordinator", "vehicle")]
PURE = [path for path in SOURCES if path.relative_to(ROOT).parts[0] in ("model", "mpc")]


def named(path: Path) -> str:
    """A file as people see it."""
    return path.relative_to(ROOT).as_posix()


@cache
def tree(path: Path) -> ast.Module:
    """Syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path: Path) -> frozenset[str]:
    """Return the dotted names of all imports of a file, by folder, inside functions as well."""
    names: set[str] = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{named(path)}:{node.lineno}: relative import"
            # `from protocol.wire import messages` imports a module, `from protocol.wire.messages
            # import Tick` a name in one.
            names |= {str(node.module), *[f"{node.module}.{alias.name}" for alias in node.names]}
    return frozenset(folder_of(name) for name in names)


def folder_of(name: str) -> str:
    """Return a dotted name by its folder: `transport.model.state` is a file of `model/`."""
    inside = name.removeprefix("transport.")
    return inside if inside.partition(".")[0] in LAYERS else name


def modules_imported(path: Path) -> set[Path]:
    """Return the files of the project that a file imports itself, also inside functions and for type checking alone."""
    found: set[Path] = set()
    for name in imports(path):
        candidate = ROOT.joinpath(*name.split("."))
        found |= {
            file
            for file in (candidate.with_suffix(".py"), candidate / "__init__.py")
            if file.exists()
        }
    return found - {path}


def reached(path: Path) -> set[Path]:
    """A file and all files of the project it imports, directly or through others."""
    found: set[Path] = set()
    waiting = [path]
    while waiting:
        at = waiting.pop()
        if at not in found:
            found.add(at)
            waiting += modules_imported(at)
    return found


def top(names: frozenset[str]) -> set[str]:
    """First parts of dotted names."""
    return {name.partition(".")[0] for name in names}


def uses_random_numbers(path: Path) -> bool:
    """Return whether a file uses `np.random`, which needs no import of its own."""
    return any(
        isinstance(node, ast.Attribute)
        and node.attr == "random"
        and isinstance(node.value, ast.Name)
        and node.value.id in ("np", "numpy")
        for node in ast.walk(tree(path))
    )


def outside_world(path: Path) -> set[str]:
    """Return the modules of the outside world that a file imports, inside functions as well."""
    found = {
        module
        for module in OUTSIDE_WORLD
        for name in imports(path)
        if f"{name}.".startswith(f"{module}.")
    }
    return found | {"numpy.random"} if uses_random_numbers(path) else found


def refused(path: Path) -> set[str]:
    """Return the modules of the outside world that a file imports without being an exception."""
    return outside_world(path) - EXCEPTIONS.get(named(path), set())


def floors(package: str) -> dict[str, int]:
    """Return the floor of each room of a package, from 0 for the lowest."""
    return {room: floor for floor, rooms in enumerate(ROOMS[package]) for room in rooms}


def room_of(path: Path, package: str) -> str:
    """Return the room of a file; empty for files of other packages and for files beside the rooms."""
    folder = ROOT / package
    return path.relative_to(folder).parts[0] if folder in path.parent.parents else ""


def in_rooms(package: str) -> list[Path]:
    """Return the files in the rooms of a package, without those beside the rooms."""
    return [path for path in SOURCES if room_of(path, package)]


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_are_few_and_listed(package: str) -> None:
    """Every folder of the large packages is a room on a floor; hardly a file lies beside them."""
    folders = {
        path.parent.name
        for path in (ROOT / package).glob("*/__init__.py")
        if not path.parent.is_symlink()  # the links of `transport/` to the other folders
    }
    assert folders == set(floors(package))
    assert len(folders) <= MOST_ROOMS
    files = {path.name for path in (ROOT / package).glob("*.py")} - {"__init__.py", "__main__.py"}
    assert len(files) <= MOST_FILES_AT_ROOT


@pytest.mark.parametrize("package", ROOMS)
def test_rooms_import_lower_floors_only(package: str) -> None:
    """No arrow between rooms of a package points up or sideways, lazy imports included."""
    floor = floors(package)
    wrong = [
        f"{named(path)} imports {named(other)}"
        for path in in_rooms(package)
        for other in modules_imported(path)
        if room_of(other, package) not in ("", room_of(path, package))
        and floor[room_of(other, package)] >= floor[room_of(path, package)]
    ]
    assert wrong == []


def public_classes(path: Path) -> list[str]:
    """Return the names of the classes of a file that others may import."""
    names = [node.name for node in tree(path).body if isinstance(node, ast.ClassDef)]
    return [name for name in names if not name.startswith("_")]


def test_folders_can_be_taken_in_at_a_glance() -> None:
    """No folder has more than 14 files."""
    files = Counter(path.parent for path in SOURCES if not path.name.startswith("__"))
    crowded = {named(folder): count for folder, count in files.items() if count > MOST_FILES}
    assert crowded == {}


def test_a_base_name_names_one_file() -> None:
    """No two files have one base name, but for the same role in different processes."""
    files = Counter(path.name for path in SOURCES if not path.name.startswith("__"))
    assert {name for name, count in files.items() if count > 1} == SAME_ROLE


def test_a_class_name_names_one_class() -> None:
    """No two public classes have one name, but for those of the Python interface that wrap the other."""
    classes = Counter(name for path in SOURCES for name in public_classes(path))
    assert {name for name, count in classes.items() if count > 1} == WRAPPED


def test_messages_and_bus_know_no_physics() -> None:
    """Messages, admission and network import nothing of `mpc` themselves.

    Messages, the gate of admission and the bus reach neither `mpc` nor `protocol/scenario`, and of
    `model` only arrays and the order of the state's numbers, through others included.
    """
    files = [
        path
        for room in ("wire", "admission", "network")
        for path in (ROOT / "protocol" / room).rglob("*.py")
    ]
    assert [named(path) for path in files if "mpc" in top(imports(path))] == []
    messages_and_bus = [
        *(ROOT / "protocol" / "wire").rglob("*.py"),
        ROOT / "protocol" / "admission" / "acceptance_and_refusals.py",
        ROOT / "protocol" / "network" / "bus.py",
    ]
    found = {named(other) for path in messages_and_bus for other in reached(path)} - WITHOUT_PHYSICS
    assert not {name for name in found if name.startswith(("model/", "mpc/", "protocol/scenario/"))}


def test_the_coordinator_has_no_control() -> None:
    """A clock and a roster: the coordinator reaches few files, none of `mpc`, and no body of `model`.

    A process joins a run and follows its coordinator without control as well.
    """
    found = {named(path) for path in reached(ROOT / "coordinator" / "node.py")}
    assert len(found) <= MOST_FILES_OF_COORDINATOR, sorted(found)
    for file in ("protocol/network/node_process.py", "protocol/admission/participant.py"):
        found |= {named(path) for path in reached(ROOT / file)}
    assert not {name for name in found - WITHOUT_PHYSICS if name.startswith(("model/", "mpc/"))}


def arrows(package: str) -> dict[str, set[str]]:
    """Return the rooms that each room of a package imports, without those that follow from others."""
    direct: dict[str, set[str]] = {room: set() for room in floors(package)}
    for path in in_rooms(package):
        own = room_of(path, package)
        direct[own] |= {room_of(other, package) for other in modules_imported(path)} - {own, ""}

    below: dict[str, set[str]] = {}
    # Lower rooms first. Rooms that import each other have no order: a CycleError that names them.
    for room in TopologicalSorter(direct).static_order():
        below[room] = direct[room].union(*(below[other] for other in direct[room]))

    return {
        room: direct[room].difference(*(below[other] for other in direct[room])) for room in direct
    }


def test_the_table_shows_the_imports() -> None:
    """The table of rooms in docs/development/architecture.md has each, with the imports that do not follow else."""
    text = (ROOT / "docs" / "development" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| `(model|mpc|agent|protocol|protocol/scenario|transport)/(\w+)` \|[^|]*\|([^|]*)\|$",
        text,
        re.MULTILINE,
    )
    written = {(package, room): set(re.findall(r"\w+", others)) for package, room, others in rows}
    found = {
        (package, room): others for package in ROOMS for room, others in arrows(package).items()
    }
    assert len(rows) == len(written)
    assert written == found


def test_no_circles() -> None:
    """No file imports itself through others, lazy imports included."""
    graph = {
        path: {file for file in modules_imported(path) if file.name != "__init__.py"}
        for path in SOURCES
    }
    assert len(list(TopologicalSorter(graph).static_order())) >= len(SOURCES)


def test_imports_run_downwards() -> None:
    """transport -> roles, deploy -> protocol -> mpc -> model.

    The three roles and deploy do not import each other, and no source imports tests, benchmarks,
    docs or examples.
    """
    wrong = []
    for path in SOURCES:
        own = named(path).partition("/")[0]
        others = top(imports(path)) - {own}
        not_below = {other for other in others & LAYERS.keys() if LAYERS[other] >= LAYERS[own]}
        foreign = others & NOT_FOR_SOURCES
        wrong += [f"{named(path)} imports {other}" for other in sorted(not_below | foreign)]
    assert wrong == []


def test_model_and_controller_are_pure() -> None:
    """model/ and mpc/ are arrays in, arrays out: none of their files imports a module of `OUTSIDE_WORLD`.

    That excludes network, clock, thread, signal, random number, file and log, but for the
    exceptions. The built-in `open` is not looked for.
    """
    assert {named(path): refused(path) for path in PURE if refused(path)} == {}


@pytest.mark.parametrize("path", NODES, ids=named)
def test_nodes_do_no_io(path: Path) -> None:
    """A node is a state machine: neither it nor a file that it reaches imports a module of `OUTSIDE_WORLD`.

    It reaches files of the project by its imports and theirs. Modules that `importlib` loads by
    name are not followed, and `EXCEPTIONS` holds here as well.
    """
    assert {named(file): refused(file) for file in reached(path) if refused(file)} == {}


@pytest.mark.parametrize("name", EXCEPTIONS)
def test_exceptions_are_needed(name: str) -> None:
    """A file that is an exception imports exactly the modules that it may."""
    assert outside_world(ROOT / name) == EXCEPTIONS[name]


def test_only_sessions_and_bus_know_zenoh() -> None:
    """Zenoh is imported in one place: its sessions, what a process does with one, and requests to it."""
    who = [named(path) for path in SOURCES if "zenoh" in top(imports(path))]
    assert who == [
        f"protocol/network/{file}.py" for file in ("bus", "requests_and_answers", "session")
    ]
