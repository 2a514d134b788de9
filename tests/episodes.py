"""Episodes as they may have been played, by how they ended."""

from __future__ import annotations

from cura_torchrl.trainers.evaluation.episodes import Episode


def run_of(letters: str, first: int = 0) -> list[Episode]:
    """Episodes with these outcomes (s, c, t), from a scene on; in a collision the arm touched."""
    return [
        Episode(
            index=first + index,
            success=(letter == "s", False, False),
            collision=letter == "c",
            contact=(False, letter == "c", False),
            tipped=False,
            steps=9,
        )
        for index, letter in enumerate(letters)
    ]
