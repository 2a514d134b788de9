"""The perceptual part of the uncertainty, Var(E[C | s] | o): what seeing the whole state would remove."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict

from cura_torchrl import keys
from cura_torchrl.objectives.energy import energy_distance
from cura_torchrl.objectives.functional import sr_lambda_targets
from cura_torchrl.objectives.rollout import cut_at_padding, read_mask, require_keys
from cura_torchrl.objectives.seeded import SeededModule

if TYPE_CHECKING:
    from tensordict import NestedKey, TensorDictBase
    from tensordict.nn import TensorDictModule


class PerceptualObjective(SeededModule):
    """Targets and losses of two estimators, of which the second predicts Var(E[C | s] | o) from the observation alone.

    With o part of the state s, the law of total variance splits the paper's uncertainty:

        Var(C | o) = E[Var(C | s) | o] + Var(E[C | s] | o)

    The first part is chance that no sensor sees, the second what the robot could still find out. A *privileged*
    estimator learns the distribution of C given s from its own SR(lambda) targets; its mean is m(s) = E[C | s]. A
    *perceptual* estimator learns, from o, the distribution of m(s) by the energy distance to the one sample that each
    step gives. The energy distance is a proper score, so the best prediction is that distribution itself, with the
    wanted variance: never negative, and without a difference of two regressions.

    Both estimators are needed while training; what reads the uncertainty afterwards needs the perceptual one alone.

    Reads and writes, time being the last batch dimension of a rollout:

    ========================================================= ===== ================================================
    in_keys of the privileged network, at root and next       read  in a minibatch those of both networks, at root
    ``("next", "cost")``                                      read  collision indicator, ``[*B, T, 1]``
    ``("next", "done")``, ``("next", "terminated")``          read  ended at all, for good, bool, ``[*B, T, 1]``
    ``("collector", "mask")``                                 read  optional: steps that are not padding, bool
    ``privileged_target``                                     write SR(lambda) target atoms, shape ``[*B, T, N]``
    ``perceptual_target``                                     write m(s_t), shape ``[*B, T, 1]``
    ``loss_privileged``, ``loss_perceptual``                  write mean energy distances, shape ``[]``
    ========================================================= ===== ================================================

    Args:
        privileged_network: Writes ``privileged_atoms`` and ``privileged_risk``, their mean, from the full state.
        perceptual_network: Writes ``perceptual_atoms`` from the observation, and their variance.
        gamma: gamma_c, discount of the collision per step [1].
        lmbda: Lambda of the SR(lambda) targets [1].
        seed: Seed of the targets' random choices; the generator's state is part of the state dict.

    Source:
        Ours. The split is that of Depeweg et al. (2018), "Decomposition of uncertainty in Bayesian deep learning for
        efficient and risk-sensitive learning", with the hidden state in place of the network's weights.

    Examples:
        >>> from cura_torchrl.modules import DistributionalCollisionEstimator
        >>> seen, full = ("observation", "latent"), ("observation", "latent", "obstacle_code")
        >>> privileged = DistributionalCollisionEstimator(
        ...     6, in_keys=full, out_keys=("privileged_atoms", "privileged_risk", "privileged_uncertainty")
        ... )
        >>> perceptual = DistributionalCollisionEstimator(
        ...     3, in_keys=seen, out_keys=("perceptual_atoms", "perceptual_risk", "uncertainty")
        ... )
        >>> objective = PerceptualObjective(privileged, perceptual)
        >>> state = {"observation": torch.zeros(4, 8, 2), "latent": torch.zeros(4, 8, 1)}
        >>> state["obstacle_code"] = torch.rand(4, 8, 3)
        >>> flags = {name: torch.zeros(4, 8, 1, dtype=torch.bool) for name in ("done", "terminated")}
        >>> rollout = TensorDict({**state, "next": {**state, **flags, "cost": torch.zeros(4, 8, 1)}}, [4, 8])
        >>> sorted(objective.losses(objective.targets(rollout).reshape(-1)).keys())
        ['loss_perceptual', 'loss_privileged']
    """

    def __init__(
        self,
        privileged_network: TensorDictModule,
        perceptual_network: TensorDictModule,
        *,
        gamma: float = 0.9,
        lmbda: float = 0.95,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.privileged_network = privileged_network
        self.perceptual_network = perceptual_network
        self.gamma = gamma
        self.lmbda = lmbda
        self.seed(seed)

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """Keys that :meth:`targets` reads, the optional mask excepted."""
        seen = self.privileged_network.in_keys
        return [*seen, *(("next", key) for key in (*seen, keys.COST, "done", "terminated"))]

    @property
    def minibatch_keys(self) -> list[NestedKey]:
        """Keys that :meth:`losses` reads."""
        seen = [*self.privileged_network.in_keys, *self.perceptual_network.in_keys]
        return list(dict.fromkeys([*seen, keys.PRIVILEGED_TARGET, keys.PERCEPTUAL_TARGET]))

    @torch.no_grad()
    def targets(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the targets of both estimators, in place: once per rollout, from the networks as they were.

        Args:
            tensordict: Rollout with time as its last batch dimension, shape ``[*B, T]``.

        Returns:
            The same tensordict.

        Raises:
            KeyError: If the rollout lacks a key.
        """  # noqa: DOC502 - raised by what this calls
        require_keys(self.rollout_keys, tensordict.keys(True, True), "rollouts that hold it")
        now, after = self._state(tensordict), self._state(tensordict.get("next"))
        targets = sr_lambda_targets(
            tensordict.get(("next", keys.COST)),
            after.get(keys.PRIVILEGED_ATOMS),
            tensordict.get(("next", "terminated")),
            cut_at_padding(tensordict.get(("next", "done")), read_mask(tensordict)),
            gamma=self.gamma,
            lmbda=self.lmbda,
            generator=self.generator,
        )
        tensordict.set(keys.PRIVILEGED_TARGET, targets)
        # C is a discounted indicator: an expectation outside of [0, 1] is the linear head's error.
        return tensordict.set(keys.PERCEPTUAL_TARGET, now.get(keys.PRIVILEGED_RISK).clamp(0.0, 1.0))

    def losses(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses of both estimators; the gradient of each reaches its own estimator alone.

        Args:
            tensordict: Minibatch that :meth:`targets` has been applied to, without padding, shape ``[B]``; it is not
                changed.

        Returns:
            ``loss_privileged`` and ``loss_perceptual`` [1], shape ``[]``.
        """
        seen = tensordict.select(*self.perceptual_network.in_keys)
        privileged = self._state(tensordict).get(keys.PRIVILEGED_ATOMS)
        perceptual = self.perceptual_network(seen).get(keys.PERCEPTUAL_ATOMS)
        losses = {
            "loss_privileged": energy_distance(privileged, tensordict.get(keys.PRIVILEGED_TARGET)).mean(),
            "loss_perceptual": energy_distance(perceptual, tensordict.get(keys.PERCEPTUAL_TARGET)).mean(),
        }
        return TensorDict(losses, [])

    def _state(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.privileged_network(tensordict.select(*self.privileged_network.in_keys))
