"""Ridgeback with a Franka arm: where its model lies, its joints, its limits and their sources."""

from __future__ import annotations

from pathlib import Path

from cura_torchrl.envs.simulation.interface import RobotShape

URDF = Path(__file__).parent / "assets" / "ridgeback_franka.urdf"
"""The model. Both PyBullet and pytorch-kinematics read this file."""

BASE_JOINTS = ("base_x", "base_y", "base_yaw")
"""Virtual joints of the planar base: x [m], y [m], yaw [rad]."""

ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
"""The arm's seven revolute joints."""

BASE_DOF, ARM_DOF = len(BASE_JOINTS), len(ARM_JOINTS)
DOF = BASE_DOF + ARM_DOF

ARM_LINKS = tuple(name.replace("joint", "link") for name in ARM_JOINTS)
"""The links that they move."""

BASE_LINK = "base_link"
TCP_LINK = "panda_grasptarget"

CHASSIS_SIZE = (0.960, 0.793)
"""Length and width of the base [m]; Clearpath Ridgeback data sheet."""

BASE_LINK_HEIGHT = 0.026
"""Height of ``base_link`` above the ground [m]; ridgeback_description.

The base frame used throughout lies below it, on the ground.
"""

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
    chassis_height=0.18,
    hand_size=(0.12, 0.122),
    hand_front=(0.0074, 0.0105),
    arm_half_width=0.1,
    joint_lower=JOINT_LOWER,
    joint_upper=JOINT_UPPER,
)
"""The robot seen from above. The chassis' box in the URDF spans 0.056 to 0.306 m above the ground; the hand is as wide
as its two open fingers, whose tips are 21 mm thick and end 7.4 mm beyond the TCP."""
