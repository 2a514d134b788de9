"""The map's autoencoder: shapes, loss by hand, round trip, and that it can learn."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from cura_torchrl.modules.map_vae import MapVAE, map_vae_loss

if TYPE_CHECKING:
    from pathlib import Path


def small(**kwargs) -> MapVAE:
    """Return an autoencoder of small maps."""
    return MapVAE(**({"latent_size": 4, "window": 20, "widths": (4, 8, 8), "patch": (4, 4)} | kwargs))


class TestLoss:
    """The loss against sums worked out by hand."""

    def test_reconstruction_is_the_weighted_cross_entropy(self) -> None:
        """Catches a weight on the wrong channel or cells, and a mean instead of the sum."""
        # One map, two channels, one cell each. Log-odds ln 3 is probability 3/4.
        logits = torch.full((1, 2, 1, 2), math.log(3.0))
        maps = torch.tensor([[[[0.5, 0.0]], [[1.0, 0.0]]]])
        terms = map_vae_loss(
            logits, torch.zeros(1, 1), torch.zeros(1, 1), maps, beta=1.0, occupancy_weight=2.0, occupied_weight=5.0
        )
        hit, miss = -math.log(0.75), -math.log(0.25)
        # Confidence: 0.5 costs (hit + miss) / 2, 0 costs miss. Occupancy: 2 * 5 * hit for the 1, 2 * miss for the 0.
        expected = (hit + miss) / 2 + miss + 10 * hit + 2 * miss
        assert terms.reconstruction.item() == pytest.approx(expected, rel=1e-6)
        assert terms.total.item() == pytest.approx(expected, rel=1e-6)

    def test_divergence_is_the_closed_form(self) -> None:
        """Catches a wrong sign or factor, and a sum over the batch instead of its mean."""
        mean = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
        log_variance = torch.tensor([[0.0, math.log(2.0)], [0.0, 0.0]])
        terms = map_vae_loss(
            torch.zeros(2, 1, 1, 1),
            mean,
            log_variance,
            torch.zeros(2, 1, 1, 1),
            beta=3.0,
            occupancy_weight=1.0,
            occupied_weight=1.0,
        )
        # KL(N(1, 1)) = 1/2; KL(N(0, 2)) = (2 - 1 - ln 2) / 2; averaged over two maps.
        divergence = (0.5 + 0.5 * (1.0 - math.log(2.0))) / 2
        assert terms.divergence.item() == pytest.approx(divergence, rel=1e-6)
        assert terms.total.item() == pytest.approx(math.log(2.0) + 3.0 * divergence, rel=1e-6)

    def test_gradient_is_right(self) -> None:
        """Catches a detached term."""
        inputs = [torch.randn(2, 2, 3, 3), torch.randn(2, 4), torch.randn(2, 4)]
        inputs = [value.double().requires_grad_() for value in inputs]
        maps = torch.rand(2, 2, 3, 3).round().double()

        def total(logits: torch.Tensor, mean: torch.Tensor, log_variance: torch.Tensor) -> torch.Tensor:
            return map_vae_loss(
                logits, mean, log_variance, maps, beta=0.5, occupancy_weight=3.0, occupied_weight=2.0
            ).total

        assert torch.autograd.gradcheck(total, inputs)


class TestMapVAE:
    """The networks."""

    @pytest.mark.parametrize("window", [20, 33, 50, 100])
    @pytest.mark.parametrize("channels", [1, 2])
    def test_reconstructions_have_the_maps_shape(self, window: int, channels: int) -> None:
        """Catches a stride that rounds a cell away."""
        vae = small(window=window, channels=channels)
        shown = vae.reconstruct(torch.rand(3, channels, window, window))
        assert shown.shape == (3, channels, window, window)
        assert ((shown >= 0) & (shown <= 1)).all()

    def test_layers_are_those_of_the_design(self) -> None:
        """Catches a layer that makes the encoder slower: 4x4 stride 4 to 16, 3x3 stride 2 to 32, then 64."""
        convolutions = [layer for layer in MapVAE().trunk if isinstance(layer, torch.nn.Conv2d)]
        found = [(c.in_channels, c.out_channels, c.kernel_size[0], c.stride[0]) for c in convolutions]
        assert found == [(2, 16, 4, 4), (16, 32, 3, 2), (32, 64, 3, 2)]
        assert MapVAE().latent_size == 32

    @pytest.mark.parametrize("window", [20, 33, 100])
    def test_every_cell_reaches_the_code(self, window: int) -> None:
        """Catches patches that leave out the window's last cells."""
        maps = torch.rand(1, 2, window, window, requires_grad=True)
        MapVAE(window=window, activation="elu").encode(maps).square().sum().backward()
        assert (maps.grad != 0).all()

    def test_impossible_shapes_are_refused(self) -> None:
        """Catches an activation or a depth that fails later, without a word."""
        with pytest.raises(ValueError, match="accepted: relu, elu"):
            MapVAE(activation="tanh")
        with pytest.raises(ValueError, match="3 numbers"):
            MapVAE(widths=(8, 8))

    def test_the_code_is_the_mean(self) -> None:
        """Catches a code that is sampled, or the wrong half of the head."""
        vae, maps = small().eval(), torch.rand(5, 2, 20, 20)
        mean, log_variance = vae.statistics(maps)
        torch.testing.assert_close(vae(maps), mean, rtol=0.0, atol=1e-6)
        torch.testing.assert_close(vae.encode(maps), mean, rtol=0.0, atol=1e-6)
        assert mean.shape == log_variance.shape == (5, 4)

    @pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
    def test_memory_format_changes_nothing(self, memory_format: torch.memory_format) -> None:
        """Catches a reshape that mixes cells up."""
        vae, maps = small(), torch.rand(5, 2, 20, 20)
        expected = vae(maps.contiguous())
        torch.testing.assert_close(vae(maps.contiguous(memory_format=memory_format)), expected, rtol=0.0, atol=1e-5)

    def test_each_cell_is_painted_in_its_place(self) -> None:
        """Catches tiles that are transposed or swapped."""
        vae = small(channels=1)
        tiles = vae.decoder[-1]
        with torch.no_grad():
            tiles.paint.weight.zero_()
            tiles.paint.bias.copy_(torch.arange(16.0))
        shown = tiles(torch.zeros(1, 4, 5, 5))[0, 0]
        # Cell (i, j) is row i mod 4, column j mod 4 of its tile.
        expected = 4 * (torch.arange(20) % 4)[:, None] + torch.arange(20) % 4
        assert torch.equal(shown, expected.float())

    def test_is_a_tensordict_module(self) -> None:
        """Catches a forward that returns more than the code."""
        module = TensorDictModule(small(), in_keys=["confidence_map"], out_keys=["latent"])
        data = module(TensorDict({"confidence_map": torch.rand(3, 2, 20, 20)}, [3]))
        assert data["latent"].shape == (3, 4)

    def test_saved_weights_come_back(self, tmp_path: Path) -> None:
        """Catches sizes that are not stored, and a network that comes back in training mode."""
        vae, maps = small(latent_size=6), torch.rand(2, 2, 20, 20)
        vae.save(str(tmp_path / "vae.pt"))
        loaded = MapVAE.load(tmp_path / "vae.pt")
        assert not loaded.training
        assert torch.equal(loaded(maps), vae(maps))
        assert [path.name for path in tmp_path.iterdir()] == ["vae.pt"]

    def test_learns_where_a_block_is(self) -> None:
        """Catches a loss that does not train: one block at 16 places has to come back where it was."""
        maps = torch.zeros(16, 2, 20, 20)
        for place in range(16):
            row, column = 1 + 5 * (place // 4), 1 + 5 * (place % 4)
            maps[place, 1, row : row + 3, column : column + 3] = 1.0
        vae = small(latent_size=8, widths=(8, 16, 16), patch=(2, 2))
        optimiser = torch.optim.Adam(vae.parameters(), lr=5e-3)
        for _ in range(300):
            mean, log_variance = vae.statistics(maps)
            logits = vae.decode(mean + torch.randn_like(mean) * (0.5 * log_variance).exp())
            loss = map_vae_loss(logits, mean, log_variance, maps, beta=0.1, occupancy_weight=1.0, occupied_weight=5.0)
            optimiser.zero_grad()
            loss.total.backward()
            optimiser.step()
        found = vae.reconstruct(maps)[:, 1] > 0.5
        assert (found & (maps[:, 1] > 0.5)).sum() / maps[:, 1].sum() > 0.9
        assert found.sum() < 1.5 * maps[:, 1].sum()
