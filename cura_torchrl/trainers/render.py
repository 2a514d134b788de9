"""Play one frozen scene with any methods, and write the paper's figures of it and animations."""

from __future__ import annotations

import logging
import sys
from contextlib import closing
from typing import TYPE_CHECKING

from tqdm import tqdm

from cura_torchrl.trainers.evaluation.task import evaluation_task
from cura_torchrl.trainers.folders import make_folder
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.methods import policy_labels
from cura_torchrl.trainers.pictures.animation import animation_frames, frame_numbers
from cura_torchrl.trainers.pictures.estimate_figures import appearance_figure, distribution_figure
from cura_torchrl.trainers.pictures.figures import layout_figure, paths_figure, snapshots_figure
from cura_torchrl.trainers.pictures.recording import find_scene, record
from cura_torchrl.trainers.pictures.render_config import RenderConfig
from cura_torchrl.trainers.pictures.scene_view import scene_frames
from cura_torchrl.trainers.pictures.video import encode_animation, require_format
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import torch
    from PIL import Image

    from cura_torchrl.envs.config import TaskConfig
    from cura_torchrl.trainers.loaded_policy import LoadedPolicy
    from cura_torchrl.trainers.pictures.recording import Recording
    from cura_torchrl.trainers.pictures.render_config import FigureName, StillFormat

__all__ = ["RenderConfig", "play_scene", "render"]

logger = logging.getLogger(__name__)


def render(config: RenderConfig) -> list[Path]:
    """Play the scene and write its figures and animations.

    Args:
        config: Scene, methods, and what to write.

    Returns:
        The files.

    Raises:
        RunError: If weights are missing or damaged, or a format cannot be written here; before anything is played.
    """  # noqa: DOC502 - raised by what this calls
    for kind in config.animation_formats:
        require_format(kind)
    loaded = [load_policy(name).double() for name in config.methods]
    make_folder(config.out, "out")
    recordings = play_scene(config, loaded)
    for recording in recordings:
        logger.info("scene %d, %s: %s", config.scene, recording.label, recording.describe())
    task = evaluation_task(loaded[0].config.env.task, config)
    return [*_write_figures(config, recordings, task), *_write_animations(config, recordings)]


def play_scene(config: RenderConfig, loaded: Sequence[LoadedPolicy]) -> list[Recording]:
    """Return the scene as every policy plays it.

    Args:
        config: The scene.
        loaded: Who plays.

    Returns:
        One recording a policy, with scan and map of every state.
    """
    recordings = []
    tasks = [evaluation_task(policy.config.env.task, config) for policy in loaded]
    total = sum(task.max_steps + 1 for task in tasks)
    with tqdm(total=total, desc="play", unit="step", file=sys.stderr) as bar:

        def note(_: torch.Tensor) -> None:
            bar.update()

        for policy, task, label in zip(loaded, tasks, policy_labels(loaded, config.methods), strict=True):
            scene = find_scene(task.scenario, seed=config.seed, index=config.scene)
            env = policy.make_evaluation_env(1, config, simulator=config.simulator, keep_map=True)
            with one_thread(), closing(env):
                recordings += record(
                    env, policy.policy, policy.collision_estimator, [scene], label=label, stride=1, watch=note
                )
        bar.update(bar.total - bar.n)
    return recordings


def _write_figures(config: RenderConfig, recordings: Sequence[Recording], task: TaskConfig) -> list[Path]:
    if not config.still_formats:
        return []
    written = []
    for name in tqdm(config.drawn, desc="figures", unit="figure", file=sys.stderr):
        for kind in config.still_formats:
            path = config.out / f"{name}.{kind}"
            path.write_bytes(_draw(name, kind, config, recordings, task))
            written.append(path)
    return written


def _draw(
    name: FigureName, kind: StillFormat, config: RenderConfig, recordings: Sequence[Recording], task: TaskConfig
) -> bytes:
    if name == "layout":
        return layout_figure(task.scenario, kind=kind)
    if name == "paths":
        return paths_figure(recordings, kind=kind)
    if name == "appearance":
        return appearance_figure(recordings, kind=kind)
    draw = snapshots_figure if name == "snapshots" else distribution_figure
    return draw(recordings, times=config.times, kind=kind)


def _write_animations(config: RenderConfig, recordings: Sequence[Recording]) -> list[Path]:
    written = []
    for view in config.views if config.animation_formats else ():
        frames = _frames(config, recordings, is_3d=view == "3d")
        for kind in config.animation_formats:
            path = config.out / f"animation-{view}.{kind}"
            path.write_bytes(encode_animation(frames, kind=kind, frame_time=1.0 / config.fps, lossless=view == "top"))
            written.append(path)
    return written


def _frames(config: RenderConfig, recordings: Sequence[Recording], *, is_3d: bool) -> list[Image.Image]:
    if not is_3d:
        return animation_frames(recordings, every=config.every)
    count = len(frame_numbers(recordings, config.every))
    frames = scene_frames(recordings, size=config.size, every=config.every)
    return list(tqdm(frames, total=count, desc="3-D view", unit="frame", file=sys.stderr))
