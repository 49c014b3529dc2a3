"""Joint position, rate and acceleration limits, and clearances, kept inside the null space of the protection."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import daqp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.control import limits_kernel as kernel
from ssm_decouple.control.collision import Clearance
from ssm_decouple.errors import InputError, as_floats, as_kind, as_positive, shown
from ssm_decouple.model.robot import Robot, per_joint

Floats = NDArray[np.float64]
Level = tuple[Floats, Floats, float]  # J_l (m_l, n), v_l (m_l,), rho_l

KINDS = {
    kernel.POSITION: "position",
    kernel.RATES: "rate",
    kernel.ACCELERATIONS: "acceleration",
    kernel.CURVATURE: "curvature",
}
# DAQP's defaults let a bound be passed by 1e-6.
TOLERANCES = {"primal_tol": 1e-12, "dual_tol": 1e-12, "iter_limit": 500}
LEAST = 1e-11  # weight of the rates beside that of what exceeds the acceleration limits
KEPT = 1e-7  # share of the acceleration limits that is left for rounding there
# Weights of the change of the rates, as kernel.STEADY, while joints or pairs of bodies are brought back inside their
# limits: of those that return, and of what the tasks do meanwhile. Beside bounds that leave them hardly any way, the
# others would be thrown from limit to limit.
RETURN_STEADY = 0.2
TASK_STEADY = 0.5


@dataclass(frozen=True)
class Limits:
    """Which limits a law keeps beside those of rate and acceleration.

    Attributes:
        position: Lower and upper joint limits, rad or m, (n, 2) or two arrays (n,); None for the URDF's. They may be
            infinite.
        braking: Share of the acceleration limits, in (0, 1), that braking ahead counts on. The rest is left for the
            turning of the null space of the protection.
        clearance: Which bodies shall stay how far apart; None for no such limit.

    Raises:
        InputError: a lower limit that is not below the upper one, numbers that are none, or no such share.
    """

    position: Any = None
    braking: float = 0.8
    clearance: Clearance | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "braking", as_positive("braking", self.braking))
        if not self.braking < 1.0:
            raise InputError(
                f"braking is {self.braking}; it is a share below 1 of the acceleration limits, such as 0.8"
            )
        if not (self.clearance is None or isinstance(self.clearance, Clearance)):
            raise InputError(f"clearance is {shown(self.clearance)}; give a Clearance, such as Clearance(0.05)")
        if self.position is not None:
            position = as_floats("position limits", self.position)
            if np.any(np.isnan(position)):
                raise InputError(f"position limits are {shown(position.tolist())}; nan is no limit, infinity is none")
            if position.ndim != 2:
                raise InputError(
                    f"position limits have shape {position.shape}; they need (n, 2) numbers: lower and upper, a row "
                    "a joint"
                )
            object.__setattr__(self, "position", tuple(map(tuple, position.tolist())))

    def describe(self, robot: Robot) -> dict[str, Any]:
        """Return them in plain types, for a record."""
        clearance = None if self.clearance is None else asdict(self.clearance)
        return {"position": self.positions(robot).tolist(), "braking": self.braking, "clearance": clearance}

    def positions(self, robot: Robot) -> Floats:
        """Return lower and upper joint limits (n, 2).

        Raises:
            InputError: as for the class, or numbers that do not fit the robot.
        """
        if self.position is None:
            return robot.position_limits.copy()
        limits, n = np.array(self.position, dtype=float), robot.n_joints
        if limits.shape == (2, n) and n != 2:
            limits = limits.T
        if limits.shape != (n, 2):
            raise InputError(
                f"position limits have shape {limits.shape}; '{robot.name}' needs ({n}, 2): lower and upper, a "
                "row a joint"
            )
        for name, (lower, upper) in zip(robot.joint_names, limits, strict=True):
            if not (lower < upper and lower < np.inf and upper > -np.inf):
                raise InputError(f"position limits of '{name}' are {lower:g} and {upper:g}; the lower must be below")
        return np.ascontiguousarray(limits)


class LimitedRates:
    """Joint rates that keep limits, and what limited them.

    Attributes:
        joint_rates: q_dot (n,), rad/s or m/s.
        share: Share in [0, 1] of what was wanted of J_sub q_dot that is reached; 1 where nothing was wanted.
        excess: How far acceleration limits are exceeded, relative to them: 0.1 for 10 %; 0 where they are kept.
        stoppable: Whether all joints can be braked together before any position limit and clearance.
    """

    __slots__ = ("_bounds", "_names", "_outside", "excess", "joint_rates", "share", "stoppable")

    def __init__(
        self,
        joint_rates: Floats,
        names: tuple[str, ...],
        bounds: Floats | None = None,
        outside: Floats | None = None,
        share: float = 1.0,
        excess: float = 0.0,
        stoppable: bool = True,
    ) -> None:
        self.joint_rates = joint_rates
        self.share = share
        self.excess = excess
        self.stoppable = stoppable
        self._names = names
        self._bounds = bounds
        self._outside = outside

    @property
    def active(self) -> tuple[tuple[str, str], ...]:
        """Joints that stand at a bound, each with its kind: position, rate, acceleration or curvature."""
        if self._bounds is None:
            return ()
        high, low = self._bounds[kernel.HIGH], self._bounds[kernel.LOW]
        near = 1e-7 * (np.abs(self.joint_rates).max() + 1e-12)
        found = []
        for j, rate in enumerate(self.joint_rates):
            if rate >= high[j] - near:
                found.append((self._names[j], KINDS[int(self._bounds[kernel.HIGH_KIND, j])]))
            elif rate <= low[j] + near:
                found.append((self._names[j], KINDS[int(self._bounds[kernel.LOW_KIND, j])]))
        return tuple(found)

    @property
    def count(self) -> int:
        """How many joints stand at a bound."""
        if self._bounds is None:
            return 0
        return int(kernel.count_at_bounds(self._bounds, self.joint_rates))

    @property
    def outside(self) -> tuple[str, ...]:
        """Joints that are outside their position limits."""
        if self._bounds is None:
            return ()
        return tuple(self._names[j] for j in np.flatnonzero(self._bounds[kernel.RETURN]))

    @property
    def too_near(self) -> tuple[int, ...]:
        """Which pairs of bodies, by the rows given, are nearer than they shall be."""
        return () if self._outside is None else tuple(int(i) for i in np.flatnonzero(self._outside))

    def __repr__(self) -> str:
        rates = ", ".join(f"{x:.6g}" for x in self.joint_rates)
        active = ", ".join(f"{name}: {kind}" for name, kind in self.active)
        return f"LimitedRates([{rates}] rad/s, active=({active}), excess={self.excess:.3g}, share={self.share:.4g})"


class _Problem:
    """A DAQP model of one size and the arrays that it reads.

    The bounds that the last solution stood at are tried first: from sample to sample they are mostly the same, and to
    see whether they are takes a quarter of the time. The problem is convex, so that both ways lead to one solution.
    """

    def __init__(self, size: int, bounds: int) -> None:
        self.H: Floats = np.eye(size)
        self.f: Floats = np.zeros(size)
        self.A: Floats = np.zeros((bounds, size))
        self.high: Floats = np.ones(bounds)
        self.low: Floats = -np.ones(bounds)
        self.active: Floats = np.zeros(bounds)
        self.solution: Floats = np.zeros(size)
        self._work: Floats = np.zeros((3 * size + 2, size))
        self.model = daqp.Model()
        self._ready = False

    def solve(self) -> Floats | None:
        """Return the solution, None where DAQP finds none."""
        if kernel.solve_at(self.H, self.f, self.A, self.high, self.low, self.active, self._work, self.solution):
            return self.solution
        fresh = np.zeros(len(self.high), dtype=np.int32)  # from the same start each time: the same answer each time
        if self._ready:
            self.model.update(self.H, self.f, self.A, self.high, self.low, fresh)
        else:
            self.model.setup(self.H, self.f, self.A, self.high, self.low, fresh)
            self.model.settings = TOLERANCES
            self._ready = True
        solution, _, flag, told = self.model.solve()
        if flag != 1:
            return None
        self.active[:] = np.sign(told["lam"])
        return solution


@dataclass
class _Buffers:
    """Scratch of one set of shapes, and the problems of the sizes met so far."""

    table: Floats
    sides: Floats
    factors: Floats
    told: Floats
    sizes: Floats  # rows of each level
    given: tuple[Floats, ...] = ()  # positions, J_sub and rows of the step that is made
    problems: dict[tuple[int, int], _Problem] = field(default_factory=dict)

    def problem(self, size: int, bounds: int) -> _Problem:
        """Return the problem of this size."""
        found = self.problems.get((size, bounds))
        if found is None:
            found = self.problems[size, bounds] = _Problem(size, bounds)
        return found


class LimitedStep:
    """One control step inside limits: joint rates in the null space of the protection that do the tasks as they can.

    In order of precedence: J_sub q_dot is what is wanted, to rounding; joints stay inside their position and rate
    limits, for which what is wanted yields as a whole; accelerations stay inside theirs; then the tasks, level by
    level, by quadratic programs.

    Braking joint by joint would leave null(J_sub); scaling all rates does not. So a step only commands rates that can
    be scaled down to rest, at a share `braking` of the acceleration limits, before any position limit and clearance:
    then the next step can always brake.

    Args:
        robot: The robot.
        limits: Position limits and clearances, and the share of the acceleration that braking counts on.
        rate_limits: (n,), rad/s or m/s; infinite for none.
        acceleration_limits: (n,), rad/s2 or m/s2; infinite for none, None for none at all.
        sample_time: How long a command is held, s.

    Raises:
        InputError: limits that do not fit the robot or are not above zero.
    """

    def __init__(
        self,
        robot: Robot,
        limits: Limits,
        rate_limits: ArrayLike,
        acceleration_limits: ArrayLike | None,
        sample_time: float,
    ) -> None:
        n = robot.n_joints
        as_kind("limits", limits, Limits, "give Limits, such as Limits(braking=0.8)")
        position = limits.positions(robot)
        columns = np.empty((kernel.COLUMNS_SIZE, n))
        columns[kernel.LOWER], columns[kernel.UPPER] = position[:, 0], position[:, 1]
        columns[kernel.RATE] = per_joint(robot, "rate_limits", rate_limits)
        accelerations = np.inf if acceleration_limits is None else acceleration_limits
        columns[kernel.ACCELERATION] = per_joint(robot, "acceleration_limits", accelerations)
        distance = 0.0 if limits.clearance is None else limits.clearance.distance
        self.robot = robot
        self.limits = limits
        self.sample_time = as_positive("sample_time", sample_time)
        self.position_limits: Floats = position
        self._columns: Floats = columns
        self._parameters: Floats = np.array([self.sample_time, limits.braking, distance, 0.0])
        self._steps: Floats = columns[kernel.ACCELERATION] * self.sample_time
        self._buffers: dict[tuple[Any, ...], _Buffers] = {}
        self._last: _Buffers | None = None
        self._no_rows: tuple[Floats, Floats] = np.empty((0, n)), np.empty(0)

    def __call__(
        self,
        positions: Floats,
        previous: Floats,
        plain: Floats,
        J_sub: Floats,
        wanted: Floats,
        levels: Sequence[Level],
        rows: Floats | None = None,
        distances: Floats | None = None,
        noise: float = 0.0,
    ) -> LimitedRates:
        """Return the rates; arrays are of floats and contiguous by rows.

        Args:
            positions: Joint positions (n,), rad or m.
            previous: The rates commanded before (n,), zeros from rest.
            plain: The rates that do the tasks without limits (n,); this array is returned where it keeps all limits.
            J_sub: (k, n).
            wanted: What J_sub q_dot shall be (k,).
            levels: Tasks in strict priority, of each level J_l (m_l, n), v_l (m_l,) and rho_l: it minimises
                |J_l q_dot - v_l|^2 + rho_l |q_dot|^2 in what those before leave.
            rows: Rates of the distances of pairs of bodies per joint rate (c, n).
            distances: These distances (c,), m.
            noise: A row of J_sub that is shorter constrains nothing.

        Raises:
            InputError: a wrong shape, or numbers that are not finite.
        """
        if rows is None or distances is None:
            rows, distances = self._no_rows
        J = levels[0][0] if len(levels) == 1 else np.concatenate([level[0] for level in levels])
        key = (
            positions.shape,
            previous.shape,
            plain.shape,
            J_sub.shape,
            wanted.shape,
            J.shape,
            rows.shape,
            distances.shape,
            *[len(level[1]) for level in levels],
        )
        buffers = self._buffers.get(key)
        if buffers is None:
            buffers = self._buffers[key] = self._fitting(key)
        table, told, self._last = buffers.table, buffers.told, buffers
        self._parameters[kernel.NOISE] = noise
        status = kernel.prepare(
            self._columns,
            self._parameters,
            positions,
            previous,
            plain,
            J_sub,
            wanted,
            J,
            buffers.sizes,
            rows,
            distances,
            table,
            buffers.sides,
            buffers.factors,
            told,
        )
        if status == kernel.INSIDE:
            return LimitedRates(plain, self.robot.joint_names)
        if status == kernel.NOT_FINITE:
            raise InputError("positions, rates, J_sub, what is wanted of it or distances are not finite")
        buffers.given = (positions, J_sub, rows)
        rates = table[kernel.BRAKE].copy()
        excess = self._least_excess(buffers, previous, rates) if status == kernel.EXCEEDED else 0.0
        if excess == 0.0:
            self._solve(buffers, levels, rates)
        share = 1.0
        if told[kernel.ASKED]:
            share = min(max(float(rates @ table[kernel.FIXED] / told[kernel.LENGTH] ** 2), 0.0), 1.0)
        bounds = table[: kernel.RETURN + 1].copy()
        near = buffers.sides[kernel.APART].copy() if len(distances) else None
        return LimitedRates(rates, self.robot.joint_names, bounds, near, share, excess, bool(told[kernel.STOPPABLE]))

    def take_out_rounding(self, J_sub: Floats, scale: Floats, found: LimitedRates) -> None:
        """Bring scale times the rates of the last step into null(J_sub / scale), or to what is wanted of it, in place.

        J_sub (k, n) and its rank are those of the step: its rates, times `scale` (n,), have rounded once more.
        """
        assert self._last is not None
        table, factors, told = self._last.table, self._last.factors, self._last.told
        residual = (J_sub / scale) @ (scale * found.joint_rates) - found.share * factors[kernel.ATTAINED, : len(J_sub)]
        kernel.take_out(residual, table, factors, int(told[kernel.RANK]), found.joint_rates)

    def _fitting(self, key: tuple[Any, ...]) -> _Buffers:
        """Return buffers for arguments of these shapes, which are checked once."""
        n = self.robot.n_joints
        positions, previous, plain, J_sub, wanted, J, rows, distances, *sizes = key
        right = positions == previous == plain == (n,) and len(J_sub) == len(J) == len(rows) == 2
        right = right and J_sub[1] == J[1] == rows[1] == n
        if not (right and wanted == J_sub[:1] and distances == rows[:1] and J[0] == sum(sizes) and sizes):
            raise InputError(
                f"shapes do not fit {n} joints: positions {positions}, previous {previous}, plain {plain}, J_sub "
                f"{J_sub}, wanted {wanted}, J {J} for levels of {sizes} rows, rows {rows}, distances {distances}"
            )
        k, m = J_sub[0], J[0]
        return _Buffers(
            np.zeros((kernel.BASIS + n + k + m, n)),
            np.zeros((kernel.SIDES_SIZE, rows[0])),
            np.zeros((kernel.FACTORS_SIZE, max(k + m, 1))),
            np.zeros(kernel.COUNTS + len(sizes)),
            np.array(sizes, dtype=float),
        )

    def _solve(self, buffers: _Buffers, levels: Sequence[Level], rates: Floats) -> None:
        """Move rates (n,), which keep all limits, level by level to the best that keep them."""
        n, table, told, (_, _, G) = len(rates), buffers.table, buffers.told, buffers.given
        first, asked = int(told[kernel.RANK]), int(told[kernel.ASKED])
        if told[kernel.RETURNING]:
            joints, pairs = np.flatnonzero(table[kernel.RETURN]), np.flatnonzero(buffers.sides[kernel.APART])
            J = np.vstack([np.eye(n)[joints], G[pairs]])
            v = np.r_[table[kernel.RETURN, joints], buffers.sides[kernel.APART, pairs]]
            self._step(buffers, J, v, 0.0, RETURN_STEADY, first - asked, n - first + asked, asked, rates)
            kernel.hold_return(table, buffers.sides, G, rates)
        if asked:
            length = told[kernel.LENGTH]
            direction = table[kernel.FIXED : kernel.FIXED + 1] / length
            # More than is wanted is asked for, and a bound keeps it to that: so no regularisation takes from it.
            self._step(buffers, direction, np.array([1.01 * length]), 0.0, 0.0, first - 1, 1, asked, rates)
        steady = TASK_STEADY if told[kernel.RETURNING] else kernel.STEADY
        for number, (J, v, rho) in enumerate(levels):
            if first == n:
                break
            decided = int(told[kernel.COUNTS + number])
            self._step(buffers, J, v, rho, steady, first, decided, 0, rates)
            first += decided

    def _step(
        self,
        buffers: _Buffers,
        J: Floats,
        v: Floats,
        rho: float,
        steady: float,
        first: int,
        decided: int,
        asked: int,
        rates: Floats,
    ) -> None:
        """Solve one level in the directions from `first` on, and move the rates there as far as the limits allow."""
        positions, J_sub, G = buffers.given
        told, n = buffers.told, len(rates)
        problem = buffers.problem(n - first, n + len(G) + asked)
        kernel.pose(
            buffers.table,
            buffers.sides,
            G,
            J,
            v,
            first,
            decided,
            rho,
            steady,
            told[kernel.SCALE],
            rates,
            problem.H,
            problem.f,
            problem.A,
            problem.high,
            problem.low,
            told[kernel.LENGTH],
        )
        y = problem.solve()
        if y is not None:
            arrays = (J_sub, G, buffers.table, buffers.sides, buffers.factors, told)
            kernel.finish(self._columns, self._parameters, positions, *arrays, first, y, rates)

    def _least_excess(self, buffers: _Buffers, previous: Floats, rates: Floats) -> float:
        """Fill the rates inside position and rate limits that exceed the acceleration limits least; return how far.

        With the excess as one more unknown, in the acceleration limits' own units.
        """
        table, told, n = buffers.table, buffers.told, len(rates)
        first = int(told[kernel.RANK] - told[kernel.ASKED])
        basis, limited = table[kernel.BASIS + first : kernel.BASIS + n], np.isfinite(self._steps)
        d, scale = len(basis), float(self._steps[limited].max(initial=0.0)) or 1.0
        steps, change = (1.0 - KEPT) * self._steps[limited] / scale, previous[limited] / scale
        ones = np.eye(d + 1)[: int(told[kernel.ASKED])]
        A = np.block(
            [
                [basis.T, np.zeros((n, 1))],
                [basis.T[limited], -steps[:, None]],
                [basis.T[limited], steps[:, None]],
            ]
        )
        high, low = table[kernel.HARD_HIGH] / scale, table[kernel.HARD_LOW] / scale
        endless = np.full(len(steps), 1e30)
        high = np.r_[high, change + steps, endless, [told[kernel.LENGTH] / scale] * len(ones)]
        low = np.r_[low, -endless, change - steps, [0.0] * len(ones)]
        H = np.diag([*[LEAST] * d, 1.0])
        f = np.r_[-LEAST * (basis @ rates) / scale, 0.0]
        problem = _Problem(d + 1, len(high))
        problem.H, problem.f, problem.A = H, f, np.vstack([A, ones])
        problem.high, problem.low = np.clip(high, -1e30, 1e30), np.clip(low, -1e30, 1e30)
        y = problem.solve()
        rates[:] = 0.0
        if y is not None:
            kernel.settle(buffers.given[1], table, buffers.factors, told, first, scale * y[:d], rates)
        excess = float(np.max(np.abs(rates - previous)[limited] / self._steps[limited], initial=0.0) - 1.0)
        if excess > 0.0:
            table[kernel.HIGH], table[kernel.LOW] = table[kernel.HARD_HIGH], table[kernel.HARD_LOW]
            table[kernel.HIGH_KIND], table[kernel.LOW_KIND] = kernel.ACCELERATIONS, kernel.ACCELERATIONS
            return excess
        table[kernel.BRAKE] = rates
        given = (self._columns, self._parameters, buffers.given[0], previous, buffers.given[2])
        kernel.fill_bounds(*given, table, buffers.sides, told)
        return 0.0
