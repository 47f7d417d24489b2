"""The linear algebra of H: the matrices that a user gives, its quadratic part, and normal modes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from sympflow.arguments import real_array
from sympflow.arrays import Array, concatenate, is_tensor, like, moveaxis

if TYPE_CHECKING:
    import sympy as sp


ZERO = 1e-12  # of the largest squared frequency: what is below is a free drift
SAME = 1e-9  # relative difference below which two frequencies are one
EQUILIBRIUM_STEPS = 100


class NormalModes:
    """Modes of a quadratic Hamiltonian by their kinds and rates, and the classes of those that have both in common."""

    kinds: Any
    rates: np.ndarray
    classes: np.ndarray
    interval: float

    @property
    def frequencies(self) -> np.ndarray:
        """|ω| of each mode, (d,): 0 where nothing oscillates."""
        return np.where(np.asarray(self.kinds) == "oscillator", abs(self.rates), 0.0)

    @property
    def stiffness(self) -> float:
        """Largest frequency × length of the default interval: the radians that the fastest mode turns in it.

        A method that meets the fast oscillation by forces, as every explicit one does, needs at least half as many
        force evaluations to be stable.
        """
        return float(self.frequencies.max(initial=0.0) * self.interval)

    @cached_property
    def representatives(self) -> np.ndarray:
        """The first mode of each class: (n_classes,)."""
        return np.unique(self.classes, return_index=True)[1]

    @property
    def n_classes(self) -> int:
        return len(self.representatives)


@dataclass(frozen=True)
class LinearPart(NormalModes):
    """½ pᵀBp + ½ (q − c)ᵀK(q − c), a quadratic Hamiltonian, in its normal modes.

    With q = c + C X and p = C⁻ᵀY it is Σ_j Ω_j (Y_j² + σ_j X_j²)/2, where σ_j = 1 for an *oscillator*, −1 for a
    *hyperbolic* mode (K negative along it), and Y_j²/2 for a *free* one; coordinates that B leaves out are *idle*.
    In these variables, in which a state moves on a circle, the exact flow needs no number that depends on the scales
    of q and p, and does not drift by rounding.
    """

    inverse_mass: np.ndarray  # B (d, d), symmetric positive semidefinite
    stiffness_matrix: np.ndarray  # K (d, d), symmetric
    center: np.ndarray  # c (d,): where the forces along stiff directions vanish, of a system given by functions
    potential: Any = None  # U(q), what V has beside the quadratic part, if the system is symbolic
    interval: float = 0.0  # length of the system's default interval
    dense: ClassVar[bool] = True
    """False of modes by fast transforms, which have no loops."""

    @property
    def ndof(self) -> int:
        return len(self.center)

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The eigenvalues of BK, (d,), negative for a hyperbolic mode, NaN for an idle one; C (d, d), C⁻¹ (d, d)."""
        B, K, d = self.inverse_mass, self.stiffness_matrix, self.ndof
        active = np.flatnonzero(np.diag(B) > 0)
        if np.delete(np.delete(B, active, 0), active, 1).any() or np.delete(K, active, 0).any():
            raise ValueError("`stiffness_matrix` acts on coordinates without a kinetic energy: leave them out of it.")
        block = np.ix_(active, active)
        L = np.linalg.cholesky(B[block])
        S = L.T @ K[block] @ L
        if np.count_nonzero(S - np.diag(np.diag(S))):
            eigenvalues, W = np.linalg.eigh((S + S.T) / 2)
        else:  # eigh would only reorder the modes
            eigenvalues, W = np.diag(S).copy(), np.eye(len(S))
        eigenvalues[np.abs(eigenvalues) <= ZERO * np.abs(eigenvalues).max(initial=0.0)] = 0.0
        unit = np.where(eigenvalues != 0, np.abs(eigenvalues) ** 0.25, 1.0)  # √Ω
        squares, C, inverse = np.full(d, np.nan), np.eye(d), np.eye(d)
        squares[active] = eigenvalues
        C[block] = L @ W / unit
        inverse[block] = unit[:, None] * (W.T @ np.linalg.inv(L))
        return squares, C, inverse

    @property
    def modes(self) -> np.ndarray:
        """C: (d, d)."""
        return self._spectrum[1]

    @property
    def inverse_modes(self) -> np.ndarray:
        """C⁻¹: (d, d)."""
        return self._spectrum[2]

    @cached_property
    def diagonal(self) -> bool:
        """True if each mode is a coordinate."""
        return not np.count_nonzero(self.modes - np.diag(np.diag(self.modes)))

    def positions(self, X: Array) -> Array:
        """C X: (..., d), each."""
        return self._times(self.modes, X)

    def coordinates(self, x: Array) -> Array:
        """C⁻¹x, of positions less c: (..., d), each."""
        return self._times(self.inverse_modes, x)

    def momenta(self, Y: Array) -> Array:
        """C⁻ᵀY: (..., d), each."""
        return self._times(self.inverse_modes.T, Y)

    def slopes(self, g: Array) -> Array:
        """Cᵀg: (..., d), each."""
        return self._times(self.modes.T, g)

    def _times(self, A: np.ndarray, x: Array) -> Array:
        if self.diagonal:
            return x * like(np.diag(A), x)
        return x @ like(A.T, x)

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The kind of each mode: "oscillator", "hyperbolic", "free" or "idle"."""
        names = {1.0: "oscillator", -1.0: "hyperbolic", 0.0: "free"}
        return tuple("idle" if np.isnan(s) else names[float(np.sign(s))] for s in self._spectrum[0])

    @cached_property
    def rates(self) -> np.ndarray:  # type: ignore[override]
        """Ω of each mode, (d,): ω, the hyperbolic rate, 1 for a free mode and 0 for an idle one."""
        squares = np.nan_to_num(self._spectrum[0])
        return np.where(squares != 0, np.sqrt(np.abs(squares)), [float(kind == "free") for kind in self.kinds])

    @cached_property
    def classes(self) -> np.ndarray:  # type: ignore[override]
        """To which of the distinct frequencies a mode belongs: (d,) int."""
        found: list[tuple[str, float]] = []
        labels = []
        for kind, rate in zip(self.kinds, self.rates, strict=True):
            same = [i for i, (k, r) in enumerate(found) if k == kind and abs(r - rate) <= SAME * abs(rate)]
            labels.append(same[0] if same else len(found))
            if not same:
                found.append((kind, float(rate)))
        return np.array(labels)


class RestOfPotential:
    """U(q) = V(q) − ½ (q − c)ᵀK(q − c) of a definition by functions; V, where the linear part is left out of that."""

    of_positions, turns = True, False

    def __init__(self, definition: Any, linear: LinearPart | None = None) -> None:
        self.definition, self.ndof, self.timed = definition, definition.ndof, definition.timed
        self.K: np.ndarray | None = None if linear is None else linear.stiffness_matrix
        self.center: Any = 0.0 if linear is None else linear.center

    def hamiltonian(self, y: Array, *t: Any) -> Array:
        q = y[..., : self.ndof]
        V = self.definition.potential(q, *t)
        if self.K is None:
            return V
        x = q - like(self.center, q)
        return V - (x * (x @ like(self.K, q))).sum(-1) / 2

    def gradient(self, y: Array, *t: Any) -> Array:
        q = y[..., : self.ndof]
        slope = self.definition.potential_gradient(q, *t)
        if self.K is not None:
            slope = slope - (q - like(self.center, q)) @ like(self.K, q)
        return concatenate([slope, 0 * q])

    def hessian_vector(self, y: Array, v: Array, *t: Any) -> Array:
        """∇²U(q)·v: (..., 2d), (..., d) to (..., d)."""
        product = self.definition.hessian_vector(y[..., : self.ndof], v, *t)
        return product if self.K is None else product - v @ like(self.K, v)


def check_parts_conservative(system: Any) -> None:
    """Refuse a system with friction, which the exact flows of parts of H leave out."""
    remedy = "use the splitting 'kinetic', as of 'verlet'"
    system.check_conservative("which exact flows of parts of H omit", remedy)


def linear_part(system: Any) -> LinearPart:
    """The quadratic part of a system, read off its symbols or made from its `stiffness_matrix`.

    Of H = T(p) + V(q) or of any other H the terms ½ pᵀBp + ½ qᵀKq + linear ones are taken, where B belongs to
    coordinates whose kinetic energy is quadratic. What remains is U. Terms that depend on t are part of U.

    A ValueError if there is none; or if it is stiff in a direction that turns over the domain, which no constant K
    follows; or if the system has friction.
    """
    check_parts_conservative(system)
    if system.followed_mass is not None:
        raise ValueError(
            "`mass` requires gradients, which do not flow through the exact linear part: take a method on the "
            "splitting 'kinetic', such as 'srkn11b', or pass mass.detach()."
        )
    part: LinearPart | None
    if system.stiffness_matrix is not None:
        K = system.stiffness_matrix
        part = LinearPart(_inverse_mass(system), K, _equilibrium(system, K), None, _interval(system))
    elif system.local is not None:
        return system.local.linear_and_rest(_interval(system))[0]
    elif system.written is not None:
        part = read_off(form_of_parts(system), _interval(system))
    else:
        raise ValueError(
            f"`system` {system.name!r} is given by functions, whose linear part is not known: pass "
            "stiffness_matrix=K to Hamiltonian."
        )
    if system.quadratic_kinetic and (reason := turning(system, part)):
        raise ValueError(f"`system` {system.name!r} has no linear part that would help: {reason}.")
    if part is None and not system.separable:
        raise ValueError(
            f"`system` {system.name!r} has no linear part: no coordinate that quadratic terms bind has a momentum that "
            "enters H by quadratic terms alone. Use 'implicit_midpoint', 'strang_parts' or a Runge–Kutta method."
        )
    if part is None:
        system.check_autonomous(
            "and has no linear part: no coordinate has quadratic terms, in q and in p, that do not depend on t, and "
            "terms that do have no known flow",
            "use a scheme on the splitting 'kinetic', such as 'srkn11b' or 'kahan_li8', or an implicit method",
        )
        raise ValueError(
            f"`system` {system.name!r} has no linear part: its potential has no quadratic terms. Use another splitting "
            "method, such as 'srkn11b', or pass a system with `stiffness_matrix`."
        )
    return part


def _equilibrium(system: Any, K: np.ndarray) -> np.ndarray:
    """c in the range of K where ∇V vanishes along it: the rest U is then small beside ½ (q−c)ᵀK(q−c)."""
    inverse, t0 = np.linalg.pinv(K, rcond=1 / GAP**2, hermitian=True), float(system.t_span[0])
    starts = [np.zeros(system.ndof)] + ([] if system.y0 is None else [system.y0[: system.ndof]])
    with np.errstate(all="ignore"):
        for start in starts:
            if not np.isfinite(system.force(start, t0)).all():
                continue
            q, last, reach = start.copy(), np.inf, 0.0
            for _ in range(EQUILIBRIUM_STEPS):
                change = inverse @ np.asarray(system.force(q, t0))
                size = float(np.linalg.norm(change))
                if not size < last:  # at the level of rounding, or nowhere near
                    break
                q, last = q + change, size
                reach = max(reach, size, float(np.linalg.norm(q)))
            return inverse @ K @ q if last <= 1e-6 * reach else inverse @ K @ start
    return np.zeros(system.ndof)


def _interval(system: Any) -> float:
    return abs(system.t_span[1] - system.t_span[0])


def form_of_parts(system: Any) -> Any:
    """H with symbols for what depends on parameters alone, where it does not depend on t."""
    return system.written.parametric if system.autonomous else system.written


def read_off(form: Any, interval: float = 0.0) -> LinearPart | None:
    """The quadratic terms of a symbolic H, by the values of its parameters, or None if its potential has none."""
    import sympy as sp

    quadratic, rest = quadratic_terms(form.H, (*form.q, *form.p), form.parameters)
    values = dict(zip(form.parameters, map(sp.Float, form.values), strict=True))
    return _read_off(quadratic.xreplace(values), rest, form.q, form.p, interval)


@lru_cache(maxsize=64)
def _read_off(
    quadratic: sp.Expr, rest: sp.Expr, q: tuple[sp.Symbol, ...], p: tuple[sp.Symbol, ...], interval: float
) -> LinearPart | None:
    import sympy as sp

    d = len(q)
    B, K = sp.hessian(quadratic, p), sp.hessian(quadratic, q)
    # a coordinate takes part if its momentum enters H by the quadratic terms alone
    active = [i for i in range(d) if any(b != 0 for b in B.row(i)) and not rest.has(p[i])]
    idle = [i for i in range(d) if i not in active]
    B_array, K_array = (np.array(A.tolist(), dtype=float) for A in (B, K))
    for A in (B_array, K_array):
        A[idle, :] = A[:, idle] = 0.0
    if not K_array.any():
        return None
    unit = np.sqrt(np.abs(np.diag(B_array)))[active]
    scaled = B_array[np.ix_(active, active)] / np.outer(unit, unit) if unit.all() else np.zeros((1, 1))
    if not np.linalg.eigvalsh(scaled)[0] > ZERO:
        raise ValueError(
            "`system` has a kinetic energy ½ pᵀM⁻¹p whose M⁻¹ is not positive definite, so its quadratic part has no "
            "normal modes: use a scheme on the splitting 'kinetic', such as 'kahan_li8', or an implicit method."
        )
    at_zero = dict.fromkeys((*q, *p), sp.S.Zero)
    slope = np.array([float(sp.diff(quadratic, s).xreplace(at_zero)) for s in q])
    center = np.where(K_array.any(0), -np.linalg.pinv(K_array) @ slope, 0.0)
    X = sp.Matrix([s - _number(c) for s, c in zip(q, center, strict=True)])
    P, Ks, Bs = sp.Matrix(p), *(sp.Matrix(d, d, [_number(v) for v in A.ravel()]) for A in (K_array, B_array))
    removed = sp.expand(quadratic - (X.T * Ks * X)[0] / 2 - (P.T * Bs * P)[0] / 2)
    given = sp.expand(quadratic).as_coefficients_dict()
    kept = [
        t
        for t in sp.Add.make_args(removed)
        if t.free_symbols and abs(t.as_coeff_Mul()[0]) > ZERO * _size(t.as_coeff_Mul()[1], given, K_array, center, q)
    ]
    return LinearPart(B_array, K_array, center, rest + sp.Add(*kept), interval)


def _size(term: sp.Expr, given: Any, K: np.ndarray, center: np.ndarray, q: Sequence[sp.Symbol]) -> float:
    """The size of what cancels in the coefficient of a term: as it was given, and of K·center where it is linear."""
    from_center = float(np.abs(K[q.index(term)] * center).max()) if term in q else 0.0
    return max(abs(float(given.get(term, 0))), from_center)


def _number(value: float) -> Any:
    import sympy as sp

    return sp.Integer(int(value)) if float(value).is_integer() else sp.Float(value)


@lru_cache(maxsize=64)
def quadratic_terms(
    H: sp.Expr, variables: tuple[sp.Symbol, ...], parameters: tuple[sp.Symbol, ...] = ()
) -> tuple[sp.Expr, sp.Expr]:
    """H as polynomial terms of degree 2 or less and the rest; a term that has none of them is left as it is written.

    Mixed products q_i p_j stay in the rest.
    """
    import sympy as sp

    half = len(variables) // 2
    first = set(variables[:half])
    quadratic, rest, degree = [], [], partial(_degree, variables=variables, parameters=parameters)
    for term in sp.Add.make_args(H):
        expanded = sp.Add.make_args(sp.expand(term))
        low = [t for t in expanded if degree(t) <= 2 and not (t.has(*first) and t.has(*variables[half:]))]
        if any(degree(t) == 2 for t in low) or len(low) == len(expanded):
            quadratic += low
            rest += [t for t in expanded if t not in low]
        else:
            rest.append(term)
    return sp.Add(*quadratic), sp.Add(*rest)


def _degree(term: sp.Expr, variables: tuple[sp.Symbol, ...], parameters: tuple[sp.Symbol, ...]) -> float:
    """Total degree of a monomial in these; infinite for other expressions."""
    degree = 0
    for base, exponent in term.as_powers_dict().items():
        if base in variables and exponent.is_Integer and exponent > 0:
            degree += int(exponent)
        elif not (base.free_symbols | exponent.free_symbols) <= {*parameters}:
            return np.inf
    return degree


DRAWN, SAMPLES = 4096, 64  # states drawn, and those of lowest potential at which Hessians are compared
GAP = 10.0  # between the curvatures of a stiff direction and of the others
TURN = 0.1  # radians by which a stiff direction may turn and still count as constant


def _inverse_mass(system: Any) -> np.ndarray:
    """M⁻¹ (d, d)."""
    if not system.quadratic_kinetic:
        raise ValueError("`stiffness_matrix` needs a kinetic energy ½ pᵀM⁻¹p: leave it out.")
    return np.asarray(system.kinetic_hessian(np.zeros(system.ndof)), dtype=float)


def turning(system: Any, part: LinearPart | None) -> str | None:
    """Reason for which a constant K does not follow the stiff directions of V, or None.

    ∇²V is taken at states of low potential, in the domain or about y0: in the valleys where orbits are. It is stiff if
    at the median state a gap divides its curvatures; then the stiff directions must be those of K at all of them, or,
    where there is no K, those at the first.
    """
    q = _positions(system)
    if q is None or system.ndof < 2:
        return None
    try:
        with np.errstate(all="ignore"):
            hessians = np.asarray(system.potential_hessian(q, float(system.t_span[0])))
    except (TypeError, ValueError):  # a callable that has no Hessian: nothing can be compared
        return None
    hessians = hessians[np.isfinite(hessians).all((-1, -2))]
    if len(hessians) < 2:
        return None
    try:
        L = np.linalg.cholesky(_inverse_mass(system))
    except np.linalg.LinAlgError:  # of coordinates without a kinetic energy
        return None
    curvature, directions = np.linalg.eigh(L.T @ hessians @ L)
    order = np.argsort(-np.abs(curvature), axis=-1)
    typical = np.median(np.abs(np.take_along_axis(curvature, order, -1)), axis=0)
    ratios = typical[:-1] / np.maximum(typical[1:], 1e-12 * typical[0])
    m = int(np.argmax(ratios)) + 1
    if not ratios[m - 1] > GAP:
        return None
    stiff = np.take_along_axis(directions, order[:, None, :m], -1)
    if (angle := _angle(stiff[0], stiff)) > TURN:
        return (
            f"its stiff directions turn, by {np.degrees(angle):.0f}° from one state of the domain to others, so no "
            "constant matrix K follows them. Write it in coordinates in which they do not turn, such as polar ones"
        )
    if part is None:
        return None
    eigenvalues, W = np.linalg.eigh(L.T @ part.stiffness_matrix @ L)
    if (angle := _angle(W[:, np.argsort(-np.abs(eigenvalues))[:m]], stiff)) <= TURN:
        return None
    if system.stiffness_matrix is not None:
        return (
            f"`stiffness_matrix` is stiff in other directions than V, {np.degrees(angle):.0f}° away. Pass ∇²V at a "
            "state of low potential, without what is not stiff in it"
        )
    return (
        f"its stiff directions do not turn, but its quadratic terms do not hold them: the stiffest of these is "
        f"{np.degrees(angle):.0f}° away. Give the system by functions, Hamiltonian(V, ndof=…, "
        "stiffness_matrix=K) with K the curvature ∇²V of the stiff directions"
    )


def _angle(reference: np.ndarray, directions: np.ndarray) -> float:
    """Angle in radians from the span of m orthonormal columns to those of others (n, d, m), exceeded by one in ten."""
    cosines = np.linalg.svd(reference.T @ directions, compute_uv=False)[:, -1]
    return float(np.arccos(np.clip(np.quantile(cosines, 0.1), 0.0, 1.0)))


def _positions(system: Any) -> np.ndarray | None:
    if system.domain is not None:
        q = system.domain.sample(DRAWN, 0)[:, : system.ndof]
    elif system.y0 is not None:
        center = system.y0[: system.ndof]
        spread = 0.5 * max(float(np.linalg.norm(center)), 1e-3) / np.sqrt(system.ndof)
        q = center + spread * np.random.default_rng(0).standard_normal((DRAWN, system.ndof))
    else:
        return None
    with np.errstate(all="ignore"):
        V = np.asarray(system.potential(q, float(system.t_span[0])))
    return q[np.argsort(np.where(np.isfinite(V), V, np.inf))[:SAMPLES]]


# matrices that a user gives ----------------------------------------------------------------------------------------


def checked_inverse_mass(mass: float | ArrayLike | None, ndof: int) -> np.ndarray | None:
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


def checked_stiffness(matrix: ArrayLike, ndof: int) -> np.ndarray:
    """K (d, d), exactly symmetric."""
    K = real_array("stiffness_matrix", matrix)
    if K.shape != (ndof, ndof):
        raise ValueError(
            f"`stiffness_matrix` must be finite, symmetric and of shape ({ndof}, {ndof}); got shape {K.shape}."
        )
    _check_symmetric("stiffness_matrix", K)
    return (K + K.T) / 2


def checked_damping(values: float | ArrayLike | None, ndof: int) -> np.ndarray | None:
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
                f"`damping` must be finite and not negative, because friction takes energy away; got {values!r}."
            )
    else:
        _check_symmetric("damping", G)
        G = (G + G.T) / 2
        rates = np.linalg.eigvalsh(G)
        if rates[0] < -8 * ndof * np.finfo(float).eps * abs(rates).max():
            raise ValueError(
                "`damping` must be a positive semi-definite matrix, because friction takes energy away; its smallest "
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


def numeric(matrix: sp.Matrix) -> np.ndarray | None:
    """The numbers of a matrix of SymPy, in its simplest form."""
    found = np.zeros(matrix.shape)
    for place, entry in matrix.todok().items():
        found[place] = float(entry)
    return simplest(found)


def simplest(inverse: np.ndarray) -> np.ndarray | None:
    """None for the identity, the diagonal for a diagonal matrix, else the matrix."""
    if np.array_equal(inverse, np.eye(len(inverse))):
        return None
    diagonal = np.diag(inverse).copy()
    return diagonal if np.array_equal(inverse, np.diag(diagonal)) else inverse


# normal modes of lattices, by fast transforms -----------------------------------------------------------------------


class Transform:
    """The orthonormal transform W of fields on a lattice to its plane or standing waves, axis by axis."""

    def __init__(self, shape: tuple[int, ...], boundary: tuple[str, ...]) -> None:
        self.shape, self.boundary = shape, boundary

    def angles(self, axis: int) -> np.ndarray:
        """θ of the waves along an axis, the phase from one site to the next: (n,), in 0 … π."""
        n = self.shape[axis]
        k = np.arange(n)
        return {"periodic": 2 * np.pi * ((k + 1) // 2) / n, "fixed": np.pi * (k + 1) / (n + 1), "free": np.pi * k / n}[
            self.boundary[axis]
        ]

    def total(self, per_axis: Sequence[np.ndarray]) -> np.ndarray:
        """The sum of values by the waves of each axis, (n, …) each: (*shape, …)."""
        total: Any = 0.0
        for axis, values in enumerate(per_axis):
            places = [-1 if a == axis else 1 for a in range(len(self.shape))]
            total = total + values.reshape(*places, *values.shape[1:])
        return np.broadcast_to(total, (*self.shape, *per_axis[0].shape[1:]))

    def forth(self, x: Array) -> Array:
        """W x: (..., *shape), each."""
        for axis, kind in enumerate(self.boundary):
            x = self._one(x, axis, kind, False)
        return x

    def back(self, x: Array) -> Array:
        """Wᵀx: (..., *shape), each."""
        for axis, kind in enumerate(self.boundary):
            x = self._one(x, axis, kind, True)
        return x

    def _one(self, x: Array, axis: int, kind: str, back: bool) -> Array:
        at = axis - len(self.shape)
        if is_tensor(x):
            x = x.movedim(at, -1)
            return (_backwards if back else _forwards)(x, kind).movedim(-1, at)
        from scipy import fft, fftpack

        if kind == "fixed":
            return fft.dst(x, 1, axis=at, norm="ortho")
        if kind == "free":
            return (fft.idct if back else fft.dct)(x, 2, axis=at, norm="ortho")
        scale = self._scales[axis].astype(x.dtype, copy=False)
        return fftpack.irfft(x / scale, axis=at) if back else fftpack.rfft(x, axis=at) * scale

    @cached_property
    def _scales(self) -> list[np.ndarray]:
        """The norms that `fftpack.rfft` leaves out, for each axis."""
        scales = []
        for axis, n in enumerate(self.shape):
            scale = np.full(n, math.sqrt(2 / n))
            scale[0] = math.sqrt(1 / n)
            if n % 2 == 0:
                scale[-1] = math.sqrt(1 / n)
            scales.append(scale.reshape([-1] + [1] * (len(self.shape) - 1 - axis)))
        return scales


def _forwards(x: Any, kind: str) -> Any:
    """W along the last axis of a tensor."""
    import torch

    n = x.shape[-1]
    if kind == "fixed":
        nothing = x.new_zeros((*x.shape[:-1], 1))
        odd = torch.cat([nothing, x, nothing, -x.flip(-1)], -1)
        return -torch.fft.rfft(odd).imag[..., 1 : n + 1] * math.sqrt(1 / (2 * (n + 1)))
    if kind == "free":
        even = torch.fft.rfft(torch.cat([x, x.flip(-1)], -1))[..., :n]
        return (even * _half_shift(x, -1)).real * _cosine_norms(x) / 2
    F = torch.fft.rfft(x)
    pairs = torch.view_as_real(F[..., 1 : (n + 1) // 2]).flatten(-2) * math.sqrt(2 / n)
    last = [F[..., n // 2 :].real * math.sqrt(1 / n)] if n % 2 == 0 else []
    return torch.cat([F[..., :1].real * math.sqrt(1 / n), pairs, *last], -1)


def _backwards(x: Any, kind: str) -> Any:
    """Wᵀ along the last axis of a tensor."""
    import torch

    n = x.shape[-1]
    if kind == "fixed":
        return _forwards(x, kind)
    if kind == "free":
        F = 2 * (x / _cosine_norms(x)) * _half_shift(x, 1)
        return torch.fft.irfft(torch.cat([F, 0 * F[..., :1]], -1), n=2 * n)[..., :n]
    pairs = x[..., 1 : 1 + 2 * ((n - 1) // 2)] * math.sqrt(n / 2)
    F = torch.view_as_complex(pairs.unflatten(-1, (-1, 2)).contiguous())
    ends = [x[..., n - 1 :] * math.sqrt(n)] if n % 2 == 0 else []
    return torch.fft.irfft(torch.cat([x[..., :1] * math.sqrt(n) + 0j, F, *(e + 0j for e in ends)], -1), n=n)


def _half_shift(x: Any, sign: int) -> Any:
    """e^{±iθ/2} of standing waves between free ends."""
    import torch

    n = x.shape[-1]
    return torch.exp(0.5j * sign * math.pi / n * torch.arange(n, dtype=x.dtype, device=x.device))


def _cosine_norms(x: Any) -> Any:
    n = x.shape[-1]
    norms = x.new_full((n,), math.sqrt(2 / n))
    norms[0] = math.sqrt(1 / n)
    return norms


class SpectralPart(NormalModes):
    """A quadratic H of fields on a lattice, diagonal by a `Transform` and a small matrix for each wave."""

    dense = diagonal = False

    def __init__(
        self,
        transform: Transform,
        rates: np.ndarray,
        kinds: np.ndarray,
        matrices: np.ndarray | None = None,
        interval: float = 0.0,
    ) -> None:
        self.transform, self.interval = transform, interval
        self.fields = len(rates)
        self.rates, self.kinds = rates.ravel(), kinds.ravel()
        self.ndof = self.rates.size
        self.center = np.zeros(self.ndof)
        self._matrices = matrices
        self._inverses = None if matrices is None else np.linalg.inv(matrices)

    @classmethod
    def of_matrices(
        cls, transform: Transform, inverse_mass: np.ndarray, stiffness: np.ndarray, interval: float = 0.0
    ) -> SpectralPart:
        """The part ½ pᵀBp + ½ qᵀKq."""
        L = np.sqrt(inverse_mass)
        squares, V = np.linalg.eigh(L[:, None] * stiffness * L)
        squares[abs(squares) <= ZERO * abs(squares).max(initial=0.0)] = 0.0
        unit = np.where(squares != 0, abs(squares) ** 0.25, 1.0)
        kinds = np.where(squares > 0, "oscillator", np.where(squares < 0, "hyperbolic", "free"))
        rates = np.where(squares != 0, np.sqrt(abs(squares)), 1.0)
        matrices = L[:, None] * V / unit[..., None, :]
        return cls(transform, np.moveaxis(rates, -1, 0), np.moveaxis(kinds, -1, 0), matrices, interval)

    @cached_property
    def modes(self) -> np.ndarray:
        """C, dense: (d, d)."""
        return self.positions(np.eye(self.ndof)).T

    @cached_property
    def inverse_modes(self) -> np.ndarray:
        """C⁻¹, dense: (d, d)."""
        return self.coordinates(np.eye(self.ndof)).T

    @cached_property
    def classes(self) -> np.ndarray:  # type: ignore[override]
        """To which of the distinct frequencies a mode belongs: (d,) int."""
        keys = np.rec.fromarrays([self.kinds, self.rates])
        return np.unique(keys, return_inverse=True)[1].reshape(-1)

    # C and its inverse, on (..., d)

    def positions(self, X: Array) -> Array:
        """C X."""
        return self._flat(self.transform.back(self._mixed(self._matrices, self._on_waves(X), False)))

    def coordinates(self, x: Array) -> Array:
        """C⁻¹x."""
        return self._flat(self._mixed(self._inverses, self.transform.forth(self._on_waves(x)), False))

    def momenta(self, Y: Array) -> Array:
        """C⁻ᵀY."""
        return self._flat(self.transform.back(self._mixed(self._inverses, self._on_waves(Y), True)))

    def slopes(self, g: Array) -> Array:
        """Cᵀg."""
        return self._flat(self._mixed(self._matrices, self.transform.forth(self._on_waves(g)), True))

    def _on_waves(self, x: Array) -> Array:
        return x.reshape(*x.shape[:-1], self.fields, *self.transform.shape)

    def _flat(self, x: Array) -> Array:
        return x.reshape(*x.shape[: x.ndim - 1 - len(self.transform.shape)], self.ndof)

    def _mixed(self, matrices: np.ndarray | None, x: Array, transposed: bool) -> Array:
        """The matrix of each wave times the fields (..., F, *shape)."""
        if matrices is None:
            return x
        A = like(matrices.swapaxes(-1, -2) if transposed else matrices, x)
        if self.fields == 1:
            return x * A[..., 0, 0]
        axis = -1 - len(self.transform.shape)
        return moveaxis((A @ moveaxis(x, axis, -1)[..., None])[..., 0], -1, axis)


def dispersion(couplings: Mapping[int, np.ndarray], angles: np.ndarray) -> np.ndarray:
    """Σ_k κ_k (2 − 2 cos kθ), of bonds ½ rᵀκ_k r over k sites: (n,) to (n, F, F)."""
    total: Any = 0.0
    for k, kappa in couplings.items():
        total = total + (4 * np.sin(k * angles / 2) ** 2)[:, None, None] * kappa
    return total
