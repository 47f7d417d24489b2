"""Fingerprints and identities of systems: a trained flow recognises its own system by these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from sympflow.arrays import to_numpy
from sympflow.compiler.arrange import Arrangement
from sympflow.compiler.program import Program
from sympflow.hamiltonian.domain import Domain, domain_of
from sympflow.hamiltonian.formulas import TracedHamiltonian
from sympflow.lazy import lately_kept

if TYPE_CHECKING:
    from sympflow.hamiltonian.hamiltonian import Hamiltonian

DRAWN = 512  # states of a domain from which those of an identity are chosen
MOST_STATES, FEWEST_STATES, MOST_NUMBERS = 64, 8, 4096
LONGEST_EXPRESSION = 20_000  # characters of an H that is kept as a text; a longer one is known by its values alone
LONGEST_COMPARED = 2_000  # characters of two formulas that are compared as such, where their texts differ
TOLERANCE = 1e-9  # share of the largest difference of energies among the states, and of the largest entry of Γ
LATEST, GOLDEN = 20.0, (5**0.5 - 1) / 2
"""Times at which a driven H is probed are multiples of the golden ratio, modulo 1, of the first."""
PROBES = 8  # fixed states whose energies begin a fingerprint


def fingerprint(system: Hamiltonian) -> tuple[float, ...]:
    """H at 8 fixed states less H at a ninth, NaN where it is not finite; then the entries of Γ of a damped system."""
    states = _fixed_states(system.ndof)
    if system.local is not None:
        states[:, : system.ndof] *= system.local.apart
    ninth = np.broadcast_to(states[0], states[1:].shape)
    with np.errstate(invalid="ignore"):
        H = _energies(system, states[1:]) - _energies(system, ninth)
    H[~np.isfinite(H)] = np.nan  # a file keeps no infinities
    friction = () if system.damping is None else system.damping.ravel().tolist()
    return (*H.tolist(), *friction)


def _fixed_states(ndof: int) -> np.ndarray:
    return np.random.Generator(np.random.PCG64(20260101)).random((9, 2 * ndof)) * 0.9 - 0.35


def same_system(a: Sequence[float], b: Sequence[float]) -> bool:
    """Return True if two fingerprints agree to nine digits of the largest, of the energies and of Γ each."""
    return a == b or _agree(tuple(a), tuple(b))


@lru_cache(maxsize=256)
def _agree(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    u, v = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return u.shape == v.shape and all(_close(u[part], v[part]) for part in (slice(PROBES), slice(PROBES, None)))


def _close(u: np.ndarray, v: np.ndarray) -> bool:
    finite = u[np.isfinite(u)]
    return np.allclose(u, v, rtol=0, atol=TOLERANCE * np.abs(finite).max(initial=0.0), equal_nan=True)


def check_for_flows(system: Hamiltonian, takes_friction: bool = False, takes_driving: bool = False) -> None:
    """Refuse a system with terms that a flow cannot have: friction, an external force, or the time."""
    if system.external_force is not None or not takes_friction:
        system.check_conservative(
            "which only primed flows can have, with H = ½ pᵀM⁻¹p + V(q)",
            "fit such a flow by sympflow.train(system), or use a splitting method such as 'verlet' or 'kahan_li8', or "
            "a Runge–Kutta method such as 'dop853'",
        )
    if not takes_driving:
        system.check_autonomous(
            "which primed flows take, with H = ½ pᵀM⁻¹p + V(q, t), and networks of SympFlow.timed(system), no others",
            "fit such a flow by sympflow.train(system), or use a splitting method such as 'verlet' or 'kahan_li8'",
        )


def recognised(mine: Sequence[float], identity: Identity | None, system: Any, friction: bool = True) -> bool:
    """Return True if a fingerprint, and an identity where there is one, are those of a system, or but for friction."""
    if not same_system(mine, system.fingerprint if friction else fingerprint(system)[:PROBES]):
        return False
    if np.isfinite(mine[:PROBES]).any():
        return identity is None or identity.agrees(system)
    if identity is None:  # in units in which H is finite at none of the common states
        return False
    return identity.agrees(system) if len(identity.states) else identity.is_proved(system)


def without_friction(mine: Sequence[float], identity: Identity | None, system: Hamiltonian) -> bool:
    """Return True if a fingerprint and an identity are those of a damped system without its friction."""
    return bool(system.friction) and recognised(mine, identity, system, friction=False)


@dataclass(eq=False)
class Identity:
    """The H of a system as a flow keeps it, to know it again all over its domain, and along a run."""

    states: np.ndarray
    energies: np.ndarray
    expression: str | None

    @classmethod
    def of(cls, system: Hamiltonian, domain: Domain | None, seed: int = 20260103) -> Self:
        """Return the identity of a system, by seeded states of a domain."""
        states = np.empty((0, 2 * system.ndof)) if domain is None else _spread_states(system, domain, seed)
        energies = _energies(system, states) if len(states) else np.empty(0)
        expression = system.expression
        if expression is not None and len(expression) > LONGEST_EXPRESSION:
            expression = None
        return cls(states, energies, expression)

    def agrees(self, system: Hamiltonian) -> bool:
        """Return True if H of a system has these energies at these states, up to a constant; found out once."""
        return _agrees(system, self)

    def first_difference(self, system: Hamiltonian, states: np.ndarray | None = None) -> int | None:
        """The index of the first of the states (n, 2d), by default its own, where H differs from a system's."""
        if states is None:
            if not len(self.states):
                return None
            states, mine = self.states, self.energies
        else:
            read = _read(self.expression, system.ndof)
            if read is None:
                return None
            mine = _energies(read, states)
        # H is known up to a constant: both are compared with what they are at one state that both can evaluate
        theirs = _energies(system, states)
        origin, base = self._origin(system)
        if not np.isfinite(origin - base):
            return None
        mine, theirs = mine - base, theirs - origin
        usual = np.abs(self.energies - base) if len(self.states) else np.abs(mine)
        usual = usual[np.isfinite(usual)].max(initial=0.0)
        size = TOLERANCE * np.maximum(np.abs(mine), usual) + 64 * np.finfo(float).eps * max(abs(base), abs(origin))
        same = (np.abs(mine - theirs) <= size) | (np.isnan(mine) & np.isnan(theirs)) | (mine == theirs)
        return None if same.all() else int(np.argmin(same))

    def _origin(self, system: Hamiltonian) -> tuple[float, float]:
        """H of the system and of this identity at a state that belongs to neither run."""
        if len(self.states):
            finite = np.flatnonzero(np.isfinite(self.energies))
            i = int(finite[0]) if finite.size else 0
            return float(_energies(system, self.states[: i + 1])[i]), float(self.energies[i])
        read, state = _read(self.expression, system.ndof), _fixed_states(system.ndof)[:1]
        return float(_energies(system, state)[0]), float(_energies(read, state)[0])

    def is_proved(self, system: Hamiltonian) -> bool:
        """Return True if the formula of a system is this one, up to a constant; found out once."""
        return _is_proved(system, self.expression)

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {"states": self.states.tolist(), "energies": self.energies.tolist(), "expression": self.expression}

    @classmethod
    def from_dict(cls, description: Any, ndof: int) -> Self:
        """Return the identity that `to_dict` described; None stands for values that are not finite."""
        names = {"states", "energies", "expression"}
        if not isinstance(description, Mapping) or set(description) != names:
            raise ValueError("it is not a table of states, energies and an expression")
        expression = description["expression"]
        if not isinstance(expression, str | None) or len(expression or "") > LONGEST_EXPRESSION:
            raise ValueError("its expression is not a text, or too long")
        states, energies = _floats(description["states"], 2), _floats(description["energies"], 1)
        states = states.reshape(-1, 2 * ndof) if states.size == 0 else states
        if states.shape != (len(energies), 2 * ndof) or not np.isfinite(states).all():
            raise ValueError("its states and energies do not fit each other")
        return cls(states, energies, expression)


@lately_kept
def _agrees(system: Hamiltonian, identity: Identity) -> bool:
    return identity.first_difference(system) is None or identity.is_proved(system)


@lately_kept
def _is_proved(system: Hamiltonian, mine: str | None) -> bool:
    if mine is None:
        return False
    form = system.form
    if isinstance(form, TracedHamiltonian) and form.text is not None:
        read = _read(mine, system.ndof)
        plain = read is not None and isinstance(read.form, TracedHamiltonian)
        return plain and _differ_by_number(read.form.H.program, form.H.program)
    theirs = system.expression
    if theirs is None or mine == theirs:
        return mine == theirs
    if len(mine) + len(theirs) > LONGEST_COMPARED:
        return False
    import sympy

    read, given = _read(mine, system.ndof), system.symbols
    if read is None or read.symbols is None or given is None:
        return False
    return bool(sympy.expand(read.symbols.H - given.H).is_number)


def _differ_by_number(a: Program, b: Program) -> bool:
    """Return True if two programs of the same inputs are seen to be the same but for a number, multiplied out."""
    made = Arrangement([(repr(x), 0) for x in a.inputs])
    difference = made.number(a(*made.states)[0]) - made.number(b(*made.states)[0])
    return difference.constant is not None


def _floats(values: Any, ndim: int) -> np.ndarray:
    """A list of numbers or None, or for ndim = 2 a list of such lists, as an array."""
    rows = values if ndim == 2 else [values]
    if not isinstance(values, list) or not all(isinstance(row, list) for row in rows):
        raise ValueError("its numbers are not in lists")
    for v in (v for row in rows for v in row):
        if v is not None and (isinstance(v, bool) or not isinstance(v, int | float)):
            raise ValueError(f"it has {v!r}, which is not a number")
    try:
        return np.array([np.nan if v is None else v for v in values] if ndim == 1 else values, dtype=float)
    except (ValueError, OverflowError, TypeError):
        raise ValueError("its numbers are not an array of floats") from None


def _energies(system: Hamiltonian, states: np.ndarray) -> np.ndarray:
    """H at the states (n, 2d), of a driven system each at a time that its number gives, within samples."""
    low, high = (system.symbols.span if system.definition.samples else None) or (0.0, LATEST)
    times = low + (high - low) * (np.arange(1, len(states) + 1) * GOLDEN % 1.0)
    with np.errstate(all="ignore"):
        return to_numpy(system.hamiltonian(states, times)).astype(float)


@lru_cache(maxsize=16)
def _read(expression: str | None, ndof: int) -> Any:
    """The H of a text in a file, read by a grammar and never executed; None unless it has d degrees of freedom."""
    from sympflow.hamiltonian.hamiltonian import Hamiltonian
    from sympflow.hamiltonian.written import written

    if expression is None:
        return None
    if (found := written(expression) or written(expression, timed=True)) is not None:
        return Hamiltonian("", found, found.inverse_mass, True) if found.ndof == ndof else None
    from sympflow.hamiltonian.symbolic import SymbolicHamiltonian

    symbols = None
    for time in (None, "t"):
        try:
            symbols = SymbolicHamiltonian(expression, time=time)
            break
        except (ValueError, TypeError):
            continue
    if symbols is None:
        return None
    return Hamiltonian("", symbols, None, False) if symbols.ndof == ndof else None


def _spread_states(system: Hamiltonian, domain: Domain, seed: int) -> np.ndarray:
    """States of the domain, the ends of each coordinate among them, to six digits."""
    width = 2 * system.ndof
    n = min(MOST_STATES, max(FEWEST_STATES, MOST_NUMBERS // width))
    if FEWEST_STATES * width > 8 * MOST_NUMBERS:
        return np.empty((0, width))
    domain = domain_of(domain, system)
    drawn = domain.sample(DRAWN, seed)
    ends = np.stack([drawn.argmin(0), drawn.argmax(0)], axis=-1).ravel()[: n // 2]
    chosen = list(dict.fromkeys([*ends.tolist(), *range(len(drawn))]))[:n]
    return np.vectorize(lambda x: float(f"{x:.6g}"))(drawn[chosen])
