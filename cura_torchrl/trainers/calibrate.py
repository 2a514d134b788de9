"""Is the collision estimator right? Play, compare its predictions with what comes of them, and write what was found."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections import defaultdict
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from cura_torchrl import keys
from cura_torchrl.trainers.calibration.config import CONDITIONS, CalibrateConfig
from cura_torchrl.trainers.calibration.figures import coverage_figure, reliability_figure, truth_figure
from cura_torchrl.trainers.calibration.futures import against_truth, exploration, horizon, summarise
from cura_torchrl.trainers.calibration.report import as_markdown
from cura_torchrl.trainers.calibration.scores import TAIL, Predictions, measure, realised_possibility
from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.evaluation.active_perception import LookingMeter
from cura_torchrl.trainers.evaluation.episodes import play_episodes
from cura_torchrl.trainers.evaluation.statistics import bootstrap_interval
from cura_torchrl.trainers.folders import make_folder
from cura_torchrl.trainers.info import provenance
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray
    from tensordict import TensorDictBase

    from cura_torchrl.envs.config import TaskConfig
    from cura_torchrl.trainers.loaded_policy import LoadedPolicy

_LOOKING = ("seen_ahead_m2", "unseen_ahead", "first_seen_s", "first_seen_m", "beside_m", "object_speed")
"""Measures of looking that are reported; see :class:`~.active_perception.LookingMeter`."""


def calibrate(config: CalibrateConfig) -> str:
    """Play every method under every condition, simulate futures, and write numbers, table and figures.

    Args:
        config: Methods, conditions and numbers. Writes ``calibration.json``, ``calibration.md``, ``reliability.png``,
            ``coverage.png`` and, where futures were simulated, ``truth.png`` to its folder, anew after every method.

    Returns:
        The table in Markdown, as it was written.

    Raises:
        CheckpointError: If a policy's checkpoint is missing or damaged.
        RunError: If a policy sees no map, no draw of hidden obstacles agrees with what was seen, or the folder to write
            to cannot be made.
    """  # noqa: DOC502 - raised by what this calls
    policies = {name: load_policy(name).double() for name in config.methods}
    blind = [name for name, loaded in policies.items() if loaded.config.perception != "map"]
    if blind:
        msg = f"method is {blind[0]}, which sees no map; accepted: a policy that sees one"
        raise RunError(msg)
    origin = provenance()  # of the code that runs, whatever is changed meanwhile
    make_folder(config.out, "out")
    states = config.states if config.simulator == "planar" else 0
    total = len(policies) * (config.episodes * len(config.conditions) + states)
    page = ""
    methods: dict[str, Any] = {}
    truths: dict[str, dict[str, NDArray[Any]]] = {}
    with one_thread(), tqdm(total=total, unit="episode or state", file=sys.stderr) as bar:
        for name, loaded in policies.items():
            found: dict[str, Any] = {
                "trained_frames": loaded.record["frames"],
                "trained_commit": loaded.record["commit"],
            }
            for condition in config.conditions:
                bar.set_postfix_str(f"{name}, {condition}")
                found[condition] = _observe(loaded, config, condition, bar.update)
            if states:
                bar.set_postfix_str(f"{name}, futures")
                task = calibration_task(loaded, config.conditions[0])
                truths[name] = against_truth(loaded, config, task, bar.update)
                found["truth"] = summarise(truths[name])
            methods[name] = found
            page = _write(config.out, {**origin, "config": _settings(config), "methods": methods}, truths)
    return page


def calibration_task(loaded: LoadedPolicy, condition: str) -> TaskConfig:
    """Return the trained task under a condition, played on until what comes of every state is known.

    Episodes go on after the goal and the time limit until a collision there would make less of the collision
    possibility than the tail. So which states count never depends on what comes after them: if episodes were cut off at
    the goal, states shortly before it would count only where a collision follows.

    Args:
        loaded: The policy.
        condition: Name of one of :data:`~.calibration.config.CONDITIONS`.

    Returns:
        The task, with the true obstacles in what is emitted.
    """
    task, gamma = loaded.config.env.task, loaded.config.cura.gamma
    more = (horizon(gamma, TAIL) + 1) * task.policy_period
    return dataclasses.replace(
        task,
        scenario=dataclasses.replace(task.scenario, **CONDITIONS[condition]),
        success_time=max(task.success_time, more),
        episode_time=task.episode_time + more,
        privileged=True,
    )


class Track:
    """What is predicted in every state, as the ``watch`` of :func:`~.episodes.play_episodes`.

    Args:
        estimator: The DCE; writes the atoms.
    """

    def __init__(self, estimator: Callable[[TensorDictBase], TensorDictBase]) -> None:
        self._estimator = estimator
        self._notes: dict[str, list[torch.Tensor]] = defaultdict(list)

    def watch(self, state: TensorDictBase, playing: torch.Tensor) -> None:
        """Note the states of the rows that are played.

        Args:
            state: What the environment emits, batch size ``[N]``.
            playing: Rows that count, bool, shape ``[N]``.
        """
        part = state[playing]
        values = {
            "atoms": self._estimator(part.select(keys.OBSERVATION, keys.LATENT))[keys.COLLISION_ATOMS],
            "episode": part[keys.EPISODE][:, 0],
            "elapsed": part[keys.ELAPSED_STEPS][:, 0],
            "success": part[keys.SUCCESS][:, 0],
            "terminated": part["terminated"][:, 0],
        }
        for name, value in values.items():
            self._notes[name].append(value.clone())

    def predictions(self, *, gamma: float, limit: int) -> Predictions:
        """Return the states before goal, time limit and end, with what came of them.

        Args:
            gamma: Discount of a step [1].
            limit: Time limit [1] in policy steps; later states are not counted.

        Returns:
            Predictions and outcomes by episode and step.
        """
        data = {name: torch.cat(values).numpy() for name, values in self._notes.items()}
        order = np.lexsort((data["elapsed"], data["episode"]))
        data = {name: values[order] for name, values in data.items()}
        value, counts = np.zeros(len(order)), np.zeros(len(order), dtype=bool)
        for rows in np.split(np.arange(len(order)), np.flatnonzero(np.diff(data["episode"])) + 1):
            left = data["elapsed"][rows[-1]] - data["elapsed"][rows]
            collided = bool(data["terminated"][rows[-1]])
            value[rows], is_known = realised_possibility(left, collided=collided, gamma=gamma)
            counts[rows] = is_known & (left > 0) & ~data["success"][rows] & (data["elapsed"][rows] < limit)
        return Predictions(
            atoms=data["atoms"][counts], possibility=value[counts], episode=data["episode"][counts], gamma=gamma
        )


def _observe(
    loaded: LoadedPolicy, config: CalibrateConfig, condition: str, report: Callable[[], object]
) -> dict[str, Any]:
    """Return how predictions come true under a condition, and how much is looked."""
    task, chunk = calibration_task(loaded, condition), min(config.chunk, config.episodes)
    limit = loaded.config.env.task.max_steps
    with closing(loaded.make_env(chunk, task=task, simulator=config.simulator, seed=config.seed)) as env:
        meter = LookingMeter(env, loaded.config.env.lidar, task.policy_period)
        track = Track(loaded.collision_estimator)

        def watch(state: TensorDictBase, playing: torch.Tensor) -> None:
            track.watch(state, playing)
            meter.watch(state, playing & ~state[keys.SUCCESS][:, 0])

        torch.manual_seed(config.seed)
        played = play_episodes(
            env,
            loaded.policy,
            torch.arange(config.episodes),
            watch=watch,
            report=lambda _: report(),
            exploration=exploration(config),
        )
    return {
        "successes": sum(episode.success[0] for episode in played),
        "collisions": sum(episode.collision for episode in played),
        **measure(track.predictions(gamma=loaded.config.cura.gamma, limit=limit)),
        "looking": looking(meter.samples()),
    }


def looking(samples: Mapping[str, tuple[torch.Tensor, torch.Tensor]]) -> dict[str, list[float]]:
    """Return means with their 95 % intervals over resampled episodes.

    Args:
        samples: Values and the episodes that they are of, shape ``[M]`` each, by name.

    Returns:
        Mean, lower and upper bound by name; NaN where there is nothing.

    Examples:
        >>> values, episodes = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0, 0, 1])
        >>> looking({name: (values, episodes) for name in _LOOKING})["beside_m"][0]
        2.0
    """
    found = {}
    for name in _LOOKING:
        values, owner = (part.numpy() for part in samples[name])
        episodes, index = np.unique(owner, return_inverse=True)
        total, count = np.bincount(index, values.astype(np.float64)), np.bincount(index)

        def mean(pick: NDArray[np.int64], total: Any = total, count: Any = count) -> float:
            return float(total[pick].sum() / count[pick].sum())

        nothing = [np.nan] * 3
        found[name] = [float(values.mean()), *bootstrap_interval(mean, len(episodes))] if len(values) else nothing
    return found


def _settings(config: CalibrateConfig) -> dict[str, Any]:
    names = (field.name for field in dataclasses.fields(config) if field.name != "out")
    return {**{name: getattr(config, name) for name in names}, "tail": TAIL}


def _write(folder: Path, result: dict[str, Any], truths: dict[str, dict[str, NDArray[Any]]]) -> str:
    page = as_markdown(result)
    (folder / "calibration.md").write_text(page, encoding="utf-8")
    states = {name: {key: values.tolist() for key, values in truth.items()} for name, truth in truths.items()}
    content = json.dumps({**_finite(result), "truth_states": states}, indent=1, allow_nan=False)
    (folder / "calibration.json").write_text(content + "\n", encoding="utf-8")
    (folder / "reliability.png").write_bytes(reliability_figure(result["methods"]))
    (folder / "coverage.png").write_bytes(coverage_figure(result["methods"]))
    if truths:
        (folder / "truth.png").write_bytes(truth_figure(truths))
    return page


def _finite(value: Any) -> Any:
    """Return the same with null in place of what is no number."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
