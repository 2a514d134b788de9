"""Velocity ramps, the reference's bounds and the impedance law, without a simulator."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cura_torchrl.envs.config import PhysicsConfig, RobotConfig
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.controller import ImpedanceController, hand_rotation

ROBOT, PHYSICS = RobotConfig(), PhysicsConfig()
TICKS = 40
AHEAD = torch.tensor([[5.0, 0.0]], dtype=torch.float64)
IDENTITY = torch.eye(10, dtype=torch.float64)[None]
HOME = torch.tensor([[0.0, 0.0, 0.0, *model.HOME]], dtype=torch.float64)
REST = torch.zeros(1, 10, dtype=torch.float64)


def make_controller(rows: int = 1, height_limit: float = 0.45) -> ImpedanceController:
    """Return a controller at home."""
    controller = ImpedanceController(rows, ROBOT, PHYSICS.control_period)
    controller.reset(torch.arange(rows), torch.full((rows,), height_limit, dtype=torch.float64))
    return controller


def run(controller: ImpedanceController, action: list[float], steps: int) -> torch.Tensor:
    """Play an action with joints that follow their reference at once; return the base's command of every tick."""
    rows = len(controller.reference)
    commands = []
    for _ in range(steps):
        controller.command(torch.tensor([action] * rows), AHEAD.expand(rows, 2), IDENTITY.expand(rows, 10, 10))
        for tick in range(TICKS):
            if tick % controller.ik_ticks == 0:
                controller.solve_ik()
            controller.torques(at_reference(controller), REST.expand(rows, 10))
            commands.append(controller.base_command[0].clone())
    return torch.stack(commands)


def at_reference(controller: ImpedanceController) -> torch.Tensor:
    """Return joints with the base at the origin and the arm at its reference."""
    return torch.cat([torch.zeros_like(controller.base_command), controller.reference], 1)


def test_the_base_command_ramps_to_its_target():
    """Catches a step in the command, a ramp per policy step in place of per second, and a wrong scale."""
    commands = run(make_controller(), [0.5, 0.0, -1.0, 0.0, 0.0, 0.0], steps=6)
    # 0.4 m/s at 2.5 m/s^2 takes 0.16 s, 32 ticks; 1 rad/s at 1 rad/s^2 takes 1 s, 200 ticks.
    time = 0.005 * np.arange(1, len(commands) + 1)
    np.testing.assert_allclose(commands[:, 0], np.minimum(2.5 * time, 0.4), atol=1e-12)
    np.testing.assert_allclose(commands[:, 2], -np.minimum(1.0 * time, 1.0), atol=1e-12)
    assert (commands[:, 1] == 0).all()


@pytest.mark.parametrize("angle", [0.3, 0.6, math.pi / 4, 1.2])
def test_the_speed_stays_within_its_disc_on_the_way(angle: float):
    """Catches axis-wise ramps that pass 0.8 m/s between two admissible velocities, and a cure that breaks the ramp."""
    controller = make_controller()
    targets = ([math.cos(angle), math.sin(angle)], [1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [-0.6, 0.7])
    commands = [run(controller, [*target, 0.0, 0.0, 0.0, 0.0], steps=4) for target in targets]
    planar = torch.cat(commands)[:, :2].numpy()
    assert np.linalg.norm(planar, axis=1).max() <= 0.8 * (1 + 1e-9)
    assert np.abs(np.diff(planar, axis=0)).max() <= 2.5 * 0.005 + 1e-12
    target = np.array([-0.6, 0.7]) / max(math.hypot(0.6, 0.7), 1.0) * 0.8
    np.testing.assert_allclose(planar[-1], target, atol=1e-12)


def test_the_torque_is_the_implicit_impedance_law():
    """Catches a sign, a missing damping term or an explicit law; solved here as one linear system."""
    generator = np.random.default_rng(0)
    factor = generator.normal(size=(10, 10))
    inertia = factor @ factor.T + 5 * np.eye(10)
    position = HOME.numpy() + 0.05 * generator.normal(size=(1, 10))
    velocity = 0.1 * generator.normal(size=(1, 10))
    controller = make_controller()
    controller.command(torch.zeros(1, 6), AHEAD, torch.from_numpy(inertia)[None])
    torque = controller.torques(torch.from_numpy(position), torch.from_numpy(velocity))[0]
    # Backward Euler: a = qdd solves (M + D dt + K dt^2) a = K (ref - q - dt qd) - D qd, and tau = M a. The base has
    # damping mass / 0.02 s and no stiffness; its command is zero.
    dt = 0.005
    stiffness = np.diag([0.0] * 3 + [600.0] * 4 + [250.0, 150.0, 50.0])
    damping = np.diag([153.16 / 0.02] * 2 + [23.0 / 0.02] + [50.0] * 4 + [30.0, 25.0, 15.0])
    reference = at_reference(controller)[0].numpy()
    force = stiffness @ (reference - position[0] - dt * velocity[0]) - damping @ velocity[0]
    expected = inertia @ np.linalg.solve(inertia + damping * dt + stiffness * dt**2, force)
    limit = np.array([np.inf] * 3 + list(model.TORQUE_LIMIT))
    np.testing.assert_allclose(torque, np.clip(expected, -limit, limit), rtol=1e-9)


def test_torques_stay_within_the_limits():
    """Catches a clamp that is left out or in the wrong order of joints."""
    controller = make_controller()
    controller.command(torch.zeros(1, 6), AHEAD, 1e3 * IDENTITY)
    torque = controller.torques(HOME, REST - 50.0)
    np.testing.assert_allclose(torque[0, 3:], model.TORQUE_LIMIT)


def test_the_reference_goes_no_further_than_the_torque_reaches():
    """Catches wind-up: against a blocked arm the reference would run away and snap back when it comes free."""
    controller = make_controller()
    for _ in range(20):
        controller.command(torch.tensor([[0.0, 0.0, 0.0, 1.0, 1.0, 1.0]]), AHEAD, IDENTITY)
        for tick in range(TICKS):
            if tick % controller.ik_ticks == 0:
                controller.solve_ik()
            controller.torques(HOME, REST)
    reach = np.array(model.TORQUE_LIMIT) / np.array(ROBOT.stiffness)  # 0.145 rad for joint 1
    assert (np.abs(controller.reference[0].numpy() - model.HOME) <= reach + 1e-12).all()
    tcp = controller.kinematics.forward(controller.reference)[0]
    assert (controller.tcp_reference - tcp).abs().max() <= ROBOT.tcp_leash + 1e-3


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_hand_stays_in_its_workspace(direction: float):
    """Catches a reference that leaves the workspace, and a tipping bound that is not kept."""
    controller = make_controller(height_limit=0.3)
    run(controller, [0.0, 0.0, 0.0, direction, direction, direction], steps=15)
    tcp = controller.kinematics.forward(controller.reference)[0][0].tolist()
    low, high = [0.76, -0.4, 0.2], [1.03, 0.4, 0.3]
    for value, least, most in zip(tcp, low, high, strict=True):
        assert least - 0.02 <= value <= most + 0.02
    np.testing.assert_allclose(controller.tcp_reference[0], high if direction > 0 else low, atol=0.03)


def test_the_hand_turns_to_the_object():
    """Catches a hand that keeps its orientation, turns away, or beyond its largest angle."""
    for object_xy, expected in (((3.0, 1.0), math.atan2(1.0, 2.1)), ((1.0, -3.0), -ROBOT.max_hand_yaw)):
        controller = make_controller()
        target = torch.tensor([object_xy], dtype=torch.float64)
        for _ in range(15):
            controller.command(torch.zeros(1, 6), target, IDENTITY)
            for tick in range(TICKS):
                if tick % controller.ik_ticks == 0:
                    controller.solve_ik()
                controller.torques(at_reference(controller), REST)
        axis = controller.kinematics.forward(controller.reference)[1][0, :, 2]
        assert math.atan2(axis[1], axis[0]) == pytest.approx(expected, abs=0.05)
        assert math.asin(-axis[2]) == pytest.approx(ROBOT.hand_tilt, abs=0.05)


def test_a_reset_puts_its_rows_alone_at_home():
    """Catches a partial reset that stops or moves other robots."""
    controller = make_controller(2)
    run(controller, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0], steps=2)
    moved = controller.reference.clone(), controller.base_command.clone(), controller.tcp_reference.clone()
    controller.reset(torch.tensor([1]), torch.tensor([0.3], dtype=torch.float64))
    for before, after, home in zip(
        moved,
        (controller.reference, controller.base_command, controller.tcp_reference),
        (model.HOME, (0.0, 0.0, 0.0), model.HOME_TCP),
        strict=True,
    ):
        np.testing.assert_array_equal(after[0], before[0])
        np.testing.assert_array_equal(after[1], home)


def test_torques_of_one_robot_move_its_state_alone():
    """Catches a world that advances the references of others."""
    controller = make_controller(3)
    controller.command(torch.ones(3, 6), AHEAD.expand(3, 2), IDENTITY.expand(3, 10, 10))
    controller.solve_ik_of(1)
    controller.torques_of(1, torch.cat([HOME, REST]).numpy())
    assert (controller.base_command[[0, 2]] == 0).all()
    assert (controller.base_command[1] > 0).all()
    assert (controller.reference[[0, 2]] == HOME[0, 3:]).all()
    assert (controller.reference[1] != HOME[0, 3:]).all()


def play_both_forms(seeds: list[int]) -> torch.Tensor:
    """Play what each row's seed says with tensors and one robot at a time; return torques and states ``[2, T, N, 23]``.

    Actions, inertias and boxes are drawn for each policy step, joints for each tick, some of them beyond their limits.
    """
    forms, draws = [make_controller(len(seeds)) for _ in range(2)], [torch.Generator().manual_seed(s) for s in seeds]
    kept: list[list[torch.Tensor]] = [[], []]

    def draw(*shape: int) -> torch.Tensor:
        return torch.stack([torch.randn(shape, generator=generator, dtype=torch.float64) for generator in draws])

    for _ in range(8):
        factor, action, box = draw(10, 10), 2.0 * draw(6).tanh(), torch.tensor([1.0, 0.0]) + draw(2)
        for controller in forms:
            controller.command(action, box, factor @ factor.mT + 5.0 * IDENTITY)
        for tick in range(TICKS):
            if tick % forms[0].ik_ticks == 0:
                forms[0].solve_ik()
                for row in range(len(seeds)):
                    forms[1].solve_ik_of(row)
            position, velocity = HOME + 2.0 * draw(10), draw(10)
            joints = torch.stack([position, velocity], 1).numpy()
            alone = [forms[1].torques_of(row, joints[row]) for row in range(len(seeds))]
            torques = forms[0].torques(position, velocity), torch.tensor(alone, dtype=torch.float64)
            for form, torque, rows in zip(forms, torques, kept, strict=True):
                rows.append(torch.cat([torque, form.base_command, form.reference, form.tcp_reference], 1))
    return torch.stack([torch.stack(rows) for rows in kept])


def test_one_robot_at_a_time_does_what_all_at_once_do():
    """Catches a clamp, ramp or gain that one form has and the other has not, also where limits are reached."""
    tensors, compiled = play_both_forms(list(range(9)))
    torch.testing.assert_close(compiled, tensors, rtol=1e-9, atol=1e-9)
    torque, base, reference = compiled[..., 3:10], compiled[..., 10:13], compiled[..., 13:20]
    at_limit = torque.abs() == torch.tensor(model.TORQUE_LIMIT, dtype=torch.float64)
    assert 0.01 < at_limit.double().mean() < 0.99
    for bound in (model.JOINT_LOWER, model.JOINT_UPPER):
        assert (reference == torch.tensor(bound, dtype=torch.float64)).any()
    assert (base[..., :2].norm(dim=-1) > 0.7999).any()


def test_a_robot_does_not_depend_on_the_batch():
    """Catches sums that round differently by the number of rows: episodes would depend on their neighbours."""
    together = play_both_forms(list(range(9)))
    for row in (0, 4, 8):
        assert torch.equal(play_both_forms([row])[:, :, 0], together[:, :, row])


@pytest.mark.parametrize(("yaw", "tilt"), [(0.0, 0.0), (0.5, 0.9), (-0.8, 0.3)])
def test_hand_rotations_are_rotations_with_the_axis_asked_for(yaw: float, tilt: float):
    """Catches a reflection, and fingers that are not level."""
    matrix = hand_rotation(torch.tensor([yaw], dtype=torch.float64), tilt)[0].numpy()
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    axis = [math.cos(tilt) * math.cos(yaw), math.cos(tilt) * math.sin(yaw), -math.sin(tilt)]
    np.testing.assert_allclose(matrix[:, 2], axis, atol=1e-12)
    assert matrix[2, 1] == pytest.approx(0.0, abs=1e-12)
