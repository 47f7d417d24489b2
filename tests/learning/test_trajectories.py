"""Trajectories from arrays, tables, Datasets and results: read alike, and refused by name."""

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sympflow
from sympflow.learning.trajectories import Trajectories
from sympflow.systems import henon_heiles, pendulum

t = np.linspace(0.0, 1.0, 6)
RUN = np.stack([np.cos(t), -np.sin(t)])
FOUR = np.arange(24.0).reshape(4, 6)


def assert_same(read, runs):
    assert len(read.runs) == len(runs)
    for one, (times, states) in zip(read.runs, runs, strict=True):
        np.testing.assert_array_equal(one.t, times)
        np.testing.assert_array_equal(one.y, states)


def test_lists_pairs_and_ends_are_the_same_trajectories():
    irregular = [(t, RUN), (t[:3], RUN[:, :3])]
    assert_same(Trajectories.read(irregular), irregular)
    assert_same(Trajectories.read([irregular[0]]), irregular[:1])
    assert_same(Trajectories.read((t, RUN)), [(t, RUN)])
    assert_same(Trajectories.read((t, np.stack([RUN, 2 * RUN]))), [(t, RUN), (t, 2 * RUN)])
    x, y = np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[5.0, 6.0], [7.0, 8.0]])
    ends = Trajectories.read((x, [0.5, -0.5], y))
    assert_same(ends, [([0, 0.5], [[1, 5], [2, 6]]), ([-0.5, 0], [[7, 3], [8, 4]])])  # the second runs backward
    assert_same(Trajectories.read(ends), [(run.t, run.y) for run in ends.runs])
    assert (repr(ends).split("\n")[0], ends.n_points) == ("2 trajectories", 4)


def test_missing_values_stay_missing_and_empty_points_go():
    y = RUN.copy()
    y[0, 1] = np.nan
    y[:, 3] = np.nan
    read = Trajectories.read((t, y))
    assert_same(read, [(t[[0, 1, 2, 4, 5]], y[:, [0, 1, 2, 4, 5]])])
    assert (read.n_values, read.n_points, len(read.states)) == (9, 5, 4)
    np.testing.assert_array_equal(Trajectories.read((t, np.ma.masked_invalid(y))).runs[0].y, read.runs[0].y)


def test_results_of_solvers_are_read():
    system = pendulum()
    states = np.array([[1.0, 0.0], [0.5, 0.2]])
    sol = sympflow.solve(system, "verlet", (0, 1), states, t_eval=t)
    assert_same(Trajectories.read(sol), [(t, sol.y[0]), (t, sol.y[1])])
    assert_same(Trajectories.read([sol, sol]), [(t, y) for y in (*sol.y, *sol.y)])
    result = sympflow.ensemble(system, "verlet", (0, 1), states, t_eval=t)
    assert_same(Trajectories.read(result), [(t, y) for y in result.y])
    scipy = solve_ivp(system, (0, 1), [1.0, 0.0], t_eval=t)
    assert_same(Trajectories.read(scipy), [(t, scipy.y)])


TIMES, BOTH = np.stack([t, 2 * t]), np.stack([RUN, 2 * RUN])
SAME, EACH = [(t, RUN), (t, 2 * RUN)], [(t, RUN), (2 * t, 2 * RUN)]
PADDED = np.where(np.arange(6) < 4, TIMES, [[1], [np.nan]] * TIMES)


@pytest.mark.parametrize(
    ("data", "options", "runs"),
    [
        ((TIMES, BOTH), {}, EACH),
        ((PADDED, BOTH), {}, [(t, RUN), (2 * t[:4], 2 * RUN[:, :4])]),
        ({"t": t, "y": BOTH}, {}, SAME),
        ({"time": TIMES, "y": BOTH}, {}, EACH),
        ({"t": TIMES, "q": BOTH[:, 0], "p": BOTH[:, 1]}, {}, EACH),
        ({"t": t, "q": BOTH[:, :1], "p": BOTH[:, 1:], "k": 3.0}, {}, SAME),
        ({"t": t, "q": BOTH[:, 0], "p": BOTH[:, 1]}, {"ndof": 1}, SAME),
        ({"t": t, "q": FOUR[:2], "p": FOUR[2:]}, {"ndof": 2}, [(t, FOUR)]),
        ((BOTH[:, :, 0], [[0.5], [0.5]], BOTH[:, :, 1]), {}, [([0, 0.5], y[:, :2]) for y in BOTH]),
    ],
)
def test_each_trajectory_has_its_times_and_arrays_have_names(data, options, runs, tmp_path):
    assert_same(Trajectories.read(data, **options), runs)
    if isinstance(data, dict):
        np.savez(tmp_path / "runs.npz", **data)
        assert_same(Trajectories.read(tmp_path / "runs.npz", **options), runs)


@pytest.mark.parametrize(("ending", "by"), [(".csv", ","), (".txt", " "), (".tsv", "\t")])
def test_files_without_names_are_refused_unless_a_comment_has_them(tmp_path, ending, by):
    pytest.importorskip("pandas")
    path = tmp_path / f"runs{ending}"
    np.savetxt(path, np.column_stack([t, *RUN]), delimiter=by)
    with pytest.raises(ValueError, match=r"^`data` names .* numbers in place of the names .* t,q1,p1"):
        Trajectories.read(path)
    for comments in ("# ", ""):
        np.savetxt(path, np.column_stack([t, *RUN]), delimiter=by, header=by.join("tqp"), comments=comments)
        assert_same(Trajectories.read(path), [(t, RUN)])


def no_engine(path):
    raise ImportError("Unable to find a usable engine")


def test_tables_and_datasets_are_read_by_their_names(tmp_path, monkeypatch):
    pd, xr = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    sol = sympflow.solve(henon_heiles(), "verlet", (0, 1), np.full((2, 4), 0.1) * [[1], [2]], t_eval=t)
    runs = [(t, y) for y in sol.y]
    assert_same(Trajectories.read(sol.to_xarray()), runs)
    table = sol.to_dataframe()
    assert_same(Trajectories.read(table), runs)
    assert_same(Trajectories.read(table[["p2", "q1", "time", "q2", "orbit", "p1"]]), runs)  # the order does not count
    table.to_csv(tmp_path / "runs.csv", index=False)
    (tmp_path / "runs.parquet").write_bytes(b"PAR1")
    with monkeypatch.context() as patch, pytest.raises(ImportError, match=r"a Parquet file, which .* pip install"):
        patch.setattr(pd, "read_parquet", no_engine)
        Trajectories.read(tmp_path / "runs.parquet")
    sol.to_xarray().to_netcdf(tmp_path / "runs.nc", engine="scipy")
    assert_same(Trajectories.read(tmp_path / "runs.nc"), runs)
    sol.to_xarray().to_zarr(tmp_path / "runs.zarr", consolidated=False)
    assert_same(Trajectories.read(tmp_path / "runs.zarr"), runs)
    large = tmp_path / "large.zarr"
    sol.to_xarray().assign(more=("x", np.zeros(3))).to_zarr(large, consolidated=False, zarr_format=2)
    described = json.loads((large / "more" / ".zarray").read_text())
    (large / "more" / ".zarray").write_text(json.dumps(described | {"shape": [10**13]}))
    with pytest.raises(ValueError, match=r"^`data` has 7\.45e\+04 GiB, more than 1e\+09 numbers: give a part\.$"):
        Trajectories.read(large)
    with pytest.raises(ValueError, match=r"names a file \.mat: \.csv, \.parquet, \.npz, \.nc and"):
        (tmp_path / "runs.mat").touch()
        Trajectories.read(tmp_path / "runs.mat")
    read = Trajectories.read(tmp_path / "runs.csv", ndof=2)
    np.testing.assert_allclose([run.y for run in read.runs], sol.y, rtol=1e-15)
    assert read.names == ("q1", "q2", "p1", "p2")
    other = pd.DataFrame({"t": t, "theta": RUN[0], "w": RUN[1]})
    assert_same(Trajectories.read(other, q="theta", p="w"), [(t, RUN)])
    assert_same(Trajectories.read(other, ndof=1), [(t, RUN)])
    dated = other.assign(t=pd.to_timedelta(t, "s"))
    np.testing.assert_allclose(Trajectories.read(dated, ndof=1).runs[0].t, t)
    padded = xr.Dataset({"q": (("orbit", "time"), [RUN[0], RUN[0]]), "p": (("orbit", "time"), [RUN[1], RUN[1]])})
    padded["time"] = ("time", t)
    assert_same(Trajectories.read(padded), [(t, RUN), (t, RUN)])
    with pytest.raises(ValueError, match=r"coordinates and momenta are not recognized: name them by `q`"):
        Trajectories.read(other)
    with pytest.raises(ValueError, match=r"velocities, v1, and no momenta: give the mass matrix as `velocity_mass`"):
        Trajectories.read(other.set_axis(["t", "q1", "v1"], axis=1))
    moving = Trajectories.read(other.set_axis(["t", "q1", "v1"], axis=1), velocity_mass=2.0)
    assert_same(moving, [(t, RUN * [[1], [2]])])
    with pytest.raises(ValueError, match=r"no column of the trajectory is recognized: name it by `run`"):
        Trajectories.read(pd.concat([other, other]), ndof=1)
    with pytest.raises(ValueError, match=r"no column of the time among theta, w: name it by `time`"):
        Trajectories.read(other.drop(columns="t"), ndof=1)
    with pytest.raises(FileNotFoundError, match="does not exist"):
        Trajectories.read(tmp_path / "none.csv")
    for decimal in ",.":
        table.to_csv(tmp_path / "runs.csv", index=False, sep=";", decimal=decimal)
        read = Trajectories.read(tmp_path / "runs.csv")
        np.testing.assert_allclose([run.y for run in read.runs], sol.y, rtol=1e-15)


VELOCITIES = {"t": t, "q1": RUN[0], "v1": RUN[1]}


@pytest.mark.parametrize(
    ("data", "options"),
    [
        ((t, RUN), {"observed": "qv"}),
        ({"t": t, "q": RUN[:1], "v": RUN[1:]}, {"observed": "qv", "ndof": 1}),
        (VELOCITIES, {"observed": "qv"}),
        (VELOCITIES, {"observed": "qv", "q": "q1", "p": "v1"}),
        ((t, RUN[:1]), {"observed": "q"}),
        ({"t": t, "q": RUN[:1]}, {"observed": "q", "ndof": 1}),
        ({"t": t, "q1": RUN[0]}, {"observed": "q"}),
        ({"t": t, "angle": RUN[0]}, {"observed": "q", "q": "angle"}),
        ({"t": t, "angle": RUN[0]}, {"observed": "q", "ndof": 1}),
    ],
)
def test_velocities_and_positions_alone_are_read(data, options):
    read = Trajectories.read(data, **options)
    assert (read.velocities, read.ndof, read.names[1][0]) == (True, 1, "v")
    np.testing.assert_array_equal(read.runs[0].y[0], RUN[0])
    missing = options["observed"] == "q"
    np.testing.assert_array_equal(read.runs[0].y[1], np.full(6, np.nan) if missing else RUN[1])
    assert read.scales[1] == pytest.approx(RUN[1].std(), rel=0.3)
    again = Trajectories.read(read)
    assert again.velocities
    assert again.names == read.names


def test_units_and_orders():
    degrees = Trajectories.read(
        (1e3 * t, np.rad2deg(RUN) * [[1], [1e-3]]), units={"t": "ms", "q": "deg", "p": "deg/ms"}
    )
    np.testing.assert_allclose(degrees.runs[0].t, t)
    np.testing.assert_allclose(degrees.runs[0].y, RUN)
    assert Trajectories.read((t, RUN), units={"p1": "g*cm^2/s"}).runs[0].y[1, 1] == pytest.approx(RUN[1, 1] * 1e-7)
    pairs = Trajectories.read((t, FOUR), order="pairs")
    assert_same(pairs, [(t, FOUR[[0, 2, 1, 3]])])
    assert_same(Trajectories.read((t, FOUR), order=[0, 2, 1, 3]), [(t, FOUR[[0, 2, 1, 3]])])
    assert_same(
        pairs.scaled(sympflow.flow.scaling.Scaling((2, 1), (1, 2), 0.5)),
        [(2 * t, FOUR[[0, 2, 1, 3]] / [[2], [1], [1], [2]])],
    )
    units = np.array(pairs.scaling.x)
    np.testing.assert_allclose(units[:2] * units[2:], pairs.scaling.action)  # dq∧dp is scaled alike


def test_angles_that_were_wrapped_are_noticed_and_continued():
    times = np.linspace(0, 10, 40)
    turning = np.stack([1.3 * times - 2.0, 1.3 + 0.1 * np.sin(times)])
    wrapped = turning.copy()
    wrapped[0] = (turning[0] + np.pi) % (2 * np.pi) - np.pi
    wrapped[0, 7] = np.nan
    for scale, period in ((1.0, r"2\*np.pi"), (180 / np.pi, "360")):
        data = Trajectories.read([(times, turning), (times, wrapped * [[scale], [1]])][1:])
        with pytest.raises(ValueError, match=rf"2 jumps of q1 by about {period}, the first in trajectory 0"):
            data.check_angles()
        data.check_angles(np.array([True]))  # it is none
    continued = Trajectories.read((times, wrapped), period=2 * np.pi)
    continued.check_angles()
    seen = np.isfinite(wrapped[0])
    np.testing.assert_allclose(continued.runs[0].y[0, seen], turning[0, seen], atol=1e-12)
    swinging = Trajectories.read((times, np.stack([3.1 * np.sin(3 * times), np.cos(times)])))
    swinging.check_angles()  # large steps of all sizes are no jumps
    assert_same(swinging.unwrapped(np.array([np.inf])), [(run.t, run.y) for run in swinging.runs])
    with pytest.raises(ValueError, match="pass period=2"):
        sympflow.discover((times, np.stack([wrapped, wrapped])))
    with pytest.raises(ValueError, match="`period` must be positive"):
        Trajectories.read((times, wrapped), period=-1.0)


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        ([], {}, "has no trajectories"),
        ((t[[0, 1, 1, 2, 3, 4]], RUN), {}, r"times that repeat \(the trajectory: 0.2 follows 0.2 at point 2\): sort"),
        ([(t, RUN), (t[[0, 2, 1, 3, 4, 5]], RUN)], {}, r"times that go back \(trajectory 1"),
        ((t, RUN * np.nan), {}, "no value but NaN"),
        ((t, RUN * [[1], [np.nan]]), {}, "no value of p1 in any trajectory"),
        ((t, RUN + np.inf), {}, "infinite values"),
        ((t * np.nan, RUN), {}, "times that are not finite"),
        ([(t, RUN), (t, FOUR)], {}, r"different widths, 2 \(trajectory 0\), 4 \(trajectory 1\)"),
        ((t, FOUR[:3]), {}, "states of 3 numbers, which is odd"),
        ((t, RUN.T), {}, "pass y.T, for time comes last"),
        ((t[:1], RUN[:, :1]), {}, "one point only"),
        ((t, RUN), {"ndof": 2}, "`ndof` is 2, but states have 2 numbers"),
        ((t, FOUR), {"order": "rows"}, "`order` must be"),
        ((t, FOUR), {"order": [0, 1, 2, 2]}, "each of 0 … 3 once"),
        ((t, RUN), {"units": {"p": "furlong"}}, "are known; else give a factor"),
        ((t, RUN), {"units": {"x": "m"}}, "`units` names 'x'"),
        ((t, RUN), {"velocity_mass": [1, 2]}, "`velocity_mass` must be"),
        ((t, RUN), {"velocity_mass": 0.0}, "`velocity_mass` must be finite"),
        ((t, FOUR), {"velocity_mass": [[1, 2], [2, 1]]}, "positive definite"),
        ((t[:0], FOUR[None, :, :0]), {}, "has no numbers"),
        ((np.eye(2), [1, 2, 3], np.eye(2)), {}, r"give x \(N, 2d\), t \(N,\)"),
        ((np.stack([t, t]), np.ones((3, 2, 6))), {}, r"times of shape \(2, 6\) .* give t \(n,\) for all, or \(N, n\)"),
        ({"y": FOUR}, {}, "no times: give them as t"),
        ({"t": t, "q": FOUR[:2], "p": FOUR[2:]}, {}, "k coordinates or k trajectories: pass `ndof`"),
        ({"t": t, "q": FOUR[:2], "v": FOUR[2:]}, {}, "with q and p of one shape"),
        ({"t": t, "q": t, "p": t[:3]}, {}, "columns must be of one length"),
    ],
)  # fmt: skip
def test_bad_data_are_refused_with_the_remedy(data, options, message):
    with pytest.raises(ValueError, match=message):
        Trajectories.read(data, **options)


def test_the_order_is_that_of_columns_with_names_of_their_own_and_of_trajectories_read_before():
    table = pytest.importorskip("pandas").DataFrame({"t": t, **dict(zip("abcd", FOUR, strict=True))})
    read = Trajectories.read(table, 2, order="pairs")
    assert read.names == ("a", "c", "b", "d")
    assert np.array_equal(read.runs[0].y, FOUR[[0, 2, 1, 3]])
    for before in (Trajectories.read(table, 2), Trajectories.read((t, FOUR))):
        turned = Trajectories.read(before, order="pairs")
        assert np.array_equal(turned.runs[0].y, FOUR[[0, 2, 1, 3]])
    named = table.rename(columns={"a": "q1", "b": "p1", "c": "q2", "d": "p2"})
    assert Trajectories.read(named, order="pairs").names == ("q1", "q2", "p1", "p2")


@pytest.mark.parametrize("data", [None, 3.0, "no.such.kind", [1, 2], [(t,)], (t, RUN * 1j)])
def test_what_is_no_data_is_refused(data):
    with pytest.raises((TypeError, FileNotFoundError), match="`data"):
        Trajectories.read(data)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("latin.csv", "t,q,p,é\n0,1,2,3\n".encode("latin-1")),
        ("empty.csv", b""),
        ("ragged.csv", b"t,q,p\n0,1,2\n1,2,3,4,5\n"),
        ("damaged.npz", b"PK\3\4junk"),
        ("no.npz", b"junk"),
    ],
)
def test_files_that_cannot_be_read_are_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"^`data` names the file .*{name}.*cannot be read .*check that it is whole"):
        Trajectories.read(tmp_path / name)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ("tqpq", r"^`data` has more than one column q: drop one of them"),
        (["t", "q", "qdot"], r"velocities, qdot, and no momenta: .* observed=\"qv\""),
        (["t", "q1", "q2", "q1_dot", "dq2_dt"], r"velocities, q1_dot, dq2_dt, and no momenta"),
    ],
)
@pytest.mark.parametrize("file", [False, True])
def test_columns_of_one_name_and_velocities_are_told(columns, message, file, tmp_path):
    pd = pytest.importorskip("pandas")
    data = pd.DataFrame(np.column_stack([t, *FOUR])[:, : len(columns)], columns=[*columns])
    if file:
        data.to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(ValueError, match=message):
        Trajectories.read(tmp_path / "run.csv" if file else data)


def test_dictionaries_of_columns_are_tables():
    pytest.importorskip("pandas")
    assert_same(Trajectories.read({"t": t, "q": RUN[0], "p": RUN[1]}), [(t, RUN)])
    assert_same(Trajectories.read({"t": t, "w": RUN[1], "a": RUN[0]}, q=["a"], p=["w"]), [(t, RUN)])


def test_sets_are_divided_by_trajectory_and_long_runs_into_pieces():
    many = Trajectories.read((t, np.arange(120.0).reshape(10, 2, 6)))
    kept, held = many.split(0.3, seed=1)
    firsts = [run.y[0, 0] for run in (*kept.runs, *held.runs)]
    assert (len(kept.runs), len(held.runs), sorted(firsts)) == (7, 3, [12.0 * i for i in range(10)])
    again = many.split(0.3, seed=1)[1]
    assert [run.y[0, 0] for run in again.runs] == [run.y[0, 0] for run in held.runs]
    one = Trajectories.read((t, RUN))
    assert [run.n_points for run in one.pieces(points=4).runs] == [4, 2]
    assert [run.n_points for run in one.pieces(points=5).runs] == [6]  # no piece of one point
    assert [run.n_points for run in one.pieces(span=0.4).runs] == [3, 3]
    assert [run.n_points for run in one.pieces(span=1e-9).runs] == [2, 2, 2]
    assert np.array_equal(np.concatenate([run.y for run in one.pieces(span=0.4).runs], 1), RUN)
    with pytest.raises(ValueError, match="one trajectory only"):
        one.split()
    with pytest.raises(ValueError, match="`points` must be an integer, 2 or more"):
        one.pieces(points=1)


def test_of_few_trajectories_each_is_left_out_in_turn():
    many = Trajectories.read((t, np.arange(240.0).reshape(20, 2, 6)))
    ((kept, held),) = many.subset(range(8)).folds(0.2)
    assert (len(kept.runs), len(held.runs)) == (5, 3)  # three at least
    ((kept, held),) = many.folds(0.2)
    assert (len(kept.runs), len(held.runs)) == (16, 4)
    folds = many.subset(range(3)).folds()
    assert [[run.y[0, 0] for run in held.runs] for _, held in folds] == [[0.0], [12.0], [24.0]]
    assert [[run.y[0, 0] for run in kept.runs] for kept, _ in folds] == [[12.0, 24.0], [0.0, 24.0], [0.0, 12.0]]
    with pytest.raises(ValueError, match="one trajectory only"):
        many.subset([0]).folds()
