"""Damped least squares against an independent solution."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cura_torchrl.envs.robots.kinematics import ArmKinematics, damped_least_squares


@pytest.mark.parametrize("damping", [0.0, 0.02, 0.5])
def test_the_solution_is_that_of_the_damped_problem(damping: float):
    """Catches a damping that is not squared, and a solution that is not the shortest."""
    generator = np.random.default_rng(0)
    jacobian, twist = generator.normal(size=(3, 6, 7)), generator.normal(size=(3, 6))
    velocity, free = damped_least_squares(torch.from_numpy(jacobian), torch.from_numpy(twist), damping)
    for row in range(3):
        # argmin |J q - v|^2 + damping^2 |q|^2, as one least-squares problem.
        stacked = np.concatenate([jacobian[row], damping * np.eye(7)])
        expected = np.linalg.lstsq(stacked, np.concatenate([twist[row], np.zeros(7)]), rcond=None)[0]
        np.testing.assert_allclose(velocity[row], expected, atol=1e-9)
        if damping == 0.0:
            np.testing.assert_allclose(jacobian[row] @ velocity[row].numpy(), twist[row], atol=1e-9)
            # What the projector lets through moves nothing, and there is one free direction.
            np.testing.assert_allclose(jacobian[row] @ free[row].numpy(), np.zeros((6, 7)), atol=1e-9)
            assert np.trace(free[row].numpy()) == pytest.approx(1.0)


def test_damping_bounds_the_velocity_near_a_singularity():
    """Catches an undamped solution: at singular value s the gain is s / (s^2 + damping^2), at most 1 / (2 damping)."""
    jacobian = torch.eye(7, dtype=torch.float64)[None, :6].clone()
    jacobian[0, 5, 5] = 1e-6
    twist = torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    velocity, _ = damped_least_squares(jacobian, twist, 0.02)
    assert velocity[0, 5].item() == pytest.approx(1e-6 / (1e-12 + 0.0004))


def test_a_robots_kinematics_do_not_depend_on_the_batch():
    """Catches batched products that round differently by batch size: episodes would depend on their neighbours."""
    arm = ArmKinematics()
    joints = torch.rand(9, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    whole = arm.forward(joints)
    for row in (0, 4, 8):
        for part, alone in zip(whole, arm.forward(joints[row : row + 1]), strict=True):
            assert torch.equal(part[row], alone[0])


def test_the_compiled_kinematics_are_those_of_the_chain():
    """Catches offsets of other frames, a joint that turns the other way, and a Jacobian with swapped halves."""
    arm = ArmKinematics()
    joints = 6.0 * torch.rand(9, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 3.0
    position, rotation, jacobian = arm.forward(joints)
    expected, pose = arm._chain.jacobian(joints, ret_eef_pose=True)
    torch.testing.assert_close(jacobian, expected, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(rotation, pose[:, :3, :3], rtol=0.0, atol=1e-12)
    # The base frame is on the ground, the chain's root 0.026 m above it.
    pose[:, 2, 3] += 0.026
    torch.testing.assert_close(position, pose[:, :3, 3], rtol=0.0, atol=1e-12)


def test_the_compiled_links_are_those_of_the_chain():
    """Catches a frame before its joint has turned, or that of the link after it."""
    arm = ArmKinematics()
    joints = 6.0 * torch.rand(9, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 3.0
    poses = arm._chain.forward_kinematics(joints, end_only=False)
    expected = torch.stack([poses[f"panda_link{i}"].get_matrix()[:, :3] for i in range(1, 8)], dim=1)
    expected[..., 2, 3] += 0.026  # the base frame is on the ground, the chain's root 0.026 m above it
    torch.testing.assert_close(arm.links(joints), expected, rtol=0.0, atol=1e-12)
