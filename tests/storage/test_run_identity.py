"""Identities: two things have one digest if and only if they are made of the same, in any process."""

import subprocess
import sys
import textwrap
import threading
from collections import namedtuple
from dataclasses import dataclass, field
from functools import cache, cached_property, partial

import numpy as np
import pytest
import torch
from numba import njit
from scipy.interpolate import CubicSpline

import sympflow
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.storage.identity import Known, digest
from sympflow.storage.store import Store

OFFSET = 0.0
LONG = np.arange(10_000.0)


def largest(t, y, factor=1.0):
    return factor * max(value + OFFSET for value in y[0])


def of_class(body, base=object, **members):
    """A class as one source would define it, another each time that it is asked for."""
    space = {"__name__": "mine", "base": base}
    exec(f"class Made(base):\n{textwrap.indent(body, '    ')}", space)
    for name, value in members.items():
        setattr(space["Made"], name, value)
    return space["Made"]


def slotted(x):
    made = of_class("__slots__ = ('x',)\ndef __call__(self, t, y):\n    return self.x")()
    made.x = x
    return made


class Scaled:
    def __init__(self, factor):
        self.factor = factor

    @cached_property
    def found(self):
        return 2 * self.factor

    def __call__(self, t, y):
        return self.factor * y[0].max()


@dataclass
class Weighted:
    weights: np.ndarray = field(compare=False, repr=False)

    def __call__(self, t, y):
        return self.weights @ y


Pair = namedtuple("Pair", "a b")


def near(i):
    """Long arrays that differ in the middle, where no text shows them."""
    x = LONG.copy()
    x[5000] += i
    return x


def closed(a):
    return lambda t, y: a @ y


def module_of(x):
    net = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Tanh() if x else torch.nn.Sigmoid())
    for p in net.parameters():
        torch.nn.init.ones_(p)
    return net


PAIRS = partial(HamiltonianSystem.pairs, "1/r", dim=2)
LATTICE = partial(HamiltonianSystem.lattice, shape=8, bond="r**2/2")
MADE = {
    "closure": lambda x: lambda t, y: x * y,
    "default": lambda x: lambda t, y, a=x: a * y,
    "object": Scaled,
    "method": lambda x: Scaled(x).__call__,
    "partial": lambda x: partial(largest, factor=x),
    "array": near,
    "closure of an array": lambda x: closed(near(x)),
    "field of a dataclass": lambda x: Weighted(near(x)),
    "slots": slotted,
    "base class": lambda x: of_class("pass", of_class(f"def f(self):\n    return {x}"))(),
    "method of a class": lambda x: of_class(f"def __call__(self, t, y):\n    return {x}")(),
    "class attribute": lambda x: of_class(f"factor = {x}"),
    "class method": lambda x: of_class(f"@classmethod\ndef f(cls):\n    return {x}"),
    "property": lambda x: of_class(f"@property\ndef f(self):\n    return {x}"),
    "objects in an array": lambda x: np.array([1, "a", [x]], dtype=object),
    "bits of an array": lambda x: np.array([np.nan, np.ldexp(float(x), -60) + 1, -0.0 if x else 0.0]),
    "tensor": lambda x: torch.tensor([1.0, float(x)], dtype=torch.bfloat16),
    "module of torch": module_of,
    "Numba": lambda x: njit(lambda q: q * x),
    "cached": lambda x: cache(lambda y: x * y),
    "spline": lambda x: CubicSpline([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, x, 0.0]),
    "generator": lambda x: np.random.default_rng(int(x)),
    "tuple with names": lambda x: Pair(1, x),
    "type of a number": lambda x: 1.0 if x else 1,
    "function that raises": lambda x: of_class(
        f"def f(y):\n    try:\n        return y[{x}]\n    except KeyError:\n        pass"
    ),
    "callable of the user in NumPy's": lambda x: np.vectorize(lambda y: y + x),
    "potential": lambda x: HamiltonianSystem(lambda q: (x + q**4).sum(-1), ndof=1),
    "gradient": lambda x: HamiltonianSystem(
        lambda q: (q**2).sum(-1) / 2, ndof=1, gradient=lambda q: q + 0 * x, check=False
    ),
    "driven": lambda x: HamiltonianSystem(lambda t, q: (q**2).sum(-1) * (1 + x * t), ndof=1, time=True),
    "doubled": lambda x: sympflow.doubled(sympflow.systems.pendulum(), lambda q, p: -x * p**3),
    "box": lambda x: PAIRS(masses=[1.0, 1.0], box=10.0 + x),
    "softening": lambda x: PAIRS(masses=[1.0, 1.0], softening=0.1 + x),
    "masses": lambda x: PAIRS(masses=[1.0, 1 + x]),
    "planets": lambda x: HamiltonianSystem.planets([1.0, 1e-3], elements={"a": 1.0}, extra=f"1e-4/r**{3 + x}"),
    "term far out": lambda x: LATTICE(onsite=f"q**2 + {x}*Max(q - 1000, 0)**4"),
    "boundary": lambda x: LATTICE(onsite="q**2", boundary="fixed" if x else "free"),
    "sites": lambda x: LATTICE(onsite="k*q**2", params={"k": 1 + near(x)[4996:5004]}),
    "waves": lambda x: HamiltonianSystem.schroedinger(shape=8, length=1.0 + x),
    "formula": lambda x: HamiltonianSystem.from_sympy(f"p**2/2 + q**2*{0.1 + 3e-17 * x!r} + Max(q, p, p*q)"),
    "damping": lambda x: HamiltonianSystem.from_sympy("p**2/2 + q**2", damping=0.1 + x),
}


@pytest.mark.parametrize("make", MADE.values(), ids=list(MADE))
def test_what_is_made_of_the_same_has_one_digest(make):
    assert digest(make(0)) == digest(make(0))
    assert digest(make(0)) != digest(make(1))


HELPER = """
FACTOR = {}
def inner(y): return FACTOR * y
def outer(y): return inner(y)
def unused(): return {}
"""
SCRIPT = """
import helper_of_mine
from sympflow.storage.identity import digest
from sympflow.systems import henon_heiles

def by_name(t, y):
    return helper_of_mine.outer(y) if "a" in {"a", "b"} else None

def imported(t, y):
    from helper_of_mine import outer
    return outer(y)

print(digest([by_name, imported, {"a", "b", "c"}, henon_heiles()]))
"""


def test_a_digest_is_that_of_another_process_and_changes_with_a_module_of_the_user(tmp_path):
    def told(factor, unused, seed):
        (tmp_path / "helper_of_mine.py").write_text(HELPER.format(factor, unused))
        (tmp_path / "script.py").write_text(SCRIPT)
        words = [sys.executable, "-B", str(tmp_path / "script.py")]
        env = {"PYTHONHASHSEED": seed, "PYTHONPATH": ":".join(sys.path)}
        return subprocess.run(words, check=True, capture_output=True, env=env).stdout

    assert told(1, 1, "1") == told(1, 22, "2") != told(3, 1, "1")


def test_what_cannot_be_told_from_another_is_said(tmp_path):
    lock = threading.Lock()
    known = Known()
    known.add("reduce", "f", lambda t, y: lock)
    assert known.untold == {"reduce": "an object of _thread.lock"}
    assert known.python == {"reduce"}
    ring = [1]
    ring.append(ring)
    again = Known()
    again.add("ring", "", ring)
    assert not again.untold
    assert not again.python


def system_of(k, held=None):
    def potential(q):
        return (k * q**2 / 2 if held is None else held[1] * q**2 / 2).sum(-1)

    return HamiltonianSystem(potential, ndof=1, y0=[1.0, 0.0], dt=0.1)


@pytest.mark.parametrize("call", ["solve", "ensemble"])
def test_a_store_is_of_one_system_and_what_cannot_be_known_is_vouched_for(tmp_path, call):
    def run(path, system, **how):
        kept = getattr(sympflow, call)(system, "verlet", (0, 1), store=tmp_path / path, **how)
        return np.array(kept.y)

    first = run("a", system_of(1.0))
    np.testing.assert_array_equal(run("a", system_of(1.0), resume=True), first)
    for other in (
        system_of(2.0),
        HamiltonianSystem.from_sympy("p**2/2 + q**2/2", name="V = potential", y0=[1.0, 0.0], dt=0.1),
    ):
        with pytest.raises(ValueError, match=r"its `system` is V = potential .*(If the code of `system`|[Nn]ame an)"):
            run("a", other, resume=True)
    held = (threading.Lock(), 1.0)
    whole = run("b", system_of(1.0, held))
    with pytest.raises(ValueError, match=r"`system` holds an object of _thread.lock, .* Pass same=True if all is"):
        run("b", system_of(1.0, held), resume=True)
    np.testing.assert_array_equal(run("b", system_of(1.0, held), resume=True, same=True), whole)
    with pytest.raises(ValueError, match=r"is of another .*: its `(t0|t_span)` is"):
        getattr(sympflow, call)(system_of(1.0, held), "verlet", (0.5, 1), store=tmp_path / "b", resume=True, same=True)
    with pytest.raises(ValueError, match="`same`"):
        getattr(sympflow, call)(system_of(1.0), "verlet", (0, 1), same=True)
    with pytest.raises(TypeError, match="`same` must be True or False"):
        run("b", system_of(1.0), resume=True, same="yes")
    assert "sympflow_run" in Store.open(tmp_path / "a").attributes or call == "ensemble"


def helped(t, y):
    return largest(t, y) if len(t) else OFFSET


@pytest.mark.parametrize("function", [largest, helped, lambda: helped])
def test_functions_are_known_by_the_globals_that_they_and_their_helpers_name(monkeypatch, function):
    before = digest(function)
    monkeypatch.setitem(globals(), "OFFSET", 1.0)
    assert digest(function) != before
    monkeypatch.setitem(globals(), "OFFSET", 0.0)
    assert digest(function) == before
    monkeypatch.setattr(largest, "__defaults__", (2.0,))
    assert digest(function) != before


def test_drawn_states_are_all_compared(tmp_path):
    """Two samplers that agree in their first states."""

    def sampler(last):
        def draw(rng, n):
            y = rng.uniform(-0.1, 0.1, (n, 4))
            y[-1] += last
            return y

        return draw

    def run(last, **how):
        how = {"n": 4096, "dt": 0.1, "reduce": "final", "store": tmp_path / "a"} | how
        return sympflow.ensemble(sympflow.systems.henon_heiles(), "verlet", (0, 1), sampler(last), **how)

    run(0.0)
    run(0.0, resume=True)
    with pytest.raises(ValueError, match="its `y0` is 4096 states by seed 0"):
        run(0.01, resume=True)


def test_what_was_used_is_the_same():
    """Cached values, generated functions and compiled code are no part of a thing."""
    for thing, use in (
        (Scaled(2.0), lambda s: s.found),
        (sympflow.systems.henon_heiles(), lambda s: (s.vector_field(s.y0), s.expression, s.fingerprint)),
        (sympflow.systems.fput(8), lambda s: (s.vector_field(s.y0), s.linear_part)),
        (njit(lambda x: x + 1), lambda f: f(1.0)),
    ):
        before = digest(thing)
        use(thing)
        assert digest(thing) == before
