"""Modules that draw random numbers of their own."""

from __future__ import annotations

import torch
from torch import nn


class SeededModule(nn.Module):
    """A module with a random generator that is saved with its state, so that a resumed run equals an unbroken one.

    Examples:
        >>> module, other = SeededModule(), SeededModule()
        >>> module.seed(0), other.seed(1)
        (None, None)
        >>> other.load_state_dict(module.state_dict())
        <All keys matched successfully>
        >>> torch.equal(*(torch.rand(3, generator=each.generator) for each in (module, other)))
        True
    """

    generator: torch.Generator
    """On the CPU."""

    def seed(self, seed: int) -> None:
        """Begin the sequence of random numbers.

        Args:
            seed: Which sequence.
        """
        self.generator = torch.Generator().manual_seed(seed)

    def get_extra_state(self) -> torch.Tensor:
        """Return the generator's state."""
        return self.generator.get_state()

    def set_extra_state(self, state: torch.Tensor) -> None:
        """Restore the generator's state.

        Args:
            state: What :meth:`get_extra_state` returned.
        """
        self.generator.set_state(state.cpu())
