"""What every loss module of this package has to keep to; subclass and fill in the abstract methods."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import pytest
import torch

if TYPE_CHECKING:
    from tensordict import NestedKey, TensorDict
    from torchrl.objectives import LossModule


class LossContract(ABC):
    """Claims that hold for every loss. Not collected itself: its name does not start with Test."""

    gradients: dict[str, str]
    """Which network, by attribute, each ``loss_*`` output trains; all others must get no gradient from it."""

    @abstractmethod
    def make_loss(self, **kwargs: object) -> LossModule:
        """Return a small loss; equal keyword arguments must give equal networks."""

    @abstractmethod
    def make_batch(self) -> TensorDict:
        """Return a minibatch, shape ``[B]``, the same in every call."""

    @abstractmethod
    def expected_in_keys(self) -> set[NestedKey]:
        """Return exactly the keys that the loss reads."""

    @abstractmethod
    def expected_out_keys(self) -> set[NestedKey]:
        """Return exactly the keys that the loss lists as written."""

    def test_keys_are_exact(self) -> None:
        """Catches a key that is read but not listed, so that dispatch and buffers drop it."""
        loss = self.make_loss()
        assert set(loss.in_keys) == self.expected_in_keys()
        assert set(loss.out_keys) == self.expected_out_keys()
        assert len(loss.in_keys) == len(set(loss.in_keys))
        out = loss(self.make_batch())
        assert set(loss.out_keys) <= set(out.keys())
        assert {key for key in out.keys() if key.startswith("loss_")} == set(self.gradients)  # noqa: SIM118

    def test_unknown_keys_are_refused(self) -> None:
        """Catches a misspelt key that is silently ignored."""
        with pytest.raises(ValueError, match="not an accepted tensordict key"):
            self.make_loss().set_keys(no_such_key="x")

    def test_every_key_can_be_nested(self) -> None:
        """Catches a hard-coded key: outputs must not change when inputs move."""
        loss, batch = self.make_loss(), self.make_batch()
        expected = loss(batch)
        for name in ("advantage", "value_target", *self.extra_input_keys()):
            old = getattr(loss.tensor_keys, name)
            new = ("moved", name)
            loss.set_keys(**{name: new})
            batch.rename_key_(old, new)
        self.assert_equal(loss(batch), expected)

    @abstractmethod
    def extra_input_keys(self) -> tuple[str, ...]:
        """Return the names of further keys that are inputs only."""

    def test_keyword_tensors_give_the_same_as_a_tensordict(self) -> None:
        """Catches a forward that is not dispatched, or returns in another order than ``out_keys``."""
        loss, batch = self.make_loss(), self.make_batch()
        out = loss(batch)
        flat = {"_".join(key) if isinstance(key, tuple) else key: batch[key] for key in loss.in_keys}
        for value, key in zip(loss(**flat), loss.out_keys, strict=True):
            # Advantages are not among the keys: the loss computes them from the same data again.
            assert value.shape == out[key].shape

    @pytest.mark.parametrize("reduction", ["mean", "sum"])
    def test_reductions_agree_with_no_reduction(self, reduction: str) -> None:
        """Catches a term that is reduced early or broadcast: per-sample losses have the batch's shape."""
        batch = self.make_batch()
        each, reduced = self.make_loss(reduction="none")(batch), self.make_loss(reduction=reduction)(batch)
        for name in self.gradients:
            assert each[name].shape == batch.batch_size
            assert torch.allclose(getattr(each[name], reduction)(), reduced[name], atol=1e-5)

    def test_gradients_reach_exactly_the_intended_networks(self) -> None:
        """Catches a loss that also trains a network it should leave alone."""
        for name, trained in self.gradients.items():
            loss = self.make_loss()
            loss(self.make_batch())[name].backward()
            for network in set(self.gradients.values()):
                grads = [p.grad for p in getattr(loss, f"{network}_params").parameters()]
                reached = any(grad is not None and grad.abs().sum() > 0 for grad in grads)
                assert reached == (network == trained), f"{name} and {network}"

    def test_diagnostics_are_detached(self) -> None:
        """Catches a logged value that keeps the graph alive."""
        out = self.make_loss()(self.make_batch())
        assert not any(value.requires_grad for key, value in out.items() if not key.startswith("loss_"))

    def test_the_batch_is_not_changed(self) -> None:
        """Catches outputs of the networks written into the replay buffer's sample."""
        batch = self.make_batch()
        before = copy.deepcopy(batch)
        self.make_loss()(batch)
        assert set(batch.keys(True, True)) == set(before.keys(True, True))
        self.assert_equal(batch, before)

    def test_the_state_dict_restores_the_losses(self) -> None:
        """Catches parameters, statistics or coefficients that are not saved."""
        loss, other, batch = self.make_loss(), self.make_loss(), self.make_batch()
        with torch.no_grad():
            for value in [*other.parameters(), *other.buffers()]:
                value.mul_(1.5) if value.is_floating_point() else None
        other.load_state_dict(loss.state_dict())
        self.assert_equal(other(batch), loss(batch))

    def test_stateful_networks_give_the_same(self) -> None:
        """Catches ``functional=False``, which DDP and FSDP need, left behind."""
        self.assert_equal(self.make_loss(functional=False)(self.make_batch()), self.make_loss()(self.make_batch()))

    def test_padding_counts_for_nothing(self) -> None:
        """Catches padded steps in the mean, NaN padding included."""
        batch = self.make_batch()
        padded = torch.cat([batch, batch[:3].apply(lambda x: x * float("nan") if x.is_floating_point() else x)])
        padded["collector", "mask"] = torch.arange(padded.shape[0]) < batch.shape[0]
        out, expected = self.make_loss(entropy_bonus=False)(padded), self.make_loss(entropy_bonus=False)(batch)
        for name in set(self.gradients) - {"loss_entropy"}:
            assert torch.allclose(out[name], expected[name], atol=1e-6)

    @staticmethod
    def assert_equal(one: TensorDict, other: TensorDict) -> None:
        """Fail unless all leaves are equal to the last bit."""
        for key in other.keys(True, True):
            assert torch.equal(one[key], other[key]), key
