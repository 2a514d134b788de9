"""Each method is the paper's."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.methods import EXTENSIONS, METHODS, PRESETS, method, policy_labels

# Paper, section "Experimental Results": (name there, object hides what is behind it, alpha, lambda_r, lambda_u, robot);
# alpha = 1 is a map without confidence.
PAPER = {
    "push-no-occlusion": ("Push w/o Occlusion", False, 1.0, 0.0, 0.0, "ridgeback_franka"),
    "push": ("Push w/ Occlusion", True, 1.0, 0.0, 0.0, "ridgeback_franka"),
    "cura-ppo": ("CURA-PPO", True, 0.9, 0.25, 1.0, "ridgeback_franka"),
    "push-conf": ("Baseline w/ Conf.", True, 0.9, 0.0, 0.0, "ridgeback_franka"),
    "cura-no-uncertainty": ("CURA w/o Uncertainty", True, 0.9, 0.25, 0.0, "ridgeback_franka"),
    "cura-no-risk": ("CURA w/o Risk", True, 0.9, 0.0, 1.0, "ridgeback_franka"),
    "push-base": ("Push w/ Base", True, 1.0, 0.0, 0.0, "ridgeback"),
    "cura-ppo-base": ("CURA-PPO w/ Base", True, 0.9, 0.25, 1.0, "ridgeback"),
}


@pytest.mark.parametrize(("name", "row"), PAPER.items())
def test_a_preset_has_the_paper_s_occlusion_decay_share_of_the_costs_and_robot(
    name: str, row: tuple[str, bool, float, float, float, str]
) -> None:
    """Catches a method that is compared under another's settings.

    The advantage is z-scored here, and the coefficients are a quarter of the paper's.
    """
    config = method(name)
    assert config.cura.advantage_scale == "zscore"
    assert (
        METHODS[name].label,
        config.env.lidar.occlusion,
        config.map.decay,
        4.0 * config.cura.risk_coeff,
        4.0 * config.cura.uncertainty_coeff,
        config.env.robot.model,
    ) == row
    assert config.method == name


def test_methods_differ_in_nothing_else() -> None:
    """Catches a comparison of methods that also compares learning rates, curricula or networks."""

    def common(name: str) -> object:
        config = method(name)
        return config.replace(
            method="",
            env=dataclasses.replace(
                config.env,
                lidar=dataclasses.replace(config.env.lidar, occlusion=True),
                robot=dataclasses.replace(config.env.robot, model="ridgeback_franka"),
            ),
            map=dataclasses.replace(config.map, decay=1.0),
            cura=dataclasses.replace(config.cura, risk_coeff=0.0, uncertainty_coeff=0.0),
        )

    assert len({common(name) for name in METHODS}) == 1


def test_all_listed_methods_are_the_paper_s() -> None:
    """Catches a method that is offered but not checked here."""
    assert set(METHODS) == set(PAPER)


@pytest.mark.parametrize(
    ("name", "changes"),
    [("cura-cvar", {"risk_measure": "cvar"}), ("cura-perceptual", {"uncertainty": "perceptual"})],
)
def test_a_method_beyond_the_paper_turns_one_knob_of_cura_ppo(name: str, changes: dict[str, str]) -> None:
    """Catches a comparison that does not tell what made the difference."""
    base = method("cura-ppo")
    assert method(name) == base.replace(method=name, cura=dataclasses.replace(base.cura, **changes))
    assert base.cura.risk_measure == "mean"
    assert base.cura.uncertainty == "total"


def test_methods_beyond_the_paper_stand_apart() -> None:
    """Catches one that is counted among the paper's, or that hides one of them."""
    assert set(EXTENSIONS) == {"cura-cvar", "cura-perceptual"}
    assert not set(EXTENSIONS) & set(METHODS)
    assert list(PRESETS) == [*METHODS, *EXTENSIONS]


def test_an_unknown_name_is_refused_with_the_names_there_are() -> None:
    """Catches a typing error that trains something else."""
    with pytest.raises(
        ValueError, match=r"method is 'cura_ppo' \(did you mean cura-ppo\?\); accepted: cura-ppo, push, "
    ):
        method("cura_ppo")


@pytest.mark.parametrize(
    ("sources", "labels"),
    [
        (("cura-ppo", "push"), ["CURA-PPO", "Push w/ Occlusion"]),
        (("runs/cura-ppo-0", "runs/cura-ppo-1"), ["CURA-PPO (cura-ppo-0)", "CURA-PPO (cura-ppo-1)"]),
        (("a/cura-ppo", "b/cura-ppo"), ["CURA-PPO (a/cura-ppo)", "CURA-PPO (b/cura-ppo)"]),
        (
            ("runs/cura-ppo-0", "push", "cura-ppo"),
            ["CURA-PPO (cura-ppo-0)", "Push w/ Occlusion", "CURA-PPO (cura-ppo)"],
        ),
        (("runs/of-ones-own", "push"), ["of-ones-own", "Push w/ Occlusion"]),
    ],
)
def test_no_two_policies_are_called_the_same(sources: tuple[str, ...], labels: list[str]) -> None:
    """Catches two training seeds under one title, and a method of one's own that has no picture."""
    names = ["push" if "push" in source else "of-ones-own" if "own" in source else "cura-ppo" for source in sources]
    loaded = [SimpleNamespace(config=TrainConfig(method=name), record={"frames": 8}) for name in names]
    assert policy_labels(loaded, sources) == labels
