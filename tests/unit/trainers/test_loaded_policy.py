"""Networks come back from a checkpoint or from shipped weights, and play where they are asked to."""

from __future__ import annotations

import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cura_torchrl.modules import MapVAE
from cura_torchrl.trainers import checkpoint, loaded_policy
from cura_torchrl.trainers.build import SHIPPED_ENCODER, Networks
from cura_torchrl.trainers.checkpoint import CHECKPOINT_FOLDER, read_config, save_checkpoint, verify
from cura_torchrl.trainers.errors import CheckpointError, UnavailableError
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.release import release
from cura_torchrl.trainers.training.progress import PROGRESS_NAME


def test_exported_weights_say_what_trained_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches weights that name the commit of their release, from which nobody can make them again."""
    config = method("push").replace(run_dir=tmp_path / "run", perception="none")
    monkeypatch.setattr(checkpoint, "git_commit", lambda: "of the training")
    save_checkpoint({"networks": Networks(config)}, config, tmp_path / "run" / CHECKPOINT_FOLDER, frames=7)
    (tmp_path / "run" / PROGRESS_NAME).write_text("frames\n7\n", encoding="utf-8")
    monkeypatch.setattr(checkpoint, "git_commit", lambda: "of the release")
    released = release(tmp_path / "run", tmp_path / "release" / "push")
    assert read_config(released)[1]["commit"] == "of the training"
    curve = tmp_path / "release" / f"push-{PROGRESS_NAME}"
    assert curve.read_text(encoding="utf-8") == "frames\n7\n"
    (tmp_path / "run" / PROGRESS_NAME).unlink()
    release(tmp_path / "run", released)
    assert not curve.exists()  # it would be that of other weights


def test_exported_weights_load_by_path_and_act_alike(tmp_path: Path) -> None:
    """Catches a release without the normalisation's statistics, which acts otherwise than the run did."""
    config = method("push").replace(run_dir=tmp_path / "run", perception="none")
    networks = Networks(config)
    networks.observation_norm.update(torch.randn(50, networks.observation_norm.mean.shape[0]) * 3 + 1)
    save_checkpoint({"networks": networks, "counters": nn.Linear(1, 1)}, config, tmp_path / "run", frames=7)
    loaded = load_policy(release(tmp_path / "run", tmp_path / "release" / "push"))
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


@pytest.mark.parametrize("kept", ["notes.txt", "SHA256SUMS", "checkpoints/checkpoint-1/notes.txt"])
def test_a_release_leaves_folders_alone_that_hold_anything_else(tmp_path: Path, kept: str) -> None:
    """Catches `release --destination .` that deletes a project, or a run."""
    run, destination = _tiny_release(tmp_path), tmp_path / "mine"
    file = destination / kept
    file.parent.mkdir(parents=True)
    file.write_text("mine", encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"destination is .*mine; accepted: a folder that is new, empty, or"):
        release(run, destination)
    assert file.read_text(encoding="utf-8") == "mine"


def test_a_release_replaces_weights_but_not_what_was_put_beside_them(tmp_path: Path) -> None:
    """Catches a release that works once only, and one that deletes notes that lie among the weights."""
    run, destination = _tiny_release(tmp_path), tmp_path / "weights" / "push"
    destination.mkdir(parents=True)
    for _ in range(2):
        assert release(run, destination) == destination
    verify(destination)
    (destination / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(CheckpointError, match="destination is"):
        release(run, destination)
    with pytest.raises(CheckpointError, match="destination is"):
        release(run, next((run / CHECKPOINT_FOLDER).iterdir()))
    with pytest.raises(CheckpointError, match="destination is"):
        release(run, Path())


@pytest.mark.parametrize(
    ("name", "message"), [("other.pt", "SHA-256 [0-9a-f]{12}; accepted"), ("gone.pt", "not there")]
)
def test_a_release_with_another_encoder_is_refused(tmp_path: Path, name: str, message: str) -> None:
    """Catches released weights that are loaded with an encoder whose codes they have never seen."""
    MapVAE().save(tmp_path / "other.pt")
    run = _tiny_release(tmp_path, perception="map", encoder=tmp_path / name)
    with pytest.raises(UnavailableError, match=f"encoder is .*{name}, .*{message}"):
        release(run, tmp_path / "push")
    assert not (tmp_path / "push").exists()


def test_a_checkpoint_with_optimisers_is_not_replaced_wherever_it_lies(tmp_path: Path) -> None:
    """Catches a backup of a run's checkpoint that passes for released weights, and loses all but its networks."""
    run, kept = _tiny_release(tmp_path), tmp_path / "backup"
    config = method("push").replace(perception="none")
    save_checkpoint({"networks": Networks(config), "counters": nn.Linear(1, 1)}, config, tmp_path / "other", frames=1)
    (tmp_path / "other" / "checkpoint-000000000001").rename(kept)
    with pytest.raises(CheckpointError, match=r"destination is .*backup; accepted: a folder that is new, empty, or"):
        release(run, kept)
    assert len(list((kept / "components").iterdir())) == 2


def test_a_release_with_a_copy_of_the_shipped_encoder_forgets_its_path(tmp_path: Path) -> None:
    """Catches a comparison of paths: shipped weights were trained with the file before it came to the package."""
    copy = shutil.copyfile(SHIPPED_ENCODER, tmp_path / "map_vae.pt")
    run = _tiny_release(tmp_path, perception="map", encoder=copy)
    assert read_config(release(run, tmp_path / "push"))[0].encoder is None


def _tiny_release(folder: Path, **changes: Any) -> Path:
    config = method("push").replace(run_dir=folder / "run", **{"perception": "none", **changes})
    save_checkpoint({"networks": Networks(config)}, config, config.run_dir / CHECKPOINT_FOLDER, frames=7)
    return config.run_dir


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


def test_in_float64_an_episode_hardly_depends_on_how_many_are_played_side_by_side() -> None:
    """Catches an encoder, normaliser or actor left in float32: it rounds differently in another batch."""

    def actions(worlds: int, *, wide: bool) -> torch.Tensor:
        loaded = load_policy("cura-ppo")
        loaded = loaded.double() if wide else loaded
        with (
            closing(loaded.make_env(worlds, simulator="planar", seed=0)) as env,
            torch.no_grad(),
            set_exploration_type(ExplorationType.DETERMINISTIC),
        ):
            return env.rollout(15, loaded.policy, break_when_any_done=False)["action"][0].double()

    def error(*, wide: bool) -> float:
        return float((actions(1, wide=wide) - actions(33, wide=wide)).abs().max())

    # 33 is more than a piece of maps.
    assert error(wide=True) < 1e-12
    assert error(wide=False) > 1e-8  # the batch does matter: else nothing is tested


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
    monkeypatch.setattr(loaded_policy, "SHIPPED_FOLDER", tmp_path)
    with pytest.raises(CheckpointError, match="no weights of method 'push' are shipped"):
        load_policy("push")
    with pytest.raises(CheckpointError, match="no checkpoint at nowhere; accepted: the path of a run or checkpoint"):
        load_policy("nowhere")
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        load_policy(tmp_path)
