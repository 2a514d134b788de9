"""One update: what it changes, what it leaves alone, and when it stops."""

from __future__ import annotations

import copy
import dataclasses
import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Independent, Normal, kl_divergence

from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE
from cura_torchrl.envs.transforms.obstacle_code import CODE_SIZE
from cura_torchrl.trainers.build import LATENT_SIZE, Networks
from cura_torchrl.trainers.config import PPOConfig, TrainConfig
from cura_torchrl.trainers.errors import NonFiniteError
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.training.learner import Learner, adapted_rate, gaussian_divergence

ROWS, STEPS = 4, 16


def build(name: str = "cura-ppo", **ppo: float) -> tuple[TrainConfig, Learner]:
    """A small learner, its costs on from the start."""
    config = method(name)
    sizes = {"actor_hidden_sizes": (16,), "critic_hidden_sizes": (16,), "collision_hidden_sizes": (16,)}
    config = config.replace(
        num_envs=ROWS,
        ppo=dataclasses.replace(config.ppo, rollout_steps=STEPS, minibatch_size=16, **ppo),
        cura=dataclasses.replace(config.cura, costs_start_frames=0, num_atoms=5),
        network=dataclasses.replace(config.network, **sizes),
    )
    return config, Learner(config, Networks(config))


def rollout(learner: Learner) -> TensorDict:
    """A rollout of noise in which the second row collides."""
    shape = (ROWS, STEPS)
    seen = {"observation": 2 + 3 * torch.randn(*shape, OBSERVATION_SIZE), "latent": torch.randn(*shape, LATENT_SIZE)}
    seen["obstacle_code"] = torch.rand(*shape, CODE_SIZE)
    batch = TensorDict(seen, shape)
    with torch.no_grad():
        learner.networks.actor(batch)
    hit = torch.zeros(*shape, 1, dtype=torch.bool)
    hit[1, 9] = True
    after = {
        "observation": seen["observation"].roll(-1, 1),
        "latent": seen["latent"].roll(-1, 1),
        "obstacle_code": seen["obstacle_code"].roll(-1, 1),
        "reward": torch.randn(*shape, 1),
        "cost": hit.float(),
        "done": hit,
        "terminated": hit,
    }
    return batch.set("next", TensorDict(after, shape))


def flat(parameters: object) -> torch.Tensor:
    """All parameters in one vector."""
    return torch.cat([parameter.detach().flatten().clone() for parameter in parameters])


def test_divergence_is_that_of_torch_s_distributions() -> None:
    """Catches KL(new || old) in place of KL(old || new), or a mean over actions in place of a sum."""
    old = Normal(torch.randn(7, 6), torch.rand(7, 6) + 0.1)
    new = Normal(torch.randn(7, 6), torch.rand(7, 6) + 0.1)
    expected = kl_divergence(Independent(old, 1), Independent(new, 1))
    torch.testing.assert_close(gaussian_divergence(old.loc, old.scale, new.loc, new.scale), expected)


@pytest.mark.parametrize(
    ("rate", "divergence", "expected"),
    [
        (3e-4, 0.021, 2e-4),  # above 2 * 0.01: divided by 1.5
        (2e-4, 0.0049, 3e-4),  # below 0.01 / 2: times 1.5
        (2e-4, 0.01, 2e-4),
        (1.2e-5, 1.0, 1e-5),  # not below the lower bound
        (9e-3, 1e-4, 1e-2),  # not above the upper bound
        (2e-4, 0.0, 2e-4),  # the first minibatch of a rollout says nothing
    ],
)
def test_the_rate_follows_the_divergence_within_its_bounds(rate: float, divergence: float, expected: float) -> None:
    """Catches a rate that runs away, and the factor upside down."""
    config = PPOConfig(target_kl=0.01, lr_factor=1.5, min_lr=1e-5, max_lr=1e-2)
    assert adapted_rate(rate, divergence, config) == pytest.approx(expected)


def test_a_target_of_zero_keeps_the_rate() -> None:
    """Catches a fixed learning rate that falls to its lower bound."""
    assert adapted_rate(3e-4, 1.0, PPOConfig(target_kl=0.0)) == 3e-4


def test_the_critic_keeps_its_rate_when_that_of_the_actor_falls() -> None:
    """Catches a critic that stops learning because small batches make the policy's steps small."""
    config, learner = build(target_kl=1e-9, lr=1e-3, min_lr=1e-5)
    metrics = learner.update(rollout(learner))
    rates = {
        name: component.param_groups[0]["lr"]
        for name, component in learner.components().items()
        if name.endswith("optimizer")
    }
    # 19 of 20 minibatches come after the first step, which moves the policy: 1e-3 / 1.5 ** 19 is below the bound.
    assert metrics["lr"] == rates["actor_optimizer"] == 1e-5
    assert rates["critic_optimizer"] == config.ppo.critic_lr
    assert rates["collision_optimizer"] == config.cura.lr


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("cura-ppo", ("actor", "critic", "collision_estimator")),
        ("cura-cvar", ("actor", "critic", "collision_estimator")),
        (
            "cura-perceptual",
            ("actor", "critic", "collision_estimator", "privileged_estimator", "perceptual_estimator"),
        ),
    ],
)
def test_an_update_changes_all_networks_and_reports_finite_numbers(name: str, parts: tuple[str, ...]) -> None:
    """Catches a network that no optimiser holds, and one that a method does not need."""
    _, learner = build(name)
    assert {name.split(".")[0] for name, _ in learner.networks.named_parameters()} == set(parts)
    parts = [getattr(learner.networks, part) for part in parts]
    before = [flat(part.parameters()) for part in parts]
    metrics = learner.update(rollout(learner))
    for part, old in zip(parts, before, strict=True):
        assert not torch.equal(flat(part.parameters()), old)
    assert (learner.frames, learner.updates) == (ROWS * STEPS, 1)
    assert {"kl", "lr", "std", "explained_variance", "risk_auroc", "energy_distance", "loss_collision"} <= set(metrics)
    assert all(math.isfinite(value) for value in metrics.values())


def test_policies_are_compared_under_the_same_normalisation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches statistics updated before the gradient steps: the first ratio would not be 1."""
    _, learner = build(target_kl=0.0)
    learner.update(rollout(learner))  # statistics that are not the identity
    batch = rollout(learner)
    divergences = []
    step = learner._step
    monkeypatch.setattr(learner, "_step", lambda data: divergences.append(learner._divergence(data)) or step(data))
    count = learner.networks.observation_norm.count.clone()
    learner.update(batch)
    assert divergences[0].abs() < 1e-6
    assert divergences[-1] > 1e-6
    assert learner.networks.observation_norm.count == count + batch.numel()


def test_costs_enter_only_once_the_estimator_has_been_trained() -> None:
    """Catches an untrained estimator whose noise, normalised to 1, drives the policy."""
    config, _ = build()
    late = config.replace(cura=dataclasses.replace(config.cura, costs_start_frames=ROWS * STEPS))
    learner = Learner(late, Networks(late))
    assert learner.update(rollout(learner))["uncertainty_weight"] == 0.0
    assert learner.update(rollout(learner))["uncertainty_weight"] > 0.0


@pytest.mark.parametrize("key", ["reward", "observation"])
def test_a_number_that_is_not_finite_stops_the_step_and_leaves_the_weights(key: str) -> None:
    """Catches a NaN that is trained into the weights, and from there into the next checkpoint."""
    _, learner = build()
    batch = rollout(learner)
    batch["next", key][2, 3] = float("nan")
    before = flat(learner.networks.parameters())
    with pytest.raises(NonFiniteError, match=f"next.{key} of the rollout is not finite at 0 frames"):
        learner.update(batch)
    assert torch.equal(flat(learner.networks.parameters()), before)


def test_without_costs_the_estimators_beyond_the_paper_change_nothing_else() -> None:
    """Catches an estimator whose first weights, random choices or gradients reach actor or critic."""
    results = []
    for name in ("cura-ppo", "cura-perceptual"):
        torch.manual_seed(5)
        config, _ = build(name)
        config = config.replace(cura=dataclasses.replace(config.cura, risk_coeff=0.0, uncertainty_coeff=0.0))
        torch.manual_seed(5)
        networks = Networks(config)
        torch.manual_seed(6)
        learner = Learner(config, networks)
        learner.update(rollout(learner))
        parts = (networks.actor, networks.critic, networks.collision_estimator)
        results.append([flat(part.parameters()) for part in parts])
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


@pytest.mark.parametrize("name", ["cura-ppo", "cura-perceptual"])
def test_a_learner_that_is_restored_goes_on_as_if_it_had_not_stopped(name: str) -> None:
    """Catches state that no checkpoint holds: optimisers, learning rate, the targets' random choices."""
    _, learner = build(name)
    batches = [rollout(learner) for _ in range(2)]
    learner.update(batches[0])
    _, other = build(name)
    for key, component in learner.components().items():
        other.components()[key].load_state_dict(copy.deepcopy(component.state_dict()))
    results = []
    for one in (learner, other):
        torch.manual_seed(3)  # the minibatches' order, which the checkpoint's global generator restores
        results.append((one.update(batches[1].clone()), flat(one.networks.parameters())))
    assert results[0][0] == pytest.approx(results[1][0], nan_ok=True)
    assert torch.equal(results[0][1], results[1][1])
