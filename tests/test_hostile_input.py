"""Hostile input, over every method: the expected error at once, or status −1. No input hangs, and none passes silently.

Each row of the tables is run with all methods, under a watchdog. A row says the exact error: its type, and how its
message begins (the argument in backticks); every message of ours ends with the remedy, that is with a sentence.
"""

import math
import re
from functools import cache

import numpy as np
import pytest
import torch
from conftest import KINDS
from numba import njit
from watchdog import watched

from sympflow import HamiltonianSystem, available, energy_error, get, solve, systems, time_transformed
from sympflow.integrators.base import FixedStep, Outcome
from sympflow.integrators.methods import NAMES

OSCILLATOR = systems.harmonic_oscillator()  # every method applies to it, and has a flow for it
ESCAPE = systems.henon_heiles_escape()
METHODS = [
    m for m in available() if m in NAMES and getattr(get(m), "splitting", "") != "kepler"
]  # other tests register more, and some are of planets
FLOWS = ("sympflow", "mlp")
OTHERS = [m for m in METHODS if m not in KINDS]
EACH = [*KINDS, *(pytest.param(m, marks=pytest.mark.slow) for m in OTHERS)]
"""Methods one by one; those whose kind another one shows are long tests."""
SEVERAL = [pytest.param(KINDS, id="a method of each kind"), pytest.param(OTHERS, id="others", marks=pytest.mark.slow)]


class Loud:
    def __array__(self, *arguments, **options):
        raise ArithmeticError("no array of me")


class Endless:
    def __iter__(self):
        while True:
            yield 0.0


def event(value=lambda t, y: y[0], **attributes):
    def g(t, y):
        return value(t, y)

    vars(g).update(attributes)
    return g


def divide(*_):
    return 1 / 0


def nested(depth):
    return [nested(depth - 1)] if depth > 1 else [0.0]


DIVISION, REAL_TENSOR = "division by zero", r"`y0` must be a real floating-point tensor"
NUMBERS, SHAPE = r"`y0` must be an array of numbers", r"`y0` must have shape \(\.\.\., 2\)"
SPAN, FINITE_SPAN = "`t_span` must be two numbers", "`t_span` must be finite"
FEW = "`t_span` spans fewer than 8 floating-point numbers"
EVENT_NUMBER = "`events` must return one number"
far = np.broadcast_to

# what solve is given, the error, and how its message begins
ARGUMENTS = {
    # the initial state: values
    "y0 NaN": ({"y0": [math.nan, 0.0]}, "`y0` must be finite"),
    "y0 inf": ({"y0": [math.inf, 0.0]}, "`y0` must be finite"),
    "y0 NaN in a batch": ({"y0": [[0.0, 1.0], [0.0, math.nan]]}, "`y0` must be finite"),
    "y0 infinite in float32": ({"y0": [1e308, 0.0], "dtype": "float32"}, "`y0` must be finite"),
    "y0 integer beyond floats": ({"y0": [10**400, 0]}, TypeError, NUMBERS),
    "y0 masked": ({"y0": np.ma.masked_array([1.0, 2.0], mask=[0, 1])}, "`y0` has masked entries"),
    # shapes
    "y0 too short": ({"y0": [1.0]}, SHAPE),
    "y0 too long": ({"y0": [[1.0, 2.0, 3.0]]}, SHAPE),
    "y0 a number": ({"y0": 1.0}, SHAPE),
    "y0 empty": ({"y0": []}, SHAPE),
    "y0 an empty batch": ({"y0": np.empty((0, 2))}, "`y0` is an empty batch"),
    "y0 ragged": ({"y0": [[1.0], [1.0, 2.0]]}, TypeError, NUMBERS),
    "y0 deeply nested": ({"y0": nested(100)}, TypeError, NUMBERS),
    "y0 of 16 GB": ({"y0": far([1.0, 0.0], (10**9, 2))}, r"`y0` has 2e\+09 numbers"),
    # kinds
    "y0 complex": ({"y0": [1j, 0.0]}, TypeError, "`y0` must be real"),
    "y0 words": ({"y0": ["a", "b"]}, TypeError, NUMBERS),
    "y0 bytes": ({"y0": b"ab"}, TypeError, NUMBERS),
    "y0 None inside": ({"y0": [None, 0.0]}, TypeError, NUMBERS),
    "y0 booleans": ({"y0": [True, False]}, TypeError, NUMBERS),
    "y0 dates": ({"y0": np.array(["2020-01-01"] * 2, dtype="datetime64[D]")}, TypeError, NUMBERS),
    "y0 records": ({"y0": np.zeros(2, dtype=[("a", float)])}, TypeError, NUMBERS),
    "y0 a dictionary": ({"y0": {"q": 0.0, "p": 1.0}}, TypeError, NUMBERS),
    "y0 a generator": ({"y0": (x for x in (1.0, 0.0))}, TypeError, NUMBERS),
    "y0 a class": ({"y0": int}, TypeError, NUMBERS),
    "y0 that raises": ({"y0": Loud()}, ArithmeticError, "no array of me"),
    # tensors
    "y0 an integer tensor": ({"y0": torch.tensor([1, 0])}, TypeError, REAL_TENSOR),
    "y0 a complex tensor": ({"y0": torch.zeros(2, dtype=torch.complex128)}, TypeError, REAL_TENSOR),
    "y0 a half tensor": ({"y0": torch.zeros(2, dtype=torch.float16)}, TypeError, REAL_TENSOR),
    "y0 a bfloat16 tensor": ({"y0": torch.zeros(2, dtype=torch.bfloat16)}, TypeError, REAL_TENSOR),
    "y0 a sparse tensor": ({"y0": torch.zeros(2).to_sparse()}, TypeError, "`y0` must be a dense tensor"),
    "y0 a meta tensor": ({"y0": torch.zeros(2, device="meta")}, TypeError, "`y0` must be a dense tensor"),
    "y0 a NaN tensor": ({"y0": torch.tensor([1.0, math.nan])}, "`y0` must be finite"),
    "dtype beside a tensor": ({"y0": torch.zeros(2), "dtype": "float32"}, TypeError, "`dtype` is for NumPy"),
    # dtype
    "dtype half": ({"dtype": "float16"}, "`dtype` must be"),
    "dtype nonsense": ({"dtype": "nonsense"}, "`dtype` must be"),
    "dtype complex": ({"dtype": complex}, "`dtype` must be"),
    "dtype of torch": ({"dtype": torch.float64}, "`dtype` must be"),
    "dtype an object": ({"dtype": object()}, "`dtype` must be"),
    # the interval
    "t_span NaN": ({"t_span": (0, math.nan)}, FINITE_SPAN),
    "t_span inf": ({"t_span": (0, math.inf)}, FINITE_SPAN),
    "t_span from -inf": ({"t_span": (-math.inf, 0)}, FINITE_SPAN),
    "t_span of infinite length": ({"t_span": (-1.7e308, 1.7e308), "t_eval": [0.0]}, FINITE_SPAN),
    "t_span an integer beyond floats": ({"t_span": (0, 10**400)}, FINITE_SPAN),
    "t_span a number": ({"t_span": 3.0}, SPAN),
    "t_span of three": ({"t_span": (0, 1, 2)}, SPAN),
    "t_span of one": ({"t_span": (0,)}, SPAN),
    "t_span words": ({"t_span": ("a", "b")}, SPAN),
    "t_span a string of digits": ({"t_span": "01"}, SPAN),
    "t_span a set": ({"t_span": {0, 1}}, SPAN),
    "t_span a dictionary": ({"t_span": {0: 1, 1: 2}}, SPAN),
    "t_span with None": ({"t_span": (None, 1)}, SPAN),
    "t_span complex": ({"t_span": (0, 1j)}, SPAN),
    "t_span without end": ({"t_span": Endless()}, SPAN),
    "t_span too far out": ({"t_span": (1e17, 1e17 + 64)}, FEW),
    "t_span denormal": ({"t_span": (0, 5e-324)}, FEW),
    # the outputs
    "t_eval beyond the end": ({"t_eval": [0.0, 2.0]}, "`t_eval` must lie within"),
    "t_eval infinite": ({"t_eval": [0.0, math.inf]}, "`t_eval` must be finite"),
    "t_eval NaN": ({"t_eval": [math.nan]}, "`t_eval` must be finite"),
    "t_eval unordered": ({"t_eval": [0.5, 0.2]}, "`t_eval` must be ordered"),
    "t_eval a matrix": ({"t_eval": [[0.5]]}, "`t_eval` must be one-dimensional"),
    "t_eval a number": ({"t_eval": 0.5}, "`t_eval` must be one-dimensional"),
    "t_eval a word": ({"t_eval": "abc"}, TypeError, "`t_eval` must be real numbers"),
    "t_eval complex": ({"t_eval": [1j]}, TypeError, "`t_eval` must be real numbers"),
    "t_eval None inside": ({"t_eval": [None]}, TypeError, "`t_eval` must be real numbers"),
    "t_eval ragged": ({"t_eval": [[0.0], [0.0, 1.0]]}, TypeError, "`t_eval` must be real numbers"),
    "t_eval a set": ({"t_eval": {0.5}}, TypeError, "`t_eval` must be real numbers"),
    "t_eval masked": ({"t_eval": np.ma.masked_array([0.0, 0.5], [0, 1])}, "`t_eval` has masked entries"),
    "t_eval of 80 GB": ({"t_eval": far(0.5, 10**10)}, r"`t_eval` has 1e\+10 times"),
    "t_eval times a batch": (
        {"t_eval": far(0.5, 10**6), "y0": np.zeros((1000, 2))},
        r"`t_eval` asks for 2e\+09 values",
    ),
    "t_eval and save_every": ({"t_eval": [0.5], "save_every": 2}, "`save_every` and `t_eval` both"),
    "save_every 0": ({"save_every": 0}, "`save_every` must be a positive integer"),
    "save_every a fraction": ({"save_every": 1.5}, "`save_every` must be a positive integer"),
    "save_every NaN": ({"save_every": math.nan}, "`save_every` must be a positive integer"),
    "save_every True": ({"save_every": True}, "`save_every` must be a positive integer"),
    "dense_output a word": ({"dense_output": "yes"}, TypeError, "`dense_output` must be"),
    "dense_output None": ({"dense_output": None}, TypeError, "`dense_output` must be"),
    # how
    "backend unknown": ({"backend": "gpu"}, "`backend` must be one of"),
    "backend a list": ({"backend": ["array"]}, "`backend` must be one of"),
    "on_domain_exit unknown": ({"on_domain_exit": "raise"}, "`on_domain_exit` must be"),
    "on_domain_exit True": ({"on_domain_exit": True}, "`on_domain_exit` must be"),
    # events
    "events a number": ({"events": 3}, TypeError, "`events` must be a function"),
    "events a word": ({"events": "y"}, TypeError, "`events` must be a function"),
    "events with a number": ({"events": [event(), 1]}, TypeError, r"`events\[1\]` must be a function"),
    "events that raise": ({"events": event(divide)}, ZeroDivisionError, DIVISION),
    "events that return None": ({"events": event(lambda t, y: None)}, TypeError, EVENT_NUMBER),
    "events that return a state": ({"events": event(lambda t, y: y)}, TypeError, EVENT_NUMBER),
    "events that return a word": ({"events": event(lambda t, y: "a")}, TypeError, EVENT_NUMBER),
    "events that are complex": ({"events": event(lambda t, y: 1j)}, TypeError, EVENT_NUMBER),
    "events that are NaN": ({"events": event(lambda t, y: math.nan)}, "`events` returned NaN at t = 0"),
    "events with a negative terminal": ({"events": event(terminal=-1)}, "`events` has `terminal` = -1"),
    "events with a fractional terminal": ({"events": event(terminal=0.5)}, "`events` has `terminal` = 0.5"),
    "events with a NaN terminal": ({"events": event(terminal=math.nan)}, "`events` has `terminal`"),
    "events with a worded terminal": ({"events": event(terminal="yes")}, "`events` has `terminal`"),
    "events with a worded direction": ({"events": event(direction="up")}, "`events` has `direction`"),
    "events of a batch": ({"events": event(), "y0": np.zeros((2, 2))}, "`events` are found along one"),
    "event_step alone": ({"event_step": 0.1}, "`event_step` samples events, but"),
    "event_step NaN": ({"events": event(), "event_step": math.nan}, "`event_step` must be a positive"),
    "event_step 0": ({"events": event(), "event_step": 0}, "`event_step` must be a positive"),
    "event_step tiny": ({"events": event(), "event_step": 1e-300}, r"`event_step` 1e-300 would take"),
    # options of the method: where it has them
    "an unknown option": ({"nonsense": 1}, TypeError, "`nonsense` is not an option of method"),
    "dt 0": ({"dt": 0}, "`dt` must be a positive"),
    "dt negative": ({"dt": -0.1}, "`dt` must be a positive"),
    "dt NaN": ({"dt": math.nan}, "`dt` must be a positive"),
    "dt inf": ({"dt": math.inf}, "`dt` must be a positive"),
    "dt a word": ({"dt": "0.1"}, "`dt` must be a positive"),
    "dt True": ({"dt": True}, "`dt` must be a positive"),
    "dt complex": ({"dt": 1j}, "`dt` must be a positive"),
    "dt an array": ({"dt": np.array([0.1, 0.2])}, "`dt` must be a positive"),
    "dt a tensor": ({"dt": torch.tensor(0.1)}, "`dt` must be a positive"),
    "dt an integer beyond floats": ({"dt": 10**400}, "`dt` must be a positive"),
    "dt tiny, every step": ({"dt": 1e-9}, "`t_eval` is not given, so .* would be stored"),
    "dt far too small": ({"dt": 1e-300, "t_eval": [0.0, 1.0]}, "`dt` 1e-300 "),
    "dt of years": ({"dt": 1e-12, "t_eval": [1.0]}, r"`dt` 1e-12 needs 1e\+12 steps"),
    "compensated a word": ({"compensated": "yes"}, TypeError, "`compensated` must be True or False"),
    "rtol negative": ({"rtol": -1}, "`rtol` must be a finite number"),
    "rtol NaN": ({"rtol": math.nan}, "`rtol` must be a finite number"),
    "atol inf": ({"atol": math.inf}, "`atol` must be a finite number"),
    "atol a word": ({"atol": "small"}, "`atol` must be a finite number"),
    "atol a list": ({"atol": [1e-3, 1e-6]}, "`atol` must be a finite number"),
    "no tolerance": ({"rtol": 0, "atol": 0}, "`rtol` and `atol` are both 0"),
    "max_step 0": ({"max_step": 0}, "`max_step` must be positive"),
    "max_step a word": ({"max_step": "a"}, "`max_step` must be positive"),
    "first_step negative": ({"first_step": -1}, "`first_step` must be positive"),
    "first_step a word": ({"first_step": "a"}, "`first_step` must be positive"),
    "max_num_steps 0": ({"max_num_steps": 0}, "`max_num_steps` must be a positive integer"),
    "max_num_steps a fraction": ({"max_num_steps": 1.5}, "`max_num_steps` must be a positive integer"),
    "max_num_steps beyond int32": ({"max_num_steps": 2**31}, "`max_num_steps` must be a positive integer"),
    "max_order 0": ({"max_order": 0}, "`max_order` must be an integer"),
    "max_order huge": ({"max_order": 10**9}, "`max_order` must be an integer"),
    "parts a number": ({"parts": 3}, TypeError, "`parts` must be a sequence of expressions"),
    "parts a word": ({"parts": "p**2/2"}, TypeError, "`parts` must be a sequence of expressions"),
    "shift NaN": ({"shift": math.nan}, "`shift` must be a finite number"),
    "shift enormous": ({"shift": 1e300}, "`shift` must be a finite number"),
    "shift below the energy": ({"shift": -1e9}, r"`shift` -1e\+09 does not exceed"),
    "flow a number": ({"flow": 3}, TypeError, "`flow` must be a trained flow"),
    "flow a file's name": ({"flow": "f.safetensors"}, "`flow` 'f.safetensors' does not name a flow"),
    "tol NaN": ({"tol": math.nan}, "`tol` must be a positive number"),
    "tol out of reach": ({"tol": 1e-300}, "`tol` 1e-300 is not met"),
}
OPTIONS = {name for method in METHODS for name in get(method).options()}


def from_gradient(gradient):
    return HamiltonianSystem(lambda q: (q**2).sum(-1) / 2, gradient=gradient, ndof=1, y0=[1.0, 0.0], dt=0.05)


def from_potential(potential):
    return HamiltonianSystem(potential, ndof=1, y0=[1.0, 0.0], dt=0.05)


def from_hamiltonian(hamiltonian):
    return HamiltonianSystem(hamiltonian=hamiltonian, ndof=1, y0=[1.0, 0.0], dt=0.05)


def endless(q):
    return endless(q)


@njit
def numba_potential(q):
    return q[0] ** 2 / 2


@njit
def numba_gradient(q, out):
    out[0] = q[0]


@njit
def numba_that_raises(q, out):
    raise ArithmeticError("within Numba")


@njit
def numba_that_is_nan(q, out):
    out[0] = np.nan


def from_numba(gradient):
    return HamiltonianSystem(numba_potential, gradient=gradient, ndof=1, y0=[1.0, 0.0], dt=0.05)


ENDINGS = "non-finite|not finite|underflow|ceased|Newton|Required step size"
GRADIENT, POTENTIAL, H = "`gradient` must return", "`potential` must return", "`hamiltonian` must return"
REAL = " real numbers"
good = {
    from_gradient: lambda q: (1 + 1e-8) * q,  # not exactly that of V: like the others it is not traced
    from_potential: lambda q: (q**2).sum(-1) / 2,
    from_hamiltonian: lambda q, p: ((q**2).sum(-1) + (p**2).sum(-1)) / (2 if (q < 9).all() else 3),
    from_numba: numba_gradient,
}

# how the system is made, the function, the error and how its message begins; None: the run ends with status −1
CALLABLES = {
    "gradient raises": (from_gradient, divide, ZeroDivisionError, DIVISION),
    "gradient recurs without end": (from_gradient, endless, RecursionError, "maximum recursion depth"),
    "gradient None": (from_gradient, lambda q: None, ValueError, f"{GRADIENT} shape"),
    "gradient a list": (from_gradient, lambda q: [1.0], ValueError, f"{GRADIENT} shape"),
    "gradient a number": (from_gradient, lambda q: 1.0, ValueError, f"{GRADIENT} shape"),
    "gradient too long": (from_gradient, lambda q: np.zeros((*q.shape[:-1], 3)), ValueError, f"{GRADIENT} shape"),
    "gradient complex": (from_gradient, lambda q: 1j * q, TypeError, GRADIENT + REAL),
    "gradient NaN": (from_gradient, lambda q: q * math.nan, None, ENDINGS),
    "gradient inf": (from_gradient, lambda q: q * math.inf, None, ENDINGS),
    "gradient NaN later": (from_gradient, lambda q: q * float("nan") if (q < 0.99).any() else q, None, ENDINGS),
    "potential raises": (from_potential, divide, ZeroDivisionError, DIVISION),
    "potential None": (from_potential, lambda q: None, ValueError, f"{POTENTIAL} shape"),
    "potential not reduced": (from_potential, lambda q: q**2, ValueError, f"{POTENTIAL} shape"),
    "potential with an axis too many": (
        from_potential,
        lambda q: (q**2).sum(-1)[None],
        ValueError,
        f"{POTENTIAL} shape",
    ),
    "potential complex": (from_potential, lambda q: (1j * q).sum(-1), TypeError, POTENTIAL + REAL),
    "potential of NumPy": (
        from_potential,
        lambda q: np.sin(q.numpy()).sum(-1),
        TypeError,
        "`potential` (could not be traced, because it fails on an array|must return an array of the library)",
    ),
    "H raises": (from_hamiltonian, divide, ZeroDivisionError, DIVISION),
    "H None": (from_hamiltonian, lambda q, p: None, ValueError, f"{H} shape"),
    "H not reduced": (from_hamiltonian, lambda q, p: q * p, ValueError, f"{H} shape"),
    "H NaN": (
        from_hamiltonian,
        lambda q, p: (q * p).sum(-1) * math.nan,
        None,
        "non-finite|not finite|underflow|Newton",
    ),
    "Numba raises": (from_numba, numba_that_raises, ArithmeticError, "within Numba"),
    "Numba NaN": (from_numba, numba_that_is_nan, None, ENDINGS),
}


class Plugin(FixedStep):
    name, order, symplectic = "plugin", 1, False


def plugin(**methods):
    return type("Broken", (Plugin,), methods)()


def answers(outcome):
    return plugin(run=lambda self, problem: outcome)


def later(spoil, after=0.2):
    """A step that goes wrong after a while only, or in the shorter step to an output."""
    return plugin(step=lambda self, system, t, y, h: spoil(y) if t > after else y)


STEP, ANSWER = "`step` must return states as those", "`method` 'plugin' must answer with an Outcome"

# an integrator of somebody else's, the error and how its message begins; None: the run ends with status −1
PLUGINS = {
    "step raises": (plugin(step=divide), ZeroDivisionError, DIVISION),
    "step None": (plugin(step=lambda self, system, t, y, h: None), TypeError, STEP),
    "step a number": (plugin(step=lambda self, system, t, y, h: 1.0), TypeError, STEP),
    "step a list": (plugin(step=lambda self, system, t, y, h: [1.0, 0.0]), TypeError, STEP),
    "step too short": (plugin(step=lambda self, system, t, y, h: y[..., :1]), TypeError, STEP),
    "step complex": (plugin(step=lambda self, system, t, y, h: 1j * y), TypeError, STEP),
    "step words": (plugin(step=lambda self, system, t, y, h: np.full(y.shape, "a")), TypeError, STEP),
    "step a tensor": (plugin(step=lambda self, system, t, y, h: torch.tensor(y)), TypeError, STEP),
    "step too short, later": (later(lambda y: y[..., :1]), TypeError, STEP),
    "step of float32, later": (later(lambda y: y.astype("f4")), TypeError, STEP),
    "step of float32": (plugin(step=lambda self, system, t, y, h: y.astype("f4")), TypeError, STEP),
    "step None, later": (later(lambda y: None), TypeError, STEP),
    "step NaN": (plugin(step=lambda self, system, t, y, h: math.nan * y), None, "non-finite"),
    "no step": (plugin(), TypeError, "`method` 'plugin' cannot be stepped by itself"),
    "check raises": (plugin(check=divide), ZeroDivisionError, DIVISION),
    "run raises": (plugin(run=divide), ZeroDivisionError, DIVISION),
    "run None": (answers(None), TypeError, ANSWER),
    "run y of another shape": (answers(Outcome(np.zeros(3), np.zeros((3, 5)), 0, "", {})), TypeError, ANSWER),
    "run t a number": (answers(Outcome(3.0, np.zeros((3, 3, 2)), 0, "", {})), TypeError, ANSWER),
    "run status a word": (answers(Outcome(np.zeros(3), np.zeros((3, 2)), "ok", "", {})), TypeError, ANSWER),
    "run NaN unflagged": (answers(Outcome(np.arange(3.0), np.full((3, 2), np.nan), 0, "", {})), None, "non-finite"),
}


def caught(call):
    """The exception that a call raises, or its result, under the watchdog."""
    with watched():
        try:
            return call()
        except Exception as error:
            return error


def assert_each(outcomes, error, message):
    """Assert that every method raised `error` with a message that begins as `message` and ends with a sentence."""
    wrong = {}
    for method, own, got in outcomes:
        expected, begins = own[0] or error, own[1] or message
        text = str(got)
        by_us = expected in (ValueError, TypeError)
        ends = text.rstrip().endswith((".", "?")) or not by_us
        if type(got) is not expected or not re.match(begins, text) or not ends:
            wrong[method] = f"{type(got).__name__}: {text[:200]}"
    assert not wrong, wrong


@pytest.mark.parametrize("row", ARGUMENTS)
def test_arguments(row):
    """Every method; an option that a method has not is refused as such."""
    arguments, *named, message = ARGUMENTS[row]
    error = named[0] if named else ValueError
    outcomes = []
    for method in KINDS if row.startswith("tol") else METHODS:
        foreign = [name for name in arguments if name in OPTIONS and name not in get(method).options()]
        expected = (TypeError, f"`{foreign[0]}` is not an option of method '{method}'") if foreign else (None, None)
        if foreign == ["tol"]:  # of which solve makes a step
            fixed = issubclass(get(method), FixedStep) and not get(method).trained
            expected = (None, None) if fixed or row == "tol NaN" else (TypeError, "`tol` chooses the step")
        if arguments == {"shift": -1e9} and not foreign and not get(method)().in_another_time:
            expected = ValueError, "`shift` is for the clock 'logarithmic'"
        given = {"t_span": (0.0, 1.0), "backend": "array", **arguments}
        outcomes.append((method, expected, caught(lambda m=method, a=given: solve(OSCILLATOR, m, **a))))
    assert_each(outcomes, error, message)


@pytest.mark.parametrize("methods", SEVERAL)
@pytest.mark.parametrize("row", CALLABLES)
def test_callables(row, methods):
    """Every method that takes the same system with a sound function; the others refuse it for the same reason."""
    make, function, error, message = CALLABLES[row]
    system, outcomes, failed = make(function), [], {}
    for method in [m for m in methods if m not in FLOWS]:
        backend = "auto" if method == "verlet" else "array"  # Numba functions are compiled anew for each kernel
        sound = of_the_sound(make, method)
        got = caught(lambda m=method, b=backend: solve(system, m, (0, 0.5), backend=b))
        if isinstance(sound, Exception):
            if type(got) is not error or not re.match(message, str(got)):  # which a method may meet first
                outcomes.append((method, (type(sound), re.escape(str(sound)[:60])), got))
        elif error is not None:
            outcomes.append((method, (None, None), got))
        elif isinstance(got, Exception) or got.status != -1 or not np.isfinite(got.y).all():
            failed[method] = repr(got)
        elif not re.search(message, got.message):
            failed[method] = got.message
    assert_each(outcomes, error, message)
    assert not failed, failed


SOUND = {make: make(function) for make, function in good.items()}


@cache
def of_the_sound(make, method):
    """Once for all rows; by arrays, for whether a method takes a system does not depend on how it is run."""
    return caught(lambda: solve(SOUND[make], method, (0, 0.5), backend="array"))


@pytest.mark.parametrize("row", PLUGINS)
@pytest.mark.parametrize("more", [{}, {"t_eval": [0.33]}, {"y0": np.zeros((3, 2))}], ids=["steps", "t_eval", "batch"])
def test_plugins(row, more):
    integrator, error, message = PLUGINS[row]
    got = caught(lambda: solve(OSCILLATOR, integrator, **{"t_span": (0.0, 0.5), **more}))
    if "run y" not in row and "run t" not in row and "run" in row and "y0" in more:
        return  # its answer is of a single trajectory
    if error is not None:
        assert type(got) is error
        assert re.match(message, str(got))
    else:
        assert (np.asarray(got.status) == -1).all()
        assert re.search(message, got.message)


# driven and damped systems --------------------------------------------------------------------------

SCENE = {"y0": [1.0, 0.2], "t_span": (0.3, 0.8), "dt": 0.01}
DRIVE = {"time": "t", "params": {"a": 0.3, "w": 1.7}}
TEXT = "p**2/2 + 2*q**2 + a*q**4*cos(w*t)"
DRIVEN = HamiltonianSystem.from_sympy(TEXT, **DRIVE, **SCENE, name="driven")
DAMPED = HamiltonianSystem.from_sympy("p**2/2 + 2*q**2 + q**4/4", damping=0.2, **SCENE, name="damped")
BOTH = HamiltonianSystem.from_sympy(TEXT, damping=0.2, **DRIVE, **SCENE, name="both")
PENDULUM = systems.pendulum()
made = HamiltonianSystem.from_sympy

# what is asked, the error and how its message goes on after the argument
SCENES = {
    "t without a name": (
        lambda: made(TEXT, params=DRIVE["params"]),
        TypeError,
        '`expression` depends on the time t.*"t"',
    ),
    "another period": (lambda: made(TEXT, **DRIVE, period=3.0), "`period` 3.0 is not a period of H"),
    "half a period": (lambda: made(TEXT, **DRIVE, period=math.pi / 1.7), "`period` .* is not a period of H"),
    "an infinite period": (lambda: made(TEXT, **DRIVE, period=math.inf), "`period` must be positive"),
    "energy of a drive": (lambda: energy_error(by_arrays(DRIVEN)), "`system` 'driven' .*balance_error"),
    "energy of friction": (
        lambda: energy_error(by_arrays(DAMPED)),
        "`system` 'damped' .* loss of energy is not an error",
    ),
    "another time": (lambda: time_transformed(DRIVEN), "`system` 'driven' is driven, .* needs an energy E"),
    "a log clock": (lambda: solve(DRIVEN, "log_kahan_li8"), "`system` 'driven' .*'log_kahan_li8' does not"),
    "a flow of no drive": (lambda: solve(DRIVEN, shipped()), "`system` 'driven' is driven"),
    "a flow of no friction": (lambda: solve(damped_pendulum(), shipped()), "`system` .* has friction"),
    "no flow with friction": (lambda: solve(damped_pendulum(), "sympflow"), "`system` .* friction, and no"),
    "copies of a function that branches": (
        lambda: solve(HamiltonianSystem(hamiltonian=of_numpy, ndof=1, **SCENE), "tao4"),
        TypeError,
        "`hamiltonian` could not be traced, because it branches on a value: write np.where",
    ),
    "copies with friction": (lambda: solve(DAMPED, "tao4"), "`system` 'damped' has friction, .*'tao4'"),
    "compensated Gauss with friction": (
        lambda: solve(DAMPED, "gauss_legendre4", compensated=True),
        "`compensated` sums are for systems without friction",
    ),
    "the time of a state": (lambda: DRIVEN.vector_field(np.ones(2)), TypeError, "`t` is missing"),
}


def by_arrays(system):
    return solve(system, "verlet", backend="array")


def shipped():
    return get("sympflow")().flow_for(PENDULUM)


def damped_pendulum():
    return made(PENDULUM.symbols.H, damping=0.1, y0=[1.0, 0.0], domain=PENDULUM.domain)


def of_numpy(q, p):
    return np.asarray(p)[..., 0] ** 2 * (1 + np.sort(np.asarray(q))[..., 0] ** 2) if (np.asarray(q) < 9).all() else 0.0


@pytest.mark.parametrize("row", SCENES)
def test_driven_and_damped(row):
    ask, *named, message = SCENES[row]
    error = named[0] if named else ValueError
    assert_each([(row, (None, None), caught(ask))], error, message)


@pytest.mark.parametrize("methods", SEVERAL)
def test_every_method_solves_a_drive_and_friction_or_says_why_not(methods):
    """None leaves one of them out."""
    wrong = {}
    for system in (DRIVEN, DAMPED, BOTH):
        truth = solve(system, "dop853", t_eval=[0.8], rtol=1e-10, atol=1e-12).y
        for method in methods:
            got = caught(lambda s=system, m=method: solve(s, m, t_eval=[0.8], backend="array"))
            if isinstance(got, Exception):
                says = re.match(r"`system` '\w+' (has friction|is driven|has no )", str(got))
                named = isinstance(got, ValueError) and says and str(got).endswith(".")
            else:
                named = np.abs(got.y - truth).max() < (0.05 if get(method).order == 1 else 0.01)
            if not named:
                wrong[system.name, method] = repr(got)[:200]
    assert not wrong, wrong


@pytest.mark.parametrize("method", EACH)
def test_blow_up_is_reported(method):
    """Above the escape energy of Hénon and Heiles the solution ends at t*: status −1, and no state that is not finite.

    The discrete map of an explicit method stays finite for some steps beyond t*, and torchdiffeq's `adaptive_heun`
    spends its steps before; the time of the singularity is reported all the same. A flow maps its states on, outside
    its domain, and says so.
    """
    t_star = 5.450984210235402
    loose = {"rtol": 1e-4, "atol": 1e-6} if method in ("bosh3", "fehlberg2", "adaptive_heun") else {}
    got = caught(lambda: solve(ESCAPE, method, (0, 20), backend="auto" if method in KINDS else "array", **loose))
    if get(method).trained:
        said = str(got) if isinstance(got, RuntimeWarning) else got.message  # a warning where it is far off
        assert re.search("The state left the domain (of the flow )?at t = 0", said)
        return
    assert not isinstance(got, Exception), got
    assert np.isfinite(got.y).all()
    assert got.status == -1
    with pytest.raises(RuntimeError, match="t = "):
        got.raise_for_status()
    assert re.search(ENDINGS + "|hardly advances|`max_num_steps` = 5000", got.message)
    assert abs(got.stats["blow_up_time"] - t_star) < got.stats.get("dt", ESCAPE.dt)
