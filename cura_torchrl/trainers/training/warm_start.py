"""Networks that start from another run's, which may lack the estimators beyond the paper or have them in excess."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cura_torchrl.trainers.checkpoint import restore

if TYPE_CHECKING:
    from pathlib import Path

    from cura_torchrl.trainers.build import Networks

_OPTIONAL = ("privileged_estimator", "perceptual_estimator")
"""Parts of the networks that depend on the method."""


def start_from(checkpoint: Path, networks: Networks) -> list[str]:
    """Load the networks of a checkpoint; optional parts that it lacks stay as they are, others that it has are left.

    Args:
        checkpoint: The checkpoint's folder; verify it first.
        networks: Networks, changed in place.

    Returns:
        Names of the parts that stayed as they are.

    Raises:
        CheckpointError: If what both have does not fit.
    """  # noqa: DOC502 - raised by what this calls
    component = _Lenient(networks)
    restore(checkpoint, {"networks": component})
    return component.fresh


class _Lenient:
    """Networks that load all but the optional parts strictly."""

    def __init__(self, networks: Networks) -> None:
        self._networks = networks
        self.fresh: list[str] = []

    def state_dict(self) -> dict[str, Any]:
        return self._networks.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        theirs, ours = ({name.split(".")[0] for name in one} for one in (state, self.state_dict()))
        self.fresh = [name for name in _OPTIONAL if name in ours - theirs]
        excess = [name for name in _OPTIONAL if name in theirs - ours]
        missing, unexpected = self._networks.load_state_dict(state, strict=False)
        wrong = [name for name in missing if name.split(".")[0] not in self.fresh]
        wrong += [name for name in unexpected if name.split(".")[0] not in excess]
        if wrong:
            msg = f"networks differ in {', '.join(sorted(wrong))}"
            raise ValueError(msg)
