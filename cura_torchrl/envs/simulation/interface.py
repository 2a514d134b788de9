"""What the task sees of a simulator: the batched state."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass
class WorldState:
    """State of N worlds, float64, world frame. Fresh tensors: nothing aliases the simulator."""

    base_pose: torch.Tensor
    """Base (x [m], y [m], yaw [rad]), shape ``[N, 3]``."""
    base_velocity: torch.Tensor
    """Base velocity (x [m/s], y [m/s], yaw [rad/s]), shape ``[N, 3]``."""
    joint_position: torch.Tensor
    """Arm joint positions [rad], shape ``[N, 7]``."""
    joint_velocity: torch.Tensor
    """Arm joint velocities [rad/s], shape ``[N, 7]``."""
    object_position: torch.Tensor
    """Centre of the object's cube [m], shape ``[N, 3]``."""
    object_quaternion: torch.Tensor
    """Object's orientation, xyzw, shape ``[N, 4]``."""
    object_velocity: torch.Tensor
    """Linear velocity of the cube's centre [m/s], shape ``[N, 3]``."""
    object_angular_velocity: torch.Tensor
    """Object's angular velocity [rad/s], shape ``[N, 3]``."""
    contact: torch.Tensor
    """Whether base, arm, object touched an obstacle during the last policy step, bool, shape ``[N, 3]``."""


@dataclass
class SceneState:
    """How B worlds start, world frame."""

    joint_position: torch.Tensor
    """Joints (base x [m], y [m], yaw [rad], arm [rad]), shape ``[B, J]``."""
    object_edge: torch.Tensor
    """Edge of the pushed cube [m], shape ``[B]``."""
    object_mass: torch.Tensor
    """Its mass [kg], shape ``[B]``."""
    floor_friction: torch.Tensor
    """Coulomb friction between it and the floor [1], shape ``[B]``."""
    com_offset: torch.Tensor
    """Its centre of mass from its centre, object frame [m], shape ``[B, 3]``."""
    object_pose: torch.Tensor
    """Its centre (x [m], y [m], yaw [rad]), shape ``[B, 3]``."""
    num_slots: int
    """Most obstacles that may appear."""
