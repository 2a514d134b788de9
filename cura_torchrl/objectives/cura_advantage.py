"""What CURA-PPO computes once per rollout with the old networks: advantage, value target and collision target."""

from __future__ import annotations

import numbers
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase, dispatch
from torchrl.objectives.value import GAE

from cura_torchrl import keys
from cura_torchrl.objectives.energy import energy_distance
from cura_torchrl.objectives.functional import (
    accumulate,
    explain,
    masked_moments,
    normalise,
    risk_cost,
    sr_lambda_targets,
    standardise,
    uncertainty_cost,
)
from cura_torchrl.objectives.rollout import MASK, cut_at_padding, read_mask, require_keys
from cura_torchrl.objectives.seeded import SeededModule
from cura_torchrl.validation import require_choice, require_finite, require_positive, require_unit

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from tensordict.nn import TensorDictModule

AdvantageScale = Literal["raw", "zscore"]
"""Scale of the advantage beside the costs: as GAE returns it, or to mean 0 and deviation 1 first."""

CostBaseline = Literal["mean", "state"]
"""What a cost is compared with: its mean over the rollout, or what a linear regression on the observation predicts."""

_GAE_KEYS = ("advantage", "value_target", "value", "reward", "done", "terminated")


class _Costs(NamedTuple):
    """Costs of a rollout before (raw) and after normalisation, shape ``[*B, T, 1]``, and where they count."""

    raw_risk: torch.Tensor
    raw_uncertainty: torch.Tensor
    risk: torch.Tensor
    uncertainty: torch.Tensor
    risk_mask: torch.Tensor
    uncertainty_mask: torch.Tensor


class CURAAdvantage(SeededModule, TensorDictModuleBase):
    """Advantage A - lambda_r C^R - lambda_u C^U with normalised costs, and SR(lambda) targets of the estimator.

    Apply it once per rollout, before the first gradient step: the costs and targets are those of the old estimator.
    With both coefficients at zero, ``normalise_sum`` and no padding, the advantage equals that of
    ``GAE(average_gae=True)`` to the last bit; set them to zero until the estimator has been trained for a while. Like
    TorchRL's estimators it writes into its input. The defaults are the letter of the paper;
    :class:`~cura_torchrl.trainers.config.CURAConfig` has those that train well on the pushing task.

    Reads and writes (default keys), time being the last batch dimension:

    ============================================================ ===== =============================================
    in_keys of both networks, at root and next                   read
    ``("next", "reward")``, ``("next", "cost")``                 read  reward, collision indicator, ``[*B, T, 1]``
    ``("next", "done")``, ``("next", "terminated")``             read  ended at all, for good, bool, ``[*B, T, 1]``
    ``("collector", "mask")``                                    read  optional: steps that are not padding, bool
    ``advantage``, ``value_target``                              write shape ``[*B, T, 1]``
    ``collision_target``                                         write target atoms, shape ``[*B, T, N]``
    ``state_value``, ``risk``, ``uncertainty``, at root and next write shape ``[*B, T, 1]``
    ============================================================ ===== =============================================

    Steps that are ``done`` but not ``terminated`` count as truncated: values, atoms and costs use the true last
    observation under ``next``. On terminated steps C^R = c_t - R(o_t), and C^U is left out of the statistics and zero.

    Args:
        critic_network: Writes the state value.
        collision_network: Writes atoms, risk and uncertainty, such as
            :class:`~cura_torchrl.modules.DistributionalCollisionEstimator`.
        gamma: Discount of the reward per step [1].
        lmbda: Lambda of the generalised advantage estimate [1].
        collision_gamma: gamma_c, discount of the collision per step [1].
        collision_lmbda: Lambda of the SR(lambda) targets [1].
        risk_coeff: lambda_r, weight of the risk cost [1]; a buffer, to be changed by assignment.
        uncertainty_coeff: lambda_u, weight of the uncertainty cost [1]; a buffer, to be changed by assignment.
        risk_floor: Smallest deviation that the risk cost is divided by [1].
        uncertainty_floor: Smallest deviation that the uncertainty cost is divided by [1].
        cost_clip: Bound on the magnitude of a normalised cost [1].
        cost_lmbda: Lambda of an advantage estimate of the costs with discount gamma_c [1]; 0 takes each step's own
            cost, as the paper does.
        cost_baseline: What is subtracted from the costs; the paper has the mean.
        advantage_scale: Scale of the advantage beside the costs. The letter of paper Eq. (10) is raw.
        normalise_sum: Whether to scale the penalised advantage to mean 0 and deviation 1 for the optimiser.
        shuffle_uncertainty: Whether the rollout's normalised uncertainty costs are dealt out among its steps at random:
            a placebo, with the same distribution and weight but without what it says about an action.
        seed: Seed of the random choices of targets and placebo; the generator's state is part of the state dict.

    Raises:
        ValueError: If a number, ``advantage_scale`` or ``cost_baseline`` is not acceptable.

    Source:
        Paper Eq. (8) to (10), Algorithm 1.

    Examples:
        >>> from tensordict import TensorDict
        >>> from cura_torchrl.modules import DistributionalCollisionEstimator, make_critic
        >>> estimate = CURAAdvantage(make_critic(3), DistributionalCollisionEstimator(3), risk_coeff=0.0)
        >>> estimate.risk_coeff = 0.25
        >>> seen = {"observation": torch.zeros(4, 8, 2), "latent": torch.zeros(4, 8, 1)}
        >>> flags = {name: torch.zeros(4, 8, 1, dtype=torch.bool) for name in ("done", "terminated")}
        >>> signals = {"reward": torch.randn(4, 8, 1), "cost": torch.zeros(4, 8, 1)}
        >>> rollout = estimate(TensorDict({**seen, "next": {**seen, **flags, **signals}}, [4, 8]))
        >>> rollout["advantage"].shape, rollout["collision_target"].shape
        (torch.Size([4, 8, 1]), torch.Size([4, 8, 50]))
    """

    @dataclass
    class _AcceptedKeys:
        advantage: NestedKey = keys.ADVANTAGE
        value_target: NestedKey = keys.VALUE_TARGET
        value: NestedKey = keys.STATE_VALUE
        reward: NestedKey = keys.REWARD
        cost: NestedKey = keys.COST
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        collision_atoms: NestedKey = keys.COLLISION_ATOMS
        risk: NestedKey = keys.RISK
        uncertainty: NestedKey = keys.UNCERTAINTY
        collision_target: NestedKey = keys.COLLISION_TARGET
        mask: NestedKey = MASK

    default_keys = _AcceptedKeys
    risk_coeff: torch.Tensor
    uncertainty_coeff: torch.Tensor

    def __init__(  # noqa: PLR0913 -- one keyword per symbol of the method, as TorchRL's value estimators have it
        self,
        critic_network: TensorDictModule,
        collision_network: TensorDictModule,
        *,
        gamma: float = 0.99,
        lmbda: float = 0.95,
        collision_gamma: float = 0.9,
        collision_lmbda: float = 0.95,
        risk_coeff: float = 0.25,
        uncertainty_coeff: float = 1.0,
        risk_floor: float = 0.005,
        uncertainty_floor: float = 0.005,
        cost_clip: float = 5.0,
        cost_lmbda: float = 0.0,
        cost_baseline: CostBaseline = "mean",
        advantage_scale: AdvantageScale = "raw",
        normalise_sum: bool = True,
        shuffle_uncertainty: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__()
        require_unit(gamma=gamma, lmbda=lmbda, collision_gamma=collision_gamma, collision_lmbda=collision_lmbda)
        require_unit(cost_lmbda=cost_lmbda)
        require_finite(risk_coeff=risk_coeff, uncertainty_coeff=uncertainty_coeff)
        require_positive(risk_floor=risk_floor, uncertainty_floor=uncertainty_floor, cost_clip=cost_clip)
        require_choice("advantage_scale", advantage_scale, get_args(AdvantageScale))
        require_choice("cost_baseline", cost_baseline, get_args(CostBaseline))
        self.value_estimator = GAE(gamma=gamma, lmbda=lmbda, value_network=critic_network)
        self.collision_network = collision_network
        self.collision_gamma = collision_gamma
        self.collision_lmbda = collision_lmbda
        self.risk_floor = risk_floor
        self.uncertainty_floor = uncertainty_floor
        self.cost_clip = cost_clip
        self.cost_lmbda = cost_lmbda
        self.cost_baseline = cost_baseline
        self.advantage_scale = advantage_scale
        self.normalise_sum = normalise_sum
        self.shuffle_uncertainty = shuffle_uncertainty
        self.tensor_keys = self._AcceptedKeys()
        self.register_buffer("risk_coeff", torch.tensor(float(risk_coeff)))
        self.register_buffer("uncertainty_coeff", torch.tensor(float(uncertainty_coeff)))
        self.seed(seed)

    def __setattr__(self, name: str, value: Any) -> None:
        """Copy numbers assigned to a coefficient into its buffer; set all else as usual."""
        buffer = self.__dict__.get("_buffers", {}).get(name)
        if buffer is not None and isinstance(value, numbers.Real):
            require_finite(**{name: float(value)})
            buffer.fill_(float(value))
        else:
            super().__setattr__(name, value)

    def _apply(self, fn: Any, recurse: bool = True) -> CURAAdvantage:
        # TorchRL's estimator hides its network from PyTorch: it would be left where and as it was.
        self.value_estimator.value_network._apply(fn)
        return super()._apply(fn, recurse)  # type: ignore[no-untyped-call]

    def set_keys(self, **kwargs: NestedKey) -> None:
        """Change the keys that are read and written.

        Args:
            **kwargs: New keys by the names of the default keys: ``advantage``, ``value_target``, ``value``, ``reward``,
                ``cost``, ``done``, ``terminated``, ``collision_atoms``, ``risk``, ``uncertainty``, ``collision_target``
                and ``mask``.

        Raises:
            ValueError: If a name is unknown.
        """
        accepted = [field.name for field in fields(self._AcceptedKeys)]
        for name in kwargs:
            if name not in accepted:
                msg = f"{name!r} is not a key of CURAAdvantage; accepted: {', '.join(accepted)}"
                raise ValueError(msg)
        self.tensor_keys = self._AcceptedKeys(**{**asdict(self.tensor_keys), **kwargs})
        self.value_estimator.set_keys(**{name: key for name, key in kwargs.items() if name in _GAE_KEYS})

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that are read, the optional mask excepted."""
        observed = [*self.value_estimator.value_network.in_keys, *self.collision_network.in_keys]
        names = self.tensor_keys
        outcome = [names.reward, names.cost, names.done, names.terminated]
        return list(dict.fromkeys([*observed, *map(_next, observed), *map(_next, outcome)]))

    @property
    def out_keys(self) -> list[NestedKey]:
        """Keys that are written."""
        names = self.tensor_keys
        both = [names.value, names.risk, names.uncertainty]
        return [names.advantage, names.value_target, names.collision_target, *both, *map(_next, both)]

    @dispatch
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute advantage and targets of a rollout, in place.

        Args:
            tensordict: Rollout with time as its last batch dimension, shape ``[*B, T]``.

        Returns:
            The same tensordict.

        Raises:
            KeyError: If the rollout or a network lacks a key; nothing has been written then.
            ValueError: If a dimension is named time and is not the last one.
        """  # noqa: DOC502 - raised by what this calls
        names = self.tensor_keys
        require_keys(self.in_keys, tensordict.keys(True, True), "rollouts that hold it, or another key by set_keys")
        written = (names.collision_atoms, names.risk, names.uncertainty)
        networks = "networks that write it, or another key by set_keys"
        require_keys(written, self.collision_network.out_keys, networks)
        require_keys([names.value], self.value_estimator.value_network.out_keys, networks)
        _require_time_last(tensordict)
        self._estimate_advantage(tensordict)
        self._estimate(tensordict)
        next_atoms = self._estimate(tensordict.get("next"))
        cost = tensordict.get(_next(names.cost))
        terminated = tensordict.get(_next(names.terminated))
        targets = sr_lambda_targets(
            cost,
            next_atoms,
            terminated,
            self._cut(tensordict),
            gamma=self.collision_gamma,
            lmbda=self.collision_lmbda,
            generator=self.generator,
        )
        tensordict.set(names.collision_target, targets)
        raw, costs = tensordict.get(names.advantage), self._costs(tensordict)
        if self.shuffle_uncertainty:
            costs = costs._replace(uncertainty=self._shuffle(costs.uncertainty, costs.uncertainty_mask))
        return tensordict.set(names.advantage, self._penalise(raw, costs, self._mask(tensordict)))

    @torch.no_grad()
    def diagnostics(self, tensordict: TensorDictBase) -> dict[str, torch.Tensor]:
        """Return what tells whether the costs are in proportion.

        It passes the rollout through the collision network once more.

        Args:
            tensordict: Rollout that :meth:`forward` has been applied to, shape ``[*B, T]``; it is not changed.

        Returns:
            By name, shape ``[]``: ``risk_mean``, ``uncertainty_mean``; ``risk_cost_std``, ``uncertainty_cost_std``,
            before normalisation; ``risk_weight``, ``uncertainty_weight``, lambda std(C) / std(A) of the summands;
            ``risk_uncertainty_correlation``; ``energy_distance`` of the estimator as it now is to its targets.
        """
        names = self.tensor_keys
        mask = self._mask(tensordict)
        costs = self._costs(tensordict)
        risk, uncertainty = tensordict.get(names.risk), tensordict.get(names.uncertainty)
        risk_mean, risk_std = masked_moments(risk, mask)
        uncertainty_mean, uncertainty_std = masked_moments(uncertainty, mask)
        covariance, _ = masked_moments((risk - risk_mean) * (uncertainty - uncertainty_mean), mask)
        advantage = self._scale(tensordict.get(names.value_target) - tensordict.get(names.value), mask)
        advantage_std = masked_moments(advantage, mask)[1].clamp_min(_TINY)
        outputs = self.collision_network(tensordict.select(*self.collision_network.in_keys))
        distance = energy_distance(outputs.get(names.collision_atoms), tensordict.get(names.collision_target))
        return {
            "risk_mean": risk_mean,
            "uncertainty_mean": uncertainty_mean,
            "risk_cost_std": masked_moments(costs.raw_risk, costs.risk_mask)[1],
            "uncertainty_cost_std": masked_moments(costs.raw_uncertainty, costs.uncertainty_mask)[1],
            "risk_weight": self.risk_coeff * masked_moments(costs.risk, mask)[1] / advantage_std,
            "uncertainty_weight": self.uncertainty_coeff * masked_moments(costs.uncertainty, mask)[1] / advantage_std,
            "risk_uncertainty_correlation": covariance / (risk_std * uncertainty_std).clamp_min(_TINY),
            "energy_distance": masked_moments(distance.unsqueeze(-1), mask)[0],
        }

    def _estimate_advantage(self, tensordict: TensorDictBase) -> None:
        names = self.tensor_keys
        if self._mask(tensordict) is None:
            self.value_estimator(tensordict)
            return
        # GAE knows no mask: show it a rollout whose trajectories end before their padding.
        shown, after = tensordict.copy(), tensordict.get("next")
        shown.set("next", after.copy().set(names.done, self._cut(tensordict)))
        self.value_estimator(shown)
        for key in (names.advantage, names.value_target, names.value):
            tensordict.set(key, shown.get(key))
        after.set(names.value, shown.get(_next(names.value)))

    def _estimate(self, tensordict: TensorDictBase) -> torch.Tensor:
        names = self.tensor_keys
        outputs = self.collision_network(tensordict.select(*self.collision_network.in_keys))
        tensordict.set(names.risk, outputs.get(names.risk))
        tensordict.set(names.uncertainty, outputs.get(names.uncertainty))
        return outputs.get(names.collision_atoms)

    def _mask(self, tensordict: TensorDictBase) -> torch.Tensor | None:
        return read_mask(tensordict, self.tensor_keys.mask)

    def _cut(self, tensordict: TensorDictBase) -> torch.Tensor:
        # Where a trajectory ends in the data. Not read from "truncated", which not every environment has and which
        # TorchRL 0.14's PPOTrainer overwrites.
        return cut_at_padding(tensordict.get(_next(self.tensor_keys.done)), self._mask(tensordict))

    def _costs(self, tensordict: TensorDictBase) -> _Costs:
        names = self.tensor_keys
        terminated = tensordict.get(_next(names.terminated))
        risk, next_risk = tensordict.get(names.risk), tensordict.get(_next(names.risk))
        raw_risk = risk_cost(tensordict.get(_next(names.cost)), risk, next_risk, terminated, gamma=self.collision_gamma)
        raw_uncertainty = uncertainty_cost(tensordict.get(names.uncertainty), tensordict.get(_next(names.uncertainty)))
        mask = self._mask(tensordict)
        risk_mask = torch.ones_like(terminated) if mask is None else mask
        uncertainty_mask = risk_mask & ~terminated
        factor, cut = self.collision_gamma * self.cost_lmbda, self._cut(tensordict)
        raw_risk = accumulate(raw_risk.masked_fill(~risk_mask, 0.0), cut, factor)
        raw_uncertainty = accumulate(raw_uncertainty.masked_fill(~uncertainty_mask, 0.0), cut, factor)
        if self.cost_baseline == "state":
            seen = [*map(tensordict.get, self.collision_network.in_keys), risk, tensordict.get(names.uncertainty)]
            features = torch.cat([part.reshape(*tensordict.batch_size, -1) for part in seen], -1)
            raw_risk = raw_risk - explain(raw_risk, features, risk_mask)
            raw_uncertainty = raw_uncertainty - explain(raw_uncertainty, features, uncertainty_mask)
        return _Costs(
            raw_risk,
            raw_uncertainty,
            normalise(raw_risk, floor=self.risk_floor, clip=self.cost_clip, mask=risk_mask),
            normalise(raw_uncertainty, floor=self.uncertainty_floor, clip=self.cost_clip, mask=uncertainty_mask),
            risk_mask,
            uncertainty_mask,
        )

    def _shuffle(self, values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        inside = values[mask]
        order = torch.randperm(len(inside), generator=self.generator)
        return values.masked_scatter(mask, inside[order.to(inside.device)])

    def _scale(self, advantage: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
        return standardise(advantage, mask) if self.advantage_scale == "zscore" else advantage

    def _penalise(self, raw: torch.Tensor, costs: _Costs, mask: torch.Tensor | None) -> torch.Tensor:
        scaled = self._scale(raw, mask)
        penalised = scaled - self.risk_coeff * costs.risk - self.uncertainty_coeff * costs.uncertainty
        if not self.normalise_sum:
            return penalised
        # Without costs one z-score, of the raw advantage: bitwise GAE, and out of a bad estimator's reach.
        penalises = (self.risk_coeff != 0) | (self.uncertainty_coeff != 0)
        return torch.where(penalises, standardise(penalised, mask), standardise(raw, mask))


_TINY = 1e-12
"""Keeps ratios of deviations finite [1]."""


def _next(key: NestedKey) -> tuple[str, ...]:
    return ("next", key) if isinstance(key, str) else ("next", *key)


def _require_time_last(tensordict: TensorDictBase) -> None:
    if "time" in tensordict.names[:-1]:
        msg = f"dimensions are {tensordict.names}; accepted: time as the last one"
        raise ValueError(msg)
