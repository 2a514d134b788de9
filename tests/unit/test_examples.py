"""The example scripts run as they stand, on little, and what they compute by themselves is right."""

from __future__ import annotations

import importlib.util
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from types import ModuleType

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))
TRAINING = [path for path in EXAMPLES if path.stem != "confidence_map_elsewhere"]
REACHED = {
    "plain_ppo": r"reward a step: (\S+) in the first rollout, (\S+) in the last",
    "train_in_a_loop": r"reward (\S+) a step, collisions (\S+)% of steps",
}
"""What a script says in the end, or on its progress bar, of what it has reached."""


def _run(script: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, script, *words], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done


def _load(name: str) -> ModuleType:
    path = next(path for path in EXAMPLES if path.stem == name)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("script", TRAINING, ids=lambda path: path.name)
def test_example_trains(script: Path, tmp_path: Path) -> None:
    """Catches an example that names something renamed, needs what a user has not got, or learns from NaN."""
    steps = "64" if script.stem == "cura_on_gymnasium" else "8"  # a pendulum needs some time to get too fast
    done = _run(script, tmp_path, "--iterations", "2", "--num-envs", "2", "--steps", steps)
    assert "2/2" in done.stderr
    reached = re.findall(REACHED[script.stem], done.stderr + done.stdout)
    assert reached, done.stdout
    assert all(math.isfinite(float(number)) for number in reached[-1])


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.name)
def test_examples_stay_short(script: Path) -> None:
    """Catches an example that has outgrown what a stranger reads in a minute."""
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 120
