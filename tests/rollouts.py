"""Small rollouts and networks for the objective."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from torch import nn

from cura_torchrl.modules import DistributionalCollisionEstimator, make_critic

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModule

ENVS, STEPS = 6, 16


def make_networks() -> tuple[TensorDictModule, DistributionalCollisionEstimator]:
    """Return a critic and an estimator, always the same."""
    torch.manual_seed(1)
    return make_critic(5, hidden_sizes=(16,)), DistributionalCollisionEstimator(5, num_atoms=10, hidden_sizes=(16,))


def make_rollout(seed: int = 0) -> TensorDict:
    """Return a random rollout in which a tenth of the steps end for good, and as many by truncation."""
    torch.manual_seed(seed)

    def seen() -> dict[str, torch.Tensor]:
        return {"observation": torch.randn(ENVS, STEPS, 3), "latent": torch.randn(ENVS, STEPS, 2)}

    terminated = torch.rand(ENVS, STEPS, 1) < 0.1
    done = terminated | (torch.rand(ENVS, STEPS, 1) < 0.1)
    signals = {"reward": torch.randn(ENVS, STEPS, 1), "cost": terminated.float()}
    return TensorDict({**seen(), "next": {**seen(), **signals, "done": done, "terminated": terminated}}, [ENVS, STEPS])


class StateEstimator(nn.Module):
    """An estimator whose risk and uncertainty are read off the observation: two atoms at r +- sqrt(u)."""

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, ...]:  # noqa: D102
        risk, uncertainty = observation[..., :1], observation[..., 1:]
        return torch.cat([risk - uncertainty.sqrt(), risk + uncertainty.sqrt()], -1), risk, uncertainty
