"""How far the planar simulator is from PyBullet: the same scenes and commands on both, differences as quantiles.

Prints a table, and writes all figures with command, commit and versions:
python benchmarks/parity.py --output benchmarks/results/parity.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tqdm import tqdm

from cura_torchrl.envs.config import LidarConfig, PushEnvConfig, ScenarioConfig, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.scripted import ScriptedPusher
from cura_torchrl.trainers.info import provenance

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tensordict import TensorDictBase

SIMULATORS = ("bullet", "planar")
QUANTILES = (0.5, 0.75, 0.9, 0.99)
PERIOD = 0.2
"""Time of a policy step [s]."""


def make_envs(rows: int, first: int, **scenario: Any) -> list[PushEnv]:
    """Return one environment a simulator, of the same training scenes, without noise on the scan.

    Args:
        rows: Worlds N.
        first: Episode of the first row.
        **scenario: Fields of :class:`~cura_torchrl.envs.config.ScenarioConfig`.
    """
    config = PushEnvConfig(task=TaskConfig(scenario=ScenarioConfig(**scenario)), lidar=LidarConfig(noise=0.0))
    return [
        PushEnv(rows, dataclasses.replace(config, simulator=name), seed=17, first_episode=first) for name in SIMULATORS
    ]


def batches(total: int, rows: int, what: str) -> Iterator[tuple[int, int]]:
    """Yield (first episode, number of rows) with a progress bar."""
    for first in tqdm(range(0, total, rows), desc=what, unit="batch"):
        yield first, min(rows, total - first)


def spread(values: torch.Tensor) -> dict[str, float]:
    """Return the quantiles of some values."""
    points = torch.tensor(QUANTILES, dtype=torch.float64)
    return {
        f"q{round(100 * q)}": round(v.item(), 5)
        for q, v in zip(QUANTILES, values.double().quantile(points), strict=True)
    }


def compare_scans(scenes: int, rows: int) -> dict[str, float]:
    """Return the share of rays that agree within a millimetre in scenes full of obstacles."""
    agree, hits = [], []
    for first, count in batches(scenes, rows, "scans"):
        envs = make_envs(count, first, obstacle_time=(0.0, 0.0))
        one, other = (env.reset()["scan"] for env in envs)
        agree.append(((one - other).abs() < 1e-3).flatten())
        hits.append((one < 9.99).flatten())
        close(envs)
    return {
        "scenes": scenes,
        "share_within_1mm": round(torch.cat(agree).double().mean().item(), 6),
        "share_of_hits": round(torch.cat(hits).double().mean().item(), 3),
    }


def replay(
    envs: list[PushEnv], act: Callable[[TensorDictBase, int], torch.Tensor], steps: int
) -> list[list[dict[str, torch.Tensor]]]:
    """Play on PyBullet, then the same actions on the planar simulator.

    Args:
        envs: One environment a simulator.
        act: Chooses PyBullet's actions from its tensordict and the number of the step.
        steps: Policy steps.

    Returns:
        States after every step, by simulator.
    """
    bullet, planar = envs
    actions: list[torch.Tensor] = []

    def play(env: PushEnv, choose: Callable[[TensorDictBase, int], torch.Tensor]) -> list[dict[str, torch.Tensor]]:
        data, states = env.reset(), []
        for step in range(steps):
            data = env.step(data.select().set("action", choose(data, step)))["next"]
            states.append({
                "base": env.world_state.base_pose, "hand": data["observation"][:, :3], "object": data["object_pose"]
            })  # fmt: skip
        return states

    def choose(data: TensorDictBase, step: int) -> torch.Tensor:
        actions.append(act(data, step))
        return actions[-1]

    first = play(bullet, choose)
    return [first, play(planar, lambda _, step: actions[step])]


def held_actions(seed: int) -> Callable[[TensorDictBase, int], torch.Tensor]:
    """Return random commands, each held for a second."""
    generator = torch.Generator().manual_seed(seed)
    held = [torch.zeros(0)]

    def act(data: TensorDictBase, step: int) -> torch.Tensor:
        if step % 5 == 0:
            held[0] = torch.rand(len(data), 6, generator=generator) * 2 - 1
        return held[0]

    return act


def scripted_actions() -> Callable[[TensorDictBase, int], torch.Tensor]:
    """Return what the scripted pusher does."""
    policy = ScriptedPusher()
    return lambda data, _: policy(data.clone())["action"].clone()


def random_pushes(seed: int) -> Callable[[TensorDictBase, int], torch.Tensor]:
    """Return pushes ahead at random speeds with random commands beside them, each held for a second."""
    noise = held_actions(seed)

    def act(data: TensorDictBase, step: int) -> torch.Tensor:
        action = 0.4 * noise(data, step).clone()
        action[:, 0] += 0.6
        return action

    return act


def compare_free_motion(scenes: int, rows: int) -> dict[str, Any]:
    """Return how far base and hand are apart after 2 s of random commands, with the box out of reach."""
    base, hand = [], []
    for first, count in batches(scenes, rows, "free motion"):
        envs = make_envs(count, first, max_obstacles=0, start_gap=(4.0, 4.5))
        one, other = (states[-1] for states in replay(envs, held_actions(first), 10))
        base.append((one["base"] - other["base"])[:, :2].norm(dim=1))
        hand.append((one["hand"] - other["hand"]).norm(dim=1))
        close(envs)
    return {"scenes": scenes, "base_m": spread(torch.cat(base)), "hand_m": spread(torch.cat(hand))}


def compare_pushing(scenes: int, rows: int, kind: str) -> dict[str, Any]:
    """Return how far the boxes are apart 1, 2 and 5 s after PyBullet's box first moved, in open loop."""
    seconds, steps = (1, 2, 5), 40
    apart: dict[int, list[torch.Tensor]] = {second: [] for second in seconds}
    for first, count in batches(scenes, rows, f"{kind} pushes"):
        envs = make_envs(count, first, max_obstacles=0, start_gap=(0.2, 0.3))
        act = scripted_actions() if kind == "scripted" else random_pushes(first)
        one, other = (torch.stack([state["object"] for state in states]) for states in replay(envs, act, steps))
        start = torch.stack([env.scenario["object_pose"] for env in envs])[0].float()
        moved = (one - start)[..., :2].norm(dim=-1)
        touched = (moved > 0.005).int().argmax(0)
        for second in seconds:
            index = touched + round(second / PERIOD) - 1
            valid = (moved[-1] > 0.005) & (index < steps)
            rows_ = torch.arange(count)[valid]
            at, there = one[index[valid], rows_], other[index[valid], rows_]
            turn = torch.remainder(at[:, 2] - there[:, 2] + torch.pi, 2 * torch.pi) - torch.pi
            travelled = moved[index[valid], rows_]
            apart[second].append(torch.stack([(at - there)[:, :2].norm(dim=1), turn.abs(), travelled], dim=1))
        close(envs)
    report: dict[str, Any] = {"scenes": scenes}
    for second, parts in apart.items():
        place, turn, travelled = torch.cat(parts).unbind(1)
        report[f"after_{second}s"] = {
            "pushed": len(place), "position_m": spread(place), "yaw_rad": spread(turn),
            "median_travelled_m": round(travelled.median().item(), 3),
        }  # fmt: skip
    return report


def compare_closed_loop(scenes: int, rows: int, edge: float) -> dict[str, Any]:
    """Return times to the goal, and how far the paths are apart, of the scripted pusher on each simulator."""
    times: list[list[torch.Tensor]] = [[], []]
    lateral, tipped = [], 0
    for first, count in batches(scenes, rows, f"closed loop {edge} m"):
        envs = make_envs(count, first, max_obstacles=0, object_edges=(edge,))
        paths = []
        for index, env in enumerate(envs):
            data = env.rollout(250, ScriptedPusher(), break_when_all_done=True, break_when_any_done=False)["next"]
            reached = data["success"][..., 0]
            time = torch.where(reached.any(1), (reached.int().argmax(1) + 1) * PERIOD, torch.inf)
            times[index].append(time)
            paths.append(data["object_pose"])
            tipped += int(data["tipped"].any()) if index == 0 else 0
        length = min(path.shape[1] for path in paths)
        middle = [_y_at(path[:, :length], 6.0) for path in paths]
        lateral.append((middle[0] - middle[1]).abs())
        close(envs)
    one, other = (torch.cat(part) for part in times)
    return {
        "scenes": scenes, "tipped_in_bullet": tipped,
        "reached": [int(part.isfinite().sum()) for part in (one, other)],
        "median_time_s": [round(part.median().item(), 2) for part in (one, other)],
        "ratio_of_medians": round((other.median() / one.median()).item(), 4),
        "lateral_at_6m_m": spread(torch.cat(lateral)),
    }  # fmt: skip


def _y_at(path: torch.Tensor, x: float) -> torch.Tensor:
    """Return the box's y where its x first passes a value [m], ``[N]``."""
    index = (path[..., 0] > x).int().argmax(1)
    return path[torch.arange(len(path)), index, 1]


def close(envs: list[PushEnv]) -> None:
    """Close environments."""
    for env in envs:
        env.close()


def main() -> None:
    """Compare and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200, help="scenes of each comparison but the scans [1]")
    parser.add_argument("--scans", type=int, default=1000, help="scenes whose scans are compared [1]")
    parser.add_argument("--rows", type=int, default=40, help="worlds played at once [1]")
    parser.add_argument("--output", type=Path, help="file for the figures, JSON")
    options = parser.parse_args()
    torch.set_num_threads(1)
    report = {
        **provenance(),
        "scans": compare_scans(options.scans, options.rows),
        "free_motion": compare_free_motion(options.scenes, options.rows),
        "scripted_pushes": compare_pushing(options.scenes, options.rows, "scripted"),
        "random_pushes": compare_pushing(options.scenes, options.rows, "random"),
        "closed_loop": {
            str(edge): compare_closed_loop(options.scenes, options.rows, edge) for edge in (0.5, 0.75, 1.0)
        },
    }
    text = json.dumps(report, indent=2)
    sys.stdout.write(text + "\n")
    if options.output is not None:
        options.output.write_text(text + "\n")


if __name__ == "__main__":
    main()
