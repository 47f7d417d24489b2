"""Bad input through `solve`: an error at once that names the argument and ends with a remedy. None hangs."""

import math

import numpy as np
import pytest
import torch

from sympflow import HamiltonianSystem, available, get, solve, systems
from sympflow.integrators.schemes import SCHEMES

PENDULUM = systems.pendulum()
HH = systems.henon_heiles()
GENERAL = HamiltonianSystem.from_sympy("(p**2 + q**2)**2/4", y0=[1.0, 0.0])
CLASSICAL = [m for m in available() if m not in ("sympflow", "mlp")]
FIXED = [m for m in CLASSICAL if "dt" in get(m).options()]
ADAPTIVE = [m for m in CLASSICAL if m not in FIXED]

FOR_ALL = [
    ({"y0": [1.0]}, ValueError, r"^`y0` must have shape \(\.\.\., 2\)"),
    ({"y0": [[1.0, 2.0, 3.0]]}, ValueError, r"^`y0` must have shape"),
    ({"y0": 1.0}, ValueError, r"^`y0` must have shape"),
    ({"y0": [math.nan, 0.0]}, ValueError, r"^`y0` must be finite"),
    ({"y0": [math.inf, 0.0]}, ValueError, r"^`y0` must be finite"),
    ({"y0": [[0.0, 1.0], [0.0, math.nan]]}, ValueError, r"^`y0` must be finite"),
    ({"y0": np.empty((0, 2))}, ValueError, r"^`y0` is an empty batch"),
    ({"y0": [1j, 0.0]}, TypeError, r"^`y0` must be real"),
    ({"y0": ["a", "b"]}, TypeError, r"^`y0` must be an array of numbers"),
    ({"y0": [[1.0], [1.0, 2.0]]}, TypeError, r"^`y0` must be an array of numbers"),
    ({"y0": [None, 0.0]}, TypeError, r"^`y0` must be an array of numbers"),
    ({"y0": torch.tensor([1, 0])}, TypeError, r"^`y0` must be a real floating-point tensor"),
    ({"y0": torch.tensor([1.0, math.nan])}, ValueError, r"^`y0` must be finite"),
    ({"y0": torch.tensor([1.0, 0.0]), "dtype": "float32"}, TypeError, r"^`dtype` is for NumPy"),
    ({"dtype": "float16"}, ValueError, r"^`dtype` must be"),
    ({"dtype": "nonsense"}, ValueError, r"^`dtype` must be"),
    ({"t_span": (0, math.nan)}, ValueError, r"^`t_span` must be finite"),
    ({"t_span": (0, math.inf)}, ValueError, r"^`t_span` must be finite"),
    ({"t_span": (-math.inf, 0)}, ValueError, r"^`t_span` must be finite"),
    ({"t_span": 3.0}, ValueError, r"^`t_span` must be two numbers"),
    ({"t_span": (0, 1, 2)}, ValueError, r"^`t_span` must be two numbers"),
    ({"t_span": ("a", "b")}, ValueError, r"^`t_span` must be two numbers"),
    ({"t_eval": [0.0, 2.0]}, ValueError, r"^`t_eval` must lie within `t_span`"),
    ({"t_eval": [0.5, 0.2]}, ValueError, r"^`t_eval` must be ordered"),
    ({"t_eval": [[0.5]]}, ValueError, r"^`t_eval` must be one-dimensional"),
    ({"t_eval": [math.nan]}, ValueError, r"^`t_eval` must lie within"),
    ({"t_eval": [0.5], "save_every": 2}, ValueError, r"^`save_every` and `t_eval` both"),
    ({"save_every": 0}, ValueError, r"^`save_every` must be a positive integer"),
    ({"save_every": 1.5}, ValueError, r"^`save_every` must be a positive integer"),
    ({"dense_output": "yes"}, TypeError, r"^`dense_output` must be"),
    ({"backend": "gpu"}, ValueError, r"^`backend` must be one of"),
    ({"on_domain_exit": "raise"}, ValueError, r"^`on_domain_exit` must be"),
    ({"nonsense": 1}, TypeError, r"^`nonsense` is not an option of method"),
    ({"flow": None}, TypeError, r"^`flow` is not an option of method"),
]
FOR_FIXED = [
    ({"dt": 0}, ValueError, r"^`dt` must be a positive"),
    ({"dt": -0.1}, ValueError, r"^`dt` must be a positive"),
    ({"dt": math.nan}, ValueError, r"^`dt` must be a positive"),
    ({"dt": math.inf}, ValueError, r"^`dt` must be a positive"),
    ({"dt": "0.1"}, ValueError, r"^`dt` must be a positive"),
    ({"dt": True}, ValueError, r"^`dt` must be a positive"),
    ({"dt": 1e-9}, ValueError, r"^`t_eval` is not given, so .* would be stored"),
    ({"dt": 1e-300, "t_eval": [1.0]}, ValueError, r"^`dt` 1e-300 needs"),
    ({"rtol": 1e-3}, TypeError, r"^`rtol` is not an option of method"),
]
FOR_ADAPTIVE = [
    ({"dt": 0.1}, TypeError, r"^`dt` is not an option of method"),
    ({"rtol": -1}, ValueError, r"^`rtol` must be a finite number"),
    ({"rtol": math.nan}, ValueError, r"^`rtol` must be a finite number"),
    ({"atol": math.inf}, ValueError, r"^`atol` must be a finite number"),
    ({"atol": "small"}, ValueError, r"^`atol` must be a finite number"),
    ({"rtol": 0, "atol": 0}, ValueError, r"^`rtol` and `atol` are both 0"),
]
CASES = [(m, *case) for m in CLASSICAL for case in FOR_ALL]
CASES += [(m, *case) for m in FIXED for case in FOR_FIXED]
CASES += [(m, *case) for m in ADAPTIVE for case in FOR_ADAPTIVE]


def label(value):
    return value if isinstance(value, str) else ",".join(value) if isinstance(value, dict) else ""


@pytest.mark.parametrize(("method", "arguments", "error", "message"), CASES, ids=label)
def test_bad_arguments_are_named(method, arguments, error, message):
    with pytest.raises(error, match=message) as raised:
        solve(PENDULUM, method, **{"t_span": (0.0, 1.0), **arguments})
    assert str(raised.value).rstrip().endswith((".", "?"))


@pytest.mark.parametrize("method", sorted(SCHEMES))
def test_splittings_refuse_a_system_that_is_not_separable(method):
    with pytest.raises(ValueError, match=r"^`method` .* needs a separable system"):
        solve(GENERAL, method)
    with pytest.raises(ValueError, match=r"^`method` .* needs a separable system"):
        get(method)().step(GENERAL, 0.0, GENERAL.y0, 0.1)


@pytest.mark.parametrize("method", ["rk45", "dop853"])
@pytest.mark.parametrize(
    ("arguments", "message"), [({"max_step": 0}, r"^`max_step`"), ({"first_step": -1}, r"^`first_step`")]
)
def test_scipy_options_are_checked(method, arguments, message):
    with pytest.raises(ValueError, match=message):
        solve(PENDULUM, method, **arguments)


@pytest.mark.parametrize("method", ["rk45", "dop853"])
def test_scipy_methods_refuse_tensors(method):
    with pytest.raises(TypeError, match=r"^`y0` is a tensor"):
        solve(PENDULUM, method, y0=torch.tensor([1.0, 0.0]))


@pytest.mark.parametrize(
    ("method", "error", "message"),
    [
        ("verlett", ValueError, r"^`method` 'verlett' is unknown. Did you mean 'verlet'\? Choose one of"),
        ("RK45", ValueError, r"Did you mean 'rk45'\?"),
        ("", ValueError, r"^`method` '' is unknown"),
        (None, TypeError, r"^`method` must be a name"),
        (int, TypeError, r"^`method` must be a name"),
        (42, TypeError, r"^`method` must be a name"),
    ],
)
def test_unknown_methods(method, error, message):
    with pytest.raises(error, match=message):
        solve(PENDULUM, method)


def test_options_do_not_go_with_a_configured_integrator():
    with pytest.raises(TypeError, match=r"^`dt` cannot be given with a configured integrator"):
        solve(PENDULUM, get("verlet")(dt=0.1), dt=0.2)


def test_the_system_must_be_one():
    with pytest.raises(TypeError, match=r"^`system` must be a HamiltonianSystem"):
        solve(lambda t, y: y, "verlet")


def test_a_system_without_an_initial_state():
    with pytest.raises(ValueError, match=r"^`y0` is needed"):
        solve(HamiltonianSystem.from_sympy("p**2/2 + q**4"), "verlet")


def test_callables_that_return_nan_end_with_a_status():
    system = HamiltonianSystem(lambda q: q.sum(-1), gradient=lambda q: q * np.nan, ndof=1, y0=[1.0, 0.0])
    for method in ("verlet", "rk45"):
        sol = solve(system, method, (0, 1))
        assert sol.status == -1
        assert sol.t.tolist() == [0.0]


def test_callables_that_raise_are_not_swallowed():
    def gradient(q):
        raise ZeroDivisionError("in the user's function")

    system = HamiltonianSystem(lambda q: q.sum(-1), gradient=gradient, ndof=1, y0=[1.0, 0.0])
    for method in ("verlet", "rk45", "dop853"):
        with pytest.raises(ZeroDivisionError, match="in the user's function"):
            solve(system, method, (0, 1))


def test_gradients_of_the_wrong_shape_are_named():
    system = HamiltonianSystem(lambda q: q.sum(-1), gradient=lambda q: q[..., :1], ndof=2, y0=[1.0, 0, 0, 0])
    with pytest.raises(ValueError, match=r"^`gradient` must return shape \(2,\)"):
        solve(system, "verlet", (0, 1))
