"""The figures of docs/measured again, each by the command that its last line names.

    python benchmarks/again.py                          all of them, one after the other: hours on a quiet machine
    python benchmarks/again.py 'peers-*' through-solve  fragments of these names alone
    python benchmarks/again.py --list                   the commands, and the commit at which each was run
    python benchmarks/again.py --older 8b073b2          fragments of commits before this one alone

A command that writes several fragments runs once. What it prints goes into out/again, and one that fails, or takes
longer than `--seconds`, does not keep the others from running; its fragments stay as they were.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
import time
from fnmatch import fnmatch
from pathlib import Path

from measuring.fragments import FOLDER

HOUSE = Path(__file__).resolve().parent.parent
SOURCE = re.compile(r"<small>`(python benchmarks/[^`]+)` · .* · commit (\w+)")


def commands(folder: Path, patterns: list[str]) -> dict[str, dict[str, str]]:
    """The commands behind fragments whose names match one of the patterns, with those names and their commits."""
    found: dict[str, dict[str, str]] = {}
    for path in sorted(folder.glob("*.md")):
        source = SOURCE.search(path.read_text(encoding="utf-8"))
        if source and any(fnmatch(path.stem, pattern) for pattern in patterns):
            found.setdefault(source[1], {})[path.stem] = source[2]
    return found


def before(commit: str, other: str) -> bool:
    """True if `commit` comes before `other` in the history."""
    ancestors = ["git", "merge-base", "--is-ancestor", other, commit]
    return subprocess.run(ancestors, cwd=HOUSE, stderr=subprocess.DEVNULL, check=False).returncode != 0


def run(command: str, folder: Path, log: Path, seconds: float | None) -> bool:
    """Run a command in the house's root, with `--out`; True if it ends well and in time."""
    _, *words = shlex.split(command)
    with log.open("w", encoding="utf-8") as said:
        try:
            done = subprocess.run(
                [sys.executable, *words, "--out", str(folder)],
                cwd=HOUSE,
                stdout=said,
                stderr=subprocess.STDOUT,
                timeout=seconds,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return False
    return done.returncode == 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("patterns", nargs="*", default=["*"], metavar="NAME", help="fragments, such as 'peers-*'")
    parser.add_argument("--list", action="store_true", help="run nothing")
    parser.add_argument("--older", metavar="COMMIT", help="only fragments that were measured before this commit")
    parser.add_argument("--seconds", type=float, help="at most for each command")
    parser.add_argument("--out", type=Path, default=HOUSE / FOLDER, help="folder of the fragments")
    options = parser.parse_args()
    logs = HOUSE / "out" / "again"
    logs.mkdir(parents=True, exist_ok=True)
    failed = 0
    for command, names in commands(options.out, options.patterns).items():
        if options.older and not any(before(commit, options.older) for commit in names.values()):
            continue
        if options.list:
            print(f"{command}\n    {', '.join(f'{name} ({commit})' for name, commit in names.items())}")
            continue
        log = logs / f"{next(iter(names))}.log"
        start = time.perf_counter()
        well = run(command, options.out, log, options.seconds)
        failed += not well
        took = time.perf_counter() - start
        print(f"{command}: {took:.0f} s" + ("" if well else f", FAILED, see {log.relative_to(HOUSE)}"), flush=True)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
