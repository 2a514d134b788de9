"""Exported graphs against the environment's own map and the networks themselves."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from cura_torchrl import load_policy
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.trainers import export as module
from cura_torchrl.trainers.deployment.config import ExportConfig
from cura_torchrl.trainers.deployment.runner import Runner, replay
from cura_torchrl.trainers.errors import CheckpointError, RunError, UnavailableError
from tests.runs import tiny_run

SENSED = ("scan", "sensor_pose", "object_pose", "object_size", "observation")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export of the shipped method; pytest would keep, and format, what PyTorch traces for its debugging."""
    logging.disable(logging.DEBUG)
    out = module.export(ExportConfig(method="cura-ppo", out=tmp_path_factory.mktemp("export") / "out", check_steps=3))
    logging.disable(logging.NOTSET)
    return out


@pytest.fixture
def runner(exported: Path) -> Runner:
    """A robot that has seen nothing."""
    return Runner(exported)


def test_graphs_repeat_recorded_episodes(runner: Runner) -> None:
    """Catches a graph of another map, encoder, normalisation or network, and a map that outlives its episode."""
    loaded, cells, compared = load_policy("cura-ppo"), 0, 0
    for is_first, state in module.observations(loaded, 10):
        if is_first:
            runner.reset()
        action, risk, uncertainty = runner.step(*(state[name].numpy() for name in SENSED))
        window = state["confidence_map"].numpy()
        differing = int((np.abs(runner.outputs["window"] - window) > 1e-6).sum())
        cells += differing
        if differing:
            continue
        compared += 1
        np.testing.assert_allclose(runner.outputs["latent"], state["latent"].numpy(), atol=1e-5)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            expected = loaded.collision_estimator(loaded.policy(state.clone()))
        np.testing.assert_allclose(action, expected["action"][0].clamp(-1, 1).numpy(), atol=1e-5)
        np.testing.assert_allclose(runner.outputs["atoms"], expected["collision_atoms"].numpy(), atol=1e-5)
        assert risk == pytest.approx(expected["collision_atoms"].mean().item(), abs=1e-5)
        assert uncertainty == pytest.approx(expected["collision_atoms"].numpy().var(), abs=1e-5)
    # A cell between two rays, or a point between two cells, may go to either.
    assert cells <= 4
    assert compared >= 16


@pytest.mark.parametrize(
    ("name", "risk", "uncertainty"),
    [
        ("cura-cvar", "mean of the largest 0.25 of the atoms", "population variance of the atoms"),
        ("cura-perceptual", "mean of the atoms", "variance of another estimator's atoms: the part that seeing"),
    ],
)
def test_methods_beyond_the_paper_are_exported_with_their_own_costs(
    tmp_path: Path, name: str, risk: str, uncertainty: str
) -> None:
    """Catches a crash, and a robot that is told the mean and variance of atoms that it does not get."""
    run = tiny_run(name, tmp_path)
    out = module.export(ExportConfig(checkpoint=run, out=tmp_path / "out", check_steps=2))
    loaded, robot = load_policy(run), Runner(out)
    (signals,) = (graph["outputs"] for key, graph in robot.description["graphs"].items() if key == "policy")
    meanings = {signal["name"]: signal["meaning"] for signal in signals}
    assert risk in meanings["risk"]
    assert uncertainty in meanings["uncertainty"]
    _, state = next(module.observations(loaded, 1))
    found = robot.step(*(state[key].numpy() for key in SENSED))[1:]
    latent = torch.from_numpy(robot.outputs["latent"])
    expected = loaded.collision_estimator(TensorDict(observation=state["observation"], latent=latent, batch_size=[1]))
    assert found == pytest.approx([expected["risk"].item(), expected["uncertainty"].item()], abs=1e-5)
    atoms = robot.outputs["atoms"][0]
    differs = abs(found[0] - atoms.mean()) if name == "cura-cvar" else abs(found[1] - atoms.var())
    assert differs > 1e-4


def test_torch_export_repeats_onnx(exported: Path, runner: Runner) -> None:
    """Catches a graph for PyTorch with other inputs, outputs or numbers than its ONNX twin."""
    recorded = np.load(exported / "recording.npz")
    graphs = {name: torch.export.load(exported / f"{name}.pt2").module() for name in ("map", "policy")}
    memory = torch.zeros(1, 242, 160), torch.full((1,), runner.description["initial_state"]["steps"])
    inputs = [torch.from_numpy(recorded[name][:1]) for name in SENSED]
    runner.step(*(recorded[name][0] for name in SENSED))
    stamps, steps, window = graphs["map"](*memory, *inputs[:4])
    for name, value in zip(("stamps", "steps", "window"), (stamps, steps, window), strict=True):
        np.testing.assert_array_equal(value.numpy(), runner.outputs[name])
    names = ("action", "latent", "atoms", "risk", "uncertainty")
    for name, value in zip(names, graphs["policy"](window, inputs[4]), strict=True):
        np.testing.assert_allclose(value.numpy(), runner.outputs[name], atol=1e-5)


def test_runner_needs_neither_torch_nor_the_package(exported: Path) -> None:
    """Catches a runner that works only where the policy was trained."""
    blocked = "import sys, runpy; sys.modules.update(dict.fromkeys(['torch', 'cura_torchrl', 'tensordict', 'onnx']))"
    code = f"{blocked}; runpy.run_path('runner.py', run_name='__main__')"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment["PYTHONPATH"] = str(Path(onnxruntime.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=exported, capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr[-1000:]
    found = json.loads(done.stdout)
    assert found.pop("milliseconds") > 0
    assert set(found) == {"action", "atoms", "risk", "uncertainty"}
    assert max(found.values()) <= 1e-5


def test_description_is_that_of_the_graphs(exported: Path) -> None:
    """Catches names, shapes, limits or hashes that a robot could not rely on, and paths of this machine."""
    text = (exported / "export.json").read_text(encoding="utf-8")
    description = json.loads(text)
    for name, graph in description["graphs"].items():
        session = onnxruntime.InferenceSession(exported / f"{name}.onnx", providers=["CPUExecutionProvider"])
        for side, found in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
            described = [(item["name"], item["shape"], "tensor(float)") for item in graph[side]]
            assert [(item.name, item.shape, item.type) for item in found] == described
    assert [part["scale"] for part in description["action"]["parts"]] == [0.8, 0.8, 1.0, 0.5, 0.5, 0.5]
    assert [part["name"] for part in description["observation"]] == list(OBSERVATION_SLICES)
    assert description["observation"][-1]["stop"] == 33
    assert (description["method"], description["map"]["decay"]) == ("cura-ppo", 0.9)
    files = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in exported.iterdir()}
    files.pop("export.json")
    assert description["sha256"] == files
    root = str(Path(module.__file__).parents[2])
    assert all(root.encode() not in file.read_bytes() for file in exported.iterdir())


def test_robot_that_stands_on_a_cells_centre_sees(runner: Runner) -> None:
    """Catches a bearing of nothing, 0 / 0, that would index any ray: odometry begins at such places."""
    pose = np.array([0.05, 0.05, 0.0], dtype=np.float32)
    runner.step(np.full(360, 3.0), pose, [9.0, 0.0, 0.0], [0.5, 0.5], np.zeros(33))
    window = runner.outputs["window"][0]
    assert np.isfinite(window).all()
    # The disc of 3 m has pi * 3^2 / 0.1^2 = 2827 cells; its rim of 2 pi * 3 / 0.1 = 188 may count or not.
    assert abs(window[0].sum() - 2827) < 188


def test_a_graph_that_answers_with_no_number_does_not_pass(runner: Runner, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a comparison that takes not-a-number for no difference."""
    step = runner.step

    def spoilt(*given: object) -> object:
        found = step(*given)
        runner.outputs["atoms"] = np.full_like(runner.outputs["atoms"], np.nan)
        return found

    monkeypatch.setattr(runner, "step", spoilt)
    found = replay(runner)
    assert np.isnan(found["atoms"])
    assert found["action"] <= module.TOLERANCE


def test_reset_forgets(runner: Runner) -> None:
    """Catches memory that stays."""
    inputs = (np.full(360, 3.0), np.zeros(3), [9.0, 0.0, 0.0], [0.5, 0.5], np.zeros(33))
    first = runner.step(*inputs)[0]
    runner.step(np.full(360, 6.0), *inputs[1:])
    runner.reset()
    np.testing.assert_array_equal(runner.step(*inputs)[0], first)


def test_runner_refuses_what_it_would_take_for_free_space(runner: Runner) -> None:
    """Catches a pose that is not a number, and a scan of another LiDAR."""
    good = {"pose": np.zeros(3), "object_pose": np.ones(3), "object_size": np.ones(2), "observation": np.zeros(33)}
    with pytest.raises(ValueError, match=r"sensor_pose is .*; accepted: finite numbers"):
        runner.step(np.ones(360), **{**good, "pose": [np.nan, 0.0, 0.0]})
    with pytest.raises(ValueError, match="scan has 720 numbers; accepted: 360"):
        runner.step(np.ones(720), **good)
    with pytest.raises(ValueError, match=r"object_size is \[1\.0, 0\.0\]; accepted: positive numbers"):
        runner.step(np.ones(360), **{**good, "object_size": [1.0, 0.0]})
    runner.step(np.full(360, np.nan), **good)


def test_graphs_that_differ_are_not_published(exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an export that is written although it computes something else."""

    def fill(stage: Path, loaded: object, check_steps: int) -> None:
        shutil.copytree(exported, stage, dirs_exist_ok=True)
        recorded = dict(np.load(stage / "recording.npz"))
        np.savez(stage / "recording.npz", **{**recorded, "risk": recorded["risk"] + 0.1})
        module._describe(stage, loaded, module.make_map(loaded))

    monkeypatch.setattr(module, "_fill", fill)
    with pytest.raises(RunError, match="graphs differ from PyTorch by"):
        module.export(ExportConfig(method="cura-ppo", out=tmp_path / "out"))
    assert list(tmp_path.iterdir()) == []


def test_policies_without_a_map_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a robot that would be given obstacles it cannot know."""
    loaded = load_policy("push")
    blind = dataclasses.replace(loaded, config=loaded.config.replace(perception="privileged"))
    monkeypatch.setattr(module, "load_policy", lambda _: blind)
    with pytest.raises(CheckpointError, match="perception of push is 'privileged'; accepted: 'map'"):
        module.export(ExportConfig(method="push", out=tmp_path / "out"))


def test_what_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a traceback that does not say what to install."""
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(UnavailableError, match=r"onnx is not installed; .*cura-torchrl\[export\]"):
        module.export(ExportConfig(method="push", out=tmp_path / "out"))


@pytest.mark.parametrize("out", [".", "..", "sub/.."])
def test_folder_without_a_name_of_its_own_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str) -> None:
    """Catches a traceback: the export is made beside its folder, under a name made of the folder's."""
    (tmp_path / "empty" / "sub").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "empty" / "sub")
    with pytest.raises(ValueError, match=r"out is .*; accepted: a folder that is empty or not there, by its name"):
        ExportConfig(method="push", out=Path(out))


def test_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    """Catches an export that replaces what somebody kept there."""
    (tmp_path / "notes").write_text("mine", encoding="utf-8")
    with pytest.raises(ValueError, match=r"out is .*; accepted: a folder that is empty or not there"):
        ExportConfig(method="push", out=tmp_path)
