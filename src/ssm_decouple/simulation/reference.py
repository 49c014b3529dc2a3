"""Targets that move: functions of time that `simulate` follows."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import DOP853
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from ssm_decouple.errors import InputError, as_floats, as_number, as_triple, shown
from ssm_decouple.model.payload import possible_inertia
from ssm_decouple.model.robot import rigid_pose
from ssm_decouple.settled import Settled, fixed_array

Floats = NDArray[np.float64]

MOST_STEPS = 10**5  # of a tumble's integration, each kept: some 1,600 turns
_STEPS_A_TURN = 60  # at least, of the tumble's integration: keeps its interpolation as accurate as its steps


class Waypoints(Settled):
    """A smooth path through points or poses at given times, at rest at both ends.

    Positions follow a cubic spline: velocity and acceleration are continuous between the first and the last time, the
    velocity is zero at both. Rotations follow SciPy's RotationSpline, likewise, its time slowed to rest within the
    first and the last interval. Before the first time and after the last the path stays where it is.

    Args:
        times: When each is reached (m,), s, rising; two at least.
        waypoints: Points (m, 3), m, inertial axes; or m poses, each a `pin.SE3` or a homogeneous matrix (4, 4).
            Between poses the shorter turn is taken.

    Attributes:
        times: As given (m,).
        positions: (m, 3), m.
        rotations: (m, 3, 3), or None where points were given.

    Raises:
        InputError: times that do not rise, fewer than two, a number that is not finite, or no rigid pose.
    """

    def __init__(self, times: ArrayLike, waypoints: ArrayLike | Sequence[pin.SE3]) -> None:
        self.times: Floats = fixed_array(_rising("waypoint times", times))
        positions, rotations = _places(waypoints, self.times.size)
        self.positions: Floats = fixed_array(positions)
        self.rotations: Floats | None = None if rotations is None else fixed_array(rotations)
        self._path = CubicSpline(self.times, self.positions, bc_type="clamped")
        self._velocity = self._path.derivative()
        self._turn: RotationSpline | None = None
        if self.rotations is not None:
            self._turn = RotationSpline(self.times, Rotation.from_matrix(self.rotations))

    def __call__(self, time: float) -> tuple[Floats, Floats]:
        """Return position (3,), m, and velocity (3,), m/s, inertial axes."""
        at, moves = self._within(time)
        return self._path(at), self._velocity(at) if moves else np.zeros(3)

    def pose(self, time: float) -> pin.SE3:
        """Return the pose in the inertial frame.

        Raises:
            InputError: points were given, which have no attitude.
        """
        at, _ = self._within(time)
        warped, _ = self._warped(at)
        return pin.SE3(self._rotation_spline()(warped).as_matrix(), self._path(at))

    def twist(self, time: float) -> Floats:
        """Return velocity and angular velocity (6,): [linear; angular], m/s and rad/s, inertial axes.

        Raises:
            InputError: points were given, which have no attitude.
        """
        spline, (at, moves) = self._rotation_spline(), self._within(time)
        warped, pace = self._warped(at)
        body = spline(warped, 1) * pace if moves else np.zeros(3)
        return np.r_[self(time)[1], spline(warped).apply(body)]

    def _within(self, time: float) -> tuple[float, bool]:
        now = as_number("time", time)
        first, last = self.times[0], self.times[-1]
        return float(np.clip(now, first, last)), bool(first < now < last)

    def _rotation_spline(self) -> RotationSpline:
        if self._turn is None:
            raise InputError("these waypoints are points, without an attitude; give poses to have one")
        return self._turn

    def _warped(self, time: float) -> tuple[float, float]:
        """Return the time that the rotations see and its rate: at rest at the ends, with two continuous derivatives."""
        t = self.times
        if t.size == 2:
            x = (time - t[0]) / (t[1] - t[0])
            return t[0] + (t[1] - t[0]) * x**3 * (10 - 15 * x + 6 * x**2), 30 * (x * (1 - x)) ** 2
        if time < t[1]:
            x = (time - t[0]) / (t[1] - t[0])
            return t[0] + (t[1] - t[0]) * x**3 * (6 - 8 * x + 3 * x**2), x**2 * (18 - 32 * x + 15 * x**2)
        if time > t[-2]:
            x = (t[-1] - time) / (t[-1] - t[-2])
            return t[-1] - (t[-1] - t[-2]) * x**3 * (6 - 8 * x + 3 * x**2), x**2 * (18 - 32 * x + 15 * x**2)
        return time, 1.0


class TumblingTarget(Settled):
    """A point on a rigid body that tumbles freely: torque-free rotation, centre of mass in uniform motion.

    The angular momentum L stays in inertial axes, so that the attitude R alone is integrated, under the body rate
    I^-1 R^T L, by an eighth-order Runge-Kutta method, as far as it is asked for.

    Args:
        inertia: About the body's centre of mass (3, 3), kg m2, body axes; its scale plays no part.
        attitude: Body axes to inertial axes at time 0 (3, 3).
        angular_velocity: At time 0 (3,), rad/s, inertial axes.
        position: Of the centre of mass at time 0 (3,), m, inertial axes.
        velocity: Of the centre of mass (3,), m/s, inertial axes.
        grasp_point: The point to follow (3,), m, body axes from the centre of mass.

    Attributes:
        angular_momentum: L (3,), kg m2/s, inertial axes.

    Raises:
        InputError: a wrong shape, a number that is not finite, or an attitude that is no rotation.
        ModelError: no body has such an inertia.
    """

    def __init__(
        self,
        inertia: ArrayLike,
        attitude: ArrayLike,
        angular_velocity: ArrayLike,
        position: ArrayLike,
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        grasp_point: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        self._inertia = possible_inertia("target inertia", inertia)
        start = np.eye(4)
        rotation = as_floats("target attitude", attitude)
        if rotation.shape != (3, 3):
            raise InputError(f"target attitude has shape {rotation.shape}; it needs a rotation matrix (3, 3)")
        start[:3, :3] = rotation
        start[:3, 3] = as_triple("target position", position)
        self._start = rigid_pose("target attitude", start)
        self._velocity = as_triple("target velocity", velocity)
        self._grasp = as_triple("target grasp_point", grasp_point)
        spin = as_triple("target angular_velocity", angular_velocity)
        R = self._start.rotation
        self._inverse = np.linalg.inv(self._inertia)
        with np.errstate(over="ignore", invalid="ignore"):  # looked at below
            self.angular_momentum: Floats = fixed_array(R @ self._inertia @ R.T @ spin)
            fastest = float(np.linalg.norm(self.angular_momentum) * np.linalg.norm(self._inverse, 2))
        self._momentum, self._half_inverse = self.angular_momentum.tolist(), (0.5 * self._inverse).tolist()
        self._prepare(fastest)

    def _prepare(self, fastest: float) -> None:
        if not fastest < np.inf:
            raise InputError("target angular_velocity: its angular momentum is beyond the largest number")
        quaternion = pin.Quaternion(self._start.rotation).normalized().coeffs()
        step = 2 * np.pi / (_STEPS_A_TURN * fastest) if fastest > 0 else np.inf
        self._solver = DOP853(self._slope, 0.0, quaternion, np.inf, max_step=step, rtol=1e-13, atol=1e-15)
        self._times: list[float] = [0.0]
        self._pieces: list[Callable[[float], Floats]] = []

    def _slope(self, time: float, quaternion: Floats) -> Floats:
        # Plain numbers: each of fifteen calls a step would cost five times as much by arrays.
        x, y, z, w = quaternion.tolist()
        a, b, c = self._momentum
        double = 2.0 / (x * x + y * y + z * z + w * w)
        along, turn, size = double * (x * a + y * b + z * c), double * w, double * w * w - 1.0
        first = size * a + along * x + turn * (b * z - c * y)  # of R^T L
        second = size * b + along * y + turn * (c * x - a * z)
        third = size * c + along * z + turn * (a * y - b * x)
        a, b, c = (u * first + v * second + s * third for u, v, s in self._half_inverse)
        return np.array([w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a, -x * a - y * b - z * c])

    def _body_rate(self, rotation: Floats) -> Floats:
        return self._inverse @ (rotation.T @ self.angular_momentum)

    def __call__(self, time: float) -> tuple[Floats, Floats]:
        """Return position (3,), m, and velocity (3,), m/s, of the grasp point, inertial axes.

        Raises:
            InputError: a time before 0, or not finite.
        """
        R = self._rotation(time)
        arm, spin = R @ self._grasp, R @ self._body_rate(R)
        return self._centre(time) + arm, self._velocity + pin.skew(spin) @ arm

    def pose(self, time: float) -> pin.SE3:
        """Return the pose in the inertial frame of the body's axes, whose origin is its centre of mass.

        Raises:
            InputError: a time before 0, or not finite.
        """
        return pin.SE3(self._rotation(time), self._centre(time))

    def twist(self, time: float) -> Floats:
        """Return velocity of the centre of mass and angular velocity (6,), m/s and rad/s, inertial axes.

        Raises:
            InputError: a time before 0, or not finite.
        """
        R = self._rotation(time)
        return np.r_[self._velocity, R @ self._body_rate(R)]

    def _centre(self, time: float) -> Floats:
        return self._start.translation + as_number("time", time) * self._velocity

    def _rotation(self, time: float) -> Floats:
        now = as_number("time", time)
        if now < 0:
            raise InputError(f"the target's motion starts at time 0; {now:g} s is before")
        ahead = (now - self._times[-1]) / self._solver.max_step
        if len(self._times) + ahead > MOST_STEPS:
            raise InputError(
                f"time is {now:g} s: the target's tumble takes {len(self._times) + ahead:.3g} steps of "
                f"{self._solver.max_step:.3g} s until then, {MOST_STEPS:g} at most; start it nearer to that time, or "
                "let it turn more slowly"
            )
        while now >= self._times[-1]:
            self._solver.step()
            self._times.append(self._solver.t)
            self._pieces.append(self._solver.dense_output())
        return _matrix(self._pieces[bisect_right(self._times, now) - 1](now))


def _matrix(quaternion: Floats) -> Floats:
    return pin.Quaternion(quaternion).normalized().matrix()


def _places(waypoints: ArrayLike | Sequence[pin.SE3], count: int) -> tuple[Floats, Floats | None]:
    if isinstance(waypoints, (list, tuple)) and any(isinstance(waypoint, pin.SE3) for waypoint in waypoints):
        given = [rigid_pose(f"waypoint {i}", waypoint).homogeneous for i, waypoint in enumerate(waypoints)]
        values = np.array(given)
    else:
        values = as_floats("waypoints", waypoints)
    if values.shape == (count, 3) and np.all(np.isfinite(values)):
        return values, None
    if values.shape == (count, 4, 4):
        poses = [rigid_pose(f"waypoint {i}", matrix) for i, matrix in enumerate(values)]
        return np.array([pose.translation for pose in poses]), np.array([pose.rotation for pose in poses])
    raise InputError(
        f"waypoints of shape {values.shape}; {count} times need ({count}, 3) finite numbers, m, or {count} poses"
    )


def _rising(name: str, values: ArrayLike) -> Floats:
    times = as_floats(name, values)
    if times.ndim != 1 or times.size < 2 or not np.all(np.isfinite(times)) or not np.all(np.diff(times) > 0):
        raise InputError(f"{name} are {shown(times.tolist())}; they need two or more finite numbers that rise, s")
    return times
