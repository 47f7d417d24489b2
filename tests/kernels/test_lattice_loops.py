"""Compiled loops of lattices: the steps of the array operations, whatever the size, the lanes and the threads."""

from __future__ import annotations

import numpy as np
import pytest

from sympflow import HamiltonianSystem, solve
from sympflow.kernels import lattices
from sympflow.kernels.protocol import RunCheckpoint
from sympflow.kernels.splitting_loops import splitting_loops
from sympflow.kernels.stages import single_table
from sympflow.kernels.threads import at_most
from sympflow.schemes import SCHEMES


def chain(n=40, **more):
    """A disordered chain between walls, with bonds to second neighbours."""
    values = np.random.default_rng(n).uniform(0.5, 1.5, (2, n))
    definition = {
        "onsite": "a*q**4/4",
        "bond": {1: "exp(r) - r", 2: "b*r**3/3"},
        "kinetic": "p**2/(2*m)",
        "boundary": "fixed",
        "params": {"a": values[0], "b": 0.3, "m": values[1]},
    }
    return HamiltonianSystem.lattice(shape=n, **{**definition, **more})


def ring(n=48, **more):
    return HamiltonianSystem.lattice(bond="r**2/2 + r**4/4", shape=n, **more)


def start(system, n=None):
    shape = 2 * system.ndof if n is None else (n, 2 * system.ndof)
    return np.random.default_rng(3).uniform(-0.5, 0.5, shape)


def assert_loops_are_arrays(system, method, y0, **more):
    """Runs by loops and by arrays, whose forces are tested by differences, agree at times on and off the grid."""
    options = {"t_span": (0.0, 1.0), "y0": y0, "dt": 0.05, "t_eval": np.array([0.0, 0.5, 0.52, 1.0]), **more}
    loops, arrays = (solve(system, method, backend=backend, **options) for backend in ("compiled", "array"))
    np.testing.assert_allclose(loops.y, arrays.y, rtol=1e-12, atol=1e-13)
    assert (loops.stats["backend"], arrays.stats["backend"]) == ("compiled", "numpy")


@pytest.mark.parametrize("method", ["srkn6b", "chin4c"])
def test_loops_make_the_steps_of_array_operations(method):
    system = chain()
    assert_loops_are_arrays(system, method, start(system))
    assert_loops_are_arrays(system, method, start(system, 3))
    assert_loops_are_arrays(system, method, start(system), t_span=(1.0, 0.0), t_eval=np.array([1.0, 0.31, 0.0]))


TWO_FIELDS = {
    "onsite": "u**2*v**2/2 + u**4/4", "bond": "r_u**2/2 + r_v**2/2 + r_u**2*r_v", "fields": ("u", "v"),
}  # fmt: skip
IN_SPACE = {**TWO_FIELDS, "bond": "r_u**2/2 + r_v**2/2 + sin(r_u*r_v)", "shape": (4, 3, 5)}
KINDS = {
    "two fields, free": (TWO_FIELDS | {"shape": 21, "boundary": "free"}, "chin4c"),
    "two fields, periodic": (TWO_FIELDS | {"shape": 21, "boundary": "periodic"}, "chin4c"),
    "two fields, a sheet": (TWO_FIELDS | {"shape": (6, 10), "boundary": ("free", "periodic")}, "chin4c"),
    "a damped sheet": (TWO_FIELDS | {"shape": (6, 10), "boundary": ("free", "periodic"), "damping": 0.3}, "verlet"),
    "a damped ring": ({"bond": "r**2/2 + r**4/4", "shape": 48, "damping": 0.2}, "srkn6b"),
    "space, periodic": (IN_SPACE | {"boundary": "periodic"}, "chin4c"),
    "space, fixed": (IN_SPACE | {"boundary": "fixed"}, "verlet"),
    "space, mixed": (IN_SPACE | {"boundary": ("free", "periodic", "fixed")}, "verlet"),
    "constant force": ({"onsite": "q", "bond": "r", "shape": (3, 8)}, "chin4c"),
    "constant tension": (
        {"onsite": "q**2/2", "bond": "r", "boundary": ("free", "periodic"), "shape": (3, 8)},
        "chin4c",
    ),
    "constant tension, free": ({"onsite": "cos(q)", "bond": "r", "boundary": "free", "shape": 12}, "chin4c"),
    "second neighbours": ({"bond": {1: "r", 2: "r**2/2"}, "boundary": "free", "shape": 12}, "chin4c"),
    "powers of derivatives": ({"bond": "1/(2 + r)**14 + r**2", "shape": 13, "boundary": "free"}, "chin4c"),
    "odd powers": ({"bond": "1/(2 + r)**15 + r**2", "shape": 13, "boundary": "free"}, "chin4c"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_lattices_of_every_kind(kind):
    definition, method = KINDS[kind]
    system = HamiltonianSystem.lattice(**definition)
    assert_loops_are_arrays(system, method, start(system))


@pytest.mark.parametrize(
    ("shapes", "boundary", "method"),
    [
        ((5, 8, 13, 40), "free", "chin4c"), ((13, 40), "fixed", "chin4c"), ((5, 8), "periodic", "chin4c"),
        ((5, 40), "free", "verlet"), (((5, 8), (7, 13), (3, 18)), ("free", "fixed"), "chin4c"),
        (((3, 18),), ("fixed", "free"), "chin4c"), (((7, 13),), ("periodic", "periodic"), "chin4c"),
        (((5, 8), (3, 18)), ("fixed", "periodic"), "verlet"), (((7, 13),), ("periodic", "free"), "verlet"),
    ],
)  # fmt: skip
def test_lattices_in_vector_registers(shapes, boundary, method):
    """Slabs have one site, or two, or several lengths, by the number of sites.

    The force of the bonds does not vanish where r = 0, and it has a pole.
    """
    for shape in shapes:
        a, m = np.random.default_rng(shape).uniform(0.5, 1.5, (2, *np.atleast_1d(shape)))
        system = HamiltonianSystem.lattice(
            onsite="a*q**4/4 + q",
            bond="a*r**2/2 + b*r**3/3 + 1/(4 + r)",
            kinetic="p**2/(2*m)",
            shape=shape,
            boundary=boundary,
            params={"a": a, "b": 0.3, "m": m},
        )
        assert_loops_are_arrays(system, method, start(system))


@pytest.fixture
def pieces(monkeypatch):
    """Lattices that threads share however small they are."""
    monkeypatch.setattr(lattices, "WORTH_A_PIECE", 16)


@pytest.mark.parametrize(
    ("method", "shape", "boundary"),
    [
        (("verlet", "chin4c")[(i + k) % 2], shape, boundary)
        for i, shape in enumerate([270, 271, (40, 9), (9, 40), (9, 8, 5)])
        for k, boundary in enumerate(["periodic", "fixed", "free"])
    ],
)
def test_pieces_and_threads_change_nothing(method, shape, boundary, pieces):
    """The state of a site is the same in all lanes and pieces, to the bit."""
    values = np.random.default_rng(5).uniform(0.5, 1.5, shape)
    system = HamiltonianSystem.lattice(
        bond="r**2/2 + r**4/4", kinetic="m*p**2", shape=shape, boundary=boundary, params={"m": values}
    )
    y0, options = start(system), {"t_span": (0.0, 1.0), "dt": 0.05, "t_eval": np.array([0.0, 0.5, 1.0])}
    runs = []
    for threads in (1, 2, 3):
        with at_most(threads):
            runs.append(solve(system, method, y0=y0, backend="compiled", **options).y)
    assert splitting_loops(system).functions(SCHEMES[method].level, False).pieces > 1
    batch = solve(system, method, y0=np.stack([y0, y0]), backend="compiled", **options).y
    for other in (*runs[1:], batch[1]):
        np.testing.assert_array_equal(other, runs[0])


@pytest.mark.parametrize("shape", [48, (6, 9)])
def test_compensated_sums_lower_the_rounding(shape):
    """There and back by a symmetric scheme: what is left is rounding, whatever the error of the method."""
    system = ring(shape)
    y0, left = start(system), []
    for compensated in (False, True):
        how = {"dt": 0.02, "compensated": compensated}
        end = solve(system, "srkn6b", t_span=(0, 100.0), y0=y0, t_eval=[100.0], **how).y[:, -1]
        back = solve(system, "srkn6b", t_span=(100.0, 0), y0=end, t_eval=[0.0], **how).y[:, -1]
        left.append(np.abs(back - y0).max())
    assert left[1] < left[0] / 5


def test_widths_change_nothing(monkeypatch):
    system, runs = chain(48), []
    for width in (1, 2, 4, 8):
        monkeypatch.setattr(lattices, "arrangement", lambda lattice, width=width: ([0], width))
        code = lattices.LatticeCode(system.local, False, SCHEMES["chin4c"].level, False)
        runs.append(np.empty((1, 96)))
        code.mapped(single_table(SCHEMES["chin4c"], 0.1).packed, start(system, 1), runs[-1])
        np.testing.assert_array_equal(runs[-1], runs[0])


@pytest.mark.parametrize("threads", [1, 2])
def test_a_run_that_becomes_infinite_keeps_what_it_has(threads, pieces):
    system = ring(230)
    y0 = start(system)
    y0[7] = 60.0
    with at_most(threads):
        loops, arrays = (
            solve(system, "srkn6b", t_span=(0.0, 10.0), y0=y0, dt=0.2, backend=backend)
            for backend in ("compiled", "array")
        )
    assert loops.status == arrays.status == -1
    np.testing.assert_array_equal(loops.t, arrays.t)


@pytest.mark.parametrize("compensated", [False, True])
def test_a_run_in_pieces_has_the_bits_of_one(compensated, pieces):
    system = ring(230)
    y0, kernel = start(system), splitting_loops(system).kernel(SCHEMES["srkn6b"], compensated)
    for threads in (1, 2):
        with at_most(threads):
            whole = kernel.run(0.05, y0, 90, np.array([20, 90])).states
            carry = RunCheckpoint()
            parts = [kernel.run(0.05, y0, n, np.array([n]), carry).states[0] for n in (20, 90)]
        np.testing.assert_array_equal(np.stack(parts), whole)


def test_the_code_does_not_depend_on_the_size():
    few, many = (splitting_loops(ring(n)).functions(0, False) for n in (64, 6400))
    assert few.function("run", 1) is many.function("run", 1)
