"""The house: a file imports only lower floors, and importing it all is light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import jaxfilt

ROOT = Path(jaxfilt.__file__).parent
FLOORS = [
    {"types", "elementary", "linalg", "chisquare", "plaintext", "lanes"},
    {"doors", "spaces", "consistency", "checkpoint", "devices", "loop"},
    {"noise", "log", "files", "theta_file", "integrate", "transforms", "bootstrap", "credibility", "priors"},
    {"correction"},
    {"prediction", "mixture"},
    {"weighing", "resampling"},
    {"models", "datasets", "filters", "complementary", "averages", "grid", "particle", "imm"},
    {"slam"},
    {"smooth", "parallel"},
    {"run", "graph", "simulate", "metrics", "diagnose", "check", "mismatch", "out_of_sequence"},
    {"scenarios", "recordings", "bound", "tally", "findings", "fold"},
    {"scores", "streaming", "objectives"},
    {"chunk"},
    {"verdict", "totals", "task", "fit"},
    {"campaign", "review", "tuning"},
    {"study"},
    {"sweep"},
    {"tune"},
    {"report"},
    {"arguments", "terminal", "tuning_data"},
    {"command"},
    {"cli_tune"},
    {"cli"},
]
FILES = sorted(p for p in ROOT.rglob("*.py") if p != ROOT / "__init__.py")


def room(path: Path) -> str:
    relative = path.relative_to(ROOT)
    return relative.parts[0] if len(relative.parts) > 1 else relative.stem


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == "jaxfilt":
            rooms |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("jaxfilt."):
            rooms.add(node.module.split(".")[1])
        elif isinstance(node, ast.Import):
            rooms |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith("jaxfilt.")}
    return rooms


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_file_imports_only_lower_floors(path: Path):
    floor = {name: k for k, names in enumerate(FLOORS) for name in names}
    own = room(path)
    assert own in floor, f"{path.name}: give it a floor"
    for name in imported_rooms(path) - {own}:
        assert floor.get(name, 99) < floor[own], f"{own} (floor {floor[own]}) imports {name}"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_only_linalg_factorizes(path: Path):
    calls = {"cholesky", "solve", "qr", "eigh", "inv", "cho_factor", "cho_solve"}
    host_side = {"bound.py", "check.py", "credibility.py", "curvature.py", "diagnose.py", "doors.py", "identify.py"}
    if path.name == "linalg.py" or room(path) == "lanes":  # which only names them, as operations of JAX
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Attribute) and node.attr in calls and path.name not in host_side:
            assert isinstance(node.value, ast.Name), f"{path.name}:{node.lineno} calls {node.attr}"
            assert node.value.id == "linalg", f"{path.name}:{node.lineno} calls {node.attr}"


def in_a_new_process(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.strip()


def test_import_starts_no_backend():
    assert in_a_new_process("import jaxfilt; from jax._src import xla_bridge as x; print(len(x._backends))") == "0"


def test_import_pulls_in_nothing_but_the_core_packages():
    code = """
import sys, jax, numpy, optax, jax.numpy
before = {name.split(".")[0] for name in sys.modules}
import jaxfilt
print(sorted({name.split(".")[0] for name in sys.modules} - before - set(sys.stdlib_module_names)))
"""
    assert in_a_new_process(code) == "['jaxfilt']"


def test_what_is_exported_is_documented():
    for name in jaxfilt.__all__:
        thing = getattr(jaxfilt, name)
        if callable(thing) and not isinstance(thing, type) and not isinstance(thing, tuple):
            assert thing.__doc__, f"jaxfilt.{name} has no docstring"
