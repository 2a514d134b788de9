"""What the objective costs beside PPO's, the energy distance beside its definition, and an update beside its losses."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torchrl.objectives import ClipPPOLoss

from cura_torchrl import keys
from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE
from cura_torchrl.envs.robots.ridgeback_franka import ACTION_SIZE
from cura_torchrl.modules import DistributionalCollisionEstimator, make_actor, make_critic
from cura_torchrl.objectives import CURALoss
from cura_torchrl.objectives.energy import energy_distance
from cura_torchrl.trainers.benches.report import Report, measure, rates, timed
from cura_torchrl.trainers.build import LATENT_SIZE, Networks
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.training.learner import Learner

if TYPE_CHECKING:
    from collections.abc import Callable

    from cura_torchrl.trainers.benches.config import BenchConfig

ATOMS = 50
"""Atoms of prediction and target [1]."""


def run(config: BenchConfig) -> Report:
    """Measure loss, energy distance and update.

    Args:
        config: How.

    Returns:
        CURALoss beside ClipPPOLoss and the estimator's own passes, sorted beside all pairs, frames a second.
    """
    report = Report()
    measure_loss(config, report)
    measure_distance(config, report)
    measure_update(config, report)
    return report


def make_rollout(rows: int, steps: int) -> TensorDict:
    """Return a rollout of noise with a collision in every second row: losses cost the same whatever the numbers.

    Args:
        rows: Worlds N.
        steps: Policy steps T.

    Returns:
        Batch ``[N, T]`` with what a collector writes, but for the policy's keys.
    """
    hit = torch.zeros(rows, steps, 1, dtype=torch.bool)
    hit[::2, steps // 2] = True

    def see() -> dict[str, torch.Tensor]:
        return {
            keys.OBSERVATION: torch.randn(rows, steps, OBSERVATION_SIZE),
            keys.LATENT: torch.randn(rows, steps, LATENT_SIZE),
        }

    flags = {"done": hit, "terminated": hit, "truncated": torch.zeros_like(hit)}
    signals = {keys.REWARD: torch.randn(rows, steps, 1), keys.COST: hit.float()}
    return TensorDict({**see(), "next": {**see(), **flags, **signals}}, [rows, steps])


def measure_loss(config: BenchConfig, report: Report) -> None:
    """Compare CURALoss with ClipPPOLoss of the same networks and passes of the same estimator.

    Args:
        config: How.
        report: Where the figures go.
    """
    batch, inputs = config.batch_size, OBSERVATION_SIZE + LATENT_SIZE
    actor, critic = make_actor(inputs, ACTION_SIZE), make_critic(inputs)
    estimator = DistributionalCollisionEstimator(inputs, num_atoms=ATOMS)
    minibatch = make_rollout(batch, 1)[:, 0]
    with torch.no_grad():
        minibatch = actor(minibatch).exclude("loc", "scale")
        target = estimator(minibatch.select(*estimator.in_keys))[keys.COLLISION_ATOMS].flip(0)
    minibatch[keys.COLLISION_TARGET] = target
    minibatch[keys.ADVANTAGE], minibatch[keys.VALUE_TARGET] = torch.randn(2, batch, 1)
    ours, theirs = CURALoss(actor, critic, estimator), ClipPPOLoss(actor, critic)

    def ppo_and_estimator() -> None:
        _pass(theirs, minibatch)
        estimator(minibatch.select(*estimator.in_keys))[keys.COLLISION_ATOMS].sum().backward()

    plays = {"CURALoss": timed(functools.partial(_pass, ours, minibatch)), "reference": timed(ppo_and_estimator)}
    taken = measure(plays, 5 * config.rounds, "losses")
    report.add_figure(f"CURALoss, {batch} samples", rates(batch, taken["CURALoss"]), "samples/s")
    name = "CURALoss / (ClipPPOLoss + estimator's passes)"
    report.add_ratio(name, taken["CURALoss"], taken["reference"], "<= 1.15")


def _pass(loss: ClipPPOLoss, minibatch: TensorDict) -> None:
    """Take the losses of a minibatch, forward and backward."""
    losses = loss(minibatch)
    sum(value for name, value in losses.items() if name.startswith("loss_")).backward()


def all_pairs(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the energy distance by its definition, from the differences of all pairs of atoms.

    Args:
        prediction: Atoms, shape ``[B, N]``.
        target: Atoms, shape ``[B, M]``.

    Returns:
        Distance, shape ``[B]``.

    Examples:
        >>> all_pairs(torch.tensor([[0.0]]), torch.tensor([[2.0]])).item()  # 2 E|X - Y|
        4.0
    """

    def mean(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (x[..., :, None] - y[..., None, :]).abs().mean((-2, -1))

    return 2.0 * mean(prediction, target) - mean(prediction, prediction) - mean(target, target)


def measure_distance(config: BenchConfig, report: Report) -> None:
    """Compare the energy distance with its definition, forward and backward.

    Args:
        config: How.
        report: Where the figures go.
    """
    batch, results = 4 * config.batch_size, {}
    # No two atoms of a sample are equal: there the gradient would be a matter of taste.
    merged = (torch.rand(batch, 2 * ATOMS).argsort(-1) + 0.5 * torch.rand(batch, 2 * ATOMS)) / (2 * ATOMS)
    prediction, target = merged[:, :ATOMS].clone().requires_grad_(), merged[:, ATOMS:].clone()

    def play(name: str, function: Callable[..., torch.Tensor]) -> None:
        value = function(prediction, target)
        results[name] = value.detach(), torch.autograd.grad(value.sum(), prediction)[0]

    functions = {"sorted": energy_distance, "all pairs": all_pairs}
    plays = {name: timed(functools.partial(play, name, function)) for name, function in functions.items()}
    taken = measure(plays, config.rounds, "energy distance")
    report.add_figure(f"energy distance, {batch} x {ATOMS} atoms", rates(batch, taken["sorted"]), "samples/s")
    report.add_ratio("all pairs / sorted energy distance", taken["all pairs"], taken["sorted"], ">= 15")
    for label, one, other in zip(("value", "gradient"), results["sorted"], results["all pairs"], strict=True):
        difference = (one - other).abs().max().item()
        report.add_check(f"sorted and all pairs, difference of the {label}", difference, 1e-6)


def measure_update(config: BenchConfig, report: Report) -> None:
    """Time an update of cura-ppo on a rollout of 24 steps, beside its losses forward and backward.

    Args:
        config: How.
        report: Where the figures go.
    """
    preset, steps = method("cura-ppo"), 24
    rows = max(1, 4 * config.batch_size // steps)
    ppo = dataclasses.replace(preset.ppo, rollout_steps=steps, minibatch_size=min(config.batch_size, rows * steps))
    train = preset.replace(num_envs=rows, ppo=ppo, learner_threads=1)
    learner, rollout = Learner(train, Networks(train)), make_rollout(rows, steps)
    with torch.no_grad():
        learner.networks.actor(rollout)
    minibatch = rollout.reshape(-1)[: ppo.minibatch_size].clone()
    minibatch[keys.ADVANTAGE], minibatch[keys.VALUE_TARGET] = torch.randn(2, len(minibatch), 1)
    minibatch[keys.COLLISION_TARGET] = torch.rand(len(minibatch), train.cura.num_atoms)

    one_pass = functools.partial(_pass, learner._loss_module, minibatch)
    plays = {"update": timed(functools.partial(learner.update, rollout)), "one pass": timed(one_pass)}
    taken = measure(plays, config.rounds, "updates")
    count = ppo.epochs * (rows * steps // ppo.minibatch_size)
    report.add_figure(
        f"update of {ppo.epochs} epochs, {rows * steps} frames", rates(rows * steps, taken["update"]), "frames/s"
    )
    report.add_ratio(
        "update / its losses, forward and backward", taken["update"], [count * one for one in taken["one pass"]]
    )
