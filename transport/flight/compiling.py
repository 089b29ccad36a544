"""Compilation of the model before a run, with a word about it only where something is compiled."""

from rich.console import Console

from model.compiled import compile_functions, needs_compilation

_TEXT = "compiling the model for this processor, once"


def compile_model(uavs: int, console: Console) -> None:
    """Compile the model of a team of that many UAVs, if that has not been done on this processor."""
    if not needs_compilation(uavs):
        return
    if console.is_terminal:
        with console.status(_TEXT):
            compile_functions(uavs)
    else:
        console.print(_TEXT, highlight=False, soft_wrap=True)
        compile_functions(uavs)
