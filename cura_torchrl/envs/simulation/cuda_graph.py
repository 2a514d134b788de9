"""Work on tensors that stay where they are, captured once and replayed by one launch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_TRIALS = 2
"""Runs before the capture [1]."""


class CudaGraph:
    """Replays work on a CUDA device; on small tensors launching takes longer than computing.

    Args:
        work: What to do. It reads and writes tensors that keep their memory, waits for nothing of the device, and does
            the same each time.
        state: The tensors that it changes: capturing needs trials, after which they are put back.

    Source:
        NVIDIA's CUDA graphs, <https://pytorch.org/blog/accelerating-pytorch-with-cuda-graphs/>.
    """

    def __init__(self, work: Callable[[], None], state: Iterable[torch.Tensor]) -> None:
        before = [(tensor, tensor.clone()) for tensor in state]
        # On a stream of its own: libraries allocate their work space at the first call, which a capture cannot hold.
        stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            for _ in range(_TRIALS):
                work()
        current.wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            work()
        for tensor, value in before:
            tensor.copy_(value)

    def replay(self) -> None:
        """Do the work once more."""
        self._graph.replay()
