"""A study or a sweep as labelled arrays, for figures of your own and for NetCDF. Needs xarray, imported when used."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxfilt import checkpoint
from jaxfilt.consistency import Consistency
from jaxfilt.report.summary import component_names
from jaxfilt.scores import STATE, Scores
from jaxfilt.study import Study
from jaxfilt.sweep import Sweep
from jaxfilt.types import PyTree

if TYPE_CHECKING:
    from xarray import Dataset

Variables = dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]]
"""name -> dimensions, values, attributes"""

TEST = ("mean", "expected", "low", "high", "p")


def to_xarray(result: Study | Sweep) -> Dataset:
    """All scores of a study or a sweep as labelled arrays.

    Dimensions: filter, time, block, part (the whole state and each block), component and component_ (of the tangent
    space), sensor, lag, probability, error_bin and nees_bin (histograms), example (runs kept whole), pair; of a sweep
    first one for each parameter. Units in SI are in the attribute ``units`` of a variable, or, where blocks differ, in
    the coordinates ``block_units`` and ``component_units``.

    What has a ``_error`` beside it is a Monte Carlo estimate with its standard error; what has ``_expected``, ``_low``,
    ``_high`` and ``_p`` is a mean with its test; ``_total`` is over runs and time. Names are those of `Scores`. NaN is
    what is unknown. ``truth``, ``estimate`` and ``covariance`` of the first runs are tangent vectors from the space's
    origin: a vector's own coordinates, an angle's value.

    Raises:
        ModuleNotFoundError: xarray is missing; the text says how to get it.

    Example:
        >>> import jax, jax.numpy as jnp, jaxfilt as jf
        >>> from jaxfilt.study import study
        >>> def walk(theta):
        ...     return jf.linear(A=jnp.eye(1), H=jnp.eye(1), Q=jnp.eye(1), R=jnp.eye(1))
        >>> def start(theta):
        ...     return jf.Gaussian(jnp.zeros(1), jnp.eye(1))
        >>> log = jf.schedule(walk(()), steps=20, dt=1.0)
        >>> filters = {"kf": lambda theta: jf.kf(walk(theta))}
        >>> data = to_xarray(study(walk, filters, start, log, jax.random.key(0), theta=(), runs=30))
        >>> data.rmse.sel(filter="kf", block="x[0]").shape, data.time.units
        ((20,), 's')
    """
    try:
        import xarray
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            f"labelled arrays need xarray: pip install 'jaxfilt[data]' ({missing})", name=missing.name
        ) from None
    if isinstance(result, Study):
        first, over, variables = result, {}, _variables(result)
    else:
        first = result.studies.flat[0]
        every = [_variables(s) for s in result.studies.flat]
        taken = {*_coordinates(first), *every[0]}
        over = {f"{name}_value" if name in taken else name: values for name, values in result.over.items()}
        shape = result.studies.shape
        variables = {
            name: ((*over, *dims), np.stack([v[name][1] for v in every]).reshape(shape + values.shape), attributes)
            for name, (dims, values, attributes) in every[0].items()
        }
    coordinates = {name: ((name,), values) for name, values in over.items()} | _coordinates(first)
    return xarray.Dataset(variables, coordinates, _attributes(result))


def netcdf(result: Study | Sweep) -> bytes:
    """`to_xarray` as a NetCDF-3 file, which every NetCDF reader knows and which needs nothing but scipy to write.

    Raises:
        ModuleNotFoundError: xarray is missing; the text says how to get it.
    """
    return bytes(to_xarray(result).to_netcdf(engine="scipy"))


def _attributes(result: Study | Sweep) -> dict[str, Any]:
    """Texts and numbers that NetCDF-3 can hold: a seed may be too large for its integers."""
    s: Study = result if isinstance(result, Study) else result.studies.flat[0]
    about = {"seed": str(s.seed), "runs": s.runs, "planned": s.planned, "steps": s.steps, "dtype": s.dtype}
    about |= {"confidence": s.confidence, "chunk": s.chunk, "sample": s.sample}
    if isinstance(result, Study):
        about["theta"] = json.dumps(checkpoint.named(s.theta))
        about["truth_theta"] = json.dumps(checkpoint.named(s.truth_theta))
    return about | {f"made_with_{what}": value for what, value in checkpoint.made_with().items()}


def _coordinates(s: Study) -> dict[str, Any]:
    one = next(iter(s.scores.values()))
    units = {i: unit for index, unit in reversed(list(s.blocks.values())) for i in index}
    components = component_names(s.blocks, s.space.dim)
    coordinates = {
        "filter": (("filter",), list(s.scores)),
        "time": (("time",), s.t, {"units": "s", "long_name": "time since the start"}),
        "block": (("block",), list(s.blocks)),
        "block_units": (("block",), [unit or "1" for _, unit in s.blocks.values()]),
        "part": (("part",), [STATE, *s.blocks]),
        "component": (("component",), components),
        "component_": (("component_",), components),
        "component_units": (("component",), [units.get(i) or "1" for i in range(s.space.dim)]),
        "sensor": (("sensor",), list(one.nis)),
        "probability": (("probability",), list(one.coverage), {"units": "1"}),
        "lag": (("lag",), _lags(one), {"units": "readings"}),
        "error_bin": (("error_bin",), _middle(one.histogram.edges), {"units": "claimed standard deviations"}),
        "nees_bin": (("nees_bin",), _middle(one.run_nees.edges), {"units": "1"}),
    }
    if s.paired:
        coordinates |= {"pair": (("pair",), [f"{a} - {b}" for a, b in s.paired])}
    return coordinates


def _lags(scores: Scores) -> np.ndarray:
    return np.asarray(next(iter(scores.whiteness.values())).lags, np.int32)


def _middle(edges: np.ndarray) -> np.ndarray:
    return 0.5 * (edges[1:] + edges[:-1])


def _variables(s: Study) -> Variables:
    found: Variables = {}

    def put(name: str, dims: tuple[str, ...], values: Any, units: str = "", about: str = "") -> None:
        attributes = {key: text for key, text in (("units", units), ("long_name", about)) if text}
        found[name] = dims, np.asarray(values, np.float64), attributes

    def each(name: str, dims: tuple[str, ...], of: Callable[[Scores], Any], units: str = "", about: str = "") -> None:
        put(name, ("filter", *dims), [of(c) for c in s.scores.values()], units, about)

    def estimate(name: str, dims: tuple[str, ...], of: Callable[[Scores], Any], about: str, units: str = "") -> None:
        each(name, dims, lambda c: np.asarray(of(c), float)[..., 0], units, about)
        each(f"{name}_error", dims, lambda c: np.asarray(of(c), float)[..., 1], units, f"standard error of {name}")

    def test(name: str, dims: tuple[str, ...], of: Callable[[Scores], list[Consistency]], about: str) -> None:
        for k, field in enumerate(TEST):
            suffix = "" if field == "mean" else f"_{field}"
            each(name + suffix, dims, lambda c, k=k: [test[k] for test in of(c)], "1", about if not suffix else "")

    parts, blocks = [STATE, *s.blocks], list(s.blocks)
    one = next(iter(s.scores.values()))
    for name, dims, about in (("rmse", ("block", "time"), ""), ("rmse_total", ("block",), ", over runs and time")):
        of = lambda c, name=name: [_pairs(getattr(c, name)[b]) for b in blocks]  # noqa: E731
        estimate(name, dims, of, f"root mean square error{about}, in block_units")
    each("claimed", ("block", "time"), lambda c: [c.claimed[b] for b in blocks], about="rmse as the filter expects it")
    each("worst", ("block",), lambda c: [c.worst[b].value for b in blocks], about="largest error, in block_units")
    each("worst_run", ("block",), lambda c: [c.worst[b].run for b in blocks], about="number of the run that has it")
    estimate("bias", ("time", "component"), lambda c: _pairs(c.bias), "mean of truth - estimate")
    each("mse", ("time", "component", "component_"), lambda c: c.mse, about="mean of e e'")
    for k, field in enumerate(TEST):
        suffix = "" if field == "mean" else f"_{field}"
        each(f"normalised_error{suffix}", ("component",), lambda c, k=k: c.normalised_error[k], "1")
    test("nees", ("part", "time"), lambda c: [c.nees[p] for p in parts], "ANEES")
    test("nees_total", ("part",), lambda c: [c.nees_total[p] for p in parts], "ANEES over runs and time")
    levels = list(one.coverage)
    test("coverage", ("probability", "time"), lambda c: [c.coverage[p] for p in levels], "share inside the ellipsoid")
    test("coverage_total", ("probability",), lambda c: [c.coverage_total[p] for p in levels], "share, runs and time")
    estimate("log_score", ("time",), lambda c: _pairs(c.log_score), "mean of log N(e; 0, P)", "1")
    estimate("log_score_total", (), lambda c: _pairs(c.log_score_total), "the same, over runs and time", "1")
    each("noncredibility", ("time",), lambda c: c.noncredibility, "dB", "noncredibility index")
    each("inclination", ("time",), lambda c: c.inclination, "dB", "inclination indicator")
    sensors = list(one.nis)
    test("nis", ("sensor", "time"), lambda c: [c.nis[k] for k in sensors], "ANIS")
    test("nis_total", ("sensor",), lambda c: [c.nis_total[k] for k in sensors], "ANIS over runs and time")
    each("refused", ("sensor",), lambda c: [c.refused[k] for k in sensors], "1", "readings that a gate refused")
    white = lambda field: lambda c: [getattr(c.whiteness[k], field) for k in sensors]  # noqa: E731
    each("autocorrelation", ("sensor", "lag"), white("autocorrelation"), "1", "of the normalised innovations")
    each("autocorrelation_bound", ("sensor", "lag"), white("bound"), "1")
    each("error_histogram", ("component", "error_bin"), lambda c: c.histogram.counts, "1", "of normalised errors")
    each("run_nees_histogram", ("nees_bin",), lambda c: c.run_nees.counts, "1", "of the runs' own average NEES / n")
    put("diverged", ("filter",), [s.diverged[f].runs for f in s.scores], "1", "runs that diverged")
    if s.paired:
        pairs = list(s.paired.values())
        for k, suffix in enumerate(("", "_error")):
            square = [[p.square[b][k] for b in blocks] for p in pairs]
            put(f"paired_square{suffix}", ("pair", "block"), square, about="the first less the second")
            put(f"paired_log_score{suffix}", ("pair",), [p.log_score[k] for p in pairs], "1")
    put("truth", ("example", "time", "component"), _vectors(s, s.truth))
    put("estimate", ("filter", "example", "time", "component"), [_vectors(s, s.tracks[f].mean) for f in s.scores])
    covariance = [np.asarray(s.tracks[f].cov) for f in s.scores]
    put("covariance", ("filter", "example", "time", "component", "component_"), covariance)
    return found


def _pairs(estimate: Any) -> np.ndarray:
    """Value and standard error side by side, on a last axis."""
    return np.stack([np.asarray(a, float) for a in estimate], -1)


def _vectors(s: Study, points: PyTree) -> np.ndarray:
    """Points (examples, T, ...) as tangent vectors (examples, T, n) from the space's origin."""
    origin = jax.tree.map(lambda o, p: jnp.asarray(o, p.dtype), s.space.origin, points)
    if not len(jax.tree.leaves(points)[0]):
        return np.zeros((0, s.steps, s.space.dim))
    return np.asarray(jax.jit(jax.vmap(jax.vmap(s.space.minus, (0, None)), (0, None)))(points, origin))
