"""How many environment steps a second the planar simulator makes in one process, beside PyBullet in two.

All are measured in turn in one run, by the clock on the wall, so leave the machine alone meanwhile; prints JSON:
OMP_NUM_THREADS=2 python benchmarks/simulators.py --num-envs 1024 --rounds 3
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import statistics
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch

from cura_torchrl.envs.config import PushEnvConfig, Simulator
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.trainers.info import provenance

_ENVS: dict[str, PushEnv] = {}


def play(simulator: Simulator, num_envs: int, steps: int) -> float:
    """Play random actions with automatic resets in this process, whose worlds are kept for the next call.

    Args:
        simulator: Which simulator.
        num_envs: Worlds N.
        steps: Policy steps.

    Returns:
        Seconds that it took.
    """
    if simulator not in _ENVS:
        _ENVS[simulator] = PushEnv(num_envs, PushEnvConfig(simulator=simulator))
    env = _ENVS[simulator]
    data = env.reset()
    start = time.perf_counter()
    for _ in range(steps):
        data = env.step_and_maybe_reset(env.rand_action(data))[1]
    return time.perf_counter() - start


def play_in_processes(pool: ProcessPoolExecutor, workers: int, num_envs: int, steps: int) -> float:
    """Play on PyBullet in several processes at once.

    Args:
        pool: The processes.
        workers: How many there are.
        num_envs: Worlds in each.
        steps: Policy steps.

    Returns:
        Environment steps a second of all together.
    """
    seconds = list(pool.map(play, ["bullet"] * workers, [num_envs] * workers, [steps] * workers))
    return workers * num_envs * steps / max(seconds)


def _one_thread() -> None:
    torch.set_num_threads(1)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=1024, help="planar worlds [1]")
    parser.add_argument("--workers", type=int, default=2, help="processes with PyBullet [1]")
    parser.add_argument("--worlds", type=int, default=32, help="PyBullet worlds in each of them [1]")
    parser.add_argument("--rounds", type=int, default=3, help="how often both are measured [1]")
    parser.add_argument("--steps", type=int, default=20, help="policy steps of a round [1]")
    parser.add_argument("--output", type=Path, help="file for the figures; PyBullet greets on standard output")
    options = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    rows: dict[str, list[float]] = {"bullet": [], "planar": []}
    with ProcessPoolExecutor(options.workers, mp_context=context, initializer=_one_thread) as pool:
        for index in range(options.rounds + 1):
            bullet = play_in_processes(pool, options.workers, options.worlds, options.steps)
            planar = options.num_envs * options.steps / play("planar", options.num_envs, options.steps)
            if index > 0:  # the first round builds the worlds
                rows["bullet"].append(bullet)
                rows["planar"].append(planar)
    ratios = [planar / bullet for planar, bullet in zip(rows["planar"], rows["bullet"], strict=True)]
    report = {
        **provenance(),
        "threads": torch.get_num_threads(),
        "env_steps_per_second": {name: round(statistics.median(values)) for name, values in rows.items()},
        "ratio": {
            "median": round(statistics.median(ratios), 2),
            "least": round(min(ratios), 2),
            "most": round(max(ratios), 2),
        },
    }
    text = json.dumps(report, indent=2)
    print(text)
    if options.output is not None:
        options.output.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
