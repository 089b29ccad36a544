"""The secret of a run on one host: processes and commands that have it connect, others do not."""

import json
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.support.attacker import session
from tests.support.commands import settings, start, wait_for
from transport.flight.run_files import RunError, own_keys
from transport.protocol.network.security import SHARED, Security, SecurityError
from transport.protocol.scenario.scenario_file import find_scenario, read_scenario

# Slower than real time, so that there is time to connect; ended by the test.
FLIGHT = ("clock.speed=0.1",)
# Timeout of a connection that has to be refused, and of one that has to be made on a busy machine.
REFUSED_S, PATIENCE_S = 0.7, 60.0


@pytest.fixture(scope="module")
def active(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield the folder of an active run with its secret.

    End the run, and check that the secret is gone.
    """
    parent = tmp_path_factory.mktemp("runs")
    folder = parent / "guarded"
    process = start(
        "run", "resilient", *settings(*FLIGHT), "--out", str(folder), "--no-figures", cwd=parent
    )
    try:
        assert wait_for(lambda: (folder / "live.json").exists(), PATIENCE_S)
        yield folder
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert not (folder / "keys").exists()


def credentials(user: str, password: str) -> dict[str, object]:
    """Return Zenoh's section for a user."""
    return {"auth": {"usrpwd": {"user": user, "password": password}}}


def test_only_the_secret_connects(active: Path) -> None:
    """Every process refuses sessions without the secret or with another one, and admits one with it."""
    file = active / "keys" / SHARED
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    user, password = file.read_text(encoding="utf-8").strip().split(":")
    endpoints = json.loads((active / "live.json").read_bytes())["endpoints"]
    assert len(endpoints) == 7
    for name in ("coordinator", "agent1", "recorder"):
        endpoint = endpoints[name]
        for given in (None, credentials(user, "0" * len(password)), credentials("root", password)):
            with pytest.raises(zenoh.ZError), session([endpoint], given, REFUSED_S):
                pass
    with session(list(endpoints.values()), credentials(user, password), PATIENCE_S) as opened:
        assert wait_for(lambda: alive(opened) >= {"coordinator", "plant", "agent1", "agent4"})


def alive(opened: zenoh.Session) -> set[str]:
    """Return the processes whose tokens a session sees."""
    replies = opened.liveliness().get("transport/*/alive/**")
    return {str(reply.ok.key_expr).split("/")[3] for reply in replies if reply.ok}


def test_a_file_system_without_permissions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run is refused where all could read its secret, with the remedy, and leaves no file."""
    touch = Path.touch
    monkeypatch.setattr(Path, "touch", lambda self, mode: (touch(self), self.chmod(0o777)))
    with pytest.raises(RunError, match=r"network.secret: .* for all; .*--set network.secret=false"):
        own_keys(read_scenario(find_scenario("resilient")), tmp_path).__enter__()
    assert list(tmp_path.iterdir()) == []


def test_a_bad_secret_is_refused(tmp_path: Path) -> None:
    """A file that holds no secret is refused by its name."""
    with own_keys(read_scenario(find_scenario("resilient")), tmp_path) as folder:
        assert folder is not None
        Security(folder, ()).check("agent1")
        (folder / SHARED).write_text("", encoding="utf-8")
        with pytest.raises(SecurityError, match=rf"{folder / SHARED}: expected a line USER:SECRET"):
            Security(folder, ()).check("agent1")
    assert not (tmp_path / "keys").exists()


def test_a_secret_may_have_any_letters(tmp_path: Path) -> None:
    """The user ends at the first colon."""
    (tmp_path / SHARED).write_text("team:a:b\n", encoding="utf-8")
    configuration: dict[str, Any] = {"transport": {"link": {}}}
    Security(tmp_path, ()).configure(configuration, "agent1", "transport/run")
    secret = configuration["transport"]["auth"]["usrpwd"]
    assert (secret["user"], secret["password"]) == ("team", "a:b")
