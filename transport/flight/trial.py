"""Trial of a user's classes, engine and controller, in a separate process: this process survives whatever they do."""

import json
import math
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Collection, Mapping
from dataclasses import replace

from agent.own import checked_controller
from plant.engines import checked_engine
from plant.inner_loop import checked_firmware
from protocol.network.parent import ENVIRONMENT, python
from protocol.scenario.errors import ScenarioError
from protocol.scenario.setup import Setup
from protocol.wire.names import PLANT, agent_name

# Time for the process of the trial to start and to be ended by its alarm, beside the time of the classes, s.
_START_S = 10.0
_FIELDS = {"engine": "plant.engine", "controller": "agents.controller"}


def named(setup: Setup) -> dict[str, str]:
    """Return the names of engine and controller of a run, by what they are in the header of its log."""
    return {"engine": setup.scenario.plant.engine, "controller": setup.scenario.agents.controller}


def checked(setup: Setup) -> dict[str, str]:
    """Return names and versions of engine and controller of a run after making each once, as its processes will.

    Raises: ScenarioError: one of them cannot be used.
    """
    return {"engine": checked_engine(setup), "controller": checked_controller(setup)}


def tried(setup: Setup, external: Collection[str] = ()) -> Mapping[str, str]:
    """Return names and versions of engine and controller, as `checked`; a user's classes are made in a new process.

    A role of which all processes are `external` is not tried.

    Raises: ScenarioError: as of `checked`, or that process ends early, or takes longer than a process may take to join
        a run.
    """
    scenario = setup.scenario
    elsewhere = {
        "engine": PLANT in external,
        "controller": all(agent_name(agent) in external for agent in setup.agents),
    }
    own = {what: name for what, name in named(setup).items() if ":" in name and not elsewhere[what]}
    for what, name in own.items():
        if name.startswith("__main__:"):
            expected = "expected a class in a module, which the processes of a run can import"
            raise ScenarioError(scenario.name, _FIELDS[what], f"{expected}, got one of the program itself")
    found = {what: "external" for what, away in elsewhere.items() if away}
    if not own:
        checks = {"engine": checked_engine, "controller": checked_controller}
        return {what: found[what] if what in found else check(setup) for what, check in checks.items()}
    if not elsewhere["engine"]:
        checked_firmware(setup)  # a failed trial names classes as the reason
    limit_s = scenario.clock.join_timeout_s
    command = [*python("transport.flight.trial"), str(math.ceil(limit_s))]
    # A copy, without the compiled model, and with built-in ones in place of those that are elsewhere.
    sections = {
        "plant": scenario.plant.model_copy(update={"engine": "rods"} if elsewhere["engine"] else {}),
        "agents": scenario.agents.model_copy(update={"controller": "mpc"} if elsewhere["controller"] else {}),
    }
    given = pickle.dumps((sys.path, replace(setup, scenario=scenario.model_copy(update=sections))))
    problem, code = f"not ready within {limit_s:g} s (clock.join_timeout_s)", -signal.SIGALRM
    field = _FIELDS[next(iter(own))]
    try:
        done = subprocess.run(
            command,
            input=given,
            stdout=subprocess.PIPE,
            env={**ENVIRONMENT, **os.environ},
            start_new_session=True,
            timeout=limit_s + _START_S,
            check=False,
        )
        code = done.returncode
        if done.stdout:
            result: dict[str, str] = json.loads(done.stdout)
            if "engine" in result:
                return result | found
            problem, field = result["problem"], result.get("field", field)
        elif code != -signal.SIGALRM:
            how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            problem = f"the process that tried the {' and '.join(own)} {how}"
    except subprocess.TimeoutExpired:
        pass
    raise ScenarioError(scenario.name, field, problem)


def _try() -> None:
    """Make the classes of the run that standard input holds, and write the result to standard output."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(int(sys.argv[1]))  # also if the parent is gone
    sys.path[:], setup = pickle.load(sys.stdin.buffer)  # noqa: S301  # from the parent
    results = os.dup(1)
    os.dup2(2, 1)  # what the classes write, also from compiled code
    try:
        result = checked(setup)
    except ScenarioError as error:
        result = {"problem": error.problem, "field": error.field}
    except KeyboardInterrupt:
        result = {"problem": "its code raised KeyboardInterrupt"}
    os.write(results, json.dumps(result).encode())
    os._exit(0)


if __name__ == "__main__":
    _try()
