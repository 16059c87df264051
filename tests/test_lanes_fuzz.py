"""A few random programs; ``python -m tests.fuzz_lanes 5000`` tries many."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz_lanes import check


@pytest.mark.long
@pytest.mark.parametrize("kernel", [False, True])
@pytest.mark.parametrize("strict", [False, True])
def test_random_programs(strict: bool, kernel: bool) -> None:
    @settings(max_examples=6, derandomize=True, deadline=None, database=None)
    @given(st.data(), st.integers(0, 2**32 - 1))
    def run(data: st.DataObject, seed: int) -> None:
        assert check(lambda n: data.draw(st.integers(0, n - 1)), seed, strict, kernel) > 0

    run()
