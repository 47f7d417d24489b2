"""The initial states of an ensemble: given, or drawn where they are needed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from sympflow.arguments import check_array, check_counts
from sympflow.hamiltonian.domain import Domain
from sympflow.hamiltonian.system import HamiltonianSystem
from sympflow.integrators.problems import check_y0
from sympflow.storage.identity import digest

DRAWN = 4096
"""States that a sampler draws at a time, from a seed and their number, so that no state depends on the chunks."""

MOST_DIGESTED = 1 << 20  # drawn states that are all compared, to know those of a store


@dataclass(frozen=True)
class Given:
    """Initial states (N, 2d) that were given."""

    y0: np.ndarray

    together: ClassVar[int] = 1  # states of which a chunk should be a multiple

    def __len__(self) -> int:
        return len(self.y0)

    def states(self, start: int, stop: int) -> np.ndarray:
        return self.y0[start:stop]

    @property
    def drawn(self) -> str:
        """How the states were drawn, in words that follow their number."""
        return ""

    def parts(self) -> tuple[Any, ...]:
        """The identity of the states for a store: all of them."""
        return (self.y0,)

    def sent(self, start: int, stop: int) -> Given:
        """The part that a worker needs for the states start … stop: these, numbered from 0."""
        return Given(self.y0[start:stop])


@dataclass(frozen=True)
class Drawn:
    """Initial states that a sampler draws, `DRAWN` at a time."""

    sampler: Any
    n: int
    seed: int
    width: int
    start: int = 0
    _last: dict[int, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    together: ClassVar[int] = DRAWN

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_last": {}}

    def __len__(self) -> int:
        return self.n

    def states(self, start: int, stop: int) -> np.ndarray:
        start, stop = self.start + start, self.start + stop
        out = np.empty((stop - start, self.width))
        for block in range(start // DRAWN, -(-stop // DRAWN)):
            low, high = max(start, block * DRAWN), min(stop, (block + 1) * DRAWN)
            states = self._last.get(block)
            if states is None:
                states = self._drawn(block)
                self._last.clear()  # but the last block, which small chunks share
                self._last[block] = states
            out[low - start : high - start] = states[low - block * DRAWN : high - block * DRAWN]
        return out

    def _drawn(self, block: int) -> np.ndarray:
        seeds = np.random.SeedSequence([self.seed, block])
        if isinstance(self.sampler, Domain):
            return self.sampler.sample(DRAWN, int(seeds.generate_state(1)[0]))
        states = np.asarray(self.sampler(np.random.default_rng(seeds), DRAWN))
        if states.shape != (DRAWN, self.width) or states.dtype.kind not in "fiu":
            raise ValueError(
                f"`y0` must draw real states of shape ({DRAWN}, {self.width}) when called with (rng, {DRAWN}); got "
                f"{states.dtype} of shape {states.shape}."
            )
        if not np.isfinite(states).all():
            raise ValueError("`y0` draws states that are not finite: correct the sampler.")
        return states

    @property
    def drawn(self) -> str:
        """How the states were drawn, in words that follow their number."""
        return f" by seed {self.seed}"

    def parts(self) -> tuple[Any, ...]:
        """The identity of the states for a store: all of them; of very many the sampler, and states among them."""
        blocks = np.arange(-(-self.n // DRAWN))
        most = MOST_DIGESTED // DRAWN
        spread = blocks if len(blocks) <= most else np.unique(np.linspace(0, len(blocks) - 1, most).astype(int))
        ends = ((k * DRAWN, min((k + 1) * DRAWN, self.n)) for k in spread.tolist())
        states = [digest(self.states(*part)) for part in ends]
        return (states,) if len(blocks) <= most else (states, self.sampler)

    def sent(self, start: int, stop: int) -> Drawn:
        """The part that a worker needs for the states start … stop: the sampler, and where to begin."""
        return Drawn(self.sampler, stop - start, self.seed, self.width, self.start + start, self._last)


def initial_states(system: HamiltonianSystem, y0: Any, n: Any, seed: Any) -> Given | Drawn:
    """The initial states that `y0`, `n` and `seed` mean."""
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"`seed` must be an integer, 0 or more; got {seed!r}.")
    if isinstance(y0, Domain) or (callable(y0) and not isinstance(y0, type)):
        if n is None:
            raise ValueError("`n` is needed: the number of states to draw from `y0`.")
        check_counts(n=n)
        drawn = Drawn(y0, int(n), int(seed), 2 * system.ndof)
        if isinstance(y0, Domain) and y0.sample(1).shape != (1, drawn.width):
            raise ValueError(f"`y0` must be a domain of states of length {drawn.width} for {system.name!r}.")
        return drawn
    if n is not None:
        raise ValueError("`n` is for drawing states: pass a domain or a sampler as `y0`, or leave it out.")
    check_array(y0, "an ensemble takes NumPy arrays")
    given = check_y0(system, system.y0 if y0 is None else y0, None)
    if given.ndim > 2:
        raise ValueError(f"`y0` must have shape (N, {given.shape[-1]}); got {given.shape}: reshape it.")
    return Given(np.atleast_2d(given))
