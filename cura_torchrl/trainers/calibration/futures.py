"""The true distribution of the collision possibility in a state: futures simulated from clones of it.

What the robot cannot have seen is redrawn in every clone: obstacles that are there and were never hit by a ray, as
:mod:`~cura_torchrl.trainers.calibration.hidden_obstacles` draws them, those still to come, and the LiDAR's noise.
"""

from __future__ import annotations

import math
from collections import defaultdict
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.stats import spearmanr
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.envs.transforms import ConfidenceMap
from cura_torchrl.modules.functional import atom_mean, atom_variance
from cura_torchrl.trainers.calibration.cloning import copy_world, put_obstacles, remove_obstacles, vary
from cura_torchrl.trainers.calibration.hidden_obstacles import Past, draw_layouts
from cura_torchrl.trainers.calibration.scores import TAIL
from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.evaluation.active_perception import Sightings
from cura_torchrl.trainers.evaluation.statistics import bootstrap_interval, correlation

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import TaskConfig
    from cura_torchrl.trainers.calibration.config import CalibrateConfig
    from cura_torchrl.trainers.loaded_policy import LoadedPolicy

_WORLDS = 24
"""Worlds in which the states are reached [1]."""
_STRIDE = 10
"""Steps between two times at which states are taken [1]."""
_FLOOR = 0.002
"""Added to the risk, in proportion to which every second state is drawn [1]."""


def horizon(gamma: float, tail: float = TAIL) -> int:
    """Return after how many steps a collision makes less of the collision possibility than the tail.

    Args:
        gamma: Discount of a step [1].
        tail: What may be left out [1].

    Returns:
        Steps [1].

    Examples:
        >>> horizon(0.9)
        44
    """
    return math.ceil(math.log(tail) / math.log(gamma))


def exploration(config: CalibrateConfig) -> ExplorationType:
    """Return how the policy's distribution becomes an action.

    Args:
        config: Says whether actions are drawn.

    Returns:
        TorchRL's exploration type.
    """
    return ExplorationType.RANDOM if config.actions == "drawn" else ExplorationType.DETERMINISTIC


class _Source:
    """The worlds in which states are reached, with what has happened in them.

    Args:
        env: The worlds, with the true obstacles in what they emit and a map among the transforms.
    """

    def __init__(self, env: EnvBase) -> None:
        self.env = env
        base = env.base_env
        self._map = next(part for part in env.transform if isinstance(part, ConfidenceMap))
        self.grid = self._map.grid
        self._sightings = Sightings(base.config.lidar.max_range)
        steps = base.config.task.max_steps + 1
        self._paths = torch.zeros(base.num_envs, steps, 8, dtype=torch.float64)
        self.state = env.reset()
        self._note()

    def step(self, policy: Callable[[TensorDictBase], TensorDictBase]) -> None:
        """Play on by one step, with new episodes where some have ended."""
        _, self.state = self.env.step_and_maybe_reset(policy(self.state))
        self._note()

    def _note(self) -> None:
        state, rows = self.state, torch.arange(len(self._paths))
        self._sightings.update(state, torch.ones_like(rows, dtype=torch.bool))
        base = state[keys.SENSOR_POSE]
        tcp = geometry.from_frame(base, state[keys.OBSERVATION][:, OBSERVATION_SLICES["tcp_position"]][:, :2])
        path = torch.cat([base, tcp, state[keys.OBJECT_POSE]], dim=-1).double()
        self._paths[rows, state[keys.ELAPSED_STEPS][:, 0]] = path

    def eligible(self, limit: int) -> torch.Tensor:
        """Return the rows whose episode is on, before the goal and the time limit, int64, shape ``[M]``."""
        elapsed = self.state[keys.ELAPSED_STEPS][:, 0]
        return (~self.state[keys.SUCCESS][:, 0] & (elapsed > 0) & (elapsed < limit)).nonzero().squeeze(-1)

    def past(self, row: int) -> Past:
        """Return what has happened in a world."""
        elapsed = int(self.state[keys.ELAPSED_STEPS][row])
        path, is_known = self._paths[row, : elapsed + 1], self._sightings.is_known[row]
        return Past(
            base_pose=path[:, :3],
            tcp_position=path[:, 3:5],
            object_pose=path[:, 5:],
            object_edge=float(self.state[keys.OBJECT_SIZE][row, 0]),
            goal_pose=self.env.base_env.scenario["goal_pose"][row],
            seen=self.state[keys.OBSTACLES][row, is_known].double(),
            seen_since=self._sightings.appeared[row, is_known],
            age=self._map.age()[row],
        )

    def num_hidden(self, row: int) -> int:
        """Return how many obstacles are there and were never hit by a ray."""
        is_there = self.state[keys.OBSTACLES][row, :, 3] > 0
        return int((is_there & ~self._sightings.is_known[row]).sum())


def roll(
    env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase], state: TensorDictBase, *, gamma: float, steps: int
) -> torch.Tensor:
    """Play on from a state and return what the collision possibility comes out as.

    Args:
        env: N worlds that are in the state.
        policy: Writes the action.
        state: What the environment has emitted, batch size ``[N]``.
        gamma: Discount of a step [1].
        steps: After how many steps to stop; a collision after them counts as none [1].

    Returns:
        C of each world [1], float64, shape ``[N]``.
    """
    found = torch.zeros(len(state), dtype=torch.float64)
    is_on = torch.ones(len(state), dtype=torch.bool)
    for step in range(steps):
        after = env.step(policy(state))["next"]
        hit = after["terminated"].squeeze(-1) & is_on
        found[hit] = gamma**step
        is_on &= ~hit
        if not is_on.any():
            break
        remove_obstacles(env, hit)
        state = step_mdp(state.set("next", after))
    return found


@torch.no_grad()
def against_truth(
    loaded: LoadedPolicy, config: CalibrateConfig, task: TaskConfig, report: Callable[[], object]
) -> dict[str, NDArray[Any]]:
    """Clone states, simulate futures, and return what was predicted beside what is true.

    Args:
        loaded: Policy and estimator.
        config: Numbers of states, futures and candidates.
        task: The task, with the true obstacles.
        report: Called after every state.

    Returns:
        Arrays of shape ``[S]``: ``predicted_mean`` and ``predicted_variance``; ``true_mean`` and ``true_variance``;
        ``hidden_variance``, the part of it between layouts of hidden obstacles, and ``future_variance``, that between
        futures of the same layout, both unbiased; ``mean_error``, the standard error of the true mean; ``hidden``, how
        many hidden obstacles there really are, ``hidden_drawn``, how many on average in the draws; ``kept``, how many
        draws agree with what was seen; ``episode``; ``by_risk``, whether it was drawn in proportion to its risk.
    """
    options: dict[str, Any] = {"task": task, "simulator": "planar"}
    rows, limit = config.futures, loaded.config.env.task.max_steps
    notes: dict[str, list[Any]] = defaultdict(list)
    generator = torch.Generator().manual_seed(config.seed)
    worlds = _WORLDS + (rows == _WORLDS)  # what clones go into has another number of worlds
    with (
        closing(loaded.make_env(worlds, seed=config.seed, **options)) as first,
        closing(loaded.make_env(rows, seed=config.seed, **options)) as target,
        set_exploration_type(exploration(config)),
    ):
        torch.manual_seed(config.seed)
        target.rand_step(target.reset())
        source = _Source(first)
        while len(notes["episode"]) < config.states:
            for _ in range(_STRIDE):
                source.step(loaded.policy)
            risk = _predict(loaded, source.state)[0]
            for row, by_risk in _choose(source.eligible(limit), risk, generator):
                if len(notes["episode"]) == config.states:
                    break
                values = _look_ahead(loaded, config, source, target, row, len(notes["episode"]))
                for name, value in {**values, "by_risk": by_risk}.items():
                    notes[name].append(value)
                report()
    return {name: np.array(values) for name, values in notes.items()}


def _choose(rows: torch.Tensor, risk: torch.Tensor, generator: torch.Generator) -> list[tuple[int, bool]]:
    """Return one row at random and another one in proportion to its risk, less where there are less."""
    chosen = []
    for by_risk in (False, True):
        if len(rows):
            weights = risk[rows].clamp_min(0.0) + _FLOOR if by_risk else torch.ones(len(rows))
            number = int(torch.multinomial(weights.double(), 1, generator=generator))
            chosen.append((int(rows[number]), by_risk))
            rows = torch.cat([rows[:number], rows[number + 1 :]])
    return chosen


def _predict(loaded: LoadedPolicy, state: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
    atoms = loaded.collision_estimator(state.select(keys.OBSERVATION, keys.LATENT))[keys.COLLISION_ATOMS]
    return atom_mean(atoms), atom_variance(atoms)


def _look_ahead(
    loaded: LoadedPolicy, config: CalibrateConfig, source: _Source, target: EnvBase, row: int, number: int
) -> dict[str, Any]:
    # Returns what is predicted and what is true in a state.
    past, gamma, task = source.past(row), loaded.config.cura.gamma, source.env.base_env.config.task
    layouts = draw_layouts(
        task.scenario, past, source.grid,
        candidates=config.candidates, seed=config.seed * 100_000 + number, period=task.policy_period,
    )  # fmt: skip
    kept, groups = len(layouts.pose), config.futures // config.repeats
    if kept == 0:
        msg = f"candidates is {config.candidates}, and none agrees with what was seen in a state; accepted: more"
        raise RunError(msg)
    picked = layouts.take(torch.arange(groups) % kept)
    spread = picked.take(torch.arange(groups).repeat_interleave(config.repeats))
    copy_world(source.env, row, target)
    put_obstacles(target, spread.pose, spread.edge, spread.adversarial)
    vary(target, torch.arange(config.futures) + (config.seed * 100_000 + number) * config.futures)
    state = source.state[row : row + 1]
    start = state.expand(config.futures).clone()
    came_out = roll(target, loaded.policy, start, gamma=gamma, steps=horizon(gamma))
    mean, variance = (float(value) for value in _predict(loaded, state))
    return {
        "predicted_mean": mean,
        "predicted_variance": variance,
        **decompose(came_out.view(groups, config.repeats).numpy()),
        "hidden": source.num_hidden(row),
        "hidden_drawn": float((layouts.edge > 0).sum(-1).double().mean()) - len(past.seen),
        "kept": kept,
        "episode": int(source.state[keys.EPISODE][row]),
    }


def decompose(values: NDArray[np.float64]) -> dict[str, float]:
    """Return mean and variance of futures, and how the variance splits.

    Args:
        values: What came out, a row for each layout of hidden obstacles, shape ``[G, R]``, G and R at least 2.

    Returns:
        ``true_mean``, ``true_variance``, ``hidden_variance``, ``future_variance``, ``mean_error``; see
        :func:`against_truth`. The variances are unbiased: that between layouts may come out below 0.

    Examples:
        >>> found = decompose(np.array([[0.0, 0.0], [1.0, 1.0]]))
        >>> found["hidden_variance"], found["future_variance"], found["true_variance"]
        (0.5, 0.0, 0.5)
    """
    groups, repeats = values.shape
    means = values.mean(-1)
    within, spread = float(values.var(-1, ddof=1).mean()), float(means.var(ddof=1))
    hidden = spread - within / repeats
    return {
        "true_mean": float(values.mean()),
        "true_variance": hidden + within,
        "hidden_variance": hidden,
        "future_variance": within,
        "mean_error": math.sqrt(spread / groups),
    }


def summarise(truth: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return how predictions compare with the truth, each number with its 95 % interval over resampled episodes.

    Args:
        truth: From :func:`against_truth`.

    Returns:
        By name value, lower and upper bound, over all states and over those drawn at random alone.
    """
    by_risk = truth["by_risk"]
    groups = {"all": by_risk | True, "at_random": ~by_risk}
    return {
        name: _summary({key: values[chosen] for key, values in truth.items()})
        for name, chosen in groups.items()
        if chosen.any()
    }


def _summary(data: dict[str, NDArray[Any]]) -> dict[str, Any]:
    episodes, owner = np.unique(data["episode"], return_inverse=True)
    members = [np.flatnonzero(owner == episode) for episode in range(len(episodes))]

    def values(pick: NDArray[np.int64]) -> NDArray[np.float64]:
        index = np.concatenate([members[episode] for episode in pick])
        return np.array(list(_comparison({name: column[index] for name, column in data.items()}).values()))

    everything = np.arange(len(episodes))
    table = np.array([values(everything), *bootstrap_interval(values, len(episodes))]).T.tolist()
    return {"states": len(owner), "episodes": len(episodes), **dict(zip(_comparison(data), table, strict=True))}


def _comparison(data: dict[str, NDArray[Any]]) -> dict[str, float]:
    found: dict[str, float] = {}
    for name in ("mean", "variance"):
        predicted, true = data[f"predicted_{name}"], data[f"true_{name}"]
        varies = predicted.std() > 0 and true.std() > 0
        found[f"{name}_pearson"] = correlation(predicted, true)
        found[f"{name}_spearman"] = float(spearmanr(predicted, true)[0]) if varies else math.nan
        found[f"{name}_bias"] = float((predicted - true).mean())
        found[f"{name}_rmse"] = float(np.sqrt(np.square(predicted - true).mean()))
        found[f"{name}_true"] = float(true.mean())
    inside, between = float(data["true_variance"].mean()), float(data["true_mean"].var())
    total = inside + between
    parts = {"states": between, "hidden": data["hidden_variance"].mean(), "future": data["future_variance"].mean()}
    found |= {f"share_{name}": float(part) / total if total > 0 else math.nan for name, part in parts.items()}
    found["mean_error"] = float(np.sqrt(np.square(data["mean_error"]).mean()))
    found["hidden"], found["hidden_drawn"] = float(data["hidden"].mean()), float(data["hidden_drawn"].mean())
    return found
