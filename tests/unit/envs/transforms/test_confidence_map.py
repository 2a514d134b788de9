"""The confidence map against its definition and against scenes worked out by hand."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase, ParallelEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from cura_torchrl.envs.config import MapConfig
from cura_torchrl.envs.sensors import map_tensors
from cura_torchrl.envs.transforms import ConfidenceMap, confidence_map
from tests.contracts.transform import STEPS, TransformContract
from tests.scenes import MAX_RANGE, NUM_RAYS, ReferenceMap, ScanEnv, cast_rays

CONFIG = MapConfig(extent_x=(-4.0, 6.0), extent_y=(-4.0, 4.0), window=40)


def make_map(config: MapConfig = CONFIG, **kwargs) -> ConfidenceMap:
    """Return a small map."""
    return ConfidenceMap(config, num_rays=NUM_RAYS, max_range=MAX_RANGE, **kwargs)


def make_env(labels: tuple[int, ...] = (0, 1, 2), *, has_object: bool = True, **kwargs) -> TransformedEnv:
    """Module-level, so that it reaches worker processes."""
    keys = {} if has_object else {"object_keys": None}
    return TransformedEnv(ScanEnv(labels, has_object=has_object), make_map(**keys, **kwargs))


def scan_of(rectangles: list[tuple[float, ...]], pose: tuple[float, ...] = (0.0, 0.0, 0.0)) -> TensorDict:
    """Return what a sensor sees of rectangles (x, y, yaw, length, width)."""
    ranges = cast_rays(np.array(rectangles).reshape(-1, 5), np.array(pose))
    return TensorDict(
        {
            "scan": torch.tensor(ranges, dtype=torch.float32)[None],
            "sensor_pose": torch.tensor([pose], dtype=torch.float32),
        },
        [1],
    )


class TestContract(TransformContract):
    """What holds for every transform."""

    def make_transform(self) -> ConfidenceMap:  # noqa: D102
        return make_map()

    def make_base_env(self, labels: tuple[int, ...]) -> EnvBase:  # noqa: D102
        return ScanEnv(labels)


class TestAdvance:
    """The map's update as a pure function."""

    def test_gives_the_windows_of_the_transform_and_changes_no_input(self) -> None:
        """Catches another order of the inputs, a scan that is not cleaned, and state that is changed in place."""
        transform = make_map()
        scans = scan_of([(2.0, 0.0, 0.0, 0.4, 0.4), (-1.0, 1.5, 0.3, 0.4, 0.4)])
        scans["scan"][0, 3] = float("nan")
        scans["object_pose"], scans["object_size"] = torch.tensor([[2.0, 0.0, 0.0]]), torch.full((1, 2), 0.4)
        state = transform.initial_state(1)
        for _ in range(3):
            scans["sensor_pose"] = scans["sensor_pose"] + torch.tensor([[0.11, -0.07, 0.2]])
            before = [value.clone() for value in state]
            inputs = [scans[key] for key in ("scan", "sensor_pose", "object_pose", "object_size")]
            *after, window = transform.advance(*state, *inputs)
            assert all(torch.equal(value, kept) for value, kept in zip(state, before, strict=True))
            expected = transform(scans.clone())["confidence_map"]
            assert expected[:, 1].any()
            assert (window != expected).float().mean() < 1e-3  # cells between two rays may ask either
            state = after


class TestDefinition:
    """The whole transform against the slow reference."""

    @pytest.mark.parametrize("decay", [0.0, 0.9, 1.0])
    @pytest.mark.parametrize("has_object", [False, True])
    def test_equals_the_definition_cell_by_cell(self, decay: float, has_object: bool) -> None:
        """Catches any departure from the definition, over several episodes with partial resets."""
        config = MapConfig(extent_x=CONFIG.extent_x, extent_y=CONFIG.extent_y, window=40, decay=decay)
        env = make_env((0, 1, 2, 3), has_object=has_object, config=config)
        base, reference = env.base_env, [None] * 4

        def expected() -> np.ndarray:
            windows = []
            for row in range(4):
                if base.time[row] == 0:
                    reference[row] = ReferenceMap(CONFIG.extent_x, CONFIG.extent_y, 0.1, decay, 40)
                scan, pose, box = base.situation(row)
                windows.append(reference[row].observe(scan, pose, box if has_object else None))
            return np.stack(windows)

        carrier = env.reset()
        compare(carrier["confidence_map"], expected())
        for _ in range(12):
            step, following = env.step_and_maybe_reset(carrier.set("action", torch.zeros(4, 1)))
            # Windows of rows that go on are checked now; rows that were reset show the new episode in the carrier.
            going = ~step["next", "done"].flatten()
            truth = expected()
            compare(step["next", "confidence_map"][going], truth[going.numpy()])
            compare(following["confidence_map"], truth)
            carrier = following

    def test_channels_are_views_of_one_map(self) -> None:
        """Catches a channel option that changes the map itself."""
        data = scan_of([(2.0, 0.0, 0.0, 0.4, 0.4)])
        windows = {}
        for channels in ("confidence+occupancy", "product", "confidence"):
            config = MapConfig(extent_x=CONFIG.extent_x, extent_y=CONFIG.extent_y, window=50, channels=channels)
            transform = make_map(config, object_keys=None)
            transform(data.clone())
            empty = scan_of([]).set("scan", torch.zeros(1, NUM_RAYS))  # a blind step: everything fades to 0.9
            windows[channels] = transform(empty)["confidence_map"]
        confidence, occupancy = windows["confidence+occupancy"].unbind(1)
        assert occupancy.sum() > 0
        assert torch.equal(windows["confidence"][:, 0], confidence)
        assert torch.equal(windows["product"][:, 0], confidence * occupancy)


def compare(actual: torch.Tensor, expected: np.ndarray) -> None:
    """Allow two cells a window to differ: on a boundary, float32 and float64 may decide differently."""
    wrong = (np.abs(actual.numpy() - expected) > 1e-6).sum((1, 2, 3))
    assert (wrong <= 2).all(), wrong


class TestScenes:
    """Scenes whose map can be worked out by hand."""

    def test_a_wall_is_occupied_before_it_free_behind_it_unseen(self) -> None:
        """Catches swapped channels and a wall one cell off."""
        # Wall face at x = 1.95, seen from the origin: in front of it free, its cell column occupied, behind it unseen.
        window = make_map(object_keys=None)(scan_of([(2.45, 0.0, 0.0, 1.0, 6.0)]))["confidence_map"][0]
        confidence, occupancy = window
        # Row i is at x = (i - 19.5) * 0.1: row 38 (1.85) is nearer than 1.95 - 0.0707 = 1.879; row 39 holds the face.
        middle = slice(18, 22)
        assert (confidence[20:39, middle] == 1.0).all()
        assert (occupancy[20:39, middle] == 0.0).all()
        assert (confidence[39, middle] == 1.0).all()
        assert (occupancy[39, middle] == 1.0).all()
        config = MapConfig(extent_x=CONFIG.extent_x, extent_y=CONFIG.extent_y, window=60)
        behind = make_map(config, object_keys=None)(scan_of([(2.45, 0.0, 0.0, 1.0, 6.0)]))["confidence_map"][0]
        assert (behind[:, 50:, 28:32] == 0.0).all()  # x from 2.05 on

    def test_a_miss_frees_but_marks_nothing(self) -> None:
        """Catches a miss that is taken for an obstacle at the maximum range."""
        config = MapConfig(extent_x=(-12.0, 12.0), extent_y=(-12.0, 12.0), window=240)
        confidence, occupancy = make_map(config, object_keys=None)(scan_of([]))["confidence_map"][0]
        assert occupancy.sum() == 0.0
        # Disc of radius 10 - 0.0707 m: 309.7 m^2, 30,972 cells but for its edge.
        assert confidence.sum().item() == pytest.approx(math.pi * (10 - 0.0707) ** 2 * 100, rel=2e-3)

    def test_the_object_casts_a_shadow_and_is_no_obstacle(self) -> None:
        """Catches a pushed object that marks itself as an obstacle, and a shadow that is taken for free."""
        box = (1.2, 0.0, 0.0, 0.5, 0.5)
        data = scan_of([box])
        data["object_pose"], data["object_size"] = torch.tensor([box[:3]]), torch.tensor([box[3:]])
        data["scan"] += 0.03 * torch.randn(1, NUM_RAYS)  # three times the LiDAR's noise
        confidence, occupancy = make_map()(data)["confidence_map"][0]
        assert occupancy.sum() == 0.0
        # Straight behind the box (x from 1.45 on, |y| < 0.25 * 1.45 / 0.95) nothing is seen.
        assert (confidence[36:, 17:23] == 0.0).all()
        # Beside it, everything is.
        assert (confidence[36:, :8] == 1.0).all()

    def test_an_obstacle_beside_the_object_is_seen(self) -> None:
        """Catches an object's footprint that hides real obstacles next to it."""
        box, obstacle = (1.2, 0.0, 0.0, 0.5, 0.5), (1.2, 0.75, 0.0, 0.4, 0.4)
        data = scan_of([box, obstacle])
        data["object_pose"], data["object_size"] = torch.tensor([box[:3]]), torch.tensor([box[3:]])
        occupancy = make_map()(data)["confidence_map"][0, 1]
        # The obstacle's near face: x = 1.0, y from 0.55 to 0.95, four cells.
        assert occupancy[29:31, 25:29].amax(0).sum() == 4.0
        assert occupancy[:, :25].sum() == 0.0

    def test_the_robot_is_no_obstacle(self) -> None:
        """Catches rays that end on the robot itself, and what is remembered under it."""
        transform = make_map(object_keys=None)
        wall = scan_of([(0.95, 0.0, 0.0, 0.1, 0.6)])  # face at x = 0.9
        assert transform(wall)["confidence_map"][0, 1].sum() > 0
        # Drive onto it while blind: the robot's rectangle reaches 0.48 m ahead and hides it.
        blind = scan_of([], (0.7, 0.0, 0.0)).set("scan", torch.zeros(1, NUM_RAYS))
        assert transform(blind)["confidence_map"][0, 1].sum() == 0.0
        near = scan_of([(0.4, 0.0, 0.0, 0.1, 0.2)])  # a ray that ends within the robot's rectangle
        fresh = make_map(object_keys=None)(near)["confidence_map"][0, 1]
        assert fresh.sum() == 0.0

    def test_confidence_fades_and_occupancy_stays(self) -> None:
        """Catches a decay off by one step, and obstacles that are forgotten."""
        transform = make_map(object_keys=None)
        window = transform(scan_of([(1.5, 0.0, 0.0, 0.4, 0.4)]))["confidence_map"][0]
        seen, occupied = window[0] == 1.0, window[1] == 1.0
        assert occupied.sum() >= 4
        blind = scan_of([]).set("scan", torch.zeros(1, NUM_RAYS))
        for step in range(1, 31):
            confidence, occupancy = transform(blind.clone())["confidence_map"][0]
            # Unseen for k steps: 0.9^k; the table is float64 rounded to float32.
            torch.testing.assert_close(
                confidence[seen], torch.full_like(confidence[seen], 0.9**step), rtol=1e-7, atol=0.0
            )
            assert torch.equal(occupancy == 1.0, occupied)
            assert (confidence[~seen] == 0.0).all()

    def test_a_cleared_obstacle_is_free_again(self) -> None:
        """Catches an occupancy that never goes away."""
        transform = make_map(object_keys=None)
        assert transform(scan_of([(1.5, 0.0, 0.0, 0.4, 0.4)]))["confidence_map"][0, 1].sum() > 0
        assert transform(scan_of([]))["confidence_map"][0, 1].sum() == 0.0

    @pytest.mark.parametrize("quarter", [1, 2, 3])
    def test_turning_on_the_spot_turns_the_window(self, quarter: int) -> None:
        """Catches a window that is fixed to the world, or mirrored."""
        walls = [(1.53, 0.42, 0.0, 0.4, 0.4), (-0.5, -1.2, 0.3, 0.6, 0.4)]  # no face on a cell's edge
        straight = make_map(object_keys=None)(scan_of(walls))["confidence_map"]
        turned = make_map(object_keys=None)(scan_of(walls, (0.0, 0.0, quarter * math.pi / 2)))["confidence_map"]
        robot = torch.ones(40, 40)
        robot[14:26, 14:26] = 0.0  # the robot's own rectangle turns with it
        assert torch.equal(torch.rot90(straight, -quarter, (2, 3)) * robot, turned * robot)
        assert (straight[:, 1] * robot).sum() > 0

    def test_outside_of_the_extent_is_unseen(self) -> None:
        """Catches an edge that is repeated, and hits beyond the extent."""
        data = scan_of([(5.0, 7.0, 0.0, 1.0, 1.0)], (5.5, 3.5, 0.0))
        window = make_map(object_keys=None)(data)["confidence_map"][0]
        # Extent ends at x = 6 (0.5 m ahead: rows from 25 on) and y = 4 (0.5 m to the left: columns from 25 on).
        assert (window[:, 25:] == 0.0).all()
        assert (window[:, :, 25:] == 0.0).all()
        assert (window[0, :25, :25] == 1.0).all()

    def test_bad_ranges_are_unseen_and_bad_poses_raise(self) -> None:
        """Catches a NaN that reads as free space."""
        data = scan_of([]).set("scan", torch.full((1, NUM_RAYS), math.nan))
        assert make_map(object_keys=None)(data)["confidence_map"].sum() == 0.0
        for bad in (math.nan, math.inf):
            with pytest.raises(RuntimeError, match="out of bounds"):
                make_map(object_keys=None)(scan_of([]).set("sensor_pose", torch.full((1, 3), bad)))

    @pytest.mark.parametrize(
        ("key", "column", "value", "message"),
        [
            ("sensor_pose", 2, math.nan, "sensor's pose"),
            ("object_pose", 0, math.nan, "object's pose"),
            ("object_pose", 2, -math.inf, "object's pose"),
            ("object_size", 1, math.nan, "object's size"),
            ("object_size", 0, math.inf, "object's size"),
            ("object_size", 0, 0.0, "object's size"),
            ("object_size", 1, -0.5, "object's size"),
        ],
    )
    def test_an_impossible_object_raises(self, key: str, column: int, value: float, message: str) -> None:
        """Catches an object that is no rectangle and takes every obstacle out of the window without a word."""
        data = scan_of([(1.5, 0.0, 0.0, 0.4, 0.4)])
        data["object_pose"], data["object_size"] = torch.tensor([[-1.5, 0.0, 0.0]]), torch.full((1, 2), 0.5)
        assert make_map()(data.clone())["confidence_map"][0, 1].any()
        data[key][0, column] = value
        with pytest.raises(RuntimeError, match=message):
            make_map()(data)

    def test_an_object_seen_between_free_steps_is_an_obstacle_only_then(self) -> None:
        """Catches an order of stamps in which a later free observation does not outdo an earlier obstacle."""
        transform, wall = make_map(object_keys=None), scan_of([(1.5, 0.0, 0.0, 0.4, 0.4)])
        expected = [False, True, True, False, True]
        for scan, is_occupied in zip((scan_of([]), wall, wall, scan_of([]), wall), expected, strict=True):
            assert bool(transform(scan.clone())["confidence_map"][0, 1].any()) == is_occupied

    def test_accumulated_confidence_outlasts_an_episode(self) -> None:
        """Catches a table of powers that ends early where nothing decays."""
        config = MapConfig(extent_x=CONFIG.extent_x, extent_y=CONFIG.extent_y, window=40, decay=1.0)
        transform = make_map(config, object_keys=None)
        seen = transform(scan_of([]))["confidence_map"][0, 0]
        transform._steps += 5000.0
        later = transform(scan_of([]).set("scan", torch.zeros(1, NUM_RAYS)))["confidence_map"][0, 0]
        assert torch.equal(later, seen)
        assert seen.any()


class TestState:
    """What the transform remembers, and for whom."""

    def test_partial_reset_touches_only_the_masked_rows(self) -> None:
        """Catches a reset that clears or advances other rows' maps."""
        env, twin = make_env((0, 3, 6)), make_env((0, 3, 6))
        carriers = []
        for each in (env, twin):
            carrier = each.reset()
            for _ in range(2):
                carrier = each.step_mdp(each.step(carrier.set("action", torch.zeros(3, 1))))
            carriers.append(carrier)
        mask = torch.tensor([[False], [True], [False]])
        reset = env.reset(carriers[0].clone().set("_reset", mask))["confidence_map"]
        assert torch.equal(reset[[0, 2]], carriers[0]["confidence_map"][[0, 2]])
        after = env.step(carriers[0].set("action", torch.zeros(3, 1)))["next", "confidence_map"]
        untouched = twin.step(carriers[1].set("action", torch.zeros(3, 1)))["next", "confidence_map"]
        assert torch.equal(after[[0, 2]], untouched[[0, 2]])
        assert not torch.equal(after[1], untouched[1])

    @pytest.mark.parametrize("has_object", [False, True])
    def test_serves_a_foreign_environment(self, has_object: bool) -> None:
        """Catches a need for keys that only the pushing task has."""
        check_env_specs(make_env((0, 1), has_object=has_object), break_when_any_done="both", seed=0)

    def test_reads_float64(self) -> None:
        """Catches a dtype that is assumed."""
        env = TransformedEnv(ScanEnv((0, 1), dtype=torch.float64), make_map())
        assert env.rollout(3)["confidence_map"].dtype == torch.float32

    def test_tensors_do_what_the_kernels_do(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Catches two definitions of the map: one on the CPU, one elsewhere."""
        kernels = make_env(tuple(range(7))).rollout(STEPS, break_when_any_done=False)["confidence_map"]
        monkeypatch.setattr(confidence_map, "map_kernels", map_tensors)
        tensors = make_env(tuple(range(7))).rollout(STEPS, break_when_any_done=False)["confidence_map"]
        # Cells whose centre lies on a border between two rays, or two cells, to 1e-4.
        assert (tensors != kernels).float().mean() < 1e-4

    def test_chunks_change_nothing(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Catches a chunk whose rows are mixed up."""
        monkeypatch.setattr(confidence_map, "map_kernels", map_tensors)
        expected = make_env(tuple(range(7))).rollout(STEPS, break_when_any_done=False)
        monkeypatch.setattr(map_tensors, "_CHUNK_CELLS", 20_000)  # two maps of 102 x 80 cells
        actual = make_env(tuple(range(7))).rollout(STEPS, break_when_any_done=False)
        assert torch.equal(actual["confidence_map"], expected["confidence_map"])

    def test_two_threads_give_the_same_bits(self) -> None:
        """Catches results that depend on how a loop is split."""
        expected = make_env((0, 1, 2)).rollout(STEPS, break_when_any_done=False)["confidence_map"]
        torch.set_num_threads(2)
        try:
            actual = make_env((0, 1, 2)).rollout(STEPS, break_when_any_done=False)["confidence_map"]
        finally:
            torch.set_num_threads(1)
        assert torch.equal(actual, expected)

    def test_the_map_is_no_part_of_the_state_dict(self) -> None:
        """Catches checkpoints that hold maps, and that load only into the same batch."""
        env = make_env()
        env.reset()
        assert not env.state_dict()

    def test_a_step_before_the_reset_is_refused(self) -> None:
        """Catches a batch that changes without a reset."""
        transform = make_map(object_keys=None)
        transform(scan_of([]))
        with pytest.raises(ValueError, match="accepted: the batch of the last whole reset"):
            transform(torch.cat([scan_of([]), scan_of([])]))

    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"in_keys": ("scan",)}, "in_keys"),
            ({"object_keys": ("object_pose",)}, "object_keys"),
            ({"num_rays": 0}, "num_rays"),
        ],
    )
    def test_impossible_arguments_are_refused(self, kwargs: dict, message: str) -> None:
        """Catches a typo that would surface as an index error later."""
        with pytest.raises(ValueError, match=message):
            ConfidenceMap(CONFIG, **({"num_rays": NUM_RAYS, "max_range": MAX_RANGE} | kwargs))

    def test_another_number_of_rays_is_refused(self) -> None:
        """Catches a scan that is read with the wrong bearings."""
        with pytest.raises(ValueError, match="accepted: num_rays = 180"):
            TransformedEnv(ScanEnv((0,)), ConfidenceMap(CONFIG, num_rays=180, max_range=MAX_RANGE)).rollout(1)

    def test_a_sensor_of_shorter_range_is_refused(self) -> None:
        """Catches misses that are drawn as a wall: a ray of 10 m at most, where only 12 m would be a miss."""
        with pytest.raises(ValueError, match=r"bound of the scan is 10\.0; accepted: max_range = 12\.0 or more"):
            TransformedEnv(ScanEnv((0,)), ConfidenceMap(CONFIG, num_rays=NUM_RAYS, max_range=12.0)).rollout(1)
        # A longer one is cut off: what lies beyond is a miss.
        window = TransformedEnv(ScanEnv((0,)), ConfidenceMap(CONFIG, num_rays=NUM_RAYS, max_range=0.9)).rollout(1)
        assert window["confidence_map"][:, :, 0].any()
        assert not window["confidence_map"][:, :, 1].any()

    def test_an_environment_without_a_scan_is_refused(self) -> None:
        """Catches a map that stays empty without a word."""
        env = TransformedEnv(ScanEnv((0,)), make_map(in_keys=("other", "sensor_pose")))
        with pytest.raises(KeyError, match="accepted: one that holds"):
            env.rollout(1)

    def test_works_in_worker_processes(self) -> None:
        """Catches a transform that cannot be pickled or does not survive shared memory."""
        env = ParallelEnv(2, partial(make_env, (0, 1)), mp_start_method="spawn")
        try:
            actual = env.rollout(STEPS, break_when_any_done=False)["confidence_map"]
        finally:
            env.close()
        expected = make_env((0, 1)).rollout(STEPS, break_when_any_done=False)["confidence_map"]
        assert torch.equal(actual[0], expected)
        assert torch.equal(actual[1], expected)
