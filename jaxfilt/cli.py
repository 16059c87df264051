"""The command line: ``jaxfilt study`` and ``jaxfilt replay``. The only room that touches argv and global settings."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import jax
import numpy as np

from jaxfilt import datasets, files, metrics, recordings, report, scenarios
from jaxfilt.filters import ckf, ekf, iekf, kf, ukf
from jaxfilt.metrics import Consistency
from jaxfilt.study import Replayed, Study, replayed
from jaxfilt.study import study as monte_carlo
from jaxfilt.types import Filter, Model, PyTree, Replay, Scenario, Status

MISSING: str | None = None
if TYPE_CHECKING:
    import typer
    from rich.table import Table
else:
    try:
        import rich  # noqa: F401
        import typer
    except ModuleNotFoundError as missing:  # the extra `cli` is not installed: `main` says so
        MISSING = missing.name

FILTERS: dict[str, Callable[..., Filter]] = {"kf": kf, "ekf": ekf, "iekf": iekf, "ukf": ukf, "ckf": ckf}

COLOURS = {"inside": "green", "above": "red", "below": "yellow", "unknown": "dim"}


class Mistake(Exception):
    """Something that the user can mend, said in one line."""


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
    return commands


def _jaxfilt(version: Annotated[bool, typer.Option("--version", help="Show the versions and exit.")] = False) -> None:
    if version:
        print(f"jaxfilt {report.version('jaxfilt')}, jax {jax.__version__}")


def study(
    scenario: Annotated[
        str,
        typer.Argument(help="A name from --list, or FILE.py:NAME: your Scenario, or a function returning one."),
    ] = "",
    filters: Annotated[str, typer.Option("--filter", help="Of kf, ekf, iekf, ukf, ckf, with commas.")] = "ekf,ukf",
    runs: Annotated[int, typer.Option(help="Simulated runs.")] = 1000,
    steps: Annotated[int, typer.Option(help="Steps of a run.")] = 1000,
    seed: Annotated[int, typer.Option(help="Of the random numbers; the same seed, the same study.")] = 0,
    dtype: Annotated[str, typer.Option(help="float64 or float32.")] = "float64",
    out: Annotated[str, typer.Option(help="Folder for the results; default jaxfilt-out/study-NAME.")] = "",
    names: Annotated[bool, typer.Option("--list", help="List the scenarios and exit.")] = False,
) -> None:
    """Simulate many runs of a robot, filter them all, and say whether the filters know how wrong they are."""
    if names:
        _list({name: scenarios.about(name) for name in scenarios.SCENARIOS}, "scenarios")
        return
    _at_least(1, runs=runs, steps=steps)
    _at_least(0, seed=seed)
    makers = _makers(filters)
    _set_dtype(dtype)
    chosen, source, label = _scenario(scenario)
    folder = _writable(out or f"jaxfilt-out/study-{label}")
    bank = {name: functools.partial(_built, make, chosen.model) for name, make in makers.items()}
    with _explained(source), _progress() as progress:
        result = monte_carlo(
            chosen.model,
            bank,
            chosen.belief,
            chosen.schedule(steps),
            jax.random.key(seed),
            theta=chosen.theta,
            runs=runs,
            control=chosen.control,
            blocks=chosen.blocks,
            progress=progress,
        )
    table = _table(f"{label}: {runs:,} runs of {steps:,} steps, {dtype}, seed {seed}", list(makers))
    scores = list(result.scores.values())
    for block, (_, unit) in result.blocks.items():
        _row(table, _with_unit(f"RMSE {block}", unit), [f"{s.rmse_total[block]:.4g}" for s in scores])
    table.add_section()
    _row(table, f"mean NEES ({scores[0].nees_total.expected:g})", [_judged(s.nees_total) for s in scores])
    for sensor, score in scores[0].nis_total.items():
        _row(table, f"mean NIS {sensor} ({score.expected:g})", [_judged(s.nis_total[sensor]) for s in scores])
    table.add_section()
    _row(table, "diverged runs", [_count(int(s.diverged.sum())) for s in scores])
    _print(table)
    for name, s in result.scores.items():
        if s.fault is not None:
            f = s.fault
            _print(
                f"{name}: run {f.run}, step {f.step}, sensor {f.sensor!r}: {f.status.name.lower().replace('_', ' ')}"
            )
    _finish(result, folder, label)


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
    dtype: Annotated[str, typer.Option(help="float64 or float32.")] = "float64",
    out: Annotated[str, typer.Option(help="Folder for the results; default jaxfilt-out/replay-NAME.")] = "",
    names: Annotated[bool, typer.Option("--list", help="List the recordings and their sequences and exit.")] = False,
) -> None:
    """Run filters over a recorded drive or flight, and score them: by the truth where it is known, and without."""
    if names:
        _list({name: ", ".join(datasets.sequences(name)) for name in recordings.names()}, "recordings")
        return
    makers, threshold = _makers(filters), _gate(gate, recording)
    _set_dtype(dtype)
    chosen, source, label = _replay(recording, log, sequence)
    folder = _writable(out or f"jaxfilt-out/replay-{label}")
    bank = {name: functools.partial(_built, make, chosen.model, gate=threshold) for name, make in makers.items()}
    with _explained(source), _progress():
        result = replayed(chosen, bank)
    gated = "no gate" if threshold is None else f"gate {threshold:g}"
    table = _table(f"{label}: {len(result.t):,} rows, {dtype}, {gated}", list(makers))
    reviews = list(result.reviews.values())
    if result.truth is not None:
        for block, (_, unit) in result.blocks.items():
            _row(table, _with_unit(f"RMSE {block}", unit), [f"{r.rmse[block]:.4g}" for r in reviews if r.rmse])
        _row(table, f"mean NEES ({result.space.dim})", [f"{r.nees_mean.mean:.4g}" for r in reviews if r.nees_mean])
        table.add_section()
    for sensor, score in reviews[0].nis.items():
        _row(table, f"mean NIS {sensor} ({score.expected:.4g})", [_judged(r.nis[sensor]) for r in reviews])
        _row(table, f"white at lags, {sensor}", [_white(r.whiteness[sensor]) for r in reviews])
        if threshold is not None:
            _row(table, f"refused, {sensor}", [_share(r.refused[sensor], r.info[sensor].status) for r in reviews])
    table.add_section()
    _row(table, "diverged", ["[red]yes[/]" if r.diverged else "no" for r in reviews])
    _print(table)
    _finish(result, folder, label)


def _built(make: Callable[..., Filter], model: Callable[[PyTree], Model], theta: PyTree, **options: Any) -> Filter:
    return make(model(theta), **options)


# --- what was asked for ---------------------------------------------------------------------------------------------


def _at_least(least: int, **named: int) -> None:
    for name, value in named.items():
        if value < least:
            raise Mistake(f"--{name}: expected at least {least}, got {value}")


def _makers(filters: str) -> dict[str, Callable[..., Filter]]:
    chosen = dict.fromkeys(name.strip() for name in filters.split(","))
    for name in chosen:
        if name not in FILTERS:
            raise Mistake(f"--filter: expected some of {', '.join(FILTERS)}, got {name!r}")
    return {name: FILTERS[name] for name in chosen}


def _set_dtype(dtype: str) -> None:
    if dtype not in ("float32", "float64"):
        raise Mistake(f"--dtype: expected float64 or float32, got {dtype!r}")
    jax.config.update("jax_enable_x64", dtype == "float64")


def _gate(gate: str, recording: str) -> float | None:
    if not gate:
        return recordings.GATES.get(recording)
    if gate == "none":
        return None
    try:
        probability = float(gate)
    except ValueError:
        probability = np.nan
    if not 0 < probability < 1:
        raise Mistake(f"--gate: expected a probability between 0 and 1, or none, got {gate!r}")
    return probability


def _writable(out: str) -> Path:
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Mistake(f"--out: cannot make the folder {folder}: {error.strerror}") from None
    if not os.access(folder, os.W_OK):
        raise Mistake(f"--out: cannot write to the folder {folder}")
    return folder


def _scenario(target: str) -> tuple[Scenario, Path | None, str]:
    """The scenario, the user's file that it is from, and a name for it."""
    if not target:
        raise Mistake("study: expected a scenario; jaxfilt study --list shows them")
    if ":" in target or target.endswith(".py"):
        return _own_scenario(target)
    try:
        return scenarios.scenario(target), None, target
    except KeyError as unknown:
        raise Mistake(f"{unknown.args[0]}; your own is FILE.py:NAME") from None


def _own_scenario(target: str) -> tuple[Scenario, Path, str]:
    """A user's scenario from FILE.py:NAME."""
    file, _, name = target.rpartition(":")
    if not file:
        raise Mistake(f"{target}: expected FILE.py:NAME, got no name")
    path = Path(file)
    if not path.is_file():
        raise Mistake(f"{target}: there is no file {file}")
    with _explained(path):
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


def _replay(recording: str, log: str, sequence: str) -> tuple[Replay, Path | None, str]:
    """The replay, the user's file that it is from, and a name for it."""
    if not recording:
        raise Mistake("replay: expected a recording; jaxfilt replay --list shows them")
    if ":" in recording or recording.endswith(".py"):
        if not log:
            raise Mistake(f"{recording}: expected a LOG after it, a file written by jaxfilt.save")
        scenario, path, label = _own_scenario(recording)
        with _explained(path):
            model = scenario.model(scenario.theta)
        try:
            recorded = files.load(log, model)
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise Mistake(_line(error) if log in _line(error) else f"{log}: {_line(error)}") from None
        own = Replay(
            scenario.model, scenario.belief, scenario.theta, recorded, None, model.space, lambda x: x, scenario.blocks
        )
        return own, path, f"{label}-{Path(log).stem}"
    if log:
        raise Mistake(f"{recording}: expected no LOG after the name of a recording, got {log}")
    try:
        chosen = recordings.replay(recording, sequence or None)
    except (KeyError, FileNotFoundError) as error:
        raise Mistake(_line(error)) from None
    return chosen, None, f"{recording}-{sequence}" if sequence else recording


@contextlib.contextmanager
def _explained(path: Path | None) -> Iterator[None]:
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
            raise Mistake(f"{path}:{lines[-1]}: {type(error).__name__}: {_line(error)}") from None
        if isinstance(error, (ValueError, TypeError, KeyError)):
            raise Mistake(f"{path}: {_line(error)}") from None
        raise


def _line(error: Exception) -> str:
    """An exception's text as one line; a KeyError's without the quotes that Python adds."""
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return " ".join(text.split())


# --- what is shown --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[int, int], None]]:
    """A spinner while it compiles, a bar while it runs; on stderr, and only where somebody looks."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("compiling", total=None)

        def progress(done: int, total: int) -> None:
            bar.update(task, description=f"{done:,} of {total:,} runs", completed=done, total=total)

        yield progress


def _print(what: Any) -> None:
    from rich.console import Console

    Console(highlight=False).print(what)


def _list(lines: dict[str, str], title: str) -> None:
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None, show_header=False, padding=(0, 2, 0, 0))
    for name, text in lines.items():
        table.add_row(f"[bold]{name}[/]", text)
    _print(table)


def _table(title: str, filters: list[str]) -> Table:
    from rich import box
    from rich.table import Table

    print(title)  # not the table's own title, which would be as narrow as the table
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("")
    for name in filters:
        table.add_column(name)
    return table


def _row(table: Table, label: str, cells: Iterable[str]) -> None:
    """A row; the label is a user's, and no markup."""
    from rich.text import Text

    table.add_row(Text(label), *cells)


def _with_unit(name: str, unit: str) -> str:
    return f"{name}, {unit}" if unit else name


def _judged(c: Consistency) -> str:
    """A mean with its verdict, and on a second line its bounds."""
    verdict = metrics.verdict(c)
    bounds = "" if verdict == "unknown" else f"\n[dim]{c.low:.4g} to {c.high:.4g}[/]"
    return f"{c.mean:.4g} [{COLOURS[verdict]}]{verdict}[/]{bounds}"


def _count(number: int) -> str:
    return f"[red]{number:,}[/]" if number else "0"


def _white(w: metrics.Whiteness) -> str:
    inside = int((np.abs(w.autocorrelation) <= w.bound).sum())
    colour = "green" if inside == len(w.lags) else "yellow"
    return f"[{colour}]{inside} of {len(w.lags)}[/]"


def _share(refused: int, status: np.ndarray) -> str:
    there = int((np.asarray(status) != Status.ABSENT).sum())
    return f"{refused:,} of {there:,}"


def _finish(result: Study | Replayed, folder: Path, label: str) -> None:
    try:
        report.write(result, folder, label)
    except ModuleNotFoundError as missing:
        raise Mistake(_line(missing)) from None
    print(
        f"compile {result.compile_seconds:.1f} s, run {result.run_seconds:.1f} s; "
        f"bounds hold {100 * result.confidence:g} % of the time"
    )
    picture = "study.png" if isinstance(result, Study) else "replay.png"
    print(f"written: {folder / 'summary.json'}, {folder / picture}")
