"""What a cluster of N nodes would collect and learn a second, from what one machine can measure; prints JSON.

Measured: bytes of a frame and of the policy's weights, frames a second of one collecting core and of the learner, and
the time that Ray takes to send weights to k workers and to fetch a rollout from them. The sum of these is the model; it
is checked against whole rollouts of the Ray backend: python benchmarks/scaling.py > benchmarks/results/scaling.json
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import ray
import torch
from ray import cloudpickle
from tensordict import TensorDict, TensorDictBase

from cura_torchrl.trainers.build import Networks, build_collector
from cura_torchrl.trainers.info import provenance
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.training.learner import Learner
from cura_torchrl.trainers.training.ray_backend import without_scan

if TYPE_CHECKING:
    from collections.abc import Callable

    from cura_torchrl.trainers.config import TrainConfig

ROUNDS = 7
"""How often a thing is timed [1]; the shortest counts, since what else runs on the machine only adds."""
WORKERS = (1, 2, 4, 8)
"""Numbers of workers that Ray's calls are timed with [1]."""
CHECKED_WORKERS = (1, 2, 4)
"""Numbers of workers that whole rollouts are checked with [1]."""
NODES = (1, 8, 64, 1000)
"""Sizes of the clusters that are predicted [1]."""
CORES_PER_NODE = 8
"""Assumption: processors of a node, a worker on each [1]."""
BYTES_PER_SECOND = 1.25e9
"""Assumption: what the learner's network takes in or gives out, 10 Gbit/s [byte/s]."""
WORLDS_PER_WORKER = 8
"""Assumption for rollouts that grow with the cluster: worlds of a worker [1]."""


@dataclass(frozen=True, kw_only=True)
class Costs:
    """What the model is made of."""

    frame_bytes: float
    """A frame as it is sent [byte]."""
    weight_bytes: float
    """The policy's weights as they are sent [byte]."""
    core_fps: float
    """Frames that one core collects [1/s]."""
    learner_fps: float
    """Frames that the learner learns from [1/s]."""
    fetch_seconds_per_frame: float
    """Time of the learner's process to take a frame from Ray [s]."""
    call_seconds: float
    """Time that an iteration waits for the answers of a single worker [s]."""
    call_seconds_per_worker: float
    """Part of an iteration's calls that each worker adds [s]."""

    def seconds(self, *, frames: int, workers: int, nodes: int) -> dict[str, float]:
        """Return the parts of an iteration's time, which follow one another [s].

        Args:
            frames: Frames of a rollout.
            workers: Workers of all nodes.
            nodes: Nodes; each gets the weights once.
        """
        return {
            "collect": frames / (workers * self.core_fps),
            "learn": frames / self.learner_fps,
            "fetch": frames * self.fetch_seconds_per_frame,
            "network": (frames * self.frame_bytes + nodes * self.weight_bytes) / BYTES_PER_SECOND,
            "calls": self.call_seconds + workers * self.call_seconds_per_worker,
        }


def least_seconds(call: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return how long a call takes [s].

    Args:
        call: What to time; it runs once more, first, to warm up.
        clock: Clock of the wall or of the processor.
    """
    call()
    times = []
    for _ in range(ROUNDS):
        start = clock()
        call()
        times.append(clock() - start)
    return min(times)


def measure_frames(config: TrainConfig) -> tuple[dict[str, float], TensorDictBase]:
    """Return bytes of a frame, frames a second of a core, and a rollout as it is sent.

    Args:
        config: A run with one worker.
    """
    with build_collector(config, Networks(config).actor, frames_done=0) as collector:
        batch = collector.next()
        seconds = least_seconds(collector.next, time.process_time)
    sent = without_scan(batch)
    return {
        "frame_bytes_collected": batch.bytes() / batch.numel(),
        "frame_bytes": sent.bytes() / sent.numel(),
        "frame_bytes_pickled": len(cloudpickle.dumps(sent)) / sent.numel(),
        "core_fps": batch.numel() / seconds,
    }, sent


def measure_learner(config: TrainConfig, rollout: TensorDictBase) -> dict[str, float]:
    """Return frames a second of the learner, by the clock and in processor time of its one thread.

    Args:
        config: A run.
        rollout: A rollout of this configuration's size.
    """
    learner = Learner(config, Networks(config))
    return {
        "learner_fps": rollout.numel() / least_seconds(lambda: learner.update(rollout), time.process_time),
        "learner_fps_wall": rollout.numel() / least_seconds(lambda: learner.update(rollout)),
    }


def measure_calls(workers: list[Any], weights: TensorDictBase, rollout: TensorDictBase) -> dict[str, Any]:
    """Return what Ray's calls to k of the workers take, by call and k.

    Args:
        workers: Remote collectors, idle.
        weights: Weights of their policy.
        rollout: Rollout that the workers hold in equal shares.

    Returns:
        Processor time of the learner's process and time on the wall [s] to ``send`` the weights, to ``call`` for an
        empty answer, and to ``fetch`` the rollout into one tensordict.
    """
    result: dict[str, dict[str, Any]] = {"send": {}, "call": {}, "fetch": {}}
    for count in WORKERS:
        chosen = workers[:count]

        def send(chosen: list[Any] = chosen) -> None:
            ref = ray.put(weights)
            ray.get([worker.cascade_execute.remote("update_policy_weights_", ref) for worker in chosen])

        def call(chosen: list[Any] = chosen) -> None:
            ray.get([worker.__ray_call__.remote(_answer_nothing) for worker in chosen])

        def fetch(chosen: list[Any] = chosen) -> None:
            torch.cat(ray.get([worker.__ray_call__.remote(_answer) for worker in chosen]))

        for worker, share in zip(chosen, rollout.chunk(count), strict=True):
            ray.get(worker.__ray_call__.remote(_keep, share.contiguous()))
        for name, function in (("send", send), ("call", call), ("fetch", fetch)):
            processor, wall = least_seconds(function, time.process_time), least_seconds(function)
            result[name][str(count)] = {"processor": processor, "wall": wall}
    return result


def cost_of_calls(calls: dict[str, Any], frames: int) -> dict[str, float]:
    """Return the model's share of Ray: a straight line through the first and the last number of workers.

    Args:
        calls: What :func:`measure_calls` returned.
        frames: Frames that were fetched.
    """
    first, last = WORKERS[0], WORKERS[-1]
    # Processor time of the learner's process: the time on the wall has the workers crowd the cores of one machine.
    sums = {k: calls["send"][str(k)]["processor"] + calls["fetch"][str(k)]["processor"] for k in (first, last)}
    slope = (sums[last] - sums[first]) / (last - first)
    fetched = calls["fetch"][str(first)]["processor"] - calls["call"][str(first)]["processor"]
    waits = [calls[name][str(first)]["wall"] - calls[name][str(first)]["processor"] for name in ("send", "call")]
    return {
        "fetch_seconds_per_frame": fetched / frames,
        "call_seconds": sum(waits),
        "call_seconds_per_worker": slope,
    }


def _keep(worker: Any, share: TensorDictBase) -> None:
    worker.kept = share.clone()


def _answer(worker: Any) -> TensorDictBase:
    return worker.kept


def _answer_nothing(_: Any) -> None:
    return None


def _processor_seconds(_: Any) -> float:
    return time.process_time()


def check_rollouts(config: TrainConfig, costs: Costs) -> dict[str, dict[str, float]]:
    """Return measured and predicted seconds of a rollout through the Ray backend, by the number of workers.

    Measured is the processor time of the worker that takes longest and, after it, of the learner's process: what the
    wall would show if each worker had a core. The wall's own time is given too.

    Args:
        config: A run of one worker; every worker gets as many worlds.
        costs: What the prediction is made of; there is no network between workers and learner here.
    """
    result = {}
    for count in CHECKED_WORKERS:
        run = config.replace(backend="ray", num_envs=config.num_envs * count, num_workers=count)
        with build_collector(run, Networks(run).actor, frames_done=0) as rollouts:
            workers = rollouts._collector.remote_collectors

            def clocks(workers: list[Any] = workers) -> list[float]:
                inside = ray.get([worker.__ray_call__.remote(_processor_seconds) for worker in workers])
                return [time.process_time(), time.perf_counter(), *inside]

            rollouts.next()
            before = clocks()
            for _ in range(ROUNDS):
                rollouts.next()
            learner, wall, *inside = [(new - old) / ROUNDS for old, new in zip(before, clocks(), strict=True)]
        parts = costs.seconds(frames=run.frames_per_batch, workers=count, nodes=1)
        predicted = parts["collect"] + parts["fetch"] + parts["calls"]
        result[str(count)] = {"measured": max(inside) + learner, "predicted": predicted, "wall": wall}
    return result


def predict(costs: Costs, config: TrainConfig) -> list[dict[str, Any]]:
    """Return what clusters would do with the paper's rollout, and with one that grows with the cluster.

    Args:
        costs: What the model is made of.
        config: The run whose rollout stays as it is.
    """
    rows = []
    for grows in (False, True):
        for nodes in NODES:
            cores = nodes * CORES_PER_NODE
            # A worker has one world at least, so a rollout that stays as it is feeds no more workers than worlds.
            workers = cores if grows else min(cores, config.num_envs)
            worlds = workers * WORLDS_PER_WORKER if grows else config.num_envs
            frames = worlds * config.ppo.rollout_steps
            parts = costs.seconds(frames=frames, workers=workers, nodes=min(nodes, workers))
            total = sum(parts.values())
            rows.append(
                {
                    "rollout_grows": grows,
                    "nodes": nodes,
                    "workers": workers,
                    "frames_per_rollout": frames,
                    "frames_per_second": frames / total,
                    "efficiency": frames / total / (workers * costs.core_fps),
                    "shares": {name: seconds / total for name, seconds in parts.items()},
                }
            )
    return rows


def saturation(costs: Costs, config: TrainConfig) -> dict[str, float]:
    """Return what no cluster exceeds if its rollouts grow with it, however many nodes it has.

    Args:
        costs: What the model is made of.
        config: The run whose number of steps a rollout has.

    Returns:
        The limit [frames/s], workers that would collect as much if nothing else took time, and the limit of Ray and
        network alone, with a learner that takes no time.
    """
    of_worker = WORLDS_PER_WORKER * config.ppo.rollout_steps
    sent = costs.frame_bytes / BYTES_PER_SECOND
    besides = costs.fetch_seconds_per_frame + sent + costs.call_seconds_per_worker / of_worker
    limit = 1.0 / (1.0 / costs.learner_fps + besides)
    return {
        "frames_per_second": limit,
        "workers": limit / costs.core_fps,
        "frames_per_second_without_learning": 1.0 / besides,
    }


def main() -> None:
    """Measure, predict, print."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it logs to stdout
    torch.set_num_threads(1)
    torch.manual_seed(0)
    load = os.getloadavg()
    config = method("cura-ppo").replace(learner_threads=1)
    small = config.replace(num_envs=WORLDS_PER_WORKER, ppo=dataclasses.replace(config.ppo, rollout_steps=16))
    frames, sent = measure_frames(small)
    # Synthetic in that it repeats: 64 worlds of 64 steps out of the 8 of 16 that were played.
    rollout = torch.cat([torch.cat([sent] * 8, 0)] * 4, 1)
    learner = measure_learner(config, rollout)
    weights = TensorDict.from_module(Networks(config).actor).data
    ray.init("local", num_cpus=max(WORKERS), include_dashboard=False, log_to_driver=False, logging_level="error")
    idle = small.replace(num_envs=max(WORKERS), num_workers=max(WORKERS), perception="none", backend="ray")
    with build_collector(idle, Networks(idle).actor, frames_done=0) as rollouts:
        calls = measure_calls(rollouts._collector.remote_collectors, weights, rollout)
    costs = Costs(
        frame_bytes=frames["frame_bytes_pickled"],
        weight_bytes=float(len(cloudpickle.dumps(weights))),
        core_fps=frames["core_fps"],
        learner_fps=learner["learner_fps"],
        **cost_of_calls(calls, rollout.numel()),
    )
    made_with = provenance()
    made_with["versions"]["ray"] = ray.__version__
    result = {
        **made_with,
        "load_average": load,
        "assumptions": {
            "cores_per_node": CORES_PER_NODE,
            "network_bytes_per_second": BYTES_PER_SECOND,
            "worlds_per_worker": WORLDS_PER_WORKER,
        },
        "measured": {**frames, **learner, "weight_bytes_held": weights.bytes(), "ray_seconds": calls},
        "model": dataclasses.asdict(costs),
        "check": check_rollouts(small, costs),
        "saturation": saturation(costs, config),
        "predictions": predict(costs, config),
    }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
