"""Running, recording, analysing and showing runs of the project. Import fails if another file hides a package.

The names of the Python interface (docs/python.md) are imported when they are first used, so that the command line does
not wait for them.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from protocol.scenario.errors import ScenarioError as ScenarioError
    from protocol.wire.errors import TransportError as TransportError
    from transport.experiments.cases import ExperimentError as ExperimentError
    from transport.flight.harness import HarnessError as HarnessError
    from transport.flight.run_files import RunError as RunError
    from transport.interface.figure import Margins as Margins
    from transport.interface.figure import margins as margins
    from transport.interface.fly import ActiveRun as ActiveRun
    from transport.interface.fly import active as active
    from transport.interface.fly import fly as fly
    from transport.interface.fly import load as load
    from transport.interface.run import Run as Run
    from transport.interface.scenario import Scenario as Scenario
    from transport.interface.scenario import team as team
    from transport.interface.series import RunSeries as RunSeries
    from transport.interface.settings import ArgumentError as ArgumentError
    from transport.interface.sweep import Sweep as Sweep
    from transport.interface.sweep import sweep as sweep
    from transport.log.run_log import LogError as LogError
    from transport.viewer.server import ViewerError as ViewerError

# Names of the Python interface by module.
_NAMES = {
    "transport.interface.fly": ("fly", "load", "active", "ActiveRun"),
    "transport.interface.sweep": ("sweep", "Sweep"),
    "transport.interface.figure": ("margins", "Margins"),
    "transport.interface.scenario": ("team", "Scenario"),
    "transport.interface.run": ("Run",),
    "transport.interface.series": ("RunSeries",),
    "protocol.wire.errors": ("TransportError",),
    "transport.interface.settings": ("ArgumentError",),
    "protocol.scenario.errors": ("ScenarioError",),
    "transport.flight.run_files": ("RunError",),
    "transport.flight.harness": ("HarnessError",),
    "transport.experiments.cases": ("ExperimentError",),
    "transport.log.run_log": ("LogError",),
    "transport.viewer.server": ("ViewerError",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = list(_MODULES)  # a type checker reads the imports above

_HERE = Path(__file__).resolve().parent.parent


for _name in ("model", "mpc", "protocol", "agent", "plant", "coordinator", "deploy", "scenarios"):
    _spec = find_spec(_name)
    if _spec is not None:  # otherwise the first import says so
        _found = Path(_spec.origin or next(iter(_spec.submodule_search_locations or ("",)))).resolve()
        if _found != _HERE / _name / "__init__.py":
            _hint = "rename it, or start from another folder"
            raise ImportError(f"payload-transport: {_found} hides its package {_name!r}: {_hint}")


def __getattr__(name: str) -> Any:
    """Return a name of the Python interface, importing its module."""
    if name not in _MODULES:
        raise AttributeError(f"module 'transport' has no attribute {name!r}")
    found = getattr(import_module(_MODULES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
