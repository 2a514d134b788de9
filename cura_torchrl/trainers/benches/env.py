"""How much of bare PyBullet is left in PushEnv, what a second process brings, and the planar simulator beside both."""

from __future__ import annotations

import functools
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from cura_torchrl import keys
from cura_torchrl.envs.config import PushEnvConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.ridgeback_franka import ACTION_SIZE
from cura_torchrl.envs.simulation.bullet_floor import BulletFloor
from cura_torchrl.trainers.benches.report import Report, measure, rates, timed

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import Simulator
    from cura_torchrl.trainers.benches.config import BenchConfig

UNIT = "env steps/s"

_ENVS: dict[tuple[str, int], tuple[PushEnv, TensorDictBase]] = {}
"""Worlds of this process and what they observed last, by simulator and number: kept from round to round."""


def run(config: BenchConfig) -> Report:
    """Measure the environments.

    Args:
        config: How.

    Returns:
        PushEnv beside the bare loop, by numbers of worlds; two processes beside one; planar beside PyBullet.
    """
    report = Report()
    measure_floor(config, report)
    measure_sweep(config, report)
    measure_processes(config, report)
    return report


class Episode:
    """A few policy steps of random actions that are played by PushEnv, and then once more by the engine alone.

    Args:
        num_envs: Worlds N.
        steps: Policy steps.
        seed: Seed of scenarios and actions.
    """

    def __init__(self, num_envs: int, steps: int, seed: int) -> None:
        self._env = PushEnv(num_envs, seed=seed)
        self.config = self._env.config
        generator = torch.Generator().manual_seed(seed)
        self._actions = 2.0 * torch.rand(steps, num_envs, ACTION_SIZE, generator=generator) - 1.0
        self._episodes = torch.arange(num_envs)
        self._record()

    def reset(self) -> Any:
        """Build the worlds anew, always the same ones.

        Returns:
            What PushEnv observes.
        """
        return self._env.reset(episodes=self._episodes)

    def play(self) -> float:
        """Play with PushEnv.

        Returns:
            Seconds of processor time, without the reset.
        """
        data = self.reset()
        start = time.process_time()
        for action in self._actions:
            data = self._env.step(data.set(keys.ACTION, action))["next"]
        return time.process_time() - start

    def _record(self) -> None:
        """Keep the torques, rays and obstacles of each policy step, then the object's positions in every tick."""
        env: Any = self._env
        worlds, law = env._worlds, env._controller
        torques: list[list[list[float]]] = [[] for _ in range(env.num_envs)]
        self._rays: list[tuple[np.ndarray, np.ndarray]] = []
        self._obstacles: list[list[tuple[torch.Tensor, ...]]] = []
        compute, cast, place = law.torques_of, env._lidar._cast, worlds.place_obstacles

        def keep_torques(world: int, joints: np.ndarray) -> list[float]:
            torques[world].append(compute(world, joints))
            return torques[world][-1]

        def keep_rays(rows: torch.Tensor, origin: torch.Tensor, ends: torch.Tensor, **options: bool) -> torch.Tensor:
            starts = origin[:, None].expand(ends.shape).contiguous().numpy()
            self._rays.append((starts, ends.clone().numpy()))
            self._obstacles.append([])
            return cast(rows, origin, ends, **options)

        def keep_obstacles(*new: torch.Tensor) -> None:
            self._obstacles[-1].append(tuple(part.clone() for part in new))
            place(*new)

        data = self.reset()
        env._lidar._cast, law.torques_of, worlds.place_obstacles = keep_rays, keep_torques, keep_obstacles
        self._obstacles.append([])
        for action in self._actions:
            data = env.step(data.set(keys.ACTION, action))["next"]
        env._lidar._cast = cast
        del law.torques_of, worlds.place_obstacles
        ticks = len(torques[0]) // len(self._actions)
        starts = range(0, len(torques[0]), ticks)
        self._torques = [[ours[start : start + ticks] for ours in torques] for start in starts]
        self._end: np.ndarray = worlds._joint_state.copy()
        self._positions: list[Any] = [None] * len(self._torques)
        self.play_bare()

    def play_bare(self) -> float:
        """Play the same torques, weights and rays with the engine alone; obstacles are placed off the clock.

        Returns:
            Seconds of processor time, without the reset.
        """
        self.reset()
        floor, seconds = BulletFloor(self._env._worlds), 0.0
        for step, (torques, rays, obstacles) in enumerate(
            zip(self._torques, self._rays, self._obstacles[:-1], strict=True)
        ):
            known = self._positions[step]
            start = time.process_time()
            found = floor.play(torques, known)
            seconds += time.process_time() - start
            if known is None:
                self._positions[step] = found
            for new in obstacles:
                self._env._worlds.place_obstacles(*new)
            start = time.process_time()
            floor.cast(*rays)
            seconds += time.process_time() - start
        self.error = float(np.abs(floor.joints() - self._end).max())
        return seconds

    def close(self) -> None:
        """Disconnect."""
        self._env.close()


def measure_floor(config: BenchConfig, report: Report) -> None:
    """Compare PushEnv with the engine alone.

    Args:
        config: How.
        report: Where the figures go.
    """
    episode = Episode(config.num_envs, config.steps, config.seed)
    taken = measure(
        {"PushEnv": episode.play, "bare loop": episode.play_bare, "reset": timed(episode.reset)},
        config.rounds,
        "PushEnv and the bare loop",
    )
    error = episode.error
    episode.close()
    work = config.num_envs * config.steps
    worlds = f"{config.num_envs} worlds, processor time"
    report.add_figure(f"PushEnv, {worlds}", rates(work, taken["PushEnv"]), UNIT)
    report.add_figure(f"bare PyBullet, {worlds}", rates(work, taken["bare loop"]), UNIT)
    report.add_figure("reset of a world", [1e3 * value / config.num_envs for value in taken["reset"]], "ms")
    report.add_ratio("PushEnv / bare PyBullet", taken["bare loop"], taken["PushEnv"], ">= 0.75")
    report.add_check("joints after the bare loop, difference [rad, m]", error, 0.0)


def measure_sweep(config: BenchConfig, report: Report) -> None:
    """Try numbers of worlds in one process.

    Args:
        config: How.
        report: Where the figures go.
    """
    counts = [count for count in config.sweep if count != config.num_envs]
    if not counts:
        return
    plays = {}
    for count in [config.num_envs, *counts]:
        prepare("bullet", count)
        plays[str(count)] = functools.partial(play, "bullet", count, config.steps, clock=time.process_time)
    taken = measure(plays, config.rounds, "worlds of a process")
    close_all()
    for count in counts:
        name = f"PushEnv, {count} / {config.num_envs} worlds"
        ours = rates(count * config.steps, taken[str(count)])
        report.add_ratio(name, ours, rates(config.num_envs * config.steps, taken[str(config.num_envs)]))


def measure_processes(config: BenchConfig, report: Report) -> None:
    """Compare several processes with one, and the planar simulator with PyBullet in as many.

    Args:
        config: How.
        report: Where the figures go.
    """
    with Workers(config.num_workers) as workers:
        play_some = functools.partial(workers.play, "bullet", num_envs=config.num_envs, steps=config.steps)
        share = -(-config.planar_envs // config.num_workers)
        taken = measure(
            {
                "one process": functools.partial(play_some, 1),
                "processes": functools.partial(play_some, config.num_workers),
                "planar": functools.partial(
                    workers.play, "planar", config.num_workers, num_envs=share, steps=config.steps
                ),
            },
            config.rounds,
            "processes",
        )
    close_all()
    work = config.num_envs * config.steps
    one = rates(work, taken["one process"])
    several = rates(config.num_workers * work, taken["processes"])
    planar = rates(config.num_workers * share * config.steps, taken["planar"])
    processes = f"{config.num_workers} processes"
    report.add_figure(f"PyBullet, 1 process of {config.num_envs} worlds", one, UNIT)
    report.add_figure(f"PyBullet, {processes} of {config.num_envs} worlds", several, UNIT)
    report.add_figure(f"planar, {processes} of {share} worlds", planar, UNIT)
    report.add_ratio(f"PyBullet, {processes} / 1", several, one, ">= 1.7")
    report.add_ratio(f"planar / PyBullet, {processes} each", planar, several, ">= 10")


class Workers:
    """Processes that keep their worlds from round to round.

    Args:
        count: How many.
    """

    def __init__(self, count: int) -> None:
        self._stack = ExitStack()
        context = get_context("spawn")
        pools = [ProcessPoolExecutor(1, mp_context=context, initializer=_one_thread) for _ in range(count)]
        self._pools = [self._stack.enter_context(pool) for pool in pools]

    def __enter__(self) -> Workers:
        """Return the workers."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the processes."""
        self._stack.close()

    def play(self, simulator: Simulator, count: int, *, num_envs: int, steps: int) -> float:
        """Play in some of the processes at once.

        Args:
            simulator: Which simulator.
            count: In how many.
            num_envs: Worlds of each.
            steps: Policy steps.

        Returns:
            Seconds on the wall until the last of them has done.
        """
        pools = self._pools[:count]
        _wait([pool.submit(prepare, simulator, num_envs) for pool in pools])
        start = time.perf_counter()
        _wait([pool.submit(play, simulator, num_envs, steps) for pool in pools])
        return time.perf_counter() - start


def _wait(jobs: Sequence[Any]) -> None:
    for job in jobs:
        job.result()


def prepare(simulator: Simulator, num_envs: int) -> None:
    """Make worlds, unless this process has them.

    Args:
        simulator: Which simulator.
        num_envs: Worlds N.
    """
    key = simulator, num_envs
    if key not in _ENVS:
        env = PushEnv(num_envs, PushEnvConfig(simulator=simulator))
        _ENVS[key] = env, env.reset()


def play(simulator: Simulator, num_envs: int, steps: int, clock: Callable[[], float] = time.perf_counter) -> float:
    """Play random actions with automatic resets in the worlds of this process, from where they are.

    Args:
        simulator: Which simulator.
        num_envs: Worlds N, as they were prepared.
        steps: Policy steps.
        clock: Clock [s].

    Returns:
        Seconds.
    """
    env, data = _ENVS[simulator, num_envs]
    start = clock()
    data = act_at_random(env, data, steps)
    seconds = clock() - start
    _ENVS[simulator, num_envs] = env, data
    return seconds


def act_at_random(env: EnvBase, data: TensorDictBase, steps: int) -> TensorDictBase:
    """Play random actions with automatic resets.

    Args:
        env: Environment.
        data: What it observed last.
        steps: Policy steps.

    Returns:
        What it observes then.
    """
    for _ in range(steps):
        data = env.step_and_maybe_reset(env.rand_action(data))[1]
    return data


def close_all() -> None:
    """Close the worlds of this process."""
    for env, _ in _ENVS.values():
        env.close()
    _ENVS.clear()


def _one_thread() -> None:
    torch.set_num_threads(1)
