"""Planar frames, rectangles and cubes against hand-computed numbers and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cura_torchrl.envs import geometry


def _f64(*values: object) -> torch.Tensor:
    return torch.tensor(values[0] if len(values) == 1 else values, dtype=torch.float64)


def test_to_frame_turns_world_points_into_the_frame():
    """Catches a rotation with the wrong sign or a shift in the wrong frame."""
    # A frame at (1, 2) that looks along world y: the point (1, 5) lies 3 ahead; (0, 2) lies 1 to its left.
    pose = _f64(1.0, 2.0, math.pi / 2)
    points = geometry.to_frame(pose, _f64([[1.0, 5.0], [0.0, 2.0]]))
    torch.testing.assert_close(points, _f64([[3.0, 0.0], [0.0, 1.0]]), atol=1e-15, rtol=0)


def test_from_frame_turns_frame_points_into_the_world():
    """Catches from_frame drifting away from to_frame's convention."""
    # The same frame: 3 ahead is (1, 5), 1 to the left is (0, 2).
    pose = _f64(1.0, 2.0, math.pi / 2)
    points = geometry.from_frame(pose, _f64([[3.0, 0.0], [0.0, 1.0]]))
    torch.testing.assert_close(points, _f64([[1.0, 5.0], [0.0, 2.0]]), atol=1e-15, rtol=0)


@pytest.mark.parametrize(
    ("vector", "angle"),
    [
        ((1.0, 0.0), 0.0),
        ((1.0, 1.0), math.pi / 4),
        ((0.0, 1.0), math.pi / 2),
        ((-1.0, 1.0), 3 * math.pi / 4),
        ((-1.0, 0.0), math.pi),
        ((-1.0, -1.0), -3 * math.pi / 4),
        ((0.0, -1.0), -math.pi / 2),
        ((2.0, -0.5), -math.atan(0.25)),
        ((0.5, -2.0), -math.atan(4.0)),
        ((-0.5, -2.0), math.atan(4.0) - math.pi),
        ((0.0, 0.0), 0.0),
    ],
)
def test_angle_of_is_right_in_every_octant(vector: tuple[float, float], angle: float):
    """Catches a wrong branch of the arctangent, and the constant pi in single precision."""
    assert geometry.angle_of(_f64(*vector)).item() == pytest.approx(angle, abs=1e-15)


def test_wrapped_angles_lie_in_the_half_open_interval():
    """Catches the upper end of the interval being returned, also for angles just below zero."""
    angles = _f64([math.pi, -math.pi, -1e-20, 0.0, 7.0, math.pi / 4, -math.pi / 4, 3 * math.pi / 4])
    # 7 - 2 pi = 0.716814..; and modulo pi/2: 7 - 4 pi / 2 = 0.716814.., 3 pi/4 - pi/2 = pi/4, which wraps to -pi/4.
    turn = [-math.pi, -math.pi, 0.0, 0.0, 7 - 2 * math.pi, math.pi / 4, -math.pi / 4, 3 * math.pi / 4]
    quarter = [0.0, 0.0, 0.0, 0.0, 7 - 2 * math.pi, -math.pi / 4, -math.pi / 4, -math.pi / 4]
    torch.testing.assert_close(geometry.wrap_angle(angles), _f64(turn), atol=1e-15, rtol=0)
    torch.testing.assert_close(geometry.quarter_turn(angles), _f64(quarter), atol=1e-15, rtol=0)


@pytest.mark.parametrize(
    ("pose", "half", "distance"),
    [
        # Unit square at the origin against ...
        ((2.0, 0.0, 0.0), (0.5, 0.5), 1.0),  # a unit square beside it: 2 - 0.5 - 0.5
        ((2.0, 3.0, 0.0), (0.5, 0.5), math.sqrt(5.0)),  # corner to corner: (1, 2)
        ((2.0, 0.0, math.pi / 4), (0.5, 0.5), 1.5 - math.sqrt(0.5)),  # a corner that points at its face
        ((0.0, 0.0, 0.0), (2.0, 0.1), 0.0),  # a cross: no vertex of either lies in the other
        ((0.1, 0.1, 0.3), (0.05, 0.05), 0.0),  # a rectangle inside
        ((3.0, 0.0, 0.0), (0.0, 0.0), 2.5),  # a point
        ((0.0, 1.5, 0.0), (4.0, 0.0), 1.0),  # a segment above, longer than the square
    ],
)
def test_rectangle_distance_of_simple_scenes(pose: tuple, half: tuple, distance: float):
    """Catches a missing direction of the vertex test and a missing separating axis, by hand-made scenes."""
    origin, unit_half = _f64(0.0, 0.0, 0.0), _f64(0.5, 0.5)
    forth = geometry.rectangle_distance(origin, unit_half, _f64(*pose), _f64(*half))
    back = geometry.rectangle_distance(_f64(*pose), _f64(*half), origin, unit_half)
    assert forth.item() == pytest.approx(distance, abs=1e-15)
    assert back.item() == pytest.approx(distance, abs=1e-15)


def _points(pose: np.ndarray, half: np.ndarray, local: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return (local * half) @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]


def _contains(pose: np.ndarray, half: np.ndarray, points: np.ndarray) -> bool:
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    local = (points - pose[:2]) @ np.array([[cosine, -sine], [sine, cosine]])
    return bool((np.abs(local) <= half).all(-1).any())


def _brute_force(pose_a: np.ndarray, half_a: np.ndarray, pose_b: np.ndarray, half_b: np.ndarray) -> float:
    step = np.linspace(-1, 1, 101)
    one = np.ones_like(step)
    boundary = np.concatenate([np.stack(p, -1) for p in ((step, one), (step, -one), (one, step), (-one, step))])
    a, b = _points(pose_a, half_a, boundary), _points(pose_b, half_b, boundary)
    if _contains(pose_a, half_a, b) or _contains(pose_b, half_b, a):
        return 0.0
    return float(np.linalg.norm(a[:, None] - b[None], axis=-1).min())


def test_rectangle_distance_agrees_with_dense_boundary_sampling():
    """Catches errors of the exact distance in general position, overlap included."""
    rng = np.random.default_rng(0)
    count = 120
    pose = rng.uniform([-2, -2, -4], [2, 2, 4], (2, count, 3))
    half = rng.uniform(0.05, 1.0, (2, count, 2))
    exact = geometry.rectangle_distance(*(_f64(x.tolist()) for x in (pose[0], half[0], pose[1], half[1]))).numpy()
    sampled = np.array([_brute_force(pose[0, i], half[0, i], pose[1, i], half[1, i]) for i in range(count)])
    # Boundary points lie at most 2 m / 100 apart, so a sampled distance exceeds the true one by at most 0.01 m a side;
    # a sliver of overlap thinner than the spacing may go unseen, which the same bound covers.
    assert (exact > 0).sum() > 40
    assert (exact == 0).sum() > 20
    np.testing.assert_allclose(exact, sampled, atol=0.02)


def test_cube_corners_start_in_the_first_quadrant_and_run_counter_clockwise():
    """Catches a change of the order on which the relabelling by quarter turns rests."""
    corners = geometry.cube_corners(_f64(1.0, 2.0, 0.5), _f64(0.0, 0.0, 0.0, 1.0), _f64(1.0))
    ring = [[1.5, 2.5], [0.5, 2.5], [0.5, 1.5], [1.5, 1.5]]
    expected = [[x, y, 0.0] for x, y in ring] + [[x, y, 1.0] for x, y in ring]
    torch.testing.assert_close(corners, _f64(expected))


def test_cube_corners_follow_a_roll():
    """Catches a transposed rotation matrix: yaw alone cannot tell it."""
    # A quarter turn about x takes (x, y, z) to (x, -z, y): the corner (0.5, 0.5, -0.5) goes to (0.5, 0.5, 0.5).
    half = math.sqrt(0.5)
    corners = geometry.cube_corners(_f64(0.0, 0.0, 0.0), _f64(half, 0.0, 0.0, half), _f64(1.0))
    torch.testing.assert_close(corners[0], _f64(0.5, 0.5, 0.5))
    # And (-0.5, 0.5, 0.5), corner 5, goes to (-0.5, -0.5, 0.5).
    torch.testing.assert_close(corners[5], _f64(-0.5, -0.5, 0.5))


def test_relabelled_corners_are_the_corners_of_the_turned_cube():
    """Catches a wrong permutation: each order must equal a cube that is really turned by a quarter turn."""
    position, edge = _f64(1.0, -2.0, 0.3), _f64(0.75)
    turned = [
        geometry.cube_corners(position, geometry.quaternion_from_yaw(_f64(0.4 + k * math.pi / 2)), edge)
        for k in range(4)
    ]
    relabelled = geometry.quarter_turn_corners(turned[0])
    torch.testing.assert_close(relabelled, torch.stack(turned), atol=1e-14, rtol=0)


@pytest.mark.parametrize("yaw", [-3.0, -1.6, 0.0, 0.7, 1.6, 3.1])
def test_yaw_survives_the_quaternion(yaw: float):
    """Catches wxyz read as xyzw, and half angles."""
    quaternion = geometry.quaternion_from_yaw(_f64(yaw))
    # q = (0, 0, sin(yaw / 2), cos(yaw / 2)) in xyzw.
    torch.testing.assert_close(quaternion, _f64(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)))
    assert geometry.yaw_from_quaternion(quaternion).item() == pytest.approx(yaw, abs=1e-14)


def test_tilt_is_the_angle_of_the_vertical_axis_alone():
    """Catches a tilt that depends on the yaw, or one that is inexact near zero as the arc cosine is."""
    # Yaw 1 followed by a rotation by t about the world's x axis: q = (sin(t/2), 0, 0, cos(t/2)) * (0, 0, s, c)
    # = (c sin(t/2), -s sin(t/2), s cos(t/2), c cos(t/2)) with s, c = sin 0.5, cos 0.5.
    sine, cosine = math.sin(0.5), math.cos(0.5)
    for tilt in (0.0, 1e-9, 0.3, 1.2, 2.0):
        half_sine, half_cosine = math.sin(tilt / 2), math.cos(tilt / 2)
        quaternion = _f64(cosine * half_sine, -sine * half_sine, sine * half_cosine, cosine * half_cosine)
        assert geometry.tilt_from_quaternion(quaternion).item() == pytest.approx(tilt, abs=1e-15)


def test_transform_point_moves_a_body_point_with_the_body():
    """Catches the surface point p_r left behind by a turned object."""
    # Yaw a quarter turn at (1, 1, 0.5): the body point (0.5, 0, 0.2) is at (1, 1.5, 0.7).
    quaternion = geometry.quaternion_from_yaw(_f64([math.pi / 2]))
    point = geometry.transform_point(_f64([[1.0, 1.0, 0.5]]), quaternion, _f64([[0.5, 0.0, 0.2]]))
    torch.testing.assert_close(point, _f64([[1.0, 1.5, 0.7]]))


def test_every_function_is_bitwise_independent_of_the_batch():
    """Catches kernels whose vectorised body and scalar tail differ, such as torch.atan2 and torch.hypot."""
    generator = torch.Generator().manual_seed(0)
    quaternion = torch.randn(37, 4, generator=generator, dtype=torch.float64)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    pose = 4 * torch.randn(37, 3, generator=generator, dtype=torch.float64)
    half = torch.rand(37, 2, generator=generator, dtype=torch.float64) + 0.1

    def everything(rows: slice) -> list[torch.Tensor]:
        return [
            geometry.rectangle_distance(pose[rows], half[rows], pose.flip(0)[rows], half.flip(0)[rows]),
            geometry.cube_corners(pose[rows], quaternion[rows], half[rows, 0]),
            geometry.yaw_from_quaternion(quaternion[rows]),
            geometry.tilt_from_quaternion(quaternion[rows]),
            geometry.norm(pose[rows]),
            geometry.wrap_angle(pose[rows, 2]),
        ]

    whole = everything(slice(None))
    for i in range(37):
        for one, batch in zip(everything(slice(i, i + 1)), whole, strict=True):
            assert torch.equal(one[0], batch[i])


def test_an_inverse_is_that_of_lapack_and_the_same_in_every_batch():
    """Catches a step of the elimination that reads what it has just written, and sums whose order is the batch's."""
    factor = torch.rand(33, 10, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrix = factor @ factor.mT + 0.1 * torch.eye(10, dtype=torch.float64)
    kept = matrix.clone()
    inverse = geometry.inverse(matrix)
    torch.testing.assert_close(inverse, torch.linalg.inv(matrix), rtol=1e-9, atol=1e-9)
    assert torch.equal(matrix, kept)
    for row in (0, 31):
        assert torch.equal(geometry.inverse(matrix[row : row + 1])[0], inverse[row])
    matrix[3] = 0.0
    assert geometry.inverse(matrix).isfinite().all(-1).all(-1).tolist() == [row != 3 for row in range(33)]
