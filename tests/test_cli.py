"""The command line: what it prints and writes, a user's own file, and one clear line for every mistake."""

import json
import re
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

import jaxfilt as jf
from jaxfilt import arguments, cli, files, scenarios

OWN = """
import jax.numpy as jnp
import jaxfilt as jf

THETA = {"r": 0.0}

def model(theta):
    one = jnp.eye(1)
    return jf.linear(A=0.9 * one, H=one, Q=0.1 * one, R=jnp.exp(theta["r"]) * one)

def belief(theta):
    return jf.Gaussian(jnp.zeros(1), jnp.eye(1))

def schedule(steps):
    return jf.schedule(model(THETA), steps, 0.1)

car = jf.Scenario(model, belief, THETA, schedule, {"place": ((0,), "m")})

def made():
    return car

def raises():
    distance = 1.0
    return distance / 0

def late():
    def broken(theta):
        return model(theta)._replace(f=lambda x, u, dt: x @ jnp.ones(3))
    return car._replace(model=broken)

def misfit():
    return car._replace(belief=lambda theta: jf.Gaussian(jnp.zeros(2), jnp.eye(2)))

number = 3
"""

BROKEN = "        return model(theta)._replace(f=lambda x, u, dt: x @ jnp.ones(3))"


def line(text):
    """The number of this line in the user's file."""
    return OWN.splitlines().index(text) + 1


@pytest.fixture(autouse=True)
def _settings():
    """The command line sets the precision for its whole process; here others come after it."""
    yield
    jax.config.update("jax_enable_x64", True)
    sys.modules.pop("my", None)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    (tmp_path / "my.py").write_text(OWN)
    return tmp_path


def invoke(*args):
    result = CliRunner(env={"COLUMNS": "200"}).invoke(cli.app(), args)
    assert result.exception is None, result.exception
    return result.output


def mistake(capsys, monkeypatch, *args):
    """The one line that a mistake gets, with exit code 2."""
    monkeypatch.setattr(sys, "argv", ["jaxfilt", *args])
    with pytest.raises(SystemExit) as end:
        cli.main()
    captured = capsys.readouterr()
    assert end.value.code == 2
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("jaxfilt: ")
    return lines[0].removeprefix("jaxfilt: ")


def summary(path):
    def no_constant(text):
        raise AssertionError(f"{text} is not JSON")

    return json.loads((path / "summary.json").read_text(), parse_constant=no_constant)


def is_picture(path):
    data = path.read_bytes()
    return data.startswith(b"\x89PNG") and len(data) > 20_000


@pytest.mark.long
def test_the_main_job_in_a_process_of_its_own(tmp_path):
    command = [sys.executable, "-c", "from jaxfilt.cli import main; main()"]
    command += ["study", "car", "--filter", "ekf,ukf", "--runs", "20", "--steps", "40", "--seed", "3"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    for word in (
        "RMSE position, m",
        "mean NEES (4)",
        "mean NIS gnss (2)",
        "diverged runs",
        "compile",
        "inside",
        "bound",
    ):
        assert word in done.stdout
    out = tmp_path / "jaxfilt-out" / "study-car"
    assert is_picture(out / "study.png")
    found = summary(out)
    assert found["schema"] == "jaxfilt.study/2"
    assert (found["name"], found["complete"]) == ("car", True)
    assert found["command"].startswith("jaxfilt ")
    settings = found["settings"]
    assert (settings["runs"], settings["steps"], settings["seed"], settings["dtype"]) == (20, 40, 3, "float64")
    assert settings["theta"]["robot/gnss"] == settings["truth_theta"]["gnss"] == pytest.approx(0.0)
    assert set(found["filters"]) == set(found["verdicts"]) == {"ekf", "ukf"}
    assert found["verdicts"]["ekf"]["headline"] in done.stdout
    position = found["filters"]["ekf"]["blocks"]["position"]
    assert position["unit"] == "m"
    assert 0.1 < position["rmse"]["value"] < 5
    assert 0.3 < position["efficiency"] < 1.5
    assert found["bound"]["exact"] is True
    assert found["made_with"]["jax"] == jax.__version__
    assert "<html" in (out / "report.html").read_text()


def test_a_users_own_scenario_and_recording(folder):
    """One file through both commands: simulated, then one of its runs recorded, saved and replayed."""
    printed = invoke("study", "my.py:made", "--filter", "kf", "--runs", "50", "--steps", "30", "--out", "here")
    assert re.search(r"RMSE place, m +0\.\d+", printed)
    assert is_picture(folder / "here" / "study.png")
    assert summary(folder / "here")["filters"]["kf"]["sensors"]["z"]["nis"]["verdict"] == "inside"

    car = arguments._own_scenario("my.py:car")[0]
    _, log = jf.simulate(car.model(car.theta), car.belief(car.theta), car.schedule(100), jax.random.key(0))
    files.save("log.npz", jf.Recording(jax.tree.map(np.asarray, log), 0.1 * np.arange(100)))
    printed = invoke("replay", "my.py:car", "log.npz", "--filter", "kf", "--gate", "0.9")
    assert re.search(r"mean NIS z \(1\) +0\.\d+ (inside|below)", printed)
    assert "RMSE" not in printed
    out = folder / "jaxfilt-out" / "replay-my-car-log"
    assert is_picture(out / "replay.png")
    found = summary(out)
    assert found["schema"] == "jaxfilt.replay/2"
    kf = found["filters"]["kf"]
    assert kf["state"] is None
    assert 0 < kf["sensors"]["z"]["refused"] < 30
    assert len(kf["sensors"]["z"]["whiteness"]["lags"]) == 20
    assert found["verdicts"]["kf"]["headline"] in " ".join(printed.split())


QUICK = ["--filter", "kf", "--runs", "200", "--steps", "60", "--no-bound"]


def test_what_the_filters_assume_wrongly_is_found(folder):
    printed = invoke("study", "my.py:car", *QUICK, "--assume", "R/z=0.25", "--assume", "Q=0.25", "--out", "wrong")
    assert "overconfident in place: ANEES 4.0 x expected throughout" in printed
    settings = summary(folder / "wrong")["settings"]
    assert (settings["theta"]["assumed/Q"], settings["theta"]["assumed/R/z"]) == (0.25, 0.25)
    assert summary(folder / "wrong")["verdicts"]["kf"]["consistent"] is False


def test_a_sweep_is_a_table_and_a_picture(folder):
    printed = invoke("study", "my.py:car", *QUICK, "--sweep", "Q=0.1,1,10", "--sweep", "R=1,4", "--out", "grid")
    rows = re.findall(r"Q=([\d.]+), R=([\d.]+) +([\d.]+) +([\d.]+)", printed)
    assert [row[:2] for row in rows] == [(q, r) for q in ("0.1", "1", "10") for r in ("1", "4")]
    assert min(rows, key=lambda row: float(row[2]))[:2] == ("1", "1")
    assert float(rows[0][3]) > 1.2 > float(rows[2][3]) > 0.8
    found = summary(folder / "grid")
    assert found["schema"] == "jaxfilt.sweep/1"
    assert found["over"] == {"Q": [0.1, 1.0, 10.0], "R": [1.0, 4.0]}
    assert is_picture(folder / "grid" / "sweep.png")


def test_readings_can_be_spoiled(folder):
    struck = invoke("study", "my.py:car", *QUICK, "--corrupt", "outliers:z:0.1:20", "--corrupt", "drop-outs:z:0.5:3")
    assert "innovations of z larger than claimed" in struck
    assert "kf consistent" not in struck


@pytest.mark.long
def test_ctrl_c_leaves_a_valid_result_and_says_how_to_go_on(folder, monkeypatch):
    """A real SIGINT, to a process that has begun to run; then the same command with --resume."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(folder / "compiled"))  # three processes compile the same
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    command = [sys.executable, "-c", "from jaxfilt.cli import main; main()", "study", "my.py:car"]
    command += ["--filter", "kf", "--runs", "4000", "--steps", "50", "--chunk", "2", "--no-bound", "--out", "out"]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while running.poll() is None and not (folder / "out" / "checkpoint.npz").exists():
        time.sleep(0.01)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=120)
    assert running.returncode == 130, err
    assert re.search(r"interrupted after [\d,]+ of 4,000 runs; go on with: jaxfilt study .* --resume", err)
    partial = summary(folder / "out")
    assert partial["complete"] is False
    assert 0 < partial["settings"]["runs"] < 4000
    assert "RMSE place, m" in out
    again = subprocess.run(command, capture_output=True, text=True)
    assert again.returncode == 2
    assert "4,000 runs: resume it, or remove the folder to begin anew; go on with: jaxfilt" in again.stderr
    resumed = subprocess.run([*command, "--resume"], capture_output=True, text=True)
    assert resumed.returncode == 0, resumed.stderr
    assert summary(folder / "out")["complete"] is True
    assert summary(folder / "out")["settings"]["runs"] == 4000


def test_single_precision_is_there_to_ask_for(folder):
    invoke("study", "my.py:car", "--filter", "ckf", "--runs", "4", "--steps", "5", "--dtype", "float32", "--out", ".")
    assert summary(folder)["settings"]["dtype"] == "float32"


@pytest.mark.data
@pytest.mark.usefixtures("data")
def test_a_recorded_drive(folder):
    printed = invoke("replay", "wifibot", "--filter", "ekf", "--out", "out")
    assert "RMSE position, m" in printed
    found = summary(folder / "out")
    assert found["filters"]["ekf"]["blocks"]["position"]["rmse"] < 0.1
    assert is_picture(folder / "out" / "replay.png")


def test_lists_help_and_version():
    listed = invoke("study", "--list")
    for name in scenarios.SCENARIOS:
        assert name in listed
    assert "utias_mrclam" in invoke("replay", "--list")
    shown = invoke("study", "--help")
    for option in (
        "--filter",
        "--runs",
        "--steps",
        "--seed",
        "--assume",
        "--sweep",
        "--corrupt",
        "--dtype",
        "--resume",
    ):
        assert option in shown
    assert f"jax {jax.__version__}" in invoke("--version")


def test_every_scenario_of_the_list_can_be_built_and_says_what_it_is():
    for name in scenarios.SCENARIOS:
        scenario = scenarios.scenario(name)
        assert scenario.blocks
        assert len(scenarios.about(name)) > 10


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (["study"], "study: expected a scenario; jaxfilt study --list shows them"),
        (["study", "nope"], "scenario: expected one of car, "),
        (["study", "car", "--filter", "ekf,xkf"], "--filter: expected some of kf, ekf, iekf, ukf, ckf, got 'xkf'"),
        (["study", "car", "--runs", "0"], "--runs: expected at least 1, got 0"),
        (["study", "car", "--steps", "-3"], "--steps: expected at least 1, got -3"),
        (["study", "car", "--seed", "-1"], "--seed: expected at least 0, got -1"),
        (["study", "car", "--runs", "many"], "Invalid value for '--runs'"),
        (["study", "car", "--dtype", "float16"], "--dtype: expected float64 or float32, got 'float16'"),
        (["study", "car", "--bogus"], "No such option: --bogus"),
        (["study", "car", "--assume", "Q=-1"], "--assume: expected Q=FACTOR, R=FACTOR or R/SENSOR=FACTOR, got 'Q=-1'"),
        (["study", "car", "--sweep", "S=1,2"], "--sweep: expected Q=FACTOR, R=FACTOR or R/SENSOR=FACTOR, got 'S=1,2'"),
        (["study", "car", "--assume", "R/sonar=2"], "R/sonar: expected a sensor of gnss, odometer, mark"),
        (
            ["study", "car", "--corrupt", "rain:gnss"],
            "--corrupt: expected one of outliers, heavy-tails, drop-outs, delay",
        ),
        (["study", "car", "--corrupt", "outliers:gnss:2:3"], "--corrupt: expected outliers:SENSOR:PROBABILITY:SCALE"),
        (["study", "my.py:car", "--resume", "--out", "new"], "new: expected a study to resume, found none"),
        (["fly"], "No such command 'fly'"),
        (["study", "car", "--out", "my.py/out"], "--out: cannot make the folder my.py/out: Not a directory"),
        (["study", "their.py:car"], "their.py:car: there is no file their.py"),
        (["study", "my.py"], "my.py: expected FILE.py:NAME, got no name"),
        (["study", "my.py:plane"], "my.py:plane: my.py has no 'plane'"),
        (["study", "my.py:number"], "my.py:number: expected a Scenario or a function returning one, got int"),
        (["study", "my.py:raises"], f"my.py:{line('    return distance / 0')}: ZeroDivisionError: "),
        (["study", "broken.py:car"], "broken.py:1: SyntaxError: "),
        (["study", "my.py:late"], f"my.py:{line(BROKEN)}: TypeError: dot_general"),
        (["study", "my.py:misfit"], "my.py: belief(theta).mean: expected shapes"),
        (["replay"], "replay: expected a recording; jaxfilt replay --list shows them"),
        (["replay", "nope"], "recording: expected one of "),
        (["replay", "wifibot", "--gate", "2"], "--gate: expected a probability between 0 and 1, or none, got '2'"),
        (["replay", "wifibot", "log.npz"], "wifibot: expected no LOG after the name of a recording, got log.npz"),
        (["replay", "my.py:car"], "my.py:car: expected a LOG after it"),
        (["replay", "my.py:car", "log.npz"], "log.npz"),
        (["replay", "my.py:car", "my.py"], "my.py"),
    ],
    ids=lambda a: " ".join(a) if isinstance(a, list) else "",
)
def test_mistakes_are_one_line_and_exit_code_2(folder, capsys, monkeypatch, args, text):
    (folder / "broken.py").write_text("car = = 3\n")
    monkeypatch.setenv("JAXFILT_DATA", str(folder))
    assert text in mistake(capsys, monkeypatch, *args)


def test_missing_recordings_say_where_they_were_looked_for(folder, capsys, monkeypatch):
    monkeypatch.setenv("JAXFILT_DATA", str(folder / "empty"))
    assert "empty" in mistake(capsys, monkeypatch, "replay", "wifibot")
    monkeypatch.delenv("JAXFILT_DATA")
    assert "JAXFILT_DATA" in mistake(capsys, monkeypatch, "replay", "wifibot")


@pytest.mark.parametrize("package", ["typer", "rich"])
def test_without_the_extra_it_says_what_to_install(package):
    hide = f"import sys; sys.modules[{package!r}] = None; from jaxfilt.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", hide], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == f"jaxfilt: the command line needs {package}: pip install 'jaxfilt[cli]'\n"
