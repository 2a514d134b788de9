"""The example scripts run as they stand, on little."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.name)
def test_example_trains(script: Path, tmp_path: Path) -> None:
    """Catches an example that names something renamed, or needs what a user has not got."""
    line = [sys.executable, str(script), "--iterations", "2", "--num-envs", "2", "--steps", "8"]
    done = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "2/2" in done.stderr
    assert "reward" in done.stderr
