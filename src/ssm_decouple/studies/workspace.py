"""How much of a robot's joint space and of its reachable set a protection leaves fit for work.

A posture is fit under a protection if the smallest singular value sigma of J_gt N_sub is above a margin: with joint
rates of norm 1 rad/s, and the protected directions at rest, the end-effector then moves at more than `margin` m/s in
whatever direction is asked for. Where sigma is zero, on the dynamic singularities of that protection, some direction is
lost.

No momentum matrix depends on the base's pose in base axes, so that all of this is a property of the joints alone.
Collisions are not looked at.

Which postures are fit is counted: they are drawn uniformly. Whether a place has any fit posture is searched for: the
best posture seen in each voxel is changed at random, again and again, and what comes out is kept wherever it lands and
is better (J.-B. Mouret and J. Clune, "Illuminating search spaces by mapping elites", 2015).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc, t

from ssm_decouple.batch.engine import Batch
from ssm_decouple.errors import InputError, as_floats, as_items, as_positive, as_seed, as_whole, shown
from ssm_decouple.model.robot import Robot, checked_robot
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.settled import Settled, fixed_array
from ssm_decouple.studies.postures import MARGIN, PROTECTIONS, joint_ranges
from ssm_decouple.studies.shares import CONFIDENCE, wilson

Floats = NDArray[np.float64]
Counts = NDArray[np.uint32]

MARGINS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2)  # m: reported beside the one that is asked for
SAMPLES = 2**20
BLOCKS = 16  # independent scrambles
CHUNK = 2**16  # postures at a time
CLIMBS = 4  # searched postures to a drawn one
VOXELS = 2**18  # more are refused: every one keeps a posture for each protection
MOST_SAMPLES = 10**9  # postures, and four times as many that are searched: weeks
MOST_POINTS = 2000  # of each joint of a slice
PER_REACH = 20.0  # voxels to a reach
CURVE = np.geomspace(1e-6, 10.0, 141)  # m: where the distribution of sigma is counted, 20 to a decade


@dataclass(frozen=True)
class Kept:
    """What one protection leaves at one margin.

    Attributes:
        robot: Name of the robot.
        joints: Number of its joints.
        protection: What is protected.
        k: Number of protected directions.
        margin_m: Smallest singular value of J_gt N_sub above which a posture is fit.
        samples: Number of postures, uniform in joint space.
        share: Share of joint space that is fit.
        share_low: Lower end of its 95 % interval, see `interval`.
        share_high: Upper end.
        sigma_median_m: Median of the smallest singular value over joint space, between the steps of `CURVE`.
        voxel_m: Edge of a voxel.
        reachable_m3: Volume of the voxels that the end-effector was seen in, base axes.
        volume: Share of that volume in which a fit posture was found: a lower bound that grows with the search.
        volume_half: The same after the first half of the blocks; None with less than two.
        typical: Share of the drawn postures that is fit, averaged over the voxels: at a typical place, where `share` is
            of a typical posture and counts places by how many postures lead there.
    """

    robot: str
    joints: int
    protection: str
    k: int
    margin_m: float
    samples: int
    share: float
    share_low: float
    share_high: float
    sigma_median_m: float
    voxel_m: float
    reachable_m3: float
    volume: float
    volume_half: float | None
    typical: float


@dataclass(frozen=True)
class Grid:
    """Cubes about the ball that the end-effector stays in, base axes.

    Attributes:
        corner: Lowest corner (3,), m.
        edge: Of a cube, m.
        shape: Number of cubes along x, y and z.
    """

    corner: Floats
    edge: float
    shape: tuple[int, int, int]

    @property
    def count(self) -> int:
        """Number of cubes."""
        return int(np.prod(self.shape))

    @classmethod
    def about(cls, robot: Robot, edge: float | None = None) -> Grid:
        """Return cubes of a size, reach / 20 if none is given, with the arm's first joint in the middle of one.

        Raises:
            InputError: the size is not positive, or so small that there are more than `VOXELS` cubes; or the arm's
                reach has no end.
        """
        if not np.isfinite(checked_robot(robot).reach):
            raise InputError(f"'{robot.name}' reaches without end: a joint slides without limits; give it limits")
        size = as_positive("voxel", robot.reach / PER_REACH if edge is None else edge)
        half = int(np.ceil(min(robot.reach / size, float(VOXELS))))
        count = 2 * half + 1
        if count**3 > VOXELS:
            least = 1.01 * robot.reach / ((round(VOXELS ** (1 / 3)) - 1) // 2)
            raise InputError(f"voxel is {size:g} m, which makes {count**3} of them; take {least:.3g} m or more")
        corner = robot.shoulder_position(robot.configuration()) - (half + 0.5) * size
        return cls(corner, size, (count, count, count))

    def place(self, points: Floats) -> NDArray[np.int64]:
        """Return the number of the cube that each point (N, 3) is in (N,)."""
        cells = np.floor((points - self.corner) / self.edge).astype(np.int64)
        found: NDArray[np.int64] = np.ravel_multi_index(tuple(cells.T), self.shape, mode="clip")
        return found

    def edges(self, axis: int) -> Floats:
        """Return where cubes begin and end along an axis (count + 1,), m."""
        found: Floats = self.corner[axis] + self.edge * np.arange(self.shape[axis] + 1)
        return found


@dataclass(frozen=True)
class Drawn:
    """What drawn postures have shown; P protections, M margins, V voxels.

    Attributes:
        samples: Number of postures.
        visits: How often the end-effector was in each voxel (V,).
        fit: How often the posture was fit (M, P, V).
        counts: How many smallest singular values lie between neighbours of `Workspace.edges` (P, edges + 1).
    """

    samples: int
    visits: Counts
    fit: Counts
    counts: NDArray[np.int64]

    def plus(self, other: Drawn) -> Drawn:
        """Return both together."""
        return Drawn(
            self.samples + other.samples,
            self.visits + other.visits,
            self.fit + other.fit,
            self.counts + other.counts,
        )


@dataclass(frozen=True)
class Elites:
    """The best posture seen in each voxel under each protection, of drawn and searched ones.

    Attributes:
        sigma: Its smallest singular value (P, V), m; -1 where none was seen.
        joints: Its joint positions (P, V, n), rad or m.
    """

    sigma: Floats
    joints: Floats

    def copy(self) -> Elites:
        """Return a copy that learns by itself."""
        return Elites(self.sigma.copy(), self.joints.copy())

    def learn(self, places: NDArray[np.int64], sigmas: Floats, joints: Floats) -> None:
        """Keep what is better than before: voxels (N,), smallest singular values (N, P) and joint positions (N, n)."""
        for p, sigma in enumerate(sigmas.T):
            better = np.flatnonzero(sigma > self.sigma[p, places])
            better = better[np.argsort(-sigma[better], kind="stable")]
            won, first = np.unique(places[better], return_index=True)
            self.sigma[p, won], self.joints[p, won] = sigma[better[first]], joints[better[first]]

    def children(self, count: int, ranges: Floats, rng: np.random.Generator) -> Floats:
        """Return elites (count, n), of all protections alike, changed by 0.1 to 30 % of the joints' ranges."""
        which, joints = rng.integers(len(self.sigma), size=count), np.empty((count, len(ranges)))
        for p, sigma in enumerate(self.sigma):
            mine = np.flatnonzero(which == p)
            joints[mine] = self.joints[p, rng.choice(np.flatnonzero(sigma >= 0.0), mine.size)]
        low, high = ranges.T
        stride = 10.0 ** rng.uniform(-3.0, -0.5, (count, 1)) / np.sqrt(len(ranges))
        joints += stride * (high - low) * rng.normal(size=joints.shape)
        turns = high - low == 2 * np.pi
        joints[:, turns] = (joints[:, turns] + np.pi) % (2 * np.pi) - np.pi
        return np.clip(joints, low, high)


@dataclass
class Workspace(Settled):
    """Which postures and places of one robot protections leave fit for work; what is done stays when interrupted.

    Postures are drawn uniformly within `joint_ranges`, by `BLOCKS` independently scrambled Sobol sequences; after each
    of them `CLIMBS` times as many are searched. A block is worked off by itself and then added, so that memory depends
    on voxels and protections, not on samples. The numbers depend on the seed alone, not on threads.

    Attributes:
        robot: The robot, with three joints or more.
        margin: Smallest singular value of J_gt N_sub above which a posture is fit, m; `MARGINS` are counted with it.
        samples: How many postures are drawn; the nearest number that gives every block a power of two is taken, as the
            sequence is balanced only then.
        voxel: Edge of a voxel, m; None is the twentieth part of the reach.
        seed: Of scrambles and search.
        threads: As for `Batch`.
        protections: Names, or texts that `Protection.parse` reads, fixed in base axes.
        grid: The voxels.
        margins: All margins that are counted, m, rising.
        edges: Where the distribution of the smallest singular value is counted, m, rising; holds the margins.
        shares: Share of each block that is fit (M, P), a list.
        growth: Share of the reached volume with a fit posture after each block (M, P), a list.
        drawn: What all blocks have drawn; None before the first is done.
        elites: The best postures so far.
    """

    _assignable: ClassVar[tuple[str, ...]] = ("drawn", "elites")

    robot: Robot
    margin: float = MARGIN
    samples: int = SAMPLES
    voxel: float | None = None
    seed: int = 0
    threads: int | None = None
    protections: Sequence[str] = PROTECTIONS
    grid: Grid = field(init=False)
    margins: tuple[float, ...] = field(init=False)
    edges: Floats = field(init=False, repr=False)
    shares: list[Floats] = field(init=False, default_factory=list, repr=False)
    growth: list[Floats] = field(init=False, default_factory=list, repr=False)
    drawn: Drawn | None = field(init=False, default=None, repr=False)
    elites: Elites = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Refuse what makes no study.

        Raises:
            InputError: fewer than three joints, a joint without a range, a margin that is not positive, no samples, a
                seed that is none, or a voxel size that makes no sense.
        """
        if checked_robot(self.robot).n_joints < 3:
            raise InputError(
                f"'{self.robot.name}' has {self.robot.n_joints} joints, but a position takes three freedoms; give a "
                "robot with three joints or more"
            )
        self.margin = as_positive("margin", self.margin)
        self.seed = as_seed("seed", self.seed)
        needs = f"give a positive whole number, such as {SAMPLES}"
        self.samples = as_whole("samples", self.samples, 1, needs, MOST_SAMPLES)
        self.protections = tuple(as_items("protections", self.protections, "give a list, such as ['none', 'yaw']"))
        self._ranges = joint_ranges(self.robot)
        self.grid = Grid.about(self.robot, self.voxel)
        self.margins = tuple(sorted({*MARGINS, self.margin}))
        self.edges = fixed_array(np.union1d(CURVE, self.margins))
        self._parsed = [Protection.parse(text) for text in self.protections]
        self._engine = Batch(self.robot, threads=self.threads)
        self._size = 2 ** max(0, round(np.log2(self.samples / BLOCKS)))  # of a block
        places = len(self.protections), self.grid.count
        self.elites = Elites(np.full(places, -1.0), np.zeros((*places, self.robot.n_joints)))

    @property
    def blocks(self) -> int:
        """How many of the `BLOCKS` blocks are done."""
        return len(self.shares)

    def run(self, progress: Callable[[float], object] | None = None) -> None:
        """Work off the blocks that are not yet done.

        Args:
            progress: Called now and then with the share done, 0 to 1.

        Raises:
            KeyboardInterrupt: Ctrl-C; what whole blocks have shown stays.
        """
        while self.blocks < BLOCKS:
            first, whole = self.blocks, BLOCKS * (1 + CLIMBS) * self._size

            def tell(done: int, first: int = first, whole: int = whole) -> None:
                if progress is not None:
                    progress(first / BLOCKS + done / whole)

            rng, elites = np.random.default_rng([self.seed, first]), self.elites.copy()
            block = self._draw(elites, rng, tell)
            self._search(elites, rng, tell)
            self._add(block, elites)

    def _draw(self, elites: Elites, rng: np.random.Generator, tell: Callable[[int], object]) -> Drawn:
        M, P, V = len(self.margins), len(self.protections), self.grid.count
        visits, fit = np.zeros(V, np.uint32), np.zeros((M, P, V), np.uint32)
        counts = np.zeros((P, self.edges.size + 1), np.int64)
        sequence, (low, high) = qmc.Sobol(self.robot.n_joints, seed=rng), self._ranges.T
        for start in range(0, self._size, CHUNK):
            joints = low + (high - low) * sequence.random(min(CHUNK, self._size - start))
            places, sigmas = self._look(joints)
            elites.learn(places, sigmas, joints)
            visits += _count(places, V)
            for p, sigma in enumerate(sigmas.T):
                counts[p] += np.bincount(np.searchsorted(self.edges, sigma), minlength=self.edges.size + 1)
                for m, margin in enumerate(self.margins):
                    fit[m, p] += _count(places[sigma > margin], V)
            tell(start + len(joints))
        return Drawn(self._size, visits, fit, counts)

    def _search(self, elites: Elites, rng: np.random.Generator, tell: Callable[[int], object]) -> None:
        for start in range(0, CLIMBS * self._size, CHUNK):
            joints = elites.children(min(CHUNK, CLIMBS * self._size - start), self._ranges, rng)
            elites.learn(*self._look(joints), joints)
            tell(self._size + start + len(joints))

    def _look(self, joints: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Return the voxels and the smallest singular values (N, P) of postures."""
        found = self._engine.matrices(joints, self._parsed)
        return self.grid.place(found.end_effector_position), found.smallest_singular_values

    def _add(self, block: Drawn, elites: Elites) -> None:
        best = elites.sigma[:, elites.sigma.max(axis=0) >= 0.0]
        self.drawn = block if self.drawn is None else self.drawn.plus(block)
        self.elites = elites
        self.growth.append(np.array([np.mean(best > margin, axis=1) for margin in self.margins]))
        self.shares.append(block.fit.sum(axis=2) / block.samples)

    def rows(self) -> list[Kept]:
        """Return what the blocks done so far say, by protection and margin; nothing before the first."""
        if self.drawn is None:
            return []
        drawn, shares, visited = self.drawn, np.array(self.shares), self.drawn.visits > 0
        typical = np.mean(drawn.fit[:, :, visited] / drawn.visits[visited], axis=2)
        half = self.growth[self.blocks // 2 - 1] if self.blocks > 1 else None
        reached, rows = int(np.sum(self.elites.sigma.max(axis=0) >= 0.0)), []
        for p, name in enumerate(self.protections):
            median = np.interp(0.5, 1.0 - self.above(name), self.edges)
            for m, margin in enumerate(self.margins):
                low, high = interval(shares[:, m, p], drawn.samples)
                rows.append(
                    Kept(
                        robot=self.robot.name,
                        joints=self.robot.n_joints,
                        protection=name,
                        k=self._parsed[p].k,
                        margin_m=margin,
                        samples=drawn.samples,
                        share=float(shares[:, m, p].mean()),
                        share_low=low,
                        share_high=high,
                        sigma_median_m=float(median),
                        voxel_m=self.grid.edge,
                        reachable_m3=reached * self.grid.edge**3,
                        volume=float(self.growth[-1][m, p]),
                        volume_half=None if half is None else float(half[m, p]),
                        typical=float(typical[m, p]),
                    )
                )
        return rows

    def best(self, protection: str) -> Floats:
        """Return the largest smallest singular value found in each voxel (x, y, z), m; NaN where nothing was seen."""
        sigma = self.elites.sigma[self._index(protection)]
        reached = self.elites.sigma.max(axis=0) >= 0.0
        return np.where(reached, np.maximum(sigma, 0.0), np.nan).reshape(self.grid.shape)

    def best_posture(self, protection: str) -> tuple[Floats, float]:
        """Return the joint positions (n,), rad or m, of the largest smallest singular value found, and that, m."""
        p = self._index(protection)
        place = int(np.argmax(self.elites.sigma[p]))
        return self.elites.joints[p, place].copy(), float(self.elites.sigma[p, place])

    def fit_share(self, protection: str) -> Floats:
        """Return the share of the drawn postures in each voxel (x, y, z) that is fit at `margin`; NaN without any."""
        drawn = self._done()
        fit = drawn.fit[self.margins.index(self.margin), self._index(protection)]
        found: Floats = np.divide(fit, drawn.visits, out=np.full(fit.shape, np.nan), where=drawn.visits > 0)
        return found.reshape(self.grid.shape)

    def above(self, protection: str) -> Floats:
        """Return the share of joint space whose smallest singular value is above each of `edges` (edges,)."""
        drawn = self._done()
        found: Floats = 1.0 - np.cumsum(drawn.counts[self._index(protection)])[:-1] / drawn.samples
        return found

    def _done(self) -> Drawn:
        if self.drawn is None:
            raise InputError(f"no block of '{self.robot.name}' is done yet; call run() first")
        return self.drawn

    def _index(self, protection: str) -> int:
        if protection not in self.protections:
            raise InputError(f"'{protection}' was not looked at; there are {', '.join(self.protections)}")
        return list(self.protections).index(protection)


def _count(places: NDArray[np.int64], size: int) -> Counts:
    return np.bincount(places, minlength=size).astype(np.uint32)


@dataclass(frozen=True)
class JointSlice:
    """The smallest singular value over two joints, all others at rest.

    Attributes:
        joints: Names of the two.
        posture: Joint positions (n,) that the others have, rad or m.
        angles: Positions of each of the two (points,), rad or m.
        protections: Names.
        sigma: Smallest singular value of J_gt N_sub (P, points, points), m: by the first joint, then by the second.
    """

    joints: tuple[str, str]
    posture: Floats
    angles: tuple[Floats, Floats]
    protections: tuple[str, ...]
    sigma: Floats


def joint_slice(
    robot: Robot,
    posture: Floats,
    joints: tuple[str, str],
    protections: Sequence[str] = PROTECTIONS,
    points: int = 181,
) -> JointSlice:
    """Return the smallest singular value on a plane through joint space.

    Args:
        robot: The robot.
        posture: Joint positions (n,), rad or m, in the order of `robot.joint_names`.
        joints: Names of the two joints that move over their ranges.
        protections: Names.
        points: How many positions of each.

    Raises:
        InputError: no such joint, or one without a range.
    """
    two = as_items("joints", joints, "give the names of two")
    if len(two) != 2:
        raise InputError(f"joints is {shown(joints)}; give the names of two")
    i, j = (checked_robot(robot).joint_index(name) for name in two)
    points = as_whole("points", points, 2, most=MOST_POINTS)
    protections = as_items("protections", protections, "give a list, such as ['none', 'yaw']")
    posture = as_floats("posture", posture)
    if posture.shape != (robot.n_joints,) or not np.all(np.isfinite(posture)):
        raise InputError(f"posture is {shown(posture.tolist())}; it needs {robot.n_joints} finite numbers, one a joint")
    ranges = joint_ranges(robot)
    first, second = (np.linspace(low, high, points) for low, high in ranges[[i, j]])
    rows = np.tile(posture, (points * points, 1))
    rows[:, i], rows[:, j] = np.repeat(first, points), np.tile(second, points)
    sigma = Batch(robot).singular_values(rows, [Protection.parse(text) for text in protections])
    shaped = sigma.T.reshape(len(protections), points, points)
    return JointSlice(joints, posture, (first, second), tuple(protections), shaped)


def arm_joints(robot: Robot) -> list[str]:
    """Return the names of the joints from the base to the end-effector, then those of all others."""
    chain = checked_robot(robot).model.supports[robot.model.frames[robot.end_effector_id].parentJoint]
    names = [robot.joint_names[joint - 2] for joint in chain if joint > 1]
    return [*names, *(name for name in robot.joint_names if name not in names)]


def interval(shares: Floats, samples: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return a confidence interval of a share from those of independent blocks.

    Each scramble is an unbiased estimate of the share, and the scrambles are independent: their spread gives Student's
    interval of the mean, whatever the order that a low-discrepancy sequence brings into a block. Wilson's interval,
    which is for independent postures, would be too wide. It is taken where the blocks show no spread at all, because
    every posture is fit or none, and for a single block.

    Args:
        shares: Share of each block (blocks,).
        samples: Postures in all blocks together.
        confidence: How sure.

    Returns:
        Lower and upper end, within 0 and 1.
    """
    shares, samples = as_floats("shares", shares), as_whole("samples", samples)
    if shares.ndim != 1 or not shares.size or not np.all((shares >= 0.0) & (shares <= 1.0)):
        raise InputError(f"shares are {shown(shares.tolist())}; they need numbers from 0 to 1, one a block")
    mean, spread = float(np.mean(shares)), float(np.std(shares, ddof=1)) if len(shares) > 1 else 0.0
    if spread == 0.0:
        return wilson(round(mean * samples), samples, confidence)
    low, high = t.interval(confidence, len(shares) - 1, mean, spread / np.sqrt(len(shares)))
    return max(float(low), 0.0), min(float(high), 1.0)
