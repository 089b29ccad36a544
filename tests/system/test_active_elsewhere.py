"""A run that was started with `--out` is found from any folder."""

import json
import signal
from pathlib import Path

import pytest

from tests.support.commands import ENDLESS, PATIENCE_S, settings, start, transport, wait_for


@pytest.mark.slow
def test_status_and_target_find_a_run_elsewhere(tmp_path: Path) -> None:
    """Without an active run in runs/ the commands act on this user's newest, which they name."""
    here = tmp_path / "here"
    here.mkdir()
    out = tmp_path / "elsewhere" / "mine"
    process = start(
        "run", "resilient", *settings(*ENDLESS), "--out", out, "--no-figures", cwd=tmp_path
    )
    try:
        assert wait_for((out / "live.json").exists)

        def has_begun() -> bool:
            answer = transport("status", "--format", "json", cwd=here)
            return answer.returncode == 0 and json.loads(answer.stdout)["tick"] > 5

        assert wait_for(has_begun)
        answer = transport("target", "0.5", "0", "-10", cwd=here)
        assert answer.returncode == 0, answer.stderr
        assert answer.stderr == f"run: {out}\n"
        assert answer.stdout.startswith("target from tick ")
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE_S)
    answer = transport("status", cwd=here)
    assert answer.returncode == 2
    assert answer.stderr.startswith("transport: no active run in runs/")
