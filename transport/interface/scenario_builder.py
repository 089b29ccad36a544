"""Scenario as an object that stays valid: a change is checked as a whole, and made or refused."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import tomli_w
from pydantic import BaseModel

from transport.interface.setting_arguments import (
    ArgumentError,
    Settings,
    ShortSettings,
    key_of,
    settings_of,
)
from transport.protocol.scenario.scenario_file import find_scenario, read_tree, with_settings
from transport.protocol.scenario.sections.scenario_errors import ScenarioError, hint
from transport.protocol.scenario.sections.scenario_keys import names_of
from transport.protocol.scenario.sections.schema import Scenario as ValidatedScenario
from transport.protocol.scenario.sections.sources_of_values import Origin
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import Team, given_values, resized

_LONGEST_RAMP_S = 3.0  # at the ends of a path with a flat reference


class ScenarioPart:
    """A section of a scenario.

    Reading an attribute reads the value, setting one changes the scenario.
    """

    _owner: "Scenario"
    _key: str

    def __init__(self, owner: "Scenario", key: str) -> None:
        self._owner = owner
        self._key = key

    @property
    def _data(self) -> Any:
        """The section as the model has it."""
        return self._owner._value(self._key)

    def _key_of(self, name: str) -> str:
        """Return the dotted key of an attribute."""
        return f"{self._key}.{name}".lstrip(".")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self._owner._shown(self._key_of(name))
        except ScenarioError as error:
            raise AttributeError(str(error)) from None

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_"):
            object.__setattr__(self, name, value)
        else:
            self._owner[self._key_of(name)] = value

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *names_of(type(self._data))]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ScenarioPart) and self._data == other._data

    __hash__ = None  # type: ignore[assignment]  # it changes

    def __repr__(self) -> str:
        return repr(self._data)


class Scenario(ScenarioPart):
    """A scenario that can be changed and is valid at any time.

    A change that would make an impossible scenario raises `ScenarioError` and leaves the scenario
    as it was. Sections are attributes, list entries count from 0; dotted keys count list entries
    from 1, as on the command line.

    >>> from transport import Scenario
    >>> scenario = Scenario("resilient", horizon=10)
    >>> scenario.links.delay_s = 0.2
    >>> scenario["controller.horizon"], scenario.links.delay_s
    (10, 0.2)
    >>> scenario.links.loss = 1.5
    Traceback (most recent call last):
        ...
    transport.protocol.scenario.sections.scenario_errors.ScenarioError: links.loss=1.5: expected less than or \
equal to 1, got 1.5
    >>> scenario.links.loss
    0.0
    >>> scenario.resized(6)
    Scenario('resilient-6': 6 UAVs, 6 agents, 25 s)

    The source is a scenario file, the name of one that comes with the package, or another scenario;
    changes are those of `fly`. With `allow_large` runs may exceed the limits of
    `transport validate`.

    Raises: ScenarioError: naming file or setting, field, expected, got. ArgumentError: an argument
        is refused.
    """

    _path: Path
    _validated: ValidatedScenario
    _setup: Setup
    _allow_large: bool
    _origins: tuple[Origin, ...]  # of values that are not those of the file

    def __init__(
        self,
        source: "str | PathLike[str] | Scenario" = "paper",
        settings: Settings | None = None,
        *,
        allow_large: bool = False,
        **short: Unpack[ShortSettings],
    ) -> None:
        super().__init__(self, "")
        changes = settings_of(settings, short)
        if isinstance(source, Scenario):
            self._path = source._path
            self._validated = source._validated
            self._setup = source._setup
            self._allow_large = allow_large or source._allow_large
            self._origins = source._origins
            if changes:
                self._change(given_values(self._validated), changes)
        else:
            self._path = find_scenario(str(source))
            self._allow_large = allow_large
            self._origins = ()
            self._change(read_tree(self._path), changes)

    def set(self, settings: Settings | None = None, **short: Unpack[ShortSettings]) -> None:
        """Make several changes at once, such as those that are valid only together."""
        self._change(given_values(self._validated), settings_of(settings, short))

    def __getitem__(self, key: str) -> Any:
        """Return the value of a dotted key or short name."""
        return self._shown(key_of(key))

    def __setitem__(self, key: str, value: Any) -> None:
        """Change the value of a dotted key or short name."""
        self.set({key: value})

    def __repr__(self) -> str:
        N = self._setup.system.N
        agents = len(self._setup.agents)
        sizes = f"{N} UAV{'s' * (N > 1)}, {agents} agent{'s' * (agents > 1)}"
        return f"Scenario({self._validated.name!r}: {sizes}, {self._setup.maneuver.duration_s:g} s)"

    @property
    def file(self) -> Path:
        """File that the scenario was read from; its folder is that of relative paths."""
        return self._path

    @property
    def setup(self) -> Setup:
        """The objects built from the scenario: system, hover, maneuver, controller settings."""
        return self._setup

    @property
    def validated(self) -> ValidatedScenario:
        """The scenario as a frozen pydantic model."""
        return self._validated

    def tree(self) -> dict[str, Any]:
        """Return the scenario as plain data with every default."""
        return self._validated.tree()

    def digest(self) -> str:
        """Return the fingerprint that `transport validate` prints."""
        return self._validated.digest()

    def __copy__(self) -> "Scenario":
        return Scenario(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> "Scenario":
        return Scenario(self)  # its parts never change: a change of a scenario replaces them

    def copy(self, settings: Settings | None = None, **short: Unpack[ShortSettings]) -> "Scenario":
        """Return a copy with changes."""
        return Scenario(self, settings, **short)

    def resized(
        self,
        uavs: int,
        *,
        group: int | None = None,
        name: str | None = None,
        vehicle: "str | PathLike[str] | None" = None,
        load_kg: float | None = None,
    ) -> "Scenario":
        """Return the scenario of a team of another size, in a ring.

        UAVs and their distance are those of `vehicle`, or else of this scenario, whose UAVs have to
        be equal then. The payload is `load_kg`, by default half the mass of the UAVs. An agent owns
        `group` UAVs, by default as many as the first one here. All other keys stay.

        >>> import transport
        >>> transport.team(4, vehicle="racing").resized(6).system.uav[5].mass_kg
        0.752
        """
        chosen = None if vehicle is None else str(vehicle)
        try:
            team = Team(uavs=uavs, group=group, name=name, vehicle=chosen, load_kg=load_kg)
        except ValueError as error:
            raise ArgumentError(str(error)) from error

        scenario = resized(self._validated, team, str(self._path), self._origins)
        made = Scenario(self)
        try:
            made._become(given_values(scenario), [])
        except ScenarioError as error:
            raise team.with_source(error, self._origins) from error.__cause__
        made._origins = team.origins(self._origins)
        return made

    def save(self, path: "str | PathLike[str]") -> Path:
        """Write the scenario, with every default, to a new file; return its path.

        The file serves in any folder: tables that the scenario named, such as measured delays, are
        in it as numbers. Own classes and `network.keys` stay names, looked up from the current
        folder.
        """
        with Path(path).open("x", encoding="utf-8") as file:
            file.write(tomli_w.dumps(self.tree()))
        return Path(path)

    def _value(self, key: str) -> Any:
        """Return the value of a dotted key as the model has it.

        An empty key is that of the scenario itself.
        """
        value: Any = self._validated
        for part in filter(None, key.split(".")):
            parts = _parts(value)
            if part not in parts:
                raise ScenarioError(str(self._path), key, f"unknown key; {hint(part, parts)}")
            value = parts[part]
        return value

    def _shown(self, key: str) -> Any:
        """Return a value as the user gets it.

        It is a section, a plain value, or a tuple for a list, which cannot be changed.
        """
        value = self._value(key)
        if isinstance(value, BaseModel):
            return ScenarioPart(self, key)
        if isinstance(value, list | tuple):
            return tuple(self._shown(f"{key}.{number}") for number in range(1, len(value) + 1))
        return value

    def _change(self, given: dict[str, Any], changes: list[str]) -> None:
        """Become the scenario of given values with changes, or stay as it is if that is refused.

        Errors name the changes.
        """
        try:
            self._become(given, changes)
        except ScenarioError as error:
            # The error names the file, so a given value is at fault, perhaps of a vehicle or load.
            if error.source == str(self._path):
                error = error.traced(self._origins)
            raise error.blaming(changes) from error.__cause__

    def _become(self, given: dict[str, Any], changes: list[str]) -> None:
        """Become the scenario of given values with changes; a refusal leaves it as it is."""
        source = str(self._path)
        scenario = with_settings(given, changes, source, allow_large=self._allow_large)
        self._setup = Setup.of(scenario, source)
        self._validated = scenario


def _parts(value: Any) -> dict[str, Any]:
    """Return the entries of a section by name, or of a list by number from 1.

    A plain value has none.
    """
    if isinstance(value, list | tuple):
        return {str(number): entry for number, entry in enumerate(value, start=1)}
    if isinstance(value, BaseModel):
        return {name: getattr(value, field) for name, field in names_of(type(value)).items()}
    return {}


def team(
    uavs: int = 4,
    *,
    vehicle: "str | PathLike[str] | None" = None,
    load_kg: float | None = None,
    base: "str | PathLike[str] | Scenario" = "resilient",
    settings: Settings | None = None,
    **short: Unpack[ShortSettings],
) -> Scenario:
    """Return the scenario of a team of UAVs in a ring over a load.

    >>> import transport
    >>> transport.team(4, vehicle="x500", load_kg=3)
    Scenario('resilient-x500-4': 4 UAVs, 4 agents, 25 s)

    The vehicle is a file, or crazyflie, x500, racing; by default UAVs and their distance are those
    of the base, the paper's in `resilient`. The payload has by default half the mass of the UAVs.
    The base has all other keys: maneuver, controller, network; changes are those of `fly`.

    Raises: ScenarioError: the scenario or a setting is refused. ArgumentError: an argument is.
    """
    made = Scenario(base).resized(uavs, vehicle=vehicle, load_kg=load_kg)
    return made.copy(settings, **short)


def path_phase(path: Sequence[Sequence[float]], *, flat: bool) -> dict[str, Any]:
    """Return the phase of a maneuver along rows of time and position, (t_s, x_m, y_m, z_m).

    Times and positions count from the first row. Between rows the speed is constant. A flat
    reference (`maneuver.reference`) needs a smooth path: with `flat` the phase is a spline through
    the rows.
    """
    try:
        rows = np.asarray(path, dtype=np.float64)
    except (TypeError, ValueError):
        rows = np.zeros(0)
    if rows.ndim != 2 or rows.shape[1] != 4 or len(rows) < 2:
        raise ArgumentError(
            f"path: expected two or more rows of t_s, x_m, y_m, z_m, got {path!r:.60}"
        )

    way = rows - rows[0]
    if not flat:
        return {"name": "path", "way": way.tolist()}

    times_s = way[1:, 0].tolist()
    return {
        "name": "path",
        "kind": "spline",
        "points_m": way[1:, 1:].tolist(),
        "times_s": times_s,
        "ramp_s": min(_LONGEST_RAMP_S, times_s[-1] / 2.0),
    }
