"""The robots that there are: what the environment and the simulators take from each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs.robots import ridgeback, ridgeback_franka
from cura_torchrl.envs.robots.base_controller import BaseController
from cura_torchrl.envs.robots.controller import ImpedanceController
from cura_torchrl.envs.robots.dynamics import BaseDynamics, RobotDynamics
from cura_torchrl.envs.simulation.interface import RobotShape

if TYPE_CHECKING:
    from cura_torchrl.envs.config import RobotName
    from cura_torchrl.envs.simulation.interface import WorldState


@dataclass(frozen=True, kw_only=True)
class RobotModel:
    """One robot: a base with three joints, and an arm or none."""

    urdf: Path
    """The model that PyBullet reads."""
    joints: tuple[str, ...]
    """Names of its joints, those of the base first."""
    home: tuple[float, ...]
    """Joints of the arm at the start [rad]."""
    tcp: tuple[float, float, float]
    """What pushes, the hand's TCP or the centre of the front face, at the start, base frame [m]."""
    shape: RobotShape
    """The robot seen from above."""
    action_size: int
    """Numbers of an action [1]."""
    rewarded_joints: slice
    """Joints, those of the base first, whose acceleration the reward counts."""
    controller: type[BaseController]
    """Its control law."""
    dynamics: type[RobotDynamics | BaseDynamics]
    """Its inertia, for simulators that have none of their own."""

    def rewarded_acceleration(self, before: WorldState, after: WorldState, period: float) -> torch.Tensor:
        """Return the mean acceleration of the joints that the reward counts.

        Args:
            before: State of N worlds.
            after: Their state some time later.
            period: That time [s].

        Returns:
            Accelerations [m/s^2, rad/s^2], shape ``[N, K]``.
        """
        velocities = (torch.cat([state.base_velocity, state.joint_velocity], dim=-1) for state in (before, after))
        start, end = (velocity[:, self.rewarded_joints] for velocity in velocities)
        return (end - start) / period


ROBOT_MODELS: dict[RobotName, RobotModel] = {
    "ridgeback_franka": RobotModel(
        urdf=ridgeback_franka.URDF,
        joints=ridgeback_franka.JOINTS,
        home=ridgeback_franka.HOME,
        tcp=ridgeback_franka.HOME_TCP,
        shape=ridgeback_franka.SHAPE,
        action_size=ridgeback_franka.ACTION_SIZE,
        rewarded_joints=slice(ridgeback.BASE_DOF, None),
        controller=ImpedanceController,
        dynamics=RobotDynamics,
    ),
    "ridgeback": RobotModel(
        urdf=ridgeback.URDF,
        joints=ridgeback.BASE_JOINTS,
        home=(),
        tcp=ridgeback.FACE,
        shape=ridgeback.SHAPE,
        action_size=ridgeback.ACTION_SIZE,
        rewarded_joints=slice(ridgeback.BASE_DOF),
        controller=BaseController,
        dynamics=BaseDynamics,
    ),
}
"""By the name that :attr:`cura_torchrl.envs.config.RobotConfig.model` has for it."""
