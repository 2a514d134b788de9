"""The box on the floor, as BulletWorlds configures it: Coulomb friction, weight, rest."""

from __future__ import annotations

import math

import numpy as np
import pybullet
import pytest
import torch

from tests.worlds import AWAY, NoTorque, make_worlds

GRAVITY = 9.81


@pytest.mark.parametrize(("friction", "speed", "mass"), [(0.25, 1.0, 3.0), (0.6, 1.5, 10.0)])
def test_a_sliding_box_stops_where_coulomb_says(friction: float, speed: float, mass: float):
    """Catches a friction pyramid (12 to 34 % short, up to 13 degrees aside), a wrong pair friction, a lost weight."""
    count = 12
    angle = torch.arange(count) * 2 * math.pi / count + 0.1
    yaw = torch.tensor([0.0, 0.3, 0.6, math.pi / 4] * 3)
    pose = torch.stack([torch.zeros(count), torch.zeros(count), yaw], -1)
    worlds = make_worlds(count, object=pose, base=AWAY, edge=0.75, friction=friction, mass=mass)
    for row, (client, body) in enumerate(zip(worlds._clients, worlds._object, strict=True)):
        velocity = [speed * math.cos(angle[row]), speed * math.sin(angle[row]), 0.0]
        pybullet.resetBaseVelocity(body, velocity, [0.0, 0.0, 0.0], physicsClientId=client)
    worlds.advance(NoTorque(), 200)  # 1 s; it stops after v / (mu g) = 0.41 s or 0.25 s
    state = worlds.state()
    worlds.close()
    assert state.object_velocity.abs().max() < 1e-3
    path = state.object_position[:, :2].numpy()
    # Stopping distance v^2 / (2 mu g): 0.2039 m and 0.1911 m.
    expected = speed**2 / (2 * friction * GRAVITY)
    np.testing.assert_allclose(np.linalg.norm(path, axis=1), expected, rtol=0.1)
    turned = np.arctan2(path[:, 1], path[:, 0]) - angle.numpy()
    aside = np.abs(np.degrees(np.arctan2(np.sin(turned), np.cos(turned))))
    # 32 directions, 3 masses, 2 frictions, 2 speeds, 2 edges: mean 0.7 to 1.0 degrees, nine in ten below 2.1, most 4.5.
    assert aside.mean() < 2.0
    assert aside.max() < 5.0


def test_a_box_at_rest_stays_where_it_is():
    """Catches a weight that acts beside the centre of mass or in the box's frame: the box would creep or tip."""
    com = [[0.05, 0.05, 0.05], [0.1, -0.1, 0.1], [-0.075, 0.0, -0.075]]
    worlds = make_worlds(
        3, base=AWAY, object=(0.0, 0.0, 0.3), edge=[0.5, 1.0, 0.75], mass=[10.0, 3.0, 5.0], com=com, friction=0.25
    )
    before = worlds.state()
    worlds.advance(NoTorque(), 2000)  # 10 s
    after = worlds.state()
    worlds.close()
    assert (after.object_position - before.object_position).abs().max() < 1e-3
    assert (after.object_quaternion - before.object_quaternion).abs().max() < 1e-3
    torch.testing.assert_close(before.object_position[:, 2], torch.tensor([0.25, 0.5, 0.375]).double())


def test_the_floor_carries_the_weight():
    """Catches a weight that does not depend on mass, or gravity that is counted twice."""
    masses = [3.0, 10.0]
    worlds = make_worlds(2, base=AWAY, object=(0.0, 0.0, 0.0), mass=masses, com=(0.02, 0.0, -0.03))
    worlds.advance(NoTorque(), 200)
    for client, body, mass in zip(worlds._clients, worlds._object, masses, strict=True):
        points = pybullet.getContactPoints(bodyA=body, physicsClientId=client)
        assert sum(point[9] for point in points) == pytest.approx(mass * GRAVITY, rel=0.01)
        assert pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[2] == pytest.approx([mass * 0.25 / 6] * 3)
    worlds.close()


def test_the_state_is_that_of_the_cubes_centre():
    """Catches a pose or velocity of the centre of mass in place of the cube's centre."""
    worlds = make_worlds(1, base=AWAY, object=(1.0, 2.0, math.pi / 2), com=(0.04, 0.02, -0.03))
    position = worlds.state().object_position
    torch.testing.assert_close(position, torch.tensor([[1.0, 2.0, 0.25]], dtype=torch.float64))
    client, body = worlds._clients[0], worlds._object[0]
    pybullet.resetBaseVelocity(body, [0.3, 0.0, 0.0], [0.0, 0.0, 2.0], physicsClientId=client)
    # The centre of mass moves with (0.3, 0, 0). Turned by 90 degrees the centre lies (0.02, -0.04) from it, and
    # omega x r = 2 * (0.04, 0.02): the centre moves with (0.38, 0.04, 0).
    velocity = worlds.state().object_velocity
    expected = torch.tensor([[0.38, 0.04, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(velocity, expected, atol=1e-9, rtol=0)
    worlds.close()
