"""PyBullet worlds by hand, for tests of the physics: one robot, one box, no task."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from cura_torchrl.envs.config import PhysicsConfig, RobotConfig
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.controller import ImpedanceController
from cura_torchrl.envs.simulation.bullet import BulletWorlds
from cura_torchrl.envs.simulation.interface import SceneState

if TYPE_CHECKING:
    import numpy as np

    from cura_torchrl.envs.simulation.interface import TorqueLaw, Worlds, WorldState

TICKS = 40
"""Control ticks of 5 ms in a policy step."""

AWAY = (-30.0, 0.0, 0.0)
"""Where a body is put that a test has no use for."""


def make_scene(num_worlds: int = 1, **overrides: Any) -> SceneState:
    """Return the home posture at the origin and a 5 kg box far away; values may be given per world or for all."""
    values = {
        "edge": 0.5,
        "mass": 5.0,
        "friction": 0.5,
        "com": (0.0, 0.0, 0.0),
        "object": AWAY,
        "base": (0.0, 0.0, 0.0),
    }
    rows = {}
    for name, value in (values | overrides).items():
        tensor = torch.as_tensor(value, dtype=torch.float64)
        shape = tuple(torch.as_tensor(values[name]).shape)
        rows[name] = tensor.expand(num_worlds, *shape).clone()
    arm = torch.tensor(model.HOME, dtype=torch.float64).expand(num_worlds, -1)
    return SceneState(
        joint_position=torch.cat([rows["base"], arm], -1),
        object_edge=rows["edge"],
        object_mass=rows["mass"],
        floor_friction=rows["friction"],
        com_offset=rows["com"],
        object_pose=rows["object"],
        num_slots=6,
    )


def make_worlds(num_worlds: int = 1, **overrides: Any) -> BulletWorlds:
    """Return worlds, reset to :func:`make_scene`, with the default physics."""
    worlds = BulletWorlds(num_worlds, model.URDF, model.BASE_JOINTS + model.ARM_JOINTS, PhysicsConfig())
    worlds.reset(torch.arange(num_worlds), make_scene(num_worlds, **overrides))
    return worlds


def place(
    worlds: Worlds, world: int, slot: int, pose: tuple[float, float, float], edge: float, *, num_worlds: int = 1
) -> None:
    """Let one static cube appear."""
    is_new = torch.zeros(num_worlds, 6, dtype=torch.bool)
    is_new[world, slot] = True
    values = torch.tensor([*pose, edge], dtype=torch.float64).expand(num_worlds, 6, 4)
    worlds.place_obstacles(is_new, values[..., :3], values[..., 3])


class NoTorque:
    """A law for robots that are left alone."""

    ik_ticks = TICKS

    def solve_ik_of(self, world: int) -> None:
        """Plan nothing."""

    def torques_of(self, world: int, joints: np.ndarray) -> list[float]:
        """Return zeros."""
        return [0.0] * joints.shape[1]


class Recorder:
    """A law that passes another one on and keeps what each world saw and was told, tick by tick."""

    def __init__(self, law: TorqueLaw, num_worlds: int) -> None:
        self.law, self.ik_ticks = law, law.ik_ticks
        self.velocity: list[list[np.ndarray]] = [[] for _ in range(num_worlds)]
        self.torque: list[list[list[float]]] = [[] for _ in range(num_worlds)]

    def solve_ik_of(self, world: int) -> None:
        """Plan."""
        self.law.solve_ik_of(world)

    def torques_of(self, world: int, joints: np.ndarray) -> list[float]:
        """Return the law's torques."""
        torque = self.law.torques_of(world, joints)
        self.velocity[world].append(joints[1].copy())
        self.torque[world].append(torque)
        return torque


class Rig:
    """Robots under impedance control, moved by policy actions. Close it."""

    def __init__(self, num_worlds: int = 1, *, height_limit: float = 0.45, **overrides: Any) -> None:
        self.rows = num_worlds
        self.worlds = make_worlds(num_worlds, **overrides)
        self.controller = ImpedanceController(num_worlds, RobotConfig(), PhysicsConfig().control_period)
        limit = torch.full((num_worlds,), height_limit, dtype=torch.float64)
        self.controller.reset(torch.arange(num_worlds), limit)
        self.record = Recorder(self.controller, num_worlds)

    @property
    def state(self) -> WorldState:
        """State of the worlds."""
        return self.worlds.state()

    def move(self, *action: float, steps: int = 1, ticks: int = TICKS) -> None:
        """Play one action in every world."""
        self.play(torch.tensor(action).expand(steps, self.rows, 6), ticks)

    def play(self, actions: torch.Tensor, ticks: int = TICKS) -> None:
        """Play actions, shape ``[T, N, 6]``; the hand points ahead."""
        ahead = torch.tensor([[5.0, 0.0]], dtype=torch.float64).expand(self.rows, 2)
        for action in actions:
            self.controller.command(action, ahead, self.worlds.mass_matrix())
            self.worlds.advance(self.record, ticks)

    def tcp(self) -> np.ndarray:
        """Return the TCP in the base frame [m], shape ``[N, 3]``."""
        return self.controller.kinematics.forward(self.state.joint_position)[0].numpy()

    def close(self) -> None:
        """Disconnect."""
        self.worlds.close()
