"""The warm start: it fits the script, ignores the map unless it imitates the avoider, and training goes on from it."""

from __future__ import annotations

import logging
from contextlib import closing

import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE, OBSERVATION_SLICES
from cura_torchrl.envs.robots.scripted import ScriptedPusher
from cura_torchrl.trainers.build import LATENT_SIZE, Networks
from cura_torchrl.trainers.checkpoint import find_checkpoint, read_config, restore
from cura_torchrl.trainers.errors import CheckpointError
from cura_torchrl.trainers.imitate import _make_env, _rounds, imitate
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.training.imitate_config import ImitateConfig
from cura_torchrl.trainers.training.run_folder import locked


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A checkpoint of two short rounds."""
    folder = tmp_path_factory.mktemp("imitate")
    return imitate(ImitateConfig(run_dir=folder, num_envs=4, rounds=2, steps=12, epochs=20, minibatch_size=16, std=0.2))


def test_a_policy_without_a_map_is_written_with_its_configuration(checkpoint):
    """Catches a checkpoint that says it saw a map, or counts frames wrongly: 4 worlds x 12 steps x 2 rounds."""
    config, record = read_config(find_checkpoint(checkpoint))
    assert config.perception == "none"
    assert config.env.task.scenario.max_obstacles == 0
    assert record["frames"] == 96


def test_networks_of_any_method_start_from_it_and_ignore_the_map_at_first(checkpoint):
    """Catches weights on the map's code that were never trained and would disturb the policy once there is a map."""
    networks = Networks(method("cura-ppo"))
    restore(find_checkpoint(checkpoint), {"networks": networks})
    seen = torch.randn(5, OBSERVATION_SIZE)
    actions = [
        networks.actor.module[0](TensorDict({"observation": seen, "latent": code}, [5]))["loc"]
        for code in (torch.zeros(5, LATENT_SIZE), torch.randn(5, LATENT_SIZE))
    ]
    assert torch.equal(*actions)
    scale = networks.actor.module[0](TensorDict({"observation": seen, "latent": torch.zeros(5, LATENT_SIZE)}, [5]))[
        "scale"
    ]
    torch.testing.assert_close(scale, torch.full((5, 6), 0.2))


@pytest.fixture(scope="module")
def avoiding(tmp_path_factory):
    """A checkpoint that imitates the avoider with what ``cura-ppo`` sees."""
    folder = tmp_path_factory.mktemp("avoid")
    sizes = {"num_envs": 4, "rounds": 2, "steps": 10, "epochs": 5, "minibatch_size": 16}
    return imitate(ImitateConfig(run_dir=folder, expert="avoider", method="cura-ppo", simulator="planar", **sizes))


def test_who_imitates_the_avoider_sees_what_its_method_sees_and_nothing_more(avoiding):
    """Catches another method's LiDAR or map, and true obstacles that leak from the expert into the policy's worlds."""
    config, record = read_config(find_checkpoint(avoiding))
    expected = method("cura-ppo").replace(simulator="planar")
    assert (config.method, config.simulator, config.perception) == ("cura-ppo", "planar", "map")
    assert (config.map, config.env.lidar) == (expected.map, expected.env.lidar)
    assert config.env.task.scenario == expected.env.task.scenario
    assert config.env.task.curriculum == ()
    assert not config.env.task.privileged
    assert record["frames"] == 80


def test_who_imitates_the_avoider_reads_the_map(avoiding):
    """Catches a fit to the vector alone, which cannot know where to steer."""
    networks = Networks(method("cura-ppo"))
    restore(find_checkpoint(avoiding), {"networks": networks})
    seen = torch.randn(1, OBSERVATION_SIZE).expand(2, -1)
    codes = torch.stack([torch.zeros(LATENT_SIZE), torch.ones(LATENT_SIZE)])
    blank, full = networks.actor.module[0](TensorDict({"observation": seen, "latent": codes}, [2]))["loc"]
    assert not torch.equal(blank, full)


def test_the_avoiders_actions_are_what_is_learned():
    """Catches labels of the pusher that sees no obstacles: near an obstacle the two differ."""
    config = ImitateConfig(
        expert="avoider", method="push", simulator="planar", num_envs=8, rounds=1, steps=60, noise=0.0
    )
    kept = _played(config)[0]
    blind = ScriptedPusher()(kept.select("observation").clone())["action"]
    assert (kept["action"] - blind).abs().amax() > 0.2


@pytest.mark.parametrize("expert", ["scripted", "avoider"])
def test_the_base_alone_has_warm_starts_of_its_own(tmp_path, expert):
    """Catches an expert or noise of the arm's six actions, and a start that the method's networks cannot take."""
    sizes = {"num_envs": 2, "rounds": 2, "steps": 4, "epochs": 1, "minibatch_size": 8}
    config = ImitateConfig(run_dir=tmp_path, expert=expert, method="push-base", simulator="planar", **sizes)
    path = imitate(config)
    assert read_config(find_checkpoint(path))[0].env.robot.model == "ridgeback"
    networks = Networks(method("cura-ppo-base"))
    restore(find_checkpoint(path), {"networks": networks})
    assert networks.observation_norm.mean.shape == (30,)
    with pytest.raises(CheckpointError, match="does not fit"):
        restore(find_checkpoint(path), {"networks": Networks(method("cura-ppo"))})


def test_a_round_goes_on_where_the_last_one_ended():
    """Catches rounds that begin anew: episodes longer than a round would never be seen to their end."""
    config = ImitateConfig(num_envs=2, rounds=2, steps=20, noise=0.0)
    first, second = (kept["observation"][:, OBSERVATION_SLICES["goal_position"]] for kept in _played(config))
    one_step = 0.8 * 0.2  # [m] at the base's full speed
    turn = 0.2 * first[-2:].norm(dim=-1).amax()  # by 1 rad/s
    assert (second[:2] - first[-2:]).norm(dim=-1).amax() < one_step + turn
    assert (first[-2:] - first[:2]).norm(dim=-1).amin() > 0.5, "the robots have moved on"


def _played(config):
    train_config = config.train_config
    with closing(_make_env(train_config, config)) as env:
        return list(_rounds(env, Networks(train_config), config))


def test_fitting_reduces_the_error_of_the_action(tmp_path, caplog):
    """Catches a regression that does not learn: forty times the passes leave at most half of the error."""
    errors = []
    for epochs in (1, 40):
        with caplog.at_level(logging.INFO, logger="cura_torchrl.trainers.imitate"):
            caplog.clear()
            folder = tmp_path / str(epochs)
            imitate(ImitateConfig(run_dir=folder, num_envs=4, rounds=1, steps=12, epochs=epochs, minibatch_size=16))
        errors.append(caplog.records[0].args[2])
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("steps", [2, 9])
def test_a_folder_that_holds_a_run_is_left_alone(tmp_path, steps):
    """Catches a second imitation into the same folder: the one with more frames is found, whichever is the newer."""
    sizes = {"num_envs": 2, "rounds": 1, "epochs": 1, "minibatch_size": 8, "simulator": "planar"}
    path = imitate(ImitateConfig(run_dir=tmp_path, steps=4, **sizes))
    with pytest.raises(CheckpointError, match=r"holds a run already; accepted: another --run-dir"):
        imitate(ImitateConfig(run_dir=tmp_path, steps=steps, **sizes))
    assert list(path.parent.iterdir()) == [path]


def test_a_folder_that_is_trained_in_is_left_alone(tmp_path):
    """Catches networks that appear among the checkpoints of a run that has only just started."""
    with locked(tmp_path), pytest.raises(CheckpointError, match=r"is being trained in by another process"):
        imitate(ImitateConfig(run_dir=tmp_path, num_envs=2, rounds=1, steps=2, epochs=1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rounds": 0}, r"rounds is 0; accepted: a positive number"),
        ({"method": "cura-pro"}, r"method is 'cura-pro' \(did you mean cura-ppo\?\)"),
        ({"seed": -1}, r"seed is -1; accepted: 0 to 2147483647"),
        ({"std": 0.01}, r"init_std is 0.01; accepted: a number larger than min_std"),
    ],
)
def test_a_configuration_that_cannot_be_played_is_refused(change, message):
    """Catches a run that fails after minutes of collecting, and a traceback where the command line has one line."""
    with pytest.raises(ValueError, match=message):
        ImitateConfig(**change)
