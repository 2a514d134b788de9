"""Configurations survive JSON, and what does not fit them is refused in one line."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cura_torchrl.envs.config import PushEnvConfig
from cura_torchrl.trainers.config import CURAConfig, EvaluateConfig, PPOConfig, TrainConfig
from cura_torchrl.trainers.methods import PRESETS, method

FINITE = st.floats(min_value=1e-6, max_value=1.0, allow_nan=False)


@st.composite
def train_configs(draw: st.DrawFn) -> TrainConfig:
    """Any method's preset with fields of every type changed."""
    preset = method(draw(st.sampled_from(list(PRESETS))))
    workers = draw(st.integers(1, 4))
    steps = draw(st.lists(st.integers(0, 10**9), max_size=4, unique=True).map(sorted))
    task = dataclasses.replace(
        preset.env.task,
        curriculum=tuple((frames, draw(st.integers(0, 6))) for frames in steps),
        random_first_age=draw(st.booleans()),
    )
    return preset.replace(
        num_envs=workers * draw(st.integers(1, 64)),
        num_workers=workers,
        backend=draw(st.sampled_from(["process", "ray"])),
        seed=draw(st.integers(0, 2**31 - 1)),
        run_dir=Path(draw(st.text(st.characters(categories=["L", "N"]), min_size=1, max_size=8))),
        encoder=draw(st.none() | st.just(Path("weights/map_vae.pt"))),
        perception=draw(st.sampled_from(["map", "none", "privileged"])),
        env=dataclasses.replace(preset.env, task=task),
        ppo=dataclasses.replace(preset.ppo, gamma=draw(FINITE), entropy_coeff=draw(FINITE)),
        network=dataclasses.replace(
            preset.network, actor_hidden_sizes=tuple(draw(st.lists(st.integers(1, 512), min_size=1)))
        ),
    )


@settings(deadline=None, max_examples=100)
@given(config=train_configs())
def test_a_configuration_survives_a_json_file(config: TrainConfig) -> None:
    """Catches a field whose type the decoder turns into another, so that a resumed run is not the same run."""
    assert TrainConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "TrainConfig is []; accepted: an object with keys"),
        ({"ppo": 3}, "ppo is 3; accepted: an object with keys"),
        ({"pppo": {}}, "pppo is an unknown key; accepted: ppo"),
        ({"ppo": {"gama": 0.9}}, "ppo.gama is an unknown key; accepted: gamma"),
        ({"ppo": {"gamma": "0.9"}}, "ppo.gamma is '0.9'; accepted: a finite number"),
        ({"ppo": {"gamma": True}}, "ppo.gamma is True; accepted: a finite number"),
        ({"ppo": {"gamma": float("nan")}}, "ppo.gamma is nan; accepted: a finite number"),
        ({"ppo": {"gamma": float("inf")}}, "ppo.gamma is inf; accepted: a finite number"),
        ({"ppo": {"gamma": 1.5}}, "ppo: gamma is 1.5; accepted: 0 to 1"),
        ({"ppo": {"epochs": 5.0}}, "ppo.epochs is 5.0; accepted: a whole number"),
        ({"num_envs": None}, "num_envs is None; accepted: a whole number"),
        ({"num_envs": 3, "num_workers": 2}, "num_envs is 3; accepted: a multiple of num_workers 2"),
        ({"simulator": "isaac"}, "simulator is 'isaac'; accepted: bullet, planar"),
        ({"backend": "slurm"}, "backend is 'slurm'; accepted: process, ray"),
        ({"run_dir": 3}, "run_dir is 3; accepted: a path"),
        ({"network": {"actor_hidden_sizes": 3}}, "network.actor_hidden_sizes is 3; accepted: a list"),
        (
            {"network": {"actor_hidden_sizes": [8, "x"]}},
            "network.actor_hidden_sizes[1] is 'x'; accepted: a whole number",
        ),
        ({"env": {"task": {"curriculum": [[0, 1, 2]]}}}, "env.task.curriculum[0] is [0, 1, 2]; accepted: a list of 2"),
        ({"env": {"task": {"random_first_age": 1}}}, "env.task.random_first_age is 1; accepted: true or false"),
        ({"_target_": "os.system"}, "_target_ is an unknown key; accepted: method, simulator"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line_with_its_key_path(data: object, message: str) -> None:
    """Catches a wrong value that is taken over silently, or an error that does not say where it is."""
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        TrainConfig.from_json(data)
    assert "\n" not in str(caught.value)


def test_a_whole_number_is_accepted_where_a_number_is_due() -> None:
    """Catches a decoder that refuses 1 for 1.0: JSON does not tell them apart."""
    assert TrainConfig.from_json({"ppo": {"gamma": 1}}).ppo.gamma == 1.0


def test_the_simulator_is_told_once() -> None:
    """Catches a run whose environment uses another simulator than its configuration says."""
    assert TrainConfig().env.simulator == TrainConfig().simulator == PushEnvConfig().simulator
    assert TrainConfig(simulator="planar").env.simulator == "planar"
    with pytest.raises(ValueError, match=r"^env.simulator is 'planar'; accepted: simulator 'bullet'$"):
        TrainConfig(env=PushEnvConfig(simulator="planar"))


@pytest.mark.parametrize(
    "changes", [{"lr": 1.0}, {"lr": 1e-9}, {"lr_factor": 1.0}, {"target_kl": -1.0}, {"clip_epsilon": 0.0}]
)
def test_optimisation_settings_out_of_range_are_refused(changes: dict[str, float]) -> None:
    """Catches a run that cannot adapt its learning rate."""
    with pytest.raises(ValueError, match="accepted"):
        PPOConfig(**changes)


@pytest.mark.parametrize(
    ("kind", "level", "accepted"),
    [("cvar", 0.0, "above 0 to 1"), ("cvar", 1.5, "above 0 to 1"), ("wang", -0.1, "a number that is not negative")],
)
def test_a_risk_level_that_its_measure_does_not_have_is_refused(kind: str, level: float, accepted: str) -> None:
    """Catches a tail of nothing, and a shift towards what is harmless, before a run starts."""
    with pytest.raises(ValueError, match=f"risk_level is {level}; accepted: {accepted}"):
        CURAConfig(risk_measure=kind, risk_level=level)


@pytest.mark.parametrize("given_", [{}, {"method": "push", "policy": "random"}, {"method": "push", "episodes": 0}])
def test_an_evaluation_needs_exactly_one_policy_and_an_episode(given_: dict[str, object]) -> None:
    """Catches a table whose cells were played by another policy than asked for."""
    with pytest.raises(ValueError, match="accepted"):
        EvaluateConfig(**given_)


def test_a_copy_on_another_simulator_has_its_worlds_there() -> None:
    """Catches a planar configuration that cannot be turned back to PyBullet."""
    planar = TrainConfig(simulator="planar")
    assert planar.env.simulator == "planar"
    assert planar.replace(simulator="bullet") == TrainConfig()
