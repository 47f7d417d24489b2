"""Pictures of a learned flow together with held-out trajectories."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from sympflow.flow.flow_map import FlowMap
from sympflow.learning.trajectories import Trajectories

DRAWN = 3  # trajectories
FINE = 200  # points of a line


def held_out_figure(flow: FlowMap, held: Trajectories) -> Any:
    """Predictions of a learned flow, held-out trajectories, and H along both.

    A prediction starts at the first state that was observed, with its noise.

    Parameters
    ----------
    flow : FlowMap
        One that `sympflow.learn` made.
    held : Trajectories

    Returns
    -------
    matplotlib.figure.Figure
    """
    from matplotlib.figure import Figure

    system = flow.system
    if system is None:
        raise ValueError("`flow` brings no system: pass one that sympflow.learn made.")
    figure = Figure(figsize=(9, 6), layout="constrained")
    above, below = figure.subplots(2, 1)
    for color, run in enumerate(held.runs[:DRAWN]):
        whole = np.isfinite(run.y).all(axis=0)
        t, y = run.t[whole], run.y[:, whole]
        times = torch.linspace(0.0, t[-1] - t[0], FINE, dtype=torch.float64)
        states = flow(times, torch.as_tensor(y[:, 0]).expand(FINE, -1)).numpy()
        above.plot(t, y[0], ".", color=f"C{color}")
        above.plot(t[0] + times, states[:, 0], color=f"C{color}", lw=1)
        below.plot(t, system.hamiltonian(y.T), ".", color=f"C{color}")
        below.plot(t[0] + times, system.hamiltonian(states), color=f"C{color}", lw=1)
    above.set(ylabel=held.names[0], title="Held-out trajectories, and predictions from their first states")
    below.set(xlabel="t", ylabel="learned H")
    return figure
