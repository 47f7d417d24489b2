"""Driven systems, H(t, q, p): samples of a function of t in expressions, and drifts of T(p, t).

The flow of H(t, q, p) is that of the autonomous E + H(t, q, p) in [q, t, p, E], with t' = 1 and E' = −∂H/∂t. A
splitting cuts it into T(p, t) + E, a drift, with which the time moves, and V(q, t), a kick at a fixed time.
"""

from __future__ import annotations

from typing import Any

import sympy as sp
from sympy.core.symbol import Str

from sympflow.hamiltonian.expression import ELEMENTARY
from sympflow.hamiltonian.parameters import Samples


class sampled(sp.Function):
    """A derivative of samples in an expression: sampled(name, order, t), of order −1 the antiderivative."""

    nargs = 3
    is_real = True

    @property
    def name_of_samples(self) -> str:
        return str(self.args[0])

    @property
    def order(self) -> int:
        return int(self.args[1])

    @property
    def at(self) -> sp.Expr:
        """The time, an expression."""
        return self.args[2]

    def _eval_derivative(self, s: sp.Symbol) -> sp.Expr:
        name, order, at = self.args
        return sampled(name, order + 1, at) * sp.diff(at, s)

    def _sympystr(self, printer: Any) -> str:
        order = "" if self.order == 0 else f"_{self.order}".replace("-", "m")
        return f"{self.name_of_samples}{order}({printer._print(self.at)})"


def sampled_parameter(name: str, samples: Samples, time: sp.Symbol) -> sampled:
    """The expression that stands for a sampled parameter."""
    return sampled(Str(f"{name}_{samples.digest}"), sp.S.Zero, time)


def with_symbols(f: list[sp.Expr]) -> tuple[list[sp.Expr], dict[sampled, sp.Symbol]]:
    """Expressions with a symbol for each value of samples in them, and these symbols."""
    found = sorted({a for each in f for a in each.atoms(sampled)}, key=str)
    symbols = {a: sp.Symbol(f"sample_{i}", real=True) for i, a in enumerate(found)}
    return ([each.xreplace(symbols) for each in f] if symbols else f), symbols


# drifts of T(p, t) ---------------------------------------------------------------------------------

DURATION = sp.Symbol("duration", real=True)  # s, how long a drift lasts, in expressions of it


def drift(slope: tuple[sp.Expr, ...], time: sp.Symbol | None) -> tuple[sp.Expr, ...]:
    """∫_t^{t+s} ∇T(p, u) du, an expression in p, t and s, which is `DURATION`, for each entry of the slope ∇T(p, t)."""
    sums = [f if time is None or not f.has(time) else sp.expand(f) for f in slope]
    return tuple(sp.Add(*[_integrated(term, time) for term in sp.Add.make_args(f)]) for f in sums)


def _integrated(term: sp.Expr, time: sp.Symbol | None) -> sp.Expr:
    if time is None or not term.has(time):
        return DURATION * term
    fixed, moving = term.as_independent(time, as_Add=False)
    if moving.free_symbols != {time}:
        raise _not_elementary(term, time)
    if isinstance(moving, sampled) and moving.at == time:
        antiderivative = moving.func(moving.args[0], moving.args[1] - 1, time)
    else:
        antiderivative = _antiderivative(moving, time)
        if antiderivative is None:
            raise _not_elementary(term, time)
    if antiderivative.is_polynomial(time):  # the difference without cancellation
        return fixed * sp.expand(antiderivative.xreplace({time: time + DURATION}) - antiderivative)
    return fixed * (antiderivative.xreplace({time: time + DURATION}) - antiderivative)


def _antiderivative(f: sp.Expr, time: sp.Symbol) -> sp.Expr | None:
    from sympy.integrals.manualintegrate import manualintegrate

    if f.atoms(sampled):
        return None
    found = manualintegrate(f, time)
    kinds = {type(a) for a in found.atoms(sp.Function)}
    if found.atoms(sp.Integral) or any(kind.__name__ not in _ELEMENTARY for kind in kinds):
        return None
    return found


_ELEMENTARY = frozenset((*ELEMENTARY, "Abs", "Max", "Min"))


def _not_elementary(term: sp.Expr, time: sp.Symbol) -> ValueError:
    return ValueError(
        f"`system` has a kinetic energy T(p, {time}) whose drift needs the integral over {time} of {term}, which is "
        "not elementary: use an implicit method such as 'gauss_legendre6', or a Runge–Kutta method."
    )
