"""The arguments of `train` that need more than a look: the domain, the losses by name, labels that are handed in."""

from __future__ import annotations

import difflib
import hashlib
import inspect
import math
import os
from typing import Any

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.flow.sympflow import SympFlow
from sympflow.hamiltonian.domain import Domain, EnergySublevel
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.training.checkpoint import check_writable
from sympflow.training.choices import is_number
from sympflow.training.run import Labelled


def domain_for(system: HamiltonianSystem, domain: Domain | None) -> Domain:
    """Ω of a training: the domain that is given, else that of the system; checked."""
    domain = system.domain if domain is None else domain
    if domain is None:
        raise ValueError(
            f"`domain` is not known for the system {system.name!r}: pass the states to train on, as by "
            "domain=sympflow.Box(low, high), sympflow.Ball(center, radius) or sympflow.EnergySublevel(energy, box)."
        )
    if not isinstance(domain, Domain):
        raise TypeError(
            f"`domain` must be a domain of phase space; got {domain!r}: use sympflow.Box(low, high), "
            "sympflow.Ball(center, radius) or sympflow.EnergySublevel(energy, box)."
        )
    if isinstance(domain, EnergySublevel):
        domain = domain.attach(system.hamiltonian)
    width = domain.sample(1, 0).shape[-1]
    if width != 2 * system.ndof:
        raise ValueError(f"`domain` has states of length {width}, the system {2 * system.ndof}: give [q, p].")
    return domain


def refuse_unknown(options: dict[str, Any]) -> None:
    """Raise if there are options that `train` does not have, with what may be meant."""
    from sympflow.training.trainer import train

    known = [each for each in inspect.signature(train).parameters if each != "unknown"]
    for name, value in options.items():
        for maker in (SympFlow.primed, SympFlow.split):
            if name in inspect.signature(maker).parameters:
                by = maker.__qualname__
                raise TypeError(f"`{name}` is an option of {by}: pass flow={by}(system, ..., {name}={value!r}).")
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"is `{close[0]}` meant?" if close else f"choose from {', '.join(known[1:])}."
        raise TypeError(f"`{name}` is no option of train(): {hint}")


def check_surroundings(given: dict[str, Any]) -> None:
    """Those of the arguments of `train` that say for how long, from where and to where, and its Δt."""
    dt, time_budget, callback = given["dt"], given["time_budget"], given["callback"]
    if dt is not None and not (is_number(dt) and 0 < dt < math.inf):
        raise ValueError(f"`dt` must be a positive finite number; got {dt!r}: leave it out for the default.")
    if time_budget is not None and not (is_number(time_budget) and 0 < time_budget < math.inf):
        raise ValueError(f"`time_budget` must be a positive number of seconds; got {time_budget!r}: leave it out.")
    if callback is not None and not callable(callback):
        raise TypeError(f"`callback` must be a function of the step and the figures; got {callback!r}: leave it out.")
    for name in ("checkpoint", "resume"):
        if given[name] is not None and not isinstance(given[name], (str, os.PathLike)):
            raise TypeError(f"`{name}` must be the path of a file; got {given[name]!r}: pass a string or leave it out.")
    if given["checkpoint"] is not None:
        check_writable(given["checkpoint"])


def weights_of(
    loss: str, residual_weight: float, matching_weight: float | None, label_weight: float | None
) -> tuple[float, float, float]:
    """Those of the residual, of matching and of the labels: 0 for what the loss does not name."""
    names = loss.split("+") if isinstance(loss, str) else []
    if not names or not set(names) <= {"residual", "matching", "labels"}:
        raise ValueError(f"`loss` {loss!r} is unknown: join some of residual, matching and labels by +.")
    if len(set(names)) < len(names):
        raise ValueError(f"`loss` {loss!r} names a loss twice: name it once, and give it more weight by its `_weight`.")
    chosen = {
        "residual": residual_weight,
        "matching": 1.0 if matching_weight is None else matching_weight,
        "labels": 1.0 if label_weight is None else label_weight,
    }
    residual, matching, labels = (weight if name in names else 0.0 for name, weight in chosen.items())
    return residual, matching, labels


def labels_of(data: Any, system: HamiltonianSystem, dt: float) -> Labelled:
    """The labels that were handed in, as float64 arrays."""
    if not isinstance(data, tuple | list) or len(data) != 3:
        raise TypeError(
            "`data` must be three arrays, times (n,), states (n, 2d) and where they go (n, 2d): pass a tuple."
        )
    t, x, y = (np.asarray(to_numpy(a), dtype=float) for a in data)
    width = 2 * system.ndof
    if t.ndim != 1 or x.shape != (len(t), width) or y.shape != x.shape or len(t) < 2:
        raise ValueError(
            f"`data` must have shapes (n,), (n, {width}) and (n, {width}), n ≥ 2; got {t.shape}, {x.shape} and "
            f"{y.shape}: give one row for each label."
        )
    if not (np.isfinite(t).all() and np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("`data` must be finite: remove the labels with NaN or infinity.")
    if t.min() < 0 or t.max() > dt * (1 + 1e-12):
        raise ValueError(
            f"`data` has times from {t.min():g} to {t.max():g}, beyond [0, dt] = [0, {dt:g}]: change `dt`."
        )
    return t, x, y


def digest(labels: Labelled) -> str:
    """Their checksum."""
    content = hashlib.sha256()
    for array in labels:
        content.update(np.ascontiguousarray(array).tobytes())
    return content.hexdigest()
