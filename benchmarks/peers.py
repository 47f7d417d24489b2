"""sympflow and its peers on one scene, in one run: the fragments of docs/benchmarks.md and its figure.

    python benchmarks/peers.py --out docs/measured

Everything runs on one thread. Packages that are not installed are left out, with the reason. The measured numbers can
be kept with `--results file.json`, and the fragments written from them again with `--reuse`.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from contenders.contender import Contender, Scene, Skipped
    from contenders.measurement import Results

PEERS = {
    "diffrax": "diffrax_solvers",
    "heyoka": "heyoka_taylor",
    "rebound": "rebound_particles",
    "pyhamsys": "pyhamsys_schemes",
    "desolver": "desolver_schemes",
}
"""Packages by the names under which they are imported, and the modules that run them."""
TARGETS = (1e-3, 1e-6, 1e-9, 1e-12)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/measured"), help="folder of the fragments")
    parser.add_argument("--results", type=Path, help="JSON file for the measured numbers")
    parser.add_argument("--reuse", action="store_true", help="write the fragments from --results, without a run")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--cap", type=float, default=0.3, help="seconds above which a run is timed in part")
    parser.add_argument("--t-end", type=float, default=1000.0, help="length of the interval (the targets need 1000)")
    parser.add_argument("--only", default="", help="comma-separated packages to compare, for a quick look")
    arguments = parser.parse_args()

    from measuring import fragments
    from measuring.machine import pin_to_one_thread

    pin_to_one_thread()
    from contenders import tables
    from contenders.measurement import Results

    if arguments.reuse:
        results = Results.from_dict(json.loads(arguments.results.read_text()))
    else:
        results = run(arguments)
        if arguments.results:
            arguments.results.parent.mkdir(parents=True, exist_ok=True)
            arguments.results.write_text(json.dumps(results.to_dict(), indent=1))
    figure = arguments.out.parent / "figures" / "work_precision_peers.png"
    tables.draw(results, figure)
    for name, body in tables.fragments(results).items():
        fragments.write(arguments.out, name, body)


def run(arguments: argparse.Namespace) -> Results:
    from contenders.contender import Scene
    from contenders.measurement import measure
    from measuring.machine import describe, load

    start = time.perf_counter()
    scene = Scene(t_end=arguments.t_end)
    contenders, skipped = gather(scene)
    if arguments.only:
        wanted = {"sympflow", *arguments.only.split(",")}
        contenders = [contender for contender in contenders if contender.package in wanted]
    environment = describe()
    results = measure(scene, contenders, TARGETS, arguments.repeats, arguments.cap)
    results.skipped = skipped
    minutes = (time.perf_counter() - start) / 60
    results.environment = environment | {"minutes": minutes, "repeats": arguments.repeats, "load_after": load()}
    return results


def gather(scene: Scene) -> tuple[list[Contender], list[Skipped]]:
    """The contenders whose packages are there, and the packages that are not."""
    from contenders import loops, ours, runge_kutta
    from contenders.contender import Skipped

    contenders = [c for module in (ours, loops, runge_kutta) for c in module.contenders(scene)]
    skipped = []
    for package, module in PEERS.items():
        if importlib.util.find_spec(package) is None:
            skipped.append(Skipped(package, "not installed; it comes with the extra `bench`"))
        else:
            contenders += importlib.import_module(f"contenders.{module}").contenders(scene)
    return contenders, skipped


if __name__ == "__main__":
    main()
