"""What the task and a simulator know of each other: the batched state, the scene, the control law."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch

if TYPE_CHECKING:
    import numpy as np


class SimulationError(RuntimeError):
    """The simulator's state is not finite, or a ray would have lied."""


@dataclass
class WorldState:
    """State of N worlds, float64, world frame. Fresh tensors: nothing aliases the simulator."""

    base_pose: torch.Tensor
    """Base (x [m], y [m], yaw [rad]), shape ``[N, 3]``."""
    base_velocity: torch.Tensor
    """Base velocity (x [m/s], y [m/s], yaw [rad/s]), shape ``[N, 3]``."""
    joint_position: torch.Tensor
    """Arm joint positions [rad], shape ``[N, 7]``; ``[N, 0]`` without an arm."""
    joint_velocity: torch.Tensor
    """Arm joint velocities [rad/s], same shape."""
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
    """Joints (base x [m], y [m], yaw [rad], arm [rad]), shape ``[B, J]``; J is 10, or 3 without an arm."""
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


@dataclass(frozen=True)
class ArmShape:
    """An arm with a hand seen from above, as a planar simulator takes it."""

    hand_size: tuple[float, float]
    """Length and width of the hand, a rectangle whose front lies ahead of the TCP [m]."""
    hand_front: tuple[float, float]
    """How far the fingertips reach beyond the TCP, along the hand's axis and across it, in the vertical plane [m]."""
    half_width: float
    """Half the width of the arm between chassis and TCP [m]."""
    joint_lower: tuple[float, ...]
    """Lower stop of each joint of the arm [rad]."""
    joint_upper: tuple[float, ...]
    """Upper stops [rad]."""


@dataclass(frozen=True)
class RobotShape:
    """The robot seen from above, as a planar simulator takes it."""

    chassis_size: tuple[float, float]
    """Length and width of the chassis, a rectangle around the base's centre [m]."""
    chassis_height: float
    """Height above the ground at which the chassis pushes [m]."""
    arm: ArmShape | None = None
    """The arm, if the chassis carries one."""


@dataclass(frozen=True)
class HandLinearization:
    """The hand about a joint position, in the base frame (on the ground below the base's centre).

    For a robot without an arm the front face is the hand: it never moves, and there are no arm joints.
    """

    tcp: torch.Tensor
    """TCP's position [m], shape ``[N, 3]``."""
    rotation: torch.Tensor
    """Hand's rotation matrix, its axis in the third column, shape ``[N, 3, 3]``."""
    jacobian: torch.Tensor
    """Jacobian of the TCP's linear, then angular velocity [m/rad, 1], shape ``[N, 6, 7]``."""
    reference: torch.Tensor
    """Arm joints at which this holds [rad], shape ``[N, 7]``."""


class TorqueLaw(Protocol):
    """What computes joint torques; see :class:`cura_torchrl.envs.robots.base_controller.BaseController`."""

    ik_ticks: int
    hand: HandLinearization

    def state(self) -> tuple[torch.Tensor, ...]:
        """Return the tensors that a policy step changes; they keep their memory."""
        ...

    def solve_ik(self) -> None:
        """Plan the next ``ik_ticks`` ticks for all worlds."""
        ...

    def solve_ik_of(self, world: int) -> None:
        """Plan the next ``ik_ticks`` ticks for one world, on the CPU."""
        ...

    def torques(self, position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Return joint torques ``[N, J]`` of all worlds from joint positions and velocities of the same shape."""
        ...

    def torques_of(self, world: int, joints: np.ndarray) -> list[float]:
        """Return one world's joint torques from its joints' positions and velocities ``[2, J]``, on the CPU."""
        ...


class Worlds(Protocol):
    """N worlds that the task runs in."""

    def reset(self, rows: torch.Tensor, scene: SceneState) -> None:
        """Put the worlds ``rows`` at their start."""
        ...

    def place_obstacles(self, is_new: torch.Tensor, pose: torch.Tensor, edge: torch.Tensor) -> None:
        """Let static cubes appear: which ``[N, M]``, where ``[N, M, 3]``, their edges [m] ``[N, M]``."""
        ...

    def mass_matrix(self) -> torch.Tensor:
        """Return the joint-space inertia ``[N, J, J]``."""
        ...

    def advance(self, law: TorqueLaw, ticks: int) -> None:
        """Run control and physics for some ticks."""
        ...

    def state(self) -> WorldState:
        """Return the state, batch ``[N]``."""
        ...

    def cast(self, rows: torch.Tensor, origin: torch.Tensor, ends: torch.Tensor, *, see_object: bool) -> torch.Tensor:
        """Return the free share ``[B, R]`` of rays from ``[B, 3]`` to ``[B, R, 3]`` in the worlds ``rows``."""
        ...

    def close(self) -> None:
        """Release what the simulator holds; harmless when done twice."""
        ...
