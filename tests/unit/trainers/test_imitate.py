"""The warm start: it fits the script, ignores the map, and any method can go on from it."""

from __future__ import annotations

import logging

import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE
from cura_torchrl.trainers.build import LATENT_SIZE, Networks
from cura_torchrl.trainers.checkpoint import find_checkpoint, read_config, restore
from cura_torchrl.trainers.imitate import ImitateConfig, imitate
from cura_torchrl.trainers.methods import method


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


def test_a_configuration_that_cannot_be_played_is_refused():
    """Catches a run that fails after minutes of collecting."""
    with pytest.raises(ValueError, match=r"rounds is 0; accepted: a positive number"):
        ImitateConfig(rounds=0)
