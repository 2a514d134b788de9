"""Variational autoencoder of the confidence map, small enough to run once per environment step on one core."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import nn
from torch.nn import functional as F  # noqa: N812

if TYPE_CHECKING:
    from collections.abc import Sequence

_ACTIVATIONS = {"relu": nn.ReLU, "elu": nn.ELU}


class MapLoss(NamedTuple):
    """Terms of the autoencoder's loss, averaged over the batch."""

    total: torch.Tensor
    """What is minimised: reconstruction + beta * divergence [nat], scalar."""
    reconstruction: torch.Tensor
    """Weighted binary cross-entropy, summed over a map [nat], scalar."""
    divergence: torch.Tensor
    """KL divergence of the code's distribution from the standard normal, summed over the code [nat], scalar."""


def map_vae_loss(
    logits: torch.Tensor,
    mean: torch.Tensor,
    log_variance: torch.Tensor,
    maps: torch.Tensor,
    *,
    beta: float,
    occupancy_weight: float,
    occupied_weight: float,
) -> MapLoss:
    """Return the loss of a variational autoencoder of maps.

    The reconstruction is a binary cross-entropy in all cells and channels. An obstacle fills few of the cells: the last
    channel, which tells where it is (the occupancy, or the product), counts more than the confidence, so that the code
    is spent on it, and occupied cells count more than the others, so that they are found. A map of confidence alone
    wants both weights to be 1.

    Args:
        logits: Decoder's output, log-odds [1], shape ``[B, C, H, W]``.
        mean: Mean of the code [1], shape ``[B, L]``.
        log_variance: Logarithm of the code's variance [1], shape ``[B, L]``.
        maps: Target in [0, 1], shape ``[B, C, H, W]``.
        beta: Weight of the divergence [1].
        occupancy_weight: Weight of the last channel; others have weight 1 [1].
        occupied_weight: Weight of a cell of the last channel whose target is 1, beside those whose target is 0 [1].

    Returns:
        The terms.

    Source:
        Kingma and Welling (2014), Eq. (10) <https://arxiv.org/abs/1312.6114>; beta as in Higgins et al. (2017).

    Examples:
        >>> nothing = torch.zeros(1, 2)
        >>> loss = map_vae_loss(
        ...     torch.zeros(1, 1, 1, 2),
        ...     nothing,
        ...     nothing,
        ...     torch.tensor([[[[0.0, 1.0]]]]),
        ...     beta=1.0,
        ...     occupancy_weight=2.0,
        ...     occupied_weight=3.0,
        ... )
        >>> round(loss.reconstruction.item() / torch.tensor(2.0).log().item(), 4), loss.divergence.item()
        (8.0, 0.0)
    """
    weight = torch.ones_like(maps)
    weight[:, -1].add_(maps[:, -1], alpha=occupied_weight - 1.0).mul_(occupancy_weight)
    entropy = F.binary_cross_entropy_with_logits(logits, maps, weight=weight, reduction="sum") / len(maps)
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance).sum() / len(maps)
    return MapLoss(entropy + beta * divergence, entropy, divergence)


class MapVAE(nn.Module):
    """Encodes maps into short codes and decodes codes into maps.

    The encoder is a convolution whose stride is what makes it fast, and two 3 x 3 convolutions with stride 2, each
    followed by an activation, then a linear layer to mean and log-variance. The decoder mirrors it, but in the end each
    pixel paints a tile of cells of its own, which is faster than a transposed convolution. As a module it returns the
    mean, so that an instance is an encoder for :class:`~cura_torchrl.envs.transforms.EncodeMap`, or for
    ``TensorDictModule(vae, [keys.CONFIDENCE_MAP], [keys.LATENT])``.

    Args:
        latent_size: Length L of the code [1].
        channels: Channels C of a map [1].
        window: Cells along a map's edge W [1].
        widths: Channels after each of the three convolutions [1].
        patch: Kernel and stride of the first convolution [1].
        activation: ``"relu"`` or ``"elu"``.

    Raises:
        ValueError: If ``widths`` are not three, or the activation is another.

    Source:
        Paper, section "Sensor Encoding"; layers: measured for speed, the paper names none.

    Examples:
        >>> vae = MapVAE()
        >>> maps = torch.zeros(3, 2, 100, 100)
        >>> vae(maps).shape, vae.reconstruct(maps).shape
        (torch.Size([3, 32]), torch.Size([3, 2, 100, 100]))
    """

    def __init__(
        self,
        *,
        latent_size: int = 32,
        channels: int = 2,
        window: int = 100,
        widths: Sequence[int] = (16, 32, 64),
        patch: tuple[int, int] = (4, 4),
        activation: str = "relu",
    ) -> None:
        super().__init__()
        if len(widths) != 3:
            msg = f"widths are {tuple(widths)}; accepted: 3 numbers of channels"
            raise ValueError(msg)
        if activation not in _ACTIVATIONS:
            msg = f"activation is {activation!r}; accepted: {', '.join(_ACTIVATIONS)}"
            raise ValueError(msg)
        self.shape = {
            "latent_size": latent_size,
            "channels": channels,
            "window": window,
            "widths": tuple(widths),
            "patch": tuple(patch),
            "activation": activation,
        }
        act = _ACTIVATIONS[activation]
        kernels, strides = (patch[0], 3, 3), (patch[1], 2, 2)
        # Patches that tile the window need no padding.
        paddings = (0 if window % patch[0] == 0 and patch[0] == patch[1] else patch[0] // 2, 1, 1)
        sizes = [window]
        for kernel, stride, padding in zip(kernels, strides, paddings, strict=True):
            sizes.append((sizes[-1] + 2 * padding - kernel) // stride + 1)
        planes = [channels, *widths]
        features = planes[-1] * sizes[-1] ** 2
        layers: list[nn.Module] = []
        for i in range(3):
            layers += [nn.Conv2d(planes[i], planes[i + 1], kernels[i], strides[i], paddings[i]), act()]
        self.trunk = nn.Sequential(*layers, nn.Flatten())
        self.statistics_head = nn.Linear(features, 2 * latent_size)
        layers = [nn.Linear(latent_size, features), act(), nn.Unflatten(1, (planes[-1], sizes[-1], sizes[-1]))]
        for i in (2, 1):
            # What a convolution with this stride has rounded away, the transposed one has to add.
            rest = sizes[i] - ((sizes[i + 1] - 1) * strides[i] + 1)
            layers += [
                nn.ConvTranspose2d(planes[i + 1], planes[i], kernels[i], strides[i], 1, output_padding=rest),
                act(),
            ]
        self.decoder = nn.Sequential(*layers, _Tiles(planes[1], channels, patch[1], window))
        # Channels last suits the CPU's convolutions; most of all with few channels.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @property
    def latent_size(self) -> int:
        """Length L of the code."""
        return self.statistics_head.out_features // 2

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Return the code that is fed to policies, as :meth:`encode`.

        Args:
            maps: Maps in [0, 1], shape ``[*, C, W, W]``.

        Returns:
            Codes, shape ``[*, L]``.
        """
        return self.encode(maps)

    def encode(self, maps: torch.Tensor) -> torch.Tensor:
        """Return the mean of the code's distribution.

        Args:
            maps: Maps in [0, 1], shape ``[*, C, W, W]``.

        Returns:
            Codes, shape ``[*, L]``.
        """
        weight, bias = self.statistics_head.weight, self.statistics_head.bias
        return F.linear(self._features(maps), weight[: self.latent_size], bias[: self.latent_size])

    def statistics(self, maps: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and log-variance of the code's distribution.

        Args:
            maps: Maps in [0, 1], shape ``[*, C, W, W]``.

        Returns:
            Mean and logarithm of the variance, both of shape ``[*, L]``.
        """
        mean, log_variance = self.statistics_head(self._features(maps)).chunk(2, -1)
        return mean, log_variance

    def decode(self, codes: torch.Tensor) -> torch.Tensor:
        """Return what the decoder makes of codes.

        Args:
            codes: Codes, shape ``[B, L]``.

        Returns:
            Log-odds of the maps [1], shape ``[B, C, W, W]``.
        """
        return self.decoder(codes)

    def reconstruct(self, maps: torch.Tensor) -> torch.Tensor:
        """Return what is left of maps after encoding and decoding.

        Args:
            maps: Maps in [0, 1], shape ``[B, C, W, W]``.

        Returns:
            Maps in [0, 1], shape ``[B, C, W, W]``.
        """
        return torch.sigmoid(self.decode(self.encode(maps)))

    def save(self, path: Path | str) -> None:
        """Write sizes and weights; the file appears whole or not at all.

        Args:
            path: File to write.
        """
        path = Path(path)
        partial = path.with_name(f"{path.name}.partial")
        torch.save({"shape": self.shape, "state_dict": self.state_dict()}, partial)
        partial.replace(path)

    @classmethod
    def load(cls, path: Path | str) -> MapVAE:
        """Return the autoencoder that :meth:`save` has written, in evaluation mode, on the CPU.

        Args:
            path: File to read; nothing in it is run.

        Returns:
            The autoencoder.
        """
        stored = torch.load(path, map_location="cpu", weights_only=True)
        vae = cls(**stored["shape"])
        vae.load_state_dict(stored["state_dict"])
        return vae.eval()

    def _features(self, maps: torch.Tensor) -> torch.Tensor:
        rows = maps.reshape(-1, *maps.shape[-3:]).contiguous(memory_format=torch.channels_last)
        return self.trunk(rows).view(*maps.shape[:-3], -1)


class _Tiles(nn.Module):
    """Paints each pixel as a tile of cells, then cuts the map to size."""

    def __init__(self, in_channels: int, out_channels: int, edge: int, window: int) -> None:
        super().__init__()
        self.paint = nn.Linear(in_channels, out_channels * edge**2)
        self.out_channels, self.edge, self.window = out_channels, edge, window

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        tiles = self.paint(pixels.permute(0, 2, 3, 1)).unflatten(-1, (self.out_channels, self.edge, self.edge))
        maps = tiles.permute(0, 3, 1, 4, 2, 5).flatten(2, 3).flatten(3, 4)
        return maps[..., : self.window, : self.window]
