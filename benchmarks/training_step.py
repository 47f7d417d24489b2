"""A residual training step, closed form against double autodiff of the same network.

    python benchmarks/training_step.py

One step is the loss L1 at 700 points and its gradient in all the weights, for L = 3 pairs with potentials of two
hidden layers of 10 (the published architecture), float64, one thread. "Double autodiff" is the published way: each V
a stack of torch linear layers on [x, t], ∇V by autograd inside every layer, d/dt of the map by autograd of each of
its components, and the gradient of all that. The second baseline is better than anything published: the array layout
of this package, and d/dt by a double reverse pass whatever the number of components. All must give the same loss and
gradient, or the benchmark fails. They are timed in turn, in rounds, and the median of the rounds counts.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from measuring import fragments
from torch import Tensor
from torch.nn.functional import linear

from sympflow import HamiltonianSystem, SympFlow
from sympflow.flow.layers import Kick
from sympflow.flow.potentials import MLPPotential
from sympflow.flow.scaling import Scaling
from sympflow.systems import harmonic_oscillator, henon_heiles
from sympflow.training.losses import Loss
from sympflow.training.points import Points, PointSource

Value = Callable[[MLPPotential, Tensor, Tensor], Tensor]


def published_value(V: MLPPotential, t: Tensor, x: Tensor) -> Tensor:
    """V(t, x) of x (N, d), as a stack of linear layers."""
    h = torch.cat([x, t[:, None]], 1)
    weights = [torch.cat([V.weight_x, V.weight_t[:, None]], 1), *V.weights]
    for W, b in zip(weights, V.biases, strict=True):
        h = torch.tanh(linear(h, W, b))
    return linear(h, V.weight_out[None])[:, 0]


def columns_value(V: MLPPotential, t: Tensor, x: Tensor) -> Tensor:
    """V(t, x) of x (N, d), by columns."""
    return V.value(t, x.T)


def gradient(V: Tensor, x: Tensor) -> Tensor:
    return torch.autograd.grad(V.sum(), x, create_graph=True)[0]


def autodiff_map(flow: SympFlow, value: Value, t: Tensor, x: Tensor) -> Tensor:
    """ψ̄_t(x) with ∇V by autograd: t (N,), x (N, 2d)."""
    q, p = x.chunk(2, -1)
    for layer in flow.layers:
        z = q if isinstance(layer, Kick) else p
        V_t, V_0 = value(layer.potential, t, z), value(layer.potential, torch.zeros_like(t), z)
        g = gradient(V_t, z) - gradient(V_0, z)
        q, p = (q, p - g) if isinstance(layer, Kick) else (q + g, p)
    return torch.cat([q, p], -1)


def mean_square(system: HamiltonianSystem, y: Tensor, velocity: Tensor) -> Tensor:
    return (velocity - system.vector_field(y)).square().sum(-1).mean()


def double_autodiff(flow: SympFlow, system: HamiltonianSystem, points: Points) -> Tensor:
    t, x = (each.detach().requires_grad_() for each in points.residual)
    y = autodiff_map(flow, published_value, t, x)
    velocity = [torch.autograd.grad(y_i.sum(), t, create_graph=True)[0] for y_i in y.unbind(-1)]
    return mean_square(system, y, torch.stack(velocity, -1))


def better_double_autodiff(flow: SympFlow, system: HamiltonianSystem, points: Points) -> Tensor:
    t, x = (each.detach().requires_grad_() for each in points.residual)
    y = autodiff_map(flow, columns_value, t, x)
    # uᵀ∂_ty is linear in u, so its derivative in u is ∂_ty: two reverse passes in place of one a component.
    u = torch.ones_like(y, requires_grad=True)
    (along_u,) = torch.autograd.grad(y, t, u, create_graph=True)
    (velocity,) = torch.autograd.grad(along_u.sum(), u, create_graph=True)
    return mean_square(system, y, velocity)


def step_time(step: Callable[[], Tensor], flow: SympFlow, repeats: int) -> float:
    begin = time.perf_counter()
    for _ in range(repeats):
        flow.zero_grad(set_to_none=True)
        step().backward()
    return (time.perf_counter() - begin) / repeats


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=700)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=9)
    fragments.add_out(parser)
    options = parser.parse_args()
    rows = []
    torch.set_num_threads(1)
    print(f"{'system':<22}{'way':<34}{'ms a step':>10}{'times slower':>14}")
    for system in (harmonic_oscillator(), henon_heiles()):
        d = system.ndof
        flow = SympFlow(d, options.pairs)
        assert system.domain is not None
        source = PointSource(system.domain, 1.0, options.points, 10, 0, torch.float64, torch.device("cpu"))
        points, loss = source(0), Loss(system, Scaling.unit(d), 1.0, 0.0)
        ways: dict[str, Callable[[], Tensor]] = {
            "closed form": lambda loss=loss, flow=flow, points=points: loss(flow, points),
            "double autodiff": lambda flow=flow, system=system, points=points: double_autodiff(flow, system, points),
            "double autodiff, improved": lambda flow=flow, system=system, points=points: better_double_autodiff(
                flow, system, points
            ),
        }
        results = {}
        for name, way in ways.items():
            flow.zero_grad(set_to_none=True)
            value = way()
            value.backward()
            results[name] = torch.cat([value.detach()[None], *(w.grad.reshape(-1) for w in flow.parameters())])
        for name, result in results.items():
            torch.testing.assert_close(result, results["closed form"], rtol=1e-9, atol=1e-12, msg=name)
        rounds = [{name: step_time(way, flow, 5) for name, way in ways.items()} for _ in range(options.rounds)]
        medians = {name: statistics.median(r[name] for r in rounds) for name in ways}
        for name, seconds in medians.items():
            ratio = seconds / medians["closed form"]
            rows.append((system.name, name, f"{1e3 * seconds:.2f}", f"{ratio:.1f}"))
            print(f"{system.name:<22}{name:<34}{1e3 * seconds:>10.2f}{ratio:>14.1f}")
    titles = ("system", "way", "ms a step", "times slower")
    fragments.write(options.out, "training-step", fragments.table(titles, rows))


if __name__ == "__main__":
    main()
