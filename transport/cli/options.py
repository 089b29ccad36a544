"""Options that several commands have, each defined once."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_origin

from typer import Argument, Option

from transport.cli.output import Format


def _scenarios(incomplete: str) -> list[str]:
    """Return the ready-made scenarios that begin like an incomplete word, for the shell, which adds files itself."""
    folder = Path(__file__).resolve().parents[2] / "scenarios"
    return sorted(path.stem for path in folder.glob("*.toml") if path.stem.startswith(incomplete))


# Runs are recorded here, and an active run is looked for here, unless an option names another folder.
RUNS = Path("runs")

ScenarioArgument = Annotated[
    str,
    Argument(
        metavar="SCENARIO",
        help="Scenario file, or name: paper, centralized, resilient, precise, centralized_lq, windy, delivery, "
        "collision, eight, gap, playground.",
        autocompletion=_scenarios,
        show_default=True,
    ),
]
ScenarioOption = Annotated[
    str,
    Option(
        "--scenario",
        metavar="SCENARIO",
        help="Scenario file or name; the same for all processes.",
        autocompletion=_scenarios,
    ),
]
SetOption = Annotated[
    list[str] | None,
    Option("--set", metavar="KEY=VALUE", help="Change a scenario value, e.g. controller.horizon=10. Repeatable."),
]
LargeOption = Annotated[
    bool, Option("--allow-large", help="Accept a run beyond the limits on size, memory, log and computation.")
]
FormatOption = Annotated[Format, Option("--format", metavar="FORMAT", help="Output format: text or json.")]
FiguresOption = Annotated[bool, Option("--figures/--no-figures", help="Draw the figures.")]
HostOption = Annotated[
    str,
    Option(
        "--host", metavar="ADDRESS", help="Address to listen on. Any host that reaches it can view and change the run."
    ),
]
PortOption = Annotated[int, Option("--port", metavar="PORT", min=0, max=65535, help="Port, or the next free one.")]


def with_options(*options: Callable[..., Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that gives a command shared options, after its own.

    The annotated parameters of all `options` become options, and their results the first arguments of the command.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = list(inspect.signature(command).parameters.values())[len(options) :]
        shared = [
            {name: parameter for name, parameter in every.items() if get_origin(parameter.annotation) is Annotated}
            for every in (inspect.signature(option).parameters for option in options)
        ]

        @wraps(command)
        def with_shared(**given: Any) -> None:
            made = [{name: given.pop(name) for name in names} for names in shared]
            command(*(option(**values) for option, values in zip(options, made, strict=True)), **given)

        parameters = [*own, *(parameter for of in shared for parameter in of.values())]
        with_shared.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_shared.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return with_shared

    return decorate
