"""The report: one HTML page about a trained policy, with all that a reviewer asks for."""

from __future__ import annotations

import dataclasses
import sys
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from tqdm import tqdm

from cura_torchrl.trainers.build import load_encoder
from cura_torchrl.trainers.checkpoint import progress_path
from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.evaluation.task import evaluation_task
from cura_torchrl.trainers.folders import make_place
from cura_torchrl.trainers.loaded_policy import LoadedPolicy, load_policy
from cura_torchrl.trainers.methods import method_label, policy_labels
from cura_torchrl.trainers.pages import report_page
from cura_torchrl.trainers.pages.demo_page import draw_card
from cura_torchrl.trainers.pages.folder_section import read_folder
from cura_torchrl.trainers.pages.markup import document
from cura_torchrl.trainers.pages.report_config import ReportConfig
from cura_torchrl.trainers.pictures import figures
from cura_torchrl.trainers.pictures.estimate_figures import distribution_figure
from cura_torchrl.trainers.pictures.recording import find_scene, record
from cura_torchrl.trainers.threads import one_thread
from cura_torchrl.trainers.training.progress import read_progress

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path

    from cura_torchrl.trainers.pictures.recording import Recording, Scene

__all__ = ["ReportConfig", "report"]

TABLE_NAME = "table.md"
"""File of a table's folder that is read."""
CALIBRATION_NAME = "calibration.md"
"""File of a calibration's folder that is read."""
_SPEED_UP = 6.0
"""How much faster than the robot the animation is [1]."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """A policy that is reported, or that it is compared with."""

    source: str
    """How it was named on the command line."""
    label: str
    """Name in figures, unlike those of the others."""
    loaded: LoadedPolicy
    """Networks, configuration, and where they come from."""
    rows: list[dict[str, float]]
    """Its progress; empty where there is none."""


def report(config: ReportConfig) -> Path:
    """Read, play a scene, and write the page.

    Args:
        config: What is reported.

    Returns:
        The page.

    Raises:
        RunError: If what is to be read is missing or damaged, or the page is to be where a folder is; nothing is
            played then.
    """  # noqa: DOC502 - raised by what this calls
    runs = _load_runs(config)
    curves = {run.label: run.rows for run in runs if run.rows}
    curves |= _more_curves(config.curves, taken=curves)
    table = None if config.table is None else read_folder(config.table, TABLE_NAME, "table")
    calibration = None if config.calibration is None else read_folder(config.calibration, CALIBRATION_NAME, "calibrate")
    make_place(config.out, "out")
    first = runs[0]
    recordings = _play(config, _players(config, runs))
    card = draw_card(recordings, every=1, frame_time=config.frame_stride * recordings[0].period / _SPEED_UP)
    others = [run.loaded for run in runs[1:]]
    sections = [
        report_page.run_section(first.source, first.loaded, first.rows, others),
        report_page.curves_section(curves, has_own=bool(first.rows)),
        report_page.table_section(table, first.loaded),
        report_page.scene_section(card, figures.snapshots_figure(recordings), distribution_figure(recordings), config),
        report_page.calibration_section(calibration),
        report_page.configuration_section(first.loaded.config),
    ]
    page = document(
        title=f"{method_label(first.loaded)}: report of a trained policy",
        introduction=report_page.introduction(sections),
        main="\n".join(section.html for section in sections),
        facts=report_page.provenance_facts(),
    )
    config.out.write_text(page, encoding="utf-8")
    return config.out


def _load_runs(config: ReportConfig) -> list[Run]:
    """Return the runs, and last the baseline, unless it is one of them."""
    sources = list(dict.fromkeys(config.runs))
    loaded = [load_policy(source).double() for source in sources]
    if config.baseline is not None:
        baseline = load_policy(config.baseline).double()
        if baseline.path not in [policy.path for policy in loaded]:
            sources.append(config.baseline)
            loaded.append(baseline)
    return [
        Run(source=source, label=label, loaded=policy, rows=read_progress(progress_path(policy.path)))
        for source, label, policy in zip(sources, policy_labels(loaded, sources), loaded, strict=True)
    ]


def _more_curves(paths: tuple[Path, ...], taken: Collection[str]) -> dict[str, list[dict[str, float]]]:
    """Return the rows of further files, by the file's name; by its path where another curve has that name.

    Raises:
        RunError: If there are no rows in a file.
    """
    found = {}
    stems = [*taken, *(path.stem for path in paths)]
    for path in paths:
        try:
            rows = read_progress(path)
        except (ValueError, UnicodeDecodeError):
            rows = []
        if not rows or any("frames" not in row for row in rows):
            msg = f"no rows of progress in {path}; accepted: a file like a run's progress.csv"
            raise RunError(msg)
        found[path.stem if stems.count(path.stem) == 1 else path.as_posix()] = rows
    return found


def _players(config: ReportConfig, runs: list[Run]) -> list[Run]:
    """Return who plays the scene: the first run, and the baseline, if any."""
    beside = [run for run in runs[1:] if run.source == config.baseline]
    players = [runs[0], *beside[:1]]
    for player in players:
        if player.loaded.config.perception == "map":
            load_encoder(player.loaded.config.encoder)
    return players


def _play(config: ReportConfig, players: list[Run]) -> tuple[Recording, ...]:
    """Return the scene as each plays it, where the first run is trained."""
    trained = players[0].loaded.config
    task = evaluation_task(trained.env.task, config)
    config = dataclasses.replace(config, simulator=config.simulator or trained.simulator)
    scene = find_scene(task.scenario, seed=config.seed, index=config.scene)
    states = task.max_steps + 1
    with tqdm(total=states * len(players), desc="play", unit="step", file=sys.stderr) as bar, one_thread():
        played = tuple(_play_one(config, player, scene, bar) for player in players)
        bar.update(bar.total - bar.n)
    return played


def _play_one(config: ReportConfig, player: Run, scene: Scene, bar: tqdm) -> Recording:
    loaded = player.loaded
    with closing(loaded.make_evaluation_env(1, config, simulator=config.simulator, keep_map=True)) as env:
        (recording,) = record(
            env,
            loaded.policy,
            loaded.collision_estimator,
            [scene],
            label=player.label,
            stride=config.frame_stride,
            watch=lambda _: bar.update(),
        )
    return recording
