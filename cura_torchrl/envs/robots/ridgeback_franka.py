"""Ridgeback with a Franka arm: where its model lies, its joints, its limits and their sources."""

from __future__ import annotations

from pathlib import Path

from cura_torchrl.envs.robots.ridgeback import BASE_DOF, BASE_JOINTS, CHASSIS_HEIGHT, CHASSIS_SIZE
from cura_torchrl.envs.simulation.interface import ArmShape, RobotShape

URDF = Path(__file__).parent / "assets" / "ridgeback_franka.urdf"
"""The model. Both PyBullet and pytorch-kinematics read this file."""

ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
"""The arm's seven revolute joints."""

JOINTS = BASE_JOINTS + ARM_JOINTS
"""All joints, those of the base first."""

ARM_DOF = len(ARM_JOINTS)
DOF = BASE_DOF + ARM_DOF

ACTION_SIZE = 6
"""Numbers of an action: velocities of the base (x, y, yaw) and of the TCP (x, y, z), as shares of the limits."""

ARM_LINKS = tuple(name.replace("joint", "link") for name in ARM_JOINTS)
"""The links that they move."""

TCP_LINK = "panda_grasptarget"

JOINT_LOWER = (-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671)
JOINT_UPPER = (2.9671, 1.8326, 2.9671, 0.0, 2.9671, 3.8223, 2.9671)
"""Joint limits [rad]; pybullet_data's franka_panda/panda.urdf."""

TORQUE_LIMIT = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Joint torque limits [N m]; the same file."""

VELOCITY_LIMIT = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
"""Joint velocity limits [rad/s]; the same file."""

BASE_MASS = 153.16
"""Mass that the base's joints carry, arm included [kg]; sum over the model."""

BASE_YAW_INERTIA = 23.0
"""Inertia about the base's yaw axis at the home posture [kg m^2]."""

HOME = (0.0, 0.998, 0.0, -1.882, 0.0, 3.551, 0.785398)
"""Arm joints at the start [rad]: TCP 0.90 m ahead, 0.28 m above the ground, hand 0.9 rad below the horizontal.

Static pushing force within the torque limits there: 108 N (J^T), against at most 59 N of sliding friction.
"""

HOME_TCP = (0.9, 0.0, 0.28)
"""TCP at :data:`HOME`, base frame [m]."""

SHAPE = RobotShape(
    chassis_size=CHASSIS_SIZE,
    chassis_height=CHASSIS_HEIGHT,
    arm=ArmShape(
        hand_size=(0.12, 0.122),
        hand_front=(0.0074, 0.0105),
        half_width=0.1,
        joint_lower=JOINT_LOWER,
        joint_upper=JOINT_UPPER,
    ),
)
"""The robot seen from above. The hand is as wide as its two open fingers, whose tips are 21 mm thick and end 7.4 mm
beyond the TCP."""
