"""Ridgeback without an arm: where its model lies, its front face, its limits and their sources."""

from __future__ import annotations

from pathlib import Path

from cura_torchrl.envs.mdp.scenarios import CHASSIS_HALF
from cura_torchrl.envs.simulation.interface import RobotShape

URDF = Path(__file__).parent / "assets" / "ridgeback.urdf"
"""The model. PyBullet reads this file, and the masses are taken from it."""

BASE_JOINTS = ("base_x", "base_y", "base_yaw")
"""Virtual joints of the planar base: x [m], y [m], yaw [rad]."""

BASE_DOF = len(BASE_JOINTS)

ACTION_SIZE = BASE_DOF
"""Numbers of an action: the base's velocity (x, y, yaw), as shares of the limits."""

BASE_LINK = "base_link"

CHASSIS_SIZE = (2.0 * CHASSIS_HALF[0], 2.0 * CHASSIS_HALF[1])
"""Length and width of the base [m]; Clearpath Ridgeback data sheet."""

CHASSIS_HEIGHT = 0.18
"""Height above the ground at which the chassis pushes [m]: its box in the URDF spans 0.056 to 0.306 m."""

BASE_LINK_HEIGHT = 0.026
"""Height of ``base_link`` above the ground [m]; ridgeback_description.

The base frame used throughout lies below it, on the ground.
"""

BASE_MASS = 135.2
"""Mass that the base's x joint carries [kg]; sum over the model."""

BASE_YAW_INERTIA = 17.443
"""Inertia about the base's yaw axis [kg m^2]; ridgeback_description."""

FACE = (CHASSIS_SIZE[0] / 2, 0.0, CHASSIS_HEIGHT)
"""Centre of the front face, base frame [m]: what pushes, and so what a hand's TCP is elsewhere."""

SHAPE = RobotShape(chassis_size=CHASSIS_SIZE, chassis_height=CHASSIS_HEIGHT)
"""The robot seen from above."""
