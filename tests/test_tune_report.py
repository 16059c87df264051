"""What a tuning says of itself: plain text, plain data, parameters as a file, figures and the page."""

import csv
import json
from typing import NamedTuple

import numpy as np
import pytest
from browser import browser
from made_up_fit import FINDINGS, FLAT, made_up_fit
from test_page import CONTRAST, DARK, SEEN, Reader, opened
from test_report import drawn

from jaxfilt import plaintext, report
from jaxfilt.report import figures, tune_summary
from jaxfilt.report.page import page
from jaxfilt.report.tune_tables import cards, tables
from jaxfilt.theta_file import theta_from_json, theta_to_json

EVIL = "<script>alert('$x_')</script>"


@pytest.fixture(scope="module")
def fit():
    return made_up_fit()


def row(text, label, part):
    """The cells of a row of the table of a part, split at two blanks."""
    table = text[text.index(part) :].split("\n\n")[0]
    (line,) = [line for line in table.splitlines() if line.startswith(label)]
    return [cell.strip() for cell in line[len(label) :].split("  ") if cell.strip()]


# --- plain text -------------------------------------------------------------------------------------------------------


def test_the_text_has_findings_first_then_held_out_scores(fit):
    text = fit.report()
    places = [text.index(what) for what in (*FINDINGS, "Test: 8 runs, 1,600 rows", "Validation", "Train:")]
    places += [text.index(what) for what in ("Parameters; standard errors: sandwich", FLAT, "Tuned covariances")]
    assert places == sorted(places)
    assert max(map(len, text.splitlines())) < 120
    scores = fit.scores["tuned"]["test"]
    assert row(text, "loss", "Test:")[2] == f"{scores.loss:.5g}"
    assert row(text, "RMSE yaw, rad", "Test:")[2] == f"{scores.rmse['yaw']:.4g}"
    assert row(text, "ANEES / n", "Train:")[2] == "1.06 inside"
    assert row(text, "ANIS / m, compass", "Train:")[0] == "0.25 below"
    assert row(text, "diverged runs", "Train:") == ["2", "0", "0", "0"]
    assert row(text, "q[1]", "Parameters;") == ["-5.3", "-3.23", "-3.046", "unknown", "-3"]
    assert row(text, "q[2]", "Parameters;")[3] == "± 30"
    assert "frozen: mark[0], mark[1]" in text
    assert "diag(1.53, 1.53)" in text


def test_without_a_truth_there_is_no_word_of_it():
    text = made_up_fit(truth=False)._replace(findings=()).report()
    for word in ("RMSE", "ANEES", "log score", "noise estimation", "true", "Findings"):
        assert word not in text
    assert row(text, "ANIS / m, gnss", "Test:") == ["10 above", "7.06 above"]
    assert row(text, "gnss", "Parameters;") == ["2.3", "0.046", "± 0.03"]


def test_matrices_are_written_out_and_kept_narrow():
    M = np.random.default_rng(0).standard_normal((20, 20)) * 1e-9
    text = plaintext.matrix(M)
    assert max(map(len, text.splitlines())) < 120
    read = np.array(text.replace("[", " ").replace("]", " ").replace(",", " ").split(), float).reshape(20, 20)
    np.testing.assert_allclose(read, M, rtol=1e-3)
    wide = plaintext.matrix(np.diag(np.arange(1.0, 60.0)))
    assert max(map(len, wide.splitlines())) < 120
    assert wide.strip().startswith("diag(1, 2, ")
    assert wide.endswith("59)")


# --- plain data -------------------------------------------------------------------------------------------------------


def test_the_summary_has_what_the_fit_has(fit):
    found = json.loads(json.dumps(tune_summary.summary(fit, "car", "make it"), allow_nan=False))
    assert (found["schema"], found["name"], found["command"]) == ("jaxfilt.tune/1", "car", "make it")
    assert found["findings"] == list(FINDINGS)
    tuned = found["scores"]["tuned"]["test"]
    assert tuned["rmse"]["yaw"] == {"unit": "rad", "value": pytest.approx(0.0123 * (1 + 3 * 2.02), rel=1e-5)}
    assert tuned["log_score"] == {"value": pytest.approx(-3.27), "error": 0.01234}
    assert tuned["nees"]["verdict"] == "above"
    assert found["scores"]["tuned"]["train"]["nis"]["compass"]["verdict"] == "inside"
    assert list(found["scores"]) == ["before", "noise estimation", "tuned", "truth"]
    q1 = found["parameters"][3]
    assert (q1["name"], q1["start"], q1["error"], q1["true"]) == ("q[1]", -5.3, None, -3.0)
    assert found["flat"][0]["std"] is None
    assert found["covariances"]["tuned"]["R"]["gnss"] == [[1.53, 0.0], [0.0, 1.53]]
    assert found["history"]["validation"][:3] == [41.1, None, 11.1]
    assert sum(found["history"]["refused"]) == 2
    assert found["starts"] == [1.0, 1.02, None]
    assert found["theta"]["q"] == fit.theta["q"].tolist()
    assert found["truth_theta"] == {"compass": -4.0, "gnss": 0.0, "q": [-3.0, -3.0, -5.0]}
    blind = tune_summary.summary(made_up_fit(truth=False))
    assert blind["truth_theta"] is blind["estimated_theta"] is blind["scores"]["tuned"]["test"]["nees"] is None


def test_the_history_is_a_line_for_each_step(fit):
    rows = list(csv.DictReader(tune_summary.history_csv(made_up_fit('gn"ss,')).splitlines()))
    assert list(rows[0])[:7] == ["step", "loss", "validation", "gradient", "refused", "seconds", 'gn"ss,']
    assert [int(r["step"]) for r in rows] == list(range(1, 14))
    assert [float(r["loss"]) for r in rows] == fit.history.loss.tolist()
    assert [float(r["q[2]"]) for r in rows] == fit.history.theta[:, 4].tolist()
    assert [r["refused"] for r in rows[2:6]] == ["0", "1", "1", "0"]
    assert rows[1]["validation"] == ""


# --- parameters as a file ---------------------------------------------------------------------------------------------


class Noise(NamedTuple):
    q: np.ndarray
    r: tuple


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_parameters_come_back_bit_for_bit(dtype):
    random = np.random.default_rng(1).standard_normal
    theta = {
        "noise": Noise(random((2, 3)).astype(dtype), (random(), dtype(random()))),
        "mass": np.asarray(random(), dtype),
    }
    back = theta_from_json(theta_to_json(theta, {"comment": "mine"}), like=theta)
    assert isinstance(back["noise"], Noise)
    assert isinstance(back["noise"].r[0], float)
    for a, b in (
        (theta["noise"].q, back["noise"].q),
        (theta["mass"], back["mass"]),
        (theta["noise"].r[1], back["noise"].r[1]),
    ):
        np.testing.assert_array_equal(a, b)
        assert np.asarray(b).dtype == dtype
    assert back["noise"].r[0] == theta["noise"].r[0]
    assert theta_from_json(theta_to_json(0.1), like=0.0) == 0.1


def test_the_file_of_a_fit_has_the_matrices_too(fit):
    text = tune_summary.theta_json(fit, "car", "make it")
    back = theta_from_json(text, like=fit.start)
    np.testing.assert_array_equal(back["q"], fit.theta["q"])
    assert back["gnss"] == fit.theta["gnss"]
    found = json.loads(text)
    tuned = fit.covariances["tuned"]
    assert found["covariances"]["dt"] == 0.02
    np.testing.assert_array_equal(found["covariances"]["Q"], tuned.Q)
    np.testing.assert_array_equal(found["covariances"]["R"]["compass"], tuned.R["compass"])
    np.testing.assert_array_equal(found["covariances"]["P0"], tuned.P0)


GOOD = {"schema": "jaxfilt.theta/1", "theta": {"q": [1.0, 2.0], "r": 0.5}}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no JSON", "expected parameters as JSON, got something else"),
        ("[1]", "expected parameters of schema 'jaxfilt.theta/1', got schema None"),
        (json.dumps(GOOD | {"schema": "jaxfilt.study/2"}), "got schema 'jaxfilt.study/2'"),
        (json.dumps(GOOD | {"theta": {"q": [1.0, 2.0], "s": 1.0}}), "got those of another; missing: r; unknown: s"),
        (json.dumps(GOOD | {"theta": {"q": [1.0], "r": 0.5}}), r"q: expected shape \(2,\), got \(1,\)"),
        (json.dumps(GOOD | {"theta": {"q": [1.0, [2.0]], "r": 0.5}}), r"q: expected numbers of shape \(2,\)"),
        (json.dumps(GOOD | {"theta": {"q": [1.0, 2.0], "r": "much"}}), "r: expected numbers"),
        (json.dumps(GOOD | {"theta": {"q": [1.0, 2.0], "r": None}}), "r: expected finite numbers, got None"),
    ],
)
def test_a_file_of_something_else_is_told(text, message):
    with pytest.raises(ValueError, match=message):
        theta_from_json(text, like={"q": np.zeros(2), "r": 0.0})


def test_what_could_not_be_read_back_is_not_written():
    with pytest.raises(ValueError, match="expected finite numbers, got nan for 'r'"):
        theta_to_json({"r": np.nan})
    with pytest.raises(ValueError, match="got 'a/b' twice"):
        theta_to_json({"a/b": 1.0, "a": {"b": 2.0}})


# --- figures and the page ---------------------------------------------------------------------------------------------


def test_no_panel_is_empty():
    lost = made_up_fit()
    bad = {stage: {k: s._replace(loss=np.nan) for k, s in parts.items()} for stage, parts in lost.scores.items()}
    one = made_up_fit(truth=False)._replace(starts=np.ones(1))
    smooth = one.history._replace(refused=np.full(13, False), validation=np.full(13, np.nan), loss=-one.history.loss)
    one = one._replace(history=smooth)
    for picture in figures.pictures(one):  # laid out without a warning
        assert figures.svg(picture.figure).startswith(b"<?xml")
    for result in (lost, lost._replace(scores=bad), made_up_fit(EVIL, truth=False), one):
        assert min(drawn(figures.overview(result, "$any_"))) > 0
        made = figures.pictures(result)
        assert len(made) == (3 if result is one else 4)
        for picture in made:
            assert min(drawn(picture.figure)) > 0, picture.title


def lines(axes):
    return [(np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)) for line in axes.lines]


def test_the_way_down_shows_losses_refused_steps_and_the_one_kept(fit):
    loss, gradient = figures.pictures(fit)[0].figure.axes
    steps = np.arange(1, 14)
    seen = lines(loss)
    assert any(np.array_equal(x, steps) and np.array_equal(y, fit.history.loss) for x, y in seen)
    known = np.isfinite(fit.history.validation)
    assert any(np.array_equal(x, steps[known]) and np.array_equal(y, fit.history.validation[known]) for x, y in seen)
    assert any(np.array_equal(x, [4, 5]) for x, _ in seen)
    assert any(np.array_equal(x, [10, 10]) for x, _ in seen)
    assert any(np.array_equal(y, fit.history.gradient) for _, y in lines(gradient))
    assert gradient.get_yscale() == "log"
    early = fit._replace(history=fit.history._replace(loss=np.r_[1e9, fit.history.loss[1:]]))
    assert figures.pictures(early)[0].figure.axes[0].get_ylim()[1] < 100


def test_parameters_are_drawn_about_the_truth_with_two_standard_errors(fit):
    (axes,) = figures.pictures(fit)[1].figure.axes
    seen = lines(axes)
    assert [text.get_text() for text in axes.get_yticklabels()] == [p.name for p in fit.parameters]
    for field in ("start", "estimated", "value", "true"):
        off = [getattr(p, field) - p.true for p in fit.parameters]
        assert any(len(x) == 5 and np.allclose(x, off) for x, _ in seen)
    gnss = next(x for x, y in seen if len(x) == 2 and np.array_equal(y, [4, 4]))
    np.testing.assert_allclose(gnss, 0.046 + np.array([-0.06, 0.06]))
    assert not any(np.array_equal(y, [1, 1]) for _, y in seen)  # nobody knows the error of q[1]
    assert axes.get_xlim()[1] < 3  # an error of 30 does not push the others together


def test_a_user_reads_the_same_numbers_in_the_tables(fit):
    found = tune_summary.summary(fit)
    scores, parameters, flat = tables(found)
    held = [[cell.text for cell in row] for row in scores.rows]
    assert held[2][:3] == ["test", "tuned", "3.27"]
    assert held[2][scores.columns.index("RMSE position")] == "3.53 m"
    inside = scores.columns.index("ANIS / m compass")
    assert [row[inside].mood for row in scores.rows[-2:]] == ["good", "good"]
    assert [cell.text for cell in parameters.rows[0]] == ["gnss", "0.046 ± 0.030", "2.3", "0.23", "0", "1.5"]
    assert parameters.rows[3][1].text == "-3.046"
    assert flat.rows[0][2].text == "unbounded"
    (card,) = cards(found)
    assert (card.word, card.mood) == ("the best on the test part", "good")
    found["scores"]["tuned"]["test"]["loss"] = 3.9
    assert cards(found)[0].word == "no better than noise estimation"


def test_all_files_are_written_and_names_are_only_text(tmp_path):
    out = report.write(made_up_fit(EVIL), tmp_path / "new", EVIL, command=f"jaxfilt tune '{EVIL}'")
    names = ["history.csv", "report.html", "summary.json", "theta.json", "tune.png"]
    assert sorted(p.name for p in out.iterdir()) == sorted(report.files(made_up_fit())) == names
    assert (out / "tune.png").read_bytes().startswith(b"\x89PNG")
    reader = Reader((out / "report.html").read_text())
    assert not reader.open
    assert len(reader.all("script")) == 1
    assert sum(EVIL in words for words in reader.words) > 8
    assert len(reader.all("img")) == 4
    ids = [attributes["id"] for _, attributes in reader.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    words = "".join(reader.words)
    for finding in FINDINGS:
        assert words.index(finding) < words.index("Figures")
    for section in ("Scores", "Parameters", "Flat directions", "Matrices", "Settings", "To get the same again"):
        assert section in words
    assert "diag(1.53, 1.53)" in words
    assert "Monte Carlo" not in words


def test_a_reader_sees_it_on_a_desk_and_on_a_phone(fit, tmp_path, record_property, capsys):
    file = tmp_path / "report.html"
    file.write_text(page(fit, "car", command="jaxfilt tune car"))
    assert "jaxfilt tune car" in file.read_text()
    if not opened(record_property, capsys):
        return
    with browser() as window:
        for width in (1280, 375):
            window.resize(width)
            window.open(file)
            seen = window.run(SEEN)
            assert window.complaints() == []
            assert seen["width"] <= seen["window"] == width
            assert seen["outside"] == seen["small"] == 0
            assert len(seen["images"]) == 4
            assert window.run(CONTRAST) > 4.5
            window.do("goog/cdp/execute", cmd="Emulation.setEmulatedMedia", params=DARK)
            assert window.run(CONTRAST) > 4.5
            window.do("goog/cdp/execute", cmd="Emulation.setEmulatedMedia", params={"features": []})
