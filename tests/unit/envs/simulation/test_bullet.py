"""What PyBullet's worlds refuse, report and forget."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pybullet
import pytest
import torch

from cura_torchrl.envs.config import PhysicsConfig
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.simulation.bullet import BulletWorlds
from cura_torchrl.envs.simulation.interface import SimulationError
from tests.worlds import TICKS, NoTorque, make_scene, make_worlds, place

if TYPE_CHECKING:
    import numpy as np


class Throw(NoTorque):
    """A law that returns one torque for all joints."""

    def __init__(self, torque: float) -> None:
        self.torque = torque

    def torques_of(self, world: int, joints: np.ndarray) -> list[float]:
        """Return the torque."""
        return [self.torque] * joints.shape[1]


def test_a_torque_that_is_not_a_number_is_an_error_that_names_the_world():
    """Catches NaN that spreads silently: a robot nowhere collides with nothing."""
    worlds = make_worlds(2)
    with pytest.raises(SimulationError, match=r"^worlds \[0, 1\] have joint states that are not finite$"):
        worlds.advance(Throw(float("nan")), 1)
    worlds.close()


def test_an_object_that_is_nowhere_is_an_error_that_names_the_world():
    """Catches a lost object, whose reward and scan would be nonsense."""
    worlds = make_worlds(2)
    nowhere = [float("nan"), 0.0, 0.0]
    pybullet.resetBaseVelocity(worlds._object[1], nowhere, [0.0, 0.0, 0.0], physicsClientId=worlds._clients[1])
    with pytest.raises(SimulationError, match=r"^worlds \[1\] have an object whose state is not finite$"):
        worlds.state()
    worlds.close()


def test_joints_in_another_order_are_refused():
    """Catches a model whose joints are not those that the controller commands."""
    worlds = BulletWorlds(1, model.URDF, model.ARM_JOINTS + model.BASE_JOINTS, PhysicsConfig())
    with pytest.raises(SimulationError, match=r"^the robot's joints are \['base_x', .*; accepted: \['panda_joint1'"):
        worlds.reset(torch.arange(1), make_scene(1))
    worlds.close()


def test_a_reset_touches_its_worlds_alone():
    """Catches a reset by the row of the scene in place of the index of the world."""
    worlds = make_worlds(3, object=[(5.0, float(row), 0.0) for row in range(3)])
    worlds.reset(torch.tensor([2, 0]), make_scene(2, object=[(7.0, 0.0, 0.0), (8.0, 0.0, 0.0)]))
    assert worlds.state().object_position[:, 0].tolist() == pytest.approx([8.0, 5.0, 7.0])
    worlds.close()


def test_a_reset_removes_obstacles_and_contacts():
    """Catches what is left over from the last episode."""
    worlds = make_worlds(1)
    place(worlds, 0, 0, (0.0, 0.0, 0.0), 0.6)
    worlds.advance(NoTorque(), 1)
    assert worlds.state().contact[0, 0]
    worlds.reset(torch.arange(1), make_scene(1))
    assert not worlds.state().contact.any()
    worlds.advance(NoTorque(), TICKS)
    assert not worlds.state().contact.any()
    worlds.close()


def test_the_robot_may_touch_the_object_and_ignores_the_floor():
    """Catches contact that counts as a collision, and a chassis that rubs on the floor."""
    worlds = make_worlds(1, object=(1.15, 0.0, 0.0))  # its face at 0.9 m, where the TCP is
    worlds.advance(NoTorque(), 1)
    touched = pybullet.getContactPoints(worlds._robot[0], physicsClientId=worlds._clients[0])
    assert {point[2] for point in touched} == {worlds._object[0]}
    assert not worlds.state().contact.any()
    worlds.close()


def test_the_state_does_not_alias_the_worlds():
    """Catches a view of the simulator's buffers, in which the past would change."""
    worlds = make_worlds(1)
    before = worlds.state()
    worlds.advance(Throw(5.0), TICKS)
    after = worlds.state()
    assert (before.joint_velocity == 0).all()
    assert (after.joint_velocity != 0).all()
    worlds.close()


def test_closing_disconnects_every_client_once():
    """Catches clients that are left open, 28 MB each, and a second close that raises."""
    worlds = make_worlds(2)
    clients = list(worlds._clients)
    assert all(pybullet.isConnected(client) for client in clients)
    worlds.close()
    worlds.close()
    assert not any(pybullet.isConnected(client) for client in clients)
