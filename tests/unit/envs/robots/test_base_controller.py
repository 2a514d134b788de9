"""The bare base's law, without a simulator: a ramp, a servo, and one form for each device."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cura_torchrl.envs.config import PhysicsConfig, RobotConfig
from cura_torchrl.envs.robots.base_controller import BaseController, FaceKinematics
from cura_torchrl.envs.robots.controller import ImpedanceController

ROBOT, PERIOD = RobotConfig(model="ridgeback"), PhysicsConfig().control_period
AHEAD = torch.tensor([[5.0, 0.0]], dtype=torch.float64)
INERTIA = torch.diag(torch.tensor([135.2, 135.1, 17.443], dtype=torch.float64))
TICKS = 40


def make_controller(rows: int = 1) -> BaseController:
    """Return a controller at rest."""
    return BaseController(rows, ROBOT, PERIOD)


def command(controller: BaseController, action: torch.Tensor) -> None:
    """Give every robot its action, with the model's inertia."""
    rows = len(action)
    controller.command(action, AHEAD.expand(rows, 2), INERTIA.expand(rows, 3, 3))


def test_the_force_is_the_implicit_servo():
    """Catches a force in the base's frame, a servo of another time constant, and an explicit law."""
    controller = make_controller()
    command(controller, torch.tensor([[0.5, 0.0, 0.0]]))
    position = torch.tensor([[1.0, 2.0, math.pi / 2]], dtype=torch.float64)
    velocity = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    force = controller.torques(position, velocity)[0].numpy()
    # After a tick of 5 ms at 2.5 m/s^2 the command is 0.0125 m/s ahead, which is the world's y at a quarter turn.
    # Servo: D = m / 0.02 s; implicit: tau = m / (m + D dt) D e = D e / (1 + 0.005 / 0.02).
    error = np.array([-0.1, 0.0125 + 0.2, -0.3])
    expected = np.array([135.2, 135.2, 17.443]) / 0.02 * error
    gain = np.array([135.2, 135.1, 17.443]) / (np.array([135.2, 135.1, 17.443]) + np.array([135.2, 135.2, 17.443]) / 4)
    np.testing.assert_allclose(force, gain * expected, rtol=1e-9)


def test_the_command_is_that_of_the_robot_with_the_arm():
    """Catches another ramp or speed limit: the base must not be a quicker one for the want of an arm."""
    bare, armed = make_controller(), ImpedanceController(1, RobotConfig(), PERIOD)
    rest = torch.zeros(1, 10, dtype=torch.float64)
    for action in ([1.0, 0.4, 1.0], [-0.6, 0.7, -1.0], [0.0, -1.0, 0.2]):
        command(bare, torch.tensor([action]))
        armed.command(torch.tensor([[*action, 0.0, 0.0, 0.0]]), AHEAD, torch.eye(10, dtype=torch.float64)[None])
        for _ in range(TICKS):
            bare.torques(rest[:, :3], rest[:, :3])
            armed.torques(rest, rest)
            assert torch.equal(bare.base_command, armed.base_command)
    # Of the last 0.2 s: from some 0.56 m/s to the left by 2.5 m/s^2 to the right, from 0 rad/s by 0.2 rad/s.
    assert bare.base_command[0, 1:].tolist() == pytest.approx([0.06, 0.2], abs=1e-6)


def test_one_robot_at_a_time_does_what_all_at_once_do():
    """Catches a compiled law that takes the arm's joints for granted."""
    tensors, compiled = make_controller(5), make_controller(5)
    generator = torch.Generator().manual_seed(0)
    for _ in range(6):
        action = 2.0 * torch.rand(5, 3, generator=generator) - 1.0
        command(tensors, action)
        command(compiled, action)
        for _ in range(TICKS):
            position = torch.randn(5, 3, generator=generator, dtype=torch.float64)
            velocity = torch.randn(5, 3, generator=generator, dtype=torch.float64)
            joints = torch.stack([position, velocity], 1).numpy()
            alone = torch.tensor([compiled.torques_of(row, joints[row]) for row in range(5)], dtype=torch.float64)
            torch.testing.assert_close(alone, tensors.torques(position, velocity), rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(compiled.base_command, tensors.base_command, rtol=0.0, atol=1e-12)


def test_a_reset_stops_its_rows_alone():
    """Catches a partial reset that stops other robots."""
    controller = make_controller(2)
    command(controller, torch.ones(2, 3))
    controller.torques(torch.zeros(2, 3, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64))
    controller.reset(torch.tensor([1]), torch.tensor([0.3]))
    assert (controller.base_command[0] > 0).all()
    assert (controller.base_command[1] == 0).all()


def test_the_face_is_where_the_chassis_ends():
    """Catches a face at the base's centre, and axes that are a hand's."""
    position, rotation, jacobian = FaceKinematics().forward(torch.zeros(2, 0, dtype=torch.float64))
    # Half of 0.960 m ahead; 0.18 m is the middle of the chassis' box, 0.056 to 0.306 m, rounded to centimetres.
    np.testing.assert_allclose(position, [[0.48, 0.0, 0.18]] * 2)
    np.testing.assert_array_equal(rotation, [np.eye(3)] * 2)
    assert jacobian.shape == (2, 6, 0)
