"""Running, recording, analysing and showing runs of the project.

The names of the Python interface (docs/python.md) are imported when they are first used, so that
the command line does not wait for them.
"""

from importlib import import_module

TYPE_CHECKING = False  # as `typing` has it, whose import the command does without at its start
if TYPE_CHECKING:
    from transport.agent.user_class.returned_values import Step as Step
    from transport.experiments.cases import ExperimentError as ExperimentError
    from transport.flight.local_processes import HarnessError as HarnessError
    from transport.flight.run_files import RunError as RunError
    from transport.interface.arena_result import Arena as Arena
    from transport.interface.arena_result import arena as arena
    from transport.interface.figure import Margins as Margins
    from transport.interface.figure import margins as margins
    from transport.interface.fly import ActiveRun as ActiveRun
    from transport.interface.fly import active as active
    from transport.interface.fly import fly as fly
    from transport.interface.fly import load as load
    from transport.interface.recorded_run import Run as Run
    from transport.interface.run_series import RunSeries as RunSeries
    from transport.interface.scenario_builder import Scenario as Scenario
    from transport.interface.scenario_builder import team as team
    from transport.interface.setting_arguments import ArgumentError as ArgumentError
    from transport.interface.swept_runs import Sweep as Sweep
    from transport.interface.swept_runs import sweep as sweep
    from transport.interface.worst_case import Worst as Worst
    from transport.interface.worst_case import worst as worst
    from transport.log.run_log import LogError as LogError
    from transport.protocol.scenario.sections.scenario_errors import ScenarioError as ScenarioError
    from transport.protocol.wire.errors_and_exit_codes import TransportError as TransportError
    from transport.viewer.server import ViewerError as ViewerError

# Names of the Python interface by module.
_NAMES = {
    "transport.interface.fly": ("fly", "load", "active", "ActiveRun"),
    "transport.interface.swept_runs": ("sweep", "Sweep"),
    "transport.interface.worst_case": ("worst", "Worst"),
    "transport.interface.arena_result": ("arena", "Arena"),
    "transport.interface.figure": ("margins", "Margins"),
    "transport.interface.scenario_builder": ("team", "Scenario"),
    "transport.interface.recorded_run": ("Run",),
    "transport.interface.run_series": ("RunSeries",),
    "transport.protocol.wire.errors_and_exit_codes": ("TransportError",),
    "transport.interface.setting_arguments": ("ArgumentError",),
    "transport.protocol.scenario.sections.scenario_errors": ("ScenarioError",),
    "transport.flight.run_files": ("RunError",),
    "transport.flight.local_processes": ("HarnessError",),
    "transport.experiments.cases": ("ExperimentError",),
    "transport.log.run_log": ("LogError",),
    "transport.viewer.server": ("ViewerError",),
    "transport.agent.user_class.returned_values": ("Step",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = list(_MODULES)  # a type checker reads the imports above


def __getattr__(name: str) -> object:
    """Return a name of the Python interface, importing its module."""
    if name not in _MODULES:
        raise AttributeError(f"module 'transport' has no attribute {name!r}")
    found = getattr(import_module(_MODULES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
