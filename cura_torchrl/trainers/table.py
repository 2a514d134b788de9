"""Play every method in every cell, keep the outcomes, and write the table of success rates from them alone."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from cura_torchrl.trainers.config import EvaluateConfig
from cura_torchrl.trainers.errors import CheckpointError, UnavailableError
from cura_torchrl.trainers.evaluation.agreement import agreement, pair
from cura_torchrl.trainers.evaluation.outcomes import SHIPPED, CodeRecord, OutcomeStore, PolicyRecord, Scenes
from cura_torchrl.trainers.evaluation.parts import Part, parts_of, play_parts
from cura_torchrl.trainers.evaluation.table_config import CHUNKS, TableConfig, parse_cell
from cura_torchrl.trainers.evaluation.table_figure import table_figure
from cura_torchrl.trainers.evaluation.table_numbers import Result, compare
from cura_torchrl.trainers.evaluation.table_parquet import write_parquet
from cura_torchrl.trainers.evaluation.table_report import agreement_section, as_csv, as_latex, as_markdown
from cura_torchrl.trainers.info import git_commit, versions
from cura_torchrl.trainers.loaded_policy import load_policy

if TYPE_CHECKING:
    from cura_torchrl.trainers.evaluation.agreement import Agreement
    from cura_torchrl.trainers.evaluation.episodes import Episode
    from cura_torchrl.trainers.evaluation.table_numbers import Played

STORE_NAME = "outcomes.sqlite"
"""File of outcomes in the table's folder."""


@dataclass(frozen=True, kw_only=True)
class _Policy:
    """Who plays, and where the weights are."""

    record: PolicyRecord
    path: Path


def table(config: TableConfig) -> str:
    """Play what the folder's file of outcomes does not hold yet, and write the table.

    Args:
        config: Methods, cells and number of scenes. Writes the table to its folder as ``table.md``, ``.csv``, ``.tex``,
            ``.png`` and ``.svg``; with pyarrow also as ``.parquet``, and the file of outcomes as ``outcomes.parquet``.

    Returns:
        The table in Markdown, as it was written.

    Raises:
        CheckpointError: If a policy's checkpoint is missing, damaged, or that of another method.
        RunError: If the file of outcomes is damaged or holds those of other weights.
        WorkerError: If a process that plays has died; what was played until then is kept.
    """  # noqa: DOC502 - raised by what this calls
    policies = _policies(config)
    if config.compare_with is not None:
        OutcomeStore(config.compare_with, read_only=True).close()  # raises before anything is played
    with closing(OutcomeStore(config.out / STORE_NAME)) as store:
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
    scenes = {
        _settings(config, policy, cell): _scenes(config, policy.record, cell)
        for policy in policies
        for cell in config.cells
    }
    parts = [part for settings, where in scenes.items() for part in _open_parts(settings, store, where)]
    code = CodeRecord(commit=git_commit(), versions=versions())
    total = len(scenes) * config.episodes
    done = total - sum(len(part.indices) for part in parts)
    with tqdm(total=total, initial=done, unit="episode", file=sys.stderr) as bar:

        def keep(part: Part, episodes: list[Episode]) -> None:
            where = scenes[part.config]
            store.add(where, episodes, code)
            bar.set_postfix_str(f"{where.method}, {where.scenario} {where.object_size} m")

        play_parts(parts, config.num_workers, keep=keep, tick=bar.update)


def _settings(config: TableConfig, policy: _Policy, name: str) -> EvaluateConfig:
    cell = parse_cell(name)
    return EvaluateConfig(
        checkpoint=policy.path,
        scenario=cell.scenario,
        object_size=cell.object_size,
        max_obstacles=config.max_obstacles,
        episodes=config.episodes,
        seed=config.seed,
        simulator=config.simulator,
        chunk=config.side_by_side,
    )


def _open_parts(settings: EvaluateConfig, store: OutcomeStore, scenes: Scenes) -> list[Part]:
    """Return the parts of a cell that have scenes without an outcome."""
    known = {episode.index for episode in store.read(scenes, settings.episodes)}
    return [part for part in parts_of(settings) if not known.issuperset(part.indices)]


def _scenes(config: TableConfig, policy: PolicyRecord, name: str) -> Scenes:
    cell = parse_cell(name)
    return Scenes(
        method=policy.method,
        training_seed=policy.training_seed,
        simulator=config.simulator,
        scenario=cell.scenario,
        object_size=cell.object_size,
        max_obstacles=config.max_obstacles,
        scene_seed=config.seed,
    )


def _write(config: TableConfig, store: OutcomeStore) -> str:
    """Return the table, made from the outcomes alone, and write its files."""
    shown = set(itertools.product(config.methods, config.seeds or (SHIPPED,)))
    policies = [entry for entry in store.policies() if (entry.method, entry.training_seed) in shown]
    results = compare(_played(config, store, policies))
    page = as_markdown(results, policies, _description(config), store.code())
    if config.compare_with is not None:
        page += f"\n{_agreement(config, store, policies, config.compare_with)}"
    for name, text in (("table.md", page), ("table.csv", as_csv(results)), ("table.tex", as_latex(results))):
        (config.out / name).write_text(text, encoding="utf-8")
    for form in ("png", "svg"):
        (config.out / f"table.{form}").write_bytes(table_figure(results, _description(config), form))
    _write_parquet(config, store, results)
    return page


def _write_parquet(config: TableConfig, store: OutcomeStore, results: list[Result]) -> None:
    columns = {name: [getattr(entry, name) for entry in results] for name in Result.__dataclass_fields__}
    try:
        write_parquet(columns, config.out / "table.parquet")
        write_parquet(store.columns(), config.out / "outcomes.parquet")
    except UnavailableError as error:
        sys.stderr.write(f"{error}\n")


def _played(config: TableConfig, store: OutcomeStore, policies: list[PolicyRecord]) -> Played:
    """Return how all scenes were played, by method, cell and training seed."""
    return {
        method: {
            cell: [
                store.read(_scenes(config, policy, cell), config.episodes)
                for policy in policies
                if policy.method == method
            ]
            for cell in config.cells
        }
        for method in config.methods
    }


def _agreement(config: TableConfig, store: OutcomeStore, policies: list[PolicyRecord], path: Path) -> str:
    """Return the section that compares with another file of outcomes."""
    found: dict[tuple[str, str], Agreement] = {}
    with closing(OutcomeStore(path, read_only=True)) as other:
        for simulator in CHUNKS:
            pairs: dict[str, list[tuple[Episode, Episode]]] = {}
            for policy, cell in itertools.product(policies, config.cells):
                own = _scenes(config, policy, cell)
                theirs = other.read(dataclasses.replace(own, simulator=simulator), config.episodes)
                pairs.setdefault(policy.method, []).extend(pair(theirs, store.read(own, config.episodes)))
            for method, both in {**pairs, "all": [entry for group in pairs.values() for entry in group]}.items():
                compared = agreement(both)
                if compared is not None:
                    found[method, simulator] = compared
        there = {(entry.method, entry.training_seed): entry.weights_sha256 for entry in other.policies()}
        changed = [
            f"{entry.method} {'' if entry.training_seed == SHIPPED else entry.training_seed}".rstrip()
            for entry in policies
            if there.get((entry.method, entry.training_seed), entry.weights_sha256) != entry.weights_sha256
        ]
        return agreement_section(found, path.as_posix(), changed)


def _description(config: TableConfig) -> str:
    return (
        f"{config.episodes} scenes a cell, seed {config.seed}, at most {config.max_obstacles} obstacles, simulator"
        f" {config.simulator}"
    )
