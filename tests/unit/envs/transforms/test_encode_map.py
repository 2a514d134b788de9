"""The encoding of maps inside of the environment."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, EnvBase, TransformedEnv

from cura_torchrl.envs.config import MapConfig
from cura_torchrl.envs.transforms import ConfidenceMap, EncodeMap
from tests.contracts.transform import TransformContract
from tests.scenes import MAX_RANGE, NUM_RAYS, ScanEnv

CONFIG = MapConfig(extent_x=(-4.0, 6.0), extent_y=(-4.0, 4.0), window=20)
CODE = 5


class CountingEncoder(nn.Module):
    """Encodes with a linear layer and dropout, and notes how many maps it was given."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(2 * 20 * 20, CODE), nn.Dropout(0.5))
        self.counts: list[int] = []

    def forward(self, maps: torch.Tensor) -> torch.Tensor:  # noqa: D102
        self.counts.append(len(maps))
        return self.layers(maps)


def make_env(labels: tuple[int, ...] = (0, 1, 2), encoder: nn.Module | None = None, **kwargs) -> TransformedEnv:
    """Return an environment with a map and its code."""
    window = ConfidenceMap(CONFIG, num_rays=NUM_RAYS, max_range=MAX_RANGE)
    return TransformedEnv(ScanEnv(labels), Compose(window, EncodeMap(encoder or CountingEncoder(), **kwargs)))


class TestContract(TransformContract):
    """What holds for every transform."""

    tolerance = 1e-5  # GEMMs differ in the last bits with the size of the batch

    def make_transform(self) -> EncodeMap:  # noqa: D102
        return EncodeMap(CountingEncoder())

    def make_base_env(self, labels: tuple[int, ...]) -> EnvBase:  # noqa: D102
        return TransformedEnv(ScanEnv(labels), ConfidenceMap(CONFIG, num_rays=NUM_RAYS, max_range=MAX_RANGE))


class TestEncoder:
    """What is encoded, when, and how."""

    def test_writes_codes_in_the_encoders_precision(self) -> None:
        """Catches maps that a network in float64 refuses, and a spec that is not what is written."""
        env = make_env(encoder=CountingEncoder().double())
        codes = env.rollout(2)["latent"]
        assert codes.dtype == env.observation_spec["latent"].dtype == torch.float64

    def test_encodes_every_row_of_a_large_batch_at_its_place(self) -> None:
        """Catches pieces that are lost, swapped or overlap; 100 is no multiple of a piece."""
        encoder, maps = CountingEncoder(), torch.rand(10, 10, 2, 20, 20)
        codes = EncodeMap(encoder)(TensorDict(confidence_map=maps, batch_size=[10, 10]))["latent"]
        assert sum(encoder.counts) == 100
        assert max(encoder.counts) < 100
        expected = maps.flatten(2) @ encoder.layers[1].weight.T + encoder.layers[1].bias
        torch.testing.assert_close(codes, expected)

    def test_stays_frozen_and_in_evaluation_mode(self) -> None:
        """Catches dropout that turns on with env.train(), and an optimiser that could reach the weights."""
        encoder = CountingEncoder().train()
        env = make_env(encoder=encoder).train()
        assert not encoder.layers.training
        assert not any(parameter.requires_grad for parameter in encoder.parameters())
        env.transform.train()
        first, second = env.reset()["latent"], make_env(encoder=encoder).reset()["latent"]
        assert torch.equal(first, second)
        assert env.transform[1].training
        assert not encoder.training

    def test_no_gradient_is_recorded(self) -> None:
        """Catches a graph that grows over a rollout."""
        data = TensorDict({"confidence_map": torch.rand(3, 2, 20, 20, requires_grad=True)}, [3])
        assert not EncodeMap(CountingEncoder())(data)["latent"].requires_grad

    def test_a_partial_reset_encodes_only_the_rows_that_are_reset(self) -> None:
        """Catches a whole batch encoded for every single reset."""
        encoder = CountingEncoder()
        env = make_env(encoder=encoder)
        first = env.reset()
        encoder.counts.clear()
        mask = torch.tensor([[False], [True], [False]])
        after = env.reset(first.clone().set("_reset", mask))
        assert encoder.counts == [1]
        assert torch.equal(after["latent"][[0, 2]], first["latent"][[0, 2]])
        assert not torch.equal(after["latent"][1], first["latent"][1])

    def test_a_step_encodes_each_row_once(self) -> None:
        """Catches a second pass for the root."""
        encoder = CountingEncoder()
        env = make_env(encoder=encoder)
        carrier = env.reset()
        encoder.counts.clear()
        env.step(carrier.set("action", torch.zeros(3, 1)))
        assert encoder.counts == [3]

    @pytest.mark.parametrize("del_keys", [True, False])
    def test_the_map_travels_only_on_request(self, del_keys: bool) -> None:
        """Catches windows that fill the collector's memory, in the data and in the specs."""
        env = make_env(del_keys=del_keys)
        data = env.rollout(6, break_when_any_done=False)
        for part in (data, data["next"], env.observation_spec):
            assert ("confidence_map" in part.keys()) is not del_keys  # noqa: SIM118
        assert data["latent"].shape == (3, 6, CODE)

    def test_code_is_that_of_the_map(self) -> None:
        """Catches a code of the wrong row or the wrong time."""
        encoder = CountingEncoder()
        data = make_env(encoder=encoder, del_keys=False).rollout(8, break_when_any_done=False)
        for part in (data, data["next"]):
            expected = encoder(part["confidence_map"].flatten(0, 1)).view(3, 8, CODE)
            torch.testing.assert_close(part["latent"], expected, rtol=0.0, atol=1e-5)

    def test_encodes_samples_of_a_replay_buffer(self) -> None:
        """Catches a forward that works only in environments."""
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(8), batch_size=4, transform=EncodeMap(CountingEncoder(), del_keys=False)
        )
        buffer.extend(TensorDict({"confidence_map": torch.rand(8, 2, 20, 20)}, [8]))
        assert buffer.sample()["latent"].shape == (4, CODE)

    def test_encodes_one_map_without_a_batch(self) -> None:
        """Catches a batch dimension that is taken for granted."""
        transform, maps = EncodeMap(CountingEncoder()), torch.rand(2, 2, 20, 20)
        batch = transform(TensorDict(confidence_map=maps.clone(), batch_size=[2]))["latent"]
        single = transform(TensorDict(confidence_map=maps[1].clone()))["latent"]
        torch.testing.assert_close(single, batch[1])

    def test_an_environment_without_a_map_is_refused(self) -> None:
        """Catches a code of nothing."""
        with pytest.raises(KeyError, match="accepted: one that holds"):
            TransformedEnv(ScanEnv((0,)), EncodeMap(CountingEncoder())).rollout(1)
