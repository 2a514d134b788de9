"""The same task through other vectorised environments, and a physics tick of one robot beside panda-gym's."""

from __future__ import annotations

import functools
import json
import logging
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torchrl.envs import ParallelEnv

from cura_torchrl import keys
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.ridgeback_franka import ACTION_SIZE
from cura_torchrl.trainers.benches.env import Episode, Workers, act_at_random, close_all, play, prepare
from cura_torchrl.trainers.benches.report import Report, measure, rates
from cura_torchrl.trainers.errors import UnavailableError

try:
    import gymnasium
except ImportError:
    gymnasium = None  # type: ignore[assignment]

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tensordict import TensorDictBase

    from cura_torchrl.trainers.benches.config import BenchConfig

logger = logging.getLogger(__name__)

_GymBase: Any = object if gymnasium is None else gymnasium.Env

INSTALL_SECONDS = 600
"""Time in which pip has to be done [s]."""

PANDA_SCRIPT = """
import json, sys, time
import gymnasium, panda_gym
env = gymnasium.make("PandaPush-v3").unwrapped
env.reset(seed=0)
env.action_space.seed(0)
actions = [env.action_space.sample() for _ in range(int(sys.argv[1]))]
for name, play in (("step", env.step), ("engine", lambda action: env.sim.step())):
    start = time.process_time()
    for action in actions:
        play(action)
    print(json.dumps([name, (time.process_time() - start) / len(actions) / env.sim.n_substeps]))
"""
"""Prints the processor seconds of a tick: of a whole step of the environment, and of the engine alone."""


def run(config: BenchConfig) -> Report:
    """Measure peers.

    Args:
        config: How.

    Returns:
        Batched worlds beside TorchRL's and gymnasium's vectors of single ones; ticks beside panda-gym's if it is asked.

    Raises:
        UnavailableError: If gymnasium is not installed.
    """
    if gymnasium is None:
        msg = "gymnasium is not installed; accepted: first pip install cura-torchrl[peers]"
        raise UnavailableError(msg)
    report = Report()
    python = find_panda(config.venv, report) if config.panda_gym else None
    if not config.panda_gym:
        report.notes.append("panda-gym was left out: --panda-gym installs and measures it")
    measure_vectors(config, report)
    measure_ticks(config, report, python)
    return report


class PushGymEnv(_GymBase):
    """One world of PushEnv as a gymnasium environment that observes the vector and the scan.

    Args:
        index: Which of the worlds.
        count: Worlds of all processes together.
        seed: Seed of the scenarios.
    """

    metadata: dict[str, Any] = {}  # noqa: RUF012 - gymnasium's own type

    def __init__(self, index: int, count: int, seed: int) -> None:
        torch.set_num_threads(1)
        self._env = make_single(index, count, seed)
        box = functools.partial(gymnasium.spaces.Box, dtype=np.float32)
        spec = self._env.observation_spec
        self.observation_space = gymnasium.spaces.Dict(
            {
                keys.OBSERVATION: box(-np.inf, np.inf, spec[keys.OBSERVATION].shape[1:]),
                keys.SCAN: box(0.0, self._env.config.lidar.max_range, spec[keys.SCAN].shape[1:]),
            }
        )
        self.action_space = box(-1.0, 1.0, (ACTION_SIZE,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start the next scenario.

        Args:
            seed: Seed of gymnasium's own generator, which draws nothing here.
            options: None are known.

        Returns:
            Observation and an empty dictionary.
        """
        super().reset(seed=seed, options=options)
        self._data = self._env.reset()
        return self._observe(self._data), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Play one policy step.

        Args:
            action: Action, shape ``[6]``.

        Returns:
            Observation, reward, terminated, truncated, and an empty dictionary.
        """
        after = self._env.step(self._data.set(keys.ACTION, torch.from_numpy(action)[None]))["next"]
        self._data = after
        ends = bool(after["terminated"]), bool(after["truncated"])
        return self._observe(after), float(after[keys.REWARD]), *ends, {}

    def _observe(self, data: TensorDictBase) -> dict[str, np.ndarray]:
        return {name: data[name][0].numpy() for name in (keys.OBSERVATION, keys.SCAN)}

    def close(self) -> None:
        """Disconnect the simulator."""
        self._env.close()


def make_single(index: int, count: int, seed: int) -> PushEnv:
    """Return a single world that plays the scenarios of one row of a batch.

    Args:
        index: Which row.
        count: Rows of the batch.
        seed: Seed of the scenarios.

    Returns:
        Environment of one world.
    """
    torch.set_num_threads(1)
    return PushEnv(1, seed=seed, first_episode=index, episode_stride=count)


def measure_vectors(config: BenchConfig, report: Report) -> None:
    """Compare batched worlds in a few processes with single worlds in a process each.

    Args:
        config: How.
        report: Where the figures go.
    """
    count, workers = config.peer_envs, config.num_workers
    factories = [functools.partial(make_single, index, count, config.seed) for index in range(count)]
    singles = ParallelEnv(count, factories, mp_start_method="spawn")
    gym = gymnasium.vector.AsyncVectorEnv(
        [functools.partial(PushGymEnv, index, count, config.seed) for index in range(count)], context="spawn"
    )
    with Workers(workers) as batches:
        prepare("bullet", count)
        plays: dict[str, Callable[[], float]] = {
            "one process": functools.partial(play, "bullet", count, config.steps),
            "batched": functools.partial(
                batches.play, "bullet", workers, num_envs=count // workers, steps=config.steps
            ),
            "ParallelEnv": functools.partial(_play_torchrl, singles, config.steps),
            "AsyncVectorEnv": functools.partial(_play_gym, gym, config.steps),
        }
        taken = measure(plays, config.rounds, "vectors of environments")
    singles.close()
    gym.close()
    close_all()
    shapes = {
        "one process": f"PushEnv, {count} worlds in 1 process",
        "batched": f"PushEnv, {count} worlds in {workers} processes",
        "ParallelEnv": f"ParallelEnv of {count} PushEnv(1)",
        "AsyncVectorEnv": f"AsyncVectorEnv of {count} PushEnv(1)",
    }
    speed = {name: rates(count * config.steps, seconds) for name, seconds in taken.items()}
    for name, label in shapes.items():
        report.add_figure(label, speed[name], "env steps/s")
    for name in ("ParallelEnv", "AsyncVectorEnv"):
        report.add_ratio(f"PushEnv in {workers} processes / {name}", speed["batched"], speed[name])


def _play_torchrl(env: ParallelEnv, steps: int) -> float:
    data = env.reset()
    start = time.perf_counter()
    act_at_random(env, data, steps)
    return time.perf_counter() - start


def _play_gym(env: Any, steps: int) -> float:
    env.reset()
    start = time.perf_counter()
    for _ in range(steps):
        env.step(env.action_space.sample())
    return time.perf_counter() - start


def measure_ticks(config: BenchConfig, report: Report, python: Path | None) -> None:
    """Time a physics tick of one robot, with all that an environment does in between, beside panda-gym's.

    Args:
        config: How.
        report: Where the figures go.
        python: Interpreter of an environment with panda-gym; none leaves it out.
    """
    env = Episode(config.num_envs, config.steps, config.seed)
    names = {"PushEnv": env.play, "bare PyBullet": env.play_bare}
    theirs: dict[str, list[float]] = {"step": [], "engine": []}

    def play_panda() -> float:
        steps = str(config.num_envs * config.steps)
        done = subprocess.run([str(python), "-c", PANDA_SCRIPT, steps], capture_output=True, text=True, check=True)
        found = dict(json.loads(line) for line in done.stdout.splitlines() if line.startswith("["))
        for name, value in found.items():
            theirs[name].append(1e6 * value)
        return found["step"]

    plays: dict[str, Callable[[], float]] = dict(names) if python is None else {**names, "panda-gym": play_panda}
    taken = measure(plays, config.rounds, "ticks")
    ticks = round(env.config.task.policy_period / env.config.physics.control_period)
    env.close()
    ours = {name: [1e6 * value / (config.num_envs * config.steps * ticks) for value in taken[name]] for name in names}
    unit = "us a tick and robot"
    for name, values in ours.items():
        report.add_figure(f"{name}, {config.num_envs} worlds, rays included", values, unit)
    if python is None:
        return
    later = {name: values[1:] for name, values in theirs.items()}  # the first round warms up
    report.add_figure("panda-gym's PandaPush, a step's share", later["step"], unit)
    report.add_figure("panda-gym's PandaPush, stepSimulation alone", later["engine"], unit)
    report.add_ratio("panda-gym / PushEnv, time a tick and robot", later["step"], ours["PushEnv"])


def find_panda(venv: Path, report: Report) -> Path | None:
    """Return the interpreter of a virtual environment with panda-gym, which is made if need be.

    Args:
        venv: Its folder.
        report: Where a note goes: with which versions it was measured, or why it was not.

    Returns:
        The interpreter; None where it cannot be had.
    """
    python = venv / "bin" / "python"
    commands = [
        [sys.executable, "-m", "venv", str(venv)],
        [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "panda-gym"],
    ]
    probe = [str(python), "-c", "import panda_gym"]
    try:
        if not python.exists() or subprocess.run(probe, capture_output=True, check=False).returncode != 0:
            logger.info("installing panda-gym into %s", venv)
            for command in commands:
                subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_SECONDS, check=True)
        listed = subprocess.run(
            [str(python), "-m", "pip", "list", "--format", "json"], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.SubprocessError) as error:
        last = (getattr(error, "stderr", None) or str(error)).strip().splitlines()[-1]
        report.notes.append(f"panda-gym was left out: it cannot be installed into {venv}: {last}")
        return None
    found = {entry["name"]: entry["version"] for entry in json.loads(listed.stdout)}
    shown = ", ".join(f"{name} {found[name]}" for name in ("panda-gym", "numpy", "pybullet") if name in found)
    report.notes.append(f"panda-gym was measured with {shown}")
    return python
