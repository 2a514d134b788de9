"""Contact of rectangles against distances found in another way, and against cases known by hand."""

from __future__ import annotations

import math

import pytest
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.simulation.contact import Rectangle, overlap, rectangle_manifold


def rectangle(pose: torch.Tensor, half: torch.Tensor) -> Rectangle:
    """Return rectangles from poses ``[K, 3]`` and half extents ``[K, 2]``."""
    x, y, yaw = pose.double().unbind(-1)
    length, width = half.double().unbind(-1)
    return Rectangle(x, y, yaw.cos(), yaw.sin(), length, width)


def draw(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return random poses in a square of 3 m, and half extents of 0.1 to 0.6 m."""
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([3.0, 3.0, 2 * math.pi])
    return torch.rand(count, 3, generator=generator) * scale, 0.1 + 0.5 * torch.rand(count, 2, generator=generator)


def one(*values: float) -> torch.Tensor:
    """Return one row."""
    return torch.tensor([values], dtype=torch.float64)


def test_overlap_is_a_distance_of_zero():
    """Catches an axis that is left out, and half extents along the wrong one."""
    (pose_a, half_a), (pose_b, half_b) = draw(20_000, 0), draw(20_000, 1)
    distance = geometry.rectangle_distance(pose_a.double(), half_a.double(), pose_b.double(), half_b.double())
    overlaps = overlap(rectangle(pose_a, half_a), rectangle(pose_b, half_b))
    assert torch.equal(overlaps, distance == 0)
    assert 0.1 < overlaps.double().mean() < 0.9


def test_rectangles_touch_where_they_overlap():
    """Catches an incident face on the wrong side, and gaps without the other's half extent."""
    (pose_a, half_a), (pose_b, half_b) = draw(20_000, 2), draw(20_000, 3)
    a, b = rectangle(pose_a, half_a), rectangle(pose_b, half_b)
    contact = rectangle_manifold(a, b)
    assert torch.equal((contact.gap < 0).any(0), overlap(a, b))


def test_moving_apart_along_the_normal_opens_the_gap_by_as_much():
    """Catches a normal that points from B to A, or is not of length one."""
    (pose_a, half_a), (pose_b, half_b) = draw(20_000, 4), draw(20_000, 5)
    a, b = rectangle(pose_a, half_a), rectangle(pose_b, half_b)
    before = rectangle_manifold(a, b)
    touching = (before.gap < 0).any(0)
    b.x, b.y = b.x + 0.01 * before.normal_x, b.y + 0.01 * before.normal_y
    after = rectangle_manifold(a, b)
    same_face = (after.normal_x - before.normal_x).abs() + (after.normal_y - before.normal_y).abs() < 1e-9
    kept = touching & same_face & after.gap.isfinite().all(0)
    assert kept.sum() > 1000
    opened = (after.gap - before.gap)[:, kept].amin(0)
    torch.testing.assert_close(opened, torch.full_like(opened, 0.01))


def test_a_hand_flat_on_a_face_touches_with_both_fingers():
    """Catches points beside the face, and a face of the larger body that is not cut to the smaller one's width."""
    contact = rectangle_manifold(
        rectangle(one(0.0, 0.1, 0.0), one(0.06, 0.061)), rectangle(one(0.3, 0.0, math.pi / 2), one(0.25, 0.25))
    )
    assert [contact.normal_x.item(), contact.normal_y.item()] == pytest.approx([1.0, 0.0])
    assert contact.gap.flatten().tolist() == pytest.approx([-0.01, -0.01])
    assert sorted(contact.y.flatten().tolist()) == pytest.approx([0.039, 0.161])


def test_a_turned_hand_touches_with_one_corner():
    """Catches contact points that do not follow the hand's yaw."""
    # The front of a hand turned by 0.2: corners at x = 0.06 cos + 0.061 sin (right) and 0.06 cos - 0.061 sin (left).
    contact = rectangle_manifold(
        rectangle(one(0.0, 0.0, 0.2), one(0.06, 0.061)), rectangle(one(0.32, 0.0, 0.0), one(0.25, 0.25))
    )
    right, left = (0.06 * math.cos(0.2) + side * 0.061 * math.sin(0.2) for side in (1.0, -1.0))
    assert sorted(contact.gap.flatten().tolist()) == pytest.approx([0.07 - right, 0.07 - left])


def test_what_lies_beside_a_face_does_not_touch():
    """Catches contact with the line that a face lies on."""
    contact = rectangle_manifold(
        rectangle(one(0.0, 0.0, 0.0), one(0.5, 0.1)), rectangle(one(0.8, 0.4, 0.0), one(0.2, 0.2))
    )
    assert contact.gap.isinf().all()
