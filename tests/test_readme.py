"""The README's programs run, in order, as one; and it says how to install and test."""

import re
from pathlib import Path

import jax
import pytest

README = (Path(__file__).parent.parent / "README.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)


@pytest.mark.long
def test_every_program_runs():
    jax.config.update("jax_enable_x64", False)
    try:
        program: dict = {}
        for block in BLOCKS:
            exec(compile(block, "README.md", "exec"), program)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert len(BLOCKS) >= 5


def test_it_names_every_public_function():
    import jaxfilt

    missing = [name for name in jaxfilt.__all__ if not re.search(rf"\b{name}\b", README)]
    assert not missing
