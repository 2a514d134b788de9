"""Where the time of one training iteration goes: seconds of each part, and frames a second, as JSON.

One process collects and learns in turn, with as many threads as OMP_NUM_THREADS says:
OMP_NUM_THREADS=2 python benchmarks/iteration_profile.py --simulator planar --num-envs 1024
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from cura_torchrl.trainers.build import Networks, build_collector
from cura_torchrl.trainers.info import provenance
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.training.learner import Learner

if TYPE_CHECKING:
    from collections.abc import Callable


class Stopwatch:
    """Adds up the time that methods take, each without those inside it that are measured too."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner: list[float] = []

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Measure a method from now on.

        Args:
            owner: Object or class that has it.
            name: Name of the method.
            part: What its time is counted as.
        """
        original: Callable[..., Any] = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            self._inner.append(0.0)
            start = time.perf_counter()
            try:
                return original(*arguments, **options)
            finally:
                spent = time.perf_counter() - start
                self.seconds[part] += spent - self._inner.pop()
                if self._inner:
                    self._inner[-1] += spent

        setattr(owner, name, timed)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--simulator", choices=("bullet", "planar"), default="planar", help="where to collect")
    parser.add_argument("--num-envs", type=int, default=1024, help="environments [1]")
    parser.add_argument("--steps", type=int, default=24, help="steps of a rollout in each of them [1]")
    parser.add_argument("--minibatch-size", type=int, default=2048, help="samples of a gradient step [1]")
    parser.add_argument("--output", type=Path, help="file for the figures; PyBullet greets on standard output")
    options = parser.parse_args()
    base = method("cura-ppo")
    ppo = dataclasses.replace(base.ppo, rollout_steps=options.steps, minibatch_size=options.minibatch_size)
    frames = options.num_envs * options.steps
    config = base.replace(
        simulator=options.simulator, num_envs=options.num_envs, num_workers=1, ppo=ppo, total_frames=2 * frames
    )
    networks, watch = Networks(config), Stopwatch()
    learner = Learner(config, networks)
    with build_collector(config, networks.actor, frames_done=0) as collector:
        batches = iter(collector)
        learner.update(next(batches))  # worlds, work space and optimisers are made
        env = collector.env
        pushing, (confidence_map, encode_map) = env.base_env, env.transform
        watch.watch(pushing._worlds, "advance", "physics, control and IK")
        watch.watch(pushing._lidar, "scan", "LiDAR")
        watch.watch(pushing, "_step", "rest of the environment")
        watch.watch(pushing, "_reset", "resets")
        watch.watch(confidence_map, "_observe", "confidence map")
        watch.watch(encode_map, "_encode", "encoder")
        start = time.perf_counter()
        batch = next(batches)
        collected = time.perf_counter()
        learner.update(batch)
        finished = time.perf_counter()
    watch.seconds["collector and policy"] = collected - start - sum(watch.seconds.values())
    watch.seconds["learner"] = finished - collected
    total = finished - start
    report = {
        **provenance(),
        "threads": torch.get_num_threads(),
        "frames": batch.numel(),
        "frames_per_second": round(batch.numel() / total),
        "seconds": {part: round(value, 3) for part, value in sorted(watch.seconds.items(), key=lambda item: -item[1])},
        "share": {part: round(value / total, 3) for part, value in watch.seconds.items()},
    }
    text = json.dumps(report, indent=2)
    print(text)
    if options.output is not None:
        options.output.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
