"""A checkpoint is whole, or it is refused in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from torch import nn

from cura_torchrl.trainers import checkpoint as module
from cura_torchrl.trainers.build import Networks
from cura_torchrl.trainers.checkpoint import (
    CHECKPOINT_FOLDER,
    export_policy,
    find_checkpoint,
    load_policy,
    progress_path,
    read_config,
    restore,
    save_checkpoint,
    sweep,
    verify,
)
from cura_torchrl.trainers.errors import CheckpointError
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.progress import PROGRESS_NAME


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


def test_exported_weights_say_what_trained_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches weights that name the commit of their release, from which nobody can make them again."""
    config = method("push").replace(run_dir=tmp_path / "run", perception="none")
    monkeypatch.setattr(module, "git_commit", lambda: "of the training")
    save_checkpoint({"networks": Networks(config)}, config, tmp_path / "run" / CHECKPOINT_FOLDER, frames=7)
    (tmp_path / "run" / PROGRESS_NAME).write_text("frames\n7\n", encoding="utf-8")
    monkeypatch.setattr(module, "git_commit", lambda: "of the release")
    released = export_policy(tmp_path / "run", tmp_path / "release" / "push")
    assert read_config(released)[1]["commit"] == "of the training"
    curve = tmp_path / "release" / f"push-{PROGRESS_NAME}"
    assert curve.read_text(encoding="utf-8") == "frames\n7\n"


def test_exported_weights_load_by_path_and_act_alike(tmp_path: Path) -> None:
    """Catches a release without the normalisation's statistics, which acts otherwise than the run did."""
    config = method("push").replace(run_dir=tmp_path / "run", perception="none")
    networks = Networks(config)
    networks.observation_norm.update(torch.randn(50, networks.observation_norm.mean.shape[0]) * 3 + 1)
    save_checkpoint({"networks": networks, "counters": nn.Linear(1, 1)}, config, tmp_path / "run", frames=7)
    loaded = load_policy(export_policy(tmp_path / "run", tmp_path / "release" / "push"))
    inputs = {"observation": torch.randn(4, 33), "latent": torch.randn(4, 32)}
    for ours, theirs in (
        (networks.actor.module[0], loaded.policy.module[0]),
        (networks.critic, loaded.critic),
        (networks.collision_estimator, loaded.collision_estimator),
    ):
        for mine, its in zip(_outputs(ours(**inputs)), _outputs(theirs(**inputs)), strict=True):
            assert torch.equal(mine, its)
    assert loaded.record["frames"] == 7
    assert loaded.config.run_dir == Path("runs/push")
    assert not any(parameter.requires_grad for parameter in loaded.policy.parameters())
    verify(loaded.path)


def test_a_policy_plays_on_either_simulator_whatever_it_was_trained_on(tmp_path: Path) -> None:
    """Catches an evaluation that plays where the policy was trained, not where it was asked to."""
    config = method("push").replace(run_dir=tmp_path / "run", perception="none", simulator="planar")
    save_checkpoint({"networks": Networks(config)}, config, tmp_path / "run", frames=1)
    loaded = load_policy(tmp_path / "run")
    for asked, played in ((None, "planar"), ("bullet", "bullet"), ("planar", "planar")):
        env = loaded.make_env(1, simulator=asked)
        assert env.base_env.config.simulator == played
        assert env.base_env.config.task.stream == "eval"
        env.close()


@pytest.mark.parametrize("name", ["cura-cvar", "cura-perceptual"])
def test_methods_beyond_the_paper_play_without_what_they_were_trained_with(tmp_path: Path, name: str) -> None:
    """Catches an evaluation that needs the true obstacles, or reads another risk than the policy was trained by."""
    config = method(name).replace(run_dir=tmp_path / "run", perception="none", simulator="planar")
    save_checkpoint({"networks": Networks(config)}, config, tmp_path / "run", frames=1)
    loaded = load_policy(tmp_path / "run")
    env = loaded.make_env(2)
    try:
        played = env.rollout(2, loaded.policy)
    finally:
        env.close()
    assert not {"obstacle_code", "obstacles"} & set(played.keys())
    outputs = loaded.collision_estimator(played.select("observation", "latent"))
    atoms = outputs["collision_atoms"].clamp(0, 1).sort(-1, descending=True).values
    # The largest quarter of 50 atoms: 12 and half of the next.
    tail = (atoms[..., :12].sum(-1) + 0.5 * atoms[..., 12]) / 12.5
    expected = tail if name == "cura-cvar" else outputs["collision_atoms"].mean(-1)
    torch.testing.assert_close(outputs["risk"].squeeze(-1), expected)


def _outputs(value: torch.Tensor | tuple[torch.Tensor, ...]) -> tuple[torch.Tensor, ...]:
    return value if isinstance(value, tuple) else (value,)


def test_a_method_without_shipped_weights_and_a_wrong_path_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a wrong name that reads as a damaged installation."""
    monkeypatch.setattr(module, "SHIPPED_FOLDER", tmp_path)
    with pytest.raises(CheckpointError, match="no weights of method 'push' are shipped"):
        load_policy("push")
    with pytest.raises(CheckpointError, match="no checkpoint at nowhere; accepted: the path of a run or checkpoint"):
        load_policy("nowhere")
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        load_policy(tmp_path)


def test_progress_lies_in_the_run_or_beside_shipped_weights() -> None:
    """Catches a curve looked for inside of a checkpoint, whose files are all hashed."""
    assert progress_path(Path("a/checkpoints/checkpoint-12")) == Path("a/progress.csv")
    assert progress_path(Path("weights/cura-ppo")) == Path("weights/cura-ppo-progress.csv")
