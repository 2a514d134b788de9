"""A method of one's own, "map-entropy": PPO that is paid for what its map shows.

No collision estimator, no costs. ``MapEntropyBonus`` is all of the method; the loop is that of ``train_in_a_loop.py``.
With the defaults (seed 0, 51,200 steps) the last rollout has a reward of 0.57 and a bonus of 0.88 a step.

python examples/a_method_of_ones_own.py
"""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from cura_torchrl import ConfidenceMap, EncodeMap, PushEnv
from cura_torchrl.envs.config import PushEnvConfig
from cura_torchrl.modules import make_actor, make_critic
from cura_torchrl.trainers.build import load_encoder

if TYPE_CHECKING:
    from tensordict import TensorDictBase


def entropy_ahead(window: torch.Tensor, half_width: int) -> torch.Tensor:
    """Return the mean entropy of the cells ahead of the robot [bit], shape ``[*B, 1]``.

    A cell of confidence c is occupied with probability (1 + c) / 2 if it was last seen occupied, else (1 - c) / 2. The
    entropy is the same for both: 0 where it is seen just now, 1 where it was never seen.

    Args:
        window: Confidence first among its channels [1], shape ``[*B, C, W, W]``; row 0 lies behind, the last one ahead.
        half_width: Cells to each side of the robot's middle that count [1].
    """
    middle = window.shape[-1] // 2
    probability = (1.0 + window[..., 0, middle:, middle - half_width : middle + half_width]) / 2.0
    bits = (torch.special.entr(probability) + torch.special.entr(1.0 - probability)) / math.log(2.0)
    return bits.mean((-2, -1)).unsqueeze(-1)


class MapEntropyBonus(Transform):
    """Adds ``coeff`` times what is known of the ground ahead, 1 - entropy [1], to the reward of each step.

    It pays for the level. The drop of the entropy from step to step would sum to almost nothing over an episode: what
    looking away costs, looking back earns.

    It reads ``confidence_map``, so it stands between ``ConfidenceMap`` and ``EncodeMap``, which removes the map.
    """

    def __init__(self, coeff: float, half_width: int = 20) -> None:
        super().__init__(in_keys=["confidence_map", "reward"], out_keys=["reward"])
        self.coeff, self.half_width = coeff, half_width

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        known = 1.0 - entropy_ahead(next_tensordict["confidence_map"], self.half_width)
        return next_tensordict.set("reward", next_tensordict["reward"] + self.coeff * known)


def make_env(num_envs: int, coeff: float) -> EnvBase:
    """Return worlds of the planar simulator whose reward has the bonus."""
    seeing = ConfidenceMap(num_rays=360, max_range=10.0)
    transforms = Compose(seeing, MapEntropyBonus(coeff), EncodeMap(load_encoder(None)))
    return TransformedEnv(PushEnv(num_envs, PushEnvConfig(simulator="planar"), seed=0), transforms)


def main() -> None:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=25, help="rollouts to train on [1]")
    parser.add_argument("--num-envs", type=int, default=32, help="planar worlds in this process [1]")
    parser.add_argument("--steps", type=int, default=64, help="policy steps of each world in a rollout [1]")
    parser.add_argument(
        "--coeff", type=float, default=1.0, help="bonus of a step that sees all of the ground ahead [1]"
    )
    options = parser.parse_args()
    torch.manual_seed(0)

    env = make_env(options.num_envs, options.coeff)
    inputs = sum(env.observation_spec[key].shape[-1] for key in ("observation", "latent"))
    actor, critic = make_actor(inputs, env.action_spec.shape[-1]), make_critic(inputs, scale=100.0)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    loss_module = ClipPPOLoss(actor, critic, entropy_coeff=0.005, critic_coeff=1e-4, loss_critic_type="l2")
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=3e-4)
    frames = options.num_envs * options.steps
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(frames), sampler=SamplerWithoutReplacement(), batch_size=min(frames, 512)
    )
    total = options.iterations * frames
    collector = Collector(
        env, actor, frames_per_batch=frames, total_frames=total, auto_register_policy_transforms=False
    )
    for rollout in (bar := tqdm(collector, total=options.iterations, unit="rollout")):
        with torch.no_grad():
            advantage(rollout)
        buffer.empty()
        buffer.extend(rollout.select(*loss_module.in_keys, "advantage", "value_target", strict=False).reshape(-1))
        for _ in range(5):
            for minibatch in buffer:
                losses = loss_module(minibatch)
                optimizer.zero_grad()
                sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
                torch.nn.utils.clip_grad_norm_(loss_module.parameters(), 1.0)
                optimizer.step()
        reward, task, cost = (rollout["next", key].sum(-1).mean() for key in ("reward", "reward_terms", "cost"))
        reached = f"reward {task:.2f} a step, bonus {reward - task:.2f}, collisions {cost:.2%} of steps"
        bar.set_postfix_str(reached)
    collector.shutdown()
    print(f"last rollout: {reached}")


if __name__ == "__main__":
    main()
