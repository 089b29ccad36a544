"""The word about compilation: once, where the model is compiled, and never again."""

import io

import pytest
from rich.console import Console

from model import compiler
from transport.flight.progress import compile_model


@pytest.mark.skipif(compiler.find_compiler() is None or not compiler.enabled(), reason="needs a C compiler")
@pytest.mark.parametrize("is_terminal", [True, False])
def test_compilation_is_announced_once(
    is_terminal: bool, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an empty cache a line says that the model is compiled; the second time nothing is said."""
    monkeypatch.setenv("PAYLOAD_TRANSPORT_CACHE", str(tmp_path_factory.mktemp("cache")))

    def said() -> str:
        output = io.StringIO()
        compile_model(1, Console(file=output, force_terminal=is_terminal))
        return output.getvalue()

    assert "compiling the model for this processor, once" in said()
    assert said() == ""
