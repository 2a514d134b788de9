"""Parts of an evaluation: nothing but the scene and the weights decides how a scene ends."""

from __future__ import annotations

import os
import subprocess
import sys

PLAY = """
import sys
from contextlib import closing

from cura_torchrl.trainers.config import EvaluateConfig
from cura_torchrl.trainers.evaluation.parts import Player, parts_of
from cura_torchrl.trainers.threads import one_thread

scenes = {"object_size": 1.0, "episodes": 6, "simulator": "planar", "seed": 0}
config = EvaluateConfig(method="cura-ppo", chunk=int(sys.argv[1]), **scenes)
with one_thread(), closing(Player(config)) as player:
    for part in parts_of(config):
        print(*player.play(part, lambda _: None), sep="\\n")
"""

OLDER = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_CBWR": "COMPATIBLE"}
"""PyTorch and what it calls compute as on a processor of ten years ago, whichever this one is."""


def test_a_scene_ends_alike_on_another_processor_and_in_another_batch() -> None:
    """Catches last bits that depend on either: contact makes ten times as much of them in every step."""
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", PLAY, chunk], stdout=subprocess.PIPE, text=True, env={**os.environ, **variables}
        )
        for chunk, variables in (("6", {}), ("2", OLDER))
    ]
    one, other = (
        [line for line in run.communicate(timeout=280)[0].splitlines() if line.startswith("Episode(")] for run in runs
    )
    assert len(one) == 6
    assert one == other
    assert all("goal_distance=" in line for line in one)  # numbers that any other bit would change
