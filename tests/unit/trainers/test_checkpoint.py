"""A checkpoint is whole, or it is refused in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from torch import nn

from cura_torchrl.trainers.checkpoint import (
    CHECKPOINT_FOLDER,
    find_checkpoint,
    progress_path,
    read_config,
    restore,
    save_checkpoint,
    sweep,
)
from cura_torchrl.trainers.errors import CheckpointError
from cura_torchrl.trainers.methods import method


def save(folder: Path, frames: int, **options: int) -> tuple[Path, nn.Module]:
    """Save a small network and return it."""
    network = nn.Linear(3, 2)
    return save_checkpoint({"networks": network}, method("push"), folder, frames=frames, **options), network


def files_of(folder: Path) -> list[Path]:
    """All files of a checkpoint."""
    return sorted(entry for entry in folder.rglob("*") if entry.is_file())


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A checkpoint."""
    return save(tmp_path, 100)[0]


def refused(path: Path) -> str:
    """Return the line with which a checkpoint is refused."""
    with pytest.raises(CheckpointError) as caught:
        find_checkpoint(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    """Catches a checkpoint that loads but holds something else."""
    path, network = save(tmp_path, 128)
    other = nn.Linear(3, 2)
    restore(find_checkpoint(tmp_path), {"networks": other})
    assert torch.equal(other.weight, network.weight)
    config, record = read_config(path)
    assert config == method("push")
    assert (record["frames"], record["seed"]) == (128, 0)
    assert {"versions", "commit"} <= set(record)


def test_what_a_gpu_saved_comes_back_without_one(saved: Path) -> None:
    """Catches weights that only a machine with a GPU can load."""
    (state,) = saved.glob("components/*networks/state.json")
    content = state.read_text(encoding="utf-8")
    assert '"device":"cpu"' in content
    state.write_text(content.replace('"device":"cpu"', '"device":"cuda:0"'), encoding="utf-8")
    network = nn.Linear(3, 2)
    before = network.weight.clone()
    restore(saved, {"networks": network})
    assert network.weight.device.type == "cpu"
    assert not torch.equal(network.weight, before)


def test_no_file_is_a_pickle(saved: Path) -> None:
    """Catches a format that runs code when it is loaded."""
    # Pickles of protocol 2 and later start with 0x80; torch.save writes a zip that holds data.pkl.
    for file in files_of(saved):
        content = file.read_bytes()
        assert not content.startswith(b"\x80")
        assert b"data.pkl" not in content


@pytest.mark.parametrize("index", range(5))
def test_a_changed_bit_is_found_in_every_file(saved: Path, index: int) -> None:
    """Catches a flipped bit in the weights, which TorchRL alone loads without a word."""
    files = [file for file in files_of(saved) if file.name != "SHA256SUMS"]
    file = files[index % len(files)]
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(bytes(content))
    assert file.relative_to(saved).as_posix() in refused(saved)


def test_a_shortened_file_is_found(saved: Path) -> None:
    """Catches a file that was cut off by a full disk."""
    file = max(files_of(saved), key=lambda entry: entry.stat().st_size)
    file.write_bytes(file.read_bytes()[:-1])
    assert "has changed" in refused(saved)


@pytest.mark.parametrize("name", ["manifest.json", "config.json", "SHA256SUMS"])
def test_a_missing_file_is_found(saved: Path, name: str) -> None:
    """Catches a checkpoint that was copied in part."""
    (saved / name).unlink()
    assert "is missing" in refused(saved) or "cannot be read" in refused(saved)


def test_an_extra_file_is_found(saved: Path) -> None:
    """Catches a payload that was slipped in beside the hashes."""
    (saved / "extra.bin").write_bytes(b"0")
    assert "extra.bin has no hash" in refused(saved)


@pytest.mark.parametrize("content", ["", "nonsense\n", "\x00\xff"])
def test_hashes_that_cannot_be_read_are_refused(saved: Path, content: str) -> None:
    """Catches a damaged list of hashes that passes as an empty one."""
    (saved / "SHA256SUMS").write_text(content, encoding="utf-8")
    refused(saved)


def test_the_newest_checkpoint_that_is_not_damaged_is_found(tmp_path: Path) -> None:
    """Catches a run that is lost because its last checkpoint is."""
    good, _ = save(tmp_path / CHECKPOINT_FOLDER, 100)
    bad, _ = save(tmp_path / CHECKPOINT_FOLDER, 200)
    (bad / "config.json").write_text("{}", encoding="utf-8")
    assert find_checkpoint(tmp_path) == good


def test_only_the_newest_are_kept_by_number_of_frames(tmp_path: Path) -> None:
    """Catches a rotation that sorts 1000 before 200."""
    for frames in (200, 1000, 30):
        save(tmp_path, frames, keep_last=2)
    assert [int(entry.name.split("-")[1]) for entry in sorted(tmp_path.iterdir())] == [200, 1000]


def test_what_a_killed_process_left_is_swept(saved: Path) -> None:
    """Catches a folder that fills up with halves of checkpoints."""
    shutil.copytree(saved, saved.parent / ".stage-0123")
    shutil.copytree(saved, saved.parent / ".checkpoint-000000000100.delete-0123")
    sweep(saved.parent)
    assert [entry.name for entry in saved.parent.iterdir()] == [saved.name]


def test_saving_twice_at_the_same_frames_keeps_the_later_one(tmp_path: Path) -> None:
    """Catches a checkpoint on interruption that fails because one is there."""
    save(tmp_path, 100)
    path, network = save(tmp_path, 100)
    other = nn.Linear(3, 2)
    restore(path, {"networks": other})
    assert torch.equal(other.weight, network.weight)
    assert len(list(tmp_path.iterdir())) == 1


def test_weights_of_another_size_are_refused_in_one_line(saved: Path) -> None:
    """Catches a resume with other network sizes that ends in a traceback."""
    with pytest.raises(CheckpointError, match="does not fit this configuration") as caught:
        restore(saved, {"networks": nn.Linear(4, 2)})
    assert "\n" not in str(caught.value)


def test_a_configuration_that_does_not_fit_names_its_key(saved: Path) -> None:
    """Catches a checkpoint of another version that is taken for one of this."""
    record = json.loads((saved / "config.json").read_text(encoding="utf-8"))
    record["config"]["ppo"]["colour"] = 1
    (saved / "config.json").write_text(json.dumps(record), encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"ppo\.colour is an unknown key"):
        read_config(saved)


def test_progress_lies_in_the_run_or_beside_shipped_weights() -> None:
    """Catches a curve looked for inside of a checkpoint, whose files are all hashed."""
    assert progress_path(Path("a/checkpoints/checkpoint-12")) == Path("a/progress.csv")
    assert progress_path(Path("weights/cura-ppo")) == Path("weights/cura-ppo-progress.csv")
