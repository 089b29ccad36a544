"""The names of `import transport`: complete, typed alike, and imported when they are used."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import transport
from transport.interface.setting_arguments import KEY_OF, ShortSettings

SOURCE = Path(transport.__file__).read_text(encoding="utf-8")


def typed() -> dict[str, str]:
    """Return the names that type checkers see, with their modules."""
    block = next(
        node
        for node in ast.parse(SOURCE).body
        if isinstance(node, ast.If) and "TYPE" in ast.dump(node.test)
    )
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def test_type_checkers_see_what_there_is() -> None:
    """The imports for type checkers, the modules of the names and `__all__` agree, and each name is there."""
    assert typed() == transport._MODULES
    assert set(transport.__all__) == set(transport._MODULES)
    for name, module in transport._MODULES.items():
        assert getattr(transport, name) is getattr(import_module(module), name)
    assert set(transport.__all__) <= set(dir(transport))


@pytest.mark.parametrize(
    ("use", "unused"),
    [
        ("transport", "{'numpy', 'pydantic', 'transport.interface'}"),
        ("transport.fly", "{'matplotlib'}"),
    ],
)
def test_imports_wait_for_their_use(use: str, unused: set[str]) -> None:
    """`import transport`, as the command line does first, loads no library of the interface.

    A run loads no figures.
    """
    program = f"import sys, transport; {use}; print(sorted({unused} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_short_names_are_typed() -> None:
    """Each short name has a type and a key; every key is one of the scenario."""
    assert set(ShortSettings.__annotations__) == set(KEY_OF)
    scenario = transport.Scenario("resilient")
    for name, key in KEY_OF.items():
        assert scenario[name] == scenario[key]


def test_errors_have_one_base() -> None:
    """Every error of the interface can be caught as TransportError."""
    errors = [getattr(transport, name) for name in transport.__all__ if name.endswith("Error")]
    assert len(errors) > 5
    assert all(issubclass(error, transport.TransportError) for error in errors)
