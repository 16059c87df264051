"""``jaxfilt tune``: simulated and recorded robots through the command line, and what it says of mistakes."""

import io
import json
import math
import os
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from made_up_fit import made_up_fit
from test_cli import _settings, invoke, is_picture, mistake, summary  # noqa: F401

import jaxfilt as jf
from jaxfilt import arguments, cli, cli_tune, datasets, files, objectives, recordings, scenarios, terminal, tuning_data
from jaxfilt.study import Interrupted
from jaxfilt.tuning.setup import Uninfluential
from jaxfilt.tuning.split import Split

OWN = """
import math
import jax.numpy as jnp
import jaxfilt as jf

THETA = {"q": math.log(0.3), "r": (0.0, 0.0), "start": 0.0}

def model(theta):
    one = jnp.eye(1)
    R = {"gnss": jnp.exp(2 * theta["r"][0]) * one, "sonar": jnp.exp(2 * theta["r"][1]) * one}
    return jf.linear(A=one, H={"gnss": one, "sonar": one}, Q=jnp.exp(2 * theta["q"]) * one, R=R)

def belief(theta):
    return jf.Gaussian(jnp.zeros(1), jnp.exp(2 * theta["start"]) * jnp.eye(1))

def schedule(steps):
    return jf.schedule(model(THETA), steps, 0.1, every={"sonar": 0})

walk = jf.Scenario(model, belief, THETA, schedule, {"place": ((0,), "m")})

def other(theta):
    return model({"q": theta["quiet"], "r": (theta["loud"], 0.0)})

otherwise = jf.Scenario(other, lambda theta: belief(THETA), {"quiet": 0.0, "loud": 0.0}, schedule, walk.blocks)

def wrong(theta):
    return model(theta)._replace(Q=lambda x, u, dt: theta["nothing"] * jnp.eye(1))

broken = walk._replace(model=wrong)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    (tmp_path / "mine.py").write_text(OWN)
    yield tmp_path
    sys.modules.pop("mine", None)


WRONG = '    return model(theta)._replace(Q=lambda x, u, dt: theta["nothing"] * jnp.eye(1))'
QUICK = ["--filter", "kf", "--runs", "12", "--length", "60", "--steps", "25"]


@pytest.mark.long
def test_a_robot_is_tuned_and_its_parameters_go_back_into_study_and_replay(folder, capsys, monkeypatch):
    """One run of the command, and everything that can be done with what it wrote."""
    printed = invoke("tune", "mine.py:walk", *QUICK, "--out", "out")
    assert "frozen: r/1 (changes nothing in these data)" in printed
    assert "tuning beats the parameters it began with on the test data" in printed
    assert printed.index("Findings") < printed.index("Test: 12 runs, 720 rows scored") < printed.index("R of gnss")
    out = folder / "out"
    found = summary(out)
    assert found["schema"] == "jaxfilt.tune/1"
    assert found["settings"]["frozen"] == ["r/1"]
    assert found["settings"]["split"].startswith("by run: train 0 to 11, validation 12 to 14, test 15 to 26")
    start = {p["name"]: p["start"] - p["true"] for p in found["parameters"]}
    factor = math.log(10)
    assert start == {"q": pytest.approx(factor), "r/0": pytest.approx(-factor), "start": pytest.approx(factor)}
    tuned = json.loads((out / "theta.json").read_text())
    assert tuned["theta"]["q"] == pytest.approx(math.log(0.3), abs=0.25)
    assert tuned["theta"]["r/0"] == pytest.approx(0.0, abs=0.2)
    assert tuned["theta"]["r/1"] == 0.0
    np.testing.assert_allclose(tuned["covariances"]["R"]["gnss"], [[math.exp(2 * tuned["theta"]["r/0"])]], rtol=1e-9)
    np.testing.assert_allclose(tuned["covariances"]["Q"], [[math.exp(2 * tuned["theta"]["q"])]], rtol=1e-9)
    assert is_picture(out / "tune.png")
    assert "<html" in (out / "report.html").read_text()
    assert len((out / "history.csv").read_text().splitlines()) == found["settings"]["steps"] + 1

    theta = ["--theta", "out/theta.json"]
    invoke(
        "study", "mine.py:walk", "--filter", "kf", "--runs", "30", "--steps", "40", "--no-bound", *theta, "--out", "s"
    )
    settings = summary(folder / "s")["settings"]
    assert settings["theta"]["robot/q"] == tuned["theta"]["q"]
    assert settings["truth_theta"]["q"] == math.log(0.3)
    walk = arguments.scenario("mine.py:walk")[0]
    _, log = jf.simulate(walk.model(walk.theta), walk.belief(walk.theta), walk.schedule(50), jax.random.key(0))
    files.save("log.npz", jf.Recording(jax.tree.map(np.asarray, log), 0.1 * np.arange(50)))
    invoke("replay", "mine.py:walk", "log.npz", "--filter", "kf", *theta, "--out", "r")
    assert summary(folder / "r")["settings"]["theta"]["r/0"] == tuned["theta"]["r/0"]

    text = mistake(capsys, monkeypatch, "study", "mine.py:otherwise", "--filter", "kf", *theta)
    assert text.startswith(
        "--theta out/theta.json: expected the parameters of this model, got those of another; missing:"
    )
    assert "unknown: q, r/0, r/1, start" in text
    text = mistake(capsys, monkeypatch, "replay", "mine.py:walk", "log.npz", "--theta", "mine.py")
    assert text.startswith("--theta mine.py: expected parameters as JSON, got something else")
    text = mistake(capsys, monkeypatch, "study", "mine.py:walk", "--theta", "none.json")
    assert text == "--theta: cannot read none.json: No such file or directory"
    text = mistake(capsys, monkeypatch, "tune", "mine.py:walk", *QUICK, "--out", "nowhere", "--resume")
    assert text.startswith("nowhere: expected a tuning to resume, found none")


@pytest.mark.parametrize(
    ("args", "text"),
    [
        ([], "tune: expected a scenario or a recording; jaxfilt tune --list shows them"),
        (["nope"], "scenario: expected one of car, "),
        (["nope"], "; or a recording of udacity_ctrv, "),
        (["car", "--objective", "x"], "--objective: expected one of log-score, likelihood, mse, nees, nis, got 'x'"),
        (["car", "--filter", "ekf,ukf"], "--filter: expected one of kf, ekf, iekf, ukf, ckf, got 'ekf,ukf'"),
        (["car", "--runs", "0"], "--runs: expected at least 1, got 0"),
        (["car", "--length", "0"], "--length: expected at least 1, got 0"),
        (["car", "--burn-in", "-1"], "--burn-in: expected at least 0, got -1"),
        (["car", "--from", "0"], "--from: expected a factor above 0, got 0"),
        (["car", "--clip", "q=x"], "--clip: expected a norm above 0, or NAME=NORM with commas between, got 'q=x'"),
        (["car", "--clip", "1,q=2"], "--clip: expected a norm above 0"),
        (["car", "--dtype", "int8"], "--dtype: expected float64 or float32, got 'int8'"),
        (["car", "--sequence", "1"], "--sequence, --test-sequence and --gate are for recordings"),
        (["car", "--out", "mine.py/out"], "--out: cannot make the folder mine.py/out: Not a directory"),
        (["wifibot", "--sequence", "1,2", "--test-sequence", "2"], "--test-sequence: expected others than those to"),
        (["wifibot", "--sequence", "7"], "sequence of 'wifibot': expected one of ['2', '1', '4'], got '7'"),
        (["wifibot"], "JAXFILT_DATA"),
        (["mine.py:plane"], "mine.py:plane: mine.py has no 'plane'"),
        (["mine.py:broken", *QUICK], f"mine.py:{OWN.splitlines().index(WRONG) + 1}: KeyError: nothing"),
    ],
    ids=lambda a: " ".join(a) if isinstance(a, list) else "",
)  # fmt: skip
def test_mistakes_are_one_line_and_exit_code_2(folder, capsys, monkeypatch, args, text):
    monkeypatch.delenv("JAXFILT_DATA", raising=False)
    if text.startswith("sequence of"):
        monkeypatch.setenv("JAXFILT_DATA", str(folder))
    assert text in mistake(capsys, monkeypatch, "tune", *args)


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (["--frozen", "mass"], "frozen: expected some of q, r/0, r/1, start, or what they begin with, got 'mass'"),
        (["--frozen", "q,r,start"], "theta: expected a free number, got none"),
        (["--optimizer", "newton"], "optimizer: expected lbfgs or the name of an optimizer in optax, got 'newton'"),
        (["--batch", "4"], "batch: expected None with lbfgs"),
        (["--optimizer", "adam", "--clip", "mass=1"], "clip: expected some of q, r/0, start"),
        (["--burn-in", "1e6"], "split: expected rows in part 'train', got none"),
    ],
    ids=lambda a: " ".join(a) if isinstance(a, list) else "",
)
def test_what_tuning_refuses_is_one_line_too(folder, capsys, monkeypatch, args, text):
    small = ["--filter", "kf", "--runs", "2", "--length", "4"]
    assert text in mistake(capsys, monkeypatch, "tune", "mine.py:walk", *small, *args)


@pytest.mark.usefixtures("folder")
def test_a_folder_that_cannot_be_written_is_told_before_anything_is_computed(capsys, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # root could write everywhere
    stubbed(monkeypatch)
    text = mistake(capsys, monkeypatch, "tune", "car", "--out", "closed")
    assert text == "--out: cannot write to the folder closed"


def stubbed(monkeypatch, *outcomes):
    """`tune` replaced: what it was called with, and what comes of it, one after the other."""
    calls, left = [], list(outcomes)

    def tune(*arguments, **options):
        calls.append((arguments, options))
        outcome = left.pop(0)
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(cli_tune, "tuned", tune)
    return calls


@pytest.mark.usefixtures("folder")
def test_options_reach_tuning(monkeypatch):
    calls = stubbed(monkeypatch, made_up_fit())
    args = [
        "--objective",
        "likelihood",
        "--optimizer",
        "adam",
        "--clip",
        "q=1,r=0.5",
        "--frozen",
        "start",
        "--batch",
        "2",
    ]
    args += [
        "--starts",
        "3",
        "--pieces",
        "20",
        "--burn-in",
        "0.5",
        "--seed",
        "7",
        "--steps",
        "9",
        "--learning-rate",
        "0.1",
    ]
    invoke("tune", "mine.py:walk", *args, "--runs", "4", "--length", "30", "--from", "100", "--resume", "--out", "out")
    ((robot, belief, theta, logs, truth), options) = calls[0]
    assert options["objective"] is objectives.likelihood
    assert options["optimizer"] == "adam"
    assert options["clip"] == {"q": 1.0, "r": 0.5}
    assert options["frozen"] == ("start", "r/1")
    assert (options["batch"], options["starts"], options["length"], options["steps"]) == (2, 3, 20, 9)
    assert (options["burn_in"], options["learning_rate"], options["resume"]) == (0.5, 0.1, True)
    assert str(options["out"]) == "out"
    assert options["split"] == Split(range(4), range(4, 6), range(6, 10))
    assert np.shape(logs.dt) == np.shape(truth.mask) == (10, 30)
    assert float(theta["q"]) - options["truth_theta"]["q"] == pytest.approx(math.log(100))
    np.testing.assert_allclose(robot(theta).model.Q(jnp.zeros(1), (), 0.1), jnp.exp(2 * theta["q"]))
    assert belief(theta).cov.shape == (1, 1)


@pytest.mark.usefixtures("folder")
def test_parameters_that_turn_out_to_do_nothing_are_frozen_and_named(monkeypatch):
    calls = stubbed(monkeypatch, Uninfluential("log_score", ["start"]), made_up_fit())
    printed = invoke("tune", "mine.py:walk", "--runs", "2", "--length", "5")
    assert "frozen: start (changes nothing in these data)" in printed
    assert [options["frozen"] for _, options in calls] == [("r/1",), ("r/1", "start")]


@pytest.mark.usefixtures("folder")
def test_ctrl_c_leaves_what_was_found_and_says_how_to_go_on(capsys, monkeypatch):
    stubbed(monkeypatch, Interrupted(made_up_fit()))
    monkeypatch.setattr(
        sys, "argv", ["jaxfilt", "tune", "mine.py:walk", "--runs", "2", "--length", "5", "--out", "out"]
    )
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 130
    err = capsys.readouterr().err
    assert "after 13 of 100 steps; go on with: jaxfilt tune mine.py:walk --runs 2 --length 5 --out out --resume" in err
    assert os.path.exists("out/theta.json")


# --- data and starts --------------------------------------------------------------------------------------------------


def test_simulations_begin_with_each_noise_off_in_turn_and_nothing_else():
    car = scenarios.scenario("car")
    job = tuning_data.of_scenario(car, runs=2, rows=5, wrong=3.0, seed=1)
    off = {name: (np.asarray(job.theta[name]) - np.asarray(car.theta[name])) / math.log(3.0) for name in car.theta}
    signs = [float(off[name]) for name in ("gnss", "odometer", "slip", "speed")]
    signs += [*off["start"], float(off["turn"])]
    np.testing.assert_allclose(signs, [1, -1, 1, -1, 1, -1, 1, -1, 1], atol=1e-6)
    np.testing.assert_allclose([off["wheel_base"], *off["mark"]], 0, atol=1e-6)
    assert tuning_data.undetermined(job, []) == dict.fromkeys(("mark/0", "mark/1"), tuning_data.SILENT)
    assert tuning_data.undetermined(job, ["mark"]) == {}
    assert len(np.unique(job.truth.x.pos[:, 0, 0])) == 6


def test_the_same_seed_simulates_the_same_runs():
    volts = [
        tuning_data.of_scenario(scenarios.scenario("voltmeter"), 1, 4, 2.0, seed).logs.z["z"] for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(volts[0], volts[1])
    assert not np.array_equal(volts[0], volts[2])


def walked(rows, seed, truth=True):
    """A recorded walk whose model is always the same function."""
    x, log = jf.simulate(
        walk_model(0.0), walk_belief(0.0), jf.schedule(walk_model(0.0), rows, 1.0), jax.random.key(seed)
    )
    recording = jf.Recording(jax.tree.map(np.asarray, log), np.arange(float(rows)))
    known = jf.Truth(np.asarray(x), np.full(rows, True)) if truth else None
    blocks = {"place": ((0,), "m"), "rest": ((1,), "")}
    return jf.Replay(walk_model, walk_belief, {"r": 0.5, "p": 0.0}, recording, known, jf.vector(2), lambda x: x, blocks)


def walk_model(theta):
    r = theta["r"] if isinstance(theta, dict) else theta
    return jf.linear(jnp.eye(2), jnp.eye(2), jnp.diag(jnp.array([1.0, 4.0])), jnp.exp(2 * r) * jnp.eye(2))


def walk_belief(theta):
    p = theta["p"] if isinstance(theta, dict) else theta
    return jf.Gaussian(jnp.zeros(2), jnp.exp(p) * jnp.eye(2))


def test_recordings_are_split_by_run_or_by_time():
    a, b, blind = walked(30, 0), walked(20, 1), walked(10, 2, truth=False)
    job = tuning_data.of_recordings([a, b], [a])
    assert job.split == Split(range(2), (), range(2, 3))
    assert [len(log.dt) for log in job.logs] == [30, 20, 30]
    assert len(job.belief) == len(job.truth) == 3
    assert job.truth_theta is None
    assert tuning_data.of_recordings([a, b], []).split == Split(1 / 3, 1 / 3, 1 / 3, "time")
    assert tuning_data.of_recordings([a], [blind]).truth is None
    assert tuning_data.undetermined(job, []) == {"p": tuning_data.BEGINNING}


def test_the_weights_of_mse_are_one_over_the_errors_before_tuning():
    """Against a Kalman filter written down; of a split by time only the first third counts."""

    def squares(replay, rows):
        m, P, R, found = np.zeros(2), np.eye(2), np.exp(2 * 0.5), []
        for k in range(rows):
            P = P + np.diag([1.0, 4.0])
            K = P @ np.linalg.inv(P + R * np.eye(2))
            m, P = m + K @ (replay.recording.log.z["z"][k] - m), (np.eye(2) - K) @ P
            found.append((replay.truth.x[k] - m) ** 2)
        return np.mean(found, 0)

    a, b = walked(30, 0), walked(30, 1)
    make = lambda theta: jf.kf(walk_model(theta))  # noqa: E731
    by_run = tuning_data.of_recordings([a], [b])
    by_time = tuning_data.of_recordings([a], [])
    for job, expected in ((by_run, squares(a, 30)), (by_time, squares(a, 10))):
        loss = tuning_data.objective("mse", job, make, 0.0).loss
        for i in range(2):
            one = {"square": jnp.eye(2)[i], "count": jnp.asarray(1.0)}
            np.testing.assert_allclose(loss(one), 1 / expected[i], rtol=1e-6)
    assert tuning_data.objective("", by_run, make, 0.0) is None
    assert tuning_data.objective("nis", by_run, make, 0.0) is objectives.nis_match


def test_sequences_are_learned_from_or_reported_on(monkeypatch):
    monkeypatch.setattr(datasets, "sequences", lambda name: ("a", "b", "c"))
    monkeypatch.setattr(recordings, "replay", lambda name, sequence: f"{name} {sequence}")

    def chosen(train, test):
        return tuple("".join(part) for part in arguments.recorded("set", train, test))

    assert chosen([], []) == ("ab", "c")
    assert chosen([], ["a"]) == ("bc", "a")
    assert chosen(["a"], []) == ("a", "")
    assert chosen(["a"], ["c"]) == ("a", "c")
    with pytest.raises(arguments.Mistake, match="got a, b, c"):
        chosen([], ["a", "b", "c"])
    monkeypatch.setattr(datasets, "sequences", lambda name: ("only",))
    assert chosen([], []) == ("only", "")


def test_the_bar_shows_loss_and_validation(monkeypatch):
    import rich.console

    seen, plain = io.StringIO(), rich.console.Console
    screen = lambda **_: plain(file=seen, force_terminal=True, width=150)  # noqa: E731
    monkeypatch.setattr(rich.console, "Console", screen)
    for step, loss, validation, text in (
        (3, 1.5, np.nan, r"step 3 of at most 40: loss 1\.5 "),
        (4, -1.25, 2.75, r"loss -1\.25, validation 2\.75"),
    ):
        with terminal.tuning_bar() as progress:
            progress(step, 40, loss, validation)
        assert re.search(text, seen.getvalue())
    assert "left:" in seen.getvalue()


def test_help_and_lists_name_everything():
    shown = invoke("tune", "--help")
    for option in ("--objective", "--optimizer", "--from", "--frozen", "--burn-in", "--starts", "--clip", "--resume"):
        assert option in shown
    listed = invoke("tune", "--list")
    assert "multirotor" in listed
    assert "utias_mrclam" in listed


@pytest.mark.long
@pytest.mark.data
@pytest.mark.usefixtures("data")
def test_a_recorded_drive_is_tuned(folder):
    printed = invoke("tune", "wifibot", "--sequence", "4", "--steps", "3", "--objective", "likelihood", "--out", "out")
    assert "frozen: start/0 (a few beginnings do not determine it)" in printed
    found = summary(folder / "out")
    assert found["settings"]["split"].startswith("by time: 33.3 % train")
    assert found["scores"]["tuned"]["train"]["loss"] < found["scores"]["before"]["train"]["loss"]
    invoke("replay", "wifibot", "--sequence", "4", "--theta", "out/theta.json", "--out", "again")
    assert (
        summary(folder / "again")["settings"]["theta"] == json.loads((folder / "out/theta.json").read_text())["theta"]
    )
