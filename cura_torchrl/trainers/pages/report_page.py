"""The sections of the report, as HTML."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.info import provenance
from cura_torchrl.trainers.methods import PRESETS, method, method_label
from cura_torchrl.trainers.pages import markup
from cura_torchrl.trainers.pages.configuration_tree import configuration_tree, count_differences
from cura_torchrl.trainers.pages.demo_page import HOW_TO_READ, Card, scene_article
from cura_torchrl.trainers.pages.folder_section import Folder, folder_html
from cura_torchrl.trainers.pictures.curves import columns_by_group, curves_figure, label_of, smooth

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from cura_torchrl.trainers.loaded_policy import LoadedPolicy
    from cura_torchrl.trainers.pages.report_config import ReportConfig
    from cura_torchrl.trainers.pictures.curves import Rows

_INTRODUCTION = (
    'A robot (<span class="robot">green</span>) pushes a box (<span class="object">magenta</span>) to a goal and sees '
    "through one planar LiDAR. The box hides what lies ahead of it, while obstacles (grey) appear on the way. Beside "
    "the policy a network is trained, the distributional collision estimator (DCE), which predicts the distribution of "
    "the collision possibility C. From it a method takes the risk R and the uncertainty U: the paper the mean and the "
    "variance."
)
_LAST = 15
"""Updates that the table's means are over [1]."""
_SUMMARY = ("success", "success_*", "collision", "timeout", "risk_auroc", "reward")


_HOW_TO_READ_CURVES = (
    "<p>Strong lines are means over a thirtieth of a run's updates around each point, faint ones each update's own "
    "value. Success, collisions and time-outs are shares of the last episodes that ended while the policy explored, "
    "with the number of obstacles K that the curriculum had reached: they are not the rates of the evaluation. Where a "
    "run was resumed its worlds begin anew, and at first only short episodes have ended. Where a few updates are far "
    "off, they lie outside of the plot.</p>"
)


@dataclass(frozen=True, kw_only=True)
class Section:
    """One section of the page."""

    name: str
    """Name in links."""
    title: str
    """Heading."""
    body: str
    """HTML."""

    @property
    def html(self) -> str:
        """The section with its heading."""
        return f'<section id="{self.name}"><h2>{escape(self.title)}</h2>{self.body}</section>'


def introduction(sections: Sequence[Section]) -> str:
    """Return what the page is about, and where its sections are.

    Args:
        sections: The sections.

    Returns:
        HTML.
    """
    links = "".join(f'<li><a href="#{section.name}">{escape(section.title)}</a></li>' for section in sections)
    return f'<p>{_INTRODUCTION}</p><nav aria-label="Sections"><ul>{links}</ul></nav>'


def run_section(source: str, loaded: LoadedPolicy, rows: Rows, others: Sequence[LoadedPolicy]) -> Section:
    """Return what the policy is and where it comes from.

    Args:
        source: How it was named.
        loaded: The policy.
        rows: Its progress.
        others: Policies that it is compared with.

    Returns:
        The section.
    """
    config, record = loaded.config, loaded.record
    sees = "sees the box, which hides what is behind it" if config.env.lidar.occlusion else "does not see the box"
    facts = {
        "Method": f"{method_label(loaded)} ({config.method})",
        "What it is": f"LiDAR {sees}; confidence map with decay {config.map.decay:g} a step; weights of the costs in "
        f"the advantage: risk {config.cura.risk_coeff:g}, uncertainty {config.cura.uncertainty_coeff:g}",
        "Trained for": f"{record['frames']:,} environment steps on {config.simulator}, the last ones on "
        f"{config.device}, {config.num_envs} worlds side by side, seed {record['seed']}",
        "Time of training": _training_time(rows),
        "Commit": str(record["commit"]),
        "Versions": ", ".join(f"{name} {version}" for name, version in record["versions"].items()),
        "Weights": f"{source}, SHA-256 {loaded.weights_sha256[:12]}",
    }
    for other in others:
        told = f"{other.record['frames']:,} steps, seed {other.record['seed']}, SHA-256 {other.weights_sha256[:12]}"
        facts[f"Beside it: {method_label(other)}"] = f"{told}, commit {other.record['commit']}"
    return Section(name="run", title="What this is", body=markup.definitions(facts))


def _training_time(rows: Rows) -> str:
    hours = sum(row.get("collect_seconds", math.nan) + row.get("update_seconds", math.nan) for row in rows) / 3600.0
    is_known = bool(rows) and math.isfinite(hours)
    return f"{hours:.1f} h to collect and to update, in {len(rows):,} updates" if is_known else "not recorded"


def curves_section(runs: Mapping[str, Rows], *, has_own: bool) -> Section:
    """Return the learning curves.

    Args:
        runs: Rows of progress by run; may be empty.
        has_own: Whether those of the policy itself are among them.

    Returns:
        The section.
    """
    parts = []
    if not has_own:
        parts.append(
            "<p>There is no <code>progress.csv</code> with these weights: a run's folder has one, and "
            "<code>--curves FILE.csv</code> adds one from elsewhere.</p>"
        )
    if runs:
        parts += [
            _HOW_TO_READ_CURVES,
            _last_means(runs),
        ]
    for title, columns in columns_by_group(runs).items():
        names = ", ".join(map(label_of, columns))
        text = f"{title} over environment steps, runs {', '.join(runs)}. Plots: {names}"
        picture = markup.image(curves_figure(runs, columns), "png", text)
        parts.append(f"<article><h3>{escape(title)}</h3>{picture}</article>")
    return Section(name="curves", title="Learning curves", body="".join(parts))


def _last_means(runs: Mapping[str, Rows]) -> str:
    columns = [
        column
        for wanted in _SUMMARY
        for found in columns_by_group(runs).values()
        for column in found
        if column == wanted or (wanted.endswith("*") and column.startswith(wanted[:-1]))
    ]
    lines = []
    for name, rows in runs.items():
        ends = [smooth(rows, column)[1][-_LAST:] for column in columns]
        values = (f"{end.mean():.3f}" if len(end) else "" for end in ends)
        lines.append([name, f"{rows[-1]['frames']:,.0f}", *values])
    caption = f"Means over the last {_LAST} updates."
    return markup.table(["Run", "Environment steps [1]", *map(label_of, columns)], lines, caption=caption)


def table_section(table: Folder | None, loaded: LoadedPolicy) -> Section:
    """Return the table of success rates.

    Args:
        table: What the command wrote; None leaves the section with the command that makes it.
        loaded: The policy, whose rows stand out.

    Returns:
        The section.
    """
    if table is None:
        name = loaded.config.method
        methods = ",".join(dict.fromkeys(("push-no-occlusion", "push", name)))
        body = _missing(f"table --methods {methods} --cells all --out runs/table", "--table runs/table")
    else:
        is_here = loaded.weights_sha256[:12] in table.text
        note = (
            "The rows that stand out are of the weights of this report."
            if is_here
            else "None of the rows is of the weights of this report: the table was made with others."
        )
        marked = method_label(loaded) if is_here else None
        body = f"<p>{note}</p>{folder_html(table, marked=marked)}"
    return Section(name="table", title="Success rates", body=body)


def scene_section(card: Card, snapshots: bytes, distribution: bytes, config: ReportConfig) -> Section:
    """Return the scene that was played.

    Args:
        card: The scene with paths and animation.
        snapshots: Picture of the maps at three moments, PNG.
        distribution: Picture of the DCE's distributions at these moments, PNG.
        config: Which scene it is.

    Returns:
        The section.
    """
    scene = card.recordings[0].scene
    who = " and ".join(recording.label for recording in card.recordings)
    more = (
        f"<h3>Three moments</h3><p>{_MOMENTS}</p>"
        f"{markup.image(snapshots, 'png', f'Paths and maps of confidence and occupancy at moments a, b, c; {who}')}"
        "<h3>What the estimator predicts at these moments</h3>"
        f"{markup.image(distribution, 'png', f'Histograms of the predicted distribution of C at a, b, c; {who}')}"
    )
    name = f"--scenario {config.scenario} --object-size {config.object_size:g} --seed {config.seed}"
    text = (
        f"<p>Scenario {scene.index} of the evaluation stream (<code>{escape(name)}</code>): one scene, chosen by its "
        "number and not for how it ends. It shows behaviour; how often it ends so is in the table. A policy that plays "
        "alone rounds otherwise than in a table's batch, so that a close call may end differently there.</p>"
        f"<p>{HOW_TO_READ}</p>"
    )
    return Section(name="scene", title="A scene", body=text + scene_article(card, is_open=True, more=more))


_MOMENTS = (
    "a: the first obstacle appears; b: the highest uncertainty between a and c; c: the end. Maps are in the base "
    "frame; dark is unseen in the map of confidence and occupied in that of occupancy."
)


def calibration_section(calibration: Folder | None) -> Section:
    """Return how right the estimator is.

    Args:
        calibration: What the command wrote; None leaves the section with the command that makes it.

    Returns:
        The section.
    """
    body = _missing("calibrate", "--calibration DIR") if calibration is None else folder_html(calibration)
    return Section(name="calibration", title="Is the collision estimator right?", body=body)


def _missing(command: str, flag: str) -> str:
    return f"<p>Not in this report. <code>cura-torchrl {command}</code> makes it, then <code>{flag}</code> adds it.</p>"


def configuration_section(config: TrainConfig) -> Section:
    """Return the resolved configuration.

    Args:
        config: The run's.

    Returns:
        The section.
    """
    preset = method(config.method) if config.method in PRESETS else TrainConfig()
    name = f"the preset <code>{escape(config.method)}</code>" if config.method in PRESETS else "the defaults"
    text = (
        f"<p>{count_differences(config, preset)} fields differ from {name} of this version; they stand out, with the "
        "preset's value beside them. A part opens at a click; those with differences are open.</p>"
    )
    return Section(name="configuration", title="Configuration", body=text + configuration_tree(config, preset))


def provenance_facts() -> dict[str, str]:
    """Return what this page was made with.

    Returns:
        Texts by name.
    """
    made = provenance()
    machine = made["hardware"]
    cores = f"{machine['cores']} cores, {machine['memory_gib']} GiB"
    return {
        "Command": made["command"],
        "Commit": made["commit"],
        "Machine": f"{machine['platform']}, {machine['processor']}, {cores}; it made this page, not the training",
        "Versions": ", ".join(f"{name} {version}" for name, version in made["versions"].items()),
    }
