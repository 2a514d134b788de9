"""The planar worlds' robot: its joints have stops, as in PyBullet, whatever pushes them."""

from __future__ import annotations

import pytest
import torch

from cura_torchrl.envs.config import PhysicsConfig
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.dynamics import RobotDynamics
from cura_torchrl.envs.simulation.interface import HandLinearization
from cura_torchrl.envs.simulation.planar import PlanarWorlds
from tests.worlds import make_scene

JOINTS = 7
TICKS = 10


class Push:
    """A law that asks for the same torques in every tick."""

    ik_ticks = TICKS

    def __init__(self, torque: torch.Tensor) -> None:
        self.torque = torch.cat([torch.zeros(len(torque), 3, dtype=torch.float64), torque], dim=-1)
        rows = len(torque)
        identity = torch.eye(3, dtype=torch.float64).expand(rows, 3, 3)
        self.hand = HandLinearization(
            torch.tensor([0.9, 0.0, 0.3], dtype=torch.float64).expand(rows, 3),
            identity,
            torch.zeros(rows, 6, JOINTS, dtype=torch.float64),
            reference=torch.zeros(rows, JOINTS, dtype=torch.float64),
        )

    def solve_ik(self) -> None:
        """Plan nothing."""

    def torques(self, position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Return the torques."""
        return self.torque


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_no_torque_turns_a_joint_past_its_stop(sign):
    """Catches stops that only the controller's reference has: a joint in contact was turned through 5 rad and beyond.

    Each joint in a world of its own, and all of them in the last: 4 s at the torque limit.
    """
    limit = torch.tensor(model.TORQUE_LIMIT, dtype=torch.float64)
    torque = sign * torch.cat([torch.diag(limit), limit[None]])
    worlds = PlanarWorlds(JOINTS + 1, RobotDynamics(), model.SHAPE, PhysicsConfig())
    worlds.reset(torch.arange(JOINTS + 1), make_scene(JOINTS + 1))
    law, reached = Push(torque), torch.zeros(JOINTS + 1, JOINTS, dtype=torch.bool)
    lower, upper = (torch.tensor(stop, dtype=torch.float64) for stop in (model.JOINT_LOWER, model.JOINT_UPPER))
    for _ in range(20):
        worlds.mass_matrix()
        worlds.advance(law, TICKS)
        state = worlds.state()
        position, outward = state.joint_position, sign * state.joint_velocity
        assert (position >= lower).all()
        assert (position <= upper).all()
        at_stop = position == (upper if sign > 0 else lower)
        assert (outward[at_stop] < 50.0).all(), "a stop stores no speed up"
        reached |= at_stop
    assert reached.diagonal().all(), "every joint has been at its stop"
