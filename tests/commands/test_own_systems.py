"""Systems in files of the user, TOML with a formula and Python with a name; what is wrong with them is said."""

import numpy as np
import pytest
from test_cli import run

from sympflow import EnergySublevel, systems
from sympflow.commands.words import one_scene, scenes
from sympflow.systems.user_files import factory

QUARTIC = """
hamiltonian = "p**2/2 + q**2/2 + lam*q**4/4"
y0 = [1.0, 0.0]
t_span = [0, 2]
dt = 0.1

[params]
lam = 0.5

[domain]
kind = "EnergySublevel"
energy = 1.0
box = { low = [-1.3, -1.5], high = [1.3, 1.5] }
"""
PYTHON = """
from sympflow import HamiltonianSystem

spring = HamiltonianSystem.from_sympy("p**2/2 + q**2/2", y0=[1.0, 0.0], t_span=(0, 2), dt=0.1)


def chain(stiffness: float = 1.0, power: int = 2, label: str = "a") -> HamiltonianSystem:
    H = f"p**2/2 + k*q**{power}/2"
    return HamiltonianSystem.from_sympy(H, params={"k": stiffness}, name=label, y0=[1.0, 0.0], t_span=(1, 2))


def needs(k):
    return spring


def number():
    return 3


def fails():
    return 1 / 0


seven = 7
"""
ARRAY = ("--method", "leapfrog", "--backend", "array")
FAST = ("--methods", "leapfrog", "--backend", "array", "--n-outputs", 3, "--repeats", 1)


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    """A folder with files of systems, which is the current one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "quartic.toml").write_text(QUARTIC, encoding="utf-8")
    (tmp_path / "own.py").write_text(PYTHON, encoding="utf-8")
    return tmp_path


def test_a_formula_in_a_file_is_the_system_of_the_same_formula():
    scene = one_scene(["quartic.toml"])
    y = np.array([[0.3, -0.7], [1.1, 0.2]])
    expected = y[:, 1] ** 2 / 2 + y[:, 0] ** 2 / 2 + 0.5 * y[:, 0] ** 4 / 4
    np.testing.assert_allclose(scene.system.hamiltonian(y), expected, rtol=1e-15)
    assert (scene.key, scene.system.name, scene.system.t_span, scene.system.dt) == ("quartic", "quartic", (0, 2), 0.1)
    assert scene.system.y0.tolist() == [1, 0]
    assert isinstance(scene.system.domain, EnergySublevel)
    assert scene.system.domain.contains([0.1, 0.1])
    assert systems.from_toml("quartic.toml", lam=3.0).params == {"lam": 3.0}
    assert one_scene(["quartic.toml:lam=2:t_end=1"]).system.params == {"lam": 2.0}
    assert one_scene(["quartic.toml", "--lam", "2"]).key == "quartic-lam=2"


def test_driven_and_damped_systems_in_files(files):
    text = (
        'hamiltonian = "p**2/2 + q**4/4 - F*q*cos(t)"\ntime = "t"\nperiod = 6.283185307179586\ny0 = [1, 0]\ndt = 0.2\n'
    )
    (files / "driven.toml").write_text(text + "damping = 0.25\nparams = { F = 0.3 }", encoding="utf-8")
    system = one_scene(["driven.toml", "--F", "0.4"]).system
    assert (system.autonomous, system.period, system.damping, system.params) == (False, 2 * np.pi, 0.25, {"F": 0.4})
    for words in (("solve",), ("section", "--since", 1), ("compare", "--n-outputs", 5, "--repeats", 1)):
        method = "--methods" if words[0] == "compare" else "--method"
        result = run(*words, "driven.toml", method, "rk4", "--t-end", 10)
        assert result.exit_code == 0, result.output
    assert "conf. defect" in result.stdout
    oscillators = 'hamiltonian = "(p1**2 + p2**2 + q1**2 + q2**2)/2"\ndamping = '
    for value, fits in (("[0.1, 0.2]", True), ("[[0.1, 0], [0, 0.2]]", True), ('"much"', False), ("[true, 1]", False)):
        (files / "damped.toml").write_text(oscillators + value, encoding="utf-8")
        if fits:
            assert not systems.from_toml("damped.toml").conservative
            continue
        with pytest.raises(ValueError, match=r"^`damping` must be a number, a list of one for each p, or a matrix"):
            systems.from_toml("damped.toml")
    source = """
from sympflow import HamiltonianSystem

def shaken(a: float = 0.1) -> HamiltonianSystem:
    return HamiltonianSystem.from_sympy(
        "p**2/2 - cos(q)*(1 + a*cos(2*t))", params={"a": a}, time="t", period=3.141592653589793, y0=[1.0, 0.0]
    )
"""
    (files / "shaken.py").write_text(source, encoding="utf-8")
    words = ("shaken.py:shaken", "--a", "0.2", "--method", "rk4", "--t-end", 7)
    assert "3.141593" in run("section", *words).stdout
    solved = run("solve", *words)
    assert solved.exit_code == 0
    assert "energy error" not in solved.stdout


def test_a_name_in_a_python_file_is_a_system_or_a_function_of_parameters():
    assert one_scene(["own.py:spring"]).system is factory("own.py", "spring")()
    made = one_scene(["own.py:chain:power=4:label=b", "--stiffness", "2"])
    assert (made.system.params, made.system.name) == ({"k": 2.0}, "b")
    assert made.system.hamiltonian(np.array([2.0, 0.0])) == 16
    assert made.key == "own-chain-stiffness=2-power=4-label=b"
    one, other = scenes(["own.py:spring", "pendulum"], ["quartic.toml"])[1:]
    assert (one.key, other.key) == ("pendulum", "quartic")


@pytest.mark.parametrize(
    "words",
    [
        ("solve", "own.py:spring", *ARRAY),
        ("solve", "--system", "quartic.toml", "--lam", "2", *ARRAY),
        ("solve", "own.py:chain:power=4", "--stiffness", "2", *ARRAY),
        ("solve", "own.py:needs:k=1", *ARRAY),
        ("solve", "own.py", *ARRAY),
        ("compare", "quartic.toml", "own.py:spring", *FAST, "--metrics", "energy"),
        ("bench", "own.py:spring", *FAST, "--t-end", 0.5),
        ("section", "own.py:spring", "--method", "leapfrog", "--t-end", 7),
        ("flows", "own.py:spring"),
        ("stability", "own.py:chain", "--vary", "power=2", "--methods", "rk45", "--steps", 0.1, "--no-limits"),
    ],
)
def test_every_command_that_takes_a_system_takes_it(words):
    result = run(*words)
    assert result.exit_code == 0, result.output
    assert {"solve": "y(2) = [", "flows": "harmonic_oscillator-sympflow"}.get(words[0], "") in result.stdout


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("gone.toml", "`system` 'gone.toml': there is no such file"),
        ("gone.py:x", "`system` 'gone.py': there is no such file"),
        ("folder.toml", "`system` 'folder.toml' cannot be read"),
        ("own.py:sprong", "`system` 'sprong' is not in 'own.py'. Did you mean 'spring'?"),
        ("own.py:seven", "must be a HamiltonianSystem, or a function that returns one; it is int"),
        ("own.py:number", "must return a HamiltonianSystem; it returns int"),
        (
            "own.py:fails",
            "`system` 'fails' in 'own.py' failed (ZeroDivisionError: division by zero, line 21): correct it.",
        ),
        (
            "own.py:needs",
            "needs a value of `k`: give it a default in the file, or on the command line write own.py:needs:k=number.",
        ),
        ("own.py:chain:power=2.5", "`power` must be a whole number; got '2.5'."),
        ("own.py:spring:k=1", "`k` is not a parameter of own-spring"),
        ("quartic.toml:x", "is one system, which has no 'x'"),
        ("quartic.toml:mu=1", "`mu` is not a parameter of quartic, which takes lam, t_end."),
    ],
)
def test_a_wrong_word_is_named(word, message, files):
    (files / "folder.toml").mkdir()
    result = run("solve", word)
    assert result.exit_code == 2
    assert message in result.stderr


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("f.toml", 'hamiltonain = "p**2/2"', "`hamiltonain` is not a key of a system (in 'f.toml'). Did you mean"),
        ("f.toml", "dt = 1", "`hamiltonian` is missing in 'f.toml'"),
        ("f.toml", "hamiltonian = p**2", "`system` 'f.toml' is not TOML"),
        ("f.toml", "y0 = " + "[" * 5000, "`system` 'f.toml' is nested too deeply"),
        ("f.toml", "dt = " + "9" * 5000, "`system` 'f.toml' is not TOML"),
        ("f.toml", "hamiltonian = 'p**2 + q99999999999'", "`hamiltonian` has coordinates numbered up to 99999999999"),
        ("f.toml", 'hamiltonian = "p**2/2 + q**"', "`hamiltonian` cannot be parsed"),
        ("f.toml", 'hamiltonian = "p**2/2 + w*q**2"', "`hamiltonian` holds w without a value: give it in `params`"),
        ("f.toml", 'hamiltonian = "p**2 + w*q**2"\nparams = {w = "a"}', "`params` must be a table of numbers"),
        ("f.toml", 'hamiltonian = "p**2 + q**2"\ny0 = ["a", 1]', "`y0` must be a list of numbers"),
        ("f.toml", 'hamiltonian = "p**2 + q**2"\ny0 = [1]', "`y0` must have shape (2,)"),
        ("f.toml", 'hamiltonian = "p**2 + q**2"\ndt = true', "`dt` must be a number; got True"),
        ("f.toml", 'hamiltonian = "p**2 + q**2"\nt_span = [1, 2, 3]', "`t_span` must be two"),
        ("f.toml", 'hamiltonian = "p**2 + q**2"\n[domain]\nkind = "Bax"', "`domain` needs a kind, one of Ball, Box"),
        ("f.toml", 'hamiltonian = "p**2 + q**2"\n[domain]\nkind = "Box"\nlow = [1, 2]', "`domain` is not a Box"),
        ("f.toml", 'hamiltonian = "p**2"\n[domain]\nkind = "Box"\nr = 1', "`domain` has a key 'r', but a Box has low"),
        ("f.py:x", "import a_module_that_is_not_there", "`system` 'f.py' cannot be run (ModuleNotFoundError"),
        ("f.py:x", "def f(:", "`system` 'f.py' cannot be run (SyntaxError: invalid syntax, line 1): correct it."),
        ("f.py", "x = 1", "`system` 'f.py' lacks the name of a system in it (it has none)"),
    ],
)
def test_a_wrong_file_is_named_with_what_is_wrong(name, text, message, files):
    (files / name.partition(":")[0]).write_text(text, encoding="utf-8")
    result = run("solve", name)
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.output


@pytest.mark.slow
def test_a_flow_is_trained_on_it_certified_and_used(files):
    small = ("--stages", 1, "--processor", 0, "--dt", 0.4, "--restarts", 1, "--steps", 2, "--points", 20)
    trained = run("train", "quartic.toml", *small, "--out", "q.safetensors")
    assert trained.exit_code == 0, trained.output
    sample = ("--states", 20, "--times", 3, "--held-out", 3, "--t-end", 4)
    for to in ("c.json", "certified.safetensors"):
        found = run("certificate", "quartic.toml", "--flow", "q.safetensors", *sample, "--out", to)
        assert found.exit_code == 0, found.output
        assert "Certificate of a flow of quartic" in found.stdout
    assert '"held_out": 3' in (files / "c.json").read_text(encoding="utf-8")
    result = run("solve", "quartic.toml", "--method", "certified.safetensors", "--backend", "array")
    assert result.exit_code == 0, result.output
