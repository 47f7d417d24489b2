"""Flows that ship without torch: the numbers of a file that compiled runs read, of primed flows and of networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from sympflow.arrays import untransformed
from sympflow.flow.known import KnownFlow
from sympflow.flow.records import Provenance, numbers_checksum, read
from sympflow.flow.tables import PrimedShape, Tables, free_numbers
from sympflow.hamiltonian.lattice_states import DRAWN, LatticeStates
from sympflow.hamiltonian.monomials import Monomials
from sympflow.hamiltonian.system import HamiltonianSystem

if TYPE_CHECKING:
    from sympflow.flow.loops import PrimedFlowKernel
    from sympflow.hamiltonian.local import LocalHamiltonian
    from sympflow.kernels.networks import NetworkLayer
    from sympflow.kernels.protocol import Kernel

WORSE = 2.0
"""Times the energy error of a ring that a lattice with ends may have for the numbers of a flow to hold there."""


class PrimedKnown(KnownFlow):
    """A primed flow, as far as it is known without its map: its table, and its system."""

    symplectic = takes_friction = takes_driving = True
    shape: PrimedShape

    @property
    def tables(self) -> Tables:
        """The tables of the numbers that the flow has now."""
        raise NotImplementedError

    @property
    def monomials(self) -> Monomials:
        return self.shape.monomials

    def evaluations(self, n_steps: int, n_saved: int, n_extra: int, backend: str) -> dict[str, int]:
        return self.tables.evaluations(n_steps, n_saved, n_extra, backend)

    def kernel_for(self, system: HamiltonianSystem, compensated: bool = False) -> Kernel:
        tables = self.tables
        if tables.kernel is not None and tables.kernel.system is system and not compensated:
            return tables.kernel
        self.check_compilable()
        made = self._compiled_for(system, compensated)
        if not compensated:
            tables.kernel = made
        return made

    def _compiled_for(self, system: HamiltonianSystem, compensated: bool) -> PrimedFlowKernel:
        from sympflow.flow.loops import PrimedFlowKernel

        return PrimedFlowKernel(self.tables, system, compensated)

    def check_compilable(self) -> None:
        """Raise a ValueError unless the numbers of the flow are float64 on the CPU, which compiled loops need."""

    # its system ---------------------------------------------------------------------------------------------

    def known_by(self, system: HamiltonianSystem) -> HamiltonianSystem:
        of_one_size = self.monomials or (self.fingerprint is not None and not self.lattice_terms)
        return system if of_one_size else system.few_sites

    @property
    def kept_ndof(self) -> int:
        return self.ndof if self.system is None else self.known_by(self.system).ndof

    def of_size(self, system: HamiltonianSystem) -> Self:
        """Return this flow for a system of its kind: carried to another size where that is a lattice of one."""
        mine, theirs = None if self.system is None else self.system.local, system.local
        if mine is theirs or mine is None or theirs is None or _size(mine) == _size(theirs):
            return self
        tables = self.tables
        if tables.carried is None or tables.carried.system is not system:
            tables.carried = self.carried(system)
        return tables.carried

    def carried(self, system: HamiltonianSystem) -> Self:
        """This flow for another size of its system, with its records."""
        raise NotImplementedError

    def provenance_for(self, system: HamiltonianSystem) -> Provenance:
        """Return the provenance of the flow for another size of its system."""
        domain = self.domain
        if isinstance(domain, LatticeStates):
            domain = domain.of(system)
        elif domain is not None:
            assert self.system is not None
            domain = LatticeStates.of_states(self.system, domain.sample(DRAWN)).of(system)
        return replace(self.provenance, domain=domain)

    def check_ends(self, system: HamiltonianSystem) -> None:
        if system.local is None:
            return
        ring = self.figures.get("ends_periodic")
        for end in dict.fromkeys(system.local.ends):
            error = self.figures.get(f"ends_{end}")
            if ring is None or error is None or error <= WORSE * ring:
                continue
            raise ValueError(
                f"`system` {system.name!r} has {end} ends, at which bonds are missing and the numbers of this "
                f"flow hold less: a relative energy error of {error:.1e} was measured on a few sites with such "
                f"ends, {ring:.1e} on a ring. Fit one by sympflow.train(system)."
            )

    @property
    def driven(self) -> bool:
        return self.system is not None and not self.system.autonomous

    @property
    def period(self) -> float | None:
        return None if self.system is None else self.system.period


class FrozenColumn(NamedTuple):
    """Numbers of a table as they are in a file: see `sympflow.flow.coefficients.Coefficients`."""

    numbers: np.ndarray
    exponents: tuple[int, ...]


class FrozenFlow(PrimedKnown):
    """A primed flow from a file of our own, for compiled runs of NumPy states; everything else is done by `thawed`."""

    kind = "sympflow"

    def __init__(
        self, path: Path, shape: PrimedShape, tables: Tables, system: HamiltonianSystem, provenance: Provenance
    ) -> None:
        self.ndof, self.shape, self.dt, self.path = system.ndof, shape, tables.dt, path
        self._tables, self._system = tables, system
        self.provenance = provenance

    @classmethod
    def of_file(cls, path: Path, system: HamiltonianSystem) -> Self:
        """Read a flow that ships, of that system."""
        record, arrays = _read(path)
        plan, ndof = record["architecture"]["primed"], record["architecture"]["ndof"]
        shape = PrimedShape.from_dict(plan, ndof)
        tables = _tables(shape, record["dt"], arrays)
        flow = cls(path, shape, tables, system, Provenance.of_record(record, ndof))
        flow.check_system(system)
        if isinstance(flow.domain, LatticeStates):
            flow.domain = flow.domain.of(system)
        return flow

    @property
    def tables(self) -> Tables:
        return self._tables

    @property
    def system(self) -> HamiltonianSystem:
        return self._system

    @cached_property
    def thawed(self) -> Any:
        """The flow itself, a module of torch."""
        return _thawed(self.path, self._system)

    def bound(self, system: HamiltonianSystem) -> Self:
        return self.of_size(system)

    def carried(self, system: HamiltonianSystem) -> Self:
        tables = Tables(self._tables.substeps, len(self.shape.outer), self.dt, self.monomials)
        return type(self)(self.path, self.shape, tables, system, self.provenance_for(system))


class FrozenNetwork(KnownFlow):
    """A SympFlow of networks from a file of our own, for compiled runs; everything else is done by `thawed`."""

    kind = "sympflow"
    symplectic = True

    def __init__(self, path: Path, dt: float, layers: Sequence[NetworkLayer], provenance: Provenance) -> None:
        self.ndof, self.dt, self.path, self._layers = layers[0].K.shape[1], dt, path, layers
        self.provenance = provenance

    @classmethod
    def of_file(cls, path: Path, system: HamiltonianSystem) -> Self | None:
        """Read a flow that ships, of that system; None unless it is a flow of networks."""
        from sympflow.kernels.networks import NetworkLayer

        record, arrays = _read(path)
        plans = record["architecture"].get("layers", [])
        if not plans or any(plan["potential"]["type"] != "mlp" for plan in plans):
            return None
        layers = []
        for i, plan in enumerate(plans):
            start = f"layers.{i}.potential."
            of = {name.removeprefix(start): a.astype(float) for name, a in arrays.items() if name.startswith(start)}
            n = len(plan["potential"]["hidden"])
            first = plan["kind"] == "kick", plan["potential"]["activation"]
            K, k = of["weight_x"] / of["scale"], of["weight_t"] / of["tau"]
            biases, weights = ([of[f"{name}.{j}"] for j in range(m)] for name, m in (("biases", n), ("weights", n - 1)))
            layers.append(NetworkLayer(*first, K, k, biases, weights, of["gain"] * of["weight_out"]))
        flow = cls(path, record["dt"], layers, Provenance.of_record(record, record["architecture"]["ndof"]))
        flow.check_system(system)
        return flow

    def _loops_for(self, system: HamiltonianSystem) -> Kernel:
        return self._kernel

    @cached_property
    def _kernel(self) -> Kernel:
        from sympflow.kernels.networks import MLPFlowKernel

        return MLPFlowKernel(self.ndof, self._layers)

    @cached_property
    def thawed(self) -> Any:
        return _thawed(self.path)


def _read(path: Path) -> tuple[dict[str, Any], Mapping[str, np.ndarray]]:
    """Return the record and the arrays of a file; a ValueError says that it is damaged."""
    from safetensors.numpy import load

    try:
        content, _, record, altered = read(path)
        arrays: Mapping[str, np.ndarray] = load(content)
    except Exception as error:  # of whatever kind the reader raises
        raise _damaged(path) from error
    if altered or numbers_checksum(arrays) != record.get("checksum"):
        raise _damaged(path)
    return record, arrays


def _damaged(path: Path) -> ValueError:
    return ValueError(f"`flow` {path.stem!r}, which ships with the package, is damaged: install the package again.")


def _thawed(path: Path, system: HamiltonianSystem | None = None) -> Any:
    from sympflow.flow.files import load

    with untransformed():  # what is kept must not be a tensor of a transform that ends
        return load(path, system=system)


def _tables(shape: PrimedShape, dt: float, arrays: Mapping[str, np.ndarray]) -> Tables:
    """The tables of a flow whose free numbers are arrays of a file."""

    def columns(inside: bool) -> Any:
        def column(name: str, n: int, exponents: tuple[int, ...], power: int, *given: Any) -> FrozenColumn:
            _, basis, offset = free_numbers(n, len(exponents), *given)
            free = arrays[f"{'' if inside else 'processor_'}{name}.free"]
            return FrozenColumn(offset + basis @ free.astype(float), exponents)

        return shape.columns(inside, column)

    inside, outside = columns(True), columns(False)
    return Tables(shape.substeps(inside, outside), len(shape.outer), dt, shape.monomials)


def _size(local: LocalHamiltonian) -> tuple[Any, ...]:
    return local.shape, local.ends, local.ndof
