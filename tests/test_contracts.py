"""One table of filters times one table of contracts: a new filter that is not in the table fails."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import CAR, Car, car_system, cast

import jaxfilt as jf
from jaxfilt import filters

FILTERS = {
    "kf": jf.kf,
    "ekf": jf.ekf,
    "iekf": functools.partial(jf.iekf, iterations=2),
    "ukf": functools.partial(jf.ukf, alpha=0.6),
    "ckf": jf.ckf,
    "build": lambda model, gate=None: jf.build(jf.gauss_hermite(2), model, gate),
}

GATE = 1 - 1e-6
S = car_system(8)
ROW = jax.tree.map(lambda a: a[3], S.log)._replace(dt=np.array(0.1))
SEEN = {"mark": np.array([True, True]), "gnss": np.array([True, True])}
SILENT = {name: np.zeros_like(mask) for name, mask in SEEN.items()}
NEAR = jax.tree.map(np.asarray, {"gnss": S.belief.mean.pos + 0.5, "mark": (np.array(25.0), np.array(-2.6))})
FAR = {"gnss": S.belief.mean.pos + 1e3, "mark": (np.array(900.0), np.array(1.0))}


def test_every_filter_is_in_the_table():
    """A filter factory is a public function of `jaxfilt.filters` that returns a Filter."""
    functions = inspect.getmembers(filters, inspect.isfunction)
    local = {name: f for name, f in functions if f.__module__ == filters.__name__ and not name.startswith("_")}
    factories = {name for name, f in local.items() if inspect.signature(f).return_annotation == "Filter"}
    assert factories == set(local) == set(FILTERS)
    assert factories <= set(jf.__all__)


class Case:
    """A filter of the car, gated, its step jitted: theta, belief and row are arguments, so it compiles once."""

    def __init__(self, factory):
        self.factory = factory
        self.step = jax.jit(lambda theta, belief, row: factory(S.model(theta), gate=GATE).step(belief, row))

    def row(self, valid, z=None, dt=0.0):
        z = z or NEAR
        c = {"mark": np.array([30.0, 5.0])} if "mark" in z else {}
        return ROW._replace(dt=np.array(dt), valid=valid, z=z, c=c)

    def __call__(self, valid, z=None, dt=0.0, belief=S.belief, theta=S.theta):
        belief, info = self.step(theta, belief, self.row(valid, z, dt))
        return jax.tree.map(np.asarray, (belief, info))


@pytest.fixture(scope="module", params=FILTERS)
def case(request):
    return Case(FILTERS[request.param])


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def close(a, b, rtol=1e-11):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=rtol, atol=1e-13)


def in_no_time_and_silence_nothing_changes(case):
    belief, info = case(SILENT)
    same(belief, S.belief)
    for one in info.values():
        assert one.status == jf.Status.ABSENT
        assert one.dof == one.loglik == one.nis == one.ratio == 0
        assert not one.S.any()


def time_adds_uncertainty_and_readings_remove_it(case):
    later, _ = case(SILENT, dt=0.5)
    assert np.linalg.eigvalsh(later.cov - S.belief.cov)[-1] > 0.01
    after, info = case(SEEN)
    assert np.linalg.det(after.cov) < 0.1 * np.linalg.det(S.belief.cov)
    assert np.linalg.eigvalsh(S.belief.cov - after.cov)[-1] > 0.1
    for name, one in info.items():
        assert (one.status, one.dof) == (jf.Status.OK, 2), name


def the_belief_keeps_its_structure_and_a_covariance_is_one(case):
    for belief, _ in (case(SILENT, dt=0.5), case(SEEN), case(SEEN, dt=0.5)):
        assert isinstance(belief, jf.Gaussian)
        assert isinstance(belief.mean, Car)
        same(belief.cov, belief.cov.T)
        assert np.linalg.eigvalsh(belief.cov)[0] > 0
        assert -np.pi <= belief.mean.yaw <= np.pi


def the_report_is_that_of_a_gaussian(case):
    _, info = case(SEEN, dt=0.5)
    for one in info.values():
        nis = one.innovation @ np.linalg.solve(one.S, one.innovation)
        np.testing.assert_allclose(one.nis, nis, rtol=1e-11)
        np.testing.assert_allclose(one.loglik, -0.5 * (nis + np.linalg.slogdet(2 * np.pi * one.S)[1]), rtol=1e-11)
        np.testing.assert_allclose(one.ratio, one.nis / (-2 * np.log(1 - GATE)), rtol=1e-8)  # chi-square of 2 dof


def a_refused_reading_changes_nothing(case):
    belief, info = case(SEEN, z=FAR)
    same(belief, S.belief)
    for one in info.values():
        assert (one.status, one.dof, one.loglik) == (jf.Status.GATED, 0, 0)
        assert one.ratio > 1


def a_silent_sensor_leaves_the_others_alone(case):
    for name in SEEN:
        both = case(SILENT | {name: SEEN[name]}, z=FAR | {name: NEAR[name]})
        alone = case(SILENT | {name: SEEN[name]}, z=NEAR)
        same(both, alone)
        assert both[1][name].dof == 2


def what_a_mask_hides_counts_for_nothing(case):
    """In belief and likelihood: any number may stand there; and the model without that row says exactly the same."""
    model = S.model(S.theta)
    mark, gnss = model.sensors["mark"], model.sensors["gnss"]
    keep = {
        "mark": (lambda z: z[1], jf.Sensor(lambda x, c: mark.h(x, c)[1], lambda x, c: mark.R(x, c)[1:, 1:], jf.angle)),
        "gnss": (
            lambda z: z[:1],
            jf.Sensor(lambda x, c: gnss.h(x, c)[:1], lambda x, c: gnss.R(x, c)[:1, :1], jf.vector(1)),
        ),
    }
    masks = {"mark": np.array([False, True]), "gnss": np.array([True, False])}
    masked = case(masks)
    wrong = {"mark": (np.array(1e5), NEAR["mark"][1]), "gnss": NEAR["gnss"] * np.array([1.0, -1e6])}
    same(case(masks, z=wrong), masked)
    reduced = case.factory(model._replace(sensors={name: sensor for name, (_, sensor) in keep.items()}), gate=GATE)
    row = case.row({}, {name: part(NEAR[name]) for name, (part, _) in keep.items()})
    belief, info = reduced.step(S.belief, row)
    close(masked[0], belief, 1e-12)
    for name in masks:
        assert masked[1][name].dof == info[name].dof == 1
        for field in ("loglik", "nis", "ratio"):
            close(getattr(masked[1][name], field), getattr(info[name], field), 1e-12)


def one_step_is_predict_then_each_update(case):
    """By hand and outside jit, with the sensors in the model's order."""
    filt = case.factory(S.model(S.theta), gate=GATE)
    belief = filt.predict(S.belief, ROW.u, 0.2)
    belief, mark = filt.update(belief, NEAR["mark"], "mark", np.array([30.0, 5.0]))
    belief, gnss = filt.update(belief, NEAR["gnss"], "gnss")
    close(case(SEEN, dt=0.2), (belief, {"mark": mark, "gnss": gnss}))


def a_batch_is_its_runs(case):
    """Under vmap branches become selects: each run still gets its own."""
    rows = [case.row(SEEN, dt=0.3), case.row(SILENT), case.row(SEEN, z=FAR), case.row(SILENT | {"mark": SEEN["mark"]})]
    batch = jax.tree.map(lambda *a: np.stack(a), *rows)
    got = jax.jit(jax.vmap(case.step, in_axes=(None, None, 0)))(S.theta, S.belief, batch)
    for k, row in enumerate(rows):
        close(jax.tree.map(lambda a, k=k: a[k], got), case.step(S.theta, S.belief, row))
    for k in (1, 2):  # nothing, and refused
        same(jax.tree.map(lambda a, k=k: np.asarray(a[k]), got[0]), S.belief)


def float32_stays_float32(case):
    theta, belief, row = (cast(tree, np.float32) for tree in (S.theta, S.belief, case.row(SEEN, dt=0.2)))
    got = case.factory(S.model(theta), gate=GATE).step(belief, row)
    for leaf in jax.tree.leaves(got):
        assert leaf.dtype in (np.float32, np.int32)
    want = case(SEEN, dt=0.2)
    size = np.sqrt(np.diag(want[0].cov))
    assert np.abs((got[0].cov - want[0].cov.astype(np.float32)) / np.outer(size, size).astype(np.float32)).max() < 1e-3
    got64 = cast(got[0].mean, np.float64)
    assert np.abs(np.asarray(CAR.minus(got64, want[0].mean)) / size).max() < 1e-3


def bad_news_is_reported(case):
    bad = dict(NEAR, gnss=np.array([np.nan, 0.0]))
    _, info = case(SEEN, z=bad)
    assert (info["mark"].status, info["gnss"].status) == (jf.Status.OK, jf.Status.BAD_MEASUREMENT)
    broken = S.belief._replace(cov=np.full((4, 4), np.nan))
    _, info = case(SEEN, belief=broken)
    assert info["mark"].status == jf.Status.BAD_BELIEF
    _, info = case(SILENT, belief=broken)
    assert info["mark"].status == jf.Status.ABSENT
    indefinite = S.belief._replace(cov=-S.belief.cov)
    _, info = case(SEEN, belief=indefinite)
    assert info["mark"].status >= jf.Status.BAD_BELIEF


def gradients_equal_differences(case):
    """Of likelihood, mean and covariance, with respect to noises, dynamics, belief and readings."""
    row = case.row({"gnss": np.array([True, False])}, {"gnss": NEAR["gnss"]}, dt=0.2)

    @jax.jit
    @jax.value_and_grad
    def value_and_grad(parameters):
        theta, belief, z = parameters
        belief, info = case.factory(S.model(theta), gate=GATE).step(belief, row._replace(z=z))
        away = CAR.minus(belief.mean, S.belief.mean)
        return away @ away + jnp.trace(belief.cov) - sum(one.loglik for one in info.values())

    parameters = jax.tree.map(np.asarray, (S.theta, S.belief, row.z))
    _, gradient = value_and_grad(parameters)
    assert gradient[2]["gnss"][1] == 0
    rng = np.random.default_rng(7)
    for _ in range(4):
        direction = jax.tree.map(lambda a: rng.normal(size=np.shape(a)), parameters)
        # A covariance moves as a covariance: symmetric.
        direction[1].cov[:] = direction[1].cov @ direction[1].cov.T
        ahead, behind = (
            value_and_grad(jax.tree.map(lambda a, d, h=h: a + h * d, parameters, direction))[0] for h in (1e-6, -1e-6)
        )
        slope = sum(np.vdot(g, d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True))
        np.testing.assert_allclose(slope, (ahead - behind) / 2e-6, rtol=1e-6)


CONTRACTS = [
    in_no_time_and_silence_nothing_changes,
    time_adds_uncertainty_and_readings_remove_it,
    the_belief_keeps_its_structure_and_a_covariance_is_one,
    the_report_is_that_of_a_gaussian,
    a_refused_reading_changes_nothing,
    a_silent_sensor_leaves_the_others_alone,
    what_a_mask_hides_counts_for_nothing,
    one_step_is_predict_then_each_update,
    a_batch_is_its_runs,
    float32_stays_float32,
    bad_news_is_reported,
    gradients_equal_differences,
]


@pytest.mark.parametrize("contract", CONTRACTS, ids=lambda contract: contract.__name__)
def test_contract(case, contract):
    contract(case)
