"""The block bootstrap: coverage on series of known correlation, and that without blocks it fails."""

import numpy as np
import pytest
import scipy.stats

from jaxfilt.bootstrap import anees_of_one_run, block_bootstrap, block_length

STEPS, SERIES = 600, 250


def ar(rho, size, seed):
    """Stationary series (size, STEPS) with autocorrelation rho^k, mean 0, variance 1."""
    x = np.random.default_rng(seed).normal(size=(size, STEPS))
    for k in range(1, STEPS):
        x[:, k] = rho * x[:, k - 1] + np.sqrt(1 - rho**2) * x[:, k]
    return x


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_the_interval_covers_about_as_often_as_it_says(rho):
    """Of correlated series the block bootstrap is known to cover a little less: no worse than 83 % for 90 %."""
    covered = 0
    for seed, x in enumerate(ar(rho, SERIES, seed=1)):
        low, high = block_bootstrap(5.0 + x, confidence=0.9, samples=400, seed=seed)
        covered += low <= 5.0 <= high
    assert 0.83 <= covered / SERIES <= 0.95


def test_without_blocks_it_fails():
    intervals = [block_bootstrap(x, confidence=0.9, block=1, samples=400) for x in ar(0.7, SERIES, seed=1)]
    assert np.mean([low <= 0.0 <= high for low, high in intervals]) < 0.65


def test_the_average_nees_of_one_run_is_inside_about_as_often_as_it_says():
    errors = np.stack([ar(0.8, SERIES, seed) for seed in range(3)])
    totals = [anees_of_one_run(nees, 3, confidence=0.9, samples=300) for nees in (errors**2).sum(0)]
    inside = np.array([t.low <= t.mean <= t.high for t in totals])
    assert 0.82 <= inside.mean() <= 0.95
    assert inside.tolist() == [t.p >= 0.1 for t in totals]
    alone = [anees_of_one_run(nees, 3, confidence=0.9, block=1, samples=300) for nees in (errors**2).sum(0)]
    assert np.mean([t.low <= t.mean <= t.high for t in alone]) < 0.7


def test_an_overconfident_run_is_found():
    nees = 2.0 * (np.stack([ar(0.8, 1, seed)[0] for seed in range(3)]) ** 2).sum(0)
    total = anees_of_one_run(nees, 3)
    assert total.mean > total.high
    assert total.p < 1e-3


@pytest.mark.parametrize("rho", [0.5, 0.8])
def test_automatic_blocks_are_as_long_as_theory_says(rho):
    """For rho^k the best length is (6 rho^2 / (1 - rho^2)^2 T)^(1/3)."""
    lengths = [block_length(x) for x in ar(rho, 60, seed=2)]
    assert np.median(lengths) == pytest.approx((6 * rho**2 / (1 - rho**2) ** 2 * STEPS) ** (1 / 3), rel=0.3)


def test_automatic_blocks_of_white_noise_are_short():
    assert np.median([block_length(x) for x in ar(0.0, 60, seed=3)]) <= 3


def test_resampled_means_are_those_of_blocks_of_the_ring():
    """Five steps in blocks of two: three blocks a sample, six sums to choose from, and no other mean can come out."""
    x = np.array([1.0, 10.0, 100.0, 1000.0, 10000.0])
    sums = x + np.roll(x, -1)
    possible = {round(a + b + c, 6) / 6 for a in sums for b in sums for c in sums}
    low, high = block_bootstrap(x, confidence=0.5, block=2, samples=101)
    stretch = scipy.stats.t.ppf(0.25, 1.5) / scipy.stats.norm.ppf(0.25)
    for end in (low, high):
        quantile = x.mean() + (end - x.mean()) / stretch
        assert min(abs(quantile - p) for p in possible) < 1e-6


def test_the_same_seed_gives_the_same_interval_and_gaps_do_not_count():
    x = ar(0.5, 1, seed=4)[0]
    holes = np.insert(x, [3, 500], np.nan)
    assert block_bootstrap(x, 0.9, seed=7) == block_bootstrap(holes, 0.9, seed=7)
    assert block_bootstrap(x, 0.9, seed=7) != block_bootstrap(x, 0.9, seed=8)


@pytest.mark.parametrize("x", [[], [1.0], [np.nan] * 9])
def test_too_little_is_not_a_number(x):
    assert np.isnan(block_bootstrap(x)).all()
    total = anees_of_one_run(x, 2)
    assert np.isnan([total.low, total.high, total.p]).all()
    assert np.isnan(block_bootstrap(np.arange(10.0), block=6)).all()
