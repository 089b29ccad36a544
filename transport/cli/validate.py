"""The command `transport validate`."""

import tomli_w
import typer

from plant.trial import tried_engine
from protocol.scenario.budget import estimate
from transport.cli.options import FormatOption, LargeOption, ScenarioArgument, SetOption
from transport.cli.output import Format, show_json
from transport.cli.scenario_setup import read_setup, scenario_errors


def validate(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Check a scenario and print it with every default.

    Prints an estimate of memory, log size and processor time on standard error.

    Example: transport validate paper --set controller.horizon=10
    """
    setup = read_setup(scenario, settings, allow_large=large)
    with scenario_errors(settings):
        engine = tried_engine(setup)
    doubts = list(setup.doubts())
    if output is Format.json:
        show_json({"scenario": setup.scenario.tree(), "digest": setup.scenario.digest(), "warnings": doubts})
        return
    typer.echo(tomli_w.dumps(setup.scenario.tree()), nl=False)
    for doubt in doubts:
        typer.echo(f"warning: {doubt}", err=True)
    hover = ", ".join(f"{thrust:.2f}" for thrust in setup.hover.u[::4])
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, {setup.ticks} ticks"
    about = f"{sizes}, hover thrust {hover} N, digest {setup.scenario.digest()}"
    typer.echo(f"valid: {about}, engine {engine}", err=True)
    typer.echo(f"estimate: {estimate(setup.scenario).text()}", err=True)
