"""H given by the user's own functions; missing derivatives by automatic differentiation."""

from __future__ import annotations

import inspect
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from sympflow.arguments import check_flag
from sympflow.arrays import (
    Array,
    as_tensor,
    beside,
    concatenate,
    differentiable,
    is_tensor,
    jacobian,
    jvp,
    library,
    library_name,
    like,
    of_library,
    opaque,
    stack,
    to_numpy,
    unfollowed,
    values,
)
from sympflow.compiler.program import Program, traced
from sympflow.compiler.tracing import WEIGHTS, Untraceable, trace, trace_chain, trace_followed
from sympflow.hamiltonian.definition import Definition
from sympflow.hamiltonian.formulas import (
    MOST_COMPILED,
    TracedHamiltonian,
    TracedPoles,
    kinetic_matrix,
    without_overflow,
)
from sympflow.hamiltonian.function_checks import Tested, check_writes, probe_states, test
from sympflow.hamiltonian.layered import LayeredPotential
from sympflow.hamiltonian.linear_part import simplest
from sympflow.hamiltonian.quantities import Variable
from sympflow.hamiltonian.times import probe_times

MOST_BY_ARRAYS = 2000  # operations of a gradient, beyond which torch differentiates its own functions of arrays
TRIED = 6  # states at which a traced function is compared with itself
CLOSE = 1e-9  # of the largest value


class FollowedForm(NamedTuple):
    """A form with the numbers of tensors that torch follows as parameters, and these tensors."""

    form: TracedHamiltonian
    tensors: Sequence[Any]

    def values(self, n: int) -> np.ndarray:
        """The numbers as they are now, the same for n trajectories: (k, n)."""
        numbers = [np.ravel(to_numpy(x)) for x in self.tensors]
        return np.repeat(np.concatenate([*numbers, np.empty(0)])[:, None], n, axis=1)


class CallableHamiltonian(Definition):
    """The functions of a system given by V(q) or H(q, p), as a program where they can be traced: `form`.

    They are traced when they are first used, and compared by value with the program. Functions of a driven system take
    the time first, one number: a float beside arrays, a tensor of one double beside tensors.
    """

    library: str = ""  # "numpy" or "torch", whose arrays the functions take; "" if they fail on both
    untraced: str = ""
    _kinetic: Program | None = None  # T of p, of an H that is found to be a sum, where T is not quadratic
    kinetic: Callable[..., Array]
    kinetic_gradient: Callable[..., Array]
    kinetic_hessian: Callable[..., Array]
    guard: Callable[[], None] | None = None  # refuses a system of which something else has changed
    _scene: tuple[Any, ...] = (None, None, None, (0.0, 1.0))
    _functions: tuple[Any, Any, Any, Any]
    _potential: Any
    _hamiltonian: Any

    def __init__(
        self, ndof: int, potential: Any, hamiltonian: Any, gradient: Any, hessian_vector: Any, check: Any, timed: bool
    ) -> None:
        check_flag("check", check)
        if (potential is None) == (hamiltonian is None):
            raise TypeError("`potential` or `hamiltonian` must be given, and not both.")
        functions = potential, hamiltonian, gradient, hessian_vector
        for (name, arguments), function in zip(_ARGUMENTS.items(), functions, strict=True):
            _check_callable(name, function, gradient)
            if function is not None and not _is_numba(function):
                _check_arguments(name, function, arguments, timed)
        if potential is None and (gradient is not None or hessian_vector is not None):
            raise TypeError("`gradient` and `hessian_vector` only go with `potential`: leave them out.")
        self.ndof, self.given, self.timed = ndof, bool(check), timed
        self.separable = potential is not None
        self._name = "potential" if self.separable and not isinstance(potential, _AtRest) else "hamiltonian"
        self._given_function: Any = potential if self.separable else hamiltonian
        self._some_time = (0.0,) * timed
        self._functions = functions
        if _is_numba(gradient):
            _check_numba(potential, gradient, hessian_vector, "t, " * timed)
            self.numba_functions = given = potential, gradient, hessian_vector
            V, slope, product = (NumbaFunction(given, order) for order in range(3))
            functions = V, None, slope, None if hessian_vector is None else product
        of_arrays = [None if f is None else partial(_over_times, f) if timed else f for f in functions]
        self._potential, self._hamiltonian, self._gradient, self._hessian_vector = of_arrays
        self.given_functions = self.numba_functions is None

    @np.errstate(all="ignore")
    def as_sum(self) -> tuple[CallableHamiltonian, np.ndarray | None, bool] | None:
        """The definition of H = T(p) + V(q) by V, M⁻¹, and whether T = ½ pᵀM⁻¹p; None for any other H."""
        form, d = self.form, self.ndof
        if form is None or self.separable:
            return None
        H, inputs = form.program, form.program.inputs
        is_sum, M = kinetic_matrix(H.outputs[0], inputs, d)
        if not is_sum:
            return None
        nothing = [0.0] * d
        state, t, _ = self._known
        elsewhere = [t] * self.timed + state[:d].tolist()
        p0 = nothing if np.isfinite(H(*map(np.float64, (*elsewhere, *nothing)))[0]) else state[d:].tolist()
        made = CallableHamiltonian(d, _AtRest(self._functions[1], p0), None, None, None, self.given, self.timed)
        made.guard = self.check_unchanged
        if p0 is nothing and M is not None:
            return made, simplest(np.array(M)), True

        def kinetic(*p: Any) -> list[Any]:
            return [H(*elsewhere, *p)[0] - H(*elsewhere, *p0)[0]]

        T = TracedHamiltonian(d, traced(kinetic, *(f"p{i + 1}" for i in range(d))), False)
        made._kinetic, made.kinetic = T.program, T.value
        made.kinetic_gradient, made.kinetic_hessian = T.gradient, T.hessian
        return made, None, False

    def identity_parts(self) -> Any:
        return [self.ndof, self._functions] if self.timed else [self.ndof, *self._functions]

    @property
    def name(self) -> str:
        letter, name = "V" if self._name == "potential" else "H", getattr(self._given_function, "__name__", "")
        return f"{letter} = {name}" if name.isidentifier() else f"{letter} of a function"

    def place(self, y0: Any, domain: Any, inverse_mass: np.ndarray | None, t_span: tuple[float, float]) -> None:
        self._scene = y0, domain, inverse_mass, t_span

    @cached_property
    def form(self) -> TracedHamiltonian | None:
        if self.numba_functions is not None:
            self.untraced = "it is a Numba function"
            return None
        if not self.given and self._functions[2] is not None:  # then `potential` may be a dummy
            self.untraced = "with check=False the `gradient` is taken as it is: leave one of them out"
            return None
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            try:
                return self._traced()
            except Untraceable as reason:
                self.untraced = str(reason)
                return None

    @cached_property
    def layered(self) -> LayeredPotential | None:
        *_, gradient, product = self._functions
        given = self.timed or gradient is not None or product is not None or not self.separable
        if given or (self.form is not None and self.form.size <= MOST_COMPILED) or self.library != "torch":
            return None
        y0, domain, inverse_mass, _ = self._scene
        try:
            chain = trace_chain(self._given_function, [f"q{i + 1}" for i in range(self.ndof)])
            found = LayeredPotential(self.ndof, chain, inverse_mass)
        except Untraceable as reason:
            if self.untraced == WEIGHTS != str(reason):
                self.untraced = f"{WEIGHTS}, and {reason}"
            return None
        states = probe_states(y0, domain, 2 * self.ndof)[:TRIED]
        if not _alike(found.value(states[:, : self.ndof]), self._values(states, [0.0] * len(states))):
            return None
        if self.form is None:
            self._known = states[0], 0.0, np.nan
        return found

    @cached_property
    def followed(self) -> FollowedForm | None:
        *_, gradient, product = self._functions
        if self.form is not None or self.library != "torch" or self.timed or not (gradient is product is None):
            return None
        y0, domain, inverse_mass, _ = self._scene
        d = self.ndof
        try:
            names = [[f"{letter}{i + 1}" for i in range(d)] for letter in "qp"[: 2 - self.separable]]
            program, tensors = trace_followed(self._given_function, names)
            program = without_overflow(program)
        except Untraceable:
            return None
        letters = [Variable(f"number{i}") for i in range(sum(x.numel() for x in tensors))]
        given = inverse_mass, False, self._kinetic, letters, [1.0] * len(letters)
        found = FollowedForm(TracedHamiltonian(d, program, self.separable, *given), tensors)
        states = probe_states(y0, domain, 2 * d)[:TRIED]
        x = states[:, :d] if self.separable else states
        with np.errstate(all="ignore"):
            values = program(*x.T, *found.values(len(x)))[0]
        return found if _alike(values, self._values(states, [0.0] * len(states))) else None

    @cached_property
    def poles(self) -> TracedPoles | None:
        return None if self.form is None else TracedPoles(self.form) or None

    @cached_property
    def _jumping(self) -> Definition:
        """The form in symbols, whose jumps in t are known, of functions that may jump."""
        written = self.form.written if self.timed and self.form is not None and self.form.may_bend else None
        return Definition() if written is None else written

    @property
    def may_jump(self) -> bool:  # type: ignore[override]
        return self._jumping.may_jump

    def jump_times(self, low: float, high: float, step: float, kinks: bool = False) -> np.ndarray:
        return self._jumping.jump_times(low, high, step, kinks)

    @property
    def has_hessian_vector(self) -> bool:  # type: ignore[override]
        *_, gradient, product = self._functions
        return gradient is None or product is not None or self.form is not None

    @property
    def has_third_derivative(self) -> bool:  # type: ignore[override]
        return self.form is not None and self.library == "numpy"

    @property
    def differentiates_itself(self) -> bool:  # type: ignore[override]
        *_, gradient, product = self._functions
        return gradient is None and product is None and not self.has_third_derivative

    def _traced(self) -> TracedHamiltonian:
        """The program, compared with the functions."""
        y0, domain, inverse_mass, t_span = self._scene
        states = probe_states(y0, domain, 2 * self.ndof)
        states = np.concatenate([states[:: -(-len(states) // (TRIED - 1))], states[-1:]])
        times = np.resize(probe_times(*t_span), len(states)).tolist()
        values, f = self._values(states, times), self._given_function
        d = self.ndof
        names: list[Any] = [[f"{letter}{i + 1}" for i in range(d)] for letter in "qp"[: 2 - self.separable]]
        program = without_overflow(trace(f, ["t", *names] if self.timed else names, self.library == "torch"))
        form = TracedHamiltonian(d, program, self.separable, inverse_mass, self.timed, self._kinetic)
        at = (np.array(times),) if self.timed else ()
        x = states[:, :d] if self.separable else states
        if not np.isfinite(values).any():
            raise Untraceable("it is not finite at the states at which it was tried: give `y0`")
        if not _alike(form.value(x, *at), values):
            raise Untraceable("what was traced has other values: the function depends on more than its arguments")
        self._compare_given(form, x, times)
        i = int(np.nanargmax(np.where(np.isfinite(values), np.abs(values), np.nan)))
        self._known = states[i], times[i], float(values[i])
        return form

    def _values(self, states: np.ndarray, times: Sequence[float]) -> np.ndarray:
        """The function's own values at states, NaN where it fails; finds out which library it is written for."""
        for name in ("numpy", *(("torch",) if "torch" in sys.modules else ())):
            self.library, failure, found = name, "", []
            for y, t in zip(states, times, strict=True):
                try:
                    value = self._single(self._given_function, y, t)
                except Exception as error:  # whatever a user's function raises
                    failure = (
                        failure or f"{type(error).__name__}: {str(error).splitlines()[0][:160] if str(error) else ''}"
                    )
                    value = np.nan
                if library_name(value) != name:
                    failure, value = failure or "its result is not a NumPy array", np.nan
                try:
                    found.append(float(value))
                except (TypeError, ValueError, RuntimeError):
                    found.append(np.nan)
            if not failure or np.isfinite(found).any():
                return np.array(found)
        self.library = ""
        raise Untraceable(f"it fails on an array ({failure})")

    def _single(self, function: Callable[..., Any], y: np.ndarray, t: float, *more: np.ndarray) -> Any:
        """A function at one state, in its library."""
        q, p = y[: self.ndof], y[self.ndof :]
        given: list[Any] = [np.array(x) for x in ((q, *more) if self.separable else (q, p))]
        if self.library == "torch":
            import torch

            with torch.no_grad():
                return function(
                    *((torch.tensor(t, dtype=torch.float64),) if self.timed else ()), *map(torch.tensor, given)
                )
        for x in given:
            x.flags.writeable = False
        return function(*((t,) if self.timed else ()), *given)

    def _compare_given(self, form: TracedHamiltonian, q: np.ndarray, times: Sequence[float]) -> None:
        """Compare a given gradient and product with those of the program."""
        *_, gradient, product = self._functions
        for name, function, more in (("gradient", gradient, ()), ("hessian_vector", product, (q[::-1],))):
            if function is None:
                continue
            exact = getattr(form, name)(q, *more, *((np.array(times),) if self.timed else ()))
            try:
                given = zip(q, times, *more, strict=True)
                rows = [self._single(function, x, t, *v) for x, t, *v in given]
                found = np.stack([to_numpy(row).astype(float) for row in rows])
            except Exception as error:  # whatever a user's function raises
                raise Untraceable(f"`{name}` fails where `{self._name}` does not ({error})") from error
            if found.shape != exact.shape or not _alike(found, exact):
                raise Untraceable(f"`{name}` is not exactly that of `{self._name}`: leave it out")

    def check_unchanged(self) -> None:
        """Raise a ValueError if the function has another value than when it was traced."""
        if self.guard is not None:
            self.guard()
        if self.form is not None:
            state, t, expected = self._known
        elif self.layered is not None:
            state, t, _ = self._known
            expected = float(self.layered.value(state[None, : self.ndof])[0])
        else:
            return
        with np.errstate(all="ignore"):
            value = float(self._single(self._given_function, state, t))
        if not abs(value - expected) <= CLOSE * abs(expected):
            raise ValueError(
                f"`{self._name}` has another value than when it was traced, {value:g} in place of {expected:g} at "
                f"the state {state[:8]}: it reads something that has changed since. Make a new HamiltonianSystem."
            )

    def _exact(self, x: Array, function: Any = None) -> TracedHamiltonian | None:
        """The program, where it is taken at x: in place of a user's function, if one is given, for tensors only.

        Torch differentiates functions of its own tensors itself.
        """
        form, tensor = self.form, is_tensor(x)
        if form is None or (tensor and self._follows_tensors) or not (tensor or function is None):
            return None
        return form if self.library == "numpy" or form.size <= MOST_BY_ARRAYS else None

    @cached_property
    def _follows_tensors(self) -> bool:
        """True if torch differentiates the functions, with the result that the program has."""
        if self.library == "torch" or self.form is None:
            return self.library == "torch"
        import torch

        d, times = self.ndof, (self._scene[3][0],) * self.timed
        state = probe_states(None, None, 2 * d)[0, : d * (2 - self.separable)]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                found = to_numpy(torch.func.grad(partial(self._own, *times))(torch.tensor(state)))
            except Exception:  # whatever a user's function raises
                return False
        return _alike(found, self.form.gradient(state, *times))

    _generated = ("form", "followed", "_jumping", "poles", "takes_tensors", "_follows_tensors")

    def learns(self, y: Array) -> bool:
        if self.numba_functions is not None or (self.form is not None and self.library == "numpy"):
            return False
        y = unfollowed(y)
        try:
            slope = self.gradient(y[..., : self.ndof] if self.separable else y, *self._some_time)
        except (TypeError, ValueError, RuntimeError):  # written for NumPy arrays: torch can follow nothing in it
            return False
        return differentiable(slope)

    @property
    def _reason(self) -> tuple[str, bool]:
        return self.untraced, self.library == "numpy"

    def check(self, states: np.ndarray, like: Array, n_given: int, times: Sequence[float] = ()) -> None:
        """Test them against each other at states (n, 2d) in the library and dtype of `like`: see `function_checks`."""
        if self.form is not None:
            self.form.check_continuous(self._name)
        if self.form is not None and self.library == "numpy":
            like = np.empty(0) if is_tensor(like) or self._gradient is None else like
        elif self.differentiates_itself:
            like = as_tensor(like)
        if self.separable:
            states = states[:, : self.ndof]
        for t in [(s,) for s in times] if self.timed else [()]:
            if self.numba_functions is not None:
                like = np.empty(0)
                _, gradient, product = self.numba_functions
                q = np.ascontiguousarray(states[0])
                check_writes("gradient", partial(gradient, *t), q)
                if product is not None:
                    check_writes("hessian_vector", partial(product, *t), q, q[::-1].copy())
            test(self._tested(*t), states, like, n_given)

    def _tested(self, *t: float) -> Tested:
        """The functions, at a time, as they are tested."""
        exact = self.form is not None and self._gradient is None
        return Tested(
            (self._name, "gradient", "q" if self.separable else "[q, p]"),
            lambda x: self.hamiltonian(x, *t),
            None if exact else lambda x: self.gradient(x, *t),
            None if self._hessian_vector is None else lambda q, v: self.hessian_vector(q, v, *t),
            automatic=self._gradient is None,
            parts=1 if self.separable else 2,
            result_types=lambda x: self._result_types(x, *t),
            time=t[0] if t else None,
        )

    def _result_types(self, x: Array, *t: float) -> list[tuple[str, Any]]:
        """The types in which the functions themselves answer for a state x."""
        if self.numba_functions is not None:
            return []
        functions = (self._name, self._own), ("gradient", self._gradient)
        return [(name, getattr(f(*t, x), "dtype", None)) for name, f in functions if f is not None]

    @cached_property
    def takes_tensors(self) -> bool:  # type: ignore[override]
        """False if the gradient fails on a tensor, or answers with something else or NumPy's warnings."""
        if self.form is not None:
            return True
        if self._gradient is None or self.numba_functions is not None:
            return self.library != "numpy"
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                return is_tensor(self._gradient(*self._some_time, as_tensor(np.full((2, self.ndof), 0.5))))
            except Exception:  # whatever a user's function raises
                return False

    def _own(self, *arguments: Any) -> Any:
        """V of (t, q), or H of (t, y), by the function itself."""
        *t, x = arguments
        if self.separable:
            return self._potential(*t, x)
        return self._hamiltonian(*t, x[..., : self.ndof], x[..., self.ndof :])

    def hamiltonian(self, x: Array, *t: Any) -> Array:
        """V of q or H of y, by the function itself, but for tensors that it does not take."""
        if (form := self._exact(x, self._own)) is not None:
            return form.value(x, *t)
        _ = self.form  # finds out for which library the function is written
        if self._gradient is not None or self.library == library_name(x) == "numpy":
            return _checked(self._protected(self._own, self._name, t, x), x, self._name, ())
        return _with_torch(partial(self._own, *t), x, self._name, (), self._reason)

    def gradient(self, x: Array, *t: Any) -> Array:
        if self._gradient is None or self._exact(x, self._gradient) is not None:
            return self._derived("gradient", _gradient_of, x, x.shape[-1:], t)
        return _checked(self._protected(self._gradient, "gradient", t, x), x, "gradient", x.shape[-1:])

    def potential_hessian(self, x: Array, *t: Any) -> Array:
        n = x.shape[-1]
        if self._exact(x) is not None:
            return self._derived("hessian", _hessian_of, x, (), t)
        if self._hessian_vector is not None:
            basis = [e + 0 * x for e in like(np.eye(n), x)]
            columns = [self._protected(self._hessian_vector, "hessian_vector", t, x, e) for e in basis]
            return stack([_checked(column, x, "hessian_vector", (n,)) for column in columns])
        if self._gradient is not None and not is_tensor(x):
            raise ValueError(
                "`hessian_vector` is needed here (force-gradient methods, volume and symplecticity metrics) and was "
                "not given: pass it to HamiltonianSystem, or write `potential` so that it can be traced and leave "
                f"`gradient` out; it could not be, because {self.untraced}."
            )
        if self._gradient is not None:
            return jacobian(partial(self._gradient, *t), x)[1]
        return self._derived("hessian", _hessian_of, x, (n, n), t)

    potential, potential_gradient, hessian = hamiltonian, gradient, potential_hessian

    def _derived(self, name: str, make: Callable[..., Any], x: Array, tail: tuple[int, ...], t: Sequence[Any]) -> Array:
        """A derivative of V or H at x: by the program, or of a function of tensors by torch."""
        form = self._exact(x)
        if form is not None:
            return getattr(form, name)(x, *t)
        return _with_torch(make(partial(self._own, *t), self._name), x, self._name, tail, self._reason)

    def _protected(self, function: Callable[..., Any], name: str, times: Sequence[Any], *states: Array) -> Any:
        """The user's function of arrays that it cannot write into, for they are the state of the run."""
        if self.numba_functions is not None:
            return function(*times, *states)
        refused = f"`{name}` writes into its argument, the state of the run: let it work on a copy"
        if is_tensor(states[0]):
            versions = [*map(_version, states)]
            value = function(*times, *states)
            if versions != [*map(_version, states)]:
                raise ValueError(f"{refused}, q.clone().")
            return value
        views = [x[...] for x in states]  # the flag is not that of the caller's array
        for view in views:
            view.flags.writeable = False
        try:
            return function(*times, *views)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise ValueError(f"{refused}, q.copy() ({error}).") from error

    def hessian_vector(self, q: Array, v: Array, *t: Any) -> Array:
        if (form := self._exact(q, self._hessian_vector)) is not None:
            return form.hessian_vector(q, v, *t)
        if self._hessian_vector is None:
            return super().hessian_vector(q, v, *t)
        return self._protected(self._hessian_vector, "hessian_vector", t, q, v)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Any) -> Array:
        assert self.form is not None
        return self.form.third_derivative(q, v, w, *t)

    def time_derivative(self, y: Array, t: Any) -> Array:
        """∂H/∂t (...): of functions that torch differentiates by that, of others by differences of order 6."""
        x = y[..., : self.ndof] if self.separable else y
        if (form := self._exact(y)) is not None:
            return form.time_derivative(x, t)
        if self.differentiates_itself:
            s, tensor = beside(t, as_tensor(x)), as_tensor(x)
            found = jvp(lambda u: self.hamiltonian(tensor, u), s, 0 * s + 1)[1]
            return like(of_library(found, y), y)
        return _time_difference(lambda s: self.hamiltonian(x, s), t)


def _alike(found: np.ndarray, expected: np.ndarray) -> bool:
    """True of equal values, but for rounding, NaN and infinite ones in the same places."""
    finite = np.isfinite(expected)
    if not (finite == np.isfinite(found)).all():
        return False
    size = np.abs(expected[finite]).max(initial=0.0)
    return bool((np.abs(found[finite] - expected[finite]) <= CLOSE * size).all())


def _check_callable(name: str, function: Any, gradient: Any) -> None:
    if function is not None and not callable(function):
        raise TypeError(f"`{name}` must be callable; got {type(function).__name__}.")
    if name in ("potential", "hamiltonian") and gradient is None and _is_numba(function):
        raise TypeError(
            f"`{name}` is a Numba function, through which torch cannot differentiate: pass the function that it is "
            "made of, its `.py_func`, written with torch functions, or a `potential` with its `gradient`."
        )


def _is_numba(function: Any) -> bool:
    """True of a function compiled by Numba, which none is before Numba is imported."""
    numba = sys.modules.get("numba.core.dispatcher")
    return numba is not None and isinstance(function, numba.Dispatcher)


def _check_numba(potential: Any, gradient: Any, hessian_vector: Any, first: str = "") -> None:
    """Raise unless the functions given with a Numba `gradient` are Numba functions of the right arguments."""
    for name, function, arguments in (
        ("potential", potential, f"{first}q"),
        ("gradient", gradient, f"{first}q, out"),
        ("hessian_vector", hessian_vector, f"{first}q, v, out"),
    ):
        if function is None:
            continue
        if not _is_numba(function):
            raise TypeError(f"`{name}` must be a Numba function, as `gradient` is: decorate it with numba.njit.")
        count = len(inspect.signature(function.py_func).parameters)
        if count != len(arguments.split(",")):
            raise TypeError(f"`{name}` must take ({arguments}) as a Numba function; it takes {count} arguments.")


def _gradient_of(f: Callable[[Array], Array], name: str) -> Callable[[Array], Array]:
    def gradient(x: Array) -> Array:
        import torch

        return torch.func.grad(lambda z: _checked(f(z), z, name, ()).sum())(x)

    return gradient


def _hessian_of(f: Callable[[Array], Array], name: str) -> Callable[[Array], Array]:
    return lambda x: jacobian(_gradient_of(f, name), x)[1]


def _with_torch(
    f: Callable[[Array], Array], x: Array, name: str, tail: tuple[int, ...], reason: tuple[str, bool]
) -> Array:
    """f(x) for a function written with torch; NumPy arrays go through tensors.

    `reason` is why it was not traced, and whether it is written for NumPy's arrays.
    """
    tensor = as_tensor(x)
    version, value, failure = _version(tensor), None, None
    untraced, of_numpy = reason
    with warnings.catch_warnings() if of_numpy else nullcontext():
        if of_numpy:
            warnings.simplefilter("error", DeprecationWarning)  # of functions that take tensors for arrays
        try:
            value = f(tensor)
        except (TypeError, RuntimeError, AttributeError, IndexError, DeprecationWarning) as error:
            if isinstance(error, RecursionError) or str(error).startswith(f"`{name}` must"):
                raise
            failure = error
    if untraced and (isinstance(value, np.ndarray | np.generic) or (failure and of_numpy)):
        raise TypeError(
            f"`{name}` could not be traced, because {untraced}, and torch cannot differentiate it. Write it with "
            "functions "
            "that have a rule, or pass `gradient` as well, as spline(q, 1) of a spline of SciPy, or use "
            "HamiltonianSystem.from_sympy."
        ) from failure
    if failure:
        traced = f", and could not be traced, because {untraced}" if untraced else ""
        raise TypeError(
            f"`{name}` failed on a torch tensor of shape {tuple(x.shape)} ({failure}){traced}. Write it with NumPy's "
            "or torch's functions of (..., d) arrays, or pass `gradient` as well, or use HamiltonianSystem.from_sympy."
        ) from failure
    if _version(tensor) != version:
        raise ValueError(f"`{name}` writes into its argument, the state of the run: let it work on a copy, q.clone().")
    value = _checked(value, tensor, name, tail)
    return of_library(value, x)


def _version(x: Any) -> int:
    """The count of what was written into a tensor, which torch leaves out in its inference mode."""
    return 0 if x.is_inference() else int(x._version)


def _checked(value: Any, x: Array, name: str, tail: tuple[int, ...]) -> Array:
    """Return the user's result for x, checked: real numbers of the right shape, in the library and dtype of x."""
    expected, tensor = (*x.shape[:-1], *tail), library_name(x) == "torch"
    if isinstance(value, int | float) and not tensor:
        value = np.asarray(value)
    shape = getattr(value, "shape", None)
    if shape is None or tuple(shape) != expected:
        raise ValueError(
            f"`{name}` must return shape {expected} for a state part of shape {tuple(x.shape)}; got "
            f"{type(value).__name__ if shape is None else tuple(shape)}. Reduce over the last axis only: write "
            "q[..., 0] in place of q[0], and NumPy's functions in place of those of `math`."
        )
    if library(value) is not library(x):
        given, got = ("a torch tensor", "NumPy's") if tensor else ("a NumPy array", "torch's")
        raise TypeError(
            f"`{name}` must return an array of the library that it is given, {given}; got one of {got}. Write it for "
            "both, leave `gradient` out, or take a method that runs on the other, such as 'rk45' or 'dopri5'."
        )
    if value.is_complex() if tensor else value.dtype.kind not in "fiub":
        raise TypeError(f"`{name}` must return real numbers; got {value.dtype}. Take the real part.")
    return value.to(x.dtype) if tensor else value.astype(x.dtype, copy=False)


class _AtRest:
    """V(q) = H(q, p0) of an H that is a sum T(p) + V(q), with the time first where there is one."""

    def __init__(self, hamiltonian: Callable[..., Any], p0: Sequence[float]) -> None:
        self.hamiltonian, self.p0 = hamiltonian, p0

    def __call__(self, *arguments: Any) -> Any:
        q, p0 = arguments[-1], np.array(self.p0)
        return self.hamiltonian(*arguments, library(q).zeros_like(q) + (like(p0, q) if is_tensor(q) else p0))


_ARGUMENTS = {"potential": "q", "hamiltonian": "q, p", "gradient": "q", "hessian_vector": "q, v"}


def _over_times(function: Callable[..., Any], t: Any, *states: Array) -> Any:
    """A function of a user whose first argument is the time, one number: of states (..., k) at one time, or each."""

    def at(t: Any, *states: Array) -> Any:
        return function(beside(t, states[0]) if is_tensor(states[0]) else float(t), *states)

    if not getattr(t, "ndim", 0):
        return at(t, *states)
    flat, times = [x.reshape(-1, x.shape[-1]) for x in states], t.reshape(-1)
    if (found := values(times)) is not None and (found == found[..., :1]).all():
        return at(times[0], *states)
    if is_tensor(times):
        each = [at(s, *(x[i] for x in flat)) for i, s in enumerate(times)]
        return stack(each, axis=0).reshape(*t.shape, *each[0].shape)
    distinct, which = np.unique(times, return_inverse=True)
    groups = [np.flatnonzero(which == k) for k in range(len(distinct))]
    parts = [at(s, *(x[rows] for x in flat)) for s, rows in zip(distinct.tolist(), groups, strict=True)]
    for part, rows in zip(parts, groups, strict=True):
        if getattr(part, "shape", ())[:1] != rows.shape:
            return part  # which is refused by its shape
    result = concatenate(parts, 0)[np.argsort(np.concatenate(groups))]
    return result.reshape(*t.shape, *result.shape[1:])


def _check_arguments(name: str, function: Callable[..., Any], arguments: str, timed: bool) -> None:
    """Raise a TypeError if it is known that a function does not take these arguments."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return
    arguments = f"t, {arguments}" if timed else arguments
    try:
        signature.bind(*arguments.split(","))
    except TypeError as error:
        time = "the time first" if timed else "without the time, which a driven system gives where time=True is passed"
        raise TypeError(f"`{name}` is called with ({arguments}), {time}: {error}.") from None


def _time_difference(value: Callable[[Any], Array], t: Any) -> Array:
    """The derivative of a function of t, by central differences of order 6 with the step of ten at which it settles."""
    found, best, before = None, None, None
    for h in (0.1 * 0.4**k for k in range(10)):
        near, middle, far = (value(t + k * h) - value(t - k * h) for k in (1, 2, 3))
        slope = (45 * near - 9 * middle + far) / (60 * h)
        if before is not None:
            change = abs(slope - before)
            where = library(change).where
            found = slope if best is None else where(change < best, slope, found)
            best = change if best is None else where(change < best, change, best)
        before = slope
    return found


class NumbaFunction:
    """V, ∇V or ∇²V·v of Numba functions, by the order, for any batch of states; the time comes first.

    Tensors are taken through NumPy; derivatives of V and of ∇V flow back by ∇V and ∇²V·v, in reverse and forward mode.
    The Numba functions are V(q), gradient(q, out) and hessian_vector(q, v, out).
    """

    def __init__(self, functions: tuple[Any, Any, Any | None], order: int, times: tuple[float, ...] = ()) -> None:
        self.functions, self.order, self.times = functions, order, times

    def __call__(self, *arguments: Any) -> Array:
        n = 2 if self.order == 2 else 1
        times, x = tuple(map(float, arguments[:-n])), arguments[-n:]
        at = NumbaFunction(self.functions, self.order, times)
        return opaque(at, *x)

    def value(self, *x: np.ndarray) -> np.ndarray:
        """The values for arrays."""
        f = self.functions[self.order]
        if f is None:
            raise ValueError(
                "`hessian_vector` is needed here (force-gradient methods, volume and symplecticity metrics) and was "
                "not given: pass it to HamiltonianSystem."
            )
        if self.order:
            return _each_row(partial(f, *self.times), *x)
        rows = [f(*self.times, row) for row in _rows(x[0], x[0].shape)]
        return np.array(rows, dtype=x[0].dtype).reshape(x[0].shape[:-1])

    def _slope(self, *x: Array) -> Array:
        return NumbaFunction(self.functions, self.order + 1)(*self.times, *x)

    def vjp(self, x: Sequence[Array], w: Array, wanted: Sequence[bool]) -> tuple[Array | None, ...]:
        if self.order == 2:
            if wanted[0]:
                raise _third_derivative()
            return None, self(*self.times, x[0], w)
        return (self._slope(x[0], w) if self.order else w[..., None] * self._slope(x[0]),)

    def jvp(self, x: Sequence[Array], v: Sequence[Array | None]) -> Array:
        if self.order == 2:
            if v[0] is not None or v[1] is None:
                raise _third_derivative()
            return self(*self.times, x[0], v[1])
        return self._slope(x[0], v[0]) if self.order else (v[0] * self._slope(x[0])).sum(-1)


def _rows(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.ascontiguousarray(np.broadcast_to(x, shape), dtype=float).reshape(-1, shape[-1])


def _each_row(f: Any, *arguments: np.ndarray) -> np.ndarray:
    """f(row, …, out) for every state."""
    shape = np.broadcast_shapes(*(a.shape for a in arguments))
    rows = [_rows(a, shape) for a in arguments]
    out = np.full_like(rows[0], np.nan)  # what a function does not write is not finite, and ends the run
    for each in zip(*rows, out, strict=True):
        f(*each)
    return out.reshape(shape).astype(arguments[0].dtype, copy=False)


def _third_derivative() -> Exception:
    return ValueError(
        "`hessian_vector` would have to be differentiated, and a system given by Numba functions has no third "
        "derivatives: use a method without force gradients, or define the system with HamiltonianSystem.from_sympy."
    )
