"""What the command line is asked for, turned into what the library takes; one clear line for every mistake."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxfilt import datasets, files, mismatch, recordings, scenarios, theta_file
from jaxfilt.filters import ckf, ekf, iekf, kf, ukf
from jaxfilt.types import Filter, Model, PyTree, Replay, Scenario

FILTERS: dict[str, Callable[..., Filter]] = {"kf": kf, "ekf": ekf, "iekf": iekf, "ukf": ukf, "ckf": ckf}


class Mistake(Exception):
    """Something that the user can mend, said in one line."""


def at_least(least: int, **named: float) -> None:
    for name, value in named.items():
        if value < least:
            raise Mistake(f"--{name}: expected at least {least}, got {value}")


def one_of(option: str, value: str, choices: Iterable[str]) -> None:
    if value not in choices:
        raise Mistake(f"--{option}: expected one of {', '.join(filter(None, choices))}, got {value!r}")


def listed(text: str) -> list[str]:
    """Names with commas between them."""
    return [name.strip() for name in text.split(",") if name.strip()]


def makers(filters: str) -> dict[str, Callable[..., Filter]]:
    chosen = dict.fromkeys(name.strip() for name in filters.split(","))
    for name in chosen:
        if name not in FILTERS:
            raise Mistake(f"--filter: expected some of {', '.join(FILTERS)}, got {name!r}")
    return {name: FILTERS[name] for name in chosen}


def maker(filter: str) -> Callable[..., Filter]:
    one_of("filter", filter, FILTERS)
    return FILTERS[filter]


def clip(text: str) -> float | dict[str, float] | None:
    """``2`` or ``q=1,gnss=0.5``: the largest norm of the gradient, or of the parts that these names begin."""
    limits: dict[str, float] = {}
    for part in listed(text):
        name, _, value = part.rpartition("=")
        try:
            limits[name] = float(value)
        except ValueError:
            limits[name] = np.nan
    if not all(0 < limit < np.inf for limit in limits.values()) or ("" in limits and len(limits) > 1):
        raise Mistake(f"--clip: expected a norm above 0, or NAME=NORM with commas between, got {text!r}")
    return limits.get("", limits) or None


def noise_factors(texts: list[str], option: str) -> dict[str, list[float]]:
    """``Q=0.5``, ``R=2`` or ``R/gnss=1,2,4`` as name -> factors of covariances."""
    found = {}
    for text in texts:
        name, _, values = text.partition("=")
        try:
            factors = [float(value) for value in values.split(",")]
        except ValueError:
            factors = []
        if not factors or not all(0 <= f < np.inf for f in factors) or not re.fullmatch(r"Q|R(/.+)?", name):
            raise Mistake(f"{option}: expected Q=FACTOR, R=FACTOR or R/SENSOR=FACTOR, got {text!r}")
        found[name] = factors
    return found


def rescaled(model: Model, factors: dict[str, Any]) -> Model:
    """The model with the noises that these factors name multiplied."""
    every = factors.get("R", 1.0)
    R = {name: every * factors.get(f"R/{name}", 1.0) for name in model.sensors}
    unknown = [name for name in factors if name not in ("Q", "R") and name.removeprefix("R/") not in model.sensors]
    if unknown:
        raise Mistake(f"{unknown[0]}: expected a sensor of {', '.join(model.sensors)}")
    return mismatch.scaled(model, Q=factors.get("Q", 1.0), R=R)


CORRUPTIONS = {
    "outliers": "SENSOR:PROBABILITY:SCALE",
    "heavy-tails": "SENSOR:DOF",
    "drop-outs": "SENSOR:PROBABILITY[:LENGTH]",
    "delay": "SENSOR:ROWS",
}
"""What can happen to a sensor's readings, by the name and the numbers that the command line takes."""


def corruption(texts: list[str], model: Callable[[PyTree], Model], theta: PyTree) -> Callable | None:
    """``outliers:gnss:0.05:10`` and the like as a function theta -> corruption, in the order given."""
    if not texts:
        return None
    wanted = []
    for text in texts:
        kind, *rest = text.split(":")
        form = CORRUPTIONS.get(kind)
        if form is None:
            raise Mistake(f"--corrupt: expected one of {', '.join(CORRUPTIONS)}, got {kind!r}")
        try:
            sensor, *numbers = rest
            values = [int(n) if kind == "delay" else float(n) for n in numbers]
            make = getattr(mismatch, kind.replace("-", "_"))
            make(model(theta), sensor, *values)
        except (ValueError, TypeError, KeyError) as error:
            raise Mistake(f"--corrupt: expected {kind}:{form}, got {text!r} ({line(error)})") from None
        wanted.append((make, sensor, values))

    def corrupt(theta: PyTree) -> mismatch.Corruption:
        robot = model(theta)
        return mismatch.several(*[make(robot, sensor, *values) for make, sensor, values in wanted])

    return corrupt


def set_dtype(dtype: str) -> None:
    if dtype not in ("float32", "float64"):
        raise Mistake(f"--dtype: expected float64 or float32, got {dtype!r}")
    jax.config.update("jax_enable_x64", dtype == "float64")


def gate(gate: str, recording: str) -> float | None:
    return probability("gate", gate) if gate else recordings.GATES.get(recording)


def probability(option: str, text: str) -> float | None:
    """A probability, or None for ``none``."""
    if text == "none":
        return None
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not 0 < value < 1:
        raise Mistake(f"--{option}: expected a probability between 0 and 1, or none, got {text!r}")
    return value


def writable(out: str) -> Path:
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Mistake(f"--out: cannot make the folder {folder}: {error.strerror}") from None
    if not os.access(folder, os.W_OK):
        raise Mistake(f"--out: cannot write to the folder {folder}")
    return folder


def theta(path: str, like: PyTree) -> PyTree:
    """The parameters in a file, in the structure of these; these themselves without a path."""
    if not path:
        return like
    try:
        return theta_file.theta_from_json(Path(path).read_text(), like)
    except OSError as error:
        raise Mistake(f"--theta: cannot read {path}: {error.strerror}") from None
    except ValueError as error:
        raise Mistake(f"--theta {path}: {line(error)}") from None


def scenario(target: str, command: str = "study") -> tuple[Scenario, Path | None, str]:
    """The scenario, the user's file that it is from, and a name for it."""
    kinds = "a scenario" if command == "study" else "a scenario or a recording"
    if not target:
        raise Mistake(f"{command}: expected {kinds}; jaxfilt {command} --list shows them")
    if ":" in target or target.endswith(".py"):
        return _own_scenario(target)
    try:
        return scenarios.scenario(target), None, target
    except KeyError as unknown:
        known = "" if command == "study" else f"; or a recording of {', '.join(recordings.names())}"
        raise Mistake(f"{unknown.args[0]}{known}; your own is FILE.py:NAME") from None


def _own_scenario(target: str) -> tuple[Scenario, Path, str]:
    """A user's scenario from FILE.py:NAME."""
    file, _, name = target.rpartition(":")
    if not file:
        raise Mistake(f"{target}: expected FILE.py:NAME, got no name")
    path = Path(file)
    if not path.is_file():
        raise Mistake(f"{target}: there is no file {file}")
    with explained(path):
        module = _module(path)
        thing = getattr(module, name, None)
        if thing is None:
            raise Mistake(f"{target}: {file} has no {name!r}")
        scenario = thing() if callable(thing) and not isinstance(thing, Scenario) else thing
    if not isinstance(scenario, Scenario):
        raise Mistake(f"{target}: expected a Scenario or a function returning one, got {type(scenario).__name__}")
    return scenario, path, f"{path.stem}-{name}"


def _module(path: Path) -> Any:
    """A user's file, run as Python runs a script: its folder first on the path."""
    spec = importlib.util.spec_from_file_location(path.stem, path.resolve())
    if spec is None or spec.loader is None:
        raise Mistake(f"{path}: expected a Python file, by custom .py")
    sys.path.insert(0, str(path.resolve().parent))
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def replay(recording: str, log: str, sequence: str) -> tuple[Replay, Path | None, str]:
    """The replay, the user's file that it is from, and a name for it."""
    if not recording:
        raise Mistake("replay: expected a recording; jaxfilt replay --list shows them")
    if ":" in recording or recording.endswith(".py"):
        if not log:
            raise Mistake(f"{recording}: expected a LOG after it, a file written by jaxfilt.save")
        scenario, path, label = _own_scenario(recording)
        with explained(path):
            model = scenario.model(scenario.theta)
        try:
            recorded = files.load(log, model)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise Mistake(line(error) if log in line(error) else f"{log}: {line(error)}") from None
        own = Replay(
            scenario.model, scenario.belief, scenario.theta, recorded, None, model.space, lambda x: x, scenario.blocks
        )
        return own, path, f"{label}-{Path(log).stem}"
    if log:
        raise Mistake(f"{recording}: expected no LOG after the name of a recording, got {log}")
    try:
        chosen = recordings.replay(recording, sequence or None)
    except (KeyError, FileNotFoundError) as error:
        raise Mistake(line(error)) from None
    return chosen, None, f"{recording}-{sequence}" if sequence else recording


def recorded(name: str, train: list[str], test: list[str]) -> tuple[dict[str, Replay], dict[str, Replay]]:
    """Sequences of a recording by name, to learn from and to report on.

    Of nothing said, the last is reported on; of a test alone, all others are learned from; of a training alone, nothing
    is reported on but a part of its own time.
    """
    every = datasets.sequences(name)
    if not train and not test and len(every) > 1:
        test = [every[-1]]
    train = train or [sequence for sequence in every if sequence not in test]
    both = [sequence for sequence in train if sequence in test]
    if both or not train:
        raise Mistake(f"--test-sequence: expected others than those to learn from, got {', '.join(both or test)}")
    try:
        first, second = ({sequence: recordings.replay(name, sequence) for sequence in part} for part in (train, test))
    except (KeyError, FileNotFoundError) as error:
        raise Mistake(line(error)) from None
    return first, second


@contextlib.contextmanager
def explained(path: Path | None) -> Iterator[None]:
    """Whatever a user's file does wrong, in one line with its place in the file; the library's own faults pass."""
    try:
        yield
    except SyntaxError as error:
        if path is None or error.filename is None or Path(error.filename).resolve() != path.resolve():
            raise
        raise Mistake(f"{path}:{error.lineno}: SyntaxError: {error.msg}") from None
    except Exception as error:
        if path is None or isinstance(error, Mistake):
            raise
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if Path(frame.filename).resolve() == path.resolve()]
        if lines:
            raise Mistake(f"{path}:{lines[-1]}: {type(error).__name__}: {line(error)}") from None
        if isinstance(error, (ValueError, TypeError, KeyError)):
            raise Mistake(f"{path}: {line(error)}") from None
        raise


def line(error: Exception) -> str:
    """An exception's text as one line; a KeyError's without the quotes that Python adds."""
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return " ".join(text.split())
