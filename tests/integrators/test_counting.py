"""Forces of a step that does not say how many it evaluates: counted by the driver, whatever the run."""

import pickle
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import torch

from sympflow import solve, systems
from sympflow.arrays import concatenate, per_state
from sympflow.hamiltonian.system import counting_view
from sympflow.integrators.base import FixedStep

HH, NONSEPARABLE = systems.henon_heiles(), systems.nonseparable()


@dataclass(frozen=True)
class Ruth3(FixedStep):
    """Three forces a step, of which nothing is said."""

    name: ClassVar[str] = "counted_ruth3"
    order: ClassVar[int | None] = 3
    symplectic: ClassVar[bool] = True

    def step(self, system, t, y, h):
        q, p, h = y[..., : system.ndof], y[..., system.ndof :], per_state(h, y)
        for b, a in ((7 / 24, 2 / 3), (3 / 4, -2 / 3), (-1 / 24, 1.0)):
            p = p + b * h * system.force(q)
            q = q + a * h * system.velocity(p)
        return concatenate([q, p])


@pytest.mark.parametrize("convert", [np.asarray, torch.as_tensor])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_each_step_counts_once_for_a_batch(convert, batch):
    y0 = convert(np.broadcast_to(HH.y0, (*batch, 4)).copy())
    sol = solve(HH, Ruth3(dt=0.1), (0, 1), y0)
    assert (sol.nfev, sol.stats["hessian_evaluations"]) == (30, 0)


def test_all_functions_of_the_system_are_counted_and_no_inner_call_twice():
    counts: dict[str, int] = {}

    def count(what, x):
        counts[what] = counts.get(what, 0) + 1

    view = counting_view(HH, count)
    y = HH.y0
    for value, expected in (
        (view.force(y[:2]), HH.force(y[:2])),
        (view.gradient(y), HH.gradient(y)),
        (view.vector_field(y), HH.vector_field(y)),
        (view(0.0, y), HH(0.0, y)),
        (view.hessian(y), HH.hessian(y)),
        (view.potential_hessian(y[:2]), HH.potential_hessian(y[:2])),
        (view.hessian_vector(y[:2], y[2:]), HH.hessian_vector(y[:2], y[2:])),
        (view.curvature_gradient(y[:2]), HH.curvature_gradient(y[:2])),
    ):
        np.testing.assert_array_equal(value, expected)
    assert counts == {"force_evaluations": 4, "hessian_evaluations": 3, "curvature_evaluations": 1}
    counting_view(NONSEPARABLE, count).vector_field(NONSEPARABLE.y0)
    assert counts["force_evaluations"] == 5


# NumPy only ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NumpyRuth3(Ruth3):
    def step(self, system, t, y, h):
        return super().step(system, t, y.astype(y.dtype), h)


class Declared(NumpyRuth3):
    arrays_only = "steps by NumPy: pass y0.numpy()"


@dataclass(frozen=True)
class Detaching(Ruth3):
    def step(self, system, t, y, h):
        return super().step(system, t, y.detach() if isinstance(y, torch.Tensor) else y, h)


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (NumpyRuth3, r"^`method` 'counted_ruth3' cannot step the tensors that it is given \(AttributeError"),
        (Declared, r"^`y0` is a tensor, but method 'counted_ruth3' steps by NumPy: pass y0\.numpy\(\)\.$"),
        (Detaching, r"^`step` loses the gradient of the tensors that it is given: pass NumPy arrays"),
    ],
)
def test_a_step_that_takes_no_tensors_says_so(method, message):
    y0 = torch.tensor(HH.y0, requires_grad=True)
    with pytest.raises(TypeError, match=message):
        solve(HH, method(dt=0.1), (0, 1), y0)
    assert solve(HH, method(dt=0.1), (0, 1), HH.y0).success


def test_a_view_passes_for_its_system():
    view = counting_view(HH, lambda what, x: None)
    assert isinstance(view, type(HH))
    assert {HH: 1}[view] == 1
    assert view == HH
    assert view.fingerprint == HH.fingerprint
    assert type(pickle.loads(pickle.dumps(view))) is type(HH)
