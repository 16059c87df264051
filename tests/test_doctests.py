"""Every example in a docstring runs and gives what it says, in the library's default float32."""

import doctest
import importlib
import pkgutil

import jax
import pytest

import jaxfilt

MODULES = [m.name for m in pkgutil.walk_packages(jaxfilt.__path__, "jaxfilt.")]


@pytest.fixture
def _defaults():
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


@pytest.mark.usefixtures("_defaults")
@pytest.mark.parametrize("name", MODULES)
def test_examples(name: str):
    failed, _ = doctest.testmod(importlib.import_module(name))
    assert failed == 0
