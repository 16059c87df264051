"""Sensors against SciPy's rotations and plain NumPy, their derivatives, their limits, and what they tell a filter."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from model_checks import assert_derivatives
from scipy.interpolate import CubicHermiteSpline, RegularGridInterpolator
from scipy.spatial.transform import Rotation

import jaxfilt as jf
from jaxfilt.models import sensors as s
from jaxfilt.models.inertial import Imu, Navigation, strapdown
from jaxfilt.models.multirotor import RigidBody
from jaxfilt.models.tracking import Target

RNG = np.random.default_rng(0)


def quaternion(rotation):
    return jnp.asarray(rotation.as_quat(scalar_first=True))


def poses(n):
    """(pos, attitude for SciPy, attitude for jaxfilt, vel, rates) at random."""
    rotations = Rotation.random(n, random_state=1)
    return [(RNG.normal(size=3), r, quaternion(r), *RNG.normal(size=(2, 3))) for r in rotations]


POSES = poses(5)
ARM = np.array([0.3, -0.2, 0.5])


def body(pos, att, vel=np.zeros(3), rates=np.zeros(3)):
    return RigidBody(jnp.asarray(pos, float), jnp.asarray(vel, float), att, jnp.asarray(rates, float))


# --- positioning -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("pos", "R", "att", "vel", "rates"), POSES)
def test_a_point_of_the_body_moves_with_it(pos, R, att, vel, rates):
    np.testing.assert_allclose(s.antenna_position(pos, att, ARM), pos + R.apply(ARM), atol=1e-12)
    h = 1e-5
    ahead, before = (R * Rotation.from_rotvec(sign * h * np.asarray(rates)) for sign in (1, -1))
    expected = vel + (ahead.apply(ARM) - before.apply(ARM)) / (2 * h)
    np.testing.assert_allclose(s.antenna_velocity(vel, att, rates, ARM), expected, atol=1e-8)
    mount = Rotation.from_euler("xyz", [0.1, 0.2, -0.7])
    place, turned = s.marker_pose(pos, att, ARM, quaternion(mount))
    np.testing.assert_allclose(place, pos + R.apply(ARM), atol=1e-12)
    seen = Rotation.from_quat(np.asarray(turned), scalar_first=True)
    np.testing.assert_allclose((seen.inv() * R * mount).magnitude(), 0.0, atol=1e-7)


def test_pressure_is_that_of_the_standard_atmosphere():
    """Geopotential heights and pressures of the tables of the U.S. Standard Atmosphere (1976)."""
    heights, pressures = np.array([0.0, 1000.0, 5000.0, 11000.0]), np.array([101325.0, 89874.6, 54019.9, 22632.1])
    np.testing.assert_allclose(s.pressure_height(pressures), heights, atol=0.5)
    np.testing.assert_allclose(np.diff(s.pressure_height(np.array([101325.0, 101225.0]))), 8.3, atol=0.05)


@pytest.mark.parametrize("option", [ARM, lambda x: ARM, tuple(ARM.tolist())], ids=["array", "of the state", "tuple"])
def test_sensors_of_a_body(option):
    pos, R, att, vel, rates = POSES[0]
    x, I3 = body(pos, att, vel, rates), jnp.eye(3)
    arm = np.asarray(ARM)
    place, speed = pos + R.apply(arm), vel + R.apply(np.cross(rates, arm))
    np.testing.assert_allclose(s.gnss_position(I3, arm=option).h(x, ()), place, atol=1e-12)
    np.testing.assert_allclose(s.gnss_velocity(I3, arm=option).h(x, ()), speed, atol=1e-12)
    np.testing.assert_allclose(s.mocap_pose(jnp.eye(6), arm=option).h(x, ())[0], place, atol=1e-12)
    np.testing.assert_allclose(s.beacon(I3[:1, :1], arm=option).h(x, place), 0.0, atol=1e-12)
    np.testing.assert_allclose(s.no_slip(I3, arm=option).h(x, ()), R.inv().apply(speed), atol=1e-12)
    np.testing.assert_array_equal(s.gnss_position(I3).h(x, ()), pos)
    np.testing.assert_array_equal(s.gnss_velocity(I3).h(x, ()), vel)
    np.testing.assert_array_equal(s.mocap_pose(jnp.eye(6)).h(x, ())[1], att)


def test_a_barometer_drifts_with_the_state_that_it_is_given():
    x = Navigation(*jnp.eye(3)[:2] * 7.0, POSES[0][2], *jnp.zeros((2, 3)), {"drift": jnp.asarray(2.0)})
    x = x._replace(pos=jnp.array([1.0, 2.0, 3.0]))
    assert s.barometer(jnp.eye(1)).h(x, ()) == 3.0
    assert s.barometer(jnp.eye(1), drift=lambda x: x.extra["drift"]).h(x, ()) == 5.0


def test_a_late_sensor_tells_of_the_past():
    x = Target(jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, -2.0, 0.5]))
    np.testing.assert_allclose(s.late(s.gnss_position(jnp.eye(3)), 0.2).h(x, ()), [0.8, 2.4, 2.9])
    # an inertial state is led back by the IMU, here through a turn: SciPy's helix of the antenna
    rates, lateness = np.array([0.0, 0.0, 1.5]), 0.3
    nav = Navigation(*jnp.zeros((2, 3)), POSES[1][2], *jnp.zeros((2, 3)))
    R = POSES[1][1]
    imu = Imu(jnp.asarray(rates), jnp.asarray(R.inv().apply([0, 0, 9.81])))
    gnss = s.late(s.gnss_position(jnp.eye(3), arm=ARM), lateness, lambda x, u, dt: (strapdown(x, u, dt), u))
    past = (R * Rotation.from_rotvec(-lateness * rates)).apply(np.asarray(ARM))
    np.testing.assert_allclose(gnss.h(nav, imu) - strapdown(nav, imu, -lateness).pos, past, atol=1e-12)
    # the slope by the lateness is the velocity, so that it can be tuned
    slope = jax.jacrev(lambda t: s.late(s.gnss_position(jnp.eye(3)), t).h(x, ()))(0.1)
    np.testing.assert_allclose(slope, -x.vel)


# --- direction ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("pos", "R", "att", "vel", "rates"), POSES)
def test_fields_are_turned_into_the_body(pos, R, att, vel, rates):
    field = s.earth_field(0.1, 1.1, 48.0)
    np.testing.assert_allclose(s.body_field(att, field, ARM), R.inv().apply(field) + ARM, atol=1e-12)
    force = R.inv().apply(np.asarray(vel) + [0.0, 0.0, 9.81]) + ARM
    np.testing.assert_allclose(s.specific_force(att, vel, ARM), force, atol=1e-12)
    yaw = R.as_euler("ZYX")[0]
    np.testing.assert_allclose(np.exp(1j * float(s.yaw_of(att))), np.exp(1j * yaw), atol=1e-12)
    x = body(pos, att, vel, rates)
    np.testing.assert_allclose(s.magnetometer(jnp.eye(3), field, ARM).h(x, ()), R.inv().apply(field) + ARM, atol=1e-12)
    np.testing.assert_allclose(s.accelerometer(jnp.eye(3), ARM, lambda x: x.vel).h(x, ()), force, atol=1e-12)
    assert s.compass(jnp.eye(1)).h(x, ()) == s.yaw_of(att)
    np.testing.assert_allclose(s.gyroscope(jnp.eye(3), ARM).h(x, ()), rates + ARM)


def test_the_earths_field_has_its_strength_its_dip_and_its_declination():
    east, north, up = s.earth_field(0.2, 1.1, 48.0)
    np.testing.assert_allclose(np.linalg.norm([east, north, up]), 48.0)
    np.testing.assert_allclose([np.arctan2(east, north), np.arctan2(-up, np.hypot(east, north))], [0.2, 1.1])


@pytest.mark.parametrize("declination", [0.0, 0.2])
def test_a_compass_turned_to_magnetic_north_reads_zero(declination):
    """The yaw at which the level part of the field lies ahead is that of the reading 0; to the right it grows."""
    east, north, _ = s.earth_field(declination, 1.1)
    np.testing.assert_allclose(s.compass_yaw(0.0, declination), np.arctan2(north, east))
    assert s.compass_yaw(0.1, declination) < s.compass_yaw(0.0, declination)


def test_straight_up_a_heading_is_zero_with_finite_slopes():
    up = quaternion(Rotation.from_euler("y", -90, degrees=True))
    slopes = jax.jit(jax.jacrev(lambda d: s.yaw_of(jf.so3.plus(up, d))))(jnp.zeros(3))
    assert np.isfinite(slopes).all()


# --- ranging -----------------------------------------------------------------------------------------------------


def test_ranges_by_pythagoras():
    p, q = RNG.normal(size=(2, 3))
    np.testing.assert_allclose(s.range_to(jnp.asarray(p), jnp.asarray(q), 0.5), np.sqrt(((p - q) ** 2).sum()) + 0.5)
    x = body(p, POSES[0][2])
    biased = s.beacon(jnp.eye(1), point=q, bias=lambda x: x.vel[0] + 0.5)
    np.testing.assert_allclose(biased.h(x, ()), np.sqrt(((p - q) ** 2).sum()) + 0.5)
    assert jax.grad(lambda p: s.range_to(p, jnp.asarray(q)))(jnp.asarray(q)).tolist() == [0.0, 0.0, 0.0]


def test_a_landmark_has_range_and_bearing():
    class Robot(Target):
        yaw = jnp.asarray(2.0)

    distance, direction = s.landmark(jnp.eye(2)).h(Robot(jnp.array([1.0, 1.0]), ()), jnp.array([-2.0, 5.0]))
    expected = -3.0 + 4.0j
    np.testing.assert_allclose([distance, direction], [abs(expected), np.angle(expected) - 2.0])


def test_pseudoranges_against_their_definition():
    sats = 2e7 * np.array([[0.1, 0.5, 0.8], [-0.9, 0.2, 0.3]]) + 1.0
    p, v, sv = np.array([120.0, -300.0, 45.0]), np.array([10.0, 3.0, -1.0]), np.array([1000.0, -2500.0, 800.0])
    for sat in sats:
        direct = np.linalg.norm(sat - p) - np.linalg.norm(sat) + 12.0
        np.testing.assert_allclose(s.pseudorange(*map(jnp.asarray, (p, sat)), 12.0), direct, atol=1e-6)
        f32 = s.pseudorange(*(jnp.asarray(a, jnp.float32) for a in (p, sat)), 12.0)
        np.testing.assert_allclose(f32, direct, atol=1e-3)  # where |s - p| itself is good to 2 m
        ahead, before = (np.linalg.norm(sat + h * sv - p - h * v) for h in (0.5, -0.5))
        rate = s.pseudorange_rate(*map(jnp.asarray, (p, v, sat, sv)), 0.7)
        np.testing.assert_allclose(rate, ahead - before + 0.7, atol=1e-4)
    assert s.satellite(jnp.eye(1), 5.0).h(body(np.zeros(3), POSES[0][2]), jnp.asarray(sats[0])) == 5.0


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.3, -0.2)])
def test_a_tilted_beam_meets_a_plain(slope):
    """The line from the drone along -z of its body, cut with the plane by hand."""
    a, b = slope
    ground = lambda p: a * p[0] + b * p[1] + 0.5  # noqa: E731
    for angles in ([0.0, 0.0], [20.0, -15.0], [-25.0, 10.0]):
        R = Rotation.from_euler("xy", angles, degrees=True)
        pos, down = np.array([3.0, -2.0, 9.0]), -R.apply([0, 0, 1])
        exact = (ground(pos) - pos[2]) / (down[2] - a * down[0] - b * down[1])
        got = s.terrain_range(jnp.asarray(pos), quaternion(R), ground, rounds=12)
        np.testing.assert_allclose(got, exact, rtol=1e-6)
        few = s.range_finder(jnp.eye(1), ground).h(body(pos, quaternion(R)), ())
        np.testing.assert_allclose(few, exact, rtol=2e-2)
        if slope == (0.0, 0.0):
            np.testing.assert_allclose(s.tilt_range(jnp.asarray(9.0), quaternion(R), 0.5), exact, rtol=1e-12)


def test_upside_down_a_range_is_finite():
    over = quaternion(Rotation.from_euler("x", 180, degrees=True))
    assert s.tilt_range(jnp.asarray(2.0), over) == pytest.approx(2.0 / s.STEEPEST)
    slopes = jax.jit(jax.jacrev(lambda d: s.tilt_range(jnp.asarray(2.0), jf.so3.plus(over, d))))(jnp.zeros(3))
    assert np.isfinite(slopes).all()


GRID, ORIGIN, SPACING = RNG.normal(size=(5, 7)), (10.0, -4.0), 2.5


def nodes():
    return tuple(o + SPACING * np.arange(n) for o, n in zip(ORIGIN, GRID.shape, strict=True))


def test_a_bilinear_map_is_scipys():
    ground = s.height_map(GRID, ORIGIN, SPACING, smooth=False)
    inside = RNG.uniform([n[0] for n in nodes()], [n[-1] for n in nodes()], (50, 2))
    expected = RegularGridInterpolator(nodes(), GRID)(inside)
    np.testing.assert_allclose(jax.jit(jax.vmap(ground))(jnp.asarray(inside)), expected, atol=1e-12)


def test_a_smooth_map_is_hermites_along_each_axis():
    """Cubic Hermite splines with the central differences of the neighbours as slopes, by SciPy, the edge repeated."""
    ground = jax.jit(s.height_map(GRID, ORIGIN, SPACING))
    wide = np.pad(GRID, 3, mode="edge")
    knots = [SPACING * np.arange(-2, n + 2) for n in GRID.shape]

    def along(values, k):
        return CubicHermiteSpline(knots[k], values[1:-1], (values[2:] - values[:-2]) / (2 * SPACING))

    for place in RNG.uniform(-SPACING, [SPACING * n for n in GRID.shape], (30, 2)):
        rows = np.array([along(row, 1)(place[1]) for row in wide])
        got = ground(jnp.asarray(place + ORIGIN))
        np.testing.assert_allclose(got, along(rows, 0)(place[0]), atol=1e-12)


@pytest.mark.parametrize("smooth", [True, False])
def test_a_map_goes_through_its_nodes_and_is_flat_beyond(smooth):
    ground = jax.jit(s.height_map(GRID, ORIGIN, SPACING, smooth))
    places = jnp.stack(jnp.meshgrid(*map(jnp.asarray, nodes()), indexing="ij"), axis=-1)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.vmap(ground)))(places), GRID, atol=1e-12)
    far = jnp.array([-1e3, 1e3])
    np.testing.assert_allclose(ground(far), GRID[0, -1], atol=1e-12)
    np.testing.assert_array_equal(jax.grad(ground)(far), [0.0, 0.0])


def test_a_smooth_map_has_slopes_without_steps():
    """Along a line across nodes, cells and the edge: the slope changes by no more than the curvature allows."""
    ground = s.height_map(GRID, ORIGIN, SPACING)
    t = np.linspace(-12.0, 30.0, 4201)
    line = jnp.asarray(np.stack([t + 0.3, 0.9 * t - 3.0], axis=1))
    slopes = jax.jit(jax.vmap(jax.grad(ground)))(line)
    assert np.abs(np.diff(slopes, axis=0)).max() < 0.05
    rough = jax.jit(jax.vmap(jax.grad(s.height_map(GRID, ORIGIN, SPACING, smooth=False))))(line)
    assert np.abs(np.diff(rough, axis=0)).max() > 0.5
    assert_derivatives(ground, line[1234], line[2000], line[3000])


def test_a_map_must_have_two_axes():
    with pytest.raises(ValueError, match=r"height_map\(grid\): expected shape \(n, m\), got \(3,\)"):
        s.height_map(np.zeros(3))


# --- vision ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("pos", "R", "att", "vel", "rates"), POSES)
def test_flow_is_how_the_ground_moves_in_the_picture(pos, R, att, vel, rates):
    """A point of the ground on the optical axis, in the body's frame a moment before and after, by SciPy."""
    distance, h = 2.5, 1e-5
    point = pos + R.apply([0, 0, -distance])
    picture = []
    for sign in (1, -1):
        turned = R * Rotation.from_rotvec(sign * h * np.asarray(rates))
        own = turned.inv().apply(point - (pos + sign * h * vel))
        picture.append(own[:2] / -own[2])
    flow = s.ground_flow(vel, att, rates, jnp.asarray(distance))
    np.testing.assert_allclose(flow, (picture[0] - picture[1]) / (2 * h), atol=1e-8)
    rotation = np.array([rates[1], -rates[0]])
    np.testing.assert_allclose((rotation - flow) * distance, R.inv().apply(vel)[:2], atol=1e-12)


def test_flow_needs_the_range():
    sensor = s.optical_flow(jnp.eye(2))
    level = jnp.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(sensor.h(body([0, 0, 2.0], level, [1, 0, 0]), ()), [-0.5, 0.0])
    np.testing.assert_allclose(sensor.h(body([0, 0, 4.0], level, [1, 0, 0], [0.3, 0.2, 9.0]), ()), [-0.05, -0.3])
    assert np.isfinite(sensor.h(body([0, 0, 0.0], level, [1, 0, 0]), ())).all()


@pytest.mark.parametrize(
    ("mount", "axes"),
    [
        (s.FORWARD_CAMERA, [[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        (s.DOWNWARD_CAMERA, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]),
    ],
    ids=["forward", "downward"],
)
def test_where_a_camera_sees_a_point(mount, axes):
    """The camera's axes (right, down, out) in the body: its rows; the pinhole by NumPy."""
    for pos, R, att, *_ in POSES:
        own = np.array([0.2, 0.1, -0.3]) + np.array([1.0, 0.5, 4.0]) @ np.array(axes)
        point = pos + R.apply(own)
        args = (pos, att, jnp.asarray(point), jnp.asarray(mount), jnp.asarray([0.2, 0.1, -0.3]))
        np.testing.assert_allclose(s.in_camera(*args), [1.0, 0.5, 4.0], atol=1e-12)
        np.testing.assert_allclose(s.image_point(*args), [0.25, 0.125], atol=1e-12)
        np.testing.assert_allclose(s.direction_to(*args), np.array([1.0, 0.5, 4.0]) / np.sqrt(17.25), atol=1e-12)
        sensor = s.camera(jnp.eye(2), mount, arm=(0.2, 0.1, -0.3))
        np.testing.assert_allclose(sensor.h(body(pos, att), args[2]), [0.25, 0.125], atol=1e-12)


def test_at_the_camera_itself_all_is_finite():
    zero, level = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0])
    for see in (s.image_point, s.direction_to):
        jacobian = jax.jacrev(lambda p, see=see: see(p, level, zero, jnp.asarray(s.FORWARD_CAMERA)))
        assert np.isfinite(jacobian(zero)).all()


@pytest.mark.parametrize("rates", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.6)])
def test_relative_poses_compose_to_the_pose(rates):
    """A loop of steps, each told by odometry, ends where SciPy's product of the same steps ends."""
    steps = [(Rotation.from_rotvec(k * np.roll(rates, k)), np.array([1.0, 0.1 * k, -0.2])) for k in range(4)]
    R, p = Rotation.identity(), np.zeros(3)
    for turn, move in steps:
        before = R, p
        R, p = R * turn, p + R.apply(move)
        moved, turned = s.relative_pose(jnp.asarray(p), quaternion(R), jnp.asarray(before[1]), quaternion(before[0]))
        np.testing.assert_allclose(moved, move, atol=1e-12)
        np.testing.assert_allclose(
            (Rotation.from_quat(turned, scalar_first=True).inv() * turn).magnitude(), 0, atol=1e-7
        )


class Drifting(NamedTuple):
    """A pose whose odometry we wait for."""

    pos: Any
    att: Any


def drifting():
    """A pose that wanders, 1 m and 0.1 rad in a second, with a key frame beside it."""
    Q = jf.diagonal(*3 * (1.0,), *3 * (0.1,))
    model = jf.Model(lambda x, u, dt: x, jf.white(Q), jf.product(Drifting(jf.vector(3), jf.so3)), {})
    return s.with_key_frame(model, {"odometry": 1e-6 * jnp.eye(6)})


def test_a_key_frame_copies_the_pose_and_its_correlations():
    """Right after a key frame the copy's covariance is that of the pose, and fully correlated with it."""
    A = RNG.normal(size=(12, 12))
    now = Drifting(jnp.array([1.0, 2.0, 3.0]), POSES[0][2])
    belief = jf.Gaussian(s.Keyed(now, jnp.zeros(3), POSES[1][2]), jnp.asarray(1e-2 * A @ A.T))
    predict = jax.jit(lambda flag: jf.ekf(drifting()).predict(belief, s.Marked((), flag), 1e-9))
    keyed, kept = predict(1.0), predict(0.0)
    own, copy = belief.cov, keyed.cov
    np.testing.assert_array_equal(keyed.mean.pos, now.pos)
    np.testing.assert_allclose(keyed.mean.att, now.att, atol=1e-12)
    for rows, columns in ((slice(0, 6), slice(6, 12)), (slice(6, 12), slice(6, 12)), (slice(0, 6), slice(0, 6))):
        np.testing.assert_allclose(copy[rows, columns], own[:6, :6], atol=1e-8)
    np.testing.assert_allclose(kept.cov, own, atol=1e-8)
    np.testing.assert_array_equal(kept.mean.pos, belief.mean.pos)


def test_odometry_from_a_key_frame_bounds_the_drift_since_and_no_more():
    """Telling of where one is since the key frame, it leaves the uncertainty of the key frame itself alone."""
    level = jnp.array([1.0, 0.0, 0.0, 0.0])
    start = jf.Gaussian(
        s.Keyed(Drifting(jnp.zeros(3), level), jnp.zeros(3), level), jf.diagonal(2.0 * jnp.ones(12)) / 16
    )
    log = jf.schedule(drifting(), 20, 0.1, u=s.Marked((), np.eye(20)[0]))
    cov = np.asarray(jax.jit(lambda log: jf.scan(jf.ekf(drifting()), start, log).belief.cov[-1])(log))
    np.testing.assert_allclose(np.sqrt(np.diag(cov))[:3], 0.5, rtol=0.01)
    since = cov[:3, :3] + cov[6:9, 6:9] - cov[:3, 6:9] - cov[6:9, :3]
    assert np.sqrt(np.diag(since)).max() < 0.01  # without odometry: 1.4 m in 2 s


# --- wheels ------------------------------------------------------------------------------------------------------


def test_wheels_of_a_differential_drive():
    """Each wheel rolls as fast as its place on the axle moves: velocity plus rate cross arm, by NumPy."""
    v, w, radius, track = 1.3, 0.7, 0.2, 0.6
    along = [(np.array([v, 0, 0]) + np.cross([0, 0, w], [0, y, 0]))[0] / radius for y in (track / 2, -track / 2)]
    np.testing.assert_allclose(s.wheel_speeds(jnp.asarray(v), jnp.asarray(w), radius, track), along)

    class Robot(Target):
        speed, rate = jnp.asarray(v), jnp.asarray(w)

    np.testing.assert_allclose(s.wheel_encoders(jnp.eye(2), radius, track).h(Robot((), ()), ()), along)


def test_a_steered_wheel_points_along_the_circle():
    """The front wheel's place moves the way it is steered: rate times wheel base over speed is tan(steering)."""
    rate = float(s.ackermann_rate(jnp.asarray(3.0), jnp.asarray(0.4), 2.7))
    np.testing.assert_allclose(np.arctan2(rate * 2.7, 3.0), 0.4)


# --- derivatives -------------------------------------------------------------------------------------------------


def test_derivatives():
    pos, _, att, vel, rates = POSES[2]
    mount = jnp.asarray(s.DOWNWARD_CAMERA)
    upright = quaternion(Rotation.from_euler("xyz", [0.2, -0.3, 1.0]))
    near = body([0.3, 0.1, 3.0], upright, vel, rates)
    assert_derivatives(lambda p: s.antenna_velocity(p[0], jf.so3.plus(att, p[1]), rates, p[2]), (vel, np.zeros(3), ARM))
    assert_derivatives(lambda d: s.yaw_of(jf.so3.plus(upright, d)), jnp.zeros(3))
    hill = s.range_finder(jnp.eye(1), lambda p: 0.1 * p[0] * p[1])

    def all_at_once(x):
        return (
            hill.h(x, ()),
            s.optical_flow(jnp.eye(2)).h(x, ()),
            s.image_point(x.pos, x.att, jnp.zeros(3), mount),
            s.direction_to(x.pos, x.att, jnp.zeros(3), mount),
            s.relative_pose(x.pos, x.att, pos, att),
            s.body_field(x.att, pos) + s.specific_force(x.att),
        )

    assert_derivatives(all_at_once, near)
    assert_derivatives(lambda p: s.pseudorange(p[0], jnp.array([2e4, 1e4, 1e4]), p[1]), (pos, jnp.asarray(0.3)))


# --- data sheets -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", s.DATA_SHEETS)
def test_a_data_sheet_is_a_covariance_with_its_units(name):
    sheet = s.DATA_SHEETS[name]
    np.testing.assert_allclose(sheet.R(), np.diag(np.square(sheet.std)))
    np.testing.assert_allclose(sheet.R(3.0), 9 * np.diag(np.square(sheet.std)))
    assert min(sheet.std) > 0
    assert 1 <= sheet.rate <= 1000
    assert sheet.source
    # the order of magnitude, by unit: what anyone would expect of a robot's sensor
    bounds = {
        "m": (1e-3, 5),
        "m/s": (0.01, 0.5),
        "rad": (1e-3, 0.1),
        "T": (1e-8, 5e-6),
        "rad/s": (1e-3, 1),
        "": (1e-4, 0.1),
    }
    low, high = bounds[sheet.unit.split(", ")[0]]
    assert low <= sheet.std[0] <= high


def test_of_two_data_sheets_the_better_is_better():
    order = [s.RTK, s.UWB, s.GNSS_CONSUMER]
    stds = [sheet.std[0] for sheet in order]
    assert stds == sorted(stds)


# --- each sensor simulates what it filters -----------------------------------------------------------------------


class Everything(NamedTuple):
    """A body with all that sensors of a body may want."""

    pos: Any
    vel: Any
    att: Any
    rates: Any
    extra: Any


SPACE = jf.product(Everything(*map(jf.vector, (3, 3)), jf.so3, jf.vector(3), jf.vector(3)))
TURN = quaternion(Rotation.from_rotvec([0.1, 0.2, 0.3]))
FIELD = s.earth_field(0.05, 1.1, 48e-6)
SAT = np.array([1e7, 5e6, 1.5e7])
SENSORS = {
    "gnss": (s.gnss_position(s.GNSS_CONSUMER.R(), arm=ARM), ()),
    "rtk": (s.gnss_position(s.RTK.R(), arm=lambda x: ARM + x.extra), ()),
    "late gnss": (s.late(s.gnss_position(s.RTK.R(), arm=ARM), 0.1), ()),
    "gnss velocity": (s.gnss_velocity(s.GNSS_VELOCITY.R(), arm=ARM), ()),
    "mocap": (s.mocap_pose(s.MOCAP.R(), ARM, TURN), ()),
    "barometer": (s.barometer(s.BAROMETER.R(), lambda x: x.extra[0]), ()),
    "magnetometer": (s.magnetometer(s.MAGNETOMETER.R(), FIELD, lambda x: 1e-5 * x.extra), ()),
    "accelerometer": (s.accelerometer(0.01 * jnp.eye(3), lambda x: x.extra), ()),
    "compass": (s.compass(s.COMPASS.R()), ()),
    "gyroscope": (s.gyroscope(1e-4 * jnp.eye(3), lambda x: x.extra), ()),
    "range finder": (s.range_finder(s.TFMINI.R(), s.height_map(0.2 * GRID, (-8.0, -8.0), SPACING), ARM), ()),
    "flat range": (s.range_finder(s.VL53L1X.R()), ()),
    "beacon": (s.beacon(s.UWB.R(), (5.0, 3.0, 1.0), lambda x: x.extra[1], ARM), ()),
    "satellite": (s.satellite(jnp.eye(1), lambda x: 10 * x.extra[2]), SAT),
    "optical flow": (s.optical_flow(s.OPTICAL_FLOW.R()), ()),
    "camera": (s.camera(s.CAMERA.R(), s.DOWNWARD_CAMERA), np.array([0.5, -0.5, 0.0])),
    "no slip": (s.no_slip(0.01 * jnp.eye(3), ARM), ()),
    "wheels": (s.wheel_encoders(s.WHEEL_ENCODERS.R(), 0.2, 0.6, lambda x: x.vel[0], lambda x: x.rates[2]), ()),
}
RUNS = 4000


@pytest.mark.parametrize("name", SENSORS)
def test_a_filter_believes_what_a_sensor_simulates(name):
    """A truth drawn from the belief, a reading of it, an update: NIS is chi-square, and not if R is nine times less."""
    sensor, c = SENSORS[name]
    level = quaternion(Rotation.from_rotvec([0.05, -0.08, 0.4]))
    mean = Everything(jnp.array([0.0, 0.0, 4.0]), jnp.array([0.5, 0.2, 0.0]), level, jnp.ones(3) / 5, jnp.zeros(3))
    std = np.repeat([0.01, 0.01, 0.004, 0.01, 0.01], 3)
    belief = jf.Gaussian(mean, jnp.diag(jnp.asarray(std) ** 2))
    sure = sensor._replace(R=lambda x, c: sensor.R(x, c) / 9)
    filt = jf.ekf(jf.Model(lambda x, u, dt: x, jf.const(jnp.eye(15)), SPACE, {"right": sensor, "wrong": sure}))

    @jax.jit
    @jax.vmap
    def nis(key):
        of_state, of_noise = jax.random.split(key)
        x = jf.sample(belief, SPACE, of_state)
        z = jf.sample(jf.Gaussian(sensor.h(x, c), sensor.R(x, c)), sensor.space, of_noise)
        return [filt.update(belief, z, kind, c)[1].nis for kind in ("right", "wrong")]

    dof = sensor.space.dim
    right, wrong = nis(jax.random.split(jax.random.key(3), RUNS))
    assert scipy.stats.kstest(right, scipy.stats.chi2(dof).cdf).pvalue > 1e-3
    assert scipy.stats.kstest(wrong, scipy.stats.chi2(dof).cdf).pvalue < 1e-6
