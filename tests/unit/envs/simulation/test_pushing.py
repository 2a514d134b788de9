"""Planar pushing against mechanics worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from cura_torchrl.envs.config import PhysicsConfig
from cura_torchrl.envs.simulation.contact import Rectangle
from cura_torchrl.envs.simulation.pushing import Cube, PushContact, Pushers

DT, GRAVITY = 0.005, PhysicsConfig().gravity
KINEMATIC = 1e-9
"""Mobility of a pusher that nothing slows down."""


def tensor(values: object) -> torch.Tensor:
    """Return a tensor of double precision."""
    return torch.as_tensor(values, dtype=torch.float64)


def make_cube(
    rows: int = 1, *, edge: float = 0.5, mass: float = 5.0, friction: float = 0.4, **overrides: object
) -> Cube:
    """Return cubes at the origin, at rest; ``pose``, ``twist`` and ``com_offset`` may be given."""
    values = {name: tensor(overrides.get(name, [[0.0] * 3])).expand(rows, 3).clone() for name in
              ("pose", "twist", "com_offset")}  # fmt: skip
    sizes = {name: tensor(value).expand(rows).clone() for name, value in
             (("edge", edge), ("mass", mass), ("friction", friction))}  # fmt: skip
    return Cube(**values, **sizes)


def make_contact(cube: Cube, creep: float = 0.0, sweeps: int = 4) -> PushContact:
    """Return the contact of one pusher a world."""
    rows = len(cube.mass)
    physics = PhysicsConfig(planar_period=DT, planar_sweeps=sweeps, planar_creep=creep)
    contact = PushContact(rows, 1, physics)
    contact.reset(torch.arange(rows), cube)
    return contact


def make_pusher(
    x: torch.Tensor, y: torch.Tensor, velocity: tuple[float, float], height: float = 0.2, mobility: float = KINEMATIC
) -> Pushers:
    """Return one hand a world, 0.12 m square, that looks along x."""
    x, y = tensor(x)[None], tensor(y)[None]
    one, half = torch.ones_like(x), torch.full_like(x, 0.06)
    twist = torch.stack([velocity[0] * one, velocity[1] * one, 0 * one, 0 * one])
    return Pushers(
        rectangle=Rectangle(x, y, one, 0 * one, half, half),
        height=height * one,
        anchor=(x, y),
        twist=twist,
        mobility=(mobility * torch.eye(4, dtype=torch.float64))[..., None, None].expand(4, 4, *x.shape),
    )


def slide(cube: Cube, seconds: float) -> None:
    """Let cubes slide with nothing near them."""
    contact, nobody = make_contact(cube), torch.full((len(cube.mass),), 99.0)
    for _ in range(round(seconds / DT)):
        contact.solve(cube, make_pusher(nobody, nobody, (0.0, 0.0)))
        cube.pose = cube.pose + DT * cube.twist


@pytest.mark.parametrize("direction", [0.0, 0.4, math.pi / 4, 2.0])
@pytest.mark.parametrize("edge", [0.5, 1.0])
def test_a_sliding_cube_stops_after_the_distance_of_coulomb(direction: float, edge: float):
    """Catches friction that depends on direction or size, a wrong weight, and a cube that creeps on."""
    cube = make_cube(edge=edge, twist=[[math.cos(direction), math.sin(direction), 0.0]])
    slide(cube, 1.0)
    distance = 1.0 / (2 * 0.4 * GRAVITY)  # v^2 / (2 mu g)
    assert cube.pose[0, :2].norm().item() == pytest.approx(distance, rel=0.03)
    assert math.atan2(cube.pose[0, 1], cube.pose[0, 0]) == pytest.approx(direction, abs=0.02)
    assert cube.pose[0, 2].abs() < 0.01
    assert cube.twist.abs().max() < 1e-3


def test_a_spinning_cube_stops_as_its_corners_rub():
    """Catches a wrong inertia, and a lever other than half a diagonal."""
    cube = make_cube(edge=0.5, twist=[[0.0, 0.0, 5.0]])
    slide(cube, 1.0)
    # mu m g e / sqrt 2 of torque on an inertia of m e^2 / 6.
    deceleration = 6 * 0.4 * GRAVITY / (math.sqrt(2) * 0.5)
    assert cube.pose[0, 2].item() == pytest.approx(5.0**2 / (2 * deceleration), rel=0.05)
    assert cube.twist.abs().max() < 1e-3


def push(
    cube: Cube, velocity: tuple[float, float], seconds: float, start: tuple[float, float], **options: float
) -> torch.Tensor:
    """Push with a hand of constant velocity; return where it ends, ``[N, 2]``."""
    contact = make_contact(cube, creep=options.pop("creep", 0.0))
    place = tensor(start).expand(len(cube.mass), 2).clone()
    for _ in range(round(seconds / DT)):
        contact.solve(cube, make_pusher(place[:, 0], place[:, 1], velocity, **options))
        place = place + DT * tensor(velocity)
        cube.pose = cube.pose + DT * cube.twist
    return place


def test_a_hand_at_full_speed_does_not_enter_the_cube():
    """Catches penetration at 0.8 m/s, and a cube that is shot away."""
    cube = make_cube()
    hand = push(cube, (0.8, 0.0), 1.0, (-0.35, 0.0))
    gap = (cube.pose[0, 0] - 0.25) - (hand[0, 0] + 0.06)
    assert abs(gap.item()) < 0.002
    assert cube.twist[0].tolist() == pytest.approx([0.8, 0.0, 0.0], abs=0.01)


@pytest.mark.parametrize(("lateral", "sign"), [(0.1, -1.0), (-0.1, 1.0)])
def test_a_push_off_the_middle_turns_the_cube(lateral: float, sign: float):
    """Catches a lever of the wrong sign."""
    cube = make_cube()
    push(cube, (0.5, 0.0), 0.6, (-0.33, lateral))
    assert sign * cube.pose[0, 2].item() > 0.05


def test_a_centre_of_mass_off_the_middle_turns_the_cube():
    """Catches loads and levers about the cube's centre in place of its centre of mass."""
    cube = make_cube(com_offset=[[0.0, 0.1, 0.0]], pose=[[0.0, 0.1, 0.0]])
    push(cube, (0.5, 0.0), 0.6, (-0.33, 0.0))
    assert cube.pose[0, 2].item() > 0.02  # the heavy side on the left lags behind; it lies beyond the hand


def test_pushing_high_loads_the_front():
    """Catches moments of the push and of friction that are left out or have the wrong sign."""
    cube = make_cube()
    contact = make_contact(cube)
    place = tensor([-0.31, 0.0])
    for _ in range(100):
        contact.solve(cube, make_pusher(place[:1], place[1:], (0.3, 0.0), height=0.3))
        place = place + DT * tensor([0.3, 0.0])
        cube.pose = cube.pose + DT * cube.twist
    weight = 5.0 * GRAVITY
    # Pushed steadily with mu m g at 0.3 m: the moment 0.3 mu m g moves mu 0.3 / 0.5 of the weight from back to front.
    front, back = contact._load[[0, 3], 0].sum().item(), contact._load[[1, 2], 0].sum().item()
    assert front + back == pytest.approx(weight, rel=1e-6)
    assert front - back == pytest.approx(2 * 0.4 * 0.3 / 0.5 * weight, rel=0.05)


def test_a_hand_that_sticks_carries_the_cube_sideways_and_creep_lets_it_slip():
    """Catches a hand without friction, one that never slips, and creep that does nothing."""
    for creep, least, most in ((0.0, 0.95, 1.05), (0.05, 0.2, 0.9)):
        cube = make_cube(friction=0.6)
        hand = push(cube, (0.4, 0.05), 0.8, (-0.311, 0.0), creep=creep)
        # Where the hand now is in the cube's frame, against where it started: the slip along the face.
        dx, dy = hand[0, 0] - cube.pose[0, 0], hand[0, 1] - cube.pose[0, 1]
        yaw = cube.pose[0, 2]
        slip = (-yaw.sin() * dx + yaw.cos() * dy).item()
        carried = 1.0 - slip / (0.05 * 0.8)
        assert least < carried < most, creep


def test_the_impulse_on_a_light_pusher_is_that_on_the_cube():
    """Catches a reaction of the wrong sign, point or size: momentum must be what friction leaves."""
    cube = make_cube(friction=1e-9)
    contact = make_contact(cube)
    pusher = make_pusher(tensor([-0.3095]), tensor([0.03]), (1.0, 0.0), mobility=1 / 3.0)
    impulse = contact.solve(cube, pusher)[:, 0, 0]
    assert impulse[0].item() < -0.1
    assert (5.0 * cube.twist[0, :2]).tolist() == pytest.approx((-impulse[:2]).tolist(), abs=1e-9)
    inertia = 5.0 * 0.25 / 6
    # About the cube's centre: its spin, and the reaction at the anchor with its lever.
    lever_x, lever_y = -0.3095, 0.03
    moment = impulse[3] + lever_x * impulse[1] - lever_y * impulse[0]
    assert (inertia * cube.twist[0, 2]).item() == pytest.approx(-moment.item(), abs=1e-9)


def test_a_light_pusher_and_the_cube_leave_with_one_velocity():
    """Catches a pusher that keeps its speed, or gains some, while it gives momentum away: the impact is inelastic."""
    cube = make_cube(friction=1e-9)
    pusher = make_pusher(tensor([-0.31]), tensor([0.0]), (1.0, 0.0), mobility=1 / 3.0)
    # Without a last tick to start from, the two points need many sweeps to share the push evenly.
    impulse = make_contact(cube, sweeps=60).solve(cube, pusher)[:, 0, 0]
    together = 3.0 * 1.0 / (3.0 + 5.0)  # of 3 kg at 1 m/s and 5 kg at rest
    assert cube.twist[0].tolist() == pytest.approx([together, 0.0, 0.0], abs=2e-3)
    assert 1.0 + impulse[0].item() / 3.0 == pytest.approx(together, abs=2e-3)
