"""Commands about scenarios: `transport scenario new`, `validate`, `margins` and `doctor`."""

import math
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path

import numpy as np
import tomli_w
import typer
from typer import Argument, Option

from transport.agent.user_class.user_controllers import plan_shapes
from transport.cli.options import FormatOption, LargeOption, ScenarioArgument, SetOption, read_setup
from transport.cli.output import Format, blame, fail, show
from transport.flight.run_files import checked
from transport.interface.scenario_builder import Scenario
from transport.model.state import INPUTS
from transport.protocol.scenario.checks.relations import after_the_end
from transport.protocol.scenario.files.atomic_writing import write_whole
from transport.protocol.scenario.radio.radio_parameters import slot_lengths
from transport.protocol.scenario.sections.limits_on_size import check_size, size_of
from transport.protocol.scenario.sections.scenario_errors import ScenarioError
from transport.protocol.scenario.setup.acting_alone import lacks
from transport.protocol.scenario.setup.run_setup import Setup
from transport.protocol.scenario.teams.team_of_any_size import FEWEST, MOST, Team, given_values
from transport.protocol.wire.errors_and_exit_codes import EXIT_CHECK_FAILED
from transport.report.laws import MOST_UAVS, in_words
from transport.report.limits_in_words import explained, explained_in_words

# Share of the largest thrust at hover above which a scenario is said to have little left.
_MOST_HOVER = 0.85


def new(
    uavs: int = Option(
        ..., metavar="COUNT", min=FEWEST, max=MOST, help="Number of UAVs, 2 to 256."
    ),
    template: str = Option(
        "resilient",
        "--from",
        metavar="SCENARIO",
        help="Scenario file or name for all but the size of the team and the payload.",
    ),
    group: int | None = Option(
        None, "--groups", metavar="COUNT", min=1, help="UAVs per agent; default: as in --from."
    ),
    vehicle: str | None = Option(
        None,
        metavar="NAME",
        help="crazyflie, x500, racing or a vehicle file; default: the UAVs of --from.",
    ),
    load_kg: float | None = Option(
        None,
        "--load",
        metavar="KG",
        min=1e-3,
        help="Payload mass; by default half the mass of the UAVs.",
    ),
    name: str | None = Option(
        None, metavar="NAME", help="Name; by default from --from, --vehicle and --uavs."
    ),
    out: Path | None = Option(
        None, metavar="FILE", help="File to write; by default standard output."
    ),
    output: FormatOption = Format.text,
) -> None:
    """Write a scenario for a team of any size.

    UAVs in a ring. By default they are those of --from, equal and as far apart as there: the
    paper's in resilient, 0.5 m apart, with 0.75 kg of payload for each. A vehicle brings its mass,
    inertia, rod, limits, motors and inner loop: docs/vehicles.md.

    Example: transport scenario new --uavs 4 --vehicle x500 --load 3.0 --out four.toml
    """
    if out is not None and out.exists():
        fail(f"--out: expected a file that does not exist yet, got {out}")
    with blame("--from"):
        ready = Scenario(template, allow_large=True)

    try:
        made = ready.resized(uavs, group=group, name=name, vehicle=vehicle, load_kg=load_kg)
    except ScenarioError as error:
        raise _by_option(error, load_kg, name) from error
    setup = made.setup
    tree = given_values(made.validated)
    text = tomli_w.dumps(tree)

    shown = [text.rstrip("\n")] if out is None else []
    show(output, {"scenario": tree, "file": out and str(out)}, *shown)
    if out is not None:
        with blame("--out"):
            write_whole(out, text)
        thrusts = hover_thrusts(setup)
        team = f"{uavs} UAVs, {len(setup.agents)} agents, {thrusts}"
        command = f"transport run {shlex.quote(str(out))}"
        try:
            check_size(made.validated, str(out))
        except ScenarioError as error:
            typer.echo(str(error), err=True)
            command += " --allow-large"
        typer.echo(f"{team}; run it with: {command}", err=True)
        if text := wide_load(setup):
            typer.echo(text, err=True)


def wide_load(setup: Setup) -> str:
    """Return in words that the payload is wider than the ring of its attachments; empty if it is not.

    Its radius of gyration about the vertical axis, sqrt(J_z / m), is compared with the largest distance
    of an attachment from that axis.
    """
    team = setup.system
    gyration_m = math.sqrt(float(team.payload.inertia[2, 2]) / team.payload.mass)
    ring_m = max(float(np.linalg.norm(uav.rho[:2])) for uav in team.uavs)
    if gyration_m <= ring_m:
        return ""
    sizes = f"radius of gyration {gyration_m:.2f} m, larger than the ring of attachments, {ring_m:.2f} m"
    remedy = "it has the shape of the paper's; a compact load has a smaller inertia"
    return f"payload: {sizes}: {remedy} (system.payload.inertia_kgm2)"


def _by_option(error: ScenarioError, load_kg: float | None, name: str | None) -> ScenarioError:
    """Return an error of a new scenario with the option that gave the refused value, if one did."""
    team = Team(uavs=FEWEST, load_kg=load_kg, name=name)
    if load_kg is not None and error.source == team.load_in_words:
        return ScenarioError(f"--load {load_kg:g}", error.field, error.problem)
    if name is not None and error.source == team.name_in_words:
        return ScenarioError(f"--name {name}", error.field, error.problem)
    return error


def hover_thrusts(setup: Setup) -> str:
    """Return the hover thrusts of UAV1, UAV2, ... in words; once if all are the same.

    Says so where little is left of the largest thrust.
    """
    thrusts_N = setup.hover.u[::INPUTS]
    texts = [f"{thrust_N:.2f}" for thrust_N in thrusts_N]
    text = f"hover thrusts {', '.join(texts)} N"
    if len(set(texts)) == 1:
        text = f"hover thrust {texts[0]} N"

    _, largest_N = setup.settings.limits.thrust_N
    share = float(max(thrusts_N)) / largest_N
    if share > _MOST_HOVER:
        text += f" ({share:.0%} of the limit: little is left to manoeuvre)"
    return text


def validate(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    explain: bool = Option(
        False, "--explain", help="Also tell the closest pair of UAVs and the nearest limit."
    ),
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Check a scenario and print it with every default.

    Prints the size of the run on standard error. With --explain also which limit along the reference
    has the least room: its UAV, its time, and a remedy.

    Example: transport validate eight --set controller.horizon=10 --explain
    """
    setup = read_setup(scenario, settings, allow_large=large)
    own_classes = checked(setup)
    tree = setup.scenario.tree()
    content = {"scenario": tree, "digest": setup.scenario.digest()}
    if explain:
        content["explained"] = explained(setup)
    show(output, content, tomli_w.dumps(tree).rstrip("\n"))
    if output is Format.text:
        for line in _about(setup, own_classes, explain=explain):
            typer.echo(line, err=True)


def _about(setup: Setup, own_classes: Mapping[str, str], *, explain: bool) -> Iterator[str]:
    """Yield what there is to say about a valid scenario, a line each: sizes, radio, limits, warnings."""
    sizes = f"{setup.system.N} UAVs, {len(setup.agents)} agents, {setup.ticks} ticks"
    classes = ", ".join(f"{kind} {name}" for kind, name in own_classes.items())
    digest = setup.scenario.digest()
    yield f"valid: {sizes}, {hover_thrusts(setup)}, digest {digest}, {classes}"

    yield from _slots_in_words(setup)
    if explain:
        yield from explained_in_words(setup)
    if setup.system.N <= MOST_UAVS:
        yield from in_words(setup)
    for problem in chain(after_the_end(setup.scenario), lacks(setup.alone)):
        yield f"warning: {problem}"
    yield f"size: {size_of(setup.scenario).text()}"


def _slots_in_words(setup: Setup) -> Iterator[str]:
    """Yield whether the slots of the radio are long enough, by kind of plan."""
    shapes = plan_shapes(setup.run) if setup.scenario.radio else {}
    for label, shape in shapes.items():
        slots = slot_lengths(setup.run, shape)
        if slots is not None:
            kind = "radio" if slots.are_enough else "radio, warning"
            yield f"{kind}: {label}{slots.text()}"


def margins(
    scenario: ScenarioArgument,
    settings: SetOption = None,
    figure: Path | None = Option(
        None, metavar="FILE", help="Draw the ranges; the ending is the format."
    ),
    without: str | None = Option(
        None, metavar="AGENTS", help="Agents that are gone for good, such as 1,2."
    ),
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Compute how much model error a hover tolerates.

    Analyses the sampled loop about hover: actuator lag, delay, spread and gain, masses, inertias and rods
    up to which the hover is stable, the others as known. Factors are relative to the known value.
    Takes seconds. With --without the team that is left holds the payload if all deviations decay.

    Example: transport margins resilient --set controller.sampling_period_s=0.02 --figure m.png
    """
    from transport.interface.figure import Margins  # loads matplotlib
    from transport.report.margins import hover_margins

    setup = read_setup(scenario, settings, allow_large=large)
    absent = [agent.strip() for agent in without.split(",")] if without else []
    if not all(map(str.isdecimal, absent)):
        fail(f"--without: expected agents such as 1,2, got {without!r:.60}")

    result = Margins(hover_margins(setup, [int(agent) for agent in absent]))
    show(output, result.data, str(result))
    if figure is not None:
        with blame("--figure", ValueError):
            result.plot().savefig(figure)


def doctor(
    scenario: str = Argument(
        "paper", metavar="SCENARIO", help="File or name of the scenario that is to run here."
    ),
    settings: SetOption = None,
    large: LargeOption = False,
    output: FormatOption = Format.text,
) -> None:
    """Check that this machine can run a scenario.

    Checks ports, network, step time, kernels, punctuality and cores. Each result is ok, warn (runs
    work, but slower or less punctually) or fail (runs do not work), with advice. Takes a few
    seconds and changes nothing.

    Exit codes: 0 no check failed, 9 a check failed, 3 scenario.

    Example: transport doctor resilient --set clock.mode=realtime --set clock.speed=1
    """
    from transport.doctor.checks import checks

    setup = read_setup(scenario, settings, allow_large=large)
    content = []
    count = Counter[str]()
    for name, finding in checks(setup):
        content.append({"name": name, **finding._asdict()})
        count[finding.status] += 1
        if output is Format.text:  # at once: a check may take seconds
            typer.echo(f"{finding.status:4} {name:12} {finding.found}")
            if finding.advice:
                typer.echo(f"{'':17} -> {finding.advice}")

    result = {"scenario": setup.scenario.name, "ok": not count["fail"], "checks": content}
    show(output, result, f"{len(content)} checks: {count['fail']} fail, {count['warn']} warn")
    if count["fail"]:
        raise typer.Exit(EXIT_CHECK_FAILED)
