"""Encode the confidence map once per step inside of the environment, with a network that never learns there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from cura_torchrl import keys
from cura_torchrl.envs.transforms.reset_mask import reset_mask

if TYPE_CHECKING:
    from tensordict import NestedKey

_ROWS = 32
"""Maps that the CPU encodes at a time [1]: what is between the layers stays in its cache. In float64 250 maps so take
46 ms in place of 133."""


class EncodeMap(Transform):
    """Encode maps with a frozen network.

    Encoding in the environment rather than in the policy gives the codes at the root and under ``"next"`` for one pass
    a step. The network's parameters are frozen, it stays in evaluation mode whatever the mode of the environment, and
    no gradient is recorded. Maps become what the encoder's parameters are, so that ``encoder.double()`` writes codes in
    float64. A partial reset encodes only the rows that are reset; the other rows' codes are 0 in what ``_reset``
    returns, for TorchRL keeps their old value. Codes depend on the batch by rounding only (in float32 about 1e-5).

    ================== ======= ================================================ ================
    Key (default)      Access  Content                                          Shape
    ================== ======= ================================================ ================
    ``confidence_map`` read    Maps; removed if ``del_keys``                    ``[*, C, H, W]``
    ``latent``         write   Code z of the map                                ``[*, L]``
    ================== ======= ================================================ ================

    Args:
        encoder: Network from maps ``[B, C, H, W]`` to codes ``[B, L]``. Frozen in place.
        in_key: Key of the map.
        out_key: Key of the code.
        del_keys: Whether the map is removed once it is encoded, so that collectors need not carry it.

    Source:
        Paper, section "Sensor Encoding".

    Examples:
        >>> from tensordict import TensorDict
        >>> transform = EncodeMap(torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(2 * 4 * 4, 3)))
        >>> data = TensorDict(confidence_map=torch.zeros(5, 2, 4, 4), batch_size=[5])
        >>> sorted(transform(data).keys()), data["latent"].shape
        (['latent'], torch.Size([5, 3]))
    """

    def __init__(
        self,
        encoder: torch.nn.Module,
        *,
        in_key: NestedKey = keys.CONFIDENCE_MAP,
        out_key: NestedKey = keys.LATENT,
        del_keys: bool = True,
    ) -> None:
        super().__init__(in_keys=[in_key], out_keys=[out_key])
        self.encoder = encoder.requires_grad_(False).eval()
        self.del_keys = del_keys

    def train(self, mode: bool = True) -> EncodeMap:
        """Set the mode of the transform, but leave the encoder in evaluation mode.

        Args:
            mode: Whether the transform is in training mode.

        Returns:
            The transform.
        """
        super().train(mode)
        self.encoder.eval()
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Encode the maps of a tensordict.

        Args:
            tensordict: Holds the in_key; modified in place.

        Returns:
            The same tensordict.
        """
        return self._call(tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        maps = self._read(next_tensordict)
        codes = self._encode(maps.reshape(-1, *maps.shape[-3:]))
        return self._write(next_tensordict, codes.view(*maps.shape[:-3], -1))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        maps = self._read(tensordict_reset)
        mask = reset_mask(self, tensordict).expand(maps.shape[:-3])
        fresh = self._encode(maps[mask])
        codes = fresh.new_zeros(*mask.shape, fresh.shape[-1])
        codes[mask] = fresh
        return self._write(tensordict_reset, codes)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the code's spec, and remove the map's on request.

        Args:
            observation_spec: Spec of the environment so far.

        Returns:
            The same spec with the out_key.

        Raises:
            KeyError: If the in_key is missing.
        """
        in_key = unravel_key(self.in_keys[0])
        if in_key not in observation_spec.keys(include_nested=True, leaves_only=True):
            msg = f"environment has no {in_key!r}; accepted: one with a map transform before this one"
            raise KeyError(msg)
        spec = observation_spec[in_key]
        code = self._encode(torch.zeros(1, *spec.shape[-3:], device=spec.device))
        shape = (*spec.shape[:-3], code.shape[-1])
        observation_spec[self.out_keys[0]] = Unbounded(shape=shape, dtype=code.dtype, device=spec.device)
        if self.del_keys:
            del observation_spec[in_key]
        return observation_spec

    @torch.no_grad()
    def _encode(self, maps: torch.Tensor) -> torch.Tensor:
        dtype = next((parameter.dtype for parameter in self.encoder.parameters()), maps.dtype)
        rows = _ROWS if maps.device.type == "cpu" else max(1, len(maps))
        return torch.cat([self.encoder(piece.to(dtype)) for piece in maps.split(rows)])

    def _read(self, tensordict: TensorDictBase) -> torch.Tensor:
        maps = tensordict.get(self.in_keys[0])
        if maps is None:
            given = sorted(map(str, tensordict.keys(True, True)))
            msg = f"tensordict has only {given}; accepted: one that holds {self.in_keys[0]!r}"
            raise KeyError(msg)
        return maps

    def _write(self, tensordict: TensorDictBase, codes: torch.Tensor) -> TensorDictBase:
        tensordict.set(self.out_keys[0], codes)
        return tensordict.exclude(*self.in_keys, inplace=True) if self.del_keys else tensordict
