"""Exit codes of every command and process, in one place (docs/command-line.md)."""

EXIT_USAGE = 2  # an option or argument is refused
EXIT_SCENARIO = 3  # the scenario is refused
EXIT_UNREACHABLE = 4  # a peer is gone or was never reachable
EXIT_OVERRUN = 5  # deadlines missed, with clock.on_overrun = "abort"
EXIT_DIVERGED = 6  # the simulation diverged
EXIT_FAILED = 7  # steps of a controller failed, or a simulation of an experiment raised an error
EXIT_DIFFERENT = 8  # replayed plans differ from the recorded ones
EXIT_CHECK_FAILED = 9  # a check of `transport doctor` failed
EXIT_UNRECORDED = 10  # the log or the report cannot be written
EXIT_COLLIDED = 11  # two UAVs touched
EXIT_INTERRUPTED = 130  # Ctrl-C, SIGTERM or SIGHUP
