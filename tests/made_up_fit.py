"""A fit that nobody tuned, for reports: two blocks, two sensors, one direction that says little."""

import jax.numpy as jnp
import numpy as np

import jaxfilt as jf
from jaxfilt.consistency import Consistency
from jaxfilt.fit import (
    BEFORE,
    ESTIMATED,
    TEST,
    TRAIN,
    TRUE,
    TUNED,
    VALIDATION,
    Covariances,
    Fit,
    Flat,
    History,
    Parameter,
    PartScores,
)
from jaxfilt.scores import Estimate

BLOCKS = {"position": ((0, 1), "m"), "yaw": ((2,), "rad")}
STAGES = (BEFORE, ESTIMATED, TUNED, TRUE)
FLAT = "the scale of slip and turn against R is hardly determined: slip -0.8, turn 0.6"
FINDINGS = (
    "tuning does not beat noise estimation on the test part: log score +0.003 ± 0.004",
    "2 of 13 steps were refused: a filter diverged within them",
)


def model(theta):
    """Three walks, two sensors."""
    r = jnp.exp(theta["gnss"])
    return jf.linear(
        A=jnp.eye(3),
        H={"gnss": jnp.eye(3)[:2], "compass": jnp.eye(3)[2:]},
        Q=jnp.diag(jnp.exp(2 * theta["q"])),
        R={"gnss": r**2 * jnp.eye(2), "compass": jnp.exp(2 * theta["compass"]) * jnp.eye(1)},
    )


def made_up_fit(name="gnss", truth=True):
    """Tuned from stages each half as far from the truth as the one before; without a truth by innovations alone.

    Args:
        name: of the first sensor and its parameter.
        truth: whether anybody knows where the robot was.
    """
    true = {name: 0.0, "compass": -4.0, "q": np.array([-3.0, -3.0, -5.0])}
    names = [name, "compass", "q[0]", "q[1]", "q[2]"]
    known = np.array([0.0, -4.0, -3.0, -3.0, -5.0])
    off = 2.3 * np.array([1, -1, 1, -1, 1])
    stages = {BEFORE: 1.0, ESTIMATED: 0.1, TUNED: 0.02, TRUE: 0.0}
    if not truth:
        stages = {BEFORE: 1.0, TUNED: 0.02}
    free = [
        Parameter(
            own,
            float(k + o),
            float(k + 0.1 * o) if truth else None,
            float(k + 0.02 * o),
            e,
            float(k) if truth else None,
        )
        for own, k, o, e in zip(names, known, off, [0.03, 0.05, 0.2, np.nan, 30.0], strict=True)
    ]
    steps = 13
    left = 2.0 ** -np.arange(steps)
    refused = np.isin(np.arange(steps), (3, 4))
    validation = np.where(np.arange(steps) % 2 == 0, 1.1 + 40 * left, np.nan)
    history = History(
        1.0 + 50 * left, validation, 90 * left, known + left[:, None] * off, refused, 0.3 * np.arange(1, steps + 1)
    )
    return Fit(
        theta=_at(true, 0.02),
        start=_at(true, 1.0),
        estimated=_at(true, 0.1) if truth else None,
        truth_theta=true if truth else None,
        model=model({"gnss": 0.046, "compass": -4.046, "q": jnp.array(true["q"]) + 0.046}),
        scores={
            stage: {part: _scores(share + k, truth, name) for k, part in enumerate((TRAIN, VALIDATION, TEST))}
            for stage, share in stages.items()
        },
        parameters=tuple(free),
        errors_by="sandwich over 32 runs",
        flat=(Flat({"q[0]": -0.8, "q[2]": 0.6}, 1e-6, float("inf"), FLAT),),
        covariances={stage: _covariances(1 + share, name) for stage, share in stages.items()},
        history=history,
        starts=np.array([1.0, 1.02, np.nan]),
        best=10,
        findings=FINDINGS,
        frozen=("mark[0]", "mark[1]"),
        objective="log score" if truth else "likelihood",
        optimizer="lbfgs",
        stopped="the gradient vanished after 13 steps",
        split="by run: 32 to train, 8 to validate, 8 to test",
        blocks=BLOCKS if truth else None,
        runs=48,
        dtype="float64",
        seed=3,
        compile_seconds=4.2,
        run_seconds=1.3,
    )


def _at(true, share):
    q = true["q"] + 2.3 * share * np.array([1, -1, 1])
    return {key: float(value + 2.3 * share) if key != "q" else q for key, value in true.items()}


def _scores(off, truth, name):
    ratio = 1 + 3 * off
    nees = Consistency(3 * ratio, 3.0, 2.7, 3.3, 0.2)
    nis = {name: Consistency(2 * ratio, 2.0, 1.8, 2.2, 0.1), "compass": Consistency(1 / ratio, 1.0, 0.9, 1.1, 0.5)}
    score = Estimate(-1.25 - off, 0.01234)
    return PartScores(
        loss=1.25 + off,
        runs=8,
        rows=1600,
        rmse={"position": 0.5 * ratio, "yaw": 0.0123 * ratio} if truth else None,
        log_score=score if truth else None,
        nees=nees if truth else None,
        nis=nis,
        diverged=2 if off == 1 else 0,
    )


def _covariances(scale, name):
    R = {name: np.diag([1.5, 1.5]) * scale, "compass": np.eye(1) * 1e-4}
    Q = np.array([[0.05, 0.01, 0.0], [0.01, 0.05, 0.0], [0.0, 0.0, 0.000123456789]]) * scale
    return Covariances(0.02, Q, R, np.eye(3))
