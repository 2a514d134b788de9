"""Transforms that turn scans into maps and maps into codes."""

from cura_torchrl.envs.transforms.confidence_map import ConfidenceMap
from cura_torchrl.envs.transforms.encode_map import EncodeMap

__all__ = ["ConfidenceMap", "EncodeMap"]
