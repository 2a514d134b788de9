"""CURA-PPO in a TorchRL loop of one's own: nothing of ``cura_torchrl.trainers`` but the shipped encoder.

python examples/train_in_a_loop.py --iterations 50
"""

from __future__ import annotations

import argparse

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, TransformedEnv
from tqdm import tqdm

from cura_torchrl import (
    ConfidenceMap,
    CURAAdvantage,
    CURALoss,
    DistributionalCollisionEstimator,
    EncodeMap,
    PushEnv,
)
from cura_torchrl.modules import make_actor, make_critic
from cura_torchrl.trainers.build import load_encoder


def make_env(num_envs: int) -> EnvBase:
    """Return worlds whose policy sees robot, object and goal as a vector and the confidence map as a code."""
    transforms = Compose(ConfidenceMap(num_rays=360, max_range=10.0), EncodeMap(load_encoder(None)))
    return TransformedEnv(PushEnv(num_envs, seed=0), transforms)


def main() -> None:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=50, help="rollouts to train on [1]")
    parser.add_argument("--num-envs", type=int, default=16, help="PyBullet worlds in this process [1]")
    parser.add_argument("--steps", type=int, default=64, help="policy steps of each world in a rollout [1]")
    options = parser.parse_args()
    torch.manual_seed(0)

    env = make_env(options.num_envs)
    inputs = sum(env.observation_spec[key].shape[-1] for key in ("observation", "latent"))
    actor, critic = make_actor(inputs, env.action_spec.shape[-1]), make_critic(inputs, scale=100.0)
    estimator = DistributionalCollisionEstimator(inputs)
    advantage = CURAAdvantage(critic, estimator)
    loss_module = CURALoss(actor, critic, estimator, entropy_coeff=0.005, critic_coeff=1e-4, loss_critic_type="l2")
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=3e-4)
    frames = options.num_envs * options.steps
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(frames), sampler=SamplerWithoutReplacement(), batch_size=min(frames, 512)
    )
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=options.iterations * frames,
        auto_register_policy_transforms=False,
    )
    for rollout in (bar := tqdm(collector, total=options.iterations, unit="rollout")):
        advantage(rollout)  # once per rollout, from the networks that collected
        buffer.empty()
        buffer.extend(rollout.select(*loss_module.in_keys, "advantage", "value_target", strict=False).reshape(-1))
        for _ in range(5):
            for minibatch in buffer:
                losses = loss_module(minibatch)
                optimizer.zero_grad()
                sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
                torch.nn.utils.clip_grad_norm_(loss_module.parameters(), 1.0)
                optimizer.step()
        reward, cost = (rollout["next", name].mean().item() for name in ("reward", "cost"))
        bar.set_postfix_str(f"reward {reward:.2f} a step, collisions {cost:.2%} of steps")
    collector.shutdown()


if __name__ == "__main__":
    main()
