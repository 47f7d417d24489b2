"""H given by the user's own functions; missing derivatives by automatic differentiation."""

from __future__ import annotations

import inspect
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from sympflow.arguments import check_flag
from sympflow.arrays import Array, differentiable, is_tensor, library, stack, to_numpy, unfollowed, values
from sympflow.compiler.tracing import WEIGHTS, Untraceable, trace, trace_chain
from sympflow.hamiltonian.definition import Definition
from sympflow.hamiltonian.formulas import TracedHamiltonian
from sympflow.hamiltonian.function_checks import Tested, check_writes, probe_states, test
from sympflow.hamiltonian.layered import LayeredPotential
from sympflow.hamiltonian.times import probe_times

MOST_BY_ARRAYS = 2000  # operations of a gradient, beyond which torch differentiates its own functions of arrays
TRIED = 6  # states at which a traced function is compared with itself
CLOSE = 1e-9  # of the largest value


class Functions(Definition):
    """A user's functions of V(q) or H(q, p), as a program where they can be traced: `form`.

    They are traced when they are first used, and compared by value with the program.

    Attributes
    ----------
    library : str
        "numpy" or "torch", whose arrays the functions take; "" if they fail on both.
    untraced : str
        The reason for which there is no program, a clause; "" if there is one.
    """

    library: str = ""
    untraced: str = ""
    _scene: tuple[Any, ...] = (None, None, None, (0.0, 1.0))
    _functions: tuple[Any, Any, Any, Any]

    @property
    def given_functions(self) -> bool:  # type: ignore[override]
        return self.numba_functions is None

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
        if self.form is not None or self.untraced != WEIGHTS or given:
            return None
        y0, domain, inverse_mass, _ = self._scene
        try:
            chain = trace_chain(self._given_function, [f"q{i + 1}" for i in range(self.ndof)])
            found = LayeredPotential(self.ndof, chain, inverse_mass)
        except Untraceable as reason:
            if str(reason) != WEIGHTS:
                self.untraced = f"{WEIGHTS}, and {reason}"
            return None
        states = probe_states(y0, domain, 2 * self.ndof)[:TRIED]
        if not _alike(found.value(states[:, : self.ndof]), self._values(states, [0.0] * len(states))):
            return None
        self._known = states[0], 0.0, np.nan
        return found

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

    @property
    def _name(self) -> str:
        return "potential" if self.separable else "hamiltonian"

    @property
    def _given_function(self) -> Callable[..., Any]:
        V, H, *_ = self._functions
        return V if self.separable else H

    def _traced(self) -> TracedHamiltonian:
        """The program, compared with the functions."""
        y0, domain, inverse_mass, t_span = self._scene
        states = probe_states(y0, domain, 2 * self.ndof)
        states = np.concatenate([states[:: -(-len(states) // (TRIED - 1))], states[-1:]])
        times = np.resize(probe_times(*t_span), len(states)).tolist()
        values, f = self._values(states, times), self._given_function
        d = self.ndof
        names: list[Any] = [[f"{letter}{i + 1}" for i in range(d)] for letter in "qp"[: 2 - self.separable]]
        program = trace(f, ["t", *names] if self.timed else names, self.library == "torch")
        form = TracedHamiltonian(d, program, self.separable, inverse_mass, self.timed)
        at = (np.array(times),) if self.timed else ()
        x = states[:, :d] if self.separable else states
        if not np.isfinite(values).any():
            raise Untraceable("it is not finite at the states at which it was tried: give `y0`")
        if not _alike(form.value(x, *at), values):
            raise Untraceable("the values of what was traced are others: it depends on more than its arguments")
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
                if is_tensor(value) != (name == "torch"):
                    failure, value = failure or "its result is none of NumPy's", np.nan
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
                found = np.stack([to_numpy(row) if is_tensor(row) else np.asarray(row, dtype=float) for row in rows])
            except Exception as error:  # whatever a user's function raises
                raise Untraceable(f"`{name}` fails where `{self._name}` does not ({error})") from error
            if found.shape != exact.shape or not _alike(found, exact):
                raise Untraceable(f"`{name}` is not exactly that of `{self._name}`: leave it out")

    def check_unchanged(self) -> None:
        """Raise a ValueError if the function has another value than when it was traced."""
        if self.layered is not None:
            state, t, _ = self._known
            expected = float(self.layered.value(state[None, : self.ndof])[0])
        elif self.form is not None:
            state, t, expected = self._known
        else:
            return
        with np.errstate(all="ignore"):
            value = float(self._single(self._given_function, state, t))
        if not abs(value - expected) <= CLOSE * abs(expected):
            raise ValueError(
                f"`{self._name}` has another value than when it was traced, {value:g} in place of {expected:g} at "
                f"the state {state[:8]}: it reads something that has changed since. Make a new HamiltonianSystem."
            )

    def _exact(self, x: Array) -> TracedHamiltonian | None:
        """The program, where it gives derivatives for x: torch differentiates functions of its own tensors itself."""
        form = self.form
        if form is None or (is_tensor(x) and self._follows_tensors):
            return None
        return form if self.library == "numpy" or form.size <= MOST_BY_ARRAYS else None

    @cached_property
    def _follows_tensors(self) -> bool:
        """True if torch differentiates the functions, with the result that the program has."""
        if self.library == "torch" or self.form is None:
            return self.library == "torch"
        import torch

        d, t, f = self.ndof, self._scene[3][0], self._given_function
        state = probe_states(None, None, 2 * d)[0, : d * (2 - self.separable)]

        def value(x: Array) -> Any:
            times = (torch.tensor(t, dtype=torch.float64),) if self.timed else ()
            return f(*times, *((x,) if self.separable else (x[:d], x[d:])))

        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                found = to_numpy(torch.func.grad(value)(torch.tensor(state)))
            except Exception:  # whatever a user's function raises
                return False
        return _alike(found, self.form.gradient(state, *((t,) if self.timed else ())))

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the program, which is traced again."""
        return {
            name: value
            for name, value in vars(self).items()
            if name not in ("form", "takes_tensors", "_follows_tensors")
        }


def _alike(found: np.ndarray, expected: np.ndarray) -> bool:
    """True of equal values, but for rounding, NaN and infinite ones in the same places."""
    finite = np.isfinite(expected)
    if not (finite == np.isfinite(found)).all():
        return False
    size = np.abs(expected[finite]).max(initial=0.0)
    return bool((np.abs(found[finite] - expected[finite]) <= CLOSE * size).all())


class CallableHamiltonian(Functions):
    """The functions of a system given by V(q) or H(q, p). See `HamiltonianSystem` for the arguments."""

    time: float | None = None
    """The time of the functions of a driven system, for messages."""
    traced: bool = False
    """True of functions at one time of a driven system that was traced."""

    def __init__(
        self,
        ndof: int,
        potential: Callable[..., Array] | None,
        hamiltonian: Callable[..., Array] | None,
        gradient: Callable[..., Any] | None,
        hessian_vector: Callable[..., Any] | None,
        check: bool = True,
    ) -> None:
        check_flag("check", check)
        if (potential is None) == (hamiltonian is None):
            raise TypeError("`potential` or `hamiltonian` must be given, and not both.")
        _check_callable(potential=potential, hamiltonian=hamiltonian, gradient=gradient)
        if potential is None and (gradient is not None or hessian_vector is not None):
            raise TypeError("`gradient` and `hessian_vector` only go with `potential`: leave them out.")
        self.ndof, self.given = ndof, bool(check)
        self.separable = potential is not None
        self._functions = potential, hamiltonian, gradient, hessian_vector
        self._potential, self._hamiltonian = potential, hamiltonian
        self._gradient, self._hessian_vector = gradient, hessian_vector
        if _is_numba(gradient):
            _check_numba(potential, gradient, hessian_vector)
            self.take_numba(potential, gradient, hessian_vector)

    @classmethod
    def at_time(cls, driven: DrivenCallables, functions: Sequence[Any]) -> CallableHamiltonian:
        """The functions of a driven system at one time, which are not traced again."""
        now = cls(driven.ndof, *functions)
        now.given = driven.given
        now.form, now.library = None, driven.library
        return now

    def take_numba(self, potential: Any, gradient: Any, hessian_vector: Any | None) -> None:
        """Take Numba functions of single states."""
        self.numba_functions = (potential, gradient, hessian_vector)
        arrays = NumbaFunctions(potential, gradient, hessian_vector)
        self._potential, self._gradient = arrays.potential, arrays.gradient
        self._hessian_vector = None if hessian_vector is None else arrays.hessian_vector

    def identity_parts(self) -> Any:
        return [self.ndof, *self._functions]

    def learns(self, y: Array) -> bool:
        if self.numba_functions is not None or (self.form is not None and self.library == "numpy"):
            return False
        y = unfollowed(y)
        try:
            slope = self.potential_gradient(y[..., : self.ndof]) if self.separable else self.gradient(y)
        except (TypeError, ValueError, RuntimeError):  # written for NumPy arrays: torch can follow nothing in it
            return False
        return differentiable(slope)

    def check(self, states: np.ndarray, like: Array, n_given: int) -> None:
        """Test them against each other at states (n, 2d) in the library and dtype of `like`: see `function_checks`."""
        traced = self.traced or self.form is not None
        if traced and self.library == "numpy":
            like = np.empty(0) if is_tensor(like) or self._gradient is None else like
        elif self.differentiates_itself and not is_tensor(like):
            import torch

            like = torch.from_numpy(np.empty(0, like.dtype))
        exact = traced and self._gradient is None
        if not self.separable:
            names = "hamiltonian", "gradient", "[q, p]"
            gradient = None if exact else self.gradient
            functions = Tested(names, self.hamiltonian, gradient, None, True, 2, self._result_types, self.time)
            test(functions, states, like, n_given)
            return
        if self.numba_functions is not None:
            _, gradient, hessian_vector = self.numba_functions
            q = np.ascontiguousarray(states[0, : self.ndof])
            check_writes("gradient", gradient, q)
            if hessian_vector is not None:
                check_writes("hessian_vector", hessian_vector, q, q[::-1].copy())
            like = np.empty(0)
        names = "potential", "gradient", "q"
        product = None if self._hessian_vector is None else self.hessian_vector
        automatic, slope = self._gradient is None, None if exact else self.potential_gradient
        functions = Tested(names, self.potential, slope, product, automatic, 1, self._result_types, self.time)
        test(functions, states[:, : self.ndof], like, n_given)

    def _result_types(self, x: Array) -> list[tuple[str, Any]]:
        """The types in which the functions themselves answer for a state x."""
        if self.numba_functions is not None:
            return []
        if not self.separable:
            return [("hamiltonian", getattr(self._H(x), "dtype", None))]
        functions = ("potential", self._potential), ("gradient", self._gradient)
        return [(name, getattr(f(x), "dtype", None)) for name, f in functions if f is not None]

    @cached_property
    def takes_tensors(self) -> bool:  # type: ignore[override]
        """False if the gradient fails on a tensor, or answers with something else or NumPy's warnings."""
        if self.form is not None:
            return True
        if self._gradient is None or self.numba_functions is not None:
            return self.library != "numpy"
        import torch

        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                return is_tensor(self._gradient(torch.full((2, self.ndof), 0.5, dtype=torch.float64)))
            except Exception:  # whatever a user's function raises
                return False

    def _value(self, f: Callable[[Array], Any], x: Array, name: str) -> Array:
        """V or H of x by the function itself, but for tensors that it does not take."""
        if is_tensor(x) and (form := self._exact(x)) is not None:
            return form.value(x)
        if self._gradient is not None or (self.library == "numpy" and not is_tensor(x)):
            return _checked(self._protected(f, name, x), x, name, ())
        return _with_torch(f, x, name, (), self.untraced)

    def _derived(self, name: str, make: Callable[..., Any], f: Any, x: Array, tail: tuple[int, ...]) -> Array:
        """A derivative of V or H at x: by the program, or of a function of tensors by torch."""
        form = self._exact(x)
        if form is not None:
            return getattr(form, name)(x)
        return _with_torch(make(f, self._name), x, self._name, tail, self.untraced)

    def hamiltonian(self, y: Array) -> Array:
        return self._value(self._H, y, "hamiltonian")

    def gradient(self, y: Array) -> Array:
        return self._derived("gradient", _gradient_of, self._H, y, (2 * self.ndof,))

    def hessian(self, y: Array) -> Array:
        return self._derived("hessian", _hessian_of, self._H, y, (2 * self.ndof, 2 * self.ndof))

    def _H(self, y: Array) -> Array:
        assert self._hamiltonian is not None
        return self._hamiltonian(y[..., : self.ndof], y[..., self.ndof :])

    def potential(self, q: Array) -> Array:
        assert self._potential is not None
        return self._value(self._potential, q, "potential")

    def potential_gradient(self, q: Array) -> Array:
        if self._gradient is None or (is_tensor(q) and self._exact(q) is not None):
            return self._derived("gradient", _gradient_of, self._potential, q, (self.ndof,))
        return _checked(self._protected(self._gradient, "gradient", q), q, "gradient", (self.ndof,))

    def _protected(self, function: Callable[..., Any], name: str, *states: Array) -> Any:
        """The user's function of arrays that it cannot write into, for they are the state of the run."""
        if self.numba_functions is not None:
            return function(*states)
        refused = f"`{name}` writes into its argument, the state of the run: let it work on a copy"
        if is_tensor(states[0]):
            versions = [getattr(x, "_version", 0) for x in states]
            value = function(*states)
            if versions != [getattr(x, "_version", 0) for x in states]:
                raise ValueError(f"{refused}, q.clone().")
            return value
        views = [x[...] for x in states]  # the flag is not that of the caller's array
        for view in views:
            view.flags.writeable = False
        try:
            return function(*views)
        except ValueError as error:
            if "read-only" not in str(error):
                raise
            raise ValueError(f"{refused}, q.copy() ({error}).") from error

    def hessian_vector(self, q: Array, v: Array) -> Array:
        form = self._exact(q)
        if form is not None and (self._hessian_vector is None or is_tensor(q)):
            return form.hessian_vector(q, v)
        if self._hessian_vector is None:
            return super().hessian_vector(q, v)
        return self._protected(self._hessian_vector, "hessian_vector", q, v)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Array) -> Array:
        assert self.form is not None
        return self.form.third_derivative(q, v, w)

    def potential_hessian(self, q: Array) -> Array:
        if self._exact(q) is not None:
            return self._derived("hessian", _hessian_of, self._potential, q, ())
        if self._hessian_vector is not None:
            columns = [self._protected(self._hessian_vector, "hessian_vector", q, e) for e in _basis(q)]
            return stack([_checked(column, q, "hessian_vector", (self.ndof,)) for column in columns])
        if self._gradient is not None and not is_tensor(q):
            raise ValueError(
                "`hessian_vector` is needed here (force-gradient methods, volume and symplecticity metrics) and was "
                "not given: pass it to HamiltonianSystem, or write `potential` so that it can be traced and leave "
                f"`gradient` out; it was not, for {self.untraced}."
            )
        if self._gradient is not None:
            return _jacobian(self._gradient, q)
        return self._derived("hessian", _hessian_of, self._potential, q, (self.ndof, self.ndof))


def _check_callable(**functions: Any) -> None:
    for name, function in functions.items():
        if function is not None and not callable(function):
            raise TypeError(f"`{name}` must be callable; got {type(function).__name__}.")
        if name in ("potential", "hamiltonian") and functions["gradient"] is None and _is_numba(function):
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


def _basis(x: Array) -> list[Array]:
    """The unit vectors along the last axis, each of the shape of x."""
    vectors = []
    for i in range(x.shape[-1]):
        e = 0 * x
        e[..., i] = 1
        vectors.append(e)
    return vectors


def _gradient_of(f: Callable[[Array], Array], name: str) -> Callable[[Array], Array]:
    def gradient(x: Array) -> Array:
        import torch

        return torch.func.grad(lambda z: _checked(f(z), z, name, ()).sum())(x)

    return gradient


def _hessian_of(f: Callable[[Array], Array], name: str) -> Callable[[Array], Array]:
    return lambda x: _jacobian(_gradient_of(f, name), x)


def _jacobian(f: Callable[[Array], Array], x: Array) -> Array:
    """Jacobian of a batched vector field by forward mode, one direction at a time: (..., k, k)."""
    import torch

    from sympflow.arrays import jvp

    return torch.stack([jvp(f, x, e)[1] for e in _basis(x)], dim=-1)


def _with_torch(f: Callable[[Array], Array], x: Array, name: str, tail: tuple[int, ...], untraced: str = "") -> Array:
    """f(x) for a function written with torch; NumPy arrays go through tensors that share their memory."""
    import torch

    tensor = x if is_tensor(x) else torch.from_numpy(np.ascontiguousarray(x))
    version = tensor._version
    try:
        value = f(tensor)
    except (TypeError, RuntimeError, AttributeError, IndexError) as error:
        if isinstance(error, RecursionError) or str(error).startswith(f"`{name}` must"):
            raise
        traced = f", and could not be traced, for {untraced}" if untraced else ""
        raise TypeError(
            f"`{name}` failed on a torch tensor of shape {tuple(x.shape)} ({error}){traced}. Write it with NumPy's or "
            "torch's functions of (..., d) arrays, or pass `gradient` as well, or use HamiltonianSystem.from_sympy."
        ) from error
    if tensor._version != version:
        raise ValueError(f"`{name}` writes into its argument, the state of the run: let it work on a copy, q.clone().")
    value = _checked(value, tensor, name, tail)
    return value if is_tensor(x) else to_numpy(value)


def _checked(value: Any, x: Array, name: str, tail: tuple[int, ...]) -> Array:
    """Return the user's result for x, checked: real numbers of the right shape, in the library and dtype of x."""
    expected = (*x.shape[:-1], *tail)
    if isinstance(value, int | float) and not is_tensor(x):
        value = np.asarray(value)
    shape = getattr(value, "shape", None)
    if shape is None or tuple(shape) != expected:
        raise ValueError(
            f"`{name}` must return shape {expected} for a state part of shape {tuple(x.shape)}; got "
            f"{type(value).__name__ if shape is None else tuple(shape)}. Reduce over the last axis only."
        )
    if is_tensor(value) != is_tensor(x):
        given, got = ("a torch tensor", "NumPy's") if is_tensor(x) else ("a NumPy array", "torch's")
        raise TypeError(
            f"`{name}` must return an array of the library that it is given, {given}; got one of {got}. Write it for "
            "both, leave `gradient` out, or take a method that runs on the other, such as 'rk45' or 'dopri5'."
        )
    if is_tensor(value):
        if value.is_complex():
            raise TypeError(f"`{name}` must return real numbers; got {value.dtype}. Take the real part.")
        return value.to(x.dtype)
    if value.dtype.kind not in "fiub":
        raise TypeError(f"`{name}` must return real numbers; got {value.dtype}. Take the real part.")
    return value.astype(x.dtype, copy=False)


class DrivenCallables(Functions):
    """The functions of a driven system, H(t, q, p), each with the time as its first argument.

    A user's function is called with one time, a number: as a float beside arrays, and as a tensor of one double beside
    tensors. States of several times are taken apart.
    """

    timed = True

    def __init__(
        self,
        ndof: int,
        potential: Callable[..., Array] | None,
        hamiltonian: Callable[..., Array] | None,
        gradient: Callable[..., Any] | None,
        hessian_vector: Callable[..., Any] | None,
        check: bool = True,
    ) -> None:
        _check_callable(potential=potential, hamiltonian=hamiltonian, gradient=gradient, hessian_vector=hessian_vector)
        self._functions = potential, hamiltonian, gradient, hessian_vector
        for (name, arguments), function in zip(_ARGUMENTS.items(), self._functions, strict=True):
            if function is not None and not _is_numba(function):
                _check_arguments(name, function, arguments)
        if _is_numba(gradient):
            _check_numba(potential, gradient, hessian_vector, "t, ")
            self.numba_functions = (potential, gradient, hessian_vector)
        check_flag("check", check)
        self.ndof, self.given, self.separable = ndof, bool(check), potential is not None
        self._at(0.0)  # refuses what does not fit

    def identity_parts(self) -> Any:
        return [self.ndof, self._functions]

    def _at(self, t: Any) -> CallableHamiltonian:
        """The functions at one time."""
        now = CallableHamiltonian.at_time(self, [None if f is None else _AtTime(f, t) for f in self._functions])
        if self.numba_functions is not None:
            now.take_numba(*(None if f is None else _AtTime(f, float(t)) for f in self.numba_functions))
        return now

    def _over_times(self, name: str, t: Any, *states: Array) -> Array:
        """A function of `CallableHamiltonian` of states (..., k), each at its time."""
        form, of_form = self._exact(states[0]), _OF_FORM.get(name)
        if form is not None and (of_form or is_tensor(states[0])):
            return getattr(form, of_form or "value")(*states, t)
        if not getattr(t, "ndim", 0):
            return getattr(self._at(t), name)(*states)
        flat = [x.reshape(-1, x.shape[-1]) for x in states]
        times = t.reshape(-1)
        if is_tensor(times) and (found := values(times)) is not None and (found == found[..., :1]).all():
            return getattr(self._at(times[0]), name)(*states)
        if is_tensor(times):
            rows = [getattr(self._at(s), name)(*(x[i] for x in flat)) for i, s in enumerate(times)]
            return stack(rows, axis=0).reshape(*t.shape, *rows[0].shape)
        distinct, which = np.unique(times, return_inverse=True)
        result: Any = None
        for k, s in enumerate(distinct.tolist()):
            rows = which == k
            each = getattr(self._at(s), name)(*(x[rows] for x in flat))
            if result is None:
                result = np.empty((len(times), *each.shape[1:]), dtype=each.dtype)
            result[rows] = each
        return result.reshape(*t.shape, *result.shape[1:])

    def learns(self, y: Array) -> bool:
        return (self.form is None or self.library == "torch") and self._at(0.0).learns(y)

    def check(self, states: np.ndarray, like: Array, n_given: int, times: np.ndarray | None = None) -> None:
        """Test them at each of the times (n,)."""
        traced = self.form is not None
        for t in (0.0,) if times is None else times.tolist():
            now = self._at(t)
            now.time, now.traced = t, traced
            now.check(states, like, n_given)

    @cached_property
    def takes_tensors(self) -> bool:  # type: ignore[override]
        return self.form is not None or self._at(0.0).takes_tensors

    def hamiltonian(self, y: Array, t: Any) -> Array:
        return self._over_times("hamiltonian", t, y)

    def gradient(self, y: Array, t: Any) -> Array:
        return self._over_times("gradient", t, y)

    def hessian(self, y: Array, t: Any) -> Array:
        return self._over_times("hessian", t, y)

    def potential(self, q: Array, t: Any) -> Array:
        return self._over_times("potential", t, q)

    def potential_gradient(self, q: Array, t: Any) -> Array:
        return self._over_times("potential_gradient", t, q)

    def potential_hessian(self, q: Array, *t: Any) -> Array:
        return self._over_times("potential_hessian", *t, q)

    def hessian_vector(self, q: Array, v: Array, *t: Any) -> Array:
        return self._over_times("hessian_vector", *t, q, v)

    def third_derivative(self, q: Array, v: Array, w: Array, *t: Any) -> Array:
        assert self.form is not None
        return self.form.third_derivative(q, v, w, *t)

    def time_derivative(self, y: Array, t: Any) -> Array:
        """∂H/∂t (...): of functions that torch differentiates by that, of others by differences of order 6."""
        states, name = (y[..., : self.ndof], "potential") if self.separable else (y, "hamiltonian")
        if (form := self._exact(y)) is not None:
            return form.time_derivative(states, t)

        def value(s: Any) -> Array:
            return self._over_times(name, s, states)

        if self.differentiates_itself:
            import torch

            from sympflow.arrays import jvp

            s = torch.as_tensor(t, dtype=torch.float64)
            tensor = torch.as_tensor(states)
            found = jvp(lambda u: self._over_times(name, u, tensor), s, torch.ones_like(s))[1]
            return found.to(states.dtype) if is_tensor(y) else to_numpy(found).astype(y.dtype)
        return _time_difference(value, t)


_OF_FORM = {
    "gradient": "gradient",
    "hessian": "hessian",
    "potential_gradient": "gradient",
    "potential_hessian": "hessian",
    "hessian_vector": "hessian_vector",
}
"""Methods of a form, by the functions of which they give derivatives."""
_ARGUMENTS = {"potential": "t, q", "hamiltonian": "t, q, p", "gradient": "t, q", "hessian_vector": "t, q, v"}


class _AtTime:
    """A function of a user at a time, which is its first argument."""

    def __init__(self, function: Callable[..., Any], t: Any) -> None:
        self.function, self.t = function, t

    def __call__(self, *states: Any) -> Any:
        t, x = self.t, states[0]
        if is_tensor(x):
            import torch

            t = torch.as_tensor(t, dtype=torch.float64, device=x.device)
        elif is_tensor(t):
            t = float(t)
        return self.function(t, *states)


def _check_arguments(name: str, function: Callable[..., Any], arguments: str) -> None:
    """Raise a TypeError if it is known that a function does not take these arguments."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(*arguments.split(","))
    except TypeError as error:
        raise TypeError(f"`{name}` of a driven system is called with ({arguments}), the time first: {error}.") from None


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


class NumbaFunctions:
    """The three functions of a system, for any batch of states.

    Tensors are taken through NumPy; derivatives of V and of ∇V flow back by ∇V and ∇²V·v, in reverse and forward mode.

    Parameters
    ----------
    potential : Numba function
        q (d,) ↦ V.
    gradient : Numba function
        (q, out) ↦ None.
    hessian_vector : Numba function, optional
        (q, v, out) ↦ None.
    """

    def __init__(self, potential: Any, gradient: Any, hessian_vector: Any | None) -> None:
        self.functions = potential, gradient, hessian_vector

    def potential(self, q: Array) -> Array:
        """V(q): (..., d) to (...)."""
        return self._on_tensors[0](q) if is_tensor(q) else self._potential(q)

    def gradient(self, q: Array) -> Array:
        """∇V(q): (..., d) to (..., d)."""
        return self._on_tensors[1](q) if is_tensor(q) else self._gradient(q)

    def hessian_vector(self, q: Array, v: Array) -> Array:
        """∇²V(q)·v: (..., d), (..., d) to (..., d)."""
        return self._on_tensors[2](q, v) if is_tensor(q) else self._hessian_vector(q, v)

    @cached_property
    def _on_tensors(self) -> tuple[Callable[..., Array], ...]:
        return _tensor_functions(self)

    def __getstate__(self) -> dict[str, Any]:
        return {"functions": self.functions}  # what is generated cannot be pickled

    def _potential(self, q: np.ndarray) -> np.ndarray:
        f = self.functions[0]
        return np.array([f(row) for row in _rows(q, q.shape)], dtype=q.dtype).reshape(q.shape[:-1])

    def _gradient(self, q: np.ndarray) -> np.ndarray:
        return _each_row(self.functions[1], q)

    def _hessian_vector(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if self.functions[2] is None:
            raise ValueError(
                "`hessian_vector` is needed here (force-gradient methods, volume and symplecticity metrics) and was "
                "not given: pass it to HamiltonianSystem."
            )
        return _each_row(self.functions[2], q, v)


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


def _tensor_functions(numba: NumbaFunctions) -> tuple[Callable[..., Array], ...]:
    """The same as differentiable functions of tensors."""
    import torch

    def through_numpy(f: Callable[..., np.ndarray], *x: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(f(*map(to_numpy, x)), dtype=x[0].dtype, device=x[0].device)

    class Function(torch.autograd.Function):
        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
            ctx.save_for_backward(*inputs)
            ctx.save_for_forward(*inputs)

        @classmethod
        def in_batch(cls, in_dims: tuple[Any, ...], *x: torch.Tensor) -> tuple[torch.Tensor, int]:
            n = next(y.shape[i] for y, i in zip(x, in_dims, strict=True) if i is not None)
            moved = [y.expand(n, *y.shape) if i is None else y.movedim(i, 0) for y, i in zip(x, in_dims, strict=True)]
            return cls.apply(*moved), 0

    class Potential(Function):
        @staticmethod
        def forward(q: torch.Tensor) -> torch.Tensor:
            return through_numpy(numba._potential, q)

        @staticmethod
        def backward(ctx: Any, v: torch.Tensor) -> torch.Tensor:
            return v[..., None] * Gradient.apply(*ctx.saved_tensors)

        @staticmethod
        def jvp(ctx: Any, v: torch.Tensor) -> torch.Tensor:
            return (v * Gradient.apply(*ctx.saved_tensors)).sum(-1)

        @staticmethod
        def vmap(info: Any, in_dims: tuple[Any, ...], q: torch.Tensor) -> tuple[torch.Tensor, int]:
            return Potential.in_batch(in_dims, q)

    class Gradient(Function):
        @staticmethod
        def forward(q: torch.Tensor) -> torch.Tensor:
            return through_numpy(numba._gradient, q)

        @staticmethod
        def backward(ctx: Any, v: torch.Tensor) -> torch.Tensor:
            return HessianVector.apply(*ctx.saved_tensors, v)

        @staticmethod
        def jvp(ctx: Any, v: torch.Tensor) -> torch.Tensor:
            return HessianVector.apply(*ctx.saved_tensors, v)

        @staticmethod
        def vmap(info: Any, in_dims: tuple[Any, ...], q: torch.Tensor) -> tuple[torch.Tensor, int]:
            return Gradient.in_batch(in_dims, q)

    class HessianVector(Function):
        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
            Function.setup_context(ctx, inputs, output)
            ctx.set_materialize_grads(False)  # so that a q that does not vary is told from one that does

        @staticmethod
        def forward(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
            return through_numpy(numba._hessian_vector, q, v)

        @staticmethod
        def backward(ctx: Any, w: torch.Tensor | None) -> tuple[None, torch.Tensor | None]:
            if w is None:
                return None, None
            if ctx.needs_input_grad[0]:
                raise _third_derivative()
            return None, HessianVector.apply(ctx.saved_tensors[0], w)

        @staticmethod
        def jvp(ctx: Any, dq: torch.Tensor | None, dv: torch.Tensor | None) -> torch.Tensor:
            if dq is not None or dv is None:
                raise _third_derivative()
            return HessianVector.apply(ctx.saved_tensors[0], dv)

        @staticmethod
        def vmap(info: Any, in_dims: tuple[Any, ...], *x: torch.Tensor) -> tuple[torch.Tensor, int]:
            return HessianVector.in_batch(in_dims, *x)

    return Potential.apply, Gradient.apply, HessianVector.apply


def _third_derivative() -> Exception:
    return ValueError(
        "`hessian_vector` would have to be differentiated, and a system given by Numba functions has no third "
        "derivatives: use a method without force gradients, or define the system with HamiltonianSystem.from_sympy."
    )
