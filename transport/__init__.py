"""Running, recording, analysing and showing runs of the project. Import fails if another file hides a package."""

from importlib.util import find_spec
from pathlib import Path

_HERE = Path(__file__).resolve().parent.parent
_PACKAGES = ("model", "mpc", "protocol", "agent", "plant", "coordinator", "deploy", "scenarios")


def _hidden() -> str:
    """Return an error text about the first package of this project that another file hides; empty if none."""
    for name in _PACKAGES:
        spec = find_spec(name)
        if spec is None:
            return f"payload-transport: expected its package {name!r} in {_HERE}, got none"
        found = Path(spec.origin).resolve() if spec.origin else Path(next(iter(spec.submodule_search_locations or ())))
        if found != _HERE / name / "__init__.py":
            hint = "rename it, or start from another folder"
            return f"payload-transport: {found} hides its package {name!r}: {hint}"
    return ""


_text = _hidden()
if _text:
    raise ImportError(_text)
