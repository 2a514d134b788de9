"""The example scripts run as they stand, on little, and what they compute by themselves is right."""

from __future__ import annotations

import importlib.util
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
import pytest
import torch
from matplotlib.image import imread
from tensordict import TensorDict
from torchrl.envs import TransformedEnv, check_env_specs

if TYPE_CHECKING:
    from types import ModuleType

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))
TRAINING = [path for path in EXAMPLES if path.stem != "confidence_map_elsewhere"]
REACHED = {
    "a_method_of_ones_own": r"last rollout: reward (\S+) a step, bonus (\S+), collisions (\S+)% of steps",
    "cura_on_gymnasium": r"last \d+ episodes: return (\S+) of at most 200, (\S+)% ended by spinning too fast",
    "plain_ppo": r"reward a step: (\S+) in the first rollout, (\S+) in the last",
    "push_with_stable_baselines3": r"reward a step: (\S+) in the first rollout, (\S+) in the last",
    "train_in_a_loop": r"reward (\S+) a step, collisions (\S+)% of steps",
}
"""What a script says in the end, or on its progress bar, of what it has reached."""


def _run(script: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, script, *words], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done


def _load(name: str) -> ModuleType:
    path = next(path for path in EXAMPLES if path.stem == name)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("script", TRAINING, ids=lambda path: path.name)
def test_example_trains(script: Path, tmp_path: Path) -> None:
    """Catches an example that names something renamed, needs what a user has not got, or learns from NaN."""
    steps = "64" if script.stem == "cura_on_gymnasium" else "8"  # a pendulum needs some time to get too fast
    done = _run(script, tmp_path, "--iterations", "2", "--num-envs", "2", "--steps", steps)
    assert "2/2" in done.stderr
    reached = re.findall(REACHED[script.stem], done.stderr + done.stdout)
    assert reached, done.stdout
    assert all(math.isfinite(float(number)) for number in reached[-1])


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.name)
def test_examples_stay_short(script: Path) -> None:
    """Catches an example that has outgrown what a stranger reads in a minute."""
    assert len(script.read_text(encoding="utf-8").splitlines()) <= 120


def test_the_map_elsewhere_shows_the_pillars(tmp_path: Path) -> None:
    """Catches a map of which bearings or axes are mistaken: its occupied cells would not lie on the pillars."""
    script = next(path for path in EXAMPLES if path.stem == "confidence_map_elsewhere")
    done = _run(script, tmp_path, "--num-envs", "2", "--steps", "20", "--output", "map.png")
    line = r"map\.png: (\d+)% seen of late; (\d+) occupied cells, (\S+) m from a pillar's edge"
    found = re.fullmatch(line, done.stdout.strip())
    assert found is not None, done.stdout
    seen, cells, distance = map(float, found.groups())
    # Pillars hide some of the window and leave most of it; cells are 0.1 m wide and turned into the window's grid.
    assert 20 < seen < 95
    assert cells > 20
    assert distance < 0.1
    picture = imread(tmp_path / "map.png")
    assert picture.std() > 0.1  # not blank


class TestSpeedLimit:
    """The task of ``cura_on_gymnasium``."""

    @pytest.mark.parametrize(("speed", "is_fast"), [(5.9, False), (6.2, True), (-6.2, True)])
    def test_costs_and_ends_where_the_pendulum_spins_too_fast(self, speed: float, is_fast: bool) -> None:
        """Catches a cost without an end, an end without a cost, and a limit in one direction only."""
        env = _load("cura_on_gymnasium").SpeedLimit(gymnasium.make("Pendulum-v1"))
        _, info = env.reset(seed=0)
        assert info["cost"].tolist() == [0.0]
        env.unwrapped.state = np.array([0.0, speed])  # upright: gravity does not change the speed
        _, _, terminated, truncated, info = env.step(np.zeros(1, dtype=np.float32))
        assert (info["cost"].tolist(), terminated, truncated) == ([float(is_fast)], is_fast, False)

    def test_scales_the_reward_to_be_worth_living_for(self) -> None:
        """Catches a reward below zero, for which an early end would be a gain."""
        env = _load("cura_on_gymnasium").SpeedLimit(gymnasium.make("Pendulum-v1"))
        env.reset(seed=0)
        env.unwrapped.state = np.array([0.0, 0.0])
        assert env.step(np.zeros(1, dtype=np.float32))[1] == pytest.approx(1.0)
        env.unwrapped.state = np.array([math.pi / 2, 4.0])
        # -(pi / 2)^2 - 0.1 * 4^2 - 0.001 * 2^2 = -4.0714; 1 - 4.0714 / 16.3 = 0.75022
        assert env.step(np.full(1, 2.0, dtype=np.float32))[1] == pytest.approx(0.75022, abs=1e-4)

    def test_hands_the_cost_to_torchrl(self) -> None:
        """Catches a cost that is lost between the info and the rollout, or has another shape than the reward."""
        env = _load("cura_on_gymnasium").make_task()
        check_env_specs(env)
        rollout = env.rollout(5)
        assert rollout["next", "cost"].shape == rollout["next", "reward"].shape == (5, 1)


class TestPillars:
    """The worlds of ``confidence_map_elsewhere``."""

    def test_ranges_are_those_of_circles(self) -> None:
        """Catches rays that count from elsewhere, turn the other way, or see through the robot's back."""
        example = _load("confidence_map_elsewhere")
        # The robot at (1, 0) looks along y: a pillar at (1, 2) is 2 m ahead, one at (-1, 0) is 2 m to the left.
        pose = torch.tensor([[1.0, 0.0, math.pi / 2]])
        centres = example.relative(torch.tensor([[[1.0, 2.0], [-1.0, 0.0]]]), pose)
        assert torch.allclose(centres, torch.tensor([[[2.0, 0.0], [0.0, 2.0]]]), atol=1e-6)
        ranges = example.cast(centres)[0]
        # From straight behind, counter-clockwise, 180 rays: behind, right, ahead, left. The radius is 0.3 m.
        assert ranges[[0, 45, 90, 135]].tolist() == pytest.approx([4.0, 4.0, 1.7, 1.7], abs=1e-5)

    def test_are_an_environment(self) -> None:
        """Catches specs that differ from the data, and a reset of one world that moves the others."""
        worlds = _load("confidence_map_elsewhere").PillarWorlds(2)
        check_env_specs(worlds)
        state = worlds.reset()
        state = worlds.step(state.set("action", torch.ones(2, 2)))["next"]
        # One step of 0.2 s: yaw 0.2, then 0.2 m along it: x = 0.2 * cos(0.2) = 0.19601, y = 0.2 * sin(0.2) = 0.03973.
        assert state["robot", "odometry"][0].tolist() == pytest.approx([0.19601, 0.03973, 0.2], abs=1e-5)
        before = worlds.pillars.clone()
        worlds.reset(TensorDict(_reset=torch.tensor([[True], [False]]), batch_size=[2]))
        assert worlds.pose[:, 0].tolist() == pytest.approx([0.0, 0.19601], abs=1e-5)
        assert (worlds.pillars != before).any(-1).any(-1).tolist() == [True, False]


class TestMapEntropy:
    """The method of ``a_method_of_ones_own``."""

    def test_entropy_is_that_of_the_cells_ahead(self) -> None:
        """Catches cells behind or beside that count, a wrong channel, and another unit than the bit."""
        entropy_ahead = _load("a_method_of_ones_own").entropy_ahead
        window = torch.zeros(1, 2, 4, 4)
        window[:, 1] = 1.0  # what is occupied makes no difference
        assert entropy_ahead(window, 1).tolist() == [[1.0]]  # nothing seen: one bit a cell
        window[:, 0, :2] = 1.0  # behind
        window[:, 0, :, [0, 3]] = 1.0  # aside
        assert entropy_ahead(window, 1).tolist() == [[1.0]]
        # Ahead are the rows 2, 3 of the columns 1, 2. Confidence 1, 1, 0.5, 0: bits 0, 0, h(3/4), 1, where
        # h(3/4) = 3/4 log2(4/3) + 1/4 log2(4) = 0.31128 + 0.5 = 0.81128; the mean is 1.81128 / 4 = 0.45282.
        window[0, 0, 2:, 1:3] = torch.tensor([[1.0, 1.0], [0.5, 0.0]])
        assert entropy_ahead(window, 1).item() == pytest.approx(0.45282, abs=1e-5)

    def test_bonus_is_added_to_the_reward_of_a_step(self) -> None:
        """Catches a bonus for not knowing, one that replaces the task's reward, and one without its coefficient."""
        transform = _load("a_method_of_ones_own").MapEntropyBonus(2.0, half_width=1)
        maps = torch.stack([torch.zeros(2, 4, 4), torch.ones(2, 4, 4)])
        data = TensorDict(confidence_map=maps, reward=torch.full((2, 1), 3.0), batch_size=[2])
        # Nothing known: 3 + 2 * 0; all known: 3 + 2 * 1.
        assert transform._call(data)["reward"].tolist() == [[3.0], [5.0]]

    def test_environment_pays_it_and_removes_the_map(self) -> None:
        """Catches a transform behind the encoder, where the map is gone, and a map that the collector would carry."""
        env = _load("a_method_of_ones_own").make_env(2, 2.0)
        assert isinstance(env, TransformedEnv)
        check_env_specs(env)
        rollout = env.rollout(3, break_when_any_done=False)
        assert "confidence_map" not in rollout["next"]
        bonus = rollout["next", "reward"] - rollout["next", "reward_terms"].sum(-1, keepdim=True)
        assert bool(((bonus > 0.0) & (bonus <= 2.0)).all())
