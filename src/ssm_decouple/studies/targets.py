"""What share of random targets, all within the arm's reach, each law reaches, and what the way costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import norm

from ssm_decouple.batch import Batch
from ssm_decouple.batch.results import Motions
from ssm_decouple.batch.rows import move_poses, place_points
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.errors import InputError, as_floats, as_kind, as_number, as_seed, as_whole, shown
from ssm_decouple.model.robot import Robot, checked_robot
from ssm_decouple.momentum.protection import AXES, Protection
from ssm_decouple.settled import Settled, fixed
from ssm_decouple.studies.case import Case, checked_case
from ssm_decouple.studies.comparison import UNDAMPED, laws_of
from ssm_decouple.studies.postures import MARGIN, PROTECTIONS, joint_ranges
from ssm_decouple.studies.shares import CONFIDENCE, wilson

Floats = NDArray[np.float64]

Flags = NDArray[np.bool_]
Triple = tuple[float, float, float]

MOST_TARGETS = 10**6
COUNT = 10_000
DRAWN = 8192  # random starts that are looked at together
TRIES = 64  # so many times before there seem to be none
INTERVALS = 16  # of a joint path, over which the base is integrated
STEPS = (("none", "yaw"), ("yaw", "roll+yaw"), ("roll+yaw", "all"), ("all", "all" + UNDAMPED))  # a row more at each
PAIRS = (("none", "selective"), ("selective", "reactionless"), ("selective", "reactionless" + UNDAMPED))

ARM, SEVERAL, ELSEWHERE = "the arm itself", "several rows", "no singularity"  # what stops a motion, beside one row

_GAUSS = (0.5 - np.sqrt(3) / 6, 0.5 + np.sqrt(3) / 6)


@dataclass(frozen=True)
class Targets:
    """Places that the arm can reach, because it has: a free base at rest, joints that travel straight to random ends.

    Attributes:
        robot: The robot.
        start: Name of the case whose start it is, or "random".
        configurations: Where the motions start (N, nq).
        goals: Joint positions at the end of the path that found each target (N, n), rad or m.
        positions: The targets (N, 3), m, inertial axes.
    """

    robot: Robot
    start: str
    configurations: Floats
    goals: Floats
    positions: Floats


def random_starts(robot: Robot, count: int, seed: int = 0, margin: float = MARGIN) -> Floats:
    """Return random joint positions (count, n) at which even full reactionless control is regular.

    There the smallest singular value of J_gt N_sub with all three axes protected is at least `margin`. As fewer
    protected rows never make it smaller, every law starts undamped and away from its singularities. That is kind to
    reactionless control: most configurations of a six-joint arm are singular for it.

    Args:
        robot: The robot.
        count: How many.
        seed: Of the random numbers. The same seed with a larger count gives the same first ones.
        margin: m.

    Raises:
        InputError: a count or a seed that makes no sense, or hardly any such configurations.
    """
    _check_count(count)
    checked_robot(robot)
    margin = as_number("margin", margin, "it needs a number, m")
    engine, (low, high) = Batch(robot), joint_ranges(robot).T
    random = np.random.default_rng([as_seed("seed", seed), 1])
    found: list[Floats] = []
    for _ in range(max(TRIES, TRIES * count // DRAWN)):
        drawn = random.uniform(low, high, (DRAWN, robot.n_joints))
        found.append(drawn[engine.singular_values(drawn, ["all"])[:, 0] >= margin])
        if sum(map(len, found)) >= count:
            return np.concatenate(found)[:count]
    raise InputError(
        f"of {TRIES * DRAWN} random configurations of '{robot.name}' too few are regular with all axes protected; give "
        f"a margin below {margin:g} m, or start from a case"
    )


def random_targets(robot: Robot, starts: ArrayLike, count: int, seed: int = 0, name: str = "random") -> Targets:
    """Return random targets that the arm can reach from its starts.

    Joint ends are drawn evenly in `joint_ranges`. The joints travel straight there while the base is free, without
    momentum; where the end-effector then is, in inertial axes, is the target. Nothing else limits them: the arm may
    pass through the spacecraft, as nothing in the laws hinders it either.

    Args:
        robot: The robot.
        starts: Configurations (count, nq), one for each target, or one (nq,) for all.
        count: How many.
        seed: Of the random numbers. The same seed with a larger count gives the same first ones.
        name: What the starts are called in results.

    Raises:
        InputError: a count or a seed that makes no sense, or starts of another shape.
    """
    _check_count(count)
    checked_robot(robot)
    given = np.atleast_2d(as_floats("starts", starts))
    if given.ndim != 2 or given.shape[1] != robot.model.nq or len(given) not in (1, count):
        raise InputError(
            f"starts have shape {given.shape}; {count} targets of '{robot.name}' need ({count}, {robot.model.nq}), or "
            "one configuration for all"
        )
    for q in given:
        robot.checked(q)
    random, (low, high) = np.random.default_rng([as_seed("seed", seed), 0]), joint_ranges(robot).T
    goals = random.uniform(low, high, (count, robot.n_joints))
    configurations = np.broadcast_to(given, (count, robot.model.nq)).copy()
    return Targets(robot, name, configurations, goals, end_of_path(robot, configurations, goals))


def end_of_path(robot: Robot, configurations: Floats, goals: Floats, intervals: int = INTERVALS) -> Floats:
    """Return where the end-effector is after the joints have travelled straight, the base free, without momentum.

    The base pose obeys T' = T (J_base(q) q')^ with base axes on the right, which a Magnus expansion of fourth order on
    two Gauss points an interval solves on SE(3). The pace does not matter: without momentum the path decides.

    Args:
        robot: The robot.
        configurations: Where the paths start (N, nq).
        goals: Joint positions where they end (N, n).
        intervals: In so many steps.

    Returns:
        Positions (N, 3), m, inertial axes.
    """
    engine = Batch(robot)
    joints, poses = engine.split(configurations)
    goals, intervals = as_floats("goals", goals), as_whole("intervals", intervals, most=MOST_TARGETS)
    if goals.shape != joints.shape:
        raise InputError(f"goals have shape {goals.shape}; {len(joints)} configurations need {joints.shape}")
    way, h = goals - joints, 1.0 / intervals
    for i in range(intervals):
        first, second = (_twists(engine, joints + (i + node) * h * way, h * way) for node in _GAUSS)
        move_poses(poses, 0.5 * (first + second) + np.sqrt(3) / 12 * _bracket(first, second))
    return _tools(engine, goals, poses)


def _tools(engine: Batch, joints: Floats, poses: Floats) -> Floats:
    """Return where the end-effector is (N, 3), m, inertial axes."""
    positions = engine.matrices(joints).end_effector_position.copy()
    place_points(poses, positions)
    return positions


def _twists(engine: Batch, joints: Floats, rates: Floats) -> Floats:
    return np.einsum("nij,nj->ni", engine.matrices(joints).J_base, rates)


def _bracket(a: Floats, b: Floats) -> Floats:
    """Return the Lie brackets of twists (N, 6), [linear; angular]."""
    linear = np.cross(a[:, 3:], b[:, :3]) + np.cross(a[:, :3], b[:, 3:])
    return np.hstack([linear, np.cross(a[:, 3:], b[:, 3:])])


@dataclass(frozen=True)
class Arrival:
    """How one law did on one set of targets; degrees and millimetres, as it is for people to read.

    What no motion has is None.

    Attributes:
        robot: Name of the robot.
        start: Name of the case that gives the start, or "random".
        law: Name of the law.
        k: Protected directions.
        targets: How many.
        arrived: At how many of them the motion arrived and stayed.
        share: arrived over targets.
        share_low: Lower end of its 95 % interval (Wilson).
        share_high: Upper end.
        stalled: Motions that stopped making progress.
        running: Motions that had done neither when the time was over.
        time_median_s: When those that arrived did, median.
        time_p90_s: 90th percentile.
        left_median_mm: Distance to the target at the end of those that did not arrive, median.
        travel_median_deg: Norm of the joint rates integrated over the motion, of those that arrived, median.
        peak_rate_deg_s: Largest joint rate of all motions.
        beyond_limits: Motions at whose end a joint is beyond its limits, which none of these laws knows.
        arrived_beyond_limits: Those of them that arrived.
        base_median_deg: Base roll, pitch, yaw, peak to peak, of those that arrived, medians.
        base_p95_deg: 95th percentiles.
        common: Targets at which all laws of the study arrive.
        common_base_median_deg: base_median_deg at these, like with like.
        common_base_p95_deg: base_p95_deg at these.
        protected_rate_max_rad_s: Largest protected rate of all motions: rounding.
        sigma_median_m: Smallest singular value of J_gt N_sub on the way, median over all motions.
        sigma_p5_m: 5th percentile.
    """

    robot: str
    start: str
    law: str
    k: int
    targets: int
    arrived: int
    share: float
    share_low: float
    share_high: float
    stalled: int
    running: int
    time_median_s: float | None
    time_p90_s: float | None
    left_median_mm: float | None
    travel_median_deg: float | None
    peak_rate_deg_s: float
    beyond_limits: int
    arrived_beyond_limits: int
    base_median_deg: Triple | None
    base_p95_deg: Triple | None
    common: int
    common_base_median_deg: Triple | None
    common_base_p95_deg: Triple | None
    protected_rate_max_rad_s: float
    sigma_median_m: float
    sigma_p5_m: float


@dataclass(frozen=True)
class Pair:
    """Two laws at the same targets.

    Attributes:
        robot: Name of the robot.
        start: Name of the case that gives the start, or "random".
        law: One law.
        other: The other.
        both: Targets at which both arrive.
        only_law: At which the one arrives and the other does not.
        only_other: The reverse.
        neither: At which none of the two arrives.
        difference: Share of the one less that of the other.
        low: Lower end of its 95 % interval for paired shares.
        high: Upper end.
        law_base_median_deg: Base roll, pitch, yaw, peak to peak, where both arrive, medians under the one; None where
            there is no such target.
        other_base_median_deg: Under the other.
    """

    robot: str
    start: str
    law: str
    other: str
    both: int
    only_law: int
    only_other: int
    neither: int
    difference: float
    low: float
    high: float
    law_base_median_deg: Triple | None
    other_base_median_deg: Triple | None


@dataclass(frozen=True)
class Stop:
    """What holds the stalled motions of one law.

    Attributes:
        robot: Name of the robot.
        start: Name of the case that gives the start, or "random".
        law: Name of the law.
        cause: The protected row without which the singular value at the end would grow most, at least to twice itself;
            "several rows" where none alone does that, but all together do; "the arm itself" where not even that; "no
            singularity" where it is above the law's damping threshold.
        stalled: Motions held by it.
        share: Of the law's stalled motions.
    """

    robot: str
    start: str
    law: str
    cause: str
    stalled: int
    share: float


@dataclass
class Trials(Settled):
    """The same targets under several laws; what is done stays when it is interrupted.

    Attributes:
        targets: The targets.
        laws: The laws by name; of the robot of the targets, and such as the batch engine takes.
        duration: Of each motion, s.
        dt: Time between samples, s.
        arrival_tolerance: Distance, m, within which the end-effector has arrived.
        threads: How many at a time; None is one a processor.
        found: Results so far by law, motions in the order of the targets.
    """

    targets: Targets
    laws: Mapping[str, SelectiveLaw]
    duration: float = 150.0
    dt: float = 0.1
    arrival_tolerance: float = 0.01
    threads: int | None = None
    found: dict[str, Motions] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse laws that the batch engine does not do before the first motion.

        Raises:
            InputError: no laws, or one that the engine refuses; the message says why.
        """
        as_kind("targets", self.targets, Targets, "draw some with random_targets(..)")
        self.laws = fixed(as_kind("laws", self.laws, Mapping, "give laws by name"))  # type: ignore[type-abstract]
        if not self.laws:
            raise InputError("there are no laws to try; give at least one, such as {'none': SelectiveLaw(..)}")
        for name, law in self.laws.items():
            try:
                self.engine.step(law, self.targets.configurations[:1], self.targets.positions[:1])
            except InputError as error:
                raise InputError(f"law '{name}': {error}") from error

    @cached_property
    def engine(self) -> Batch:
        """The engine that moves the robot."""
        return Batch(self.targets.robot, threads=self.threads)

    def run(self, progress: Callable[[str, float], object] | None = None) -> None:
        """Run the laws that are not yet found.

        Args:
            progress: Called now and then with the law and the share of its motions that is done.

        Raises:
            InputError: times that make no sense.
            KeyboardInterrupt: Ctrl-C; `found` keeps the laws that were finished.
        """
        for name, law in self.laws.items():
            if name not in self.found:
                tick = None if progress is None else lambda share, name=name: progress(name, share)
                self.found[name] = self.engine.motions(
                    law,
                    self.targets.configurations,
                    self.targets.positions,
                    self.duration,
                    self.dt,
                    self.arrival_tolerance,
                    tick,
                )

    def arrived(self, name: str) -> Flags:
        """Return at which targets (N,) a law arrives."""
        return self.found[name].outcome == "converged"

    def common(self) -> Flags:
        """Return at which targets (N,) all laws that were finished arrive."""
        return np.all([self.arrived(name) for name in self.found], axis=0)

    def beyond_limits(self, name: str) -> Flags:
        """Return which motions (N,) of a law end with a joint beyond its limits."""
        joints, limits = self.engine.split(self.found[name].configuration)[0], self.targets.robot.position_limits
        return np.any((joints < limits[:, 0]) | (joints > limits[:, 1]), axis=1)

    def distances(self) -> Floats:
        """Return how far the targets are from where the end-effector starts (N,), m."""
        tools = _tools(self.engine, *self.engine.split(self.targets.configurations))
        return np.linalg.norm(self.targets.positions - tools, axis=1)

    def final_positions(self, name: str) -> Floats:
        """Return where the end-effector is at the end of each motion of a law (N, 3), m, inertial axes."""
        return _tools(self.engine, *self.engine.split(self.found[name].configuration))

    def rows(self) -> list[Arrival]:
        """Return a row for each law that was finished."""
        return [self._arrival(name) for name in self.laws if name in self.found]

    def pairs(self, wanted: Sequence[tuple[str, str]] = PAIRS) -> list[Pair]:
        """Return pairs of laws, those of which both were finished."""
        return [self._pair(a, b) for a, b in wanted if a in self.found and b in self.found]

    def stops(self) -> list[Stop]:
        """Return what holds the stalled motions of each law that was finished, the most frequent first."""
        return [row for name in self.laws if name in self.found for row in self._stops(name)]

    def _arrival(self, name: str) -> Arrival:
        found, arrived, common = self.found[name], self.arrived(name), self.common()
        count, total = int(arrived.sum()), len(arrived)
        low, high = wilson(count, total)
        turned, beyond = np.rad2deg(found.base_rotation), self.beyond_limits(name)
        return Arrival(
            robot=self.targets.robot.name,
            start=self.targets.start,
            law=name,
            k=self.laws[name].protection.k,
            targets=total,
            arrived=count,
            share=count / total,
            share_low=low,
            share_high=high,
            stalled=int((found.outcome == "stalled").sum()),
            running=int((found.outcome == "running").sum()),
            time_median_s=_percentile(found.outcome_time[arrived], 50),
            time_p90_s=_percentile(found.outcome_time[arrived], 90),
            left_median_mm=_percentile(1e3 * found.final_error[~arrived], 50),
            travel_median_deg=_percentile(np.rad2deg(found.joint_travel[arrived]), 50),
            peak_rate_deg_s=float(np.rad2deg(found.peak_rate.max())),
            beyond_limits=int(beyond.sum()),
            arrived_beyond_limits=int((beyond & arrived).sum()),
            base_median_deg=_percentiles(turned[arrived], 50),
            base_p95_deg=_percentiles(turned[arrived], 95),
            common=int(common.sum()),
            common_base_median_deg=_percentiles(turned[common], 50),
            common_base_p95_deg=_percentiles(turned[common], 95),
            protected_rate_max_rad_s=float(found.protected_rate.max()),
            sigma_median_m=float(np.median(found.smallest_singular_value)),
            sigma_p5_m=float(np.percentile(found.smallest_singular_value, 5)),
        )

    def _pair(self, law: str, other: str) -> Pair:
        one, two = self.arrived(law), self.arrived(other)
        both, only_one, only_other = one & two, int((one & ~two).sum()), int((two & ~one).sum())
        low, high = paired_interval(only_one, only_other, len(one))
        return Pair(
            robot=self.targets.robot.name,
            start=self.targets.start,
            law=law,
            other=other,
            both=int(both.sum()),
            only_law=only_one,
            only_other=only_other,
            neither=int((~one & ~two).sum()),
            difference=(only_one - only_other) / len(one),
            low=low,
            high=high,
            law_base_median_deg=_percentiles(np.rad2deg(self.found[law].base_rotation[both]), 50),
            other_base_median_deg=_percentiles(np.rad2deg(self.found[other].base_rotation[both]), 50),
        )

    def _stops(self, name: str) -> Iterator[Stop]:
        causes = self.causes(name)
        held = causes[causes != ""]
        found, counts = np.unique(held, return_counts=True)
        for i in np.argsort(-counts, kind="stable"):
            count = int(counts[i])
            yield Stop(self.targets.robot.name, self.targets.start, name, str(found[i]), count, count / len(held))

    def causes(self, name: str) -> NDArray[np.str_]:
        """Return what holds each stalled motion of a law (N,), in the words of `Stop`; "" where it is not stalled."""
        found, law = self.found[name], self.laws[name]
        held = np.flatnonzero(found.outcome == "stalled")
        U, k = law.protection.U_twist, law.protection.k
        fewer = [Protection(np.delete(U, i, axis=1)) if k > 1 else Protection("none") for i in range(k)]
        tried = [law.protection, *fewer, Protection("none")]
        sigma = self.engine.singular_values(self.engine.split(found.configuration[held])[0], tried)
        words = np.array([*row_names(law.protection), SEVERAL, ARM, ELSEWHERE])
        told = np.full(len(found.outcome), "", dtype=words.dtype)
        own, best = sigma[:, 0], sigma[:, 1:-1].argmax(axis=1) if k else np.zeros(len(held), dtype=int)
        row = (sigma[np.arange(len(held)), 1 + best] > 2 * own) & (k > 0)
        cause = np.where(row, best, np.where(sigma[:, -1] > 2 * own, k, k + 1))
        told[held] = words[np.where(own >= law.damping_threshold, k + 2, cause)]
        return told


def laws_to_try(case: Case) -> dict[str, SelectiveLaw]:
    """Return the laws of a case to try: none, its own, reactionless, and reactionless undamped."""
    laws = {name: case.make_law(protection) for name, protection in laws_of(case).items()}
    last, law = next(reversed(laws.items()))
    if law.protection.k == 3 and law.damping > 0:
        laws[last + UNDAMPED] = replace(case, law={**case.law, "damping": 0.0}).make_law(law.protection)
    return laws


def case_trials(
    case: Case, count: int = COUNT, seed: int = 0, dt: float | None = None, threads: int | None = None
) -> Trials:
    """Return the trials of a case: from its start, with its law's settings and times, to random targets.

    Args:
        case: The case.
        count: How many targets.
        seed: Of the targets.
        dt: Time between samples, s, instead of the case's own.
        threads: How many at a time; None is one a processor.

    Raises:
        InputError: the batch engine does not do what the case asks for; the message says what.
    """
    checked_case(case)
    try:
        beyond = [key for key in case.simulation if key not in ("method", "arrival_tolerance")]
        if beyond or case.simulation.get("method", "explicit") != "explicit":
            asked = beyond[0] if beyond else "method"
            raise InputError(
                f"random targets are tried with the explicit method alone, the case asks for {asked} = "
                f"{case.simulation[asked]!r}; leave that out"
            )
        laws, start = laws_to_try(case), case.start()
        targets = random_targets(case.robot, start, count, seed, case.name)
        tolerance = float(case.simulation.get("arrival_tolerance", 0.01))
        return Trials(targets, laws, case.duration, case.dt if dt is None else dt, tolerance, threads)
    except InputError as error:
        raise InputError(f"case '{case.name}': {error}") from error


def workspace_trials(
    robot: Robot,
    count: int = COUNT,
    seed: int = 0,
    gain: float = 0.05,
    rate_limit: ArrayLike | None = None,
    margin: float = MARGIN,
    threads: int | None = None,
) -> Trials:
    """Return the trials of eight protections on one robot, all three axes also undamped, from random regular starts.

    Args:
        robot: The robot.
        count: How many targets, each with a start of its own.
        seed: Of starts and targets.
        gain: Tracking gain, 1/s.
        rate_limit: Largest joint rates, as for `SelectiveLaw`; None is the robot's own.
        margin: Of the starts, see `random_starts`.
        threads: How many at a time; None is one a processor.

    Raises:
        InputError: numbers that make no sense, or a robot that protected has no freedom left.
    """
    joints = random_starts(robot, count, seed, margin)
    starts = np.array([robot.configuration(row) for row in joints])
    laws = {name: SelectiveLaw(robot, Protection(name), gain, rate_limit) for name in PROTECTIONS}
    laws["all" + UNDAMPED] = SelectiveLaw(robot, Protection("all"), gain, rate_limit, damping=0.0)
    return Trials(random_targets(robot, starts, count, seed), laws, threads=threads)


def paired_interval(only_one: int, only_other: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of the difference of two shares of the same targets, by Agresti and Min.

    It is Wald's for paired shares with half a motion added to each of the four counts, which keeps its level also where
    few motions differ.

    Args:
        only_one: Targets at which only the one arrives.
        only_other: At which only the other does.
        total: All targets.
    """
    b, c, size = only_one + 0.5, only_other + 0.5, total + 2.0
    middle = (b - c) / size
    half = norm.ppf(0.5 + 0.5 * CONFIDENCE) * np.sqrt(b + c - (b - c) ** 2 / size) / size
    return float(middle - half), float(middle + half)


def row_names(protection: Protection) -> list[str]:
    """Return the names of protected directions: roll, pitch, yaw, or their components."""
    known = {tuple(axis): name for name, axis in AXES.items()}
    columns = [tuple(np.round(column, 12) + 0.0) for column in protection.U_c.T]
    return [known.get(column, f"({', '.join(f'{x:.3g}' for x in column)})") for column in columns]


def _percentile(values: Floats, share: float) -> float | None:
    return float(np.percentile(values, share)) if len(values) else None


def _percentiles(values: Floats, share: float) -> Triple | None:
    if not len(values):
        return None
    x, y, z = np.percentile(values, share, axis=0)
    return float(x), float(y), float(z)


def _check_count(count: int) -> None:
    try:
        as_whole("count", count)
    except InputError:
        raise InputError(f"{shown(count)} targets are no study; give a whole number from 1") from None
    as_whole("count of targets", count, most=MOST_TARGETS)
