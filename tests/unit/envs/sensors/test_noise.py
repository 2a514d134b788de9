"""Draws that depend on key and counter alone."""

from __future__ import annotations

import torch
from scipy import stats

from cura_torchrl.envs.sensors.noise import noise_key, normal

EPISODES = torch.arange(3)
FIRST = torch.zeros(3, dtype=torch.int64)


def test_the_draws_are_normal():
    """Catches a wrong scale, correlated fields and a bias, with the Kolmogorov-Smirnov test."""
    draws = normal(noise_key(0, 1, torch.arange(200)), torch.zeros(200, dtype=torch.int64), 360)
    assert stats.kstest(draws.flatten().numpy(), "norm").pvalue > 0.01
    neighbours = torch.corrcoef(torch.stack([draws[:, :-1].flatten(), draws[:, 1:].flatten()]))[0, 1]
    assert abs(neighbours.item()) < 0.015


def test_every_part_of_the_key_counts():
    """Catches two streams, seeds, episodes or scans that share their noise."""
    keys = [noise_key(stream, seed, EPISODES) for stream in range(3) for seed in (-1, 0, 1, 2**63, 2**64 + 2)]
    scans = torch.cat([normal(key, FIRST + count, 8) for key in keys for count in range(2)])
    assert len(scans.unique(dim=0)) == len(scans)
    assert len(scans.flatten().unique()) > 0.99 * scans.numel()


def test_a_row_does_not_depend_on_the_others():
    """Catches draws that are counted over the batch."""
    both = normal(noise_key(0, 0, EPISODES), FIRST + 7, 360)
    alone = normal(noise_key(0, 0, EPISODES[2:]), FIRST[:1] + 7, 360)
    assert torch.equal(both[2:], alone)


def test_scans_follow_one_another_without_overlap():
    """Catches a counter that starts each scan one draw later."""
    key = noise_key(2, 5, EPISODES[:1])
    long = normal(key, FIRST[:1], 20)
    assert torch.equal(normal(key, FIRST[:1] + 1, 10)[0], long[0, 10:])
