"""What is compiled does what is written: few kernels on a GPU, loops on the CPU."""

from __future__ import annotations

import numba
import pytest
import torch

from cura_torchrl.compiled import compiled
from cura_torchrl.envs.sensors import MapGrid, map_tensors, noise, window
from cura_torchrl.envs.simulation import rays

GRID = MapGrid(extent_x=(-1.0, 3.0), extent_y=(-2.0, 2.0), resolution=0.1)
NUM_RAYS = 45


def see(mark_free, rows, device):
    """Mark what a scan of random ranges has seen."""
    generator = torch.Generator().manual_seed(rows)
    stamps = torch.rand(rows, GRID.num_rows, GRID.num_columns, generator=generator).mul_(9.0).floor_()
    scan, pose = torch.rand(rows, NUM_RAYS, generator=generator) * 3.0, torch.randn(rows, 3, generator=generator)
    inputs = [stamps, torch.full((rows,), 10.0), GRID.row_x(), GRID.column_y(), scan, pose]
    inputs = [tensor.to(device) for tensor in inputs]
    mark_free(*inputs, GRID.half_diagonal)
    return inputs[0]


def look(fill_windows, rows, device):
    """Cut windows out of random maps."""
    generator = torch.Generator().manual_seed(rows)
    maps = torch.rand(rows, GRID.num_rows, GRID.num_columns, generator=generator).mul_(20.0).floor_() / 2.0
    pose, object_pose = torch.randn(2, rows, 3, generator=generator)
    offsets, windows = window.window_offsets(16, 0.1), torch.empty(rows, 2, 16, 16, device=device)
    frames = [
        window.map_frame(GRID, offsets, pose),
        window.footprint_frame(offsets, pose, object_pose, torch.ones(rows, 2)),
    ]
    frames = [window.WindowFrame(*(terms.to(device) for terms in frame)) for frame in frames]
    tables = [torch.full((16, 16), 2.0, device=device), 0.9 ** torch.arange(8.0, device=device)]
    fill_windows(windows, GRID.inside(maps).to(device), torch.full((rows,), 10.0, device=device), *frames, *tables)
    return windows


def cast(nearest, rows, device):
    """Cast random rays at random squares."""
    generator = torch.Generator().manual_seed(rows)
    squares, directions = torch.randn(5, rows, 3, generator=generator), torch.randn(2, rows, NUM_RAYS)
    squares[4].abs_()
    return nearest(squares.to(device), *directions.to(device))


def draw(normal, rows, device):
    """Draw the noise of some episodes."""
    key = noise.noise_key(0, 0, torch.arange(rows, device=device))
    return normal(key, torch.arange(rows, device=device), NUM_RAYS)


CASES = [
    pytest.param(see, map_tensors._mark_free, id="free"),
    pytest.param(look, map_tensors._fill_windows, id="windows"),
    pytest.param(cast, rays._nearest, id="rays"),
    pytest.param(draw, noise.normal, id="noise"),
]


@pytest.mark.parametrize(("play", "function"), CASES)
def test_a_function_is_one_graph_for_any_number_of_rows(play, function):
    """Catches an operation that the compiler leaves out or takes as fixed: each batch would be compiled anew."""
    graphs = []

    def backend(module, _):
        graphs.append(module)
        return module

    compiled = torch.compile(function.__wrapped__, backend=backend, fullgraph=True, dynamic=True)
    for rows in (7, 9, 4):
        torch.manual_seed(0)
        expected = play(function.__wrapped__, rows, "cpu")
        torch.manual_seed(0)
        assert torch.equal(play(compiled, rows, "cpu"), expected)
    assert len(graphs) == 1


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize(("play", "function"), CASES)
def test_a_gpu_fuses_to_what_is_written(play, function):
    """Catches kernels that differ from the operations they are made of by more than cells on a border."""
    for rows in (3, 5):
        torch.manual_seed(0)
        expected = play(function.__wrapped__, rows, "cpu")
        torch.manual_seed(0)
        is_same = (play(function, rows, "cuda").cpu() - expected).abs() < 1e-5
        assert is_same.float().mean() > 0.999


def test_without_a_folder_to_write_functions_are_compiled_anew(monkeypatch):
    """Catches an import that fails in a container whose user can write neither the package's folder nor a home."""
    njit = numba.njit
    njit(lambda: 0)()  # numba imports parts of itself, which it compiles too, with the first function

    def nowhere(*, cache, **options):
        def refuse(function):
            msg = f"cannot cache function {function.__name__!r}: no locator available"
            raise RuntimeError(msg)

        return refuse if cache else njit(cache=False, **options)

    monkeypatch.setattr(numba, "njit", nowhere)
    assert compiled(lambda number: number + 1)(1) == 2
