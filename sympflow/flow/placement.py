"""The dtype and device that a flow is asked for, checked before anything is made."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

_DTYPES = {"float32": torch.float32, "float64": torch.float64}


def checked_dtype(dtype: Any) -> torch.dtype:
    """`dtype` as that of torch: float32 or float64, by torch's, NumPy's or a plain name.

    Raises
    ------
    TypeError
        If it is anything else.
    """
    name = str(dtype).removeprefix("torch.")
    if not isinstance(dtype, (torch.dtype, str)) and dtype is not None:
        try:
            name = np.dtype(dtype).name
        except TypeError:
            name = ""
    if name not in _DTYPES:
        raise TypeError(f"`dtype` must be float32 or float64; got {dtype!r}: use torch.float32 or torch.float64.")
    return _DTYPES[name]


def checked_device(device: Any) -> torch.device | None:
    """`device` as that of torch, and one that there is; None stands for torch's default.

    Raises
    ------
    TypeError
        If it is not a device or the name of one.
    ValueError
        If torch knows no such device, or does not see it on this machine.
    """
    if device is None:
        return None
    if isinstance(device, bool) or not isinstance(device, (torch.device, str, int)):
        raise TypeError(f"`device` must be a torch.device or its name; got {device!r}: use 'cpu' or 'cuda'.")
    try:
        there = torch.device(device)
        torch.empty(0, device=there)
    except (RuntimeError, AssertionError, NotImplementedError, ImportError) as error:
        reason = str(error).splitlines()[0].rstrip(". ") if str(error) else type(error).__name__
        raise ValueError(f"`device` {str(device)!r} is not to be had here ({reason}): use device='cpu'.") from None
    return there
