"""The list of tests that are long names tests that exist."""

import re

import pytest
from conftest import TESTS

LISTED = sorted({line.partition("[")[0] for line in (TESTS / "long.txt").read_text("utf-8").splitlines()})


@pytest.mark.parametrize("name", LISTED)
def test_what_is_listed_exists(name):
    path, *_, function = name.split("::")
    assert re.search(rf"def {function}\(", (TESTS.parent / path).read_text("utf-8"))
