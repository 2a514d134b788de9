"""Loops compiled for the CPU by numba, and tensor operations fused for a GPU by torch: how, and on how many threads."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numba
import numpy as np
import numpy.typing as npt
import torch

if TYPE_CHECKING:
    from collections.abc import Callable

Floats: TypeAlias = npt.NDArray[np.float32]
Doubles: TypeAlias = npt.NDArray[np.float64]
Ints: TypeAlias = npt.NDArray[np.int32]

_Function = TypeVar("_Function", bound="Callable[..., Any]")


def compiled(function: _Function) -> _Function:
    """Compile a function on its first call, and keep the result for the next process where a folder can be written.

    Sums keep their order and functions their precision: what a row of a batch comes to must not depend on its
    neighbours in a vector.

    Args:
        function: Function of arrays and numbers.

    Returns:
        The compiled function, which runs without Python's lock.
    """
    compiles = functools.partial(
        numba.njit, nogil=True, error_model="numpy", fastmath={"nnan", "ninf", "nsz", "contract"}
    )
    try:
        return compiles(cache=True)(function)  # type: ignore[return-value]
    except RuntimeError:  # neither the package's folder nor the home can be written
        return compiles(cache=False)(function)  # type: ignore[return-value]


def fused(function: _Function) -> _Function:
    """Make few kernels of a function's tensor operations on a GPU: what is between them then stays in registers.

    Compiled when first called there, and once more for any number of rows when a second one comes. Without Triton, and
    on other devices, the operations run as they are written.

    Args:
        function: Function of tensors, of which the first tells the device, and constants.

    Returns:
        The function; compiled, its results differ by rounding.
    """

    @functools.cache
    def kernels() -> Callable[..., Any]:
        return torch.compile(function) if find_spec("triton") else function

    @functools.wraps(function)
    def run(first: torch.Tensor, *rest: Any) -> Any:
        return (kernels() if first.is_cuda else function)(first, *rest)

    return run  # type: ignore[return-value]


def run_rows(kernel: Callable[..., None], batch: tuple[torch.Tensor, ...], *constants: Any) -> None:
    """Run a kernel on as many threads as torch has, each with some rows of the batch.

    Args:
        kernel: Compiled function of the batch's arrays, then the constants; it writes into some of the arrays.
        batch: Tensors on the CPU with the same first dimension.
        *constants: What all rows share.
    """
    arrays = [tensor.numpy() for tensor in batch]
    threads = min(torch.get_num_threads(), len(arrays[0]))
    if threads <= 1:
        kernel(*arrays, *constants)
        return
    bounds = np.linspace(0, len(arrays[0]), threads + 1).astype(int)
    parts = [[array[low:high] for array in arrays] for low, high in pairwise(bounds)]
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda part: kernel(*part, *constants), parts):
            pass
