"""A run that was started with `--out` is found from any folder."""

import json
import signal
from pathlib import Path

import pytest

from tests.support.commands import ENDLESS, PATIENCE_S, settings, start, wait_for
from tests.system.test_operate import invoke


@pytest.mark.slow
def test_status_and_target_find_a_run_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without an active run in runs/ the commands act on this user's newest, which they name."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    out = tmp_path / "elsewhere" / "mine"
    process = start(
        "run", "resilient", *settings(*ENDLESS), "--out", out, "--no-figures", cwd=tmp_path
    )
    try:
        assert wait_for((out / "live.json").exists)

        def has_begun() -> bool:
            code, output, _ = invoke("status", "--format", "json")
            return code == 0 and json.loads(output)["tick"] > 5

        assert wait_for(has_begun)
        code, output, errors = invoke("target", "0.5", "0", "-10")
        assert (code, errors) == (0, f"run: {out}")
        assert output.startswith("target from tick ")
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)
    code, _, errors = invoke("status")
    assert code == 2
    assert errors.startswith("transport: no active run in runs/")
