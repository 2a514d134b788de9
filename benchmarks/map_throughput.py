"""What a step of the confidence map, its encoder, the energy distance and the loss cost, as JSON.

The map is fed with the scans of a real rollout, repeated to fill the batch. Times are medians; "cpu" is the processor
time of all threads, which other users of the machine disturb less than the wall clock:
python benchmarks/map_throughput.py --num-envs 1024 --threads 1
THP_MEM_ALLOC_ENABLE=1, PyTorch's switch for huge pages, saves the page faults of the fresh window in each step.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import platform
import statistics
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torchrl.envs import TransformedEnv
from torchrl.objectives import ClipPPOLoss

from cura_torchrl import ConfidenceMap, CURALoss, DistributionalCollisionEstimator, PushEnv
from cura_torchrl.modules import make_actor, make_critic
from cura_torchrl.objectives.functional import energy_distance
from cura_torchrl.trainers.build import load_encoder
from cura_torchrl.trainers.info import provenance

if TYPE_CHECKING:
    from collections.abc import Callable

    from tensordict import TensorDict

ROLLOUT = (16, 40)
"""Worlds and policy steps of the rollout."""


def measure(plays: dict[str, Callable[[], object]], rounds: int) -> dict[str, dict[str, float]]:
    """Time functions in turn, so that a disturbance meets all of them.

    Args:
        plays: The functions.
        rounds: How often each is called; once more to warm up.

    Returns:
        Per function, medians of processor and wall time of a call [ms].
    """
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in plays}
    for _ in range(rounds + 1):
        for name, play in plays.items():
            cpu, wall = time.process_time(), time.perf_counter()
            play()
            times[name].append((time.process_time() - cpu, time.perf_counter() - wall))
    return {
        name: {
            label: round(statistics.median(one[i] for one in taken[1:]) * 1e3, 3)
            for i, label in enumerate(("cpu_ms", "wall_ms"))
        }
        for name, taken in times.items()
    }


def record() -> TensorDict:
    """Return a rollout of random actions with its windows, all steps in one batch."""
    torch.manual_seed(0)
    env = TransformedEnv(PushEnv(ROLLOUT[0], seed=0), ConfidenceMap(num_rays=360, max_range=10.0))
    data = env.rollout(ROLLOUT[1], break_when_any_done=False).transpose(0, 1).reshape(-1)
    env.close()
    return data


def measure_map(data: TensorDict, num_envs: int, rounds: int) -> dict[str, Any]:
    """Return what one step of the map costs.

    Args:
        data: The rollout.
        num_envs: Environments N.
        rounds: Steps.
    """
    transform = ConfidenceMap(num_rays=360, max_range=10.0)
    rows = torch.arange(num_envs) % len(data)
    inputs = data.select(*transform.in_keys)[rows]
    return {"num_envs": num_envs, **measure({"step": lambda: transform(inputs.clone(False))}, rounds)["step"]}


def measure_encoder(data: TensorDict, rounds: int) -> dict[str, Any]:
    """Return maps a second of the shipped encoder, and how far variants of it are from it.

    Args:
        data: The rollout.
        rounds: Batches.
    """
    maps = data["confidence_map"][torch.arange(1024) % len(data)]
    encoder = load_encoder(None).requires_grad_(False)
    last = load_encoder(None).requires_grad_(False).to(memory_format=torch.channels_last)
    half = load_encoder(None).requires_grad_(False).to(memory_format=torch.channels_last).bfloat16()
    plain = torch.nn.Sequential(*encoder.trunk, encoder.statistics_head)

    def autocast() -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return last.encode(maps)

    plays: dict[str, Callable[[], torch.Tensor]] = {
        "shipped": lambda: encoder.encode(maps),
        "contiguous": lambda: plain(maps)[:, : encoder.latent_size],
        "channels_last_weights": lambda: last.encode(maps),
        "channels_last_bfloat16": lambda: half.encode(maps.bfloat16()).float(),
        "channels_last_autocast": autocast,
    }
    codes = {name: play().float() for name, play in plays.items()}
    figures: dict[str, Any] = {"code_deviation": round(codes["shipped"].std(0).mean().item(), 4)}
    for name, taken in measure(plays, rounds).items():
        error = (codes[name] - codes["shipped"]).abs()
        figures[name] = {
            "maps_per_second": round(len(maps) / taken["wall_ms"] * 1e3),
            "maps_per_cpu_second": round(len(maps) / taken["cpu_ms"] * 1e3),
            "max_difference": error.max().item(),
            "mean_difference": error.mean().item(),
        }
    return figures


def all_pairs(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the energy distance by its definition.

    Args:
        prediction: Atoms, shape ``[B, N]``.
        target: Atoms, shape ``[B, M]``.
    """

    def mean(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (x[..., :, None] - y[..., None, :]).abs().mean((-2, -1))

    return 2.0 * mean(prediction, target) - mean(prediction, prediction) - mean(target, target)


def measure_distance(rounds: int, batch: int = 16_384, atoms: int = 50) -> dict[str, Any]:
    """Return what the energy distance costs, forward and backward, beside all pairs.

    Args:
        rounds: Calls.
        batch: Samples.
        atoms: Atoms N of prediction and target.
    """
    # No two atoms of a sample are equal: there the gradient would be a matter of taste.
    merged = (torch.rand(batch, 2 * atoms).argsort(-1) + 0.5 * torch.rand(batch, 2 * atoms)) / (2 * atoms)
    target, results = merged[:, atoms:].clone(), {}
    prediction = merged[:, :atoms].clone().requires_grad_()

    def play(name: str, function: Callable[..., torch.Tensor]) -> None:
        value = function(prediction, target)
        results[name] = value.detach(), torch.autograd.grad(value.sum(), prediction)[0]

    functions = {"sorted": energy_distance, "all_pairs": all_pairs}
    figures: dict[str, Any] = measure(
        {name: functools.partial(play, name, function) for name, function in functions.items()},
        rounds,
    )
    figures["ratio"] = round(figures["all_pairs"]["cpu_ms"] / figures["sorted"]["cpu_ms"], 2)
    pairs = zip(results["sorted"], results["all_pairs"], strict=True)
    figures["max_difference"] = {
        label: (a - b).abs().max().item() for label, (a, b) in zip(("value", "gradient"), pairs, strict=True)
    }
    return figures


def measure_loss(data: TensorDict, rounds: int, batch: int = 4096) -> dict[str, Any]:
    """Return what CURALoss costs beside ClipPPOLoss and the passes of the estimator, all forward and backward.

    Args:
        data: The rollout.
        rounds: Calls.
        batch: Samples of a minibatch.
    """
    rows = torch.arange(batch) % len(data)
    minibatch = data.select("observation", "action", ("next", "observation"), ("next", "reward"), "next").exclude(
        ("next", "confidence_map")
    )[rows]
    for part in (minibatch, minibatch["next"]):
        part["latent"] = torch.randn(batch, 32)
    inputs = minibatch["observation"].shape[-1] + 32
    actor, critic = make_actor(inputs, minibatch["action"].shape[-1]), make_critic(inputs)
    estimator = DistributionalCollisionEstimator(inputs)
    with torch.no_grad():
        minibatch = actor(minibatch.clone(False)).exclude("loc", "scale")
        minibatch["collision_target"] = estimator(minibatch.clone(False))["collision_atoms"].flip(0)
    minibatch["advantage"], minibatch["value_target"] = torch.randn(2, batch, 1)
    ours, theirs = CURALoss(actor, critic, estimator), ClipPPOLoss(actor, critic)

    def play(loss: ClipPPOLoss) -> None:
        losses = loss(minibatch)
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()

    def ppo_and_estimator() -> None:
        play(theirs)
        estimator(minibatch.select(*estimator.in_keys))["collision_atoms"].sum().backward()

    figures: dict[str, Any] = measure({"cura": lambda: play(ours), "ppo_and_estimator": ppo_and_estimator}, rounds)
    figures["ratio"] = round(figures["cura"]["cpu_ms"] / figures["ppo_and_estimator"]["cpu_ms"], 3)
    return {"batch": batch, **figures}


def settings() -> dict[str, Any]:
    """Return the processor's name and how PyTorch was set up."""
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "processor": names[0].split(":")[1].strip() if names else platform.processor(),
        "threads": torch.get_num_threads(),
        "huge_pages": os.environ.get("THP_MEM_ALLOC_ENABLE") == "1",
    }


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=1024, help="environments of a step of the map")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch")
    parser.add_argument("--rounds", type=int, default=7, help="calls of everything")
    parser.add_argument("--only", choices=("map", "encoder", "distance", "loss"), help="one part; all if left out")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    data = record()
    parts: dict[str, Callable[[], dict[str, Any]]] = {
        "map": lambda: measure_map(data, arguments.num_envs, arguments.rounds),
        "encoder": lambda: measure_encoder(data, arguments.rounds),
        "distance": lambda: measure_distance(arguments.rounds),
        "loss": lambda: measure_loss(data, 5 * arguments.rounds),
    }
    chosen = [arguments.only] if arguments.only else list(parts)
    print(json.dumps(provenance() | settings() | {name: parts[name]() for name in chosen}, indent=2))


if __name__ == "__main__":
    main()
