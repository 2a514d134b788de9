"""Base and arm under the controller at 200 Hz: rest, limits, tracking, pushing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pybullet
import pytest
import torch

from cura_torchrl.envs.robots import ridgeback_franka as model
from tests.worlds import TICKS, Rig

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any

TORQUE_LIMIT = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
STOP = (0.0,) * 6


@pytest.fixture
def rig() -> Iterator[Any]:
    """Build rigs that are closed after the test."""
    rigs: list[Rig] = []

    def build(num_worlds: int = 1, **overrides: Any) -> Rig:
        rigs.append(Rig(num_worlds, **overrides))
        return rigs[-1]

    yield build
    for one in rigs:
        one.close()


def joint_error(rig: Rig) -> float:
    """Return the largest difference of a joint from its reference [rad]."""
    return (rig.state.joint_position - rig.controller.reference).abs().max().item()


def test_the_arm_rests_at_its_reference(rig):
    """Catches an explicit impedance law, with which joint 7 swings by 1.9 rad, and a droop under gravity."""
    still = rig(2)
    still.move(*STOP, steps=10)
    assert joint_error(still) < 2e-3
    assert np.abs(still.tcp() - np.array(model.HOME_TCP)).max() < 1e-3
    assert still.state.joint_velocity.abs().max() < 1e-3
    assert still.state.base_pose.abs().max() < 1e-6
    assert (np.abs(np.array(still.record.torque)[:, :, 3:]) < 0.1 * TORQUE_LIMIT).all()


def test_the_arm_comes_to_rest_after_any_motion(rig):
    """Catches a reference that drifts, torques that saturate, and joints that are stuck at a limit."""
    moved = rig(4)
    moved.play(torch.rand(20, 4, 6, generator=torch.Generator().manual_seed(0)) * 2 - 1)
    moved.move(*STOP, steps=25)  # 5 s: the posture task, 1/s, still turns the elbow at first
    torque, velocity = np.array(moved.record.torque)[:, :, 3:], np.array(moved.record.velocity)[:, :, 3:]
    assert (np.abs(torque) < TORQUE_LIMIT).all()
    assert (np.abs(velocity) < 1.05 * np.array(model.VELOCITY_LIMIT)).all()
    assert joint_error(moved) < 2e-3
    # In the workspace's far low corner the arm is stretched: the damped solution stops 7 mm short. Elsewhere 1.2 mm.
    error = np.linalg.norm(moved.tcp() - moved.controller.tcp_reference.numpy(), axis=1)
    assert error.max() < 1e-2
    assert np.median(error) < 1.5e-3
    position = moved.state.joint_position.numpy()
    assert (position > np.array(model.JOINT_LOWER)).all()
    assert (position < np.array(model.JOINT_UPPER)).all()


@pytest.mark.parametrize(("axis", "direction"), [(1, 1.0), (1, -1.0), (0, 1.0), (2, -1.0)])
def test_the_free_hand_moves_as_commanded(rig, axis: int, direction: float):
    """Catches a twist in a wrong frame, a wrong scale, and IK too seldom to follow."""
    free = rig()
    action = [0.0] * 6
    action[3 + axis] = 0.5 * direction  # 0.25 m/s
    steps = 5 if axis == 1 else 2  # the workspace ends 0.13 m ahead and 0.08 m below
    reference = np.array(model.HOME_TCP)
    path = [free.tcp()[0]]
    for step in range(steps):
        free.move(*action)
        path.append(free.tcp()[0])
        wanted = reference.copy()
        wanted[axis] += 0.05 * direction * (step + 1)
        if axis == 2:
            wanted[2] = max(wanted[2], 0.2)
        # The impedance lets the hand lag by D/K, about 0.1 s at 0.25 m/s.
        assert np.abs(path[-1] - wanted).max() < 0.025
    if axis == 1:
        speed = np.diff(np.array(path)[:, axis])[2:] / 0.2
        np.testing.assert_allclose(speed, 0.25 * direction, rtol=0.1)


def test_the_base_keeps_its_limits(rig):
    """Catches a step of the velocity command, and speeds that add up over the axes or on the way between two."""
    base = rig()
    diagonal = math.sqrt(0.5)
    base.move(1.0, 1.0, 0.0, 0.0, 0.0, 0.0, steps=4)
    velocity = base.state.base_velocity[0, :2]
    torch.testing.assert_close(velocity, torch.full((2,), 0.8 * diagonal).double(), atol=0.01, rtol=0)
    base.move(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, steps=3)  # ramped axis by axis it would pass 0.847 m/s
    base.move(-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, steps=4)
    planar = np.array(base.record.velocity[0])[:, :2]
    assert np.linalg.norm(planar, axis=1).max() < 0.8 * 1.005
    assert planar[-1, 0] == pytest.approx(-0.8, abs=0.01)
    acceleration = np.diff(planar, axis=0) / 0.005
    assert 2.3 < np.abs(acceleration).max() < 2.5 * 1.02  # 2 % for the swinging arm


def test_the_base_turns_within_its_limits(rig):
    """Catches a yaw rate or yaw acceleration beyond 1 rad/s and 1 rad/s^2."""
    base = rig()
    base.move(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, steps=7)
    rate = np.array(base.record.velocity[0])[:, 2]
    assert rate[-1] == pytest.approx(1.0, abs=0.01)
    assert rate.max() < 1.0 * 1.02
    # The arm is carried along and swings: 6 % on top of the command's ramp.
    assert 0.9 < np.diff(rate).max() / 0.005 < 1.1


def test_velocity_commands_are_in_the_base_frame(rig):
    """Catches a base that drives along the world's axes."""
    turned = rig(base=(1.0, 2.0, math.pi / 2))
    turned.move(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, steps=5)
    moved = turned.state.base_pose[0] - torch.tensor([1.0, 2.0, math.pi / 2]).double()
    # 1 s with a ramp of 0.32 s to 0.8 m/s: 0.8 (1 - 0.16) = 0.672 m, less 0.8 * 0.02 of the servo.
    assert moved[1].item() == pytest.approx(0.656, abs=0.01)
    assert moved[0].abs() < 0.01


@pytest.mark.parametrize(("edge", "mass", "friction"), [(0.5, 3.0, 0.25), (1.0, 10.0, 0.6)])
def test_a_pushed_box_is_not_penetrated(rig, edge: float, mass: float, friction: float):
    """Catches contact that gives way at full speed, an arm that is pushed back, and a box that is not moved."""
    push = rig(object=(1.0 + edge / 2, 0.0, 0.0), edge=edge, mass=mass, friction=friction, height_limit=0.3)
    depth = _push(push, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0), steps=12)
    assert depth < 3e-3
    assert push.state.object_velocity[0, 0].item() == pytest.approx(0.8, abs=0.05)
    gap = push.state.object_position[0, 0] - edge / 2 - push.state.base_pose[0, 0]
    assert gap.item() == pytest.approx(0.9, abs=0.06)  # the TCP has been pressed back by a few centimetres at most
    assert (np.abs(np.array(push.record.torque)[:, :, 3:]) < TORQUE_LIMIT).all()


def test_the_chassis_does_not_enter_a_box(rig):
    """Catches a chassis without a collision shape of its own."""
    push = rig(object=(0.0, 0.3965 + 0.25 + 0.1, 0.0), mass=10.0, friction=0.6)
    depth = _push(push, (0.0, 1.0, 0.0, 0.0, 0.0, 0.0), steps=8)
    assert depth < 3e-3
    gap = push.state.object_position[0, 1] - push.state.base_pose[0, 1]
    assert gap.item() == pytest.approx(0.3965 + 0.25, abs=0.01)


def _push(push: Rig, action: tuple[float, ...], steps: int) -> float:
    """Return the deepest that robot and object went into each other [m]."""
    worlds, depth = push.worlds, 0.0
    for _ in range(steps * 5):
        push.move(*action, ticks=TICKS // 5)
        points = pybullet.getContactPoints(worlds._robot[0], worlds._object[0], physicsClientId=worlds._clients[0])
        depth = max([depth, *(-point[8] for point in points)])
    assert points
    return depth
