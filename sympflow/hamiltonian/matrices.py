"""The matrices that a user gives, the mass M, the stiffness K, the damping Γ: checked, in their simplest form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import real_array


def inverse_mass(mass: float | ArrayLike | None, ndof: int) -> np.ndarray | None:
    """M⁻¹ in its simplest form for a mass M: a number, (d,) or (d, d)."""
    M = real_array("mass", 1.0 if mass is None else mass)
    if M.shape not in ((), (ndof,), (ndof, ndof)):
        raise ValueError(f"`mass` must be a number or have shape ({ndof},) or ({ndof}, {ndof}); got {M.shape}.")
    if M.ndim < 2:
        M = np.broadcast_to(M, ndof)
        if not (np.isfinite(M).all() and (M > 0).all()):
            raise ValueError(f"`mass` must be finite, symmetric and positive definite; got {mass!r}.")
        return None if (M == 1).all() else 1 / M
    _check_symmetric("mass", M)
    smallest = np.linalg.eigvalsh(M)[0]
    if not smallest > 0:
        raise ValueError(
            f"`mass` must be finite, symmetric and positive definite; its smallest eigenvalue is {smallest:g}."
        )
    return simplest(np.linalg.inv(M))


def stiffness_matrix(matrix: ArrayLike, ndof: int) -> np.ndarray:
    """K (d, d), exactly symmetric."""
    K = real_array("stiffness_matrix", matrix)
    if K.shape != (ndof, ndof):
        raise ValueError(
            f"`stiffness_matrix` must be finite, symmetric and of shape ({ndof}, {ndof}); got shape {K.shape}."
        )
    _check_symmetric("stiffness_matrix", K)
    return (K + K.T) / 2


def damping(values: float | ArrayLike | None, ndof: int) -> np.ndarray | None:
    """Γ in its simplest form, () for one rate, (d,) or (d, d), of a number, (d,) or (d, d); None for no friction."""
    if values is None:
        return None
    if isinstance(values, bool | np.bool_):
        raise TypeError(f"`damping` must be a rate, or several; got {values!r}: pass a number such as 0.1.")
    G = real_array("damping", values)
    if G.shape not in ((), (ndof,), (ndof, ndof)):
        raise ValueError(
            f"`damping` must be a number, one for each p, of shape ({ndof},), or a matrix of shape ({ndof}, {ndof}); "
            f"got shape {G.shape}."
        )
    if G.ndim < 2:
        if not (np.isfinite(G).all() and (G >= 0).all()):
            raise ValueError(
                f"`damping` must be finite and not negative, for friction takes energy away; got {values!r}."
            )
    else:
        _check_symmetric("damping", G)
        G = (G + G.T) / 2
        rates = np.linalg.eigvalsh(G)
        if rates[0] < -8 * ndof * np.finfo(float).eps * abs(rates).max():
            raise ValueError(
                "`damping` must be a positive semi-definite matrix, for friction takes energy away; its smallest "
                f"eigenvalue is {rates[0]:g}."
            )
        if np.array_equal(G, np.diag(np.diag(G))):
            G = np.diag(G).copy()
    if G.ndim == 1 and (G[0] == G).all():
        G = np.array(G[0])
    if not G.any():
        return None
    return np.array(abs(G)) if G.ndim < 2 else G  # −0.0 is 0


def _check_symmetric(name: str, matrix: np.ndarray) -> None:
    """Raise with the first entry that is not finite, or differs from its mirror image."""
    for wrong in (~np.isfinite(matrix), ~np.isclose(matrix, matrix.T)):
        if wrong.any():
            i, j = np.argwhere(wrong)[0].tolist()
            mirror = f", [{j}, {i}] is {matrix[j, i]:g}" if np.isfinite(matrix[i, j]) else ""
            raise ValueError(f"`{name}` must be finite, symmetric; its entry [{i}, {j}] is {matrix[i, j]:g}{mirror}.")


def from_entries(shape: tuple[int, int], entries: Mapping[tuple[int, int], Any]) -> np.ndarray:
    """The matrix with these entries, all others 0."""
    matrix = np.zeros(shape)
    for place, entry in entries.items():
        matrix[place] = float(entry)
    return matrix


def simplest(inverse: np.ndarray) -> np.ndarray | None:
    """None for the identity, the diagonal for a diagonal matrix, else the matrix."""
    if np.array_equal(inverse, np.eye(len(inverse))):
        return None
    diagonal = np.diag(inverse).copy()
    return diagonal if np.array_equal(inverse, np.diag(diagonal)) else inverse
