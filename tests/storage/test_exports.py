"""Results as data elsewhere: Datasets, tables and files hold the numbers, and say by what they were made."""

import json
import sys
from importlib.util import find_spec

import numpy as np
import pytest

import sympflow
from sympflow.hamiltonian.domain import Box

needs_data = pytest.mark.skipif(
    find_spec("xarray") is None or find_spec("pandas") is None, reason="the extra data is not installed"
)
OSCILLATOR = sympflow.HamiltonianSystem.from_sympy(
    "p1**2/2 + p2**2/2 + k*(q1**2 + q2**2)/2 + q1**2*q2", params={"k": 1.0}, dt=0.1, name="oscillator"
)
STATES = Box([-0.1] * 4, [0.1] * 4).sample(6, 1).reshape(2, 3, 4)
TIMES = [0.0, 0.5, 1.0]


def solved(y0=STATES, **how):
    return sympflow.solve(OSCILLATOR, "verlet", (0, 1), y0, t_eval=TIMES, **how)


@needs_data
def test_a_dataset_holds_the_solution():
    sol = solved(params={"k": [1.0, 2.0, 3.0]})
    data = sol.to_xarray()
    assert data.q.dims == data.p.dims == ("orbit_0", "orbit_1", "dof", "time")
    assert np.array_equal(np.concatenate([data.q, data.p], axis=-2), sol.y)
    assert np.array_equal(np.concatenate([data.q0, data.p0], axis=-1), STATES)
    assert data.dof.values.tolist() == [1, 2]
    assert np.array_equal(data.time, sol.t)
    assert np.array_equal(data.energy, sol.energy())
    assert data.k.dims == ("orbit_0", "orbit_1")
    assert data.k[1].values.tolist() == [1, 2, 3]
    assert data.status.shape == (2, 3)
    assert not data.status.any()
    assert all(isinstance(value, str | int | float | list) for value in data.attrs.values())
    told = data.attrs
    assert told["sympflow_version"] == sympflow.__version__
    assert (told["system"], told["method"], told["t_span"]) == ("oscillator", "verlet", [0.0, 1.0])
    assert "k*(q1**2 + q2**2)/2" in told["hamiltonian"]
    assert json.loads(told["params"]) == {"k": 1.0}
    assert "clock='physical'" in told["options"]
    assert (told["backend"], told["dt"], told["message"]) == ("compiled", 0.1, sol.message)
    assert "flow_checksum" not in told
    assert "units" not in data.time.attrs
    assert "energy" not in sol.to_xarray(energy=False)


@needs_data
@pytest.mark.filterwarnings("ignore::UserWarning")  # of zarr, about the names that it gives to formats
def test_files_give_the_same_back(tmp_path):
    import xarray as xr

    data = solved(params={"k": [1.0, 2.0, 3.0]}).to_xarray()
    solved(params={"k": [1.0, 2.0, 3.0]}).to_netcdf(tmp_path / "a.nc")
    data.to_zarr(tmp_path / "a.zarr")
    with xr.open_dataset(tmp_path / "a.nc") as netcdf, xr.open_zarr(tmp_path / "a.zarr") as zarr:
        assert netcdf.equals(data)
        assert zarr.identical(data)
        assert netcdf.attrs["hamiltonian"] == data.attrs["hamiltonian"]
        assert netcdf.time.dtype == float


@needs_data
def test_tables_have_a_row_for_each_time():
    sol = solved(params={"k": [1.0, 2.0, 3.0]})
    table = sol.to_dataframe()
    assert [*table] == ["orbit_0", "orbit_1", "time", "k", "q1", "q2", "p1", "p2", "energy", "status"]
    assert len(table) == 2 * 3 * 3
    row = table[(table.orbit_0 == 1) & (table.orbit_1 == 2) & (table.time == 0.5)].iloc[0]
    assert np.array_equal(row[["q1", "q2", "p1", "p2"]], sol.y[1, 2, :, 1])
    assert row.k == 3
    assert row.energy == sol.energy()[1, 2, 1]
    single = solved(STATES[0, 0]).to_dataframe(energy=False)
    assert [*single] == ["time", "q1", "q2", "p1", "p2"]
    assert single.attrs["method"] == "verlet"


@pytest.mark.parametrize("library", ["xarray", "pandas", "zarr"])
def test_a_missing_library_is_asked_for(monkeypatch, tmp_path, library):
    sol, how = solved(), {"reduce": "final", "dt": 0.1}
    result = sympflow.ensemble(OSCILLATOR, "verlet", (0, 1), STATES[0], **how)
    stored = sympflow.ensemble(OSCILLATOR, "verlet", (0, 1), STATES[0], store=tmp_path / "a.zarr", **how)
    calls = {"xarray": [sol.to_xarray, result.to_xarray], "pandas": [sol.to_dataframe, result.to_dataframe]}
    monkeypatch.setitem(sys.modules, library, None)
    for call in calls.get(library, [stored.to_xarray]):
        with pytest.raises(ImportError, match=rf"{call.__name__}\(\) needs {library}: pip install {library}"):
            call()
    with pytest.raises(TypeError, match="`energy` must be True or False"):
        sol.to_xarray(energy="no")


@needs_data
def test_tables_of_ensembles():
    how = {"params": {"k": [1.0, 2.0]}}
    states = STATES.reshape(6, 4)
    result = sympflow.ensemble(OSCILLATOR, "verlet", (0, 1), states, t_eval=TIMES, **how)
    table = result.to_dataframe()
    assert [*table] == ["k", "orbit", "time", "q1", "q2", "p1", "p2", "status"]
    assert np.array_equal(table[table.k == 2].q2.to_numpy().reshape(6, 3), result.y[1, :, 1])
    ends = sympflow.ensemble(OSCILLATOR, "verlet", (0, 1), states, reduce="final", **how).to_dataframe()
    assert [*ends] == ["k", "orbit", *("q1", "q2", "p1", "p2"), "status", *("q1_0", "q2_0", "p1_0", "p2_0")]
    assert np.array_equal(ends.q1_0, np.tile(states[:, 0], 2))
    own = sympflow.ensemble(
        OSCILLATOR, "verlet", (0, 1), states, reduce=lambda t, y: {"low": y.min(), "ends": y[:2, [0, -1]]}
    ).to_dataframe()
    assert [*own][:6] == ["orbit", "low", "ends_0_0", "ends_0_1", "ends_1_0", "ends_1_1"]
    assert np.array_equal(own.ends_0_0, states[:, 0])


@needs_data
def test_driven_damped_and_trained_systems_say_so():
    driven = sympflow.HamiltonianSystem.from_sympy(
        "p**2/2 + q**2/2 - A*q*cos(t)", time="t", params={"A": 0.3}, damping=0.2, dt=0.1
    )
    sol = sympflow.solve(driven, "verlet", (0, 1), [1.0, 0.0])
    data = sol.to_xarray()
    assert data.attrs["damping"] == "0.2"
    assert np.array_equal(data.energy, [driven.hamiltonian(y, t) for y, t in zip(sol.states, sol.t, strict=True)])
    scene = sympflow.systems.henon_heiles()
    told = sympflow.solve(scene, "sympflow", (0, 1), [0.1] * 4).to_xarray().attrs
    assert len(told["flow_checksum"]) == 64
    assert told["method"] == "sympflow"
