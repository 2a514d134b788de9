"""The demo's page: one HTML file that holds its pictures and refers to nothing outside."""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from cura_torchrl.trainers.evaluation.episodes import summarise
from cura_torchrl.trainers.pages.markup import document, image
from cura_torchrl.trainers.pictures import animation, figures
from cura_torchrl.trainers.pictures.recording import Recording
from cura_torchrl.trainers.pictures.video import encode_animation

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_INTRODUCTION = (
    'A robot (<span class="robot">green</span>) pushes a box (<span class="object">magenta</span>) to a goal and sees '
    "only through one planar LiDAR, so the box hides what lies ahead of it, while obstacles (grey) appear on the way. "
    "Both policies play the same scenes: {first} and, beside it, {second}. "
    "The animations also show what the robot has seen and how recently (confidence), where it saw obstacles "
    "(occupancy), and the distribution of the collision possibility C that its estimator predicts, from which a "
    "method takes the risk R and the uncertainty U: the paper the mean and the variance."
)

FRAME_TIME = 0.1
"""Time for which a frame of a telling scene is shown [s]; the others have half the frames."""


@dataclass(frozen=True, kw_only=True)
class Card:
    """One scene on the page."""

    recordings: tuple[Recording, ...]
    """The scene as each policy played it; the demo's page shows two."""
    paths: bytes
    """Picture of the paths, PNG."""
    animation: bytes
    """Animation, WebP."""


def draw_card(recordings: tuple[Recording, ...], *, every: int, frame_time: float = FRAME_TIME) -> Card:
    """Draw a scene.

    Args:
        recordings: The scene as each policy played it.
        every: Every how many recorded frames are shown [1].
        frame_time: Time for which each recorded frame would be shown [s].

    Returns:
        The scene with its pictures.
    """
    frames = animation.animation_frames(recordings, every=every)
    return Card(
        recordings=recordings,
        paths=figures.paths_figure(recordings),
        animation=encode_animation(frames, frame_time=every * frame_time),
    )


def make_page(
    telling: Sequence[Card],
    others: Sequence[Card],
    *,
    curve: bytes | None,
    facts: Mapping[str, str],
) -> str:
    """Return the page.

    Args:
        telling: Scenes that come first, with their animation in sight.
        others: All other scenes; their animations open at a click.
        curve: Picture of the learning curves, PNG; None leaves the section out.
        facts: What the page was made with, by name.

    Returns:
        HTML that refers to no other file.

    Raises:
        ValueError: If there is no scene at all.
    """
    cards = [*telling, *others]
    if not cards:
        msg = "number of scenes is 0; accepted: 1 or more"
        raise ValueError(msg)
    first, second = (recording.label for recording in cards[0].recordings)
    sections = (
        f'<h2>How the scenes ended</h2><div class="table">{summary_table(cards)}</div>',
        f"<h2>How to read the pictures</h2><p>{HOW_TO_READ}</p>",
        _section("The most telling scenes", _RULE, telling, is_open=True),
        _section("The other scenes" if telling else "The scenes", _OTHERS, others, is_open=False),
        "" if curve is None else _learning(curve, escape(first)),
    )
    return document(
        title=f"{first} beside {second}, on the same scenes",
        introduction=f"<p>{_INTRODUCTION.format(first=escape(first), second=escape(second))}</p>",
        main="\n".join(sections),
        facts=facts,
    )


_RULE = (
    "Chosen by rule, not by hand: first the scenes that end well for one policy and not for the other, whichever it "
    "is, then those with the least clearance."
)
HOW_TO_READ = (
    "Robot and its path are green, the box and its path magenta (broken), outlines stand 5 s apart; a ring marks the "
    "goal, a cross a collision, a number when an obstacle appeared. The same obstacle may appear elsewhere for the "
    "other policy, for its place keeps clear of robot and box wherever they are by then. Distances are those of the "
    "last state, some seconds after the goal was reached; clearance is that of robot and box from the nearest obstacle."
)
_OTHERS = "Their animations open at a click, and show every second frame."
_LEARNING = (
    "The wide plots show the run whose weights {label} plays with, the narrow ones what the same training made of them "
    "in this demo. Rates are taken over the episodes that ended: in the demo only a few, and those that end early come "
    "first, collisions above all."
)


def summary_table(cards: Sequence[Card]) -> str:
    """Return the table of how the scenes ended, by scenario and policy.

    Args:
        cards: All scenes.

    Returns:
        An HTML table.
    """
    kinds = list(dict.fromkeys(card.recordings[0].scene.kind for card in cards))
    rows = []
    for name, wanted in [*((kind, {kind}) for kind in kinds), ("all scenes", set(kinds))]:
        for index in (0, 1):
            chosen = [card.recordings[index] for card in cards if card.recordings[0].scene.kind in wanted]
            rows.append(_summary_row(name, chosen))
    head = (
        '<tr><th>Scenes</th><th class="word">Policy</th><th>Success</th><th>95 % interval</th><th>Collisions</th>'
        "<th>Time-outs</th><th>within 0.25 m</th><th>0.10 m &amp; 10°</th><th>Mean steps</th></tr>"
    )
    first = cards[0].recordings[0]
    caption = (
        f"Success: the box within {first.success_radius:g} m of the goal before any collision. Interval: Wilson's; so "
        "few scenes leave open which policy is better: docs/results.md has thousands, <code>cura-torchrl table</code> "
        "plays as many as are wanted. "
        f"Steps of {first.period:g} s until goal, collision or time-out."
    )
    return f"<table><caption>{caption}</caption><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _summary_row(name: str, recordings: Sequence[Recording]) -> str:
    counts = summarise([recording.episode for recording in recordings])
    count = counts["episodes"]
    cells = (
        f"{counts['successes']} of {count} ({counts['success_rate']:.0%})",
        f"{counts['wilson_low']:.0%} to {counts['wilson_high']:.0%}",
        f"{counts['collisions']}",
        f"{counts['timeouts']}",
        f"{counts['success_rate_025']:.0%}",
        f"{counts['success_rate_010_10deg']:.0%}",
        f"{counts['mean_steps']:.0f}",
    )
    label = f'<td>{escape(name)}</td><td class="word">{escape(recordings[0].label)}</td>'
    return f"<tr>{label}{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _section(title: str, text: str, cards: Sequence[Card], *, is_open: bool) -> str:
    if not cards:
        return ""
    return f"<h2>{title}</h2><p>{text}</p>{''.join(scene_article(card, is_open=is_open) for card in cards)}"


def scene_article(card: Card, *, is_open: bool, more: str = "") -> str:
    """Return a scene with its pictures and numbers.

    Args:
        card: The scene.
        is_open: Whether its animation is in sight at once.
        more: HTML that follows the animation.

    Returns:
        An HTML element.
    """
    scene = card.recordings[0].scene
    title = f"Scene {scene.index}: {scene.kind}, box of {scene.object_edge:g} m"
    outcomes = "; ".join(f"{recording.label}: {recording.describe()}" for recording in card.recordings)
    return (
        f'<article id="scene-{scene.index}"><h3>{escape(title)}</h3>'
        f"{image(card.paths, 'png', f'Paths of robot and box. {outcomes}')}"
        f'<div class="table">{_numbers(card.recordings)}</div>'
        f"<details{' open' if is_open else ''}><summary>Animation with map and collision estimate</summary>"
        f"{image(card.animation, 'webp', f'Animation of the scene. {outcomes}')}</details>{more}</article>"
    )


def _numbers(recordings: Sequence[Recording]) -> str:
    rows = []
    for recording in recordings:
        clearance = recording.min_clearance
        cells = (
            f"{recording.episode.steps}",
            f"{recording.final_distance:.2f}",
            f"{clearance:.2f}" if math.isfinite(clearance) else "none",
            f"{recording.risk.max():.2f}",
            f"{recording.uncertainty.max():.3f}",
        )
        outcome = f'<td class="word {recording.outcome}">{escape(recording.describe())}</td>'
        numbers = "".join(f"<td>{cell}</td>" for cell in cells)
        rows.append(f"<tr><td>{escape(recording.label)}</td>{outcome}{numbers}</tr>")
    head = (
        '<tr><th>Policy</th><th class="word">Outcome</th><th>Steps</th><th>Final distance [m]</th>'
        "<th>Least clearance [m]</th><th>Highest R</th><th>Highest U</th></tr>"
    )
    return f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _learning(curve: bytes, label: str) -> str:
    picture = image(curve, "png", "Success, collisions, speed of the object and reward over environment steps")
    return f"<h2>Learning goes on</h2><p>{_LEARNING.format(label=label)}</p><article>{picture}</article>"
