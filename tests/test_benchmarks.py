"""The benchmarks: whoever is here gets the reference's answer; tables, gate and clock say what they should."""

import contextlib
import json
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks import gate, measure, plot, reference, systems, tables, workloads
from benchmarks.__main__ import BEGIN, END, written
from benchmarks.contestants import REGISTRY, Entry, Unable

NO_COMPILER = not any(map(shutil.which, ("gcc", "clang")))
HERE = [
    name for name, c in REGISTRY.items() if not (c.missing() or c.xla or (c.module == "native" and NO_COMPILER))
]  # fmt: skip
CASES = [
    (work, name)
    for work in ("W1", "W2", "W3", "W4", "W5", "W8")
    for name in HERE
    if workloads.WORKLOADS[work].kind in REGISTRY[name].kinds
]
SIZES = {"W5": 3, "W8": 1}


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    folder = tmp_path_factory.mktemp("readings")
    return lambda work, dtype="float64": workloads.problem(work, SIZES.get(work, 11), 12, dtype, folder)


@contextlib.contextmanager
def as_they_like_it(module):
    """The rivals were not written for a JAX as strict as in these tests."""
    if module in ("ours", "naive"):
        yield
        return
    with warnings.catch_warnings(), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        warnings.simplefilter("ignore")
        yield


@pytest.mark.parametrize(("work", "name"), CASES)
def test_everybody_here_gets_the_answer(problem, work, name):
    contestant = REGISTRY[name]
    with as_they_like_it(contestant.module):
        record = measure.measured(contestant, problem(work), repeats=1, seconds=0.0)
    off = [record[key] for key in ("mean_off", "variance_off", "value_off", "gradient_off") if key in record]
    assert len(off) == 2, record
    assert max(off) < (1e-5 if name == "dynamax" else 1e-10)
    assert record["run"] > 0


@pytest.mark.parametrize("work", ["W1", "W2", "W3", "W4", "W5"])
def test_lanes_are_as_right_as_xla(problem, work):
    off = []
    for name in ("jaxfilt lanes", "jaxfilt xla"):
        record = measure.measured(REGISTRY[name], problem(work), repeats=1, seconds=0.0)
        off.append([record[key] for key in ("mean_off", "variance_off", "value_off", "gradient_off") if key in record])
    for lanes, xla in zip(*off, strict=True):
        assert lanes <= 3 * xla + 1e-13


@pytest.mark.parametrize("name", [name for name in ("jaxfilt xla", "NumPy", "C", "C, dense") if name in HERE])
def test_float32_is_float32(problem, name):
    found = problem("W2", "float32")
    entry = REGISTRY[name].prepare(found)
    means, variances = entry.fetch(entry.run(), 11)
    assert means.dtype == variances.dtype == np.float32
    assert np.abs(means - found.means).max() < 1e-4


@pytest.mark.parametrize("name", systems.SYSTEMS)
def test_jacobians_by_hand_are_those_of_complex_steps(name):
    system = systems.SYSTEMS[name]
    x = np.random.default_rng(3).uniform(0.1, 0.8, (5, system.n))
    u = system.inputs(7)[6]
    by_hand = systems.transition(system, x, u)
    np.testing.assert_allclose(by_hand, reference.jacobian(lambda s: systems.moved(system, s, u), x), atol=1e-14)


def test_the_truth_is_covered_by_the_answer(tmp_path):
    found = workloads.problem("W2", 16, 100, folder=tmp_path)
    squares = (found.truth - found.means) ** 2 / found.variances
    assert 0.9 < squares.mean() < 1.1


def test_readings_are_made_once(tmp_path, monkeypatch):
    first = workloads.problem("W1", 3, 5, folder=tmp_path)
    monkeypatch.setattr(workloads, "simulated", None)
    again = workloads.problem("W1", 3, 5, folder=tmp_path)
    np.testing.assert_array_equal(first.z, again.z)
    assert len(list(tmp_path.iterdir())) == 1


def record(name, run=1.0, **more):
    base = {"workload": "W2", "contestant": name, "runs": 100, "steps": 10, "dtype": "float64", "run": run}
    base |= {"compile": 0.0, "runs_done": 100, "load": 0.0, "peak_memory": 80.0, "note": "", "mean_off": 1e-12}
    return base | {"variance_off": 1e-13} | more


def unable(name, why):
    which = {"workload": "W2", "contestant": name, "runs": 100, "steps": 10, "dtype": "float64"}
    return which | {"unable": why}


RECORDS = [
    record("C, limit", 0.01),
    unable("dynamax", "dynamax is not installed"),
    record("filterpy", 40.0, runs_done=2, load=0.5),
    record("naive JAX", 2.0, compile=1.5),
    record("jaxfilt lanes", 0.05, compile=0.4, note="look"),
]


def test_the_table_has_a_row_for_everybody_and_the_ratios():
    rows = {row.split("|")[1].strip(): row for row in tables.tables(RECORDS).splitlines() if row.startswith("| ")}
    assert list(rows) == ["contestant", "jaxfilt lanes", "naive JAX", "dynamax", "filterpy", "C, limit"]
    assert {row.count("|") for row in rows.values()} == {len(tables.HEADS) + 1}
    ours = [cell.strip() for cell in rows["jaxfilt lanes"].split("|")[1:-1]]
    assert ours == ["jaxfilt lanes", "400 ms", "50 ms", "5e+04", "40", "5", "80", "1e-12, 1e-13", "look"]
    assert "dynamax is not installed" in rows["dynamax"]
    assert "40 s*!" in rows["filterpy"]


def test_the_last_record_of_a_contestant_counts():
    [rows] = tables.group([*RECORDS, record("naive JAX", 3.0)]).values()
    assert rows["naive JAX"]["run"] == 3.0


def test_the_gate_fails_on_a_worse_ratio_and_on_nothing_else():
    baseline = gate.ratios(RECORDS)
    assert baseline == {"W2 jaxfilt lanes float64 100": 40.0}
    assert gate.failures(RECORDS, baseline) == []
    slower = [*RECORDS, record("jaxfilt lanes", 0.05 / gate.SLACK * 1.01)]
    [said] = gate.failures(slower, baseline)
    assert "jaxfilt lanes" in said
    assert gate.failures([*RECORDS, record("jaxfilt lanes", 0.05 / gate.SLACK * 0.99)], baseline) == []
    everything = [r | {"run": 3 * r["run"]} if "run" in r else r for r in RECORDS]
    assert gate.failures(everything, baseline) == []


def test_the_gate_fails_on_a_wrong_answer_and_on_none():
    baseline = gate.ratios(RECORDS)
    for off in (1e-3, float("nan")):
        [said] = gate.failures([*RECORDS, record("jaxfilt lanes", 0.05, mean_off=off)], baseline)
        assert "off by" in said
    [said] = gate.failures([*RECORDS, unable("jaxfilt lanes", "fails: it does")], baseline)
    assert said.endswith("fails: it does")
    assert gate.failures([*RECORDS, unable("dynamax", "fails: it does")], baseline) == []


def test_the_baseline_keeps_what_was_not_measured(tmp_path):
    path = tmp_path / "baseline.json"
    path.write_text(json.dumps({"W1 jaxfilt xla float64 100": 2.0}))
    gate.write(RECORDS, path)
    assert gate.read(path) == {"W1 jaxfilt xla float64 100": 2.0, "W2 jaxfilt lanes float64 100": 40.0}


def test_the_clock_leaves_out_the_first_call_and_brings_up_a_few_runs(problem, monkeypatch):
    now = iter(np.cumsum([0.0, 5.0, 0.0, 0.0, 1.0, 0.0, 3.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0]).tolist())
    monkeypatch.setattr(measure.machine, "_busy", lambda: 0.0)
    monkeypatch.setattr(measure.time, "perf_counter", lambda: next(now))
    calls = []
    entry = Entry(lambda: calls.append(0) or len(calls), lambda found, k: (), runs=2)
    found, last = measure.timed(entry, problem("W1"), repeats=3, seconds=100.0)
    assert (len(calls), last, found["repeats"], found["runs_done"]) == (4, 4, 3, 2)
    assert found["compile"] == 3.0  # 5 s, less the median of 1, 3 and 2
    assert (found["least"], found["run"], found["most"]) == (1.0 * 11 / 2, 2.0 * 11 / 2, 3.0 * 11 / 2)


def test_what_nobody_does_is_a_row(problem):
    with pytest.raises(Unable, match="has no ukf"):
        REGISTRY["C, dense"].prepare(problem("W4"))
    assert measure.measured(REGISTRY["C, dense"], problem("W4"), 1, 0.0) == {"unable": "has no ukf"}


def test_a_figure_for_each_workload_that_has_two_sizes(tmp_path):
    more = [record("jaxfilt lanes", 0.4, runs=1000), record("naive JAX", 20.0, runs=1000)]
    assert plot.curves(RECORDS) == {}
    assert plot.curves([*RECORDS, *more])["W2", "float64"] == {
        "jaxfilt lanes": [(100, 0.05), (1000, 0.4)],
        "naive JAX": [(100, 2.0), (1000, 20.0)],
    }
    [path] = plot.draw([*RECORDS, *more], tmp_path)
    assert path.name == "W2-float64.svg"
    assert "<svg" in path.read_text()


def test_the_readme_is_written_between_its_marks():
    readme = f"before\n{BEGIN}\nold\n{END}\nafter\n"
    once = written(readme, "new")
    assert once == f"before\n{BEGIN}\n\nnew\n\n{END}\nafter\n"
    assert written(once, "new") == once


def test_the_command_measures_in_new_processes(tmp_path):
    command = [sys.executable, "-m", "benchmarks", "--only", "W1", "--contestants", "NumPy", "cuthbert"]
    command += ["--runs", "3", "--steps", "5", "--repeats", "1", "--wait", "0", "--limit", "100"]
    command += ["--json", str(tmp_path / "records")]
    root = Path(measure.__file__).parent.parent
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=root)
    rows = [line for line in done.stdout.splitlines() if line.startswith(("| NumPy", "| cuthbert"))]
    assert len(rows) == 2
    first, second = map(json.loads, (tmp_path / "records").read_text().splitlines())
    assert {first["contestant"], second["contestant"]} == {"NumPy", "cuthbert"}
    numpy = first if first["contestant"] == "NumPy" else second
    assert numpy["mean_off"] < 1e-10
