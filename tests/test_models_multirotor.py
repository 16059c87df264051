"""Multirotors against mechanics: conserved quantities, scipy's rotations and integrators, the textbook's Euler form."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt.models import multirotor as multirotors
from jaxfilt.models import rotors, sensors
from jaxfilt.models.control import GRAVITY, circle, controller, figure_eight, hover
from jaxfilt.models.multirotor import BODY, EULER_BODY, EulerBody, RigidBody

J = np.array([0.02, 0.03, 0.045])
MASS, DRAG = 1.3, 0.4
SPINNING = RigidBody(
    np.array([1.0, 2.0, 3.0]), np.array([0.5, -1.0, 2.0]), np.array([0.5, 0.5, -0.5, 0.5]), np.array([3.0, 0.4, -4.0])
)
WRENCH = np.array([15.0, 0.01, -0.02, 0.03])
AIRFRAMES = {"hummingbird": rotors.hummingbird(), "firefly": rotors.firefly(), "crazyflie": rotors.crazyflie()}


def tumbling(x, u):
    return multirotors.rigid_body_rate(x, jnp.zeros(3), jnp.zeros(3), MASS, jnp.asarray(J))


def flying(x, u):
    return multirotors.multirotor_rate(x, u, MASS, jnp.asarray(J), DRAG)


def rotation(att) -> Rotation:
    """scipy's, which wants the scalar last."""
    return Rotation.from_quat(np.roll(np.asarray(att), -1, axis=-1))


@functools.partial(jax.jit, static_argnums=(0, 4))
def states(f, x, u, dt, steps):
    """The states, the first of them x, under a held input."""

    def body(x, _):
        return f(x, u, dt), x

    return jax.lax.scan(body, x, length=steps)[1]


def fly(f, x, u, dt, steps):
    """The same as NumPy arrays."""
    return jax.tree.map(np.asarray, states(f, jax.tree.map(jnp.asarray, x), u, dt, steps))


TUMBLING = jf.rk4(tumbling, BODY)


def by_scipy(x, force_and_moment, t):
    """The same body at time t by solve_ivp, its attitude as a rotation matrix with R_dot = R [w]x."""

    def rate(_, y):
        v, R, w = y[3:6], y[6:15].reshape(3, 3), y[15:]
        force, moment = force_and_moment(v, R)
        skew = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        acc = R @ force / MASS - np.array([0, 0, GRAVITY])
        return np.concatenate([v, acc, (R @ skew).ravel(), (moment - np.cross(w, J * w)) / J])

    y0 = np.concatenate([x.pos, x.vel, rotation(x.att).as_matrix().ravel(), x.rates])
    y = solve_ivp(rate, (0, t), y0, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    return y[:3], y[3:6], y[6:15].reshape(3, 3), y[15:]


def error(x, k, want):
    """Largest difference in position, velocity, rotation matrix and rates, after k steps."""
    got = x.pos[k], x.vel[k], rotation(x.att[k]).as_matrix(), x.rates[k]
    return max(np.abs(a - b).max() for a, b in zip(got, want, strict=True))


# --- dynamics ----------------------------------------------------------------------------------------------------


def test_without_torque_energy_and_momentum_are_conserved():
    x = fly(TUMBLING, SPINNING, (), 0.002, 1501)
    spin = 0.5 * (J * x.rates**2).sum(1)
    energy = spin + 0.5 * MASS * (x.vel**2).sum(1) + MASS * GRAVITY * x.pos[:, 2]
    np.testing.assert_allclose(spin, spin[0], rtol=1e-9)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(J * x.rates, axis=1), np.linalg.norm(J * x.rates[0]), rtol=1e-9)
    momentum = rotation(x.att).apply(J * x.rates)
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-9)
    assert np.ptp(x.rates[:, 1]) > 1, "it should tumble, not spin"


def test_free_tumbling_as_scipy_has_it():
    x = fly(TUMBLING, SPINNING, (), 0.002, 1501)
    assert error(x, 1000, by_scipy(SPINNING, lambda v, R: (np.zeros(3), np.zeros(3)), 2.0)) < 1e-8


@pytest.mark.parametrize(
    ("integrate", "order"), [(jf.euler, 1), (multirotors.split_step, 2), (jf.rk4, 4)], ids=["euler", "split", "rk4"]
)
def test_powered_flight_and_order_of_convergence(integrate, order):
    """Thrust, moments and drag against scipy; half the step, 2^order times less error."""

    def push(v, R):
        across = R.T @ v * [1, 1, 0]
        return np.array([0, 0, WRENCH[0]]) - DRAG * across, WRENCH[1:]

    want = by_scipy(SPINNING, push, 0.4)
    f = integrate(flying, BODY)
    errors = [error(fly(f, SPINNING, WRENCH, 0.4 / steps, 161), steps, want) for steps in (80, 160)]
    assert errors[0] < {1: 0.3, 2: 5e-3, 4: 2e-6}[order]
    assert errors[0] / errors[1] == pytest.approx(2**order, rel=0.15)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_hover_is_an_equilibrium(name):
    airframe = AIRFRAMES[name]
    n = len(airframe.rotors.pos)
    wrench = rotors.allocation(airframe.rotors) @ np.full(n, airframe.mass * GRAVITY / n)
    physics = airframe.mass, jnp.asarray(airframe.inertia), airframe.drag
    x = RigidBody(jnp.array([1.0, -2.0, 3.0]), jnp.zeros(3), jf.so3_exp(jnp.array([0.0, 0.0, 2.0])), jnp.zeros(3))
    still = multirotors.multirotor_rate(x, wrench, *physics)
    for rate in jax.tree.leaves(still):
        np.testing.assert_allclose(rate, 0, atol=1e-12)
    heading = EulerBody(x.pos, x.vel, jnp.array([0.0, 0.0, 2.0]), x.rates)
    for rate in jax.tree.leaves(multirotors.euler_rate(heading, wrench, *physics)):
        np.testing.assert_allclose(rate, 0, atol=1e-12)
    tilted = x._replace(att=jf.so3_exp(jnp.array([0.1, 0.0, 0.0])))
    assert multirotors.multirotor_rate(tilted, wrench, *physics).vel[1] < -0.9, "rolled to the right, it goes right"


def test_process_noise_is_white_force_and_torque():
    theta = multirotors.parameters(rotors.firefly(), gust=0.2, shake=0.7)
    theta |= {"mass": math.log(2.0)}
    mass, inertia = 2.0, np.exp(theta["inertia"])
    B = np.zeros((12, 6))
    B[3:6, :3], B[9:, 3:] = np.eye(3) / mass, np.diag(1 / inertia)
    density = np.exp([theta["force"]] * 3 + list(theta["torque"])) ** 2
    for model in (multirotors.multirotor(theta), multirotors.euler_multirotor(theta)):
        Q = model.Q(None, None, 0.03)
        np.testing.assert_allclose(Q, B @ np.diag(density) @ B.T * 0.03, rtol=1e-6)
    assert Q[10, 10] == pytest.approx(0.7**2 * 0.03)


# --- Euler angles ------------------------------------------------------------------------------------------------

POSES = np.random.default_rng(5).uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (20, 3))


def test_euler_angles_are_scipys():
    matrices = Rotation.from_euler("ZYX", POSES[:, ::-1]).as_matrix()
    np.testing.assert_allclose(jax.vmap(multirotors.body_to_world)(POSES), matrices, atol=1e-14)
    still = np.zeros((20, 3))
    bodies = jax.vmap(multirotors.from_euler)(EulerBody(still, still, POSES, still))
    np.testing.assert_allclose(rotation(bodies.att).as_matrix(), matrices, atol=1e-14)
    np.testing.assert_allclose(jax.vmap(multirotors.to_euler)(bodies).rpy, POSES, atol=1e-7)


def test_euler_rates_against_a_small_turn():
    """W by what it means: turn by a little of the body rate, and see how the angles change."""
    rates, step = np.array([0.3, -0.7, 1.1]), 1e-6
    for rpy in POSES[np.abs(POSES[:, 1]) < 1.3]:
        ahead, behind = (
            (Rotation.from_euler("ZYX", rpy[::-1]) * Rotation.from_rotvec(way * step * rates)).as_euler("ZYX")[::-1]
            for way in (1, -1)
        )
        want = (np.unwrap(np.stack([behind, ahead]), axis=0)[1] - behind) / (2 * step)
        x = EulerBody(jnp.zeros(3), jnp.zeros(3), rpy, rates)
        got = multirotors.euler_rate(x, jnp.zeros(4), 1.0, jnp.ones(3), 0.0).rpy
        np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-6)


def test_the_two_forms_fly_the_same_gentle_flight():
    wrenches = MASS * GRAVITY * np.array([1.02, 0, 0, 0]) + 0.002 * np.sin(
        np.arange(200)[:, None] * [0.0, 0.031, 0.047, 0.02]
    )
    start = EulerBody(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.1, -0.05, 0.5]), np.array([0.1, 0.2, -0.3]))

    def euler_flying(x, u):
        return multirotors.euler_rate(x, u, MASS, jnp.asarray(J), DRAG)

    @jax.jit
    def both(x, y):
        f, g = jf.rk4(euler_flying, EULER_BODY), jf.rk4(flying, BODY)

        def body(xy, u):
            xy = f(xy[0], u, 0.01), g(xy[1], u, 0.01)
            return xy, xy

        return jax.lax.scan(body, (x, y), wrenches)[1]

    x, y = both(start, multirotors.from_euler(jax.tree.map(jnp.asarray, start)))
    np.testing.assert_allclose(
        Rotation.from_euler("ZYX", np.asarray(x.rpy)[:, ::-1]).as_matrix(), rotation(y.att).as_matrix(), atol=1e-9
    )
    for a, b in ((x.pos, y.pos), (x.vel, y.vel), (x.rates, y.rates)):
        np.testing.assert_allclose(a, b, atol=1e-9)
    assert np.abs(x.rpy[:, :2]).max() > 0.2, "it should tilt on the way"


def test_euler_angles_are_singular_nose_down_and_quaternions_are_not():
    wrench, turning = jnp.array([7.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0])
    theta = multirotors.HUMMINGBIRD

    def jacobian(x):
        y = quaternion.f(x, wrench, 0.01)
        return jax.jacfwd(lambda d: BODY.minus(quaternion.f(BODY.plus(x, d), wrench, 0.01), y))(jnp.zeros(12))

    euler, quaternion = multirotors.euler_multirotor(theta, jf.euler), multirotors.multirotor(theta)
    step, slopes = jax.jit(lambda x: euler.f(x, wrench, 0.01)), jax.jit(jacobian)
    for short in (1.0, 0.1, 0.08, 1e-4, 0.0, -0.1, -1.0):
        x = EulerBody(jnp.zeros(3), jnp.zeros(3), jnp.array([0.0, math.pi / 2 - short, 0.0]), turning)
        assert np.abs(slopes(multirotors.from_euler(x))).max() < 1.1
        rates = multirotors.euler_rate(x, wrench, 1.0, jnp.ones(3), 0.0)
        assert np.isfinite(np.concatenate([rates.pos, rates.vel, rates.rates])).all()
        if short > 0.09:
            assert float(rates.rpy[2]) == pytest.approx(1 / np.sin(short))
            assert np.isfinite(step(x).rpy).all()
        else:  # near the singularity and beyond: not any angle, but none
            assert np.isnan(step(x).rpy).all()


def test_derivatives_of_euler_angles_stay_finite_nose_down():
    nose_down = RigidBody(jnp.zeros(3), jnp.zeros(3), jf.so3_exp(jnp.array([0.0, math.pi / 2, 0.0])), jnp.zeros(3))
    slopes = jax.jacrev(lambda att: multirotors.to_euler(nose_down._replace(att=att)).rpy)(nose_down.att)
    assert np.isfinite(slopes).all()
    level = RigidBody(jnp.zeros(3), jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    assert np.isfinite(jax.jacrev(lambda att: multirotors.to_euler(level._replace(att=att)).rpy)(level.att)).all()


# --- sensors -----------------------------------------------------------------------------------------------------


def test_ranges_and_bearings():
    pos, point, yaw = np.array([1.0, -2.0]), np.array([-3.0, 1.0]), 2.5
    distance, direction = sensors.range_bearing(jnp.asarray(pos), jnp.asarray(yaw), jnp.asarray(point))
    assert distance == pytest.approx(5.0)
    assert direction == pytest.approx(np.angle(np.exp(1j * (math.atan2(3.0, -4.0) - 2.5))))
    assert sensors.range_to(jnp.asarray(pos), jnp.asarray(point), 0.25) == pytest.approx(5.25)
    for h in (lambda p: sensors.range_bearing(p, jnp.asarray(yaw), point)[0], lambda p: sensors.range_to(p, point)):
        slope = jax.grad(h)(jnp.asarray(pos))
        np.testing.assert_allclose(slope, (pos - point) / 5.0, rtol=1e-12)
        assert np.isfinite(jax.grad(h)(jnp.asarray(point))).all()


def test_a_range_finder_looks_down_its_own_axis():
    for roll, pitch, yaw in [(0.0, 0.0, 1.0), (0.3, -0.5, 2.0), (-0.6, 0.2, -1.0)]:
        att = np.roll(Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat(), 1)
        want = (2.0 - 0.7) / (math.cos(roll) * math.cos(pitch))
        assert sensors.tilt_range(jnp.asarray(2.0), jnp.asarray(att), 0.7) == pytest.approx(want)
    upside_down = jnp.array([0.0, 1.0, 0.0, 0.0])
    assert sensors.tilt_range(jnp.asarray(2.0), upside_down) == pytest.approx(20.0)
    assert np.isfinite(jax.grad(lambda q: sensors.tilt_range(jnp.asarray(2.0), q))(upside_down)).all()


def test_the_sensors_of_a_multirotor():
    x = jax.tree.map(jnp.asarray, SPINNING)
    model = multirotors.multirotor()
    assert list(model.sensors) == ["position", "velocity", "pose", "gyro"]
    for name, want in {"position": x.pos, "velocity": x.vel, "gyro": x.rates}.items():
        np.testing.assert_array_equal(model.sensors[name].h(x, ()), want)
    pos, att = model.sensors["pose"].h(x, ())
    np.testing.assert_array_equal(pos, x.pos)
    np.testing.assert_array_equal(att, x.att)
    stds = {name: np.sqrt(np.diag(sensor.R(x, ()))) for name, sensor in model.sensors.items()}
    np.testing.assert_allclose(stds["position"], [1.0, 1.0, 1.5])
    np.testing.assert_allclose(stds["pose"], [0.005] * 3 + [0.01] * 3)
    in_angles = multirotors.to_euler(x)
    pos, rpy = multirotors.euler_multirotor().sensors["pose"].h(in_angles, ())
    np.testing.assert_array_equal(rpy, in_angles.rpy)
    seam = multirotors.ANGLES.minus(jnp.array([0.0, 0.0, 3.1]), jnp.array([0.0, 0.0, -3.1]))
    np.testing.assert_allclose(seam, [0.0, 0.0, 6.2 - 2 * math.pi], atol=1e-12)


# --- control -----------------------------------------------------------------------------------------------------

STEPS, DT = 1500, 0.01
PATHS = {"hover": hover(STEPS), "circle": circle(STEPS, DT), "eight": figure_eight(STEPS, DT)}


@functools.cache
def flown(name):
    """Distances from the three paths (3, STEPS) that an airframe flies without noise, started 1.2 m off and tilted."""
    airframe = AIRFRAMES[name]
    model = multirotors.multirotor(multirotors.parameters(airframe))
    fly = controller(airframe)

    def one(path):
        off = RigidBody(
            path.pos[0] + jnp.array([0.8, -0.8, 0.4]),
            jnp.zeros(3),
            jf.so3_exp(jnp.array([0.3, -0.3, 0.5])),
            jnp.array([0.5, -0.5, 0.5]),
        )

        def body(x, reference):
            x_next = model.f(x, fly(x, reference), DT)
            return x_next, (x.pos, jnp.sum(jnp.abs(x.rates)))

        return jax.lax.scan(body, off, path)[1]

    paths = jax.tree.map(lambda *leaves: jnp.stack(leaves), *PATHS.values())
    pos, spin = jax.jit(jax.vmap(one))(paths)
    return np.linalg.norm(pos - paths.pos, axis=-1), np.asarray(spin)


@pytest.mark.parametrize("name", AIRFRAMES)
def test_the_controller_flies(name):
    """From an offset to within a millimetre of hover, and along circle and eight within 15 cm: lag and drag."""
    (hovering, circling, eight), spin = flown(name)
    assert hovering[0] > 1
    assert hovering[800:].max() < 1e-3
    assert spin[0, 800:].max() < 1e-3
    assert circling[400:].max() < 0.15
    assert eight[400:].max() < 0.15


def test_paths_are_their_own_derivatives():
    for path in (circle(400, 0.01), figure_eight(400, 0.01)):
        np.testing.assert_allclose(np.gradient(path.pos, 0.01, axis=0)[1:-1], path.vel[1:-1], atol=1e-3)
        np.testing.assert_allclose(np.gradient(path.vel, 0.01, axis=0)[1:-1], path.acc[1:-1], atol=1e-3)


def test_thrusts_are_those_that_rotors_have():
    airframe = AIRFRAMES["hummingbird"]
    far = jax.tree.map(lambda a: jnp.asarray(a[0]), hover(1, point=(0.0, 0.0, 1000.0)))
    x = RigidBody(jnp.zeros(3), jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    wrench = controller(airframe)(x, far)
    assert wrench[0] == pytest.approx(4 * airframe.max_thrust)
    beside = jax.tree.map(lambda a: jnp.asarray(a[0]), hover(1, point=(1000.0, 0.0, 0.0)))
    thrusts = rotors.mixer(airframe.rotors) @ controller(airframe)(x, beside)
    assert thrusts.min() >= -1e-9
    assert thrusts.max() <= airframe.max_thrust + 1e-9
    assert thrusts[2] > thrusts[0], "nose down to go forward"


# --- filters -----------------------------------------------------------------------------------------------------

LEVEL = RigidBody(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))


def cast(tree, dtype):
    """Every floating leaf in this dtype."""
    return jax.tree.map(lambda a: jnp.asarray(a, dtype if np.asarray(a).dtype.kind == "f" else None), tree)


@pytest.mark.long
@pytest.mark.parametrize(("make", "dtype"), [(jf.ekf, jnp.float32), (jf.ukf, jnp.float64)], ids=["ekf", "ukf"])
def test_gradients_at_zero_angle_are_finite(make, dtype):
    """Hovering level with zero innovation: every square root and quotient of the attitude at its worst."""
    theta, x = cast(multirotors.HUMMINGBIRD, dtype), cast(LEVEL, dtype)
    u = jnp.asarray([0.716 * GRAVITY, 0.0, 0.0, 0.0], dtype)

    def cost(theta, z):
        filt = make(multirotors.multirotor(theta))
        belief = filt.predict(jf.Gaussian(x, multirotors.multirotor_start(theta).cov), u, 0.01)
        if make is jf.ekf:  # the UKF's update takes as long to compile again and passes the same attitudes
            belief, _ = filt.update(belief, z, "pose")
        return belief.cov.sum() + filt.model.space.minus(belief.mean, x).sum()

    slopes = jax.jit(jax.grad(cost, argnums=(0, 1)))(theta, (x.pos, x.att))
    for leaf in jax.tree.leaves(slopes):
        assert leaf.dtype == dtype
        assert np.isfinite(leaf).all()
    assert slopes[0]["start"][2] > 0, "the less is known of the attitude at the start, the less after"
    assert slopes[0]["mass"] < -0.01, "the heavier, the less it climbs"


@pytest.mark.parametrize("name", ["scenario", "harsh_scenario", "euler_scenario"])
def test_scenarios_fly_their_path_in_float32(name):
    scenario = getattr(multirotors, name)()
    theta = cast(scenario.theta, jnp.float32)
    model, belief = scenario.model(theta), scenario.belief(theta)
    log = cast(scenario.schedule(1200), jnp.float32)
    truth, flown_log = jax.jit(lambda key: jf.simulate(model, belief, log, key, scenario.control))(jax.random.key(4))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves((truth, flown_log.u, flown_log.z)))
    assert flown_log.u.shape == (1200, 4)
    away = np.linalg.norm(truth.pos[:-1] - log.u.pos[1:], axis=1)
    assert away[400:].max() < (1.2 if name == "harsh_scenario" else 0.5)
    indices = sorted(i for block, _ in scenario.blocks.values() for i in block)
    assert indices == list(range(model.space.dim))
