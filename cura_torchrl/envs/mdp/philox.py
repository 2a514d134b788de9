"""Counter-based uniform draws: Philox4x64-10 over a whole batch of counters at once.

The same numbers as ``numpy.random.Generator(numpy.random.Philox(key=..., counter=...)).random(count)``, without one
generator object per row.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_Words = npt.NDArray[np.uint64]

_MULTIPLIERS = (0xD2E7470EE14C6C93, 0xCA5A826395121157)
_WEYL = (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)
_ROUNDS = 10
_MASK = (1 << 64) - 1
_HALF = np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)


def _multiply(words: _Words, factor: int) -> tuple[_Words, _Words]:
    """Return the high and the low 64 bits of the 128-bit products."""
    factor_high, factor_low = np.uint64(factor >> 32), np.uint64(factor & 0xFFFFFFFF)
    high, low = words >> _HALF, words & _LOW
    cross = high * factor_low + ((low * factor_low) >> _HALF)
    cross_low = low * factor_high + (cross & _LOW)
    return high * factor_high + (cross >> _HALF) + (cross_low >> _HALF), words * np.uint64(factor)


def _blocks(counter: tuple[_Words, _Words], key: tuple[int, int]) -> _Words:
    word0, word1 = counter
    word2 = word3 = np.zeros_like(word0)
    for step in range(_ROUNDS):
        key0, key1 = (np.uint64((k + step * weyl) & _MASK) for k, weyl in zip(key, _WEYL, strict=True))
        high0, low0 = _multiply(word0, _MULTIPLIERS[0])
        high1, low1 = _multiply(word2, _MULTIPLIERS[1])
        word0, word1, word2, word3 = high1 ^ word1 ^ key0, low1, high0 ^ word3 ^ key1, low0
    return np.stack((word0, word1, word2, word3), -1)


def counter_uniforms(key: tuple[int, int], index: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.float64]:
    """Return uniform numbers that are a pure function of a key and an index.

    The first numbers of a row do not depend on how many are asked for.

    Args:
        key: Two words that name the stream, each from 0 to ``2**64 - 1``.
        index: Which sequence of the stream, shape ``[B]``.
        count: Numbers per sequence [1].

    Returns:
        Numbers in [0, 1) [1], shape ``[B, count]``.

    Source:
        Philox4x64-10, Salmon et al. (2011), "Parallel random numbers: as easy as 1, 2, 3".

    Examples:
        >>> ours = counter_uniforms((7, 1), np.array([5]), 3)[0]
        >>> bits = np.random.Philox(key=np.array([7, 1], dtype=np.uint64), counter=[0, 5, 0, 0])
        >>> bool((ours == np.random.Generator(bits).random(3)).all())
        True
    """
    num_blocks = -(-count // 4)
    # NumPy's generator increments its counter before it produces a block, hence the count from one.
    block, row = np.broadcast_arrays(
        np.arange(1, num_blocks + 1, dtype=np.uint64)[None, :], index.astype(np.uint64)[:, None]
    )
    words = _blocks((block, row), key).reshape(len(index), 4 * num_blocks)[:, :count]
    return (words >> np.uint64(11)).astype(np.float64) * 2.0**-53
