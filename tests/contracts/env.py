"""What every environment of this package has to keep to; subclass and fill in the abstract method."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

LIMIT = 4
"""Policy steps of an episode, unless a test asks for longer ones: resets must come often."""

LONG = 22
"""Policy steps in which obstacles appear, and in which rounding that depends on the batch would have grown."""


def draw_actions(env: EnvBase, steps: int, seed: int = 0) -> torch.Tensor:
    """Return uniform actions, shape ``[T, N, A]``; those of a row do not depend on the number of rows."""
    size = env.action_spec.shape[-1]
    rows = [
        torch.rand(steps, size, generator=torch.Generator().manual_seed(seed + 97 * i)) for i in range(env.num_envs)
    ]
    return torch.stack(rows, 1) * 2 - 1


def play(env: EnvBase, actions: torch.Tensor, data: TensorDictBase | None = None) -> TensorDictBase:
    """Return the rollout of some actions with automatic resets, batch ``[N, T]``, from a root or a next tensordict."""
    data = env.reset() if data is None else data.select(*env.observation_spec.keys(), *env.full_done_spec.keys())
    steps = []
    for action in actions:
        step, data = env.step_and_maybe_reset(data.set("action", action))
        steps.append(step)
    return torch.stack(steps, -1)


def assert_same(one: TensorDictBase, other: TensorDictBase) -> None:
    """Fail unless two tensordicts hold the same keys and, to the last bit, the same values."""
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]), key


class EnvContract(ABC):
    """Claims that hold for every environment. Not collected itself: its name does not start with Test."""

    @abstractmethod
    def make_env(self, num_envs: int, *, limit: int = LIMIT, **kwargs: Any) -> EnvBase:
        """Return an environment whose episodes last ``limit`` steps and in which obstacles appear within 2 s."""

    @pytest.fixture
    def make(self) -> Iterator[Callable[..., EnvBase]]:
        """Build environments that are closed after the test, whatever happens."""
        envs: list[EnvBase] = []

        def build(num_envs: int = 3, **kwargs: Any) -> EnvBase:
            envs.append(self.make_env(num_envs, **kwargs))
            return envs[-1]

        yield build
        for env in envs:
            env.close(raise_if_closed=False)

    @pytest.mark.parametrize("rows", [1, 3])
    def test_specs_match_data(self, make: Callable[..., EnvBase], rows: int) -> None:
        """Catches a wrong key, shape, dtype or bound, in steps and in resets."""
        check_env_specs(make(rows), break_when_any_done="both", seed=0)

    def test_fake_data_look_like_real_data(self, make: Callable[..., EnvBase]) -> None:
        """Catches specs that a collector would allocate wrongly."""
        env = make()
        fake, real = env.fake_tensordict(), env.rollout(1)[:, 0]
        assert set(fake.keys(True, True)) == set(real.keys(True, True))
        for key in fake.keys(True, True):
            assert (fake[key].shape, fake[key].dtype) == (real[key].shape, real[key].dtype), key

    def test_random_play_is_finite_and_inside_the_specs(self, make: Callable[..., EnvBase]) -> None:
        """Catches NaN, and values beyond the bounds that a few steps of the spec check do not reach."""
        env = make(limit=8)
        data = play(env, draw_actions(env, 20))
        for name, value in data.items(True, True):
            assert value.isfinite().all(), name
        for step in data.unbind(-1):
            assert env.observation_spec.is_in(step["next"].select(*env.observation_spec.keys()))
            assert env.full_done_spec.is_in(step["next"].select(*env.full_done_spec.keys()))

    def test_a_partial_reset_changes_the_masked_rows_alone(self, make: Callable[..., EnvBase]) -> None:
        """Catches a reset that restarts or disturbs other rows, at once or in the steps after it."""
        touched, untouched = make(limit=LONG), make(limit=LONG)
        actions = draw_actions(touched, 8)
        before, reference = (play(env, actions[:4])[:, -1]["next"] for env in (touched, untouched))
        mask = torch.tensor([[True], [False], [True]])
        root = touched.reset(before.clone().set("_reset", mask))
        observed = list(touched.observation_spec.keys())
        assert_same(root.select(*observed)[1], before.select(*observed)[1])
        assert root["elapsed_steps"].flatten().tolist() == [0, 4, 0]
        assert not root["done"].any()
        after, expected = (play(env, actions[4:], data) for env, data in ((touched, root), (untouched, reference)))
        assert_same(after["next"][1], expected["next"][1])
        assert (after["next", "elapsed_steps"][0] == torch.arange(1, 5)[:, None]).all()

    def test_a_row_is_bitwise_what_it_is_alone(self, make: Callable[..., EnvBase]) -> None:
        """Catches a leak between worlds, and arithmetic that rounds differently by the size of the batch."""
        # Nine rows: vector instructions and blocks of worlds come in eights, the ninth falls to what is left over.
        together, alone = make(9, limit=LONG + 1), make(1, limit=LONG + 1)
        actions = draw_actions(together, LONG)
        data = play(together, actions)
        obstructed = together.obstacles[0].any(-1).nonzero().flatten().tolist()
        for row in {obstructed[0], obstructed[-1]}:
            root = alone.reset(episodes=data["episode"][row, 0])
            assert_same(play(alone, actions[:, row : row + 1], root)[0], data[row])

    def test_an_episode_does_not_depend_on_the_past(self, make: Callable[..., EnvBase]) -> None:
        """Catches state that survives a reset: warm starts of a solver, noise, obstacles, controllers."""
        used, fresh = make(2), make(2)
        play(used, draw_actions(used, LONG, seed=5))
        episodes, actions = torch.tensor([1000, 1001]), draw_actions(used, LIMIT)
        one, other = (play(env, actions, env.reset(episodes=episodes)) for env in (used, fresh))
        assert_same(one[:, : LIMIT - 1], other[:, : LIMIT - 1])
        assert_same(one["next"], other["next"])

    def test_the_seed_decides(self, make: Callable[..., EnvBase]) -> None:
        """Catches hidden randomness, and a seed that nothing reads."""
        one, same, other = make(2, seed=1), make(2, seed=1), make(2, seed=2)
        actions = draw_actions(one, LIMIT + 2)
        data = play(one, actions)
        assert_same(play(same, actions), data)
        assert not torch.equal(play(other, actions)["scan"], data["scan"])
        other.set_seed(1)
        # The seed begins the sequence of episodes again, and the scenes are those of the new seed.
        assert_same(play(other, actions), data)

    def test_outputs_do_not_alias_state(self, make: Callable[..., EnvBase]) -> None:
        """Catches an emitted buffer that a later step or reset overwrites."""
        env = make()
        emitted = [env.reset()]
        for action in draw_actions(env, 3):
            emitted.append(env.step(emitted[0].select().set("action", action))["next"])
            emitted.append(env.reset(TensorDict({"_reset": torch.tensor([[True], [False], [False]])}, [3])))
        kept = [data.clone() for data in emitted]
        play(env, draw_actions(env, LIMIT + 1))
        for data, copy in zip(emitted, kept, strict=True):
            assert_same(data, copy)

    def test_the_action_given_is_not_changed(self, make: Callable[..., EnvBase]) -> None:
        """Catches a clamp in place, which would falsify the policy's log-probability."""
        env = make()
        action = torch.full_like(env.rand_action()["action"], 3.0)
        env.step(env.reset().set("action", action))
        assert (action == 3.0).all()

    def test_actions_out_of_bounds_are_clamped(self, make: Callable[..., EnvBase]) -> None:
        """Catches an action beyond the robot's limits that is carried out or shown to the policy."""
        env, clamped = make(), make()
        actions = 4 * draw_actions(env, 3)
        one, other = play(env, actions), play(clamped, actions.clamp(-1, 1))
        assert_same(one["next"], other["next"])

    def test_a_nan_action_is_refused_and_changes_nothing(self, make: Callable[..., EnvBase]) -> None:
        """Catches NaN that reaches the simulator, where it reads as free space, or that spoils the worlds."""
        env, reference = make(), make()
        actions = draw_actions(env, 2)
        data, expected = (play(e, actions[:1])[:, 0]["next"] for e in (env, reference))
        broken = actions[1].clone()
        broken[1, 0] = torch.nan
        with pytest.raises(ValueError, match=r"^action .* \[1\]; accepted: ") as error:
            env.step(data.select().set("action", broken))
        assert "\n" not in str(error.value)
        one, other = (e.step(d.select().set("action", actions[1])) for e, d in ((env, data), (reference, expected)))
        assert_same(one["next"], other["next"])

    def test_the_last_observation_of_an_episode_is_kept(self, make: Callable[..., EnvBase]) -> None:
        """Catches the next episode's first observation in place of the last one, from which values bootstrap."""
        env, reference = make(2), make(2)
        actions = draw_actions(env, LIMIT + 1)
        data, root = play(env, actions), reference.reset()
        for action in actions[:LIMIT]:
            last = reference.step(root.select().set("action", action))["next"]
        assert last["done"].all()
        assert_same(data[:, LIMIT - 1]["next"], last)
        assert (data["next", "elapsed_steps"][:, LIMIT - 1] == LIMIT).all()
        assert (data["elapsed_steps"][:, LIMIT] == 0).all()
        assert not torch.equal(data["observation"][:, LIMIT], last["observation"])

    def test_done_is_terminated_or_truncated(self, make: Callable[..., EnvBase]) -> None:
        """Catches an ending that TorchRL never sees: it resets on ``done`` alone."""
        env = make()
        data = env.rollout(3 * LIMIT + 1, break_when_any_done=False)
        after = data["next"]
        assert torch.equal(after["done"], after["terminated"] | after["truncated"])
        assert not (after["terminated"] & after["truncated"]).any()
        assert (after["done"].sum(1) == 3).all()
        starts = data["elapsed_steps"][:, 1:] == 0
        assert torch.equal(starts, after["done"][:, :-1])
        assert (data["elapsed_steps"][:, 1:] == torch.where(starts, 0, after["elapsed_steps"][:, :-1])).all()

    def test_works_in_a_collector(self, make: Callable[..., EnvBase]) -> None:
        """Catches state that a collector's stripped tensordicts would lose."""
        steps = LIMIT + 1
        collector = Collector(
            make(), frames_per_batch=3 * steps, total_frames=6 * steps, auto_register_policy_transforms=False
        )
        batches = torch.cat([batch.clone() for batch in collector], -1)
        collector.shutdown()
        expected = [step % LIMIT for step in range(2 * steps)]
        assert batches.shape == (3, 2 * steps)
        for row in batches["elapsed_steps"]:
            assert row.flatten().tolist() == expected

    def test_works_under_transforms(self, make: Callable[..., EnvBase]) -> None:
        """Catches keys or reset data that TorchRL's own transforms cannot work with."""
        sums = RewardSum(in_keys=["reward", "cost"], out_keys=["episode_reward", "episode_cost"])
        env = TransformedEnv(make(), Compose(StepCounter(), sums))
        check_env_specs(env, break_when_any_done="both", seed=0)
        data = env.rollout(LIMIT + 2, break_when_any_done=False)
        assert torch.equal(data["next", "step_count"], data["next", "elapsed_steps"])
        total = data["next", "reward"][:, :LIMIT].sum(1)
        torch.testing.assert_close(data["next", "episode_reward"][:, LIMIT - 1], total)

    def test_closing_twice_is_harmless(self, make: Callable[..., EnvBase]) -> None:
        """Catches a collector's second close that raises on the way out."""
        env = make(1)
        env.reset()
        env.close()
        assert env.is_closed
        env.close(raise_if_closed=False)
        env.close(raise_if_closed=True)
