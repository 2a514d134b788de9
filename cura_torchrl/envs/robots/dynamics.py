"""Joint-space inertia of the robots, batched over worlds, from the masses in their URDFs."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import pytorch_kinematics as pk
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.robots.kinematics import ArmKinematics
from cura_torchrl.envs.robots.ridgeback import BASE_LINK, BASE_LINK_HEIGHT
from cura_torchrl.envs.robots.ridgeback import URDF as BASE_URDF
from cura_torchrl.envs.robots.ridgeback_franka import ARM_LINKS, URDF


@dataclass(frozen=True)
class _Inertia:
    """Inertia of bodies about the origin of their frame."""

    mass: torch.Tensor
    """Mass [kg], shape ``[*]``."""
    moment: torch.Tensor
    """First moment: mass times centre of mass [kg m], shape ``[*, 3]``."""
    tensor: torch.Tensor
    """Second moment [kg m^2], shape ``[*, 3, 3]``."""

    def moved(self, rotation: torch.Tensor, position: torch.Tensor) -> _Inertia:
        """Return the same bodies about the origin of another frame, in which theirs has this pose."""
        moment = (rotation @ self.moment[..., None])[..., 0]
        turned = rotation @ self.tensor @ rotation.mT
        # About p beyond: I + m (p.p 1 - p p^T) + 2 (p.h) 1 - p h^T - h p^T.
        eye = torch.eye(3, dtype=position.dtype, device=position.device)
        mass = self.mass[..., None]
        scalar = (position * (mass * position + 2.0 * moment)).sum(-1)[..., None, None] * eye
        outer = position[..., :, None] * (mass * position + moment)[..., None, :] + _outer(moment, position)
        return _Inertia(self.mass.expand(scalar.shape[:-2]), moment + mass * position, turned + scalar - outer)


def _outer(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    return first[..., :, None] * second[..., None, :]


class RobotDynamics:
    """Mass matrix of the robot's ten joints.

    Args:
        device: Where the tensors live; the CPU when None.

    Examples:
        >>> matrix = RobotDynamics().mass_matrix(torch.zeros(2, 10, dtype=torch.float64))
        >>> matrix.shape, round(matrix[0, 0, 0].item(), 2)  # all that the base's x joint moves [kg]
        (torch.Size([2, 10, 10]), 153.16)
    """

    def __init__(self, device: torch.device | None = None) -> None:
        self._kinematics = ArmKinematics(device)
        masses = _rigid_groups(ElementTree.fromstring(URDF.read_bytes()))
        # About the ground below the base's centre, as the arm's links.
        height = torch.tensor([0.0, 0.0, BASE_LINK_HEIGHT], dtype=torch.float64)
        masses[BASE_LINK] = masses[BASE_LINK].moved(torch.eye(3, dtype=torch.float64), height)

        def stack(links: tuple[str, ...]) -> _Inertia:
            parts = [masses[link] for link in links]
            columns = ([part.mass for part in parts], [part.moment for part in parts], [part.tensor for part in parts])
            return _Inertia(*(torch.stack(column).to(device) for column in columns))

        self._arm, self._base = stack(ARM_LINKS), stack((BASE_LINK,))
        self._slides = _slides(masses).to(device)
        # Twists (angular, linear at the base's origin) of the base's x, y and yaw, in the base frame.
        self._base_twists = torch.eye(6, dtype=torch.float64, device=device)[[3, 4, 2]]

    def mass_matrix(self, joint_position: torch.Tensor) -> torch.Tensor:
        """Return the joint-space inertia.

        Args:
            joint_position: Base (x [m], y [m], yaw [rad]) and arm joints [rad], float64, shape ``[N, 10]``.

        Returns:
            Inertia [kg, kg m, kg m^2], shape ``[N, 10, 10]``.

        Source:
            Featherstone (2008), "Rigid Body Dynamics Algorithms", section 6.2: the composite-rigid-body algorithm, all
            in one frame.
        """
        links = self._kinematics.links(joint_position[:, 3:])
        rotation, position = links[..., :3], links[..., 3]
        bodies = self._arm.moved(rotation, position)
        # What each joint carries: all links from its own to the hand; the base's joints carry those and the base.
        carried = [_from_the_tip(part) for part in (bodies.mass, bodies.moment, bodies.tensor)]
        whole = [part[:, :1] + own for part, own in zip(carried, _fields(self._base), strict=True)]
        mass, moment, tensor = (
            torch.cat([part.expand(-1, 3, *part.shape[2:]), arm], dim=1)
            for part, arm in zip(whole, carried, strict=True)
        )
        axis = rotation[..., 2]  # every arm joint turns about its frame's z axis
        arm_twists = torch.cat([axis, torch.cross(position, axis, dim=-1)], dim=-1)
        twists = torch.cat([self._base_twists.expand(len(axis), -1, -1), arm_twists], dim=1)
        angular, linear = twists[..., :3], twists[..., 3:]
        force = mass[..., None] * linear + torch.cross(angular, moment, dim=-1)
        torque = (tensor @ angular[..., None])[..., 0] + torch.cross(moment, linear, dim=-1)
        wrenches = torch.cat([torque, force], dim=-1)
        product = geometry.matvec(wrenches[:, None], twists)  # [i, j] of twist i and wrench j holds for i <= j
        matrix = product.triu() + product.triu(1).mT
        return self._in_world(matrix, joint_position[:, 2])

    def _in_world(self, matrix: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
        """Return the matrix for base velocities along the world's axes; it came for those along the base's."""
        cos, sin = yaw.cos(), yaw.sin()
        turn = torch.stack([torch.stack([cos, sin], -1), torch.stack([-sin, cos], -1)], -2)  # world to base
        matrix[:, :2] = turn.mT @ matrix[:, :2]
        matrix[:, :, :2] = matrix[:, :, :2] @ turn
        matrix.diagonal(dim1=1, dim2=2)[:, :2] += self._slides
        return matrix


class BaseDynamics:
    """Mass matrix of a base without an arm, whose centre of mass lies above the axis of its yaw.

    Args:
        device: Where the tensors live; the CPU when None.

    Examples:
        >>> matrix = BaseDynamics().mass_matrix(torch.zeros(2, 3, dtype=torch.float64))
        >>> [round(entry, 3) for entry in matrix[0].diagonal().tolist()]
        [135.2, 135.1, 17.443]
    """

    def __init__(self, device: torch.device | None = None) -> None:
        masses = _rigid_groups(ElementTree.fromstring(BASE_URDF.read_bytes()))
        base = masses[BASE_LINK]
        moved = torch.cat([base.mass + _slides(masses), base.tensor[2, 2, None]])
        self._matrix = torch.diag(moved).to(device)

    def mass_matrix(self, joint_position: torch.Tensor) -> torch.Tensor:
        """Return the joint-space inertia, the same for every pose.

        Args:
            joint_position: Base (x [m], y [m], yaw [rad]), float64, shape ``[N, 3]``.

        Returns:
            Inertia [kg, kg m^2], shape ``[N, 3, 3]``.
        """
        return self._matrix.expand(len(joint_position), 3, 3)


def _slides(masses: dict[str, _Inertia]) -> torch.Tensor:
    """Return what the base's x and y joints carry beside the base [kg], shape ``[2]``."""
    slides = [masses[name].mass.item() for name in ("base_slide_x", "base_slide_y")]
    return torch.tensor([sum(slides), slides[1]], dtype=torch.float64)


def _from_the_tip(values: torch.Tensor) -> torch.Tensor:
    return values.flip(1).cumsum(1).flip(1)


def _fields(inertia: _Inertia) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return inertia.mass, inertia.moment, inertia.tensor


def _rigid_groups(root: ElementTree.Element) -> dict[str, _Inertia]:
    """Return what each moving link weighs with all that is fixed to it, in its frame; float64."""
    own = {link.attrib["name"]: _own_inertia(link) for link in root.iter("link")}
    groups = dict(own)
    fixed = [joint for joint in root.iter("joint") if joint.attrib["type"] == "fixed"]
    # Children are listed after their parents: from the last to the first, each is whole before it is added.
    for joint in reversed(fixed):
        child, parent = (_find(joint, end).attrib["link"] for end in ("child", "parent"))
        moved = groups.pop(child).moved(*_origin(joint))
        total = [a + b for a, b in zip(_fields(groups[parent]), _fields(moved), strict=True)]
        groups[parent] = _Inertia(*total)
    return groups


def _own_inertia(link: ElementTree.Element) -> _Inertia:
    inertial = link.find("inertial")
    if inertial is None:
        zero = torch.zeros(3, 3, dtype=torch.float64)
        return _Inertia(zero[0, 0], zero[0], zero)
    mass = torch.tensor(float(_find(inertial, "mass").attrib["value"]), dtype=torch.float64)
    entry = {name: float(value) for name, value in _find(inertial, "inertia").attrib.items()}
    rows = [[entry["i" + "".join(sorted(row + column))] for column in "xyz"] for row in "xyz"]
    about_centre = _Inertia(mass, torch.zeros(3, dtype=torch.float64), torch.tensor(rows, dtype=torch.float64))
    return about_centre.moved(*_origin(inertial))


def _origin(element: ElementTree.Element) -> tuple[torch.Tensor, torch.Tensor]:
    """Return rotation and position of an element's ``origin``; roll, pitch and yaw about fixed axes."""
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    xyz, rpy = ([float(word) for word in attributes.get(name, "0 0 0").split()] for name in ("xyz", "rpy"))
    angles = torch.tensor(rpy[::-1], dtype=torch.float64)
    return pk.euler_angles_to_matrix(angles, "ZYX"), torch.tensor(xyz, dtype=torch.float64)


def _find(element: ElementTree.Element, path: str) -> ElementTree.Element:
    found = element.find(path)
    if found is None:
        msg = f"the robot's model has a {element.tag} {element.attrib.get('name')} without {path}"
        raise ValueError(msg)
    return found
