"""Success, its latch, and the truth table of the endings."""

from __future__ import annotations

import math

import pytest
import torch

from cura_torchrl.envs.config import TaskConfig
from cura_torchrl.envs.mdp import terminations

TASK = TaskConfig()
LAST_STEP = 250  # 50 s at 5 Hz
PLAY_ON = 25  # 5 s at 5 Hz


@pytest.mark.parametrize(
    ("offset", "yaw_error", "flags"),
    [
        ((0.0, 0.0), 0.0, (True, True, True)),
        ((0.06, 0.079), 0.0, (True, True, True)),  # sqrt(0.0036 + 0.006241) = 0.0992 m
        ((0.0, 0.11), 0.0, (True, True, False)),
        ((0.0, 0.26), 0.0, (True, False, False)),
        ((0.3, 0.41), 0.0, (False, False, False)),  # sqrt(0.09 + 0.1681) = 0.508 m
        ((0.0, 0.0), math.radians(9.9), (True, True, True)),
        ((0.0, 0.0), math.radians(10.1), (True, True, False)),
        ((0.0, 0.0), math.radians(90 + 9.9), (True, True, True)),
        ((0.0, 0.0), math.radians(-180 - 9.9), (True, True, True)),
        ((0.0, 0.0), math.radians(45), (True, True, False)),
    ],
)
def test_success_flags_read_distance_and_yaw_modulo_a_quarter_turn(offset: tuple, yaw_error: float, flags: tuple):
    """Catches a yaw test on the wrong tolerance, or one that a quarter turn fails."""
    goal = torch.tensor([[12.0, 1.0, 2.5]], dtype=torch.float64)
    object_pose = goal + torch.tensor([[*offset, yaw_error]], dtype=torch.float64)
    assert terminations.success_flags(TASK, object_pose, goal).tolist() == [list(flags)]


@pytest.mark.parametrize(
    ("contact", "elapsed", "since", "terminated", "truncated"),
    [
        ((False, False, False), 1, -1, False, False),
        ((True, False, False), 1, -1, True, False),
        ((False, True, False), 1, -1, True, False),
        ((False, False, True), 1, -1, True, False),
        ((False, False, False), LAST_STEP - 1, -1, False, False),
        ((False, False, False), LAST_STEP, -1, False, True),
        ((True, False, False), LAST_STEP, -1, True, False),
        ((False, False, False), 100, 0, False, False),
        ((False, False, False), 100, PLAY_ON - 1, False, False),
        ((False, False, False), 100, PLAY_ON, False, True),
        ((False, True, False), 100, PLAY_ON, True, False),
        ((False, False, False), LAST_STEP, 3, False, True),
    ],
)
def test_endings_truth_table(contact: tuple, elapsed: int, since: int, terminated: bool, truncated: bool):
    """Catches success that terminates, a limit off by one step, and steps that both terminate and truncate."""
    ends = terminations.endings(
        TASK,
        contact=torch.tensor([contact]),
        elapsed_steps=torch.tensor([elapsed]),
        steps_since_success=torch.tensor([since]),
    )
    assert (ends[0].tolist(), ends[1].tolist()) == ([terminated], [truncated])


def test_success_time_zero_does_not_end_episodes_without_success():
    """Catches the -1 of 'no success yet' being read as a time."""
    ends = terminations.endings(
        TaskConfig(success_time=0.0),
        contact=torch.zeros(2, 3, dtype=torch.bool),
        elapsed_steps=torch.tensor([7, 7]),
        steps_since_success=torch.tensor([-1, 0]),
    )
    assert ends[1].tolist() == [False, True]


def test_success_is_latched_and_its_age_counts_from_zero():
    """Catches a success that is lost when the object leaves the goal, and an age that restarts."""
    success = torch.zeros(1, 3, dtype=torch.bool)
    steps = torch.tensor([-1])
    contact = torch.zeros(1, 3, dtype=torch.bool)
    # Not there; at the 0.5 m goal; out again; within 0.25 m.
    sequence = [(False, False, False), (True, False, False), (False, False, False), (True, True, False)]
    seen = []
    for flags in sequence:
        success, steps = terminations.latch_success(success, steps, flags=torch.tensor([flags]), contact=contact)
        seen.append((success[0].tolist(), steps.item()))
    assert seen == [
        ([False, False, False], -1),
        ([True, False, False], 0),
        ([True, False, False], 1),
        ([True, True, False], 2),
    ]


def test_success_in_the_step_of_a_collision_does_not_count():
    """Catches an episode that is both a success and a collision at the same instant."""
    success, steps = terminations.latch_success(
        torch.tensor([[False, False, False], [True, False, False]]),
        torch.tensor([-1, 4]),
        flags=torch.tensor([[True, True, False], [True, True, False]]),
        contact=torch.tensor([[False, False, True], [True, False, False]]),
    )
    # The earlier success of the second world stays.
    assert success.tolist() == [[False, False, False], [True, False, False]]
    assert steps.tolist() == [-1, 5]
