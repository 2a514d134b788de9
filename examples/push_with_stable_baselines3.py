"""The pushing task with somebody else's learner: PPO of Stable-Baselines3, through ``gymnasium.make``.

What the policy sees is what ours see: robot, box and goal, and the code of the confidence map. The cost of a collision
is in ``info``, and this learner has no use for it. Worlds are played one after the other, which is the price of
Gymnasium's interface. Needs ``pip install cura-torchrl[gym] stable-baselines3``.

python examples/push_with_stable_baselines3.py
"""

from __future__ import annotations

import argparse

import gymnasium
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from tqdm import tqdm

import cura_torchrl


class Progress(BaseCallback):
    """Keeps reward and cost a step of every rollout, before normalisation, and shows them on a progress bar."""

    def __init__(self, iterations: int) -> None:
        super().__init__()
        self.bar = tqdm(total=iterations, unit="rollout")
        self.rewards: list[float] = []
        self.costs: list[float] = []
        self.history: list[tuple[float, float]] = []

    def _on_step(self) -> bool:
        self.rewards += self.training_env.get_original_reward().tolist()
        self.costs += [info["cost"] for info in self.locals["infos"]]
        return True

    def _on_rollout_end(self) -> None:
        self.history.append((sum(self.rewards) / len(self.rewards), sum(self.costs) / len(self.costs)))
        self.rewards.clear()
        self.costs.clear()
        self.bar.set_postfix_str(f"reward {self.history[-1][0]:.2f} a step")
        self.bar.update()


def main() -> None:
    """Parse the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=20, help="rollouts to train on [1]")
    parser.add_argument("--num-envs", type=int, default=4, help="planar worlds, one after the other [1]")
    parser.add_argument("--steps", type=int, default=256, help="policy steps of each world in a rollout [1]")
    options = parser.parse_args()

    task = cura_torchrl.register_gym()
    worlds = make_vec_env(lambda: gymnasium.make(task, simulator="planar"), n_envs=options.num_envs, seed=0)
    env = VecNormalize(worlds, gamma=0.99)
    frames = options.num_envs * options.steps
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=options.steps,
        batch_size=min(frames, 256),
        n_epochs=5,
        policy_kwargs={"net_arch": [128, 64], "log_std_init": -0.5},
        seed=0,
        device="cpu",
    )
    progress = Progress(options.iterations)
    model.learn(options.iterations * frames, callback=progress)
    env.close()
    first, last = progress.history[0], progress.history[-1]
    print(f"reward a step: {first[0]:.2f} in the first rollout, {last[0]:.2f} in the last")
    print(f"collisions in the last: {last[1]:.1%} of steps")


if __name__ == "__main__":
    main()
