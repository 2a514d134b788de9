"""One update of the networks from one rollout."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import torch
from torch.nn.utils import clip_grad_norm_
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer

from cura_torchrl import keys
from cura_torchrl.modules.actor_critic import LOG_PROB_KEY
from cura_torchrl.trainers.build import build_advantage, build_loss, build_perceptual
from cura_torchrl.trainers.errors import NonFiniteError
from cura_torchrl.trainers.training.diagnostics import explained_variance, find_non_finite, risk_auroc

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from cura_torchrl.trainers.build import Networks
    from cura_torchrl.trainers.config import PPOConfig, TrainConfig


_SAMPLE_KEYS = (keys.ACTION, LOG_PROB_KEY, "loc", "scale")
"""What the collecting policy wrote beside what it read."""

_MINIBATCH_KEYS = (
    keys.OBSERVATION, keys.LATENT, *_SAMPLE_KEYS, keys.ADVANTAGE, keys.VALUE_TARGET, keys.COLLISION_TARGET,
)  # fmt: skip
"""What the loss reads. With an advantage among it, TorchRL's loss computes none of its own."""

_LOGGED = ("entropy", "clip_fraction", "ESS")
"""Diagnostics of TorchRL's loss that are kept."""


class Learner:
    """Networks, objective and optimisers.

    Args:
        config: Coefficients and sizes.
        networks: Networks to train, in place.
    """

    def __init__(self, config: TrainConfig, networks: Networks) -> None:
        self.networks = networks.to(config.device)
        self.frames = 0
        self.updates = 0
        self._config = config
        self._advantage = build_advantage(config, networks)
        self._loss_module = build_loss(config, networks)
        self._perceptual = build_perceptual(config, networks)
        # Each network has its own clip, in which the largest loss would decide for all, and its own learning rate: that
        # of the actor follows its KL divergence, and with small batches falls to where a critic would not learn.
        self._parts = {
            "actor": _Part(networks.actor, config.ppo.lr, config.ppo.max_grad_norm),
            "critic": _Part(networks.critic, config.ppo.critic_lr, config.ppo.max_grad_norm),
            "collision": _Part(networks.collision_estimator, config.cura.lr, config.cura.max_grad_norm),
        }
        for name in ("privileged", "perceptual"):
            network = getattr(networks, f"{name}_estimator")
            if network is not None:
                self._parts[name] = _Part(network, config.cura.lr, config.cura.max_grad_norm)
        size = min(config.ppo.minibatch_size, config.frames_per_batch)
        self._buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(config.frames_per_batch, device=config.device),
            sampler=SamplerWithoutReplacement(drop_last=True),
            batch_size=size,
        )

    def components(self) -> dict[str, Any]:
        """Return what a checkpoint holds.

        Returns:
            Objects with ``state_dict`` and ``load_state_dict``, by name.
        """
        return {
            "networks": self.networks,
            **{f"{name}_optimizer": part.optimizer for name, part in self._parts.items()},
            "counters": self,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return the counters and the state of the targets' random choices.

        Returns:
            Environment steps and updates so far [1], and the state of each generator.
        """
        state = {"frames": self.frames, "updates": self.updates, "generator": self._advantage.get_extra_state()}
        if self._perceptual is not None:
            state["perceptual_generator"] = self._perceptual.get_extra_state()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Set what :meth:`state_dict` returned.

        Args:
            state: Counters and the state of each generator.
        """
        self.frames, self.updates = int(state["frames"]), int(state["updates"])
        self._advantage.set_extra_state(state["generator"])
        if self._perceptual is not None:
            self._perceptual.set_extra_state(state["perceptual_generator"])

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Train on a rollout.

        Args:
            batch: Rollout, shape ``[N, T]``; not changed.

        Returns:
            Means over the update's minibatches, and statistics of critic and collision estimator before the update.

        Raises:
            NonFiniteError: If a number of the rollout, a loss or a gradient is not finite.
        """
        bad = find_non_finite(batch)
        if bad is not None:
            msg = f"{bad} of the rollout is not finite at {self.frames} frames; the last checkpoint is intact"
            raise NonFiniteError(msg)
        perceptual = self._perceptual
        extra = [] if perceptual is None else perceptual.rollout_keys
        data = batch.select(*self._advantage.in_keys, *_SAMPLE_KEYS, *extra).to(self._config.device)
        metrics = self._estimate(data)
        extra = [] if perceptual is None else perceptual.minibatch_keys
        self._buffer.empty()
        self._buffer.extend(data.select(*_MINIBATCH_KEYS, *extra).reshape(-1))
        sums: dict[str, torch.Tensor] = defaultdict(lambda: torch.zeros((), device=self._config.device))
        count = 0
        for _ in range(self._config.ppo.epochs):
            for minibatch in self._buffer:
                for name, value in self._step(minibatch).items():
                    sums[name] = sums[name] + value
                count += 1
        # After the last gradient step and before the next rollout: the policy that collects and the policy whose ratio
        # PPO takes read observations normalised by the same statistics.
        self.networks.observation_norm.update(data[keys.OBSERVATION])
        self.frames += batch.numel()
        self.updates += 1
        metrics |= {name: (value / count).item() for name, value in sums.items()}
        return metrics | {"lr": self._parts["actor"].rate, "std": data["scale"].mean().item()}

    @torch.no_grad()
    def _estimate(self, data: TensorDictBase) -> dict[str, float]:
        # Advantages and targets are written into the data, all from the networks that collected.
        cura = self._config.cura
        is_trained = self.frames >= cura.costs_start_frames
        self._advantage.risk_coeff.fill_(cura.risk_coeff if is_trained else 0.0)
        self._advantage.uncertainty_coeff.fill_(cura.uncertainty_coeff if is_trained else 0.0)
        self._advantage(data)
        if self._perceptual is not None:
            self._perceptual.targets(data)
        costs = {name: value.item() for name, value in self._advantage.diagnostics(data).items()}
        return {"explained_variance": explained_variance(data), **costs, "risk_auroc": risk_auroc(data)}

    def _step(self, minibatch: TensorDictBase) -> dict[str, torch.Tensor]:
        divergence = self._divergence(minibatch)
        self._adapt_rate(divergence.item())
        losses = self._loss_module(minibatch)
        if self._perceptual is not None:
            losses.update(self._perceptual.losses(minibatch))
        terms = {name: value for name, value in losses.items() if name.startswith("loss_")}
        total = torch.stack([value.reshape(()) for value in terms.values()]).sum()
        if not torch.isfinite(total):
            bad = ", ".join(name for name, value in terms.items() if not torch.isfinite(value).all())
            raise NonFiniteError(f"{bad} is not finite at {self.frames} frames; the last checkpoint is intact")
        if self.frames < self._config.ppo.critic_warmup_frames:
            total = total - losses["loss_objective"] - losses["loss_entropy"]
        for part in self._parts.values():
            part.optimizer.zero_grad(set_to_none=True)
        total.backward()
        norms = {f"{name}_grad_norm": self._clip(name, part) for name, part in self._parts.items()}
        for part in self._parts.values():
            part.optimizer.step()
        scalars = {name: value.detach().mean() for name, value in losses.items() if name in _LOGGED or name in terms}
        return {**scalars, **norms, "kl": divergence}

    def _clip(self, name: str, part: _Part) -> torch.Tensor:
        norm = clip_grad_norm_(part.parameters, part.max_grad_norm)
        if not torch.isfinite(norm):
            msg = f"gradient of the {name} network is not finite at {self.frames} frames; the last checkpoint is intact"
            raise NonFiniteError(msg)
        return norm

    @torch.no_grad()
    def _divergence(self, minibatch: TensorDictBase) -> torch.Tensor:
        """Return the mean KL divergence from the collecting to the present policy [nat]."""
        now = self.networks.actor.module[0](minibatch.select(keys.OBSERVATION, keys.LATENT))
        return gaussian_divergence(minibatch["loc"], minibatch["scale"], now["loc"], now["scale"]).mean()

    def _adapt_rate(self, divergence: float) -> None:
        part = self._parts["actor"]
        part.rate = adapted_rate(part.rate, divergence, self._config.ppo)


class _Part:
    """A network's parameters and what steps them."""

    def __init__(self, network: torch.nn.Module, lr: float, max_grad_norm: float) -> None:
        self.parameters = [*network.parameters()]
        self.max_grad_norm = max_grad_norm
        self.optimizer = torch.optim.Adam(self.parameters, lr=lr)

    @property
    def rate(self) -> float:
        """Learning rate [1]."""
        return float(self.optimizer.param_groups[0]["lr"])

    @rate.setter
    def rate(self, value: float) -> None:
        self.optimizer.param_groups[0]["lr"] = value


def gaussian_divergence(
    old_loc: torch.Tensor, old_scale: torch.Tensor, new_loc: torch.Tensor, new_scale: torch.Tensor
) -> torch.Tensor:
    """Return the KL divergence from one diagonal Gaussian to another.

    Args:
        old_loc: Mean of the first, shape ``[*, A]``.
        old_scale: Standard deviation of the first, shape ``[*, A]``.
        new_loc: Mean of the second, shape ``[*, A]``.
        new_scale: Standard deviation of the second, shape ``[*, A]``.

    Returns:
        KL(old || new) [nat], shape ``[*]``.

    Examples:
        >>> zero, one = torch.zeros(1), torch.ones(1)
        >>> gaussian_divergence(zero, one, one, one).item()  # (mean difference)^2 / 2
        0.5
    """
    ratio = old_scale / new_scale
    shift = (new_loc - old_loc) / new_scale
    return (0.5 * (ratio.square() + shift.square() - 1.0) - ratio.log()).sum(-1)


def adapted_rate(rate: float, divergence: float, config: PPOConfig) -> float:
    """Return the learning rate that steers the KL divergence to its target.

    Args:
        rate: Present learning rate [1].
        divergence: KL divergence from the collecting to the present policy [nat].
        config: Target, factor and bounds.

    Returns:
        The rate, lower where the divergence is above twice the target, higher where it is below half of it [1].

    Source:
        Schulman et al. (2017), Sec. 4, the adaptive KL rule, applied to the learning rate as rsl_rl does.

    Examples:
        >>> from cura_torchrl.trainers.config import PPOConfig
        >>> adapted_rate(0.003, 0.03, PPOConfig(target_kl=0.01))  # 0.003 / 1.5
        0.002
    """
    if config.target_kl == 0.0:
        return rate
    if divergence > 2.0 * config.target_kl:
        return max(config.min_lr, rate / config.lr_factor)
    if 0.0 < divergence < 0.5 * config.target_kl:
        return min(config.max_lr, rate * config.lr_factor)
    return rate
