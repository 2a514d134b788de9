"""Collecting maps and training their autoencoder, on a toy environment with analytic scans."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.data import Composite, UnboundedDiscrete

from cura_torchrl.envs.config import MapConfig
from cura_torchrl.modules.map_vae import MapVAE
from cura_torchrl.trainers import pretrain_map
from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.pretrain_map import measure
from cura_torchrl.trainers.training.map_dataset import MapDataset, RandomPusher, pack_maps, unpack_maps, unpacking_table
from cura_torchrl.trainers.training.pretrain_map_config import PretrainMapConfig
from tests.scenes import ScanEnv

if TYPE_CHECKING:
    from pathlib import Path

    from torchrl.envs import EnvBase

MAP = MapConfig(extent_x=(-3.0, 5.0), extent_y=(-3.0, 3.0), window=40)


class EpisodeEnv(ScanEnv):
    """The toy environment with the scenario's index, which maps are held out by."""

    def __init__(self, labels: tuple[int, ...]) -> None:
        super().__init__(labels)
        spec = self.observation_spec.clone()
        spec["episode"] = UnboundedDiscrete(shape=(len(labels), 1), dtype=torch.int64)
        self.set_spec_lock_(False)
        self.observation_spec = Composite(dict(spec.items()), shape=(len(labels),))
        self.set_spec_lock_(True)

    def _emit(self) -> TensorDictBase:
        return (
            super()
            ._emit()
            .set("episode", torch.tensor(self.episode)[:, None] * len(self.labels) + torch.tensor(self.labels)[:, None])
        )


def toy_env(config: PretrainMapConfig, worker: int, *, occlusion: bool, simulator: str) -> EnvBase:
    """Return the toy environment of a worker; module-level, so that it reaches other processes."""
    first = worker * config.num_envs
    return EpisodeEnv(tuple(range(first, first + config.num_envs)))


def still() -> TensorDictModuleBase:
    """Return a policy that does nothing."""
    return TensorDictModule(lambda scan: torch.zeros(*scan.shape[:-1], 1), in_keys=["scan"], out_keys=["action"])


def tiny(tmp_path: Path, **kwargs) -> PretrainMapConfig:
    """Return a configuration that takes a second."""
    fields = {
        "run_dir": tmp_path,
        "map": MAP,
        "num_maps": 120,
        "num_envs": 3,
        "num_workers": 1,
        "epochs": 2,
        "batch_size": 32,
        "threads": 1,
        "held_out": 0.25,
        "latent_size": 8,
    }
    return PretrainMapConfig(**(fields | kwargs))


class TestStorage:
    """One byte a cell."""

    def test_bytes_come_back_as_maps(self) -> None:
        """Catches swapped bits, a lost cell, or a transposed window."""
        maps = torch.rand(5, 2, 8, 8)
        maps[:, 1] = maps[:, 1].round()
        back = unpack_maps(
            pack_maps(maps), torch.zeros(5, dtype=torch.int64), unpacking_table(0.9, (0.9,), "confidence+occupancy")
        )
        assert torch.equal(back[:, 1], maps[:, 1])
        # 127 levels: half a level is 0.004; what is seen is never stored as unseen, which costs up to a level there.
        assert (back[:, 0] - maps[:, 0]).abs().max() <= 1 / 127
        assert back.is_contiguous(memory_format=torch.channels_last)

    @pytest.mark.parametrize("steps", [0, 1, 5, 12])
    def test_other_decays_follow_from_one(self, steps: int) -> None:
        """Catches a wrong exponent: seen k steps ago, 0.9^k has to become 0.8^k, 1, and 0 or 1."""
        maps = torch.tensor([0.9**steps, 1.0]).view(1, 2, 1, 1)
        table = unpacking_table(0.9, (0.8, 1.0, 0.0), "confidence")
        values = [unpack_maps(pack_maps(maps), torch.tensor([i]), table).item() for i in range(3)]
        # The relative error of half a level in 0.9^k, times ln 0.8 / ln 0.9 = 2.1.
        assert values[0] == pytest.approx(0.8**steps, rel=2.2 * 0.5 / 127 / 0.9**steps)
        assert values[1] == 1.0
        assert values[2] == float(steps == 0)

    def test_an_unseen_cell_stays_unseen(self) -> None:
        """Catches 0 to the power 0."""
        table = unpacking_table(0.9, (0.9, 1.0, 0.0), "confidence")
        assert table[:, 0].abs().sum() == 0.0

    def test_product_and_confidence_follow_from_both(self) -> None:
        """Catches a channel option that the autoencoder and the environment understand differently."""
        both, product, confidence = (
            unpacking_table(0.9, (0.9,), name) for name in ("confidence+occupancy", "product", "confidence")
        )
        assert torch.equal(product[..., 0], both[..., 0] * both[..., 1])
        assert torch.equal(confidence[..., 0], both[..., 0])

    def test_maps_of_an_episode_are_never_split(self) -> None:
        """Catches held-out maps whose neighbours were trained on."""
        episodes = torch.arange(40) % 10
        train, held_out = MapDataset(torch.zeros(40, 1, dtype=torch.uint8), episodes).split(0.2)
        assert set(episodes[held_out].tolist()) == {0, 5}
        assert not set(episodes[held_out].tolist()) & set(episodes[train].tolist())
        assert len(train) + len(held_out) == 40

    def test_maps_collected_otherwise_are_not_used(self, tmp_path: Path) -> None:
        """Catches stale maps after a change of the configuration."""
        data = MapDataset(torch.ones(2, 4, dtype=torch.uint8), torch.tensor([0, 1]))
        data.save(tmp_path / "maps.pt", "this")
        assert MapDataset.load(tmp_path / "maps.pt", "other") is None
        assert MapDataset.load(tmp_path / "none.pt", "this") is None
        loaded = MapDataset.load(tmp_path / "maps.pt", "this")
        assert torch.equal(loaded.codes, data.codes)
        assert torch.equal(loaded.episodes, data.episodes)


class TestMeasure:
    """Held-out figures, by hand."""

    def test_figures_by_hand(self) -> None:
        """Catches a neighbourhood that is too wide, and cells beyond the reach that count."""

        class Fixed(MapVAE):
            def reconstruct(self, maps: torch.Tensor) -> torch.Tensor:
                shown = torch.full_like(maps, 0.25)
                shown[:, 0] = maps[:, 0] * 0.5
                shown[:, 1, 10, 11] = 0.9  # one cell from the first: found and right
                shown[:, 1, 12, 16] = 0.9  # two cells from the second: neither
                shown[:, 1, 0, 0] = 0.9  # beyond the reach
                return shown

        maps = torch.zeros(1, 2, 20, 20)
        maps[:, 0, :10] = 1.0
        for row, column in ((10, 10), (12, 14), (19, 19)):
            maps[:, 1, row, column] = 1.0
        # 0.5 m at 0.1 m: cells within 5 of the centre 9.5; (12, 14) is at hypot(2.5, 4.5) = 5.15, so 0.52 m is taken.
        figures = measure(Fixed(window=20), iter([maps]), MapConfig(window=20), reach=0.52)
        assert figures["recall"] == 0.5
        # (12, 16) is at hypot(2.5, 6.5) = 6.96: beyond the reach; (10, 11) is right.
        assert figures["precision"] == 1.0
        assert figures["confidence_error"] == pytest.approx(0.25)  # half of the cells are off by 0.5

    def test_maps_without_obstacles_have_nothing_to_find(self) -> None:
        """Catches a division by zero."""
        vae = MapVAE(window=20)
        torch.nn.init.constant_(vae.decoder[-1].paint.bias, -20.0)
        figures = measure(vae, iter([torch.zeros(1, 2, 20, 20)]), MapConfig(window=20))
        assert (figures["recall"], figures["precision"]) == (1.0, 1.0)


class TestPretrainMap:
    """The whole of it."""

    def test_leaves_weights_figures_and_picture(self, tmp_path: Path) -> None:
        """Catches a file that is missing, or weights that do not load."""
        config = tiny(tmp_path)
        figures = pretrain_map.pretrain_map(config, make_env=toy_env, policy=still())
        vae = MapVAE.load(tmp_path / pretrain_map.WEIGHTS_NAME)
        assert vae(torch.zeros(2, 2, 40, 40)).shape == (2, 8)
        record = json.loads((tmp_path / pretrain_map.FIGURES_NAME).read_text())
        assert record["figures"] == figures
        assert {
            f"{name}, decay {decay}"
            for name in ("bce", "confidence_error", "recall", "precision")
            for decay in ("0.9", "1")
        } < set(figures)
        assert figures["train_maps"] + figures["held_out_maps"] == 120
        assert (tmp_path / pretrain_map.PICTURE_NAME).stat().st_size > 1000
        assert not list(tmp_path.glob("*partial*"))

    def test_a_training_that_was_cut_off_goes_on(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Catches a resume that repeats or skips an epoch, or collects again."""
        whole = tiny(tmp_path / "whole")
        pretrain_map.pretrain_map(whole, make_env=toy_env, policy=still())
        torch.manual_seed(5)
        cut = dataclasses.replace(whole, run_dir=tmp_path / "cut")
        step, count = torch.optim.Adam.step, 0

        def fail_in_second_epoch(*args, **kwargs) -> object:
            nonlocal count
            count += 1
            if count > 4:
                raise KeyboardInterrupt
            return step(*args, **kwargs)

        with monkeypatch.context() as patch:
            patch.setattr(torch.optim.Adam, "step", fail_in_second_epoch)
            with pytest.raises(KeyboardInterrupt):
                pretrain_map.pretrain_map(cut, make_env=toy_env, policy=still())

        def no_env(*args, **kwargs) -> EnvBase:
            pytest.fail("collects again")

        pretrain_map.pretrain_map(cut, make_env=no_env, policy=still())
        first, second = (MapVAE.load(c.run_dir / pretrain_map.WEIGHTS_NAME).state_dict() for c in (whole, cut))
        for name, value in first.items():
            assert torch.equal(value, second[name]), name

    def test_too_few_maps_are_told_in_one_line(self, tmp_path: Path) -> None:
        """Catches a traceback: one world that is seen once is one episode, which cannot be split."""
        with pytest.raises(RunError, match=r"num_maps is 1, of which \d+ are held out; accepted: enough for two"):
            pretrain_map.pretrain_map(tiny(tmp_path, num_maps=1, num_envs=1), make_env=toy_env, policy=still())

    @pytest.mark.parametrize("channels", ["product", "confidence"])
    def test_serves_every_choice_of_channels(self, tmp_path: Path, channels: str) -> None:
        """Catches a network with the wrong number of channels."""
        config = tiny(tmp_path, map=dataclasses.replace(MAP, channels=channels), epochs=1)
        figures = pretrain_map.pretrain_map(config, make_env=toy_env, policy=still())
        assert ("recall, decay 0.9" in figures) is (channels == "product")
        assert MapVAE.load(tmp_path / pretrain_map.WEIGHTS_NAME).shape["channels"] == 1

    @pytest.mark.slow
    def test_workers_share_the_scenarios(self, tmp_path: Path) -> None:
        """Catches processes that play the same scenes, or that do not end."""
        config = tiny(tmp_path, num_workers=2, num_maps=96, epochs=1)
        pretrain_map.pretrain_map(config, make_env=toy_env, policy=still())
        data = torch.load(tmp_path / pretrain_map.MAPS_NAME, weights_only=True)
        assert data["codes"].shape == (96, 1600)
        assert len(data["episodes"].unique()) >= 6

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"map": dataclasses.replace(MAP, decay=1.0)}, "map.decay"),
            ({"decays": ()}, "decays"),
            ({"decays": (1.1,)}, "decays"),
            ({"num_maps": 0}, "num_maps"),
            ({"held_out": 0.0}, "held_out"),
            ({"lr": 0.0}, "lr"),
        ],
    )
    def test_impossible_configurations_are_refused(self, tmp_path: Path, change: dict, message: str) -> None:
        """Catches a mistake that would surface after an hour of collecting."""
        with pytest.raises(ValueError, match=message):
            tiny(tmp_path, **change)


class TestRandomPusher:
    """What the robot does while maps are collected."""

    def test_noise_is_smooth_and_bounded(self) -> None:
        """Catches white noise, which would average out, and actions out of bounds."""
        torch.manual_seed(0)
        policy = RandomPusher(noise=0.4)
        policy.pusher = policy.avoider = TensorDictModule(
            lambda o: torch.zeros(len(o), 6), in_keys=["observation"], out_keys=["action"]
        )
        data = TensorDict({"observation": torch.zeros(64, 33)}, [64])
        actions = torch.stack([policy(data.clone())["action"] for _ in range(200)])
        assert actions.abs().max() <= 1.0
        assert actions.std().item() == pytest.approx(0.4, rel=0.1)
        before, after = actions[100:-1].flatten(), actions[101:].flatten()
        # First-order autoregression with 0.9: so is its correlation from step to step (a little less by clipping).
        assert torch.corrcoef(torch.stack([before, after]))[0, 1].item() == pytest.approx(0.9, abs=0.03)
