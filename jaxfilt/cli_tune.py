"""``jaxfilt tune``: a robot that is simulated, or one that was recorded, and the filter that is to be tuned for it."""

from __future__ import annotations

import functools
import sys
from typing import Annotated, Any, get_args

import jax

from jaxfilt import arguments as asked
from jaxfilt import datasets, recordings, scenarios, terminal, tuning_data
from jaxfilt.arguments import Mistake, explained
from jaxfilt.command import built, finish, kept, typed, typer
from jaxfilt.fit import Fit
from jaxfilt.loop import Backend
from jaxfilt.study import Interrupted
from jaxfilt.tune import tune as tuned
from jaxfilt.tuning.setup import Uninfluential
from jaxfilt.tuning_data import Job


def tune(
    target: Annotated[
        str, typer.Argument(help="A scenario or a recording from --list, or FILE.py:NAME: your Scenario.")
    ] = "",
    filter: Annotated[str, typer.Option("--filter", help="One of kf, ekf, iekf, ukf, ckf.")] = "ekf",
    objective: Annotated[
        str,
        typer.Option(
            help="log-score, likelihood, mse (a block weighs one over the variance of its error before tuning), nees "
            "or nis; default log-score with a truth, else likelihood."
        ),
    ] = "",
    optimizer: Annotated[str, typer.Option(help="lbfgs, or one of optax: adam, ...")] = "lbfgs",
    learning_rate: Annotated[float, typer.Option(help="Of one of optax.")] = 0.05,
    steps: Annotated[int, typer.Option(help="At most.")] = 100,
    runs: Annotated[int, typer.Option(help="Simulated runs to learn from; as many more are held out.")] = 32,
    length: Annotated[int, typer.Option(help="Rows of a simulated run.")] = 1000,
    wrong: Annotated[
        float, typer.Option("--from", help="Simulations start so many times off, in turn above and below the truth.")
    ] = 10.0,
    sequence: Annotated[str, typer.Option(help="Of a recording, with commas, to learn from; default all others.")] = "",
    test_sequence: Annotated[
        str, typer.Option(help="To report on; default the last one; with --sequence none, but a third of the time.")
    ] = "",
    gate: Annotated[
        str,
        typer.Option(help="Of a recording, as in replay; none by default for likelihood and nis, which it would fool."),
    ] = "",
    robust: Annotated[str, typer.Option(help="As in replay, of a recording or a simulation.")] = "none",
    frozen: Annotated[
        str, typer.Option(help="Names of parameters that stay as they are, or what they begin with.")
    ] = "",
    burn_in: Annotated[float, typer.Option(help="Seconds at the start of each run that do not count.")] = 0.0,
    batch: Annotated[int, typer.Option(help="Runs, or pieces, of a step; default all. Not with lbfgs.")] = 0,
    pieces: Annotated[int, typer.Option(help="Rows of the pieces that runs are cut into. Not with lbfgs.")] = 0,
    starts: Annotated[int, typer.Option(help="Descents, the others from around the first.")] = 1,
    clip: Annotated[
        str, typer.Option(help="Largest norm of the gradient: a number, or NAME=NUMBER with commas. Not with lbfgs.")
    ] = "",
    seed: Annotated[int, typer.Option(help="Of the random numbers; the same seed, the same result.")] = 0,
    dtype: Annotated[str, typer.Option(help="float64 or float32.")] = "float64",
    backend: Annotated[str, typer.Option(help="auto, xla, or lanes (needs the extra fast).")] = "auto",
    out: Annotated[str, typer.Option(help="Folder for the results; default jaxfilt-out/tune-NAME.")] = "",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the tuning in the folder.")] = False,
    names: Annotated[bool, typer.Option("--list", help="List the scenarios and recordings and exit.")] = False,
) -> int:
    """Find Q, R and whatever else a filter assumes by gradients, and judge it on data that it did not learn from."""
    if names:
        terminal.listing({name: scenarios.about(name) for name in scenarios.SCENARIOS}, "scenarios")
        terminal.listing({name: ", ".join(datasets.sequences(name)) for name in recordings.names()}, "recordings")
        return 0
    asked.at_least(1, steps=steps, runs=runs, length=length, starts=starts)
    asked.at_least(0, seed=seed, batch=batch, pieces=pieces, **{"burn-in": burn_in})
    make = asked.maker(filter)
    asked.one_of("objective", objective, ("", *tuning_data.OBJECTIVES))
    asked.one_of("backend", backend, get_args(Backend))
    if not 0 < wrong < float("inf"):
        raise Mistake(f"--from: expected a factor above 0, got {wrong:g}")
    limits, limit = asked.clip(clip), asked.probability("robust", robust)
    asked.set_dtype(dtype)
    source, label, threshold, title = None, target, None, target
    if target in recordings.names():
        chosen = asked.recorded(target, asked.listed(sequence), asked.listed(test_sequence))
        prepared = functools.partial(tuning_data.of_recordings, *[list(part.values()) for part in chosen])
        title += f": {', '.join(chosen[0])}" + (f"; test {', '.join(chosen[1])}" if chosen[1] else "")
        threshold = None if objective in ("likelihood", "nis") and not gate else asked.gate(gate, target)
    elif sequence or test_sequence or gate:
        raise Mistake("--sequence, --test-sequence and --gate are for recordings; jaxfilt tune --list shows them")
    else:
        scenario, source, label = asked.scenario(target, "tune")
        title = label
        prepared = functools.partial(tuning_data.of_scenario, scenario, runs, length, wrong, seed)
    folder = asked.writable(out or f"jaxfilt-out/tune-{label}")
    with explained(source):
        job = prepared()
        stay = dict.fromkeys(asked.listed(frozen), "")
        stay |= {name: why for name, why in tuning_data.undetermined(job, list(stay)).items() if name not in stay}
        for name, why in stay.items():
            if why:
                print(f"frozen: {name} ({why})")
        robot = functools.partial(built, make, job.model, threshold, limit)
        options: dict[str, Any] = {
            "objective": tuning_data.objective(objective, job, robot, burn_in),
            "frozen": tuple(stay),
            "burn_in": burn_in,
            "optimizer": optimizer,
            "learning_rate": learning_rate,
            "steps": steps,
            "batch": batch or None,
            "length": pieces or None,
            "starts": starts,
            "backend": backend,
            "clip": limits,
            "key": jax.random.key(seed),
            "out": folder,
            "resume": resume,
        }
        fit, interrupted = _tuned(robot, job, options)
    print(f"{title}\n\n{fit.report()}\n")
    finish(fit, folder, title)
    if interrupted:
        done = len(fit.history.loss)
        print(f"interrupted after {done:,} of {steps:,} steps; go on with: {typed()} --resume", file=sys.stderr)
    return 130 if interrupted else 0


def _tuned(robot: Any, job: Job, options: dict[str, Any]) -> tuple[Fit, bool]:
    """What tuning found, and whether it was interrupted; parameters that turn out to do nothing are frozen too."""
    about = {"space": job.space, "view": job.view, "blocks": job.blocks, "split": job.split}
    try:
        with terminal.tuning_bar() as progress:
            data = job.belief, job.theta, job.logs, job.truth
            return tuned(robot, *data, truth_theta=job.truth_theta, progress=progress, **about, **options), False
    except Interrupted as stopped:
        return stopped.result, True
    except Uninfluential as error:
        for name in error.names:
            print(f"frozen: {name} ({tuning_data.SILENT})")
        return _tuned(robot, job, options | {"frozen": (*options["frozen"], *error.names)})
    except OSError as error:
        raise Mistake(kept(error)) from None
    except (ValueError, KeyError) as error:
        raise Mistake(asked.line(error)) from None
