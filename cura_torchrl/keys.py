"""Every TensorDict key, once.

Shapes are per environment; ``*`` stands for the batch dimensions. World quantities carry no suffix in their key: their
frame is stated here.
"""

from __future__ import annotations

ACTION = "action"
"""Policy action in [-1, 1], shape ``[*, A]``: base (vx, vy, wz), then end-effector (vx, vy, vz), base frame."""

OBSERVATION = "observation"
"""Robot, object and goal in the base frame, shape ``[*, D]``; see :mod:`cura_torchrl.envs.mdp.observations`."""

SCAN = "scan"
"""LiDAR ranges [m], shape ``[*, R]``; a miss is the maximum range.

Ray ``i`` points at ``-pi + i * 2 pi / R`` in the base frame.
"""

SENSOR_POSE = "sensor_pose"
"""LiDAR (x [m], y [m], yaw [rad]) in the world frame, shape ``[*, 3]``."""

OBJECT_POSE = "object_pose"
"""Pushed object's centre (x [m], y [m], yaw [rad]) in the world frame, shape ``[*, 3]``."""

OBJECT_SIZE = "object_size"
"""Pushed object's footprint (length, width) [m], shape ``[*, 2]``."""

CONFIDENCE_MAP = "confidence_map"
"""Robot-centred window of the map (confidence, occupancy) [1], shape ``[*, 2, H, W]``."""

LATENT = "latent"
"""Code z of the confidence map, shape ``[*, L]``."""

REWARD = "reward"
"""Weighted sum of the reward terms, shape ``[*, 1]``."""

REWARD_TERMS = "reward_terms"
"""Weighted reward terms in the order of :data:`cura_torchrl.envs.mdp.rewards.REWARD_TERM_NAMES`, shape ``[*, 6]``."""

COST = "cost"
"""Collision indicator c_t in {0, 1}, shape ``[*, 1]``."""

CONTACT = "contact"
"""What touches an obstacle: (base, arm, object), bool, shape ``[*, 3]``."""

SUCCESS = "success"
"""Goal reached before any collision, latched, for each of ``TaskConfig.tolerances``, bool, shape ``[*, 3]``."""

TIPPED = "tipped"
"""The object has tilted by more than the limit in this episode, bool, shape ``[*, 1]``."""

EPISODE = "episode"
"""Index of the scenario being played, int64, shape ``[*, 1]``."""

ELAPSED_STEPS = "elapsed_steps"
"""Policy steps since the start of the episode, int64, shape ``[*, 1]``."""

OBSTACLES = "obstacles"
"""True obstacles (x [m], y [m], yaw [rad], edge [m]), world frame, shape ``[*, 6, 4]``; edge 0 where none has appeared.

Privileged: emitted with ``TaskConfig.privileged`` only.
"""

STATE_VALUE = "state_value"
"""Critic's estimate of the return, shape ``[*, 1]``."""

COLLISION_ATOMS = "collision_atoms"
"""The DCE's N atoms of the collision possibility C, unsorted, shape ``[*, N]``."""

RISK = "risk"
"""Risk measure of the collision atoms, in the paper their mean, Eq. (5), shape ``[*, 1]``."""

UNCERTAINTY = "uncertainty"
"""Population variance of the collision atoms, paper Eq. (6), shape ``[*, 1]``.

With ``CURAConfig.uncertainty = "perceptual"`` that of the perceptual atoms.
"""

OBSTACLE_CODE = "obstacle_code"
"""True obstacles for an estimator that sees all of them, shape ``[*, 24]``.

See :class:`~cura_torchrl.envs.transforms.ObstacleCode`. Privileged: emitted while training with
``CURAConfig.uncertainty = "perceptual"`` only.
"""
PRIVILEGED_ATOMS = "privileged_atoms"
"""Atoms of the collision possibility C given the full state s, unsorted, shape ``[*, N]``."""
PRIVILEGED_RISK = "privileged_risk"
"""Expected collision possibility given the full state, m(s) = E[C | s], shape ``[*, 1]``."""
PRIVILEGED_TARGET = "privileged_target"
"""SR(lambda) target atoms of the estimator that sees the full state, shape ``[*, N]``."""
PERCEPTUAL_ATOMS = "perceptual_atoms"
"""Atoms of m(s) given the observation o, unsorted, shape ``[*, N]``; their variance is Var(E[C | s] | o)."""
PERCEPTUAL_TARGET = "perceptual_target"
"""The one target atom m(s) of the perceptual estimator, shape ``[*, 1]``."""
ADVANTAGE = "advantage"
"""Advantage that the policy maximises, shape ``[*, 1]``."""

VALUE_TARGET = "value_target"
"""Regression target of the critic, shape ``[*, 1]``."""

COLLISION_TARGET = "collision_target"
"""SR(lambda) target atoms of the DCE, shape ``[*, N]``."""
