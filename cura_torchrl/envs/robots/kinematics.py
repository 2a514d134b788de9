"""Forward kinematics, Jacobian and damped least squares of the arm, batched over worlds.

The chain is pytorch-kinematics'. Its tensor operations take longer to start than to do on the CPU: there the same is
compiled.
"""

from __future__ import annotations

import pytorch_kinematics as pk
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.robots.ik_kernel import place_hands, place_links
from cura_torchrl.envs.robots.ridgeback import BASE_LINK, BASE_LINK_HEIGHT
from cura_torchrl.envs.robots.ridgeback_franka import ARM_LINKS, TCP_LINK, URDF


class ArmKinematics:
    """Pose and Jacobian of the TCP in the base frame (on the ground below the base's centre).

    Args:
        device: Where the tensors live; the CPU when None.

    Attributes:
        offsets: Rotation and position [m] of each joint at zero in the frame of the one before it, of the first in the
            base frame, of the TCP in that of the last; on the CPU, shape ``[8, 3, 4]``. Joints turn about their z axis.

    Examples:
        >>> arm = ArmKinematics()
        >>> position, rotation, jacobian = arm.forward(torch.zeros(2, 7, dtype=torch.float64))
        >>> position.shape, rotation.shape, jacobian.shape
        (torch.Size([2, 3]), torch.Size([2, 3, 3]), torch.Size([2, 6, 7]))
    """

    def __init__(self, device: torch.device | None = None) -> None:
        chain = pk.build_serial_chain_from_urdf(URDF.read_bytes(), TCP_LINK, root_link_name=BASE_LINK)
        self._chain = chain.to(dtype=torch.float64, device=device)
        poses = self._chain.forward_kinematics(self._chain.axes.new_zeros(1, 7), end_only=False)
        frames = torch.cat([poses[link].get_matrix() for link in (*ARM_LINKS, TCP_LINK)]).cpu()
        frames[:, 2, 3] += BASE_LINK_HEIGHT
        self._links = self._chain.get_frame_indices(*ARM_LINKS).to(device)
        frames[1:] = torch.linalg.solve(frames[:-1], frames[1:])
        self.offsets = frames[:, :3].contiguous()

    def forward(self, joint_position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return where the TCP is and how it moves with the joints.

        Args:
            joint_position: Arm joints [rad], float64, shape ``[N, 7]``.

        Returns:
            TCP position [m], shape ``[N, 3]``; its rotation matrix, shape ``[N, 3, 3]``; the Jacobian of linear, then
            angular velocity [m/rad, 1], shape ``[N, 6, 7]``; all in the base frame.
        """
        if joint_position.device.type == "cpu":
            rows = len(joint_position)
            pose, jacobian = joint_position.new_empty(rows, 3, 4), joint_position.new_empty(rows, 6, 7)
            place_hands(joint_position.contiguous().numpy(), pose.numpy(), jacobian.numpy(), self.offsets.numpy())
            return pose[:, :, 3], pose[:, :, :3], jacobian
        jacobian, pose = self._chain.jacobian(joint_position, ret_eef_pose=True)
        position = pose[:, :3, 3].clone()
        position[:, 2] += BASE_LINK_HEIGHT
        return position, pose[:, :3, :3], jacobian

    def links(self, joint_position: torch.Tensor) -> torch.Tensor:
        """Return where the links are that the joints move.

        Args:
            joint_position: Arm joints [rad], float64, shape ``[N, 7]``.

        Returns:
            Rotations and positions [m] of the links' frames in the base frame, shape ``[N, 7, 3, 4]``.
        """
        if joint_position.device.type == "cpu":
            poses = joint_position.new_empty(len(joint_position), len(ARM_LINKS), 3, 4)
            place_links(joint_position.contiguous().numpy(), poses.numpy(), self.offsets.numpy())
            return poses
        poses = self._chain.forward_kinematics_tensor(joint_position)[self._links, :, :3].movedim(0, 1)
        poses[..., 2, 3] += BASE_LINK_HEIGHT
        return poses


def damped_least_squares(
    jacobian: torch.Tensor, twist: torch.Tensor, damping: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the joint velocity that follows a twist, and the projector onto what is left free.

    The solution is ``J^T (J J^T + damping^2 I)^-1 twist``.

    Args:
        jacobian: Jacobian of the task, shape ``[N, 6, 7]``.
        twist: Linear [m/s] and angular [rad/s] velocity, shape ``[N, 6]``.
        damping: Damping factor lambda.

    Returns:
        Joint velocity [rad/s], shape ``[N, 7]``; null-space projector ``I - J^+ J``, shape ``[N, 7, 7]``.

    Source:
        Paper, implementation details (DLS, lambda = 0.02).

    Examples:
        >>> jacobian = torch.eye(7, dtype=torch.float64)[None, :6]
        >>> velocity, free = damped_least_squares(jacobian, torch.ones(1, 6, dtype=torch.float64), 0.0)
        >>> velocity[0, :2].tolist(), free[0, 6, 6].item()
        ([1.0, 1.0], 1.0)
    """
    rows, joints = jacobian.shape[-2:]
    transposed = jacobian.mT
    gram = jacobian @ transposed + damping**2 * torch.eye(rows, dtype=jacobian.dtype, device=jacobian.device)
    # J^T (J J^T + lambda^2 I)^-1, the Gram matrix being symmetric; solve_ex waits for no answer of the device.
    inverse = torch.linalg.solve_ex(gram, jacobian).result.mT
    velocity = geometry.matvec(inverse, twist)
    return velocity, torch.eye(joints, dtype=jacobian.dtype, device=jacobian.device) - inverse @ jacobian
