"""Networks that start from those of another method."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import pytest
import torch

from cura_torchrl.trainers.build import Networks
from cura_torchrl.trainers.checkpoint import find_checkpoint, save_checkpoint
from cura_torchrl.trainers.errors import CheckpointError
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.training.warm_start import start_from

if TYPE_CHECKING:
    from pathlib import Path

NEW = ("privileged_estimator", "perceptual_estimator")


def make(name: str, size: int = 8) -> Networks:
    """Small networks of a method, with statistics of their own."""
    preset = method(name)
    sizes = {f"{part}_hidden_sizes": (size,) for part in ("actor", "critic", "collision")}
    networks = Networks(preset.replace(network=dataclasses.replace(preset.network, **sizes)))
    networks.observation_norm.update(torch.randn(50, networks.observation_norm.mean.shape[0]) * 3 + 1)
    return networks


def saved(networks: Networks, name: str, folder: Path) -> Path:
    """Return a checkpoint of the networks."""
    save_checkpoint({"networks": networks}, method(name), folder, frames=1)
    return find_checkpoint(folder)


def test_estimators_that_the_other_lacks_start_afresh(tmp_path: Path) -> None:
    """Catches a perceptual fine-tuning that the shipped weights do not fit, or that keeps its own statistics."""
    theirs, ours = make("cura-ppo"), make("cura-perceptual")
    before = {name: value.clone() for name, value in ours.named_parameters()}
    assert start_from(saved(theirs, "cura-ppo", tmp_path), ours) == list(NEW)
    loaded = dict(ours.named_parameters())
    assert all(torch.equal(loaded[name], value) for name, value in theirs.named_parameters())
    assert all(torch.equal(loaded[name], value) for name, value in before.items() if name.startswith(NEW))
    assert torch.equal(ours.observation_norm.mean, theirs.observation_norm.mean)
    for part in NEW:
        norms = [value for name, value in getattr(ours, part).named_buffers() if name.endswith("mean")]
        assert norms
        assert all(torch.equal(norm, theirs.observation_norm.mean) for norm in norms)


def test_estimators_that_only_the_other_has_are_left(tmp_path: Path) -> None:
    """Catches a method of the paper that cannot go on from one beyond it."""
    theirs, ours = make("cura-perceptual"), make("cura-cvar")
    assert start_from(saved(theirs, "cura-perceptual", tmp_path), ours) == []
    loaded = dict(ours.named_parameters())
    assert all(torch.equal(value, dict(theirs.named_parameters())[name]) for name, value in loaded.items())


def test_other_parts_have_to_fit(tmp_path: Path) -> None:
    """Catches a warm start that silently leaves out the actor."""
    theirs = make("cura-ppo")
    path = saved(theirs, "cura-ppo", tmp_path / "wider")
    with pytest.raises(CheckpointError, match="does not fit this configuration"):
        start_from(path, make("cura-ppo", size=16))
    del theirs.actor
    with pytest.raises(CheckpointError, match="networks differ in actor"):
        start_from(saved(theirs, "cura-ppo", tmp_path / "headless"), make("cura-perceptual"))
