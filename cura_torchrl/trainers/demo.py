"""The demo: two trained policies on the same scenes, a page to look at, and a few iterations of training."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import logging
import math
import shutil
import sys
import webbrowser
from contextlib import closing
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from cura_torchrl.envs.config import ScenarioConfig
from cura_torchrl.trainers.build import load_encoder
from cura_torchrl.trainers.checkpoint import progress_path
from cura_torchrl.trainers.errors import RunError, UnavailableError
from cura_torchrl.trainers.evaluation.episodes import summarise
from cura_torchrl.trainers.evaluation.task import evaluation_physics, frozen_task
from cura_torchrl.trainers.folders import make_folder
from cura_torchrl.trainers.info import git_commit, hardware, shipped_methods, versions
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.methods import PRESETS, policy_labels
from cura_torchrl.trainers.pages.demo_config import DemoConfig
from cura_torchrl.trainers.pages.demo_page import Card, draw_card, make_page
from cura_torchrl.trainers.pictures import figures
from cura_torchrl.trainers.pictures.estimate_figures import distribution_figure
from cura_torchrl.trainers.pictures.recording import Recording, choose_scenes, record
from cura_torchrl.trainers.threads import one_thread
from cura_torchrl.trainers.train import train
from cura_torchrl.trainers.training.progress import PROGRESS_NAME, read_progress
from cura_torchrl.trainers.training.run_folder import CHECKPOINT_FOLDER
from cura_torchrl.trainers.worker_pool import WorkerPool, count_one

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from cura_torchrl.envs.config import TaskConfig
    from cura_torchrl.trainers.config import TrainConfig
    from cura_torchrl.trainers.loaded_policy import LoadedPolicy
    from cura_torchrl.trainers.pictures.recording import Scene

__all__ = ["DemoConfig", "demo"]

logger = logging.getLogger(__name__)

PAGE_NAME = "index.html"
"""File of the demo's folder that is looked at."""
TRAINING_FOLDER = "training"
"""Folder of the demo's folder that training writes to."""
_FIRST_RATE = 1e-4
"""Largest learning rate to go on with where none is known: Adam has to find its moments again [1]."""
_Pair = tuple[Recording, Recording]


def demo(config: DemoConfig) -> Path:
    """Play, write the page, train on, and add the curves to the page.

    Args:
        config: Policies, scenes and amount of training.

    Returns:
        The page.

    Raises:
        RunError: If weights or scenes are missing, or a folder to write to cannot be made.
        WorkerError: If a process that plays or draws dies.
    """  # noqa: DOC502 - raised by what this calls
    loaded = [_load(name, config) for name in config.policies]
    tasks = [_task(config, policy) for policy in loaded]
    scenes = _scenes(config, tasks[0])
    make_folder(config.run_dir, "run_dir")
    if config.docs_dir is not None:
        make_folder(config.docs_dir, "docs_dir")
    with WorkerPool(config.num_workers) as pool:
        pairs = _play(config, loaded, tasks, scenes, pool)
        telling = most_telling(pairs, config.telling_scenes)
        cards = _draw(config, [*telling, *(pair for pair in pairs if pair not in telling)], pool)
    for line in _summary(pairs):
        logger.info("%s", line)
    page = config.run_dir / PAGE_NAME
    content: dict[str, Any] = {
        "telling": cards[: len(telling)],
        "others": cards[len(telling) :],
        "facts": _facts(config, loaded),
    }
    page.write_text(make_page(**content, curve=None), encoding="utf-8")
    if config.docs_dir is not None:
        write_pictures(config.docs_dir, cards[0], tasks[0])
    if config.train_iterations > 0:
        curve = figures.curve_figure(*_train_on(config, loaded[0]))
        page.write_text(make_page(**content, curve=curve), encoding="utf-8")
    if config.open_browser:
        webbrowser.open(page.resolve().as_uri())
    return page


def most_telling(pairs: Sequence[_Pair], count: int) -> list[_Pair]:
    """Return the scenes that show most.

    First come those that end well for one policy and not for the other, whichever it is, then those with the least
    clearance; in case of doubt the one with the smaller index.

    Args:
        pairs: The scenes, as both policies played them.
        count: How many to return at most [1].

    Returns:
        The scenes, the most telling first.
    """

    def rank(pair: _Pair) -> tuple[bool, float, int]:
        is_alike = len({recording.outcome == "success" for recording in pair}) == 1
        return is_alike, min(recording.min_clearance for recording in pair), pair[0].scene.index

    return sorted(pairs, key=rank)[:count]


def write_pictures(folder: Path, card: Card, task: TaskConfig) -> None:
    """Write the documentation's pictures.

    Args:
        folder: Folder to write to.
        card: The scene to show.
        task: The task, whose layout is drawn.
    """
    pictures = {
        "layout.png": figures.layout_figure(task.scenario),
        "paths.png": card.paths,
        "snapshots.png": figures.snapshots_figure(card.recordings),
        "collision_distribution.png": distribution_figure(card.recordings),
        "demo.webp": card.animation,
    }
    for name, content in pictures.items():
        (folder / name).write_bytes(content)


def _load(name: str, config: DemoConfig) -> LoadedPolicy:
    # Where weights are missing, the one line names the command that makes them.
    if name in PRESETS and name not in shipped_methods():
        others = " ".join(f"runs/{other}" if other == name else other for other in config.policies)
        msg = (
            f"no weights of method {name!r} are shipped with this copy; accepted: first "
            f"`cura-torchrl train --method {name} --run-dir runs/{name}`, then `cura-torchrl demo --policies {others}`"
        )
        raise UnavailableError(msg)
    loaded = load_policy(name)
    if loaded.config.perception == "map":
        load_encoder(loaded.config.encoder)
    return loaded


def _task(config: DemoConfig, loaded: LoadedPolicy) -> TaskConfig:
    scenario = ScenarioConfig(kind="mixed", object_edges=config.object_sizes, max_obstacles=config.max_obstacles)
    return frozen_task(loaded.config.env.task, scenario)


def _scenes(config: DemoConfig, task: TaskConfig) -> list[Scene]:
    try:
        return choose_scenes(task.scenario, seed=config.seed, count=config.scenes)
    except ValueError as error:
        raise RunError(str(error)) from None


def _play(
    config: DemoConfig,
    loaded: Sequence[LoadedPolicy],
    tasks: Sequence[TaskConfig],
    scenes: list[Scene],
    pool: WorkerPool,
) -> list[_Pair]:
    """Return every scene as both policies play it."""
    paths, labels = (policy.path for policy in loaded), policy_labels(loaded, config.policies)
    with tqdm(total=sum(task.max_steps + 1 for task in tasks), desc="play", unit="step", file=sys.stderr) as bar:
        work = functools.partial(_play_one, config, scenes)
        played = pool.map(work, list(zip(paths, tasks, labels, strict=True)), tick=bar.update)
        bar.update(bar.total - bar.n)
    return list(zip(*played, strict=True))


def _play_one(config: DemoConfig, scenes: list[Scene], who: tuple[Path, TaskConfig, str]) -> list[Recording]:
    """Return the recordings of one policy; the scenes run side by side."""
    path, task, label = who
    loaded = load_policy(path).double()
    env = loaded.make_env(
        len(scenes),
        task=task,
        physics=evaluation_physics(loaded.config.env),
        simulator=config.simulator,
        keep_map=True,
        seed=config.seed,
    )
    with one_thread(), closing(env):
        return record(
            env,
            loaded.policy,
            loaded.collision_estimator,
            scenes,
            label=label,
            stride=config.frame_stride,
            watch=lambda _: count_one(),
        )


def _draw(config: DemoConfig, pairs: Sequence[_Pair], pool: WorkerPool) -> list[Card]:
    every = itertools.chain(itertools.repeat(1, config.telling_scenes), itertools.repeat(2))
    with tqdm(total=len(pairs), desc="draw", unit="scene", file=sys.stderr) as bar:
        return pool.map(_draw_one, list(zip(pairs, every, strict=False)), tick=bar.update)


def _draw_one(part: tuple[_Pair, int]) -> Card:
    pair, every = part
    card = draw_card(pair, every=every)
    count_one()
    return card


def _summary(pairs: Sequence[_Pair]) -> Iterator[str]:
    """Yield one line per policy and scenario."""
    for kind in ("adversarial", "uniform"):
        for recordings in zip(*(pair for pair in pairs if pair[0].scene.kind == kind), strict=True):
            counts = summarise([recording.episode for recording in recordings])
            rate, low, high = (counts[name] for name in ("success_rate", "wilson_low", "wilson_high"))
            yield (
                f"{kind:<12}{recordings[0].label:<20}{counts['successes']} of {counts['episodes']} reached the goal "
                f"({rate:.0%}, 95 % interval {low:.0%} to {high:.0%}); "
                f"collisions {counts['collisions']}, time-outs {counts['timeouts']}"
            )


def _facts(config: DemoConfig, loaded: Sequence[LoadedPolicy]) -> dict[str, str]:
    machine = hardware()
    facts = {}
    for label, policy in zip(policy_labels(loaded, config.policies), loaded, strict=True):
        frames, seed, commit = (policy.record[name] for name in ("frames", "seed", "commit"))
        facts[label] = f"{frames:,} environment steps of training, seed {seed}, commit {commit}"
    facts["Scenes"] = (
        f"evaluation stream, seed {config.seed}, up to {config.max_obstacles} obstacles, at least one; simulator"
        f" {config.simulator}"
    )
    facts["Commit"] = git_commit()
    facts["Machine"] = f"{machine['platform']}, {machine['cores']} cores, {machine['memory_gib']} GiB"
    facts["Versions"] = ", ".join(f"{name} {version}" for name, version in versions().items())
    return facts


def _train_on(config: DemoConfig, loaded: LoadedPolicy) -> tuple[list[dict[str, float]], list[dict[str, float]]]:
    # Rows of the run that the networks come from, and those that are added here.
    before = read_progress(progress_path(loaded.path))
    folder = config.run_dir / TRAINING_FOLDER
    if (folder / CHECKPOINT_FOLDER).is_dir():
        shutil.rmtree(folder)
    logger.info("training goes on for %d iterations", config.train_iterations)
    train(_continued(config, loaded, before, folder), init_from=loaded.path)
    return before, read_progress(folder / PROGRESS_NAME)


def _continued(
    config: DemoConfig, loaded: LoadedPolicy, before: Sequence[dict[str, float]], folder: Path
) -> TrainConfig:
    """Return the run's own configuration as it was in the end, on fewer worlds."""
    run = loaded.config
    most = run.env.task.max_obstacles(loaded.record["frames"])
    scenario = dataclasses.replace(run.env.task.scenario, max_obstacles=most)
    task = dataclasses.replace(run.env.task, scenario=scenario, curriculum=(), random_first_age=True)
    last = before[-1].get("lr", math.nan) if before else math.nan
    rate = last if math.isfinite(last) else min(run.ppo.lr, _FIRST_RATE)
    return run.replace(
        run_dir=folder,
        num_envs=config.train_envs,
        num_workers=1,
        total_frames=config.train_iterations * config.train_envs * run.ppo.rollout_steps,
        device="cpu",
        logger="csv",
        checkpoint_minutes=60.0,
        env=dataclasses.replace(run.env, task=task),
        ppo=dataclasses.replace(run.ppo, lr=min(max(rate, run.ppo.min_lr), run.ppo.max_lr), critic_warmup_frames=0),
        cura=dataclasses.replace(run.cura, costs_start_frames=0),
    )
