"""Trial of a user's engine in a separate process: this process survives whatever its code does."""

import json
import math
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import replace

from plant.engines import checked_engine
from plant.inner_loop import checked_firmware
from protocol.network.parent import ENVIRONMENT, python
from protocol.scenario.errors import ScenarioError
from protocol.scenario.setup import Setup

# Time for the process of the trial to start and to be ended by its alarm, beside the time of the engine, s.
_START_S = 10.0


def tried_engine(setup: Setup) -> str:
    """Return name and version of the engine of a run, as `checked_engine`; a user's class is built in a new process.

    Raises: ScenarioError: as of `checked_engine`, or that process ends early, or takes longer than a process may take
        to join a run.
    """
    name = setup.scenario.plant.engine
    if ":" not in name or name.startswith("__main__:"):
        return checked_engine(setup)
    checked_firmware(setup)  # the trial names the engine as the reason of all its errors
    limit_s = setup.scenario.clock.join_timeout_s
    command = [*python("plant.trial"), str(math.ceil(limit_s))]
    given = pickle.dumps((sys.path, replace(setup)))  # a copy, without the compiled model
    problem, code = f"not ready within {limit_s:g} s (clock.join_timeout_s)", -signal.SIGALRM
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
                return result["engine"]
            problem = result["problem"]
        elif code != -signal.SIGALRM:
            how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            problem = f"the process that tried the engine {how}"
    except subprocess.TimeoutExpired:
        pass
    raise ScenarioError(setup.scenario.name, "plant.engine", problem)


def _try() -> None:
    """Build the engine that standard input holds, and write the result to standard output."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(int(sys.argv[1]))  # also if the parent is gone
    sys.path[:], setup = pickle.load(sys.stdin.buffer)  # noqa: S301  # from the parent
    results = os.dup(1)
    os.dup2(2, 1)  # what the engine writes, also from compiled code
    try:
        result = {"engine": checked_engine(setup)}
    except ScenarioError as error:
        result = {"problem": error.problem}
    except KeyboardInterrupt:
        result = {"problem": "its code raised KeyboardInterrupt"}
    os.write(results, json.dumps(result).encode())
    os._exit(0)


if __name__ == "__main__":
    _try()
