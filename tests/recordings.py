"""Recordings by hand: short straight drives whose numbers can be checked on paper."""

from __future__ import annotations

from typing import Any

import numpy as np

from cura_torchrl.envs.robots.ridgeback_franka import HOME
from cura_torchrl.trainers.evaluation.episodes import Episode
from cura_torchrl.trainers.pictures.recording import Recording, Scene

NUM_STATES = 7
"""States of a recording; frames are states 0, 3 and 6."""

TRACKS = (
    "base_pose", "tcp", "object_pose", "obstacles", "arm_joints", "object_position", "object_quaternion", "atoms",
    "risk", "uncertainty",
)  # fmt: skip
"""What a recording has of every state."""


def make_episode(*, index: int = 4, outcome: str = "success", steps: int = 6) -> Episode:
    """Return an episode; in a collision it is the object that is touched."""
    is_success, is_collision = outcome == "success", outcome == "collision"
    return Episode(
        index=index,
        success=(is_success, False, False),
        collision=is_collision,
        contact=(False, False, is_collision),
        tipped=False,
        steps=steps,
    )


def make_recording(*, outcome: str = "success", index: int = 4, adversarial: bool = True, **changes: Any) -> Recording:
    """Return a drive along the x axis with the object ahead; an obstacle appears at x = 8 m in state 2, after 0.4 s.

    The base goes from x = 0 in steps of 0.5 m, the TCP is 0.9 m ahead of it and the object's centre, edge 1 m, 1.5 m;
    the goal is at (12, 1). The LiDAR sees 5 m all around, atoms are half 0 and half 1; risk and uncertainty are their
    mean and variance.
    """
    along = 0.5 * np.arange(NUM_STATES)
    zero = np.zeros(NUM_STATES)
    obstacles = np.zeros((NUM_STATES, 6, 4))
    obstacles[2:, 1] = (8.0, 0.0, 0.0, 0.4)
    maps = np.zeros((3, 2, 100, 100), dtype=np.uint8)
    maps[:, 0, 50:] = 255  # all that is ahead has been seen
    values: dict[str, Any] = {
        "label": "First",
        "scene": Scene(index=index, adversarial=adversarial, object_edge=1.0, goal_pose=(12.0, 1.0, 0.0)),
        "episode": make_episode(index=index, outcome=outcome),
        "period": 0.2,
        "success_radius": 0.5,
        "resolution": 0.1,
        "base_pose": np.stack([along, zero, zero], -1),
        "tcp": np.stack([along + 0.9, zero], -1),
        "object_pose": np.stack([along + 1.5, zero, zero], -1),
        "obstacles": obstacles,
        "arm_joints": np.tile(HOME, (NUM_STATES, 1)),
        "object_position": np.stack([along + 1.5, zero, zero + 0.5], -1),
        "object_quaternion": np.tile([0.0, 0.0, 0.0, 1.0], (NUM_STATES, 1)),
        "atoms": np.tile([0.0, 1.0], (NUM_STATES, 25)),
        "scans": np.full((3, 360), 5.0),
    }
    atoms = changes.get("atoms", values["atoms"])
    values |= {"risk": atoms.mean(1), "uncertainty": atoms.var(1)}
    arrays = {name: value.astype(np.float32) for name, value in values.items() if isinstance(value, np.ndarray)}
    return Recording(**{**values, **arrays, "frame_steps": np.array([0, 3, 6]), "maps": maps, **changes})
