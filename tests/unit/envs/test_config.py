"""Configs refuse what cannot be meant, in one line."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest

from cura_torchrl.envs.config import (
    LidarConfig,
    MapConfig,
    PhysicsConfig,
    PushEnvConfig,
    RewardConfig,
    RobotConfig,
    ScenarioConfig,
    TaskConfig,
)

CONFIGS = (ScenarioConfig, RewardConfig, TaskConfig, RobotConfig, LidarConfig, MapConfig, PhysicsConfig)


@pytest.mark.parametrize(
    ("config", "changes"),
    [
        (ScenarioConfig, {"max_obstacles": 7}),
        (ScenarioConfig, {"max_obstacles": -1}),
        (ScenarioConfig, {"num_fallbacks": 0}),
        (ScenarioConfig, {"object_edges": ()}),
        (ScenarioConfig, {"obstacle_edges": (0.4, -0.6)}),
        (ScenarioConfig, {"goal_x": (14.0, 12.0)}),
        (ScenarioConfig, {"object_mass": (0.0, 10.0)}),
        (RewardConfig, {"max_speed": 0.0}),
        (TaskConfig, {"policy_period": 0.0}),
        (TaskConfig, {"episode_time": 0.1}),
        (TaskConfig, {"success_time": -1.0}),
        (TaskConfig, {"curriculum": ((10, 2), (5, 3))}),
        (TaskConfig, {"curriculum": ((0, 7),)}),
        (ScenarioConfig, {"kind": "adverserial"}),
        (ScenarioConfig, {"com_shift": 0.5}),
        (ScenarioConfig, {"obstacle_clearance": -1.0}),
        (TaskConfig, {"stream": "test"}),
        (RobotConfig, {"model": "franka"}),
        (RobotConfig, {"base_time_constant": 0.0}),
        (RobotConfig, {"stiffness": (0.0,) * 7}),
        (RobotConfig, {"ik_damping": 0.0}),
        (RobotConfig, {"stiffness": (600.0,) * 6}),
        (LidarConfig, {"num_rays": 7}),
        (LidarConfig, {"num_rays": 8193}),
        (LidarConfig, {"noise": -0.1}),
        (MapConfig, {"decay": 1.1}),
        (MapConfig, {"window": 0}),
        (MapConfig, {"channels": "occupancy"}),
        (PhysicsConfig, {"gravity": -9.81}),
        (PushEnvConfig, {"simulator": "Planar"}),
        (PhysicsConfig, {"control_period": 0.0}),
        (PushEnvConfig, {"physics": PhysicsConfig(control_period=0.03)}),
    ],
)
def test_values_that_cannot_be_meant_are_refused_in_one_line(config: type, changes: dict[str, Any]):
    """Catches a check that was lost, and a message that does not name field, value and what is accepted."""
    with pytest.raises(ValueError, match=r"^[\w, .]+ is .*; accepted: ") as error:
        config(**changes)
    assert "\n" not in str(error.value)
    names = [*changes, "control_period"]
    assert any(name in str(error.value) for name in names)


def test_a_plane_has_no_lidar_above_its_cubes():
    """Catches rays that hit, on the planar simulator, what they pass over on PyBullet."""
    above = LidarConfig(height=0.45)
    PushEnvConfig(lidar=above)
    with pytest.raises(ValueError, match=r"LiDAR is 0\.45; accepted: below the lowest cube's 0\.4 m"):
        PushEnvConfig(lidar=above, simulator="planar")


@pytest.mark.parametrize("config", CONFIGS)
def test_numbers_that_are_not_finite_are_refused(config: type):
    """Catches a field that is left out of the check: NaN passes every comparison that is written the wrong way."""
    for field in dataclasses.fields(config):
        value = getattr(config(), field.name)
        for wrong in (math.nan, math.inf):
            if isinstance(value, float):
                broken = wrong
            elif isinstance(value, tuple) and value and isinstance(value[0], float):
                broken = (*value[:-1], wrong)
            else:
                continue
            with pytest.raises(ValueError, match=rf"^{config.__name__}.{field.name} is .*; accepted: finite numbers$"):
                config(**{field.name: broken})


@pytest.mark.parametrize("config", [*CONFIGS, PushEnvConfig])
def test_defaults_are_valid_frozen_and_documented(config: type):
    """Catches a default that its own check refuses, and a config that can change after the check."""
    made = config()
    name = dataclasses.fields(config)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(made, name, None)
    assert made == config()
    assert dataclasses.replace(made) == made


def test_the_curriculum_counts_frames() -> None:
    """Catches a curriculum that is one step off, or one that plays all obstacles before its first step."""
    task = TaskConfig(curriculum=((100, 1), (200, 3)))
    assert [task.max_obstacles(frames) for frames in (0, 99, 100, 199, 200, 10**9)] == [0, 0, 1, 1, 3, 3]
    assert TaskConfig().max_obstacles(0) == 6
