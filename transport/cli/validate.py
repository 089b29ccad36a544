"""The command `transport validate`."""

import tomli_w
import typer

from transport.cli.options import FormatOption, ScenarioArgument, SetOption
from transport.cli.output import Format, show_json
from transport.cli.scenario_setup import read_setup


def validate(scenario: ScenarioArgument, settings: SetOption = None, output: FormatOption = Format.text) -> None:
    """Check a scenario and print it with every default.

    Example: transport validate paper --set controller.horizon=10
    """
    setup = read_setup(scenario, settings)
    doubts = list(setup.doubts())
    if output is Format.json:
        show_json({"scenario": setup.scenario.tree(), "digest": setup.scenario.digest(), "warnings": doubts})
        return
    typer.echo(tomli_w.dumps(setup.scenario.tree()), nl=False)
    for doubt in doubts:
        typer.echo(f"warning: {doubt}", err=True)
    hover = ", ".join(f"{thrust:.2f}" for thrust in setup.hover.u[::4])
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, {setup.ticks} ticks"
    typer.echo(f"valid: {sizes}, hover thrust {hover} N, digest {setup.scenario.digest()}", err=True)
