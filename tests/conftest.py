"""JAX at its strictest: no silent rank or dtype promotion; float64 there to ask for."""

import os
import sys
from pathlib import Path

import jax
import pytest

# The benchmarks are not installed; behind whatever is.
sys.path.append(str(Path(__file__).resolve().parent.parent))

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
# Nine tenths of the tests' time is compilation, a third of which this saves. Whatever runs in a process of its own (the
# command line, studies that are killed, several devices, the notebooks) is compiled as users compile it.
jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture(scope="module", autouse=True)
def _forgotten_programs():
    """A module's compiled programs are of no use to the next: thousands of them are gigabytes."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def data() -> Path:
    """The recordings; absent, the test skips and says so."""
    root = os.environ.get("JAXFILT_DATA")
    if not root:
        pytest.skip("JAXFILT_DATA is not set: no recordings to run on")
    return Path(root)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """In CI a skip is a failure: what was not run was not tested."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("CI") and reporter and reporter.stats.get("skipped"):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
