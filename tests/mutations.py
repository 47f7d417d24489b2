"""Break the numerical heart in some twenty places, one at a time, and see that the tests notice.

    python tests/mutations.py                     # all of them, in a copy of this tree
    python tests/mutations.py --tree DIR          # in a copy of another tree
    python tests/mutations.py --only tangent      # those whose names match

A mutation is a text of the package and what is put in its place. It is found by its content in whatever file it stands.
Each names tests that must fail, again by name alone. Tests run with `-x` in a copy, in a folder of compiled loops of
its own, so nothing of the tree is changed.
Exit status 1 if a mutation survives, or is found nowhere.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Mutation:
    """A change that must be noticed: what is put in place of a text, and the tests that notice it."""

    name: str
    old: str
    new: str
    tests: tuple[str, ...]


MUTATIONS = (
    Mutation(
        "weight of a scheme",
        "(*half, 1.0 - 2.0 * sum(half), *reversed(half))",
        "(*half, 1.0 - 2.001 * sum(half), *reversed(half))",
        ("test_order_conditions_hold_up_to_the_order_and_not_beyond",),
    ),
    Mutation(
        "kick of the inverse",
        "p = p + change if sign > 0 else p - change",
        "p = p + change",
        ("test_inverse_tangent_and_gradients",),
    ),
    Mutation(
        "sign of the force gradient",
        "change = change - (kick.three * h**3)",
        "change = change + (kick.three * h**3)",
        ("test_the_order_is_the_slope",),
    ),
    Mutation(
        "sign of a tangent",
        "q = [summed(q[i], slant[d * i : d * (i + 1)], p)",
        "q = [summed(q[i], slant[d * i : d * (i + 1)], q)",
        ("test_steps_and_their_jacobians_are_those_of_differentiated_steps",),
    ),
    Mutation(
        "last and first kick of a compiled run",
        "stages[1:-1], last + first",
        "stages[1:-1], last",
        ("test_kernel_agrees_with_numpy",),
    ),
    Mutation(
        "shears of a turn",
        "Y = Y - sigma * X",
        "Y = Y + sigma * X",
        ("test_the_flow_is_the_matrix_exponential", "test_whole_quarter_turns_leave_no_rounding_to_add_up"),
    ),
    Mutation(
        "filter of the mollified impulse",
        "* times / np.pi)",
        "* times)",
        ("test_the_order_is_the_slope", "test_fput_figures"),
    ),
    Mutation(
        "tableau of Gauss",
        "/ (2 * math.sqrt(4 * k * k - 1))",
        "/ (2 * math.sqrt(4 * k * k - 0.9))",
        ("test_the_contract_holds_where_h_does_not_split",),
    ),
    Mutation(
        "matrix of Newton's method",
        "M = -blocks.reshape(",
        "M = blocks.reshape(",
        ("test_a_run_is_the_same_in_every_way", "test_first_and_second_derivatives_pass_through_a_step"),
    ),
    Mutation(
        "compensated sum",
        'op("sub", op("sub", total, x), change)',
        'op("add", op("sub", total, x), change)',
        ("test_compensated_sums_need_compiled_loops_and_lower_the_rounding", "test_compensated_sums_lower_it"),
    ),
    Mutation(
        "time of a secant",
        "for _ in range(80):\n        x = step(sigma)",
        "for _ in range(2):\n        x = step(sigma)",
        ("test_it_is_right_in_the_physical_time",),
    ),
    Mutation(
        "place of a time on the grid",
        "np.where(on_grid, nearest, np.floor(x))",
        "np.where(on_grid, nearest, np.rint(x))",
        ("test_every_time_is_a_count_and_a_remainder",),
    ),
    Mutation(
        "shorter step at the end",
        "return count, t - (self.t0 + count * self.h)",
        "return count, self.h",
        ("test_the_last_step_is_shorter",),
    ),
    Mutation(
        "direction of an event",
        "(up and self.direction >= 0) or (down and self.direction <= 0)",
        "(up and self.direction <= 0) or (down and self.direction >= 0)",
        ("test_directions", "test_the_results_are_scipys"),
    ),
    Mutation(
        "inverse of a layer",
        "return self._moved(q, p, -g if back else g)",
        "return self._moved(q, p, g)",
        ("test_it_is_the_identity_at_zero_and_has_an_exact_inverse",),
    ),
    Mutation(
        "velocity of a layer",
        "*self._moved(q, p, g), *self._moved(dq, dp, dg)",
        "*self._moved(q, p, g), *self._moved(dq, dp, -dg)",
        ("test_its_velocity_is_the_time_derivative_and_that_of_its_hamiltonian",),
    ),
    Mutation(
        "Hamiltonian of a flow",
        "return *self._moved(q, p, -g), rate",
        "return *self._moved(q, p, -g), -rate",
        ("test_its_velocity_is_the_time_derivative_and_that_of_its_hamiltonian",),
    ),
    Mutation(
        "rate of primed coefficients",
        "sum((m + e) * c_k * tau**e",
        "sum((m - e) * c_k * tau**e",
        ("test_its_velocity_is_the_time_derivative_and_that_of_its_hamiltonian",),
    ),
    Mutation(
        "loss of Hamiltonian matching",
        "* (self.scaling.t / self.scaling.action)",
        "* self.scaling.t",
        ("test_losses_are_the_papers", "test_losses_do_not_depend_on_units"),
    ),
    Mutation(
        "logarithm of the volume",
        "sign, logarithm = np.linalg.slogdet(",
        "sign, logarithm = np.linalg.slogdet(1.0001 * ",
        ("test_volume_of_one_rk45_step_is_that_of_its_stability_function",),
    ),
    Mutation(
        "scale of the energy error",
        "scale = np.fmax(np.abs(H[0]),",
        "scale = np.fmax(1 + np.abs(H[0]),",
        ("test_error_is_relative_to_the_initial_energy_or_to_the_declared_scale",),
    ),
    Mutation(
        "tangent of Runge–Kutta",
        "dY = identity + h[..., None] * weighted(row, dK) if K else identity",
        "dY = identity - h[..., None] * weighted(row, dK) if K else identity",
        ("test_volume_of_one_rk45_step_is_that_of_its_stability_function",),
    ),
    Mutation(
        "states of a sublevel",
        "(self.above - slack < H)",
        "(self.above + slack < H)",
        ("test_energy_slack_widens_an_energy_domain", "test_compiled_code_agrees_on_what_lies_in_a_sublevel"),
    ),
)


def mutated(tree: Path, mutation: Mutation) -> Path:
    """Break a tree; the file that was changed.

    Raises
    ------
    LookupError
        If the text does not occur, or in several places.
    """
    files = {path: path.read_text(encoding="utf-8") for path in sorted((tree / "sympflow").rglob("*.py"))}
    found = [path for path, text in files.items() if mutation.old in text]
    if not found:
        raise LookupError(f"the text {mutation.old!r} does not occur")
    if len(found) > 1 or files[found[0]].count(mutation.old) > 1:
        raise LookupError(f"the text {mutation.old!r} occurs more than once")
    found[0].write_text(files[found[0]].replace(mutation.old, mutation.new), encoding="utf-8")
    return found[0]


def failing_test(tree: Path, tests: tuple[str, ...]) -> str:
    """The first of the tests of these names that fails in a tree; "" if none does.

    Raises
    ------
    LookupError
        If no test bears one of the names, or pytest could not run them.
    """
    texts = {path: path.read_text(encoding="utf-8") for path in sorted((tree / "tests").rglob("test_*.py"))}
    files = [path for path, text in texts.items() if any(f"def {name}(" in text for name in tests)]
    missing = [name for name in tests if not any(f"def {name}(" in text for text in texts.values())]
    if missing:
        raise LookupError(f"no test bears the name {missing[0]}")
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-p",
        "no:cacheprovider",
        "-k",
        " or ".join(tests),
        *map(str, files),
    ]
    run = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    if run.returncode > 1:
        raise LookupError(run.stdout[-2000:] + run.stderr[-2000:])
    failed = re.findall(r"^(?:FAILED|ERROR) \S*::(\S+)", run.stdout, re.MULTILINE)
    return failed[0] if run.returncode else ""


def main() -> int:
    """Run the mutations; the number of those that are not caught."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tree", type=Path, default=HERE)
    parser.add_argument("--only", default="", metavar="PATTERN")
    given = parser.parse_args()
    os.environ.setdefault("SYMPFLOW_CACHE_DIR", str(Path(tempfile.gettempdir()) / "sympflow-mutations"))
    chosen = [mutation for mutation in MUTATIONS if re.search(given.only, mutation.name)]
    bad = 0
    with tempfile.TemporaryDirectory(prefix="sympflow-mutation-") as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(given.tree, tree, ignore=shutil.ignore_patterns(".*", "__pycache__", "site", "out"))
        for mutation in chosen:
            since, changed = time.perf_counter(), None
            try:
                changed = mutated(tree, mutation)
                caught = failing_test(tree, mutation.tests)
                verdict = f"caught by {caught}" if caught else "SURVIVED"
            except LookupError as error:
                caught, verdict = "", f"NOT TRIED: {error}"
            finally:
                if changed:
                    shutil.copyfile(given.tree / changed.relative_to(tree), changed)
            bad += not caught
            where = changed.relative_to(tree) if changed else "-"
            print(f"{mutation.name:35} {where!s:40} {time.perf_counter() - since:4.0f} s  {verdict}", flush=True)
    print(f"{len(chosen) - bad} of {len(chosen)} mutations caught")
    return min(bad, 1)


if __name__ == "__main__":
    sys.exit(main())
