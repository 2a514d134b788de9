"""What configurations are turned into."""

from __future__ import annotations

import functools
import pickle
from typing import TYPE_CHECKING, Any

import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.envs.config import MapConfig
from cura_torchrl.envs.transforms.obstacle_code import CODE_SIZE, ObstacleCode
from cura_torchrl.modules import MapVAE
from cura_torchrl.trainers import build as module
from cura_torchrl.trainers.build import LATENT_SIZE, Networks, load_encoder, make_env, make_worker_env
from cura_torchrl.trainers.errors import RunError, UnavailableError
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.train import train

if TYPE_CHECKING:
    from pathlib import Path


def test_workers_play_every_scenario_once_and_none_again_after_a_resume() -> None:
    """Catches workers that all play the same scenes, and a resumed run that starts over with old ones."""
    config = method("push").replace(num_envs=4, num_workers=2, perception="none")
    played = []
    for frames_done in (0, 1000):
        for worker in range(2):
            env = make_worker_env(config.replace(num_workers=1), 2, worker=worker, frames_done=frames_done)
            played += env.reset()["episode"].flatten().tolist()
            env.close()
    assert played == [0, 1, 2, 3, 1000, 1001, 1002, 1003]


def test_the_factory_of_a_worker_s_environment_can_be_sent_to_it() -> None:
    """Catches a closure or a live simulator in what is pickled for a worker."""
    factory = functools.partial(make_worker_env, method("cura-ppo"), 2, worker=0, frames_done=0)
    assert pickle.loads(pickle.dumps(factory)).args[0] == method("cura-ppo")


def test_networks_share_one_normalisation() -> None:
    """Catches statistics of which each network has its own, two of them never updated."""
    networks = Networks(method("push"))
    for network in (networks.actor, networks.critic, networks.collision_estimator):
        assert any(part is networks.observation_norm for part in network.modules())


def test_only_training_of_the_perceptual_uncertainty_shows_the_obstacles() -> None:
    """Catches a policy that cannot be evaluated without the true obstacles, and a run that asks for them in vain."""
    for name, is_shown in (("cura-ppo", False), ("cura-cvar", False), ("cura-perceptual", True)):
        config = method(name).replace(perception="none", simulator="planar")
        training, playing = make_worker_env(config, 1, worker=0, frames_done=0), make_env(config, 1)
        try:
            assert ("obstacle_code" in set(training.reset().keys())) == is_shown
            assert not {"obstacle_code", "obstacles"} & set(playing.reset().keys())
            if is_shown:
                assert training.rollout(2)["next", "obstacle_code"].shape == (1, 2, CODE_SIZE)
        finally:
            training.close()
            playing.close()


def test_the_perceptual_uncertainty_stands_in_for_the_total_one() -> None:
    """Catches a policy whose costs, logs and pictures still read the total variance."""
    networks = Networks(method("cura-perceptual"))
    seen = TensorDict({"observation": torch.randn(5, 33), "latent": torch.randn(5, LATENT_SIZE)}, [5])
    total, outputs = networks.collision_estimator(seen.clone()), networks.collision_network(seen.clone())
    for key in ("collision_atoms", "risk"):
        assert torch.equal(outputs[key], total[key])
    expected = outputs["perceptual_atoms"].double().var(-1, correction=0, keepdim=True)
    torch.testing.assert_close(outputs["uncertainty"].double(), expected, rtol=1e-4, atol=1e-8)
    assert not torch.equal(outputs["uncertainty"], total["uncertainty"])


@pytest.mark.parametrize("content", [None, b"", b"not weights"])
def test_encoder_weights_that_are_missing_or_damaged_are_told_in_one_line(
    tmp_path: Path, content: bytes | None
) -> None:
    """Catches a traceback from torch's loader, or a hint that does not name the command that helps."""
    path = tmp_path / "map_vae.pt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UnavailableError, match="cura-torchrl pretrain-map") as caught:
        load_encoder(path)
    assert "\n" not in str(caught.value)


def test_the_shipped_encoder_is_looked_for_in_the_package() -> None:
    """Catches a path that holds only where the package was developed."""
    assert module.SHIPPED_ENCODER.parent.parent.name == "modules"


def test_without_perception_the_code_is_zero() -> None:
    """Catches obstacle-free pretraining whose networks do not fit the map's code later."""
    env = make_env(method("push").replace(perception="none"), 2)
    try:
        batch = env.rollout(2)
    finally:
        env.close()
    assert batch["next", "latent"].shape == (2, 2, LATENT_SIZE)
    assert not batch["next", "latent"].any()


def test_privileged_code_tells_the_obstacles_in_the_base_frame() -> None:
    """Catches obstacles in the world frame, which would be of no use to a policy in the base frame."""
    transform = ObstacleCode(LATENT_SIZE, is_blind=False)
    obstacles = torch.zeros(1, 6, 4)
    obstacles[0, 2] = torch.tensor([1.0, 4.0, 0.3, 0.6])
    # The base is at (1, 2) and looks along world y: the obstacle is 2 m ahead of it.
    pose = torch.tensor([[1.0, 2.0, torch.pi / 2]])
    code = transform(TensorDict({"sensor_pose": pose, "obstacles": obstacles}, [1]))["latent"]
    torch.testing.assert_close(code[0, 8:12], torch.tensor([0.2, 0.0, 0.6, 1.0]))
    assert code[0, :8].abs().sum() == 0
    assert code[0, 12:].abs().sum() == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"channels": "product"},
            r"map.channels is 'product' and map.window 100, maps of 1 x 100 x 100; accepted: 2 x 100",
        ),
        (
            {"channels": "confidence"},
            r"maps of 1 x 100 x 100; accepted: 2 x 100 x 100 that the encoder .*map_vae.pt takes",
        ),
        ({"window": 60}, r"map.window 60, maps of 2 x 60 x 60; accepted: .*pretrain-map --map.channels .* --encoder"),
    ],
)
def test_maps_that_the_encoder_does_not_take_are_told_in_one_line(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    """Catches a traceback of a convolution from inside of the worlds, after a checkpoint has been written."""
    config = method("push").replace(map=MapConfig(**change), simulator="planar", run_dir=tmp_path / "run")
    with pytest.raises(RunError, match=message):
        make_env(config, 1)
    with pytest.raises(RunError, match=message):
        train(config)
    assert not config.run_dir.exists()


def test_codes_of_another_length_are_told_in_one_line(tmp_path: Path) -> None:
    """Catches a traceback of the networks' first layer."""
    path = tmp_path / "short.pt"
    MapVAE(latent_size=8).save(path)
    with pytest.raises(RunError, match=r"code of the encoder .*short.pt has 8 numbers; accepted: 32, as of"):
        make_env(method("push").replace(encoder=path, simulator="planar"), 1)


def test_an_encoder_of_other_maps_plays_with_them(tmp_path: Path) -> None:
    """Catches a comparison with the shipped encoder in place of the one that is asked for."""
    path = tmp_path / "small.pt"
    MapVAE(channels=1, window=40).save(path)
    shown = MapConfig(channels="product", window=40)
    env = make_env(method("push").replace(encoder=path, map=shown, simulator="planar"), 1)
    try:
        assert env.reset()["latent"].shape == (1, LATENT_SIZE)
    finally:
        env.close()
