"""What the benchmarks compare, what they record, and that their checks can fail."""

from __future__ import annotations

import json
import math
import os
from typing import TYPE_CHECKING

import numpy as np
import pybullet
import pytest
import torch

from cura_torchrl.envs.config import LidarConfig, MapConfig, PushEnvConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.simulation.bullet_floor import BulletFloor
from cura_torchrl.trainers.bench import TARGETS, as_table, bench
from cura_torchrl.trainers.benches import peers as bench_peers
from cura_torchrl.trainers.benches.config import BenchConfig
from cura_torchrl.trainers.benches.env import Episode
from cura_torchrl.trainers.benches.lidar import see_all_cells
from cura_torchrl.trainers.benches.report import Report, measure
from cura_torchrl.trainers.errors import UnavailableError

if TYPE_CHECKING:
    from pathlib import Path

TINY = {
    "rounds": 1, "steps": 2, "num_envs": 2, "sweep": (1,), "planar_envs": 2, "peer_envs": 2, "maps": 16,
    "batch_size": 64,
}  # fmt: skip


def test_measuring_takes_turns_and_forgets_the_first_round():
    """Catches rounds of one thing after those of another, which a busy minute would tell apart."""
    called: list[str] = []

    def play(name: str) -> float:
        called.append(name)
        return float(len(called))

    taken = measure({"a": lambda: play("a"), "b": lambda: play("b")}, rounds=2)
    assert called == ["a", "b", "a", "b", "a", "b"]
    assert taken == {"a": [3.0, 5.0], "b": [4.0, 6.0]}


def test_a_ratio_is_taken_within_each_round():
    """Catches the ratio of two medians, in which a slow round of one and a fast one of the other meet."""
    report = Report()
    report.add_ratio("x", [1.0, 10.0, 4.0], [2.0, 10.0, 1.0], ">= 1")
    assert report.ratios["x"] == {"median": 1.0, "min": 0.5, "max": 4.0, "aim": ">= 1"}


def test_a_check_that_fails_is_told():
    """Catches a table that prints a speed of something that computed the wrong thing, without a word."""
    report = Report()
    report.add_check("fine", 1e-7, 1e-6)
    report.add_check("wrong", 2e-6, 1e-6)
    assert [entry["holds"] for entry in report.checks.values()] == [True, False]
    text = as_table({"ratios": {}, "figures": {}, "checks": report.checks, "notes": []})
    assert "check: wrong: 2e-06, at most 1e-06: DOES NOT HOLD" in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rounds": 0}, "rounds is 0; accepted: 1 or more"),
        ({"peer_envs": 3}, "peer_envs is 3; accepted: a multiple of num_workers, which is 2"),
        ({"sweep": (0,)}, r"sweep is \(0,\); accepted: 1 or more each"),
        ({"seed": -1}, "seed is -1; accepted: 0 to 2147483647"),
    ],
)
def test_settings_that_measure_nothing_are_refused(changes: dict[str, object], message: str):
    """Catches a division by no round, and worlds that cannot be shared out."""
    with pytest.raises(ValueError, match=message):
        BenchConfig(target="env", **changes)


@pytest.mark.parametrize("target", ["env", "learner", "lidar", "ik"])
def test_a_target_measures_and_records(target: str, tmp_path: Path):
    """Catches a target that does not run, a file without what it was made with, and a check that does not hold."""
    path = tmp_path / "folder" / "result.json"
    result = bench(BenchConfig(target=target, output=path, **TINY))
    assert json.loads(path.read_text(encoding="utf-8")) == result
    assert {"command", "commit", "hardware", "versions", "load_average", "settings"} <= set(result)
    assert result["settings"]["target"] == target
    assert result["ratios"]
    for entry in [*result["ratios"].values(), *result["figures"].values()]:
        assert 0.0 < entry["min"] <= entry["median"] <= entry["max"] < math.inf
    assert all(entry["holds"] for entry in result["checks"].values())
    assert all(name in as_table(result) for name in result["ratios"])


@pytest.mark.parametrize(("load", "notes"), [(0.0, 0), (1e3, 1)])
def test_a_busy_machine_is_noted(load: float, notes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Catches wall-clock figures of a machine that others kept busy, published as if it had been idle."""
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    result = bench(BenchConfig(target="ik", output=tmp_path / "result.json", **TINY))
    assert len([note for note in result["notes"] if note.startswith("the machine was busy")]) == notes


def test_every_target_of_the_command_line_has_a_module():
    """Catches a target that help offers and nothing measures."""
    assert set(TARGETS) == {"env", "learner", "lidar", "ik", "peers"}


def test_the_bare_loop_does_the_same_physics():
    """Catches a floor whose robots stand still, and a comparison that would not notice another torque."""
    episode = Episode(2, 3, seed=0)
    assert episode.play() > 0.0
    assert episode.play_bare() > 0.0
    assert episode.error == 0.0
    episode._torques[1][0][5][0] += 1.0
    episode.play_bare()
    assert 0.0 < episode.error < 1.0
    episode.close()


def test_the_bare_loop_needs_pybullet():
    """Catches a floor that is measured in worlds that are not PyBullet's."""
    env = PushEnv(1, PushEnvConfig(simulator="planar"))
    with pytest.raises(TypeError, match="worlds are PlanarWorlds; accepted: BulletWorlds"):
        BulletFloor(env._worlds)
    env.close()


def test_pybullet_brings_the_arm_to_its_target():
    """Catches inverse kinematics of another link, or with joints in another order."""
    env = PushEnv(2)
    env.reset()
    floor, worlds = BulletFloor(env._worlds), env._worlds
    targets = [(x + 0.8, y, 0.5) for x, y, _ in env.world_state.base_pose.tolist()]
    for world, (solution, target) in enumerate(zip(floor.solve_ik(targets, 200), targets, strict=True)):
        robot, client = worlds._robot[world], worlds._clients[world]
        for joint, value in enumerate(solution):
            pybullet.resetJointState(robot, joint, value, physicsClientId=client)
        last = pybullet.getLinkState(robot, len(solution) - 1, computeForwardKinematics=1, physicsClientId=client)
        assert math.dist(last[4], target) < 0.01  # Bullet stops at 1e-4 m, or after its iterations
    env.close()


def test_all_cells_are_seen_up_to_the_range():
    """Catches a reference that tests nothing, or turns the map: a scan that reads 2 m to the left, 0 m elsewhere."""
    lidar, grid = LidarConfig(), MapConfig()
    scan = torch.zeros(1, lidar.num_rays)
    scan[0, 3 * lidar.num_rays // 4 - 20 : 3 * lidar.num_rays // 4 + 20] = 2.0  # rays start behind: left is at 3/4
    free = see_all_cells(scan, torch.tensor([[0.05, 0.05, 0.0]]), grid)[0]

    def at(x: float, y: float) -> bool:
        return bool(free[round((x - grid.extent_x[0]) / 0.1 - 0.5), round((y - grid.extent_y[0]) / 0.1 - 0.5)])

    assert (at(0.05, 1.05), at(0.05, 1.85), at(0.05, 2.15), at(0.05, -1.05), at(1.05, 0.05)) == (
        True, True, False, False, False,
    )  # fmt: skip


def test_peers_without_gymnasium_name_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Catches a traceback in place of the line that says what to install."""
    monkeypatch.setattr(bench_peers, "gymnasium", None)
    with pytest.raises(UnavailableError, match=r"gymnasium is not installed; .*cura-torchrl\[peers\]"):
        bench(BenchConfig(target="peers", output=tmp_path / "result.json", **TINY))


def test_a_virtual_environment_that_cannot_be_made_is_a_note(tmp_path: Path):
    """Catches a benchmark that dies because the package index cannot be reached."""
    (tmp_path / "file").write_text("", encoding="utf-8")
    report = Report()
    assert bench_peers.find_panda(tmp_path / "file" / "venv", report) is None
    assert len(report.notes) == 1
    assert report.notes[0].startswith("panda-gym was left out: it cannot be installed into ")


def test_a_single_gymnasium_world_is_a_row_of_the_batch():
    """Catches peers that play other scenes, or observe something else."""
    pytest.importorskip("gymnasium")
    batch, single = PushEnv(3), bench_peers.PushGymEnv(1, 3, 0)
    data, (seen, _) = batch.reset(), single.reset()
    action = np.linspace(-1.0, 1.0, 6, dtype=np.float32)
    for _ in range(2):
        for name, value in seen.items():
            np.testing.assert_array_equal(value, data[name][1].numpy())
        assert single.observation_space.contains(seen)
        data = batch.step(data.set("action", torch.from_numpy(action).expand(3, 6).clone()))["next"]
        seen, reward, terminated, truncated, _ = single.step(action)
        assert reward == data["reward"][1].item()
        assert (terminated, truncated) == (data["terminated"][1].item(), data["truncated"][1].item())
    batch.close()
    single.close()


@pytest.mark.slow
def test_peers_measure_and_record(tmp_path: Path):
    """Catches peers that do not run; panda-gym is left out, as it needs the network."""
    pytest.importorskip("gymnasium")
    result = bench(BenchConfig(target="peers", output=tmp_path / "result.json", **TINY))
    assert {"PushEnv in 2 processes / ParallelEnv", "PushEnv in 2 processes / AsyncVectorEnv"} <= set(result["ratios"])
    assert "panda-gym was left out: --panda-gym installs and measures it" in result["notes"]
