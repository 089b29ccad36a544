"""Folder and secret of a run before it begins, and the metadata of its log."""

import os
import platform
import re
import secrets
import shutil
import sys
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import psutil
import tomli_w

from transport.flight.roles import plant_run
from transport.log.run_folder import LATEST, point_latest
from transport.model.kernels import native
from transport.plant.engines import checked_engine
from transport.protocol.network.security import SHARED
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.protocol.scenario.radio.radio_parameters import is_class
from transport.protocol.scenario.sections.schema import Scenario
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.wire.errors_and_exit_codes import EXIT_SCENARIO, EXIT_USAGE, TransportError
from transport.protocol.wire.names import PLANT, agent_name


class RunError(TransportError, RuntimeError):
    """A run that could not be started or recorded.

    The text is one line for the user; the command ends with the exit code.
    """

    def __init__(self, text: str, exit_code: int) -> None:
        super().__init__(text)
        self.exit_code = exit_code


def existing(folder: Path) -> RunError:
    """Return the error of a run folder that exists."""
    return RunError(f"expected a folder that does not exist yet, got {folder}", EXIT_USAGE)


def create(folder: Path, setup: Setup) -> str:
    """Create the run folder with the resolved scenario; return its text, or raise RunError."""
    text = tomli_w.dumps(setup.scenario.tree())
    try:
        str(folder).encode()  # Zenoh and TOML take UTF-8 only
        folder.mkdir(parents=True)
    except FileExistsError as error:
        raise existing(folder) from error
    except (OSError, ValueError) as error:
        raise _not_created(folder, error) from error

    try:
        write_whole(folder / "scenario.toml", text)
        point_latest(folder)
    except OSError as error:
        discard(folder)
        raise _not_created(folder, error) from error
    except BaseException:  # an interrupt
        discard(folder)
        raise
    return text


def _not_created(folder: Path, error: Exception) -> RunError:
    """Return the error of a run folder that cannot be created."""
    reason = getattr(error, "strerror", None) or error
    return RunError(f"cannot create the folder {str(folder)!r} ({reason})", EXIT_USAGE)


def discard(folder: Path) -> None:
    """Remove a run folder; the link to the most recent run then leads to the one before."""
    shutil.rmtree(folder, ignore_errors=True)

    link = folder.parent / LATEST
    with suppress(OSError):
        if link.readlink() == Path(folder.name):
            link.unlink()
            logs = list(folder.parent.glob("*/run.mcap"))
            newest = max(logs, key=lambda log: log.stat().st_mtime_ns, default=None)
            if newest is not None:
                point_latest(newest.parent)


@dataclass(slots=True)
class NewFolder:
    """A run folder in the making."""

    path: Path
    scenario_toml: str  # text of the resolved scenario
    is_kept: bool = False  # whether the folder stays


@contextmanager
def new_run_folder(folder: Path, setup: Setup) -> Iterator[NewFolder]:
    """Create a run folder and remove it in the end unless it is kept.

    A start that fails leaves none.
    Raises: RunError.
    """
    made = NewFolder(folder, create(folder, setup))
    try:
        yield made
    finally:
        if not made.is_kept:
            discard(folder)


@contextmanager
def own_keys(scenario: Scenario, folder: Path) -> Iterator[Path | None]:
    """Make the secret of a run in its folder.

    None where other keys protect the run, or it is to be open.
    Raises: RunError: the secret cannot be written, or all could read it.
    """
    network = scenario.network
    if network.keys is not None or network.router is not None or not network.secret:
        yield None
        return

    keys = folder.resolve() / "keys"
    file = keys / SHARED
    with _told_as_run_error(file):
        keys.mkdir(mode=0o700)
    try:
        with _told_as_run_error(file):
            file.touch(mode=0o600)
            if file.stat().st_mode & 0o077:
                raise _readable_by_all(file)
            file.write_text(f"run:{secrets.token_hex(24)}\n", encoding="utf-8")
        yield keys
    finally:
        with suppress(OSError):
            file.unlink(missing_ok=True)
            keys.rmdir()


@contextmanager
def _told_as_run_error(file: Path) -> Iterator[None]:
    """Turn an OSError about a file of the run's secret into a RunError."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise RunError(f"cannot write the secret {str(file)!r} ({reason})", EXIT_USAGE) from error


def _readable_by_all(file: Path) -> RunError:
    """Return the error of a file system that keeps no permissions (FAT, some shares)."""
    problem = f"network.secret: expected a file that only its owner can read, got {file} for all"
    remedy = "use another folder, or --set network.secret=false: open to every local process"
    return RunError(f"{problem}; {remedy}", EXIT_SCENARIO)


def run_header(
    setup: Setup, run: str, processes: int, scenario_toml: str, classes: Mapping[str, str]
) -> Mapping[str, str]:
    """Return the metadata of a run's log.

    `classes` are engine and controller with their versions, as far as known.
    """
    return {
        "run_id": run,
        "scenario": scenario_toml,
        "seed": str(setup.scenario.seed),
        "processes": str(processes),
        "versions": versions(),
        **classes,
        "machine": machine(),
        "command_started_ns": str(started_ns()),
    }


def started_ns() -> int:
    """Return the time at which this process started, ns since 1970, to 10 ms."""
    started_s: float = psutil.Process().create_time()
    if sys.platform == "linux":
        # It is counted from the start of the system, which psutil knows to a second.
        system_s = time.time() - time.clock_gettime(time.CLOCK_BOOTTIME)
        started_s += system_s - psutil.boot_time()
    return round(started_s * 1e9)


def checked(setup: Setup, external: Collection[str] = ()) -> dict[str, str]:
    """Return names and versions of engine and controller of a run after making each once.

    Raises: ScenarioError: one of them cannot be made.
    """
    controller = ", ".join(dict.fromkeys(setup.scenario.controllers))
    if all(agent_name(agent) in external for agent in setup.agents):
        controller = "external"
    elif any(map(is_class, setup.scenario.controllers)):
        # Imports all of an agent, which this process does not need otherwise.
        from transport.agent.user_class.user_controllers import checked_controller

        controller = checked_controller(setup.run)
    return {
        "engine": "external" if PLANT in external else checked_engine(plant_run(setup)),
        "controller": controller,
    }


def versions() -> str:
    """Return the versions of Python, packages and kernels that results depend on, in one line."""
    packages = ("payload-transport", "numpy", "casadi", "daqp", "clarabel", "eclipse-zenoh")
    parts = [f"python {platform.python_version()}"]
    parts += [f"{package} {version(package)}" for package in packages]
    parts.append(f"kernels {native.description()}")
    return ", ".join(parts)


def machine() -> str:
    """Return the machine in one line: processor, cores this process may use, system."""
    processor = platform.processor() or platform.machine()
    with suppress(OSError):
        cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8")
        names = re.findall(r"model name\s*: (.*)", cpuinfo)
        processor = names[0] if names else processor

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    unit = "core" if cores == 1 else "cores"
    return f"{processor}, {cores} {unit}, {platform.system()} {platform.release()}"
