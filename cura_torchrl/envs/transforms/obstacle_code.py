"""The true obstacles in place of the map's code: what a policy could do if it saw everything, for diagnosis only."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from cura_torchrl import keys
from cura_torchrl.envs.geometry import to_frame
from cura_torchrl.envs.mdp.scenarios import OBSTACLE_SLOTS
from cura_torchrl.validation import require

if TYPE_CHECKING:
    from tensordict import NestedKey, TensorDictBase

_FAR = 10.0
"""Scale of an obstacle's position [m]."""


CODE_SIZE = 4 * OBSTACLE_SLOTS
"""Length of the code of all obstacles [1]."""


class ObstacleCode(Transform):
    """Write the obstacles, or nothing at all, where the policy expects the code of the map.

    The code has the length of the map's, so that networks fit either.

    ============== ======= ===================================================================== =============
    Key            Access  Content                                                               Shape
    ============== ======= ===================================================================== =============
    ``obstacles``  read    True obstacles; left alone if ``is_blind``                            ``[*, 6, 4]``
    ``sensor_pose`` read   Base (x [m], y [m], yaw [rad]), world frame                           ``[*, 3]``
    ``latent``     write   Per obstacle: x and y in the base frame over 10 m, edge [m], presence ``[*, size]``
    ============== ======= ===================================================================== =============

    Args:
        size: Length of the code, at least 24 unless ``is_blind`` [1].
        is_blind: Whether the code is zero.
        out_key: Key of the code.

    Raises:
        ValueError: If ``size`` is too small for the obstacles.
    """

    def __init__(self, size: int, *, is_blind: bool, out_key: NestedKey = keys.LATENT) -> None:
        require(is_blind or size >= CODE_SIZE, "size", size, f"{CODE_SIZE} or more")
        in_keys = [keys.SENSOR_POSE] if is_blind else [keys.SENSOR_POSE, keys.OBSTACLES]
        super().__init__(in_keys=in_keys, out_keys=[out_key])
        self.size = size
        self.is_blind = is_blind

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        pose = next_tensordict[keys.SENSOR_POSE]
        code = pose.new_zeros(*pose.shape[:-1], self.size)
        if not self.is_blind:
            seen = self._encode(pose, next_tensordict[keys.OBSTACLES])
            code[..., : seen.shape[-1]] = seen
        return next_tensordict.set(self.out_keys[0], code)

    forward = _call

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._call(tensordict_reset)

    def _encode(self, pose: torch.Tensor, obstacles: torch.Tensor) -> torch.Tensor:
        position = to_frame(pose.unsqueeze(-2), obstacles[..., :2]) / _FAR
        edge = obstacles[..., 3:]
        is_there = (edge > 0).to(edge.dtype)
        return torch.cat([position * is_there, edge, is_there], -1).flatten(-2)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the code's spec.

        Args:
            observation_spec: Spec of the environment so far.

        Returns:
            The same spec with the code.
        """
        shape = (*observation_spec.shape, self.size)
        observation_spec[self.out_keys[0]] = Unbounded(shape=shape, dtype=torch.float32)
        return observation_spec
