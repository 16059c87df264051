"""What the commands of the command line share: how they were typed, and how they end."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxfilt import arguments as asked
from jaxfilt import report
from jaxfilt.arguments import Mistake
from jaxfilt.bound import Bound
from jaxfilt.fit import Fit
from jaxfilt.review import Replayed
from jaxfilt.study import Study
from jaxfilt.sweep import Sweep
from jaxfilt.types import Filter, Model, PyTree

MISSING: str | None = None
"""The package of the extra `cli` that is not installed."""

if TYPE_CHECKING:
    import typer
else:
    try:
        import rich  # noqa: F401
        import typer
    except ModuleNotFoundError as missing:  # `jaxfilt.cli.main` says so
        MISSING, typer = missing.name, None


def typed() -> str:
    """The command that makes the same again."""
    return shlex.join(["jaxfilt", *[word for word in sys.argv[1:] if word != "--resume"]])


def kept(error: OSError) -> str:
    """What hinders a study or a tuning from keeping its state."""
    if isinstance(error, FileExistsError):
        return f"{error}; go on with: {typed()} --resume"
    return f"{error.filename}: {error.strerror}" if error.filename else asked.line(error)


def built(
    make: Callable[..., Filter],
    model: Callable[[PyTree], Model],
    gate: float | None,
    robust: float | None,
    theta: PyTree,
) -> Filter:
    """A filter of these parameters."""
    return make(model(theta), gate=gate, robust=robust)


def finish(result: Study | Sweep | Replayed | Fit, folder: Path, label: str, bound: Bound | None = None) -> None:
    """Write all files, and say where they are and how long it took."""
    try:
        report.write(result, folder, label, bound=bound, command=typed())
    except ModuleNotFoundError as missing:
        raise Mistake(asked.line(missing)) from None
    except OSError as error:
        raise Mistake(f"{folder}: cannot write the results: {error.strerror}") from None
    timed = one_of(result)
    spent = f"compile {timed.compile_seconds:.1f} s, run {timed.run_seconds:.1f} s"
    print(spent if isinstance(result, Fit) else f"{spent}; bounds hold {100 * timed.confidence:g} % of the time")
    print(f"written: {', '.join(str(folder / name) for name in report.files(result))}")


def one_of(result: Any) -> Any:
    """The result, or the first study of a sweep: how long it took, and of how many runs it is, all share."""
    return result.studies.flat[0] if isinstance(result, Sweep) else result
