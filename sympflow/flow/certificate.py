"""A-posteriori statements on a flow: because its Hamiltonian 𝓗 is known, its energy error has a bound.

    |H(ψ_kΔt(x)) − H(x)| ≤ k δ,    δ = ∫₀^Δt sup_x |∇Hᵀ J ∇(𝓗 − H)|(ψ̄_t(x)) dt,

as long as the orbit is in Ω at every step: d/dt H(ψ̄_t(x)) = ∇Hᵀ J ∇𝓗, where ∇Hᵀ J ∇H = 0 drops out. The suprema
are estimates over seeded samples of Ω × [0, Δt]; beside them stand measured errors of held-out orbits.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

QUANTILE, CONFIDENCE = 0.95, 0.99  # of the energy errors, and that its limit is one


def upper_limit(values: np.ndarray, quantile: float = QUANTILE, confidence: float = CONFIDENCE) -> float:
    """Return an upper confidence limit of a quantile of |values|, an order statistic; NaN counts as infinite.

    It holds for any distribution (Conover, Practical Nonparametric Statistics, 1999, 3.2).
    """
    from scipy.stats import binom

    ordered = np.sort(sizes(values))
    return float(ordered[min(int(binom.ppf(confidence, len(ordered), quantile)), len(ordered) - 1)])


def sizes(values: np.ndarray) -> np.ndarray:
    """|values|, and infinity for NaN."""
    return np.where(np.isnan(values), math.inf, np.abs(values))


@dataclass(frozen=True)
class Quantiles:
    """Median, 95 % quantile and largest of |values| over a sample."""

    median: float
    q95: float
    largest: float

    @classmethod
    def of(cls, values: np.ndarray) -> Quantiles:
        """Return those of some values; NaN counts as infinite."""
        # never interpolated, which would make NaN of infinities
        return cls(*(float(np.quantile(sizes(values), level, method="higher")) for level in (0.5, 0.95, 1.0)))


@dataclass(frozen=True)
class Certificate:
    """Figures estimated of a flow on Ω × [0, Δt], and measured on held-out orbits; an estimate, not a proof.

    Attributes
    ----------
    system : str
    dt : float
        Δt.
    states, times, seed : int
        The sample: seeded states of Ω, equidistant times in [0, Δt].
    defect : Quantiles
        ‖d/dt ψ̄_t(x) − J∇H(ψ̄_t(x))‖ over the sample.
    hamiltonian_error : Quantiles
        |𝓗(t, x) − H(x) − c(t)| over the sample, c(t) the mean over Ω; the largest estimates the supremum.
    delta : Quantiles
        ∫₀^Δt |∇Hᵀ J ∇(𝓗 − H)| dt by the trapezoidal rule, at each time the quantile over the states; the largest is δ,
        for which the worst states of each time are followed to worse ones nearby in Ω: the largest that was found.
    held_out : int
        Number of held-out states, of another seed.
    t_end : float
        T, to which their orbits were followed.
    one_step_error : Quantiles
        ‖ψ̄_Δt(x) − φ_H,Δt(x)‖ at the held-out states, φ by DOP853 at 1e-12.
    energy_error, relative_energy_error : Quantiles
        Over the held-out states, the largest |H(ψ_t x) − H(x)| up to T, or up to where the orbit leaves Ω, at the steps
        and at one time between every two; relative to the system's `energy_scale`, else to |H(x)|.
    left : int
        Number of orbits that left Ω before T.
    weights : str
        Checksum of the weights that this holds for.
    relative_limit : float or None
        An upper 99 % confidence limit of the 95 % quantile of the relative energy error over Ω (see `upper_limit`);
        None if it was not computed.
    """

    system: str
    dt: float
    states: int
    times: int
    seed: int
    defect: Quantiles
    hamiltonian_error: Quantiles
    delta: Quantiles
    held_out: int
    t_end: float
    one_step_error: Quantiles
    energy_error: Quantiles
    relative_energy_error: Quantiles
    left: int
    weights: str
    relative_limit: float | None = None

    def bound(self, t: float) -> float:
        """kδ, k = ⌈|t|/Δt⌉: an estimate of the largest change of H over a time t while the orbit is in Ω."""
        return math.ceil(abs(t) / self.dt * (1 - 1e-12)) * self.delta.largest

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)

    @classmethod
    def from_dict(cls, description: dict[str, Any]) -> Certificate:
        """The certificate that `to_dict` described; None stands for values that are not finite.

        Raises
        ------
        ValueError
            If the description is not that of a certificate.
        """
        if isinstance(description, dict):
            description = {"relative_limit": None, **description}
        if not isinstance(description, dict) or set(description) != {f.name for f in fields(cls)}:
            raise ValueError(
                "`description` is not the description of a certificate: compute it again by flow.certificate(system)."
            )
        return cls(**{f.name: _checked(f.name, str(f.type), description[f.name]) for f in fields(cls)})

    def __str__(self) -> str:
        rows = (
            ("defect ‖dψ̄/dt − J∇H‖", self.defect),
            ("|𝓗 − H − c(t)|", self.hamiltonian_error),
            ("energy gained in a step, estimate", self.delta),
            (f"one-step error at Δt = {self.dt:g}", self.one_step_error),
            (f"|H − H₀| up to T = {self.t_end:g}", self.energy_error),
            ("the same, relative", self.relative_energy_error),
        )
        table = [f"{'':36}{'median':>10}{'95 %':>10}{'largest':>10}"]
        table += [f"{name:36}{q.median:10.1e}{q.q95:10.1e}{q.largest:10.1e}" for name, q in rows]
        left = f"; {self.left} of them left Ω" if self.left else ""
        return "\n".join(
            (
                f"Certificate of a flow of {self.system}: estimates, no proof",
                f"upper half: {self.states} states of Ω at {self.times} times in [0, {self.dt:g}] (seed {self.seed}); "
                f"lower half: {self.held_out} held-out states{left}",
                *table,
                f"estimated bound on |H − H₀| at T, while in Ω: {self.bound(self.t_end):.1e} (δ: the largest found)",
            )
        )


def _checked(name: str, kind: str, value: Any) -> Any:
    """The value of a field of that kind; else it is refused."""
    if kind == "Quantiles":
        if not isinstance(value, dict) or set(value) != {q.name for q in fields(Quantiles)}:
            raise ValueError(f"`description` has a {name} that is not made of quantiles: {value!r}.")
        return Quantiles(**{q: _number(q, math.inf if v is None else v) for q, v in value.items()})
    if kind.startswith("float"):
        return None if value is None and "None" in kind else _number(name, value)
    if type(value).__name__ != kind:
        raise ValueError(f"`description` has a {name} that is not of type {kind}: {value!r}.")
    return value


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0:
        raise ValueError(f"`description` has a {name} that is not a number: {value!r}.")
    return float(value)
