"""The commands about scenarios: `transport scenario new`, `validate`, `margins` and `doctor`."""

import math
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tomli_w
import typer
from typer import Argument, Option

from protocol.scenario.budget import check_budget, estimate
from protocol.scenario.file import ScenarioError, find_scenario, read_scenario
from protocol.scenario.schema import Scenario
from protocol.scenario.setup import Setup
from protocol.scenario.team import FEWEST, MOST, given, read_vehicle, resized
from protocol.wire.exit_codes import EXIT_CHECK_FAILED
from transport.cli.options import FormatOption, LargeOption, ScenarioArgument, SetOption, read_setup
from transport.cli.output import Format, blame, fail, rows, show
from transport.flight.header import checked

# Number of UAVs beyond which a user should know that the model takes long to build.
_LONG = 48


def new(
    uavs: int = Option(..., metavar="COUNT", help="Number of UAVs, 2 to 256."),
    template: str = Option(
        "resilient", "--from", metavar="SCENARIO", help="Scenario file or name for all but the system."
    ),
    group: int | None = Option(None, "--groups", metavar="COUNT", help="UAVs per agent; by default as in --from."),
    vehicle: str | None = Option(
        None, metavar="NAME", help="crazyflie, x500, racing or a vehicle file; default: the paper's."
    ),
    load_kg: float | None = Option(
        None, "--load", metavar="KG", help="Payload mass; by default half the mass of the UAVs."
    ),
    name: str | None = Option(None, metavar="NAME", help="Name; by default from --from, --vehicle and --uavs."),
    out: Path | None = Option(None, metavar="FILE", help="File to write; by default standard output."),
    output: FormatOption = Format.text,
) -> None:
    """Write a scenario for a team of any size.

    UAVs in a ring. By default they are the paper's, 0.5 m apart, with 0.75 kg of payload for each. A vehicle brings its
    mass, inertia, rod, limits, motors and inner loop: docs/vehicles.md.

    Example: transport scenario new --uavs 4 --vehicle x500 --load 3.0 --out four.toml
    """
    if not FEWEST <= uavs <= MOST:
        why = ": a payload on one rod rotates freely about it, and no input can control that" if uavs == 1 else ""
        fail(f"--uavs: expected {FEWEST} to {MOST}, got {uavs}{why}")
    if group is not None and not 1 <= group <= uavs:
        fail(f"--groups: expected 1 to {uavs} UAVs per agent, got {group}")
    if load_kg is not None and not 0.0 < load_kg < math.inf:
        fail(f"--load: expected a number > 0 kg, got {load_kg}")
    if vehicle is not None:
        with blame("--vehicle"):
            read_vehicle(vehicle)
    if out is not None and out.exists():
        fail(f"--out: expected a file that does not exist yet, got {out}")
    with blame("--from"):
        path = find_scenario(template)
        ready = read_scenario(path, allow_large=True)
    source = f"--from {template}"
    if uavs > _LONG:
        typer.echo(f"checking the model of {uavs} UAVs: this takes minutes", err=True)
    try:
        scenario = resized(
            ready, path.parent, uavs, group=group, name=name, source=source, vehicle=vehicle, load_kg=load_kg
        )
    except ScenarioError as error:
        if error.field == "name":
            fail(f"--name: {error.problem}")
        raise
    setup = Setup.of(scenario, source)
    options = {"--uavs": uavs, "--from": template, "--groups": group, "--vehicle": vehicle, "--load": load_kg}
    words = [str(word) for option, value in (options | {"--name": name}).items() if value for word in (option, value)]
    comment = [
        f"Made by: {shlex.join(['transport', 'scenario', 'new', *words])}",
        f"{uavs} UAVs in a ring over a payload that fits; all but [system], owned and name is from {ready.name}.",
        *([f"Mass, inertia, rods, limits, inner loop and motors are from the vehicle {vehicle}."] if vehicle else []),
    ]
    text = scenario_text(given(scenario), comment)
    content = {"scenario": given(scenario), "file": None if out is None else str(out)}
    show(output, content, *([text.rstrip("\n")] if out is None else []))
    if out is None:
        return
    with blame("--out"):
        out.write_text(text, encoding="utf-8")
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, hover thrust {setup.hover.u[0]:.2f} N"
    large = "" if _is_within_limits(scenario) else " --allow-large"
    typer.echo(f"{sizes}; run it with: transport run {shlex.quote(str(out))}{large}", err=True)


def _is_within_limits(scenario: Scenario) -> bool:
    """Return whether a run of the scenario is accepted without --allow-large."""
    try:
        check_budget(scenario, "")
    except ScenarioError:
        return False
    return True


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
    classes, tree, digest = checked(setup), setup.scenario.tree(), setup.scenario.digest()
    show(output, {"scenario": tree, "digest": digest}, tomli_w.dumps(tree).rstrip("\n"))
    if output is Format.json:
        return
    hover = ", ".join(f"{thrust:.2f}" for thrust in setup.hover.u[::4])
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, {setup.ticks} ticks"
    own = "".join(f", {what} {name}" for what, name in classes.items() if name != "mpc")
    typer.echo(f"valid: {sizes}, hover thrust {hover} N, digest {digest}{own}", err=True)
    typer.echo(f"estimate: {estimate(setup.scenario).text()}", err=True)


def margins(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    figure: Path | None = Option(None, metavar="FILE", help="Draw the ranges; the ending is the format."),
    without: str | None = Option(None, metavar="AGENTS", help="Agents that are gone for good, such as 1,2."),
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Compute how much model error a hover tolerates.

    Analyses the sampled loop about hover: actuator lag, delay and gain, masses, inertias and rods up to which the hover
    is stable, the others as known. Factors are relative to the known value. Takes seconds. With --without the
    team that is left holds the payload if all deviations decay.

    Example: transport margins resilient --set controller.sampling_period_s=0.02 --figure margins.png
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    from transport.report import margins as report
    from transport.report.style import RC

    setup = read_setup(scenario, settings, allow_large=large)
    absent = [agent.strip() for agent in without.split(",")] if without else []
    if not all(map(str.isdecimal, absent)):
        fail(f"--without: expected agents such as 1,2, got {without!r:.60}")
    found = report.hover_margins(setup, [int(agent) for agent in absent])
    names = ("property", *report.ACTUATIONS)
    show(output, asdict(found), rows([dict(zip(names, row, strict=True)) for row in report.rows(found)], *names))
    if output is Format.text:
        for note in report.notes(found):
            typer.echo(f"warning: {note}", err=True)
    if figure is not None:
        with blame("--figure", ValueError), mpl.rc_context(RC):
            drawing = Figure()
            report.draw(found, drawing)
            drawing.savefig(figure)


_COLOURS = {"ok": "green", "warn": "yellow", "fail": "bold red"}


def doctor(
    scenario: str = Argument("paper", metavar="SCENARIO", help="File or name of the scenario that is to run here."),
    settings: SetOption = None,
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Check that this machine can run a scenario.

    Checks Python, packages, ports, network, clock, processors and limits. Each result is ok, warn (runs work, but
    slower or less punctually) or fail (runs do not work), with advice. Takes a few seconds and changes nothing.

    Exit codes: 0 no check failed, 9 a check failed, 3 scenario.

    Example: transport doctor resilient --set clock.mode=realtime --set clock.speed=1
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from transport.doctor.checks import checks

    setup = read_setup(scenario, settings, allow_large=large)
    content, count, console = [], Counter[str](), Console()
    for name, finding in checks(setup):
        content.append({"name": name, **finding._asdict()})
        count[finding.status] += 1
        if output is Format.text:  # at once: a check may take seconds
            grid = Table.grid(padding=(0, 1))
            grid.add_column(width=4)
            grid.add_column(width=12)
            grid.add_row(Text(finding.status, _COLOURS[finding.status]), Text(name, "cyan"), Text(finding.found))
            if finding.advice:
                grid.add_row("", "", Text(f"-> {finding.advice}"))
            console.print(grid)
    result = {"scenario": setup.scenario.name, "ok": not count["fail"], "checks": content}
    show(output, result, f"{len(content)} checks: {count['fail']} fail, {count['warn']} warn")
    if count["fail"]:
        raise typer.Exit(EXIT_CHECK_FAILED)


def scenario_text(tree: dict[str, Any], comment: Sequence[str]) -> str:
    """Return a scenario in TOML.

    Args:
        tree: The scenario as plain data; its keys are bare words.
        comment: Lines for the top; TOML forbids most unprintable characters, so each becomes a question mark.
    """
    top = ["# " + "".join(c if c.isprintable() else "?" for c in line) for line in comment]
    return "\n".join([*top, *_table(tree, ""), ""])


def _table(tree: dict[str, Any], path: str) -> Iterator[str]:
    """Yield the lines of a table: its values first, as everything after a heading belongs to that heading."""
    tables: list[tuple[str, str, dict[str, Any]]] = []
    for key, value in tree.items():
        name = path + key
        if isinstance(value, dict):
            tables.append((f"[{name}]", name, value))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            tables += [(f"[[{name}]]", name, entry) for entry in value]
        else:
            yield f"{key} = {_value(value)}"
    for heading, name, table in tables:
        yield from ("", heading)
        yield from _table(table, f"{name}.")


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    return tomli_w.dumps({"_": value}).removeprefix("_ = ").rstrip("\n")
