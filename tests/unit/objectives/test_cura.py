"""The loss of CURA-PPO."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import NestedKey, TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.trainers.algorithms import PPOTrainer

from cura_torchrl.modules import DistributionalCollisionEstimator, ObservationNorm, make_actor, make_critic
from cura_torchrl.objectives import CURAAdvantage, CURALoss
from tests.contracts.loss import LossContract

BATCH, OBSERVATION, LATENT, ACTION, ATOMS = 12, 3, 2, 2, 8


def _networks(
    in_keys: tuple[str, ...] = ("observation", "latent"), inputs: int = OBSERVATION + LATENT
) -> list[nn.Module]:
    """Small actor, critic and estimator that share a norm; the same weights in every call."""
    torch.manual_seed(1)
    norm = ObservationNorm(OBSERVATION)
    norm.update(torch.randn(64, OBSERVATION) * 3.0 + 1.0)
    common = {"hidden_sizes": (16, 8), "observation_norm": norm, "in_keys": in_keys}
    return [
        make_actor(inputs, ACTION, **common),
        make_critic(inputs, **common),
        DistributionalCollisionEstimator(inputs, num_atoms=ATOMS, **common),
    ]


def _batch() -> TensorDict:
    torch.manual_seed(2)

    def seen() -> dict[str, torch.Tensor]:
        return {"observation": torch.randn(BATCH, OBSERVATION), "latent": torch.randn(BATCH, LATENT)}

    flags = {name: torch.zeros(BATCH, 1, dtype=torch.bool) for name in ("done", "terminated")}
    return TensorDict(
        {
            **seen(),
            "action": torch.randn(BATCH, ACTION),
            "action_log_prob": -2.0 + 0.3 * torch.randn(BATCH),
            "advantage": torch.randn(BATCH, 1),
            "value_target": torch.randn(BATCH, 1),
            "collision_target": torch.rand(BATCH, ATOMS),
            "next": {**seen(), **flags, "reward": torch.randn(BATCH, 1)},
        },
        [BATCH],
    )


class TestCURALoss(LossContract):
    """The contract of every loss, for CURALoss."""

    gradients = {  # noqa: RUF012
        "loss_objective": "actor_network",
        "loss_entropy": "actor_network",
        "loss_critic": "critic_network",
        "loss_collision": "collision_network",
    }

    def make_loss(self, **kwargs: object) -> CURALoss:
        """Return a loss over the small networks."""
        return CURALoss(*_networks(), **kwargs)

    def make_batch(self) -> TensorDict:
        """Return the minibatch."""
        return _batch()

    def expected_in_keys(self) -> set[NestedKey]:
        """Return what ClipPPOLoss reads, and the target."""
        seen = {"observation", "latent", ("next", "observation"), ("next", "latent")}
        outcome = {("next", "reward"), ("next", "done"), ("next", "terminated")}
        return seen | outcome | {"action", "action_log_prob", "collision_target"}

    def expected_out_keys(self) -> set[NestedKey]:
        """Return what ClipPPOLoss writes, and the collision loss."""
        diagnostics = {"clip_fraction", "entropy", "ESS", "kl_approx", "max_ratio", "mean_ratio"}
        return diagnostics | set(self.gradients)

    def extra_input_keys(self) -> tuple[str, ...]:
        """Return the target and the behaviour's log-probability."""
        return ("collision_target", "sample_log_prob")


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("coeff", [0.0, 1.0])
def test_ppo_is_unchanged_to_the_last_bit(functional: bool, coeff: float) -> None:
    """Catches any side effect on PPO: values and gradients of actor and critic equal those of ClipPPOLoss."""
    networks, reference = _networks(), _networks()
    ours = CURALoss(*networks, collision_coeff=coeff, functional=functional)(_batch())
    theirs = ClipPPOLoss(*reference[:2], functional=functional)(_batch())
    LossContract.assert_equal(ours, theirs)
    sum(value for key, value in ours.items() if key.startswith("loss_")).backward()
    sum(value for key, value in theirs.items() if key.startswith("loss_")).backward()
    for mine, other in zip(networks[:2], reference[:2], strict=True):
        for (name, a), b in zip(mine.named_parameters(), other.parameters(), strict=True):
            assert torch.equal(a.grad, b.grad), name
    reached = any(p.grad is not None and p.grad.abs().sum() > 0 for p in networks[2].parameters())
    assert reached == (coeff > 0.0)


def test_the_collision_loss_is_the_energy_distance_over_all_pairs() -> None:
    """Catches atoms or targets under the wrong key, or reduced over the wrong dimension."""
    networks, batch = _networks(), _batch()
    x = networks[2](batch.clone())["collision_atoms"].detach().double()
    y = batch["collision_target"].double()
    cross, own, other = ((p.unsqueeze(-1) - q.unsqueeze(-2)).abs().mean() for p, q in ((x, y), (x, x), (y, y)))
    expected = 2.0 * (2 * cross - own - other)
    assert CURALoss(*networks, collision_coeff=2.0)(batch)["loss_collision"].item() == pytest.approx(
        expected.item(), rel=1e-5
    )


def test_the_coefficient_is_a_buffer_that_can_be_scheduled() -> None:
    """Catches a shadowing attribute: assignment must change what the loss computes."""
    loss, batch = CURALoss(*_networks()), _batch()
    before = loss(batch)["loss_collision"]
    loss.collision_coeff = 0.5
    assert loss(batch)["loss_collision"].item() == pytest.approx(0.5 * before.item())
    assert dict(loss.named_buffers())["collision_coeff"].item() == 0.5


def test_the_shared_norm_reaches_the_functional_networks() -> None:
    """Catches statistics copied at construction: the trainer's update must change all three networks in the loss."""
    networks, batch = _networks(), _batch()
    loss = CURALoss(*networks)
    before = loss(batch)
    norms = {module for network in networks for module in network.modules() if isinstance(module, ObservationNorm)}
    assert len(norms) == 1
    norms.pop().update(100.0 * torch.randn(500, OBSERVATION))
    after = loss(batch)
    for name in ("loss_objective", "loss_critic", "loss_collision"):
        assert not torch.equal(before[name], after[name]), name
    assert not any("observation_norm" in name for name, _ in loss.named_parameters())


def test_outputs_can_be_selected() -> None:
    """Catches ``out_keys`` without a setter, which breaks TorchRL's ``select_out_keys``."""
    loss, batch = CURALoss(*_networks()), _batch()
    expected = loss(batch)["loss_collision"]
    loss.select_out_keys("loss_collision")
    assert list(loss.out_keys) == ["loss_collision"]
    out = loss(batch)
    assert set(out.keys()) == {"loss_collision"}
    assert torch.equal(out["loss_collision"], expected)


def test_a_batch_without_targets_says_what_to_do() -> None:
    """Catches a bare KeyError deep inside when CURAAdvantage was forgotten."""
    with pytest.raises(KeyError, match="CURAAdvantage"):
        CURALoss(*_networks())(_batch().exclude("collision_target"))


def test_estimators_of_other_sizes_and_keys_fit() -> None:
    """Catches assumptions about the number of target atoms or the estimator's output keys."""
    actor, critic, _ = _networks()
    estimator = DistributionalCollisionEstimator(
        OBSERVATION, num_atoms=5, hidden_sizes=(8,), in_keys=["observation"], out_keys=[("dce", "z"), "r", "u"]
    )
    loss = CURALoss(actor, critic, estimator)
    loss.set_keys(collision_atoms=("dce", "z"))
    assert loss(_batch())["loss_collision"].isfinite()


class _Corridor(EnvBase):
    """A point on a line: the wall at |x| > 1 is a collision, 12 steps are the limit, standing at 0 is best."""

    batch_locked = True

    def __init__(self, num_envs: int = 4) -> None:
        super().__init__(device=None, batch_size=torch.Size([num_envs]))
        column = (num_envs, 1)
        self.observation_spec = Composite(observation=Unbounded((num_envs, OBSERVATION)), shape=(num_envs,))
        self.action_spec = Bounded(-10.0, 10.0, (num_envs, ACTION))
        self.full_reward_spec = Composite(reward=Unbounded(column), cost=Unbounded(column), shape=(num_envs,))
        flag = partial(Binary, n=1, shape=column, dtype=torch.bool)
        self.full_done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(num_envs,))
        self.position, self.age = torch.zeros(column), torch.zeros(column)
        self.source = torch.Generator().manual_seed(0)

    def _observe(self) -> torch.Tensor:
        return torch.cat([self.position, self.position.square(), self.age / 12.0], -1)

    def _reset(self, tensordict: TensorDict | None = None, **_: object) -> TensorDict:
        everywhere = torch.ones_like(self.age, dtype=torch.bool)
        mask = everywhere if tensordict is None else tensordict.get("_reset", everywhere)
        start = torch.rand(self.position.shape, generator=self.source) - 0.5
        self.position, self.age = torch.where(mask, start, self.position), self.age.masked_fill(mask, 0.0)
        return TensorDict({"observation": self._observe()}, self.batch_size)

    def _step(self, tensordict: TensorDict) -> TensorDict:
        self.position = self.position + 0.5 * tensordict["action"].clamp(-1.0, 1.0)[..., :1]
        self.age = self.age + 1.0
        crashed = self.position.abs() > 1.0
        signals = {"reward": -self.position.abs(), "cost": crashed.float()}
        flags = {"terminated": crashed, "truncated": self.age >= 12.0, "done": crashed | (self.age >= 12.0)}
        return TensorDict({"observation": self._observe(), **signals, **flags}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.source.manual_seed(seed or 0)


def _collector(actor: nn.Module, num_envs: int, rollouts: int) -> Collector:
    frames = 32 * num_envs
    return Collector(
        _Corridor(num_envs),
        actor,
        frames_per_batch=frames,
        total_frames=frames * rollouts,
        auto_register_policy_transforms=False,
    )


@pytest.mark.filterwarnings("ignore:The '.*' hook stage will be replaced by OptimizationStepper:FutureWarning")
def test_it_trains_in_torchrls_ppo_trainer() -> None:
    """Catches anything that breaks in a TorchRL user's script: set_keys, summing of losses, buffers, weight updates."""
    actor, critic, estimator = _networks(("observation",), OBSERVATION)
    loss = CURALoss(actor, critic, estimator)
    advantage = CURAAdvantage(critic, estimator)
    before = [p.detach().clone() for p in loss.parameters()]
    sampler = SamplerWithoutReplacement()
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(128), sampler=sampler, batch_size=64)
    with pytest.warns(UserWarning, match="experimental/prototype"):
        trainer = PPOTrainer(
            collector=_collector(actor, 4, 2),
            total_frames=256,
            frame_skip=1,
            optim_steps_per_batch=2,
            num_epochs=2,
            loss_module=loss,
            optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
            replay_buffer=buffer,
            progress_bar=False,
            add_gae=False,
            enable_logging=False,
        )
    trainer.register_op("batch_process", advantage)
    trainer.train()
    assert trainer.collected_frames == 256
    assert all(p.isfinite().all() for p in loss.parameters())
    changed = [not torch.equal(old, new) for old, new in zip(before, loss.parameters(), strict=True)]
    assert all(changed)


def test_a_hand_written_loop_learns_to_predict_collisions() -> None:
    """Catches an estimator that does not learn: beside the wall the risk must rise far above that in the middle.

    The rollout's policy walks at random with steps of about 0.3, so that a start at 0.95 soon ends in the wall.
    """
    actor, critic, estimator = _networks(("observation",), OBSERVATION)
    loss, advantage = CURALoss(actor, critic, estimator), CURAAdvantage(critic, estimator)
    optimizer = torch.optim.Adam(loss.collision_network_params.parameters(), lr=1e-2)
    collector = _collector(actor, 64, 1)
    (rollout,) = collector
    collector.shutdown()
    rollout = advantage(rollout)
    assert rollout["next", "cost"].sum() > 0
    first = advantage.diagnostics(rollout)["energy_distance"].item()
    for _ in range(100):
        optimizer.zero_grad()
        loss(rollout.reshape(-1))["loss_collision"].backward()
        optimizer.step()
    assert advantage.diagnostics(rollout)["energy_distance"].item() < first
    position = torch.tensor([[0.0], [0.95]])
    risk = estimator(torch.cat([position, position.square(), torch.full((2, 1), 0.25)], -1))[1].flatten()
    assert risk[1] > risk[0] + 0.2


def test_a_network_that_writes_other_keys_is_named() -> None:
    """Catches a missing tensor as the only sign of an estimator with other out_keys."""
    actor, critic, _ = _networks()
    other = DistributionalCollisionEstimator(
        OBSERVATION + LATENT, num_atoms=ATOMS, hidden_sizes=(8,), out_keys=("atoms", "risk", "uncertainty")
    )
    loss = CURALoss(actor, critic, other)
    with pytest.raises(KeyError, match=r"'collision_atoms' is missing; accepted: .* set_keys"):
        loss(_batch())
    loss.set_keys(collision_atoms="atoms")
    assert loss(_batch())["loss_collision"].isfinite()
