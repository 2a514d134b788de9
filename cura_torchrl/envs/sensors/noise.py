"""Normal draws that are a pure function of a key and a counter: no state, no batch, any device.

A generator's state would tie a world's noise to the batch that it is drawn with, and one generator a world is a Python
loop and a copy from the host in every step.
"""

from __future__ import annotations

import math

import torch

from cura_torchrl.compiled import fused

_GOLDEN = 0x9E3779B97F4A7C15 - 2**64  # odd; int64 arithmetic wraps
_MULTIPLIERS = (0xBF58476D1CE4E5B9 - 2**64, 0x94D049BB133111EB - 2**64)


def _mix(value: torch.Tensor) -> torch.Tensor:
    """Return well-mixed bits of integers, one to one.

    Source:
        Steele, Lea and Flood (2014), "Fast splittable pseudorandom number generators": SplitMix64's finaliser.
    """
    value = (value ^ _shift(value, 30)) * _MULTIPLIERS[0]
    value = (value ^ _shift(value, 27)) * _MULTIPLIERS[1]
    return value ^ _shift(value, 31)


def _shift(value: torch.Tensor, bits: int) -> torch.Tensor:
    # int64 shifts repeat the sign: the mask drops it.
    return (value >> bits) & (2 ** (64 - bits) - 1)


def noise_key(stream: int, seed: int, episodes: torch.Tensor) -> torch.Tensor:
    """Return a key for each episode.

    Args:
        stream: Index of the stream of scenarios.
        seed: Seed, any integer; only its lower 64 bits count.
        episodes: Episode indices, int64, shape ``[B]``.

    Returns:
        Keys, int64, shape ``[B]``.
    """
    low = seed & (2**64 - 1)
    words = torch.tensor([low - 2**64 if low >= 2**63 else low, stream], device=episodes.device)
    key = torch.zeros_like(episodes)
    for word in (*words, episodes):
        key = _mix(key + (word + 1) * _GOLDEN)
    return key


@fused
def normal(key: torch.Tensor, count: torch.Tensor, size: int) -> torch.Tensor:
    """Return standard normal draws.

    Args:
        key: Key of each row, int64, shape ``[B]``.
        count: How many times a row has drawn before, int64, shape ``[B]``.
        size: Draws a row K.

    Returns:
        Draws, at most 5.8 in size, float64, shape ``[B, K]``.

    Source:
        Box and Muller (1958), from two of a mixed counter's 24-bit fields.

    Examples:
        >>> key = noise_key(0, 0, torch.arange(2))
        >>> draws = normal(key, torch.zeros(2, dtype=torch.int64), 1000)
        >>> bool(draws.mean().abs() < 0.1), bool((draws.std() - 1).abs() < 0.1)
        (True, True)
    """
    index = count[:, None] * size + torch.arange(1, size + 1, device=key.device)
    bits = _mix(key[:, None] + index * _GOLDEN)
    radius = ((_shift(bits, 40) + 1).double() * 2.0**-24).log().mul_(-2.0).sqrt_()
    return radius * ((_shift(bits, 16) & (2**24 - 1)).double() * (2.0 * math.pi * 2.0**-24)).cos_()
