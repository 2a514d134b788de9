"""Is the change of uncertainty a signal about the action? Cloned states, several actions, many seeds each.

Splits var(C^U) into what lies between states, between actions in the same state, and between seeds of the same action:
LiDAR noise and obstacles still to come, drawn anew. Only the second part can teach the policy anything:
python benchmarks/research/uncertainty_signal.py --output runs/research/uncertainty_signal.json
"""

from __future__ import annotations

import itertools
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.figure import Figure
from recording import PERIOD, clearance, parser, save, task
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from cura_torchrl import keys
from cura_torchrl.objectives.functional import risk_cost, uncertainty_cost
from cura_torchrl.trainers.calibration.cloning import copy_world, vary
from cura_torchrl.trainers.evaluation.statistics import bootstrap_interval, correlation
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.trainers.loaded_policy import LoadedPolicy

HOLDS = (1, 5)
"""For how many steps the action is held [1]; costs are summed over them."""
NEAR = 1.5
"""Distance from chassis or object to an obstacle below which a state counts as near one [m]."""
COSTS = ("uncertainty", "risk", "by map", "by vector")
"""What is split: both costs, and the change of U where only the map's code, or only the vector, is that after it."""
KINDS = ("policy", "uniform")
"""Where the actions come from: drawn by the policy in that state, as in training, or uniformly."""


def make(loaded: LoadedPolicy, rows: int, options: Any) -> EnvBase:
    """Return worlds of the planar simulator."""
    played = task(loaded, max_obstacles=options.max_obstacles)
    return loaded.make_env(rows, task=played, simulator="planar", keep_map=True, seed=options.seed)


def estimate(loaded: LoadedPolicy, state: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
    """Return risk and uncertainty, ``[N]`` each."""
    outputs = loaded.collision_estimator(state.select(keys.OBSERVATION, keys.LATENT))
    return outputs[keys.RISK].squeeze(-1), outputs[keys.UNCERTAINTY].squeeze(-1)


def check(loaded: LoadedPolicy, source: EnvBase, state: TensorDictBase, target: EnvBase) -> dict[str, float]:
    """Return the greatest differences between a world and its clones, all given the same five actions.

    Returns:
        By key, the map's being the share of cells that differ, and for comparison the scan's from another world's. The
        source has moved on by five steps.
    """
    copy_world(source, 0, target)
    clones = state[:1].expand(target.batch_size).clone()
    worst: dict[str, float] = {}
    for _ in range(5):
        state = loaded.policy(state)
        clones[keys.ACTION] = state[keys.ACTION][:1].expand(*target.batch_size, -1).clone()
        state, clones = (step_mdp(env.step(data)) for env, data in ((source, state), (target, clones)))
        for name in (keys.OBSERVATION, keys.SCAN, keys.OBJECT_POSE, keys.LATENT):
            worst[name] = max(worst.get(name, 0.0), float((clones[name] - state[name][:1]).abs().max()))
        worst["scan of another world"] = float((state[keys.SCAN][1:2] - state[keys.SCAN][:1]).abs().max())
        differs = (clones[keys.CONFIDENCE_MAP] != state[keys.CONFIDENCE_MAP][:1]).float().mean()
        worst[keys.CONFIDENCE_MAP] = max(worst.get(keys.CONFIDENCE_MAP, 0.0), float(differs))
    return worst


def branch(
    loaded: LoadedPolicy, target: EnvBase, state: TensorDictBase, options: Any, number: int
) -> dict[str, torch.Tensor]:
    """Return the costs of every action and seed from a state that the target's worlds are all in.

    Args:
        loaded: Policy and estimator.
        target: Worlds, one for each kind of action, action and seed.
        state: The state, batch ``[1]``.
        options: Numbers of actions and seeds.
        number: Index of the state, which the seeds go on from.

    Returns:
        Costs summed over each of the holds, shape ``[holds, kinds, actions, seeds]``.
    """
    rows, shape = target.batch_size[0], (len(KINDS), options.actions, options.seeds)
    vary(target, torch.arange(rows) + number * rows)
    drawn = loaded.policy(state.expand(options.actions).clone())[keys.ACTION]
    action = torch.stack([drawn, 2.0 * torch.rand_like(drawn) - 1.0])[:, :, None].expand(*shape, -1).reshape(rows, -1)
    data = state.expand(rows).clone()
    ended = torch.zeros(rows, dtype=torch.bool)
    start, (risk, uncertainty) = state.expand(rows), estimate(loaded, data)
    first = uncertainty
    sums = {name: torch.zeros(rows) for name in COSTS}
    found: dict[str, list[torch.Tensor]] = {name: [] for name in sums}
    for step in range(1, max(HOLDS) + 1):
        after = target.step(data.set(keys.ACTION, action))["next"]
        next_risk, next_uncertainty = estimate(loaded, after)
        cost, terminated = after[keys.COST].squeeze(-1), after["terminated"].squeeze(-1)
        risk_step = risk_cost(cost, risk, next_risk, terminated, gamma=loaded.config.cura.gamma)
        sums["risk"] += risk_step.masked_fill(ended, 0.0)
        ended = ended | terminated
        sums["uncertainty"] += uncertainty_cost(uncertainty, next_uncertainty).masked_fill(ended, 0.0)
        for name, key in (("by map", keys.LATENT), ("by vector", keys.OBSERVATION)):
            sums[name] = (estimate(loaded, start.clone().set(key, after[key]))[1] - first).masked_fill(ended, 0.0)
        risk, uncertainty = next_risk, next_uncertainty
        if step in HOLDS:
            for name, values in sums.items():
                found[name].append(values.clone().reshape(shape))
        data = step_mdp(data.set("next", after))
    return {name: torch.stack(values) for name, values in found.items()}


@torch.no_grad()
def sample(loaded: LoadedPolicy, options: Any) -> tuple[dict[str, NDArray[Any]], dict[str, float]]:
    """Return costs ``[states, holds, kinds, actions, seeds]`` and the states' distances, and the check's result."""
    torch.manual_seed(options.seed)
    rows = len(KINDS) * options.actions * options.seeds
    costs: dict[str, list[torch.Tensor]] = {name: [] for name in (*COSTS, "clearance")}
    with closing(make(loaded, options.envs, options)) as source, closing(make(loaded, rows, options)) as target:
        target.rand_step(target.reset())
        state = source.reset()
        while len(costs["risk"]) < options.states:
            for _ in range(options.stride):
                _, state = source.step_and_maybe_reset(loaded.policy(state))
            distance = clearance(source)
            for row in torch.randperm(options.envs)[: options.batch].tolist():
                copy_world(source, row, target)
                found = branch(loaded, target, state[row : row + 1], options, len(costs["risk"]))
                for name, value in {**found, "clearance": distance[row]}.items():
                    costs[name].append(value)
        checked = check(loaded, source, state, target)
    return {name: torch.stack(values).double().numpy() for name, values in costs.items()}, checked


def split(costs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the variance between states, between actions and between seeds, unbiased, from ``[states, A, S]``."""
    _, actions, seeds = costs.shape
    between_seeds = costs.var(-1, ddof=1).mean()
    between_actions = costs.mean(-1).var(-1, ddof=1).mean() - between_seeds / seeds
    means = costs.mean((1, 2))
    between_states = means.var(ddof=1) - between_actions / actions - between_seeds / (actions * seeds)
    return np.array([between_states, between_actions, between_seeds])


def measure(costs: NDArray[np.float64]) -> dict[str, Any]:
    """Return the three variances and the shares of that between actions, with intervals over states."""

    def shares(pick: NDArray[np.int64]) -> NDArray[np.float64]:
        states, actions, seeds = split(costs[pick])
        return np.array([actions / (states + actions + seeds), actions / (actions + seeds)])

    everything = np.arange(len(costs))
    parts, found = split(costs), shares(everything)
    low, high = bootstrap_interval(shares, len(costs))
    alone = [shares_of for one in costs if (shares_of := _within(one)) is not None]
    return {
        "states": len(costs),
        "std": float(np.sqrt(parts.clip(0).sum())),
        "shares": (parts / parts.sum()).tolist(),
        "of_all": [float(found[0]), low[0], high[0]],
        "within_states": [float(found[1]), low[1], high[1]],
        "median_within_a_state": float(np.median(alone)),
    }


def _within(costs: NDArray[np.float64]) -> float | None:
    _, actions, seeds = split(np.stack([costs, costs]))
    total = actions + seeds
    return float(actions / total) if total > 0 else None


def draw(results: dict[str, Any]) -> Figure:
    """Return the figure: how the variance of each cost splits, by phase, kind of action and hold."""
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    for axis, cost in zip(figure.subplots(1, 2, sharey=True), ("uncertainty", "risk"), strict=True):
        names = list(results[cost])
        shares = np.array([results[cost][name]["shares"] for name in names]).T.clip(0)
        bottom = np.zeros(len(names))
        for share, label, colour in zip(shares, ("states", "actions", "seeds"), ("0.8", "C2", "C1"), strict=True):
            axis.bar(names, share, bottom=bottom, label=f"between {label}", color=colour)
            bottom += share
        axis.set_title(f"{cost} cost", loc="left", fontsize=9)
        axis.set_ylabel("share of the variance [1]")
        axis.tick_params(axis="x", rotation=60, labelsize=7)
    # Above the plots: the bars fill them.
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", fontsize=8, ncols=3)
    return figure


def main() -> None:
    """Parse the command line, play, measure, write."""
    command = parser(__doc__, "runs/research/uncertainty_signal.json")
    command.set_defaults(envs=63)
    command.add_argument("--states", type=int, default=160, help="states to clone")
    command.add_argument("--actions", type=int, default=8, help="actions of each kind in a state")
    command.add_argument("--seeds", type=int, default=12, help="seeds of each action")
    command.add_argument("--stride", type=int, default=12, help="steps between two times at which states are taken")
    command.add_argument("--batch", type=int, default=6, help="states that are taken at a time")
    options = command.parse_args()
    loaded = load_policy(options.checkpoint)
    with one_thread(), set_exploration_type(ExplorationType.RANDOM):
        costs, checked = sample(loaded, options)
    near = costs["clearance"] < NEAR
    results: dict[str, Any] = {name: {} for name in COSTS}
    phases = {"all": near | True, "near": near, "free": ~near}
    for cost, (phase, chosen), kind, hold in itertools.product(results, phases.items(), range(2), range(2)):
        name = f"{phase}, {KINDS[kind]}, {HOLDS[hold] * PERIOD:g} s"
        results[cost][name] = measure(costs[cost][chosen, hold, kind])
    effects = costs["uncertainty"].mean(-1) - costs["uncertainty"].mean((-2, -1), keepdims=True)[..., 0]
    facts = {
        "checkpoint": loaded.config.method, "trained_frames": loaded.record["frames"], "seed": options.seed,
        "max_obstacles": options.max_obstacles, "actions": options.actions, "seeds": options.seeds,
        "clone_differences": checked,
        "correlation_of_effects_over_holds": {
            kind: correlation(effects[:, 0, index], effects[:, 1, index]) for index, kind in enumerate(KINDS)
        },
    }  # fmt: skip
    save({**facts, **results}, draw(results), options.output)


if __name__ == "__main__":
    main()
