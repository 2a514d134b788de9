"""Where two rectangles touch: batched, without data-dependent shapes.

One tensor a component, all of one shape: on contiguous rows even small batches run at the speed of the arithmetic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

_FACE_BIAS = 1e-3
"""How much deeper a face of the first rectangle must lie to take the second one's place as the reference [m].

Without it the reference, and with it the contact points, would jump back and forth between two parallel faces.
"""


@dataclass
class Rectangle:
    """Oriented rectangles, each component of shape ``[*]``."""

    x: torch.Tensor
    """Centre, world x [m]."""
    y: torch.Tensor
    """Centre, world y [m]."""
    cos: torch.Tensor
    """Cosine of the yaw [1]."""
    sin: torch.Tensor
    """Sine of the yaw [1]."""
    half_length: torch.Tensor
    """Half extent along its x axis [m]."""
    half_width: torch.Tensor
    """Half extent along its y axis [m]."""

    def face_gaps(self, other: Rectangle) -> tuple[torch.Tensor, torch.Tensor]:
        """Return how far another rectangle lies beyond the faces on the x and the y axis [m], negative within."""
        dx, dy = other.x - self.x, other.y - self.y
        along, across = (dx * self.cos + dy * self.sin).abs(), (dy * self.cos - dx * self.sin).abs()
        cos = (self.cos * other.cos + self.sin * other.sin).abs()
        sin = (self.cos * other.sin - self.sin * other.cos).abs()
        length = cos * other.half_length + sin * other.half_width
        width = sin * other.half_length + cos * other.half_width
        return along - self.half_length - length, across - self.half_width - width


@dataclass
class Manifold:
    """Two points of contact between rectangles A and B, world frame."""

    normal_x: torch.Tensor
    """Unit vector from A to B [1], shape ``[*]``."""
    normal_y: torch.Tensor
    """Its y component."""
    x: torch.Tensor
    """Points of contact [m], shape ``[2, *]``."""
    y: torch.Tensor
    """Their y component."""
    gap: torch.Tensor
    """Distance between the surfaces at each point [m], negative where they overlap, shape ``[2, *]``."""


def rectangle_manifold(a: Rectangle, b: Rectangle) -> Manifold:
    """Return the contact of two oriented rectangles.

    The axis that separates them most, or else is least overlapped, belongs to a face of one of them; the other's face
    that looks against it is cut to that face's sides, and its two ends are the points of contact.

    Args:
        a: Rectangles of shape ``[*]``.
        b: Rectangles of shape ``[*]``.

    Returns:
        The contact; its gaps are infinite where no face of one lies before a face of the other.

    Source:
        Gottschalk et al. (1996), "OBBTree" (separating axes); Catto (2006), "Fast and Simple Physics using Sequential
        Impulses" (clipping of the incident face).

    Examples:
        >>> one, zero, half = torch.ones(1), torch.zeros(1), torch.full((1,), 0.5)
        >>> contact = rectangle_manifold(
        ...     Rectangle(zero, zero, one, zero, half, half), Rectangle(one + 0.2, zero, one, zero, half, half)
        ... )
        >>> contact.normal_x.item(), [round(gap, 4) for gap in contact.gap.flatten().tolist()]
        (1.0, [0.2, 0.2])
    """
    gap_a, gap_b = a.face_gaps(b), b.face_gaps(a)
    is_a = torch.maximum(*gap_a) - _FACE_BIAS > torch.maximum(*gap_b)
    is_side = torch.where(is_a, gap_a[1] > gap_a[0], gap_b[1] > gap_b[0])
    own = Rectangle(*(torch.where(is_a, *pair) for pair in _pairs(a, b)))
    other = Rectangle(*(torch.where(is_a, *pair) for pair in _pairs(b, a)))
    # The reference face: outward normal towards the other rectangle, and its half width.
    normal_x, normal_y = torch.where(is_side, -own.sin, own.cos), torch.where(is_side, own.cos, own.sin)
    depth = torch.where(is_side, own.half_width, own.half_length)
    width = torch.where(is_side, own.half_length, own.half_width)
    dx, dy = other.x - own.x, other.y - own.y
    distance = dx * normal_x + dy * normal_y
    sign = torch.where(distance < 0, -1.0, 1.0).to(distance.dtype)
    normal_x, normal_y, distance = sign * normal_x, sign * normal_y, sign * distance
    shift = dy * normal_x - dx * normal_y
    # The other's face that looks against it, in the frame of the reference face, tilted by at most an eighth of a turn.
    axis_x = other.cos * normal_x + other.sin * normal_y
    axis_y = other.sin * normal_x - other.cos * normal_y
    is_lengthwise = axis_x.abs() >= axis_y.abs()
    face_x, face_y = torch.where(is_lengthwise, axis_x, -axis_y), torch.where(is_lengthwise, axis_y, axis_x)
    cos, sin = face_x.abs(), torch.where(face_x < 0, -face_y, face_y)
    other_depth = torch.where(is_lengthwise, other.half_length, other.half_width)
    other_width = torch.where(is_lengthwise, other.half_width, other.half_length)
    middle, centre = distance - other_depth * cos, shift - other_depth * sin
    low, high = (-width - centre) / cos, (width - centre) / cos
    along = torch.stack([torch.maximum(low, -other_width), torch.minimum(high, other_width)])
    is_beside = (low > other_width) | (high < -other_width)
    ahead, left = middle - along * sin, centre + along * cos
    toward = torch.where(is_a, 1.0, -1.0).to(distance.dtype)
    return Manifold(
        normal_x=toward * normal_x,
        normal_y=toward * normal_y,
        x=own.x + ahead * normal_x - left * normal_y,
        y=own.y + ahead * normal_y + left * normal_x,
        gap=torch.where(is_beside, math.inf, ahead - depth),
    )


def _pairs(first: Rectangle, second: Rectangle) -> list[tuple[torch.Tensor, torch.Tensor]]:
    names = ("x", "y", "cos", "sin", "half_length", "half_width")
    return [(getattr(first, name), getattr(second, name)) for name in names]


def overlap(a: Rectangle, b: Rectangle) -> torch.Tensor:
    """Return whether two oriented rectangles overlap: whether no axis of either separates them, bool, shape ``[*]``."""
    gap_a, gap_b = a.face_gaps(b), b.face_gaps(a)
    return torch.maximum(torch.maximum(*gap_a), torch.maximum(*gap_b)) < 0
