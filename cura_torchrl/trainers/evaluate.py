"""Play frozen scenarios with a fixed policy and count how they end."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from cura_torchrl.trainers.evaluation.episodes import Episode, summarise
from cura_torchrl.trainers.evaluation.parts import Part, parts_of, play_parts
from cura_torchrl.trainers.info import git_commit, versions
from cura_torchrl.trainers.loaded_policy import load_policy

if TYPE_CHECKING:
    from cura_torchrl.trainers.config import EvaluateConfig


def evaluate(config: EvaluateConfig) -> dict[str, Any]:
    """Play the scenarios and return the counts.

    Args:
        config: Policy, scenarios and their number.

    Returns:
        JSON-compatible result; rates with Wilson's 95 % interval.

    Raises:
        CheckpointError: If the policy's checkpoint is missing or damaged.
    """  # noqa: DOC502 - raised by what this calls
    source = _source(config)
    if config.policy is None:
        # A run that is being trained may have a newer checkpoint by the time that a worker looks.
        config = dataclasses.replace(config, method=None, checkpoint=Path(source["checkpoint"]))
    episodes: list[Episode] = []
    with tqdm(total=config.episodes, unit="episode", file=sys.stderr) as bar:

        def keep(_: Part, played: list[Episode]) -> None:
            episodes.extend(played)
            bar.set_postfix_str(f"success {sum(entry.success[0] for entry in episodes) / len(episodes):.1%}")

        play_parts(parts_of(config), config.num_workers, keep=keep, tick=bar.update)
    return {**source, **summarise(episodes), **_settings(config)}


def _source(config: EvaluateConfig) -> dict[str, Any]:
    """Return who plays; raises before any world is built."""
    if config.policy is not None:
        return {"method": config.policy, "robot": config.robot, "checkpoint": None, "trained_frames": 0}
    loaded = load_policy(config.source)
    return {
        "method": loaded.config.method,
        "robot": loaded.config.env.robot.model,
        "checkpoint": loaded.path.as_posix(),
        "trained_frames": loaded.record["frames"],
        "trained_commit": loaded.record["commit"],
    }


def _settings(config: EvaluateConfig) -> dict[str, Any]:
    return {
        "scenario": config.scenario,
        "object_size": config.object_size,
        "max_obstacles": config.max_obstacles,
        "seed": config.seed,
        "chunk": config.chunk,
        "simulator": config.simulator,
        "commit": git_commit(),
        "versions": versions(),
    }
