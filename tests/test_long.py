"""The lists of tests that are long, and of mutations, name what exists."""

import re

from conftest import COLLECTED, TESTS
from mutations import MUTATIONS

LISTED = (TESTS / "long.txt").read_text("utf-8").splitlines()


def test_what_is_listed_exists(request):
    """Rows with their names, of the files that are run whole; of the others the functions."""
    collected = request.config.stash[COLLECTED]
    named = {word.partition("::")[0] for word in request.config.args if "::" in word}
    for row in LISTED:
        path, *_, function = row.partition("[")[0].split("::")
        assert re.search(rf"def {function}\(", (TESTS.parent / path).read_text("utf-8")), row
        if path not in named and any(name.startswith(f"{path}::") for name in collected):
            assert any(name.partition("[")[0] == row or name == row for name in collected), row


def test_mutations_are_of_texts_that_occur_once_and_name_tests_that_exist():
    package = [path.read_text("utf-8") for path in (TESTS.parent / "sympflow").rglob("*.py")]
    tests = {
        name for path in TESTS.rglob("test_*.py") for name in re.findall(r"def (test_\w+)\(", path.read_text("utf-8"))
    }
    for mutation in MUTATIONS:
        assert sum(text.count(mutation.old) for text in package) == 1, mutation.name
        assert mutation.new != mutation.old, mutation.name
        assert mutation.tests, mutation.name
        assert tests.issuperset(mutation.tests), mutation.name
