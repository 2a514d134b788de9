"""The loss of CURA-PPO: clipped PPO for actor and critic, energy distance for the collision estimator."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from tensordict import NestedKey
from tensordict.nn import dispatch
from torchrl.objectives import ClipPPOLoss

from cura_torchrl import keys
from cura_torchrl.objectives.energy import energy_distance
from cura_torchrl.objectives.rollout import require_keys

if TYPE_CHECKING:
    import torch
    from tensordict import TensorDict, TensorDictBase, TensorDictParams
    from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule


class CURALoss(ClipPPOLoss):
    """Clipped PPO with a ``loss_collision`` that trains the collision estimator beside actor and critic.

    The costs enter through the advantage, which :class:`~cura_torchrl.objectives.CURAAdvantage` computes once per
    rollout together with the estimator's targets. So all that ``ClipPPOLoss`` returns is unchanged to the last bit,
    whatever ``collision_coeff`` is, and the gradient of ``loss_collision`` reaches the estimator alone.

    Beyond what ``ClipPPOLoss`` reads and writes (default keys):

    ===================== ===== ===================================================================
    ``observation``, ...  read  in_keys of the collision network
    ``collision_target``  read  target atoms, shape ``[B, M]``
    ``loss_collision``    write ``collision_coeff`` times the energy distance, reduced like the others
    ===================== ===== ===================================================================

    Networks that share an ``ObservationNorm`` have to be moved to their device before they are given to the loss.

    Args:
        actor_network: Policy, see ``ClipPPOLoss``.
        critic_network: Value network, see ``ClipPPOLoss``.
        collision_network: Network that writes atoms under the key ``collision_atoms``.
        collision_coeff: Weight of the energy distance [1]; schedulable by assignment.
        **kwargs: Keyword arguments of ``ClipPPOLoss``.

    Source:
        Paper Eq. (7) and (10), Algorithm 1.

    Examples:
        >>> from cura_torchrl.modules import DistributionalCollisionEstimator, make_actor, make_critic
        >>> loss = CURALoss(make_actor(5, 2), make_critic(5), DistributionalCollisionEstimator(5), entropy_coeff=0.005)
        >>> loss.out_keys[-1]
        'loss_collision'
        >>> loss.set_keys(collision_target=("collision", "target"))
        >>> ("collision", "target") in loss.in_keys
        True
    """

    @dataclass
    class _AcceptedKeys(ClipPPOLoss._AcceptedKeys):
        collision_atoms: NestedKey = keys.COLLISION_ATOMS
        collision_target: NestedKey = keys.COLLISION_TARGET

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    _schedulable_buffers: ClassVar[frozenset[str]] = frozenset({"collision_coeff"})

    collision_network: TensorDictModule
    collision_network_params: TensorDictParams | None
    target_collision_network_params: TensorDictParams | None
    collision_coeff: torch.Tensor
    _out_keys: list[NestedKey] | None

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critic_network: TensorDictModule,
        collision_network: TensorDictModule,
        *,
        collision_coeff: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(actor_network, critic_network, **kwargs)
        if self.functional:
            self.convert_to_functional(collision_network, "collision_network")
        else:
            self.collision_network = collision_network
            self.collision_network_params = None
        self.register_coeff_buffer("collision_coeff", collision_coeff, device=self.entropy_coeff.device)
        self._set_in_keys()

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        # The parent's constructor calls this before there is a collision network.
        network = getattr(self, "collision_network", None)
        if network is not None:
            extra = [*network.in_keys, self.tensor_keys.collision_target]
            self._in_keys += [key for key in extra if key not in self._in_keys]

    @property
    def out_keys(self) -> list[NestedKey]:
        """Keys that the loss writes: those of ``ClipPPOLoss``, then ``loss_collision``."""
        if self._out_keys is None:
            self._out_keys = [*ClipPPOLoss.out_keys.fget(self), "loss_collision"]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses and diagnostics of a minibatch.

        Args:
            tensordict: Minibatch with advantage, value target and collision target, shape ``[B]``; it is not changed.

        Returns:
            Losses, whose keys start with ``loss_``, and detached diagnostics, see :attr:`out_keys`.
        """
        losses = super().forward(tensordict)
        collision = self._reduce_loss(self.loss_collision(tensordict), tensordict)
        return losses.set("loss_collision", collision.squeeze(-1))

    def loss_collision(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Return ``collision_coeff`` times the energy distance from the predicted to the target atoms.

        Args:
            tensordict: Minibatch with the collision network's inputs and the collision target, shape ``[B]``.

        Returns:
            Weighted energy distance per sample [1], shape ``[B, 1]``, not reduced.

        Raises:
            KeyError: If the minibatch has no collision target, or the network writes no atoms.
        """
        target = tensordict.get(self.tensor_keys.collision_target, None)
        if target is None:
            msg = (
                f"key {self.tensor_keys.collision_target!r} is missing; "
                "accepted: batches that CURAAdvantage has been applied to, once per rollout"
            )
            raise KeyError(msg)
        with (
            self.collision_network_params.to_module(self.collision_network, preserve_module_state=False)
            if self.collision_network_params is not None
            else contextlib.nullcontext()
        ):
            outputs = self.collision_network(tensordict.select(*self.collision_network.in_keys))
        atoms = self.tensor_keys.collision_atoms
        require_keys([atoms], outputs.keys(True, True), "networks that write it, or another key by set_keys")
        prediction = outputs.get(atoms)
        return self.collision_coeff * energy_distance(prediction, target.detach()).unsqueeze(-1)
