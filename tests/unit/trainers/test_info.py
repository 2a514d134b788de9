"""A result names the code that made it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cura_torchrl.trainers import info

if TYPE_CHECKING:
    import pytest


def test_a_commit_that_is_checked_out_meanwhile_is_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a run of hours that names a commit which it does not run."""
    info.git_commit.cache_clear()
    monkeypatch.setattr(info, "_git", lambda *_: "before")
    assert info.git_commit() == "before"
    monkeypatch.setattr(info, "_git", lambda *_: "meanwhile")
    assert info.provenance()["commit"] == "before"
    info.git_commit.cache_clear()
