"""The command line: ``jaxfilt study``, ``jaxfilt replay`` and, in a file of its own, ``jaxfilt tune``."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any, get_args

import jax

from jaxfilt import arguments as asked
from jaxfilt import checkpoint, datasets, recordings, scenarios, terminal
from jaxfilt.arguments import Mistake, explained
from jaxfilt.bound import Bound, cramer_rao
from jaxfilt.cli_tune import tune
from jaxfilt.command import MISSING, built, finish, kept, one_of, typed, typer
from jaxfilt.loop import Backend
from jaxfilt.review import replayed
from jaxfilt.study import Interrupted, Study
from jaxfilt.study import study as monte_carlo
from jaxfilt.sweep import Sweep
from jaxfilt.sweep import sweep as many_studies
from jaxfilt.types import Filter, Gaussian, Log, Model, PyTree, Scenario

BOUND_RUNS = 200
"""Simulated truths that the Cramer-Rao bound is averaged over."""


def main() -> None:
    """Entry point: what the user can mend is one line on stderr and exit code 2, never a traceback."""
    if MISSING is not None:
        print(f"jaxfilt: the command line needs {MISSING}: pip install 'jaxfilt[cli]'", file=sys.stderr)
        sys.exit(2)
    usage_error: Any = typer.BadParameter.__mro__[1]
    try:
        code = app()(args=sys.argv[1:] or ["--help"], prog_name="jaxfilt", standalone_mode=False)
    except (Mistake, usage_error) as mistake:
        print(f"jaxfilt: {getattr(mistake, 'format_message', mistake.__str__)()}", file=sys.stderr)
        sys.exit(2)
    except (KeyboardInterrupt, typer.Abort):
        print("jaxfilt: interrupted", file=sys.stderr)
        sys.exit(130)
    sys.exit(code if isinstance(code, int) else 0)


def app() -> typer.Typer:
    """The commands, as typer has them."""
    commands = typer.Typer(
        help="Kalman filters for robots: are they consistent, and how close do they come?",
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    commands.callback(invoke_without_command=True)(_jaxfilt)
    commands.command()(study)
    commands.command()(replay)
    commands.command()(tune)
    return commands


def _jaxfilt(version: Annotated[bool, typer.Option("--version", help="Show the versions and exit.")] = False) -> None:
    if version:
        print(f"jaxfilt {checkpoint.version('jaxfilt')}, jax {jax.__version__}")


def study(
    scenario: Annotated[
        str,
        typer.Argument(help="A name from --list, or FILE.py:NAME: your Scenario, or a function returning one."),
    ] = "",
    filters: Annotated[str, typer.Option("--filter", help="Of kf, ekf, iekf, ukf, ckf, with commas.")] = "ekf,ukf",
    runs: Annotated[int, typer.Option(help="Simulated runs.")] = 1000,
    steps: Annotated[int, typer.Option(help="Steps of a run.")] = 1000,
    seed: Annotated[int, typer.Option(help="Of the random numbers; the same seed, the same study.")] = 0,
    assume: Annotated[
        list[str] | None,
        typer.Option(help="What the filters believe: Q=0.5, R=2, R/SENSOR=4, factors of the true covariances."),
    ] = None,
    sweep: Annotated[
        list[str] | None, typer.Option(help="Many such factors, Q=0.1,0.3,1,3,10; two options make a grid.")
    ] = None,
    corrupt: Annotated[
        list[str] | None,
        typer.Option(
            help="What happens to readings: outliers:SENSOR:PROBABILITY:SCALE, heavy-tails:SENSOR:DOF, "
            "drop-outs:SENSOR:PROBABILITY[:LENGTH], delay:SENSOR:ROWS."
        ),
    ] = None,
    bound: Annotated[bool, typer.Option(help="Compare with the Cramer-Rao bound.")] = True,
    theta: Annotated[
        str, typer.Option(help="theta.json of jaxfilt tune: what the filters assume; the truth stays as it is.")
    ] = "",
    dtype: Annotated[str, typer.Option(help="float64 or float32.")] = "float64",
    chunk: Annotated[int, typer.Option(help="Runs at once; default by memory.")] = 0,
    backend: Annotated[str, typer.Option(help="auto, xla, or lanes (needs the extra fast).")] = "auto",
    out: Annotated[str, typer.Option(help="Folder for the results; default jaxfilt-out/study-NAME.")] = "",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the study in the folder.")] = False,
    names: Annotated[bool, typer.Option("--list", help="List the scenarios and exit.")] = False,
) -> int:
    """Simulate many runs of a robot, filter them all, and say whether the filters know how wrong they are."""
    if names:
        terminal.listing({name: scenarios.about(name) for name in scenarios.SCENARIOS}, "scenarios")
        return 0
    asked.at_least(1, runs=runs, steps=steps)
    asked.at_least(0, seed=seed, chunk=chunk)
    asked.one_of("backend", backend, get_args(Backend))
    makers = asked.makers(filters)
    believed = {name: values[0] for name, values in asked.noise_factors(assume or [], "--assume").items()}
    over = asked.noise_factors(sweep or [], "--sweep")
    asked.set_dtype(dtype)
    chosen, source, label = asked.scenario(scenario)
    assumed = asked.theta(theta, chosen.theta)
    folder = asked.writable(out or f"jaxfilt-out/study-{label}")
    bank = {name: functools.partial(_assuming, make, chosen.model) for name, make in makers.items()}
    log, key = chosen.schedule(steps), jax.random.key(seed)
    options: dict[str, Any] = {
        "runs": runs,
        "control": chosen.control,
        "truth_belief": chosen.belief,
        "blocks": chosen.blocks,
        "chunk": chunk or None,
        "backend": backend,
        "out": folder,
        "resume": resume,
    }
    with explained(source), terminal.progress_bar() as progress, ThreadPoolExecutor(1) as beside:
        asked.rescaled(chosen.model(chosen.theta), believed | dict.fromkeys(over, 1.0))
        options |= {"progress": progress, "corrupt": asked.corruption(corrupt or [], chosen.model, chosen.theta)}
        robot = chosen.model, bank, functools.partial(_believed, chosen.belief), log, key
        # The bound is of the truth's own model and noise, and compiles while the study does.
        wanted = bound and not over and not corrupt
        limit = beside.submit(_bound, chosen, log, key) if wanted else None
        result, interrupted = _simulated(robot, assumed, chosen.theta, believed, over, options)
        least = limit.result() if limit and not interrupted else None
    done = one_of(result).runs
    title = f"{label}: {done:,} runs of {steps:,} steps, {dtype}, seed {seed}"
    if isinstance(result, Sweep):
        terminal.show_sweep(result, title)
    else:
        terminal.show_study(result, title, least)
    finish(result, folder, label, least)
    if interrupted:
        print(f"interrupted after {done:,} of {runs:,} runs; go on with: {typed()} --resume", file=sys.stderr)
    return 130 if interrupted else 0


def _bound(chosen: Scenario, log: Log, key: Any) -> Bound:
    return cramer_rao(
        chosen.model, chosen.belief, log, key, theta=chosen.theta, runs=BOUND_RUNS, control=chosen.control
    )


def _simulated(
    robot: tuple,
    theta: PyTree,
    truth_theta: PyTree,
    believed: dict[str, float],
    over: dict[str, list[float]],
    options: dict[str, Any],
) -> tuple[Study | Sweep, bool]:
    """The study, or the sweep of studies, and whether it was interrupted."""

    def assumed(**factors: float) -> PyTree:
        return {"robot": theta, "assumed": believed | factors}

    try:
        if over:
            return many_studies(*robot, over=over, theta=assumed, truth_theta=truth_theta, **options), False
        return monte_carlo(*robot, theta=assumed(), truth_theta=truth_theta, **options), False
    except Interrupted as stopped:
        return stopped.result, True
    except OSError as error:
        raise Mistake(kept(error)) from None
    except ValueError as error:
        if "cannot resume" not in str(error):
            raise
        raise Mistake(asked.line(error)) from None


def replay(
    recording: Annotated[
        str, typer.Argument(help="A name from --list, or FILE.py:NAME: your Scenario, with its LOG.")
    ] = "",
    log: Annotated[str, typer.Argument(help="A recording of yours, saved by jaxfilt.save: log.npz.")] = "",
    sequence: Annotated[str, typer.Option(help="Which drive or flight of the recording; default the first.")] = "",
    filters: Annotated[str, typer.Option("--filter", help="Of kf, ekf, iekf, ukf, ckf, with commas.")] = "ekf",
    gate: Annotated[
        str,
        typer.Option(help="Probability with which a true reading passes, or none; default the recording's own."),
    ] = "",
    robust: Annotated[
        str, typer.Option(help="Probability with which a true reading counts in full: Huber's weight beyond it.")
    ] = "none",
    theta: Annotated[str, typer.Option(help="theta.json of jaxfilt tune: the parameters to use.")] = "",
    dtype: Annotated[str, typer.Option(help="float64 or float32.")] = "float64",
    out: Annotated[str, typer.Option(help="Folder for the results; default jaxfilt-out/replay-NAME.")] = "",
    names: Annotated[bool, typer.Option("--list", help="List the recordings and their sequences and exit.")] = False,
) -> None:
    """Run filters over a recorded drive or flight, and score them: by the truth where it is known, and without."""
    if names:
        terminal.listing({name: ", ".join(datasets.sequences(name)) for name in recordings.names()}, "recordings")
        return
    makers, threshold = asked.makers(filters), asked.gate(gate, recording)
    limit = asked.probability("robust", robust)
    asked.set_dtype(dtype)
    chosen, source, label = asked.replay(recording, log, sequence)
    assumed = asked.theta(theta, chosen.theta)
    folder = asked.writable(out or f"jaxfilt-out/replay-{label}")
    bank = {name: functools.partial(built, make, chosen.model, threshold, limit) for name, make in makers.items()}
    with explained(source), terminal.progress_bar():
        result = replayed(chosen, bank, theta=assumed)
    gated = "no gate" if threshold is None else f"gate {threshold:g}"
    gated += "" if limit is None else f", robust {limit:g}"
    terminal.show_replay(result, f"{label}: {len(result.t):,} rows, {dtype}, {gated}", threshold is not None)
    finish(result, folder, label)


def _assuming(make: Callable[..., Filter], model: Callable[[PyTree], Model], theta: PyTree) -> Filter:
    """A filter that knows the robot's parameters, and takes its noises for so many times what they are."""
    return make(asked.rescaled(model(theta["robot"]), theta["assumed"]))


def _believed(belief: Callable[[PyTree], Gaussian], theta: PyTree) -> Gaussian:
    return belief(theta["robot"])
