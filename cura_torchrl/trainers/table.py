"""Play every method in every cell, keep the outcomes, and write the table of success rates from them alone."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from cura_torchrl.trainers.checkpoint import load_policy
from cura_torchrl.trainers.config import EvaluateConfig
from cura_torchrl.trainers.errors import CheckpointError, WorkerError
from cura_torchrl.trainers.evaluate import Episode, Player, part_size, play_in_worker
from cura_torchrl.trainers.outcomes import SHIPPED, OutcomeStore, PolicyRecord, Scenes
from cura_torchrl.trainers.table_config import TableConfig, parse_cell
from cura_torchrl.trainers.table_report import as_csv, as_latex, as_markdown, compare
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from collections.abc import Callable

STORE_NAME = "outcomes.sqlite"
"""File of outcomes in the table's folder."""


@dataclass(frozen=True, kw_only=True)
class _Policy:
    """Who plays, and where the weights are."""

    record: PolicyRecord
    path: Path


@dataclass(frozen=True, kw_only=True)
class _Part:
    """What one process plays at a time and one transaction writes."""

    scenes: Scenes
    config: EvaluateConfig
    index: int

    @property
    def indices(self) -> range:
        first = self.index * part_size(self.config)
        return range(first, min(first + part_size(self.config), self.config.episodes))


def table(config: TableConfig) -> str:
    """Play what the folder's file of outcomes does not hold yet, and write the table.

    Args:
        config: Methods, cells and number of scenes. Writes ``table.md``, ``table.csv`` and ``table.tex`` to its folder.

    Returns:
        The table in Markdown, as it was written.

    Raises:
        CheckpointError: If a policy's checkpoint is missing, damaged, or that of another method.
        RunError: If the file of outcomes is damaged or holds those of other weights.
        WorkerError: If a process that plays has died; what was played until then is kept.
    """  # noqa: DOC502 - raised by what this calls
    policies = _policies(config)
    with closing(OutcomeStore(config.out / STORE_NAME, chunk=config.chunk)) as store:
        for policy in policies:
            store.register(policy.record)
        _play(config, store, policies)
        return _write(config, store)


def _policies(config: TableConfig) -> list[_Policy]:
    # Raises before anything is played.
    found = []
    for method, seed in itertools.product(config.methods, config.seeds or (SHIPPED,)):
        loaded = load_policy(method if seed == SHIPPED else config.runs / f"{method}-{seed}")
        if loaded.config.method != method:
            msg = f"checkpoint {loaded.path} is of method {loaded.config.method}; accepted: a run of {method}"
            raise CheckpointError(msg)
        record = PolicyRecord(
            method=method,
            training_seed=seed,
            weights_sha256=loaded.weights_sha256,
            frames=loaded.record["frames"],
            commit=loaded.record["commit"],
        )
        found.append(_Policy(record=record, path=loaded.path))
    return found


def _play(config: TableConfig, store: OutcomeStore, policies: list[_Policy]) -> None:
    """Play the parts that the store does not hold, and write each when it is over."""
    parts = [part for policy in policies for cell in config.cells for part in _open_parts(config, store, policy, cell)]
    total = len(policies) * len(config.cells) * config.episodes
    done = total - sum(len(part.indices) for part in parts)
    with tqdm(total=total, initial=done, unit="episode", file=sys.stderr) as bar:

        def keep(part: _Part, episodes: list[Episode]) -> None:
            store.add(part.scenes, episodes)
            bar.update(len(episodes))
            bar.set_postfix_str(f"{part.scenes.method}, {part.scenes.scenario} {part.scenes.object_size} m")

        if config.num_workers == 1:
            _play_here(parts, keep)
        elif parts:
            _play_in_processes(parts, min(config.num_workers, len(parts)), keep)


def _open_parts(config: TableConfig, store: OutcomeStore, policy: _Policy, name: str) -> list[_Part]:
    """Return the parts of a cell that have scenes without an outcome."""
    scenes, played_by = _scenes(config, policy.record.method, policy.record.training_seed, name), policy.path
    settings = EvaluateConfig(
        checkpoint=played_by,
        scenario=parse_cell(name).scenario,
        object_size=scenes.object_size,
        max_obstacles=config.max_obstacles,
        episodes=config.episodes,
        seed=config.seed,
        simulator=config.simulator,
        chunk=config.chunk,
    )
    known = {episode.index for episode in store.read(scenes, config.episodes)}
    count = -(-config.episodes // part_size(settings))
    parts = (_Part(scenes=scenes, config=settings, index=index) for index in range(count))
    return [part for part in parts if not known.issuperset(part.indices)]


def _scenes(config: TableConfig, method: str, training_seed: int, name: str) -> Scenes:
    cell = parse_cell(name)
    return Scenes(
        method=method,
        training_seed=training_seed,
        simulator=config.simulator,
        scenario=cell.scenario,
        object_size=cell.object_size,
        max_obstacles=config.max_obstacles,
        scene_seed=config.seed,
    )


def _play_here(parts: list[_Part], keep: Callable[[_Part, list[Episode]], object]) -> None:
    for settings, group in itertools.groupby(parts, key=lambda part: part.config):
        with one_thread(), closing(Player(settings)) as player:
            for part in group:
                episodes: list[Episode] = []
                player.play(part.index, episodes.append)
                keep(part, episodes)


def _play_in_processes(parts: list[_Part], workers: int, keep: Callable[[_Part, list[Episode]], object]) -> None:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_end_with_parent) as pool:
        futures = {pool.submit(play_in_worker, part.config, part.index): part for part in parts}
        try:
            for future in as_completed(futures):
                keep(futures[future], future.result())
        except BrokenProcessPool:
            msg = "a process that plays has died; what was played is kept, the same command goes on from there"
            raise WorkerError(msg) from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)  # else leaving the block would play on to the end


def _end_with_parent() -> None:
    """End this process when its parent is killed: it would wait for work forever."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _write(config: TableConfig, store: OutcomeStore) -> str:
    """Return the table, made from the outcomes alone, and write its files."""
    seeds = config.seeds or (SHIPPED,)
    played = {
        method: {
            cell: [store.read(_scenes(config, method, seed, cell), config.episodes) for seed in seeds]
            for cell in config.cells
        }
        for method in config.methods
    }
    results = compare(played)
    shown = set(itertools.product(config.methods, seeds))
    policies = [entry for entry in store.policies() if (entry.method, entry.training_seed) in shown]
    page = as_markdown(results, policies, _settings(config))
    for name, text in (("table.md", page), ("table.csv", as_csv(results)), ("table.tex", as_latex(results))):
        (config.out / name).write_text(text, encoding="utf-8")
    return page


def _settings(config: TableConfig) -> str:
    return (
        f"{config.episodes} scenes a cell, seed {config.seed}, at most {config.max_obstacles} obstacles, simulator"
        f" {config.simulator}"
    )
