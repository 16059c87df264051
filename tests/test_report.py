"""Reports: the plain data, the labelled arrays, the figures and the files, of studies, sweeps and replays."""

import importlib.util
import json
import os
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import jaxfilt as jf
from jaxfilt import report
from jaxfilt.bound import Bound
from jaxfilt.report import arrays, drawing, figures
from jaxfilt.report.summary import summary
from jaxfilt.review import replayed
from jaxfilt.study import study
from jaxfilt.sweep import sweep

THETA = {"r": 0.1, "q": 0.012345678901}
BLOCKS = {"place": ((0, 1), "m"), "rest": ((2,), "")}


def model(theta):
    """Three walks; what is seen of the last one breaks where it is below -1.5."""

    def h(x, c):
        return jnp.where(x[2:] > -1.5, x[2:], jnp.nan)

    sensors = {
        "gnss": jf.Sensor(lambda x, c: x[:2], jf.const(theta["r"] * jnp.eye(2)), jf.vector(2)),
        "eye": jf.Sensor(h, jf.const(theta["r"] * jnp.eye(1)), jf.vector(1)),
    }
    return jf.Model(lambda x, u, dt: x, jf.const(theta["q"] * jnp.eye(3)), jf.vector(3), sensors)


def belief(theta):
    return jf.Gaussian(jnp.zeros(3), 0.3 * jnp.eye(3))


def plan():
    return jf.schedule(model(THETA), 20, 0.5, every={"eye": 4})


FILTERS = {"ekf": lambda theta: jf.ekf(model(theta)), "$_<b>": lambda theta: jf.ekf(model(theta), gate={"gnss": 0.99})}


@pytest.fixture(scope="module")
def broken():
    """Of 150 runs some meet the sensor's fault."""
    return study(model, FILTERS, belief, plan(), jax.random.key(1), theta=THETA, runs=150, blocks=BLOCKS, examples=2)


@pytest.fixture(scope="module")
def bound():
    """Any, that changes over time."""
    cov = 0.01 * (2 - np.linspace(0, 1, 20))[:, None, None] * np.eye(3)
    return Bound(cov, 1.2 * cov, False, "approximate: made up")


@pytest.fixture(scope="module")
def swept():
    over = {"q": np.array([0.01, 0.1]), "r": np.array([0.05, 0.1, 0.2])}
    return sweep(
        model, {"ekf": FILTERS["ekf"]}, belief, plan(), jax.random.key(1), over, theta=lambda q, r: {"r": r, "q": q},
        truth_theta=THETA, runs=30, blocks=BLOCKS,
    )  # fmt: skip


@pytest.fixture(scope="module")
def drive():
    """One simulated run as a recording; the truth knows the place alone, and not all the time; and without it."""
    log = jf.schedule(model(THETA), 60, 0.5)
    truth, log = jf.simulate(model(THETA), belief(THETA), log, jax.random.key(3))
    known = jf.Truth(np.asarray(truth[:, :2]), np.arange(60) % 3 > 0)
    recording = jf.Recording(jax.tree.map(np.asarray, log), 1e9 + 0.5 * np.arange(60))
    view = lambda x: x[:2]  # noqa: E731
    drive = jf.Replay(model, belief, THETA, recording, known, jf.vector(2), view, {"place": ((0, 1), "m")})
    return [replayed(each, {"ekf": FILTERS["ekf"]}) for each in (drive, drive._replace(truth=None))]


# --- plain data -------------------------------------------------------------------------------------------------------


def test_a_summary_has_what_the_study_has(broken, bound):
    found = json.loads(json.dumps(summary(broken, "walks", bound, "make it"), allow_nan=False))
    assert (found["schema"], found["name"], found["command"]) == ("jaxfilt.study/2", "walks", "make it")
    assert found["complete"] is True
    assert found["verdicts"]["ekf"]["headline"] == broken.verdicts["ekf"].headline
    scores, ekf = broken.scores["ekf"], found["filters"]["ekf"]
    near = lambda value: pytest.approx(value, rel=1e-5)  # noqa: E731
    place = ekf["blocks"]["place"]
    assert place["unit"] == "m"
    assert place["rmse"] == {
        "value": near(scores.rmse_total["place"].value),
        "error": near(scores.rmse_total["place"].error),
    }
    assert place["claimed"] == near(np.sqrt((scores.claimed["place"] ** 2).mean()))
    assert place["worst"] == {"value": near(scores.worst["place"].value), "run": scores.worst["place"].run}
    mean_bound, mean_mse = (np.trace(a[:, :2, :2], axis1=1, axis2=2).mean() for a in (bound.cov, scores.mse))
    assert place["efficiency"] == near(mean_bound / mean_mse)
    assert found["bound"]["rmse"]["place"] == near(np.sqrt(mean_bound))
    nees = ekf["state"]["nees"]
    assert nees["ratio"] == near(scores.nees_total["state"].mean / 3)
    assert found["filters"]["$_<b>"]["sensors"]["gnss"]["refused"] > 0
    assert nees["p"] == near(scores.nees_total["state"].p)
    assert ekf["state"]["coverage"]["0.9"]["mean"] == near(scores.coverage_total[0.9].mean)
    assert ekf["components"]["place[1]"]["normalised_error"]["mean"] == near(scores.normalised_error.mean[1])
    assert ekf["sensors"]["gnss"]["nis"]["mean"] == near(scores.nis_total["gnss"].mean)
    assert ekf["sensors"]["gnss"]["whiteness"]["autocorrelation"][0] == near(
        scores.whiteness["gnss"].autocorrelation[0]
    )
    known = scores.noncredibility[np.isfinite(scores.noncredibility)]
    assert ekf["state"]["noncredibility"] == near(known.mean())
    over = ekf["over_time"]
    assert over["t"][-1] == near(10.0)
    assert [v is None for v in over["nis"]["eye"]["mean"]] == [k % 4 != 3 for k in range(20)]
    (pair,) = found["paired"]
    assert (pair["first"], pair["second"]) == ("ekf", "$_<b>")
    assert pair["square"]["place"]["unit"] == "m^2"
    assert pair["square"]["place"]["value"] == near(broken.paired["ekf", "$_<b>"].square["place"].value)


def test_broken_runs_are_told_with_step_and_sensor(broken):
    found = summary(broken)["filters"]["ekf"]
    lost = broken.diverged["ekf"]
    assert 0 < lost.runs < 150
    assert found["diverged"] == {
        "runs": lost.runs,
        "share": pytest.approx(lost.runs / 150, rel=1e-5),
        "first": [*lost.first],
    }
    assert found["fault"]["sensor"] == "eye"
    assert found["fault"]["step"] % 4 == 3
    assert found["fault"]["status"] in ("BAD_MEASUREMENT", "BAD_PREDICTION")
    assert found["kept"]["runs"] == 150 - lost.runs
    assert found["kept"]["rmse"]["rest"]["value"] > 0


def test_parameters_keep_all_their_digits_and_an_unfinished_study_says_so(broken):
    found = summary(broken._replace(planned=400))
    assert found["settings"]["theta"] == {"q": 0.012345678901, "r": 0.1}
    assert found["complete"] is False
    assert found["settings"]["planned"] == 400


def test_a_sweep_has_a_point_for_each_setting(swept):
    found = json.loads(json.dumps(summary(swept, "grid"), allow_nan=False))
    assert found["schema"] == "jaxfilt.sweep/1"
    assert found["over"] == {"q": [0.01, 0.1], "r": [0.05, 0.1, 0.2]}
    assert [p["at"] for p in found["points"][:4]] == [
        {"q": 0.01, "r": 0.05}, {"q": 0.01, "r": 0.1}, {"q": 0.01, "r": 0.2}, {"q": 0.1, "r": 0.05},
    ]  # fmt: skip
    assert found["points"][3]["theta"] == {"q": 0.1, "r": 0.05}
    own = swept.studies[1, 0].scores["ekf"].rmse_total["place"].value
    assert found["points"][3]["filters"]["ekf"]["blocks"]["place"]["rmse"]["value"] == pytest.approx(own, rel=1e-5)


def test_a_replay_is_summed_up_with_and_without_its_truth(drive):
    seen, blind = drive
    found = summary(seen)
    assert found["schema"] == "jaxfilt.replay/2"
    review, ekf = seen.reviews["ekf"], found["filters"]["ekf"]
    assert found["verdicts"]["ekf"]["headline"] == review.verdict.headline
    assert ekf["blocks"]["place"] == {"unit": "m", "rmse": pytest.approx((review.rmse or {})["place"], rel=1e-5)}
    assert ekf["sensors"]["gnss"]["nis"]["verdict"] == "inside"
    assert ekf["state"]["nees"]["expected"] == 2
    nothing = summary(blind)["filters"]["ekf"]
    assert nothing["blocks"] is nothing["state"] is None
    assert nothing["sensors"]["gnss"]["nis"] == ekf["sensors"]["gnss"]["nis"]


# --- labelled arrays --------------------------------------------------------------------------------------------------


def test_labelled_arrays_are_the_scores(broken):
    data, scores = arrays.to_xarray(broken), broken.scores["$_<b>"]
    own = data.sel(filter="$_<b>")
    np.testing.assert_array_equal(own.rmse.sel(block="place"), scores.rmse["place"].value)
    np.testing.assert_array_equal(own.rmse_error.sel(block="rest"), scores.rmse["rest"].error)
    np.testing.assert_array_equal(own.nees_high.sel(part="state"), scores.nees["state"].high)
    np.testing.assert_array_equal(own.nis.sel(sensor="eye"), scores.nis["eye"].mean)
    np.testing.assert_array_equal(own.coverage_total.sel(probability=0.5), scores.coverage_total[0.5].mean)
    np.testing.assert_array_equal(
        own.autocorrelation.sel(sensor="gnss", lag=2), scores.whiteness["gnss"].autocorrelation[1]
    )
    np.testing.assert_array_equal(own.mse.transpose("time", ...), scores.mse)
    np.testing.assert_array_equal(own.estimate, broken.tracks["$_<b>"].mean)
    np.testing.assert_array_equal(own.covariance, broken.tracks["$_<b>"].cov)
    np.testing.assert_array_equal(data.truth, broken.truth)
    assert own.run_nees_histogram.sum() == scores.run_nees.counts.sum()
    assert data.diverged.sel(filter="ekf") == broken.diverged["ekf"].runs
    pair = data.paired_square.sel(pair="ekf - $_<b>", block="place")
    assert pair == broken.paired["ekf", "$_<b>"].square["place"].value
    assert data.block_units.sel(block="place") == "m"
    assert data.time.units == "s"
    assert json.loads(data.attrs["theta"]) == THETA


def test_a_sweep_has_its_parameters_as_dimensions(swept):
    data = arrays.to_xarray(swept)
    np.testing.assert_array_equal(
        data.rmse_total.sel(filter="ekf", block="place"),
        swept.curve(lambda s: s.scores["ekf"].rmse_total["place"].value),
    )
    assert data.rmse_total.sel(q=0.1, r=0.2).dims == ("filter", "block")
    clash = swept._replace(over={"time": swept.over["q"], "r": swept.over["r"]})
    assert arrays.to_xarray(clash).sizes["time_value"] == 2


def test_netcdf_comes_back_the_same(broken, swept, tmp_path):
    large = broken._replace(seed=2**60)  # more than the format's integers hold
    for name, result in {"study": large, "sweep": swept}.items():
        (tmp_path / f"{name}.nc").write_bytes(arrays.netcdf(result))
        back = xarray.load_dataset(tmp_path / f"{name}.nc", engine="scipy")
        xarray.testing.assert_equal(back, arrays.to_xarray(result))
    assert int(xarray.load_dataset(tmp_path / "study.nc", engine="scipy").attrs["seed"]) == 2**60


# --- figures ----------------------------------------------------------------------------------------------------------


def drawn(figure):
    """The number of finite points of each panel's lines and areas."""
    counts = []
    for axes in figure.axes:
        lines = [np.isfinite(np.asarray(line.get_ydata(), float)).sum() for line in axes.lines]
        counts.append(sum(lines) + len(axes.collections) + len(axes.patches) + len(axes.images) + len(axes.texts))
    return counts


def test_no_panel_is_empty(broken, swept, drive, bound):
    curve = swept._replace(over={"q": swept.over["q"]}, studies=swept.studies[:, 0])
    one_run = broken._replace(scores={"ekf": broken.scores["ekf"]}, truth=broken.truth[:0], tracks={})
    three = swept._replace(over=swept.over | {"s": np.array([1, 2])}, studies=np.stack([swept.studies] * 2, -1))
    for result in [broken, one_run, swept, curve, three, *drive]:
        assert min(drawn(figures.overview(result, "any", bound))) > 0
        for picture in figures.pictures(result, bound):
            assert min(drawn(picture.figure)) > 0, picture.title
    for picture in figures.pictures(curve):
        assert figures.svg(picture.figure).startswith(b"<?xml")


def test_a_figure_shows_the_bound_and_the_claim(broken, bound):
    error, *_ = figures.pictures(broken, bound)
    place = error.figure.axes[0]
    series = [np.asarray(line.get_ydata()) for line in place.lines]
    expected = [broken.scores["ekf"].rmse["place"].value, broken.scores["ekf"].claimed["place"]]
    expected.append(np.sqrt(np.trace(bound.cov[:, :2, :2], axis1=1, axis2=2)))
    for one in expected:
        assert any(len(one) == len(s) and np.allclose(s, one, rtol=1e-6) for s in series)
    assert place.get_ylabel() == "place (m)"
    names = [text.get_text() for text in error.figure.legends[0].get_texts()]
    assert "approximate bound" in names
    assert r"\$_<b>" in names  # the dollar sign begins no formula, the underscore hides nothing


def test_long_lines_become_pixels_and_the_same_figure_the_same_bytes():
    pages = []
    for _ in range(2):
        fig, (axes,) = drawing.grid(1)
        axes.plot(np.sin(np.arange(20_000) * 12.9898))
        pages.append(figures.svg(fig))
    assert len(pages[0]) < 150_000
    assert pages[0] == pages[1]


def test_an_ellipse_is_where_the_quadratic_form_is_the_quantile():
    P = np.array([[4.0, 1.5], [1.5, 1.0]])
    points = drawing.ellipse(np.array([1.0, -2.0]), P) - np.array([[1.0], [-2.0]])
    squares = np.einsum("ik,ij,jk->k", points, np.linalg.inv(P), points)
    np.testing.assert_allclose(squares, -2 * np.log(0.01), rtol=1e-9)


# --- files ------------------------------------------------------------------------------------------------------------


def test_all_files_are_written_whole(broken, bound, tmp_path):
    out = report.write(broken, tmp_path / "new" / "folder", "walks", bound=bound, command="make it")
    assert sorted(p.name for p in out.iterdir()) == sorted(report.files(broken))
    assert json.loads((out / "summary.json").read_text()) == summary(broken, "walks", bound, "make it")
    assert (out / "study.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "report.html").read_text().endswith("</html>\n")
    assert xarray.load_dataset(out / "study.nc", engine="scipy").sizes["time"] == 20


def test_sweeps_and_replays_are_written_too(swept, drive, tmp_path):
    for result, picture in ((swept, "sweep.png"), (drive[0], "replay.png")):
        out = report.write(result, tmp_path / picture)
        assert (out / picture).stat().st_size > 20_000
        assert (out / "report.html").stat().st_size > 20_000
    assert not (tmp_path / "replay.png" / "replay.nc").exists()


def test_what_was_there_stays_whole_when_the_disk_is_full(swept, tmp_path, monkeypatch):
    (tmp_path / "report.html").write_text("an old page")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    monkeypatch.setattr(report, "rendered", lambda *_: "another")
    monkeypatch.setattr(figures, "pictures", lambda *_: [])
    with pytest.raises(OSError, match="No space left"):
        report.write(swept, tmp_path)
    assert (tmp_path / "report.html").read_text() == "an old page"
    assert not list(tmp_path.glob("*.partial"))


def test_without_xarray_all_else_is_written(swept, tmp_path, monkeypatch):
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "xarray" else there(name))
    monkeypatch.setitem(sys.modules, "xarray", None)
    monkeypatch.setattr(figures, "pictures", lambda *_: [])
    out = report.write(swept, tmp_path)
    assert sorted(p.name for p in out.iterdir()) == ["report.html", "summary.json", "sweep.png"]
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'jaxfilt\[data\]'"):
        arrays.to_xarray(swept)


def test_without_matplotlib_the_error_says_how_to_get_it(swept, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'jaxfilt\[plot\]'"):
        report.write(swept, tmp_path)
