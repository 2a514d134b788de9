"""The vectorised generator against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from cura_torchrl.envs.mdp.philox import counter_uniforms


@pytest.mark.parametrize("key", [(0, 0), (1, 2), (2**63, 1), (2**64 - 1, 2**64 - 1)])
def test_uniforms_equal_numpys_philox(key: tuple[int, int]):
    """Catches a wrong carry, round key or word order: NumPy's generator is an independent implementation."""
    index = np.array([0, 1, 12345, 2**62])
    ours = counter_uniforms(key, index, 11)
    for row, episode in enumerate(index):
        bits = np.random.Philox(key=np.array(key, dtype=np.uint64), counter=[0, int(episode), 0, 0])
        np.testing.assert_array_equal(ours[row], np.random.Generator(bits).random(11))


def test_first_uniforms_do_not_depend_on_the_count():
    """Catches draws that shift when more are asked for, which would change every scene with the number of fallbacks."""
    index = np.arange(5)
    np.testing.assert_array_equal(counter_uniforms((3, 0), index, 40)[:, :9], counter_uniforms((3, 0), index, 9))
