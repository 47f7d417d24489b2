"""Learning from data, by the protocols of published models: `sympflow.learn` and `sympflow.discover`.

    python benchmarks/learning.py [--out docs/measured]         all of them
    python benchmarks/learning.py --only hnn-spring             one protocol
    python benchmarks/learning.py --only discovery              formulas of four systems
    python benchmarks/learning.py --only sweeps                 the authors' sweeps in noise, N and M, with a figure

The data are made here, by the descriptions of the authors' generators, from solutions that are exact to 1e-10. "Theirs"
are published figures (`SOURCES`), or, where the protocol asks for it, a baseline by code of this file that gets as much
processor time as the fit and at least `--baseline` seconds. Float64, one thread; seconds are processor time.
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measuring.machine import pin_to_one_thread

pin_to_one_thread()

import numpy as np
import torch
from measuring import fragments

import sympflow
from sympflow import HamiltonianSystem, SympFlow, discover, solve, systems

SOURCES = {
    "authors": "the paper's supervised experiment: N = 100 states, M = 50 irregular times in [0, 1], noise on targets",
    "ghnn": "GHNN (AELITTEN/GHNN): exact labels in place of the authors', which err by 1e-4 to 1e-3",
    "hnn": "HNN (greydanus/hamiltonian-nn): 50 trajectories, half for training, σ = 0.1",
    "d-hnn": "D-HNN (greydanus/dissipative_hnns): damped spring, γ = 0.1, σ = 0.01",
}
PENDULUM = systems.pendulum()
SPRING = HamiltonianSystem.from_sympy("p**2 + q**2", name="spring")
HNN_PENDULUM = HamiltonianSystem.from_sympy("p**2 + 2*(1 - cos(q))", name="hnn_pendulum")
DAMPED = HamiltonianSystem.from_sympy("(p**2 + q**2)/2", damping=0.1, name="damped_spring")
CHAIN = HamiltonianSystem.from_sympy(
    "(p1**2 + p2**2 + p3**2 + p4**2)/2 + (q1**2 + q2**2 + q3**2 + q4**2)/2"
    " + ((q1 - q2)**4 + (q2 - q3)**4 + (q3 - q4)**4)/4"
)
KEPLER = HamiltonianSystem.from_sympy("(p1**2 + p2**2)/2 - 1/sqrt(q1**2 + q2**2)")


@dataclass(frozen=True)
class Row:
    """A line of the table; figures are text, for some are pairs."""

    protocol: str
    metric: str
    theirs: str
    target: float
    ours: float
    seconds: float
    remark: str = ""

    def cells(self) -> list[str]:
        reached = "yes" if self.ours <= self.target else "no"
        figures = [self.theirs, fragments.number(self.target), fragments.number(self.ours), reached]
        return [self.protocol, self.metric, *figures, f"{self.seconds:.0f}", self.remark]


def exact(system: HamiltonianSystem, y0: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States (N, 2d, n) at times t, which start at 0."""
    span = (0.0, float(t[-1]))
    if system.conservative:
        method = "kahan_li8" if system.separable else "gauss_legendre8"
        return solve(system, method, span, y0, t_eval=t, dt=0.01).raise_for_status().y
    made = [solve(system, "dop853", span, start, t_eval=t, rtol=1e-11, atol=1e-12) for start in y0]
    return np.array([sol.raise_for_status().y for sol in made])


def timed(f: Callable[[], Any]) -> tuple[Any, float]:
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = f()
    return found, time.process_time() - start


def predicted(flow: Any, y0: np.ndarray, t: np.ndarray) -> np.ndarray:
    """States (N, 2d, n) by a learned flow."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return solve(flow.system, flow, (0.0, float(t[-1])), y0, t_eval=t).y


def energy_mse(system: HamiltonianSystem, found: np.ndarray, true: np.ndarray) -> float:
    """Mean square of the true H along predictions, less that along the true solutions."""
    H = [system.hamiltonian(np.moveaxis(y, -1, -2)) for y in (found, true)]
    return float(np.mean((H[0] - H[1]) ** 2))


# the authors' experiment ----------------------------------------------------------------------------------------------


def authors_data(
    system: HamiltonianSystem, width: float, eps: float, n: int, m: int, seed: int
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """N trajectories of M irregular times in [0, 1] and their start, without noise; and held-out states."""
    random = np.random.default_rng(seed)
    states = random.uniform(-width, width, (n + 100, 2 * system.ndof))
    data = []
    for start in states[:n]:
        t = np.concatenate([[0.0], np.sort(random.uniform(0.0, 1.0, m))])
        y = exact(system, start[None], t)[0]
        y[:, 1:] += eps * random.normal(size=(len(y), m))
        data.append((t, y))
    return data, states[n:]


def authors_adam(data: list[tuple[np.ndarray, np.ndarray]], ndof: int, seconds: float, seed: int) -> SympFlow:
    """A SympFlow of 5 pairs of layers of 10 by Adam on the labels, for so much processor time."""
    torch.manual_seed(seed)
    x = torch.tensor(np.concatenate([np.repeat(y[:, :1].T, y.shape[1] - 1, 0) for _, y in data]))
    t = torch.tensor(np.concatenate([one[1:] for one, _ in data]))
    target = torch.tensor(np.concatenate([y[:, 1:].T for _, y in data]))
    flow = SympFlow(ndof, 5, [10], dt=1.0, seed=seed)
    optimizer = torch.optim.Adam(flow.parameters(), 5e-3)
    start, generator = time.process_time(), torch.Generator().manual_seed(seed)
    while time.process_time() - start < seconds:
        for group in optimizer.param_groups:
            group["lr"] = 5e-3 * (1 - 0.98 * (time.process_time() - start) / seconds)
        i = torch.randint(len(t), (500,), generator=generator)
        optimizer.zero_grad()
        loss = ((flow.psi(t[i], x[i]) - target[i]) ** 2).sum(-1).mean()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(flow.parameters(), 1.0)
        optimizer.step()
    return flow


def authors(system: HamiltonianSystem, width: float, eps: float, options: argparse.Namespace) -> Row:
    data, held = authors_data(system, width, eps, 100, 50, 0)
    truth = exact(system, held, np.array([0.0, 1.0]))[:, :, -1]
    flow, seconds = timed(lambda: sympflow.learn(data, dt=1.0))
    adam = authors_adam(data, system.ndof, max(seconds, options.baseline), 0)
    with torch.no_grad():
        theirs = adam.psi(1.0, torch.tensor(held)).numpy()
    ours = predicted(flow, held, np.array([0.0, 1.0]))[:, :, -1]
    errors = [float(np.linalg.norm(y - truth, axis=1).mean()) for y in (theirs, ours)]
    target = errors[0] / 10 if eps == 0 else 5e-3
    adams = f"{fragments.number(errors[0])} (ours, Adam)"
    name = f"authors: {system.name}, ε = {eps:g}"
    return Row(name, "one-step error at Δt = 1", adams, target, errors[1], seconds, _model(flow))


def _model(flow: Any) -> str:
    return flow.recipe["learned"]["model"]


# GHNN -----------------------------------------------------------------------------------------------------------------


def ghnn_pendulum(options: argparse.Namespace) -> list[Row]:
    """Trained on the first quarter of a period, from rest; judged at one period."""
    from scipy.special import ellipk

    random = np.random.default_rng(0)
    q0 = random.uniform(-0.95 * np.pi, 0.95 * np.pi, 500)
    periods = 4 * ellipk(np.sin(q0 / 2) ** 2)
    y0 = np.stack([q0, np.zeros(500)], 1)
    t = np.arange(0.0, periods.max() + 0.1, 0.1)
    y = exact(PENDULUM, y0, t)
    data = [(t[:n], y[i, :, :n]) for i in range(400) if (n := int(periods[i] / 4 / 0.1) + 1) > 1]
    at = np.minimum(np.round(periods / 0.1).astype(int), len(t) - 1)[400:]
    truth = y[400 + np.arange(100), :, at]
    rows = []
    fits: dict[str, Callable[[], Any]] = {
        "learn": lambda: sympflow.learn(data[: options.runs], dt=0.5),
        "discover": lambda: discover(data[: options.runs]),
    }
    for name, fit in fits.items():
        found, seconds = timed(fit)
        remark = _model(found) if name == "learn" else found.discovery.formula()
        if name == "learn":
            made = predicted(found, y0[400:], t)
        else:
            made = solve(found, "kahan_li8", (0.0, float(t[-1])), y0[400:], t_eval=t, dt=0.05).y
        error = float(np.abs(made[np.arange(100), :, at] - truth).mean())
        rows.append(Row(f"GHNN pendulum, `{name}`", "MAE at 1 T", "1.3e-3 … 1.1e-2", 1e-3, error, seconds, remark))
    return rows


def ghnn_double_pendulum(options: argparse.Namespace) -> list[Row]:
    system = systems.double_pendulum()
    random = np.random.default_rng(0)
    y0 = np.concatenate(
        [random.uniform(-np.pi / 2, np.pi / 2, (options.runs + 100, 2)), np.zeros((options.runs + 100, 2))], 1
    )
    t = np.linspace(0.0, 10.0, 101)
    y = exact(system, y0, t)
    flow, seconds = timed(lambda: sympflow.learn((t[:51], y[100:, :, :51]), dt=0.1, separable=False))
    made = predicted(flow, y0[:100], t)
    rows = []
    for at, theirs, target in ((50, "6.3e-3", 4e-3), (100, "2.5e-2", 1.5e-2)):
        error = float(np.abs(made[:, :, at] - y[:100, :, at]).mean())
        rows.append(Row("GHNN double pendulum", f"MAE at t = {t[at]:g}", theirs, target, error, seconds, _model(flow)))
    return rows


# HNN ------------------------------------------------------------------------------------------------------------------


def hnn_data(
    system: HamiltonianSystem, radii: tuple[float, float], rate: int, sigma: float
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """25 noisy trajectories over [0, 3], and 25 held-out states, on circles of random radii."""
    random = np.random.default_rng(0)
    y0 = random.uniform(-1.0, 1.0, (50, 2))
    y0 *= random.uniform(*radii, (50, 1)) / np.linalg.norm(y0, axis=1, keepdims=True)
    t = np.linspace(0.0, 3.0, 3 * rate)
    return (t, exact(system, y0[:25], t) + sigma * random.normal(size=(25, 2, len(t)))), y0[25:]


def hnn(name: str, options: argparse.Namespace) -> list[Row]:
    system, radii, rate, theirs = {
        "spring": (SPRING, (0.1, 1.0), 10, 3.8e-4),
        "pendulum": (HNN_PENDULUM, (0.2, 2.0), 15, 2.5e-2),
    }[name]
    data, held = hnn_data(system, radii, rate, 0.1)
    t = np.linspace(0.0, 20.0, 201)
    truth = exact(system, held, t)
    flow, seconds = timed(lambda: sympflow.learn(data))
    ours = energy_mse(system, predicted(flow, held, t), truth)
    rows = [
        Row(f"HNN {name}, `learn`", "energy MSE to t = 20", f"{theirs:g}", theirs / 10, ours, seconds, _model(flow))
    ]
    found, seconds = timed(lambda: discover(data))
    made = solve(found, "kahan_li8", (0.0, 20.0), held, t_eval=t, dt=0.05).y
    remark = found.discovery.formula()
    error = energy_mse(system, made, truth)
    rows.append(
        Row(f"HNN {name}, `discover`", "energy MSE to t = 20", f"{theirs:g}", theirs / 10, error, seconds, remark)
    )
    if options.networks:
        rows.append(_network(name, system, data, held, t, truth, theirs))
    return rows


def _network(
    name: str, system: HamiltonianSystem, data: Any, held: np.ndarray, t: np.ndarray, truth: np.ndarray, theirs: float
) -> Row:
    """An HNN of two hidden layers of 200, tanh: exact derivatives at the noisy states, 2000 steps of Adam."""
    from scipy.integrate import solve_ivp

    times, y = data
    torch.manual_seed(0)
    net = torch.nn.Sequential(
        torch.nn.Linear(2, 200), torch.nn.Tanh(), torch.nn.Linear(200, 200), torch.nn.Tanh(), torch.nn.Linear(200, 1)
    ).double()
    clean = exact(system, hnn_clean(system, data), times)
    x = torch.tensor(y.transpose(0, 2, 1).reshape(-1, 2))
    v = torch.tensor(system.vector_field(clean.transpose(0, 2, 1).reshape(-1, 2)))

    def field(z: torch.Tensor, graph: bool = True) -> torch.Tensor:
        z = z.requires_grad_()
        (g,) = torch.autograd.grad(net(z).sum(), z, create_graph=graph)
        return torch.stack([g[:, 1], -g[:, 0]], 1)

    optimizer = torch.optim.Adam(net.parameters(), 1e-3, weight_decay=1e-4)
    start = time.process_time()
    for _ in range(2000):
        optimizer.zero_grad()
        ((field(x) - v) ** 2).mean().backward()
        optimizer.step()
    seconds = time.process_time() - start

    def f(_: float, z: np.ndarray) -> np.ndarray:
        return field(torch.tensor(z).reshape(-1, 2), False).detach().numpy().ravel()

    made = solve_ivp(f, (0.0, t[-1]), held.ravel(), t_eval=t, rtol=1e-6).y.reshape(len(held), 2, -1)
    error = energy_mse(system, made, truth)
    remark = "our own HNN, exact derivatives"
    return Row(f"HNN {name}, network", "energy MSE to t = 20", f"{theirs:g}", theirs / 10, error, seconds, remark)


def hnn_clean(system: HamiltonianSystem, data: Any) -> np.ndarray:
    """The initial states of `hnn_data` without noise, drawn again."""
    radii = (0.1, 1.0) if system is SPRING else (0.2, 2.0)
    random = np.random.default_rng(0)
    y0 = random.uniform(-1.0, 1.0, (50, 2))
    y0 *= random.uniform(*radii, (50, 1)) / np.linalg.norm(y0, axis=1, keepdims=True)
    return y0[: len(data[1])]


def damped_spring(options: argparse.Namespace) -> list[Row]:
    random = np.random.default_rng(0)
    y0 = random.uniform(-1.0, 1.0, (50, 2))
    t = np.linspace(0.0, 6.0, 61)
    y = exact(DAMPED, y0, t)
    data = (t, y[:25] + 0.01 * random.normal(size=(25, 2, len(t))))
    flow, seconds = timed(lambda: sympflow.learn(data, damping=True))
    error = energy_mse(DAMPED, predicted(flow, y0[25:], t), y[25:])
    gamma = float(np.mean(flow.system.damping))
    return [
        Row("D-HNN damped spring", "energy MSE", "3.6e-06", 3.6e-7, error, seconds, _model(flow)),
        Row("D-HNN damped spring", "relative error of γ", "", 0.01, abs(gamma / 0.1 - 1), seconds, f"γ = {gamma:.5f}"),
    ]


# discovery ------------------------------------------------------------------------------------------------------------


def discoveries() -> dict[str, tuple[HamiltonianSystem, np.ndarray, np.ndarray, dict[str, float]]]:
    """Systems with initial states, times, and the true coefficients of H."""
    random = np.random.default_rng(0)
    angle, a, e = random.uniform(0, 2 * np.pi, 50), random.uniform(0.8, 1.5, 50), random.uniform(0, 0.5, 50)
    r, v = a * (1 - e), np.sqrt((1 + e) / (1 - e) / a)
    orbits = np.stack([r * np.cos(angle), r * np.sin(angle), -v * np.sin(angle), v * np.cos(angle)], 1)
    wells = systems.henon_heiles()
    squares = {f"{x}{i}**2": 0.5 for x in "pq" for i in range(1, 5)}
    bonds = {f"(q{i} - q{i + 1})**4": 0.25 for i in range(1, 4)}
    plane = {"p1**2": 0.5, "p2**2": 0.5}
    hh = {"q1**2": 0.5, "q2**2": 0.5, "q1**2*q2": 1.0, "q2**3": -1 / 3}
    t = np.linspace(0.0, 10.0, 101)
    return {
        "Hénon–Heiles": (wells, wells.domain.sample(50, 0), t, plane | hh),
        "pendulum": (PENDULUM, PENDULUM.domain.sample(50, 0), t, {"p1**2": 0.5, "cos(q1)": -1.0}),
        "quartic chain of 4": (CHAIN, random.uniform(-1.2, 1.2, (25, 8)), t, squares | bonds),
        "Kepler": (KEPLER, orbits, np.linspace(0, 10, 201), plane | {"1/sqrt(q1**2 + q2**2)": -1.0}),
    }


def discovered(names: list[str], folder: Path | None, sigma: float = 0.01) -> list[list[str]]:
    """For each system the formula and the largest relative error of a coefficient; of the first the path, drawn."""
    rows = []
    for name, (system, y0, t, truth) in discoveries().items():
        if names and name not in names:
            continue
        noise = sigma * np.random.default_rng(1).normal(size=(len(y0), 2 * system.ndof, len(t)))
        y = solve(system, "kahan_li8", (0.0, float(t[-1])), y0, t_eval=t, dt=0.02).y
        found, seconds = timed(lambda y=y, t=t, noise=noise: discover((t, y + noise)))  # type: ignore[misc]
        record = found.discovery
        made = {str(f): c for f, c in zip(record.terms, record.coefficients, strict=True)}
        right = made.keys() == truth.keys()
        error = max((abs(made[f] / c - 1) for f, c in truth.items() if f in made), default=np.inf)
        counts = [f"{len(truth)} of {len(record.library)}", str(len(made)), "yes" if right else "no"]
        rows.append([name, *counts, f"{100 * error:.2g} %", f"{seconds:.0f}", f"`{record.formula()}`"])
        print(*rows[-1], sep=" | ", flush=True)
        print(record.table(), flush=True)
        if folder is not None and name == "Hénon–Heiles":
            record.figure().savefig(folder / "discovery_path.png", dpi=110)
    return rows


# sweeps ---------------------------------------------------------------------------------------------------------------

SWEEPS = {
    "noise ε": [(eps, 100, 50) for eps in (0.0, 0.005, 0.01, 0.02, 0.03, 0.04, 0.05)],
    "trajectories N": [(0.01, n, 50) for n in (10, 20, 50, 100, 200)],
    "times M": [(0.01, 100, m) for m in (5, 10, 20, 50, 100)],
}


def sweeps(folder: Path | None) -> list[list[str]]:
    """One-step errors of `learn` on the authors' oscillator against noise, trajectories and times."""
    from matplotlib.figure import Figure

    system = systems.harmonic_oscillator()
    figure = Figure(figsize=(9.0, 3.0), layout="constrained", facecolor="white")
    rows = []
    for ax, (label, cases) in zip(figure.subplots(1, 3), SWEEPS.items(), strict=True):
        points = []
        for eps, n, m in cases:
            data, held = authors_data(system, 1.2, eps, n, m, 0)
            truth = exact(system, held, np.array([0.0, 1.0]))[:, :, -1]
            flow, seconds = timed(lambda data=data: sympflow.learn(data, dt=1.0))  # type: ignore[misc]
            error = float(np.linalg.norm(predicted(flow, held, np.array([0.0, 1.0]))[:, :, -1] - truth, axis=1).mean())
            points.append(({"ε": eps, "N": n, "M": m}[label[-1]], error))
            rows.append([label, f"{eps:g}", str(n), str(m), fragments.number(error), f"{seconds:.0f}"])
            print(*rows[-1], sep=" | ", flush=True)
        x, y = np.array(points).T
        ax.plot(x, y, "o-", color="#D55E00")
        ax.set(xlabel=label, yscale="log", xscale="linear" if label[0] == "n" else "log")
        ax.grid(alpha=0.3, which="both")
    figure.axes[0].set_ylabel("one-step error at Δt = 1")
    if folder is not None:
        figure.savefig(folder / "learning_sweeps.png", dpi=110)
    return rows


# all of them ----------------------------------------------------------------------------------------------------------

PROTOCOLS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "authors-oscillator": lambda o: [authors(systems.harmonic_oscillator(), 1.2, eps, o) for eps in (0.0, 0.05)],
    "authors-henon-heiles": lambda o: [authors(systems.henon_heiles(), 1.0, eps, o) for eps in (0.0, 0.05)],
    "ghnn-pendulum": ghnn_pendulum,
    "ghnn-double-pendulum": ghnn_double_pendulum,
    "hnn-spring": lambda o: hnn("spring", o),
    "hnn-pendulum": lambda o: hnn("pendulum", o),
    "d-hnn": damped_spring,
}
TABLES = {
    "learning-authors": ("authors-oscillator", "authors-henon-heiles"),
    "learning-ghnn": ("ghnn-pendulum", "ghnn-double-pendulum"),
    "learning-hnn": ("hnn-spring", "hnn-pendulum", "d-hnn"),
}
"""Fragments, and the protocols in each."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=[*PROTOCOLS, "discovery", "sweeps"], default=None)
    parser.add_argument("--systems", nargs="+", default=[], help="of the discovery; all of them by default")
    parser.add_argument("--runs", type=int, default=100, help="training trajectories of the GHNN protocols")
    parser.add_argument("--baseline", type=float, default=60.0, help="least processor time of Adam, in seconds")
    parser.add_argument("--networks", action="store_true", help="an HNN of our own beside the published figures")
    fragments.add_out(parser)
    options = parser.parse_args()
    wanted = options.only or [*PROTOCOLS, "discovery", "sweeps"]
    figures = None if options.out is None else options.out.parent / "figures"
    for fragment, names in TABLES.items():
        rows = []
        for name in names:
            for row in PROTOCOLS[name](options) if name in wanted else ():
                rows.append(row.cells())
                print(*rows[-1], sep=" | ", flush=True)
        if rows:
            titles = ["protocol", "metric", "theirs", "target", "ours", "reached", "s", "model"]
            fragments.write(options.out, fragment, fragments.table(titles, rows), f"--only {' '.join(names)}")
    if "discovery" in wanted:
        titles = ["system", "true terms, of a library", "found", "these and no other", "largest error", "s", "H"]
        table = fragments.table(titles, discovered(options.systems, figures))
        fragments.write(options.out, "learning-discovery", table, "--only discovery")
    if "sweeps" in wanted:
        table = fragments.table(["sweep", "ε", "N", "M", "one-step error", "s"], sweeps(figures))
        fragments.write(options.out, "learning-sweeps", table, "--only sweeps")


if __name__ == "__main__":
    main()
