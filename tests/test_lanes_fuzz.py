"""A few random programs; ``python -m tests.fuzz_lanes 5000`` tries many."""

import numpy as np
import pytest

from tests.fuzz_lanes import check


@pytest.mark.long
@pytest.mark.parametrize("seed", range(12))
def test_a_random_program(seed: int) -> None:
    rng = np.random.default_rng(seed)
    assert check(lambda n: int(rng.integers(n)), seed, strict=seed % 2 == 0, kernel=seed % 4 < 2) > 0
