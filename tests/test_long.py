"""The lists of tests that are long, and of mutations, name what exists."""

import re

import pytest
from conftest import TESTS
from mutations import MUTATIONS

LISTED = sorted({line.partition("[")[0] for line in (TESTS / "long.txt").read_text("utf-8").splitlines()})


@pytest.mark.parametrize("name", LISTED)
def test_what_is_listed_exists(name):
    path, *_, function = name.split("::")
    assert re.search(rf"def {function}\(", (TESTS.parent / path).read_text("utf-8"))


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
