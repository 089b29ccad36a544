"""The scenario that a command is given, read and checked."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.setup import Setup
from protocol.wire.exit_codes import EXIT_SCENARIO
from transport.cli.output import fail


def read_setup(scenario: str, settings: Sequence[str] | None, *, allow_large: bool = False) -> Setup:
    """Return the setup of a scenario, file or name, with changes KEY=VALUE; end the command if it is refused.

    The run may exceed the limits of `protocol.scenario.budget` with `allow_large`.
    """
    with scenario_errors(settings):
        path = find_scenario(scenario)
        return _setup(path, tuple(settings or ()), allow_large, _file_version(path))


@contextmanager
def scenario_errors(settings: Sequence[str] | None) -> Iterator[None]:
    """End the command if a scenario is refused, naming the setting that gave the field."""
    try:
        yield
    except ScenarioError as error:
        fail(str(error.blaming(settings or [])), EXIT_SCENARIO)


def _file_version(path: Path) -> tuple[int, ...]:
    """Return numbers that change when a file is rewritten; none if it cannot be read."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_ino, found.st_size, found.st_mtime_ns


@lru_cache(maxsize=1)
def _setup(path: Path, settings: tuple[str, ...], allow_large: bool, _: tuple[int, ...]) -> Setup:
    """Read a setup; cached until the file is rewritten, as the fork server reads it for all processes of a run."""
    return Setup.of(read_scenario(path, settings, allow_large=allow_large), str(path))
