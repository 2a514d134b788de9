"""What the experiments share: rollouts with the estimator's predictions, bootstrap intervals, result files."""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.mdp import scenarios
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.objectives.functional import normalise, risk_cost, uncertainty_cost
from cura_torchrl.trainers.evaluation.active_perception import unseen_ahead
from cura_torchrl.trainers.evaluation.statistics import wilson_interval
from cura_torchrl.trainers.info import provenance

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.figure import Figure
    from numpy.typing import NDArray
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import TaskConfig
    from cura_torchrl.envs.push import PushEnv
    from cura_torchrl.trainers.loaded_policy import LoadedPolicy

Policy = Callable[[TensorDictBase], TensorDictBase]

PERIOD = 0.2
"""Time of a policy step [s]."""
SIZES = (0.5, 0.75, 1.0)
"""Edges of the object in the six cells [m]."""
KINDS = ("uniform", "adversarial")
"""Their scenarios."""
BURN_IN = 64
"""Steps that are played before recording, in which episodes that begin together spread out [1]."""


def parser(description: str | None, output: str) -> argparse.ArgumentParser:
    """Return a command line with what every experiment needs.

    Args:
        description: What the script does.
        output: Result file that is written by default; the figure lies beside it.
    """
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--checkpoint", default="cura-ppo", help="method whose weights are shipped, or a run's folder")
    made.add_argument("--seed", type=int, default=1000, help="seed of scenarios; never 0, the evaluation's")
    made.add_argument("--envs", type=int, default=256, help="worlds, a multiple of those of a rollout in training")
    made.add_argument("--max-obstacles", type=int, default=6, help="most obstacles K in an episode")
    made.add_argument("--output", type=Path, default=Path(output), help="result file; the figure lies beside it")
    return made


def save(result: dict[str, Any], figure: Figure, output: Path) -> None:
    """Write a result with its origin, and its figure beside it."""
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps({**provenance(), **result}, indent=1) + "\n", encoding="utf-8")
    figure.savefig(output.with_suffix(".png"), dpi=90)
    print(f"wrote {output} and {output.with_suffix('.png')}")


def task(loaded: LoadedPolicy, **scenario: Any) -> TaskConfig:
    """Return the trained task with some fields of its scenario changed."""
    trained = loaded.config.env.task
    return dataclasses.replace(trained, scenario=dataclasses.replace(trained.scenario, **scenario))


def clearance(env: EnvBase) -> torch.Tensor:
    """Return the distance from the chassis or the object to the nearest obstacle that has appeared [m], ``[N]``."""
    return gaps(env.base_env).amin(-1)


def gaps(base: PushEnv) -> torch.Tensor:
    """Return the distance from the chassis or the object to every obstacle [m], 20 if it is not there, ``[N, 6]``."""
    active, pose, edge = base.obstacles
    state = base.world_state
    yaw = geometry.yaw_from_quaternion(state.object_quaternion)
    object_pose = torch.cat([state.object_position[:, :2], yaw[:, None]], dim=-1)
    half = (base.scenario["object_edge"] / 2)[:, None].expand(-1, 2)
    chassis = half.new_tensor(scenarios.CHASSIS_HALF).expand_as(half)
    bodies = ((object_pose, half), (state.base_pose, chassis))
    square = (edge / 2)[..., None].expand(*edge.shape, 2)
    distance = torch.stack([geometry.rectangle_distance(p[:, None], h[:, None], pose, square) for p, h in bodies]).amin(
        0
    )
    return distance.masked_fill(~active, 20.0)


@torch.no_grad()
def record(
    env: EnvBase, policy: Policy, steps: int, watch: Callable[[TensorDictBase], dict[str, torch.Tensor]]
) -> dict[str, NDArray[Any]]:
    """Play and note what a function sees before, and what an ending does after, every step.

    Args:
        env: N worlds.
        policy: Writes the action; random policies draw it as in training.
        steps: Steps to note T, after those of the burn-in.
        watch: Values of a state, shape ``[N]`` each.

    Returns:
        Arrays ``[N, T]``: those of ``watch``, the same after the step under ``next_*``, ``episode`` (one number for
        every episode played), ``elapsed``, ``cost``, ``terminated``, ``done``, ``edge``.
    """
    notes: dict[str, list[torch.Tensor]] = {}
    played = torch.arange(env.batch_size[0])
    with set_exploration_type(ExplorationType.RANDOM):
        state = env.reset()
        for step in range(-BURN_IN, steps):
            before = watch(state) if step >= 0 else {}
            state, following = env.step_and_maybe_reset(policy(state))
            after = state["next"]
            ended = after["done"].squeeze(-1)
            if step >= 0:
                # Where an episode has ended, clearance is that of the next one's start: such steps are not read.
                seen = {f"next_{name}": value for name, value in watch(after).items()}
                ends = {name: after[name].squeeze(-1) for name in (keys.COST, "terminated", "done")}
                start = {"elapsed": after[keys.ELAPSED_STEPS][:, 0], "edge": after[keys.OBJECT_SIZE][:, 0]}
                for name, value in {**before, **seen, **ends, **start, "episode": played}.items():
                    notes.setdefault(name, []).append(value.clone())
            played = torch.where(ended, played + len(played), played)
            state = following
    return {name: torch.stack(values, dim=1).numpy() for name, values in notes.items()}


def estimator_watch(loaded: LoadedPolicy, env: EnvBase) -> Callable[[TensorDictBase], dict[str, torch.Tensor]]:
    """Return what notes risk, uncertainty, clearance and the unseen area ahead; the environment keeps its map."""

    def watch(state: TensorDictBase) -> dict[str, torch.Tensor]:
        outputs = loaded.collision_estimator(state.select(keys.OBSERVATION, keys.LATENT))
        parts = {name: state[keys.OBSERVATION][..., part] for name, part in OBSERVATION_SLICES.items()}
        centre, half = parts["object_position"][:, :2], parts["object_position"][:, 2:]
        away = centre / geometry.norm(centre)[:, None].clamp_min(1e-6)
        unseen = unseen_ahead(state[keys.CONFIDENCE_MAP], centre, half, away, loaded.config.map.resolution)
        return {
            "risk": outputs[keys.RISK].squeeze(-1),
            "uncertainty": outputs[keys.UNCERTAINTY].squeeze(-1),
            "unseen": unseen,
            "clearance": clearance(env).float(),
        }

    return watch


def normalised_costs(loaded: LoadedPolicy, notes: dict[str, NDArray[Any]]) -> dict[str, NDArray[np.float32]]:
    """Return the costs as they enter the advantage, normalised over parts as large as a rollout in training.

    Args:
        loaded: The checkpoint; floors, clip and weights are those that it was trained with.
        notes: From :func:`record`, N a multiple of the trained ``num_envs``, T of ``rollout_steps``.

    Returns:
        ``raw_risk``, ``raw_uncertainty``, ``risk``, ``uncertainty`` and their weighted ``sum``, shape ``[N, T]``; on
        terminated steps the uncertainty's are 0.
    """
    config, cura = loaded.config, loaded.config.cura
    data = {name: torch.from_numpy(value) for name, value in notes.items()}
    terminated = data["terminated"]
    raw_risk = risk_cost(data["cost"], data["risk"], data["next_risk"], terminated, gamma=cura.gamma)
    raw_uncertainty = uncertainty_cost(data["uncertainty"], data["next_uncertainty"]).masked_fill(terminated, 0.0)
    risk, uncertainty = torch.zeros_like(raw_risk), torch.zeros_like(raw_risk)
    for top in range(0, len(risk), config.num_envs):
        for left in range(0, risk.shape[1], config.ppo.rollout_steps):
            part = (slice(top, top + config.num_envs), slice(left, left + config.ppo.rollout_steps))
            risk[part] = normalise(raw_risk[part], floor=cura.risk_floor, clip=cura.cost_clip)
            uncertainty[part] = normalise(
                raw_uncertainty[part], floor=cura.uncertainty_floor, clip=cura.cost_clip, mask=~terminated[part]
            )
    total = cura.risk_coeff * risk + cura.uncertainty_coeff * uncertainty
    named = {"raw_risk": raw_risk, "raw_uncertainty": raw_uncertainty, "risk": risk, "uncertainty": uncertainty}
    return {name: value.numpy() for name, value in {**named, "sum": total}.items()}


def share_of(count: int, episodes: int) -> list[float]:
    """Return a rate with Wilson's 95 % interval [1]."""
    return [count / episodes, *wilson_interval(count, episodes)]
