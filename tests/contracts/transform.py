"""What every transform of this package has to keep to; subclass and fill in the abstract methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial
from typing import TYPE_CHECKING

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

if TYPE_CHECKING:
    from torchrl.envs import Transform

STEPS = 9
"""Longer than two episodes of the shortest row, so that rows are reset at different times."""


def wrap(env: EnvBase, transform: Transform) -> TransformedEnv:
    """Return the transformed environment, which may be transformed already."""
    return TransformedEnv(env, transform, auto_unwrap=False)


class TransformContract(ABC):
    """Claims that hold for every transform. Not collected itself: its name does not start with Test."""

    tolerance = 0.0
    """Largest difference that the size of the batch may make; 0 is bitwise."""

    @abstractmethod
    def make_transform(self) -> Transform:
        """Return the transform; two calls give equal ones."""

    @abstractmethod
    def make_base_env(self, labels: tuple[int, ...]) -> EnvBase:
        """Return an environment with one row per label that emits the in_keys; a row depends on its label alone."""

    def make_env(self, labels: tuple[int, ...] = (0, 1, 2)) -> TransformedEnv:
        """Return the transformed environment."""
        return wrap(self.make_base_env(labels), self.make_transform())

    def out_key(self) -> str:
        """Return the key that the transform writes."""
        return self.make_transform().out_keys[0]

    def rollout(self, env: EnvBase) -> TensorDict:
        """Return several episodes per row, with their partial resets."""
        return env.rollout(STEPS, break_when_any_done=False)

    def assert_close(self, actual: torch.Tensor, expected: torch.Tensor) -> None:
        """Compare to the transform's tolerance."""
        torch.testing.assert_close(actual, expected, rtol=0.0, atol=self.tolerance)

    @pytest.mark.parametrize("rows", [1, 3])
    def test_specs_match_data(self, rows: int) -> None:
        """Catches a wrong shape, dtype or bound, at the root and under next, in steps and in resets."""
        check_env_specs(self.make_env(tuple(range(rows))), break_when_any_done="both", seed=0)

    def test_out_key_is_written_at_root_and_next(self) -> None:
        """Catches a transform that writes nothing at a reset."""
        data, spec = self.rollout(env := self.make_env()), env.observation_spec[self.out_key()]
        for part in (data, data["next"]):
            value = part[self.out_key()]
            assert value.shape == (3, STEPS, *spec.shape[1:])
            assert value.dtype == spec.dtype
            assert not value.requires_grad

    def test_works_inside_and_outside_of_a_serial_env(self) -> None:
        """Catches state that assumes one batch dimension."""
        expected = self.rollout(self.make_env((0, 1)))[self.out_key()]
        inside = SerialEnv(2, partial(self.make_env, (0, 1)))
        outside = wrap(SerialEnv(2, partial(self.make_base_env, (0, 1))), self.make_transform())
        for env in (inside, outside):
            actual = self.rollout(env)[self.out_key()]
            self.assert_close(actual[0], expected)
            self.assert_close(actual[1], expected)

    def test_rows_do_not_depend_on_the_batch(self) -> None:
        """Catches a leak between rows, and vectorised code whose result depends on the place in the batch."""
        together = self.rollout(self.make_env((0, 1, 2, 3, 4)))
        for label in range(5):
            alone = self.rollout(self.make_env((label,)))
            self.assert_close(together[label][self.out_key()], alone[0][self.out_key()])
            self.assert_close(together[label]["next", self.out_key()], alone[0]["next", self.out_key()])

    def test_a_reset_forgets_the_past(self) -> None:
        """Catches state that survives a reset: an episode must look the same whether others came before it."""
        used, fresh = self.make_env(), self.make_env()
        self.rollout(used)
        fresh.base_env.episode[:] = used.base_env.episode
        self.assert_close(self.rollout(used)[self.out_key()], self.rollout(fresh)[self.out_key()])

    def test_outputs_do_not_alias_state(self) -> None:
        """Catches an emitted buffer that the next step overwrites."""
        env = self.make_env()
        first = env.reset()
        kept = first[self.out_key()].clone()
        step = env.step(first.set("action", torch.zeros(3, 1)))["next"]
        later = step[self.out_key()].clone()
        env.reset(TensorDict({"_reset": torch.tensor([[True], [False], [True]])}, [3]))
        assert torch.equal(first[self.out_key()], kept)
        assert torch.equal(step[self.out_key()], later)

    def test_composes_with_other_transforms(self) -> None:
        """Catches a transform that works only as the first and only one."""
        both = Compose(StepCounter(), self.make_transform(), StepCounter(step_count_key="n"))
        check_env_specs(wrap(self.make_base_env((0, 1)), both), seed=0)

    def test_works_in_a_collector(self) -> None:
        """Catches state that a collector's stripped reset tensordict would lose."""
        env = self.make_env()
        collector = Collector(
            env, frames_per_batch=3 * STEPS, total_frames=6 * STEPS, auto_register_policy_transforms=False
        )
        batches = torch.cat([batch.clone() for batch in collector], -1)
        collector.shutdown()
        value, after = batches[self.out_key()], batches["next", self.out_key()]
        assert value.shape == (3, 2 * STEPS, *env.observation_spec[self.out_key()].shape[1:])
        # Within an episode the next step's root is this step's next, also across batches.
        goes_on = ~batches["next", "done"][:, :-1, 0]
        assert goes_on.sum() > STEPS
        assert torch.equal(value[:, 1:][goes_on], after[:, :-1][goes_on])

    def test_leaves_other_keys_alone(self) -> None:
        """Catches a transform that rewrites its inputs or unrelated keys."""
        before = self.make_base_env((0, 1, 2)).reset().set("other", torch.arange(3.0))
        after = self.make_transform()(before.clone())
        assert "other" in after.keys()  # noqa: SIM118
        for key in set(before.keys()) & set(after.keys()):
            assert torch.equal(after[key], before[key])

    def test_a_missing_key_is_named(self) -> None:
        """Catches a silent no-op when an input is missing."""
        transform = self.make_transform()
        with pytest.raises(KeyError, match="accepted"):
            transform(TensorDict({"other": torch.zeros(2, 1)}, [2]))
