"""Fixtures that every test may use."""

from __future__ import annotations

import pytest
import torch

# Tests run in several processes (pytest-xdist): more threads than one each would only get in each other's way.
torch.set_num_threads(1)


@pytest.fixture
def generator() -> torch.Generator:
    """A seeded generator, so that a failure can be repeated whatever the order of the tests."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(autouse=True)
def _seeded_torch() -> None:
    """Networks initialise from torch's global generator, which pytest-randomly does not seed."""
    torch.manual_seed(0)
