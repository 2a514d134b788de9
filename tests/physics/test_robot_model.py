"""The robot's model against its source, pybullet_data's Panda, and pytorch-kinematics against PyBullet."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pybullet
import pybullet_data
import pytest
import torch

from cura_torchrl.envs.robots import ridgeback
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.dynamics import BaseDynamics, RobotDynamics
from cura_torchrl.envs.robots.kinematics import ArmKinematics
from tests.worlds import make_worlds

if TYPE_CHECKING:
    from collections.abc import Iterator

PANDA = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
OURS, THEIRS = ET.parse(model.URDF).getroot(), ET.parse(PANDA).getroot()
ARM_LINKS = [f"panda_link{i}" for i in range(9)] + ["panda_hand", "panda_leftfinger", "panda_rightfinger"]


def find(root: ET.Element, kind: str, name: str) -> ET.Element:
    """Return a joint or link by its name."""
    return next(element for element in root.iter(kind) if element.get("name") == name)


def numbers(element: ET.Element | None, attribute: str) -> list[float]:
    """Return the numbers of an attribute, zeros where it or its element is left out."""
    text = None if element is None else element.get(attribute)
    return [float(word) for word in (text or "0 0 0").split()]


@pytest.mark.parametrize("name", [*model.ARM_JOINTS, "panda_joint8", "panda_hand_joint", "panda_grasptarget_hand"])
def test_joint_frames_are_the_pandas(name: str):
    """Catches a copied frame with a wrong digit, which kinematics and physics would share and never tell."""
    ours, theirs = find(OURS, "joint", name), find(THEIRS, "joint", name)
    for attribute in ("xyz", "rpy"):
        assert numbers(ours.find("origin"), attribute) == numbers(theirs.find("origin"), attribute)
    if name in model.ARM_JOINTS:
        assert numbers(ours.find("axis"), "xyz") == numbers(theirs.find("axis"), "xyz")
    for end in ("parent", "child"):
        assert ours.find(end).get("link") == theirs.find(end).get("link")


def test_joint_limits_are_the_pandas():
    """Catches limits from another source: torque, velocity and position limits are kept by the controller alone."""
    limits = [find(THEIRS, "joint", name).find("limit") for name in model.ARM_JOINTS]
    for values, attribute in (
        (model.JOINT_LOWER, "lower"),
        (model.JOINT_UPPER, "upper"),
        (model.TORQUE_LIMIT, "effort"),
        (model.VELOCITY_LIMIT, "velocity"),
    ):
        assert list(values) == [float(limit.get(attribute)) for limit in limits], attribute
    for name, theirs in zip(model.ARM_JOINTS, limits, strict=True):
        ours = find(OURS, "joint", name).find("limit")
        assert [float(ours.get(a)) for a in ("effort", "velocity")] == [
            float(theirs.get(a)) for a in ("effort", "velocity")
        ]


@pytest.mark.parametrize("name", ARM_LINKS)
def test_masses_and_inertias_are_the_pandas(name: str):
    """Catches a link that is heavier, lighter or balanced otherwise than its source."""
    ours, theirs = (find(root, "link", name).find("inertial") for root in (OURS, THEIRS))
    mass = float(theirs.find("mass").get("value"))
    assert float(ours.find("mass").get("value")) == mass
    if mass:
        assert numbers(ours.find("origin"), "xyz") == numbers(theirs.find("origin"), "xyz")
        for axis in ("ixx", "iyy", "izz"):
            assert float(ours.find("inertia").get(axis)) == float(theirs.find("inertia").get(axis))


def test_the_gripper_is_open():
    """Catches fingers that are fixed elsewhere than at the end of the Panda's travel."""
    for name, side in (("panda_finger_joint1", 1.0), ("panda_finger_joint2", -1.0)):
        theirs = find(THEIRS, "joint", name)
        travel = float(theirs.find("limit").get("upper"))
        x, y, z = numbers(theirs.find("origin"), "xyz")
        assert numbers(find(OURS, "joint", name).find("origin"), "xyz") == [x, y + side * travel, z]


def test_the_base_has_the_ridgebacks_dimensions():
    """Catches a chassis, mount or scan plane that is not where the data sheet and the task put it."""
    box = find(OURS, "link", "base_link").find("collision").find("geometry").find("box")
    assert numbers(box, "size")[:2] == list(ridgeback.CHASSIS_SIZE) == [0.960, 0.793]
    assert numbers(find(OURS, "joint", "base_yaw").find("origin"), "xyz") == [0.0, 0.0, ridgeback.BASE_LINK_HEIGHT]
    assert numbers(find(OURS, "joint", "arm_mount").find("origin"), "xyz") == [0.21, 0.0, 0.28]
    lidar = numbers(find(OURS, "joint", "lidar_mount").find("origin"), "xyz")
    assert lidar == pytest.approx([0.0, 0.0, 0.26 - ridgeback.BASE_LINK_HEIGHT])


@pytest.fixture(scope="module")
def robot() -> Iterator[tuple[int, int, dict[str, int]]]:
    """The model in PyBullet with all its links: client, body, joint index by the name of the child link."""
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(str(model.URDF), useFixedBase=True, physicsClientId=client)
    infos = [pybullet.getJointInfo(body, i, client) for i in range(pybullet.getNumJoints(body, client))]
    yield client, body, {info[12].decode(): info[0] for info in infos} | {info[1].decode(): info[0] for info in infos}
    pybullet.disconnect(client)


def random_joints(count: int) -> np.ndarray:
    """Return joint positions within the limits, shape ``[B, 7]``."""
    share = np.random.default_rng(0).uniform(size=(count, 7))
    return np.array(model.JOINT_LOWER) + share * (np.array(model.JOINT_UPPER) - np.array(model.JOINT_LOWER))


def set_joints(robot: tuple[int, int, dict[str, int]], values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put the arm into a posture and return where PyBullet has the TCP [m] and its rotation matrix."""
    client, body, index = robot
    for name, value in zip(model.ARM_JOINTS, values, strict=True):
        pybullet.resetJointState(body, index[name], value, physicsClientId=client)
    state = pybullet.getLinkState(body, index[model.TCP_LINK], computeForwardKinematics=True, physicsClientId=client)
    return np.array(state[4]), np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)


def test_forward_kinematics_equal_pybullets(robot):
    """Catches another tool frame, base frame or joint order in pytorch-kinematics than in the simulator."""
    joints = random_joints(20)
    position, rotation, _ = ArmKinematics().forward(torch.from_numpy(joints))
    for row, values in enumerate(joints):
        expected, matrix = set_joints(robot, values)
        # pytorch-kinematics builds its chain in float32.
        np.testing.assert_allclose(position[row], expected, atol=1e-6)
        np.testing.assert_allclose(rotation[row], matrix, atol=1e-6)


def test_the_jacobian_is_the_derivative_of_pybullets_pose(robot):
    """Catches a Jacobian in the tool frame, or angular before linear rows."""
    joints = random_joints(4)
    jacobian = ArmKinematics().forward(torch.from_numpy(joints))[2].numpy()
    step = 3e-3  # PyBullet reports poses with about 1e-7 m
    for row, values in enumerate(joints):
        for joint in range(7):
            moved = [set_joints(robot, values + sign * step * np.eye(7)[joint]) for sign in (1, -1)]
            linear = (moved[0][0] - moved[1][0]) / (2 * step)
            spin = (moved[0][1] - moved[1][1]) / (2 * step) @ set_joints(robot, values)[1].T
            angular = [spin[2, 1], spin[0, 2], spin[1, 0]]
            np.testing.assert_allclose(jacobian[row, :3, joint], linear, atol=2e-4)
            np.testing.assert_allclose(jacobian[row, 3:, joint], angular, atol=2e-4)


def test_the_home_posture_is_what_it_says(robot):
    """Catches a home whose TCP, tilt or static pushing force is not the one in its docstring."""
    position, rotation = set_joints(robot, np.array(model.HOME))
    np.testing.assert_allclose(position, model.HOME_TCP, atol=1e-3)
    assert np.arcsin(-rotation[2, 2]) == pytest.approx(0.9, abs=2e-3)
    jacobian = ArmKinematics().forward(torch.tensor([model.HOME], dtype=torch.float64))[2][0].numpy()
    # tau = J^T F for a force along x: the first joint at its limit decides.
    force = (np.array(model.TORQUE_LIMIT) / np.abs(jacobian[0]).clip(min=1e-9)).min()
    assert force == pytest.approx(108.0, abs=1.0)


def test_the_simulator_reads_the_same_masses():
    """Catches a base servo with another mass than the model's, and inertias that are not taken from the file."""
    worlds = make_worlds(1)
    inertia = worlds.mass_matrix()[0]
    worlds.close()
    total = sum(float(mass.get("value")) for mass in OURS.iter("mass"))
    assert inertia[0, 0] == pytest.approx(total, rel=1e-6)
    assert total == pytest.approx(model.BASE_MASS, abs=0.01)
    assert inertia[2, 2] == pytest.approx(model.BASE_YAW_INERTIA, rel=0.05)
    np.testing.assert_allclose(inertia, inertia.T, atol=1e-9)


def test_the_inertia_is_that_of_pybullet():
    """Catches a body that is left out, a frame or an axis that is wrong, and base velocities in the base's frame."""
    client = pybullet.connect(pybullet.DIRECT)
    # Link by link: merging fixed links, as BulletWorlds does for speed, shifts the hand's centre of mass a little.
    robot = pybullet.loadURDF(
        str(model.URDF), useFixedBase=True, flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
    )
    generator = np.random.default_rng(0)
    position = generator.uniform(-1.0, 1.0, (5, 10))
    position[:, 3:] += model.HOME
    expected = [pybullet.calculateMassMatrix(robot, row.tolist(), physicsClientId=client) for row in position]
    pybullet.disconnect(client)
    matrix = RobotDynamics().mass_matrix(torch.from_numpy(position))
    np.testing.assert_allclose(matrix, expected, atol=1e-5)


def test_the_bare_base_is_the_one_that_carries_the_arm():
    """Catches a base of other dimensions, masses or joints, and a part of the arm that was left on it."""

    def parts(root: ET.Element) -> dict[tuple[str, str], str]:
        kinds = [element for element in root if element.tag in {"link", "joint"}]
        return {(part.tag, part.attrib["name"]): ET.canonicalize(ET.tostring(part), strip_text=True) for part in kinds}

    bare, carrying = parts(ET.parse(ridgeback.URDF).getroot()), parts(OURS)
    assert bare == {name: part for name, part in carrying.items() if name in bare}
    links = {"world", "base_slide_x", "base_slide_y", "base_link", "lidar"}
    assert {name for kind, name in bare if kind == "link"} == links
    assert {name for kind, name in bare if kind == "joint"} == {*ridgeback.BASE_JOINTS, "lidar_mount"}


def test_the_bare_base_has_the_inertia_of_pybullet():
    """Catches a servo with the arm's mass, and a mass matrix that turns with the base."""
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    robot = pybullet.loadURDF(str(ridgeback.URDF), useFixedBase=True, flags=flags, physicsClientId=client)
    position = np.array([[0.0, 0.0, 0.0], [1.0, -2.0, 0.7]])
    expected = [pybullet.calculateMassMatrix(robot, row.tolist(), physicsClientId=client) for row in position]
    pybullet.disconnect(client)
    matrix = BaseDynamics().mass_matrix(torch.from_numpy(position))
    np.testing.assert_allclose(matrix, expected, atol=1e-5)
    assert matrix[0, 0, 0].item() == pytest.approx(ridgeback.BASE_MASS, abs=0.01)
    assert matrix[0, 2, 2].item() == pytest.approx(ridgeback.BASE_YAW_INERTIA, abs=1e-3)
