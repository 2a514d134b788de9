"""Planar rigid transforms, rectangles and cubes.

Everything here is elementwise over the leading dimensions, so a row's result does not depend, bit for bit, on the batch
that it is in. That rules out ``torch.atan2`` and ``torch.hypot`` on the CPU, whose vectorised body and scalar tail
differ in the last bit, and reductions, whose order of summation depends on shape and strides: hence :func:`angle_of`,
:func:`dot` and :func:`norm`.
"""

from __future__ import annotations

import math

import torch

_CORNER_SIGNS = (
    (1.0, 1.0, -1.0),
    (-1.0, 1.0, -1.0),
    (-1.0, -1.0, -1.0),
    (1.0, -1.0, -1.0),
    (1.0, 1.0, 1.0),
    (-1.0, 1.0, 1.0),
    (-1.0, -1.0, 1.0),
    (1.0, -1.0, 1.0),
)
"""Corners of a cube [half edges]: the bottom counter-clockwise seen from above, then the top in the same order."""

_QUARTER_TURNS = tuple(
    tuple(4 * layer + (corner + turn) % 4 for layer in (0, 1) for corner in range(4)) for turn in range(4)
)
"""Order of the corners of a cube after 0, 1, 2 and 3 quarter turns about its z axis."""


def dot(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return the scalar product over the last dimension, summed from left to right.

    Args:
        first: Vectors, shape ``[*, K]``.
        second: Vectors, shape ``[*, K]``.

    Returns:
        Scalar products in the product of the units, shape ``[*]``.
    """
    products = (first * second).unbind(-1)
    total = products[0]
    for product in products[1:]:
        total = total + product
    return total


def matvec(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Return the products of matrices and vectors, bitwise the same in every batch while R times C is below 400.

    Larger products PyTorch leaves to a BLAS, which rounds by the number of matrices and by the processor.

    Args:
        matrix: Matrices, shape ``[*, R, C]``.
        vector: Vectors, shape ``[*, C]``.

    Returns:
        Vectors in the product of the units, shape ``[*, R]``.

    Examples:
        >>> matvec(torch.tensor([[1.0, 2.0], [0.0, 3.0]]), torch.tensor([1.0, 1.0])).tolist()
        [3.0, 3.0]
    """
    return (matrix @ vector[..., None])[..., 0]


def inverse(matrix: torch.Tensor) -> torch.Tensor:
    """Return the inverses of symmetric positive definite matrices, bitwise the same in every batch.

    Args:
        matrix: Matrices, shape ``[*, D, D]``.

    Returns:
        Inverses, shape ``[*, D, D]``; not finite where a matrix has none.

    Source:
        Goodnight (1979), "A Tutorial on the SWEEP Operator"; it needs no pivoting here.

    Examples:
        >>> inverse(torch.tensor([[2.0, 1.0], [1.0, 1.0]])).tolist()
        [[1.0, -1.0], [-1.0, 2.0]]
    """
    result = matrix
    for k in range(matrix.shape[-1]):
        column, pivot = result[..., k], 1.0 / result[..., k, k, None]
        row = result[..., k, :] * pivot
        result = result - column[..., None] * row[..., None, :]
        result[..., k, :], result[..., k] = row, -column * pivot
        result[..., k, k] = pivot[..., 0]
    return result


def norm(vector: torch.Tensor) -> torch.Tensor:
    """Return the Euclidean length over the last dimension.

    Args:
        vector: Vectors, shape ``[*, K]``.

    Returns:
        Lengths in the vectors' unit, shape ``[*]``.

    Examples:
        >>> norm(torch.tensor([3.0, 4.0])).item()
        5.0
    """
    return dot(vector, vector).sqrt()


def angle_of(vector: torch.Tensor) -> torch.Tensor:
    """Return the angle from the x axis to a planar vector.

    Args:
        vector: Planar vectors, shape ``[*, 2]``.

    Returns:
        Angles in [-pi, pi] [rad], shape ``[*]``; zero for the zero vector.

    Examples:
        >>> angle_of(torch.tensor([0.0, 2.0], dtype=torch.float64)).item() == math.pi / 2
        True
    """
    x, y = vector.unbind(-1)
    is_steep = y.abs() > x.abs()
    denominator = torch.where(is_steep, y, x)
    slope = torch.where(is_steep, x, y) / torch.where(denominator == 0, torch.ones_like(x), denominator)
    base = torch.atan(slope)
    half_turn = torch.full_like(y, math.pi).copysign(y)
    flat = torch.where(x < 0, base + half_turn, base)
    return torch.where(is_steep, half_turn / 2 - base, flat)


def rotate(vector: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Rotate planar vectors counter-clockwise.

    Args:
        vector: Planar vectors, shape ``[*, 2]``.
        angle: Angles [rad], shape ``[*]``.

    Returns:
        Rotated vectors in the vectors' unit, shape ``[*, 2]``.
    """
    cosine, sine = angle.cos(), angle.sin()
    x, y = vector.unbind(-1)
    return torch.stack((cosine * x - sine * y, sine * x + cosine * y), -1)


def to_frame(pose: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """Express world points in a planar frame.

    Args:
        pose: The frame's (x [m], y [m], yaw [rad]) in the world, shape ``[*, 3]``.
        point: Points in the world [m], shape ``[*, 2]``.

    Returns:
        The points in the frame [m], shape ``[*, 2]``.

    Examples:
        >>> to_frame(torch.tensor([1.0, 2.0, 0.0]), torch.tensor([1.5, 2.0])).tolist()
        [0.5, 0.0]
    """
    return rotate(point - pose[..., :2], -pose[..., 2])


def from_frame(pose: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """Express points of a planar frame in the world: the inverse of :func:`to_frame`.

    Args:
        pose: The frame's (x [m], y [m], yaw [rad]) in the world, shape ``[*, 3]``.
        point: Points in the frame [m], shape ``[*, 2]``.

    Returns:
        The points in the world [m], shape ``[*, 2]``.
    """
    return pose[..., :2] + rotate(point, pose[..., 2])


def _wrap(angle: torch.Tensor, period: float) -> torch.Tensor:
    remainder = torch.remainder(angle, period)
    return torch.where(remainder >= period / 2, remainder - period, remainder)


def wrap_angle(angle: torch.Tensor) -> torch.Tensor:
    """Wrap angles to one turn.

    Args:
        angle: Angles [rad], shape ``[*]``.

    Returns:
        The same angles in [-pi, pi) [rad], shape ``[*]``.

    Examples:
        >>> wrap_angle(torch.tensor(math.pi, dtype=torch.float64)).item() == -math.pi
        True
    """
    return _wrap(angle, 2 * math.pi)


def quarter_turn(angle: torch.Tensor) -> torch.Tensor:
    """Wrap angles modulo a quarter turn, the symmetry of a cube about its vertical axis.

    Args:
        angle: Angles [rad], shape ``[*]``.

    Returns:
        Equivalent angles in [-pi/4, pi/4) [rad], shape ``[*]``.

    Examples:
        >>> round(quarter_turn(torch.tensor(1.5, dtype=torch.float64)).item(), 4)  # 1.5 - pi / 2
        -0.0708
    """
    return _wrap(angle, math.pi / 2)


def _vertices(pose: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    signs = half.new_tensor([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    return from_frame(pose.unsqueeze(-2), half.unsqueeze(-2) * signs)


def _gaps(pose: torch.Tensor, half: torch.Tensor, vertex: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the least distance of four vertices from a rectangle [m] and whether one of its axes separates them."""
    local = to_frame(pose.unsqueeze(-2), vertex)
    distance = norm((local.abs() - half.unsqueeze(-2)).clamp(min=0.0)).amin(-1)
    is_separated = (local.amin(-2) > half) | (local.amax(-2) < -half)
    return distance, is_separated.any(-1)


def rectangle_distance(
    pose_a: torch.Tensor, half_a: torch.Tensor, pose_b: torch.Tensor, half_b: torch.Tensor
) -> torch.Tensor:
    """Return the distance between two oriented rectangles.

    Two disjoint convex polygons are nearest at a vertex of one of them, so the distance is the least one from the
    vertices of each to the other; two rectangles overlap unless one of their four axes separates them.

    Args:
        pose_a: Centre (x [m], y [m]) and yaw [rad] of the first rectangle, shape ``[*, 3]``.
        half_a: Its half extents along its own axes [m], shape ``[*, 2]``; zero makes a segment or a point.
        pose_b: Centre and yaw of the second rectangle, shape ``[*, 3]``.
        half_b: Its half extents [m], shape ``[*, 2]``.

    Returns:
        Distances [m], zero where the rectangles overlap, shape ``[*]``.

    Examples:
        >>> half = torch.tensor([0.5, 0.5])
        >>> rectangle_distance(torch.zeros(3), half, torch.tensor([3.0, 0.0, 0.0]), half).item()
        2.0
    """
    distance_a, is_separated_a = _gaps(pose_a, half_a, _vertices(pose_b, half_b))
    distance_b, is_separated_b = _gaps(pose_b, half_b, _vertices(pose_a, half_a))
    distance = torch.minimum(distance_a, distance_b)
    return torch.where(is_separated_a | is_separated_b, distance, torch.zeros_like(distance))


def quaternion_from_yaw(yaw: torch.Tensor) -> torch.Tensor:
    """Return the quaternion of a rotation about the world's z axis.

    Args:
        yaw: Angles [rad], shape ``[*]``.

    Returns:
        Unit quaternions, xyzw [1], shape ``[*, 4]``.
    """
    zero = torch.zeros_like(yaw)
    return torch.stack((zero, zero, (yaw / 2).sin(), (yaw / 2).cos()), -1)


def rotation_matrix(quaternion: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrix of a quaternion.

    Args:
        quaternion: Unit quaternions, xyzw [1], shape ``[*, 4]``.

    Returns:
        Matrices that take body vectors to the world [1], shape ``[*, 3, 3]``.
    """
    x, y, z, w = quaternion.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def yaw_from_quaternion(quaternion: torch.Tensor) -> torch.Tensor:
    """Return the direction of the body's x axis seen from above.

    Args:
        quaternion: Unit quaternions, xyzw [1], shape ``[*, 4]``.

    Returns:
        Angles in [-pi, pi] [rad], shape ``[*]``; meaningless where the body's x axis is vertical.

    Examples:
        >>> round(yaw_from_quaternion(quaternion_from_yaw(torch.tensor(0.3, dtype=torch.float64))).item(), 12)
        0.3
    """
    return angle_of(rotation_matrix(quaternion)[..., :2, 0])


def tilt_from_quaternion(quaternion: torch.Tensor) -> torch.Tensor:
    """Return the angle between the body's and the world's z axis.

    Args:
        quaternion: Unit quaternions, xyzw [1], shape ``[*, 4]``.

    Returns:
        Angles in [0, pi] [rad], shape ``[*]``.
    """
    z_axis = rotation_matrix(quaternion)[..., :, 2]
    return angle_of(torch.stack((z_axis[..., 2], norm(z_axis[..., :2])), -1))


def transform_point(position: torch.Tensor, quaternion: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """Express points of a body frame in the world.

    Args:
        position: The body's origin in the world [m], shape ``[*, 3]``.
        quaternion: The body's orientation, xyzw [1], shape ``[*, 4]``.
        point: Points in the body frame [m], shape ``[*, 3]``.

    Returns:
        The points in the world [m], shape ``[*, 3]``.
    """
    matrix = rotation_matrix(quaternion)
    x, y, z = (point[..., axis].unsqueeze(-1) for axis in range(3))
    return position + (matrix[..., 0] * x + matrix[..., 1] * y + matrix[..., 2] * z)


def cube_corners(position: torch.Tensor, quaternion: torch.Tensor, edge: torch.Tensor) -> torch.Tensor:
    """Return the eight corners of cubes, the paper's keypoint vector G.

    The bottom comes first, counter-clockwise seen from above from the body's first quadrant on; then the top likewise.

    Args:
        position: Centres in the world [m], shape ``[*, 3]``.
        quaternion: Orientations, xyzw [1], shape ``[*, 4]``.
        edge: Edge lengths [m], shape ``[*]``.

    Returns:
        Corners in the world [m], shape ``[*, 8, 3]``.

    Examples:
        >>> position, upright = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 0.0, 1.0])
        >>> cube_corners(position, upright, torch.tensor(2.0))[0].tolist()
        [1.0, 1.0, 0.0]
    """
    local = edge.new_tensor(_CORNER_SIGNS) * (edge / 2)[..., None, None]
    return transform_point(position.unsqueeze(-2), quaternion.unsqueeze(-2), local)


def quarter_turn_corners(corners: torch.Tensor) -> torch.Tensor:
    """Return a cube's corners in the orders they have after 0, 1, 2 and 3 quarter turns about its z axis.

    Args:
        corners: Corners in the order of :func:`cube_corners` [m], shape ``[*, 8, 3]``.

    Returns:
        The same corners in four orders [m], shape ``[*, 4, 8, 3]``.
    """
    order = torch.tensor(_QUARTER_TURNS, device=corners.device)
    return corners[..., order, :]
