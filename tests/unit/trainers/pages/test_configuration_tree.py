"""The tree of a configuration: every field, its meaning, and what differs."""

from __future__ import annotations

import dataclasses

from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.pages.configuration_tree import configuration_tree, count_differences, field_docstrings
from tests.pages import Reader


def fields(config: object) -> list[str]:
    """Return the names of all fields that hold no part of the configuration."""
    found = []
    for item in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, item.name)
        found += fields(value) if dataclasses.is_dataclass(value) else [item.name]
    return found


def test_every_field_has_a_row_with_its_meaning() -> None:
    """Catches a part that is left out, and a field whose docstring is not found."""
    rows = [row for row in Reader(configuration_tree(TrainConfig(), TrainConfig())).rows if row[0] != "Field"]
    assert sorted(row[0] for row in rows) == sorted(fields(TrainConfig()))
    assert [row[0] for row in rows if not row[3]] == []


def test_what_differs_stands_out_with_both_values() -> None:
    """Catches a difference deep down that nobody sees, and parts that are open without reason."""
    base = TrainConfig()
    task = dataclasses.replace(base.env.task, episode_time=7.0)
    changed = base.replace(num_envs=4096, env=dataclasses.replace(base.env, task=task))
    page = configuration_tree(changed, base)
    assert count_differences(changed, base) == 2
    assert page.count('<tr class="marked">') == 2
    assert page.count("<details open>") == 2  # env and env.task
    rows = Reader(page).rows
    assert next(row[1:3] for row in rows if row[0] == "num_envs") == ["4,096", "64"]
    assert next(row[1:3] for row in rows if row[0] == "episode_time") == ["7.0", str(base.env.task.episode_time)]


def test_docstrings_of_a_class_without_source_are_empty() -> None:
    """Catches a report that fails on a class made at run time."""
    assert field_docstrings(dataclasses.make_dataclass("Made", ["x"])) == {}
