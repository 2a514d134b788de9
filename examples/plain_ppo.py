"""The pushing task with nothing but TorchRL's own PPO: a vector observation, GAE, ``ClipPPOLoss`` and a perceptron.

The policy sees robot, box and goal, and no obstacle. The worlds are those of the planar simulator, for speed. With the
defaults (seed 0, 122,880 steps, about a minute on one core) the reward a step rises from -0.69 to 0.83.

python examples/plain_ppo.py
"""

from __future__ import annotations

import argparse

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import EnvBase, RewardScaling, TransformedEnv
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

from cura_torchrl import PushEnv
from cura_torchrl.envs.config import PushEnvConfig

REWARD_SCALE = 0.1
"""What the reward is multiplied by for the learner [1]: returns of hundreds are more than a plain critic fits."""


def make_networks(env: EnvBase) -> tuple[ProbabilisticActor, ValueOperator]:
    """Return actor and critic on the key ``observation``; the environment clamps actions to -1 to 1."""
    inputs, outputs = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    head = nn.Sequential(MLP(inputs, 2 * outputs, num_cells=[128, 64], activation_class=nn.ELU), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(head, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(inputs, 1, num_cells=[128, 64], activation_class=nn.ELU), in_keys=["observation"])
    return actor, critic


def main() -> None:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=30, help="rollouts to train on [1]")
    parser.add_argument("--num-envs", type=int, default=64, help="planar worlds in this process [1]")
    parser.add_argument("--steps", type=int, default=64, help="policy steps of each world in a rollout [1]")
    options = parser.parse_args()
    torch.manual_seed(0)

    worlds = PushEnv(options.num_envs, PushEnvConfig(simulator="planar"), seed=0)
    env = TransformedEnv(worlds, RewardScaling(loc=0.0, scale=REWARD_SCALE))
    actor, critic = make_networks(env)
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    loss_module = ClipPPOLoss(actor, critic, entropy_coeff=0.001, critic_coeff=0.01, loss_critic_type="l2")
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=3e-4)
    frames = options.num_envs * options.steps
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(frames), sampler=SamplerWithoutReplacement(), batch_size=min(frames, 512)
    )
    total = options.iterations * frames
    collector = Collector(
        env, actor, frames_per_batch=frames, total_frames=total, auto_register_policy_transforms=False
    )
    rewards = []
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
        rewards.append(rollout["next", "reward"].mean().item() / REWARD_SCALE)
        bar.set_postfix_str(f"reward {rewards[-1]:.2f} a step")
    collector.shutdown()
    print(f"reward a step: {rewards[0]:.2f} in the first rollout, {rewards[-1]:.2f} in the last")


if __name__ == "__main__":
    main()
