"""How many environment steps a second PushEnv makes on one core, beside the bare physics ticks of the same worlds.

Both loops run in the same process in turn and are timed by the processor time they take, so that figures and ratio
mean something on a machine that others use too: python benchmarks/env_throughput.py --num-envs 8 --steps 50
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import TYPE_CHECKING

import pybullet
import torch

from cura_torchrl.envs.push import PushEnv

if TYPE_CHECKING:
    from collections.abc import Callable


def steps_per_second(play: Callable[[], None], frames: int) -> float:
    """Return how many frames a loop makes in a second of processor time.

    Args:
        play: The loop.
        frames: Environment steps in it, all worlds taken together.
    """
    start = time.process_time()
    play()
    return frames / (time.process_time() - start)


def measure(num_envs: int, steps: int, rounds: int) -> dict[str, float]:
    """Return medians over the rounds.

    Args:
        num_envs: Worlds N.
        steps: Policy steps of a round.
        rounds: How often both loops are run.

    Returns:
        Environment steps a second of PushEnv and of the bare ticks, and their ratio's median, least and most.
    """
    env = PushEnv(num_envs)
    physics, task = env.config.physics, env.config.task
    ticks = round(task.policy_period / physics.control_period)
    clients = env._worlds._clients

    data = env.reset()

    def play() -> None:
        nonlocal data
        for _ in range(steps):
            data = env.step_and_maybe_reset(env.rand_action(data))[1]

    def tick() -> None:
        for client in clients:
            for _ in range(steps * ticks):
                pybullet.stepSimulation(physicsClientId=client)

    full, bare = [], []
    for _ in range(rounds):
        full.append(steps_per_second(play, num_envs * steps))
        bare.append(steps_per_second(tick, num_envs * steps))
    env.close()
    ratios = [one / other for one, other in zip(full, bare, strict=True)]
    return {
        "env_steps_per_second": statistics.median(full),
        "bare_steps_per_second": statistics.median(bare),
        "ratio": statistics.median(ratios),
        "ratio_min": min(ratios),
        "ratio_max": max(ratios),
    }


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=8, help="worlds in this process")
    parser.add_argument("--steps", type=int, default=50, help="policy steps of a round")
    parser.add_argument("--rounds", type=int, default=3, help="rounds of both loops; the first also warms up")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    result = measure(arguments.num_envs, arguments.steps, arguments.rounds)
    result |= {"num_envs": arguments.num_envs, "steps": arguments.steps, "rounds": arguments.rounds}
    if arguments.json:
        print(json.dumps(result))
        return
    print("In a second of processor time, all worlds taken together:")
    print(f"PushEnv, {arguments.num_envs} worlds: {result['env_steps_per_second']:.0f} env steps/s")
    print(f"bare physics ticks of the same worlds: {result['bare_steps_per_second']:.0f} env steps/s")
    print(f"ratio: {result['ratio']:.2f} ({result['ratio_min']:.2f} to {result['ratio_max']:.2f})")


if __name__ == "__main__":
    main()
