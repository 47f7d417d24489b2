"""Whether the numbers of a flow are still those that something was made from, however they were changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from torch import Tensor


class Contents:
    """The values of tensors in some modules' dictionaries, read from memory in microseconds.

    A tensor's version counter misses edits through `.data`, and a new tensor may stand in the dictionary.

    Parameters
    ----------
    tensors : iterable of dict
        `_parameters` or `_buffers` of modules.
    """

    def __init__(self, tensors: Iterable[Mapping[str, Tensor | None]]) -> None:
        self._tensors = [d for d in tensors if d]
        self._addresses: list[int] = []
        self._views: list[np.ndarray] = []
        self._shared = False  # whether the views are the memory of the tensors, which lie on the CPU

    def first(self) -> Tensor:
        """One of the tensors."""
        return next(w for d in self._tensors for w in d.values() if w is not None)

    def snapshot(self) -> bytes:
        """Equal to an earlier one as long as no number has changed."""
        addresses = [w.data_ptr() for d in self._tensors for w in d.values() if w is not None]
        if addresses != self._addresses or not self._shared:
            tensors = [w for d in self._tensors for w in d.values() if w is not None]
            self._views = [np.ascontiguousarray(w.detach().cpu().numpy()) for w in tensors]
            self._addresses, self._shared = addresses, all(w.device.type == "cpu" for w in tensors)
        return b"".join(self._views)  # type: ignore[arg-type]
