"""Run the commands of docs/getting-started.md in a new folder and renew their outputs.

Two minutes on two cores.

Commands that install something or serve the viewer are not run. tests/test_getting_started.py runs
the page in memory.
"""

import doctest
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from contextlib import redirect_stdout
from pathlib import Path

DOCUMENT = Path(__file__).resolve().parent / "getting-started.md"
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```", re.MULTILINE | re.DOTALL)
SKIPPED = ("git ", "cd ", "python3 -m venv", ". ", "pip ", "transport view")
# Lines of progress, of a run that takes longer than 10 s or is the first one of a team's size.
PROGRESS = re.compile(r" *\d+\.\d of |compiling the model")


def commands(block: str) -> list[tuple[str, str]]:
    """Return the commands of a console block with their outputs."""
    parts = re.split(r"^\$ (.*)\n", block, flags=re.MULTILINE)[1:]
    return list(zip(parts[::2], parts[1::2], strict=True))


def example(one: doctest.Example, names: dict[str, object]) -> str:
    """Return a Python example with its output."""
    first, *rest = one.source.rstrip("\n").split("\n")
    source = "".join([f">>> {first}\n", *(f"... {line}\n" for line in rest)])
    output = io.StringIO()
    try:
        with redirect_stdout(output):
            exec(compile(one.source, "<page>", "single"), names)  # noqa: S102  # the project's own page
    except Exception as error:  # noqa: BLE001  # shown to the reader
        kind = type(error)
        return f"{source}Traceback (most recent call last):\n    ...\n{kind.__module__}.{kind.__qualname__}: {error}\n"
    return source + output.getvalue()


def in_shell(command: str) -> str:
    """Return the output of a command; nothing for one that is not run."""
    if command.startswith(SKIPPED):
        return ""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        shlex.split(command),
        check=True,
        env={**os.environ, "PATH": path, "COLUMNS": "100"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    lines = [
        line.rstrip()
        for line in done.stdout.splitlines()
        if line.strip() and not PROGRESS.match(line)
    ]
    return "".join(f"{line}\n" for line in lines)


def main() -> None:
    """Renew the page."""
    names: dict[str, object] = {}  # of the Python examples

    def renew(found: re.Match[str]) -> str:
        language, block = found.groups()
        if language == "console":
            lines = [f"$ {command}\n{in_shell(command)}" for command, _ in commands(block)]
        else:
            lines = [example(one, names) for one in doctest.DocTestParser().get_examples(block)]
        return f"```{language}\n{''.join(lines)}```"

    text = DOCUMENT.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        text = BLOCK.sub(renew, text)
    DOCUMENT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
