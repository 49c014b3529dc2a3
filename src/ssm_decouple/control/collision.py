"""Clearances between bodies: their distances by Coal, and how fast joint rates change them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.errors import InputError, ModelError, as_items, as_not_negative, as_positive, shown
from ssm_decouple.model.folded import flat_collisions, has_many_fixed_links
from ssm_decouple.model.origin import from_base
from ssm_decouple.model.plain import parser_heard, pinocchio_text
from ssm_decouple.model.robot import Robot
from ssm_decouple.model.urdf import parse_urdf

Floats = NDArray[np.float64]
Pair = tuple[str, str]
# Coal's default of 1e-6 leaves the normal, and so the rates, three digits. Of how deep bodies are in each other it is
# left: there a smaller one fails.
TOLERANCE = 1e-8
NEARLY = 0.1  # m: corners and ends this much farther than the nearest points are looked at too
CLOSE = 0.5  # m beyond the clearance: pairs farther apart have no other row than that of their nearest points
POINT, EYE = coal.Sphere(0.0), np.eye(3)


@dataclass(frozen=True)
class Clearance:
    """Which bodies shall stay how far apart.

    Without `pairs` it is every pair of links that can move against each other, but those with one joint between them,
    which touch in any robot, and those in `ignored`.

    Attributes:
        distance: Least distance, m.
        horizon: Distance, m, beyond which a pair is left out of a step; None leaves none out. It must hold the way
            that the arm needs to brake.
        pairs: Pairs of link names, instead of all.
        ignored: Pairs of link names to leave out, such as shapes of a wrist that overlap.

    Raises:
        InputError: a negative distance, a horizon not beyond it, or pairs that are no pairs of names.
    """

    distance: float = 0.05
    horizon: float | None = None
    pairs: Sequence[Pair] | None = None
    ignored: Sequence[Pair] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "distance", as_not_negative("distance", self.distance))
        if self.horizon is not None:
            object.__setattr__(self, "horizon", as_positive("horizon", self.horizon))
            if not self.horizon > self.distance:
                raise InputError(f"horizon is {self.horizon} m; it must be beyond the distance {self.distance} m")
        object.__setattr__(self, "pairs", None if self.pairs is None else _pairs("pairs", self.pairs))
        object.__setattr__(self, "ignored", _pairs("ignored", self.ignored))


def _pairs(name: str, given: Sequence[Pair]) -> tuple[Pair, ...]:
    pairs = as_items(name, given, "it is a list of pairs of link names, such as [('bus', 'link_3')]")
    for pair in pairs:
        two = isinstance(pair, list | tuple) and len(pair) == 2
        if not two or not all(isinstance(link, str) for link in pair):
            raise InputError(f"{shown(pair)} is no pair of link names, such as ('bus', 'link_3')")
    return tuple((first, second) for first, second in pairs)


class Distances:
    """The distances between the bodies of a robot that shall stay apart, and their rates.

    Bodies are the collision shapes of the URDF; a mesh stands for its convex hull. Where faces or lines are parallel,
    the nearest points are not unique and the distance has a kink: the ends of what is parallel are looked at as well,
    each with a row of its own.

    Args:
        robot: The robot.
        clearance: Which pairs, how far apart.

    Attributes:
        names: The pairs of links, one a pair of shapes.

    Raises:
        InputError: the robot has no collision shapes on two bodies that move against each other, or a pair names no
            link that has one.
        ModelError: a mesh of the URDF cannot be read.
    """

    def __init__(self, robot: Robot, clearance: Clearance) -> None:
        self.robot = robot
        self.clearance = clearance
        self._geometry = _geometry(robot)
        shapes = self._geometry.geometryObjects
        links = [robot.model.frames[shape.parentFrame].name for shape in shapes]
        for pair in (*(clearance.pairs or ()), *clearance.ignored):
            for name in pair:
                if name not in links:
                    raise InputError(
                        f"link '{name}' of the pair {tuple(pair)} has no collision shape in '{robot.name}'; those with "
                        f"one: {', '.join(dict.fromkeys(links))}"
                    )
        chosen = list(self._chosen(links))
        if not chosen:
            raise InputError(
                f"'{robot.name}' has no two collision shapes that move against each other; give its URDF <collision> "
                "shapes, or the clearance other pairs"
            )
        for first, second in chosen:
            self._geometry.addCollisionPair(pin.CollisionPair(first, second))
        self.names: tuple[Pair, ...] = tuple((links[first], links[second]) for first, second in chosen)
        self._data = pin.Data(robot.model)
        self._results = self._geometry.createData()
        self._candidates = _Candidates.of(self._geometry)
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()
        self._request.gjk_tolerance = TOLERANCE
        for request in self._results.distanceRequests:
            request.gjk_tolerance = TOLERANCE
        n = robot.n_joints
        carried = np.zeros((robot.model.njoints, n))  # 1.0 where joint j carries body i
        for i, support in enumerate(robot.model.supports):
            carried[i, [joint - 2 for joint in support if joint > 1]] = 1.0
        joints = [shape.parentJoint for shape in shapes]
        self._carry_first: Floats = carried[[joints[first] for first, _ in chosen]]
        self._carry_second: Floats = carried[[joints[second] for _, second in chosen]]

    def _chosen(self, links: list[str]) -> Iterator[tuple[int, int]]:
        """Yield the pairs of shapes, by their places."""
        joints, parents = [shape.parentJoint for shape in self._geometry.geometryObjects], self.robot.model.parents
        wanted = None if self.clearance.pairs is None else {frozenset(pair) for pair in self.clearance.pairs}
        ignored = {frozenset(pair) for pair in self.clearance.ignored}
        for second in range(len(links)):
            for first in range(second):
                a, b, pair = joints[first], joints[second], frozenset((links[first], links[second]))
                if a == b or pair in ignored:
                    continue
                if pair in wanted if wanted is not None else a != parents[b] and b != parents[a]:
                    yield first, second

    def __call__(self, q: Floats) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Return rates of distances per joint rate (c, n), the distances (c,), m, and of which of `names` each is (c,).

        First those of all pairs, then those of ends. A distance is negative where bodies are in each other: how deep.

        Args:
            q: Configuration (nq,).
        """
        model, geometry, results, q = self.robot.model, self._geometry, self._results, from_base(q)
        J = pin.computeJointJacobians(model, self._data, q)[:, 6:]
        pin.updateGeometryPlacements(model, self._data, geometry, results)
        pin.computeDistances(geometry, results)
        near = _Nearest.of([(i, *_numbers(result)) for i, result in enumerate(results.distanceResults)])
        ends = self._ends(near)
        if ends:
            near = _Nearest.of([*zip(*near, strict=True), *ends])
        if self.clearance.horizon is not None:
            kept = near.distance < self.clearance.horizon
            near = _Nearest(
                near.pair[kept], near.distance[kept], near.normal[kept], near.first[kept], near.second[kept]
            )
        rows = _rates(J, near.normal, near.second, self._carry_second[near.pair])
        rows -= _rates(J, near.normal, near.first, self._carry_first[near.pair])
        return rows, near.distance, near.pair

    def _ends(self, near: _Nearest) -> list[tuple[int, float, Floats, Floats, Floats]]:
        """Return where else pairs are nearly as near as where they are nearest.

        Whatever is far from the plane through the other's nearest point, or from the box about the other, is not.
        """
        ends, placements = self._candidates, self._results.oMg
        R = np.array([placement.rotation for placement in placements])
        t = np.array([placement.translation for placement in placements])
        own, other = (near.first, near.second), (near.second, near.first)
        first = ends.sign[:, None] > 0.0
        mine, theirs = (np.where(first, both[0][ends.pair], both[1][ends.pair]) for both in (own, other))
        towards, axes = near.normal[ends.pair] * ends.sign[:, None], R[ends.own][:, :, 2]
        across = towards - np.sum(towards * axes, axis=1)[:, None] * axes
        across *= (ends.radius / np.maximum(np.linalg.norm(across, axis=1), 1e-9))[:, None]
        points = np.einsum("cij,cj->ci", R[ends.own], ends.point) + t[ends.own] + across
        local = np.einsum("cji,cj->ci", R[ends.other], points - t[ends.other]) - ends.centre
        apart = np.linalg.norm(np.maximum(np.abs(local) - ends.half, 0.0), axis=1)
        least, distance = np.maximum(np.sum(towards * (theirs - points), axis=1), apart), near.distance[ends.pair]
        close = (distance > 0.0) & (distance < self.clearance.distance + CLOSE) & (least < distance + NEARLY)
        close &= np.max(np.abs(points - mine), axis=1) > 1e-3  # the nearest point itself has its row
        found, request, result = [], self._request, self._result
        for c in np.flatnonzero(close):
            placement = placements[int(ends.other[c])]
            there = coal.Transform3s(placement.rotation, placement.translation)
            shape = self._geometry.geometryObjects[int(ends.other[c])].geometry
            result.clear()
            coal.distance(POINT, coal.Transform3s(EYE, points[c]), shape, there, request, result)
            apart_by, normal, *both = _numbers(result)
            if 0.0 < apart_by < distance[c] + NEARLY:
                both = both if ends.sign[c] > 0.0 else both[::-1]
                found.append((int(ends.pair[c]), apart_by, ends.sign[c] * normal, both[0], both[1]))
        return found

    def refuse_overlaps(self, q: Floats) -> None:
        """Raise if two bodies are in each other at q.

        Raises:
            InputError: the message names them and says how deep.
        """
        near = from_base(self.robot.checked(q))
        pin.updateGeometryPlacements(self.robot.model, self._data, self._geometry, self._results, near)
        pin.computeDistances(self._geometry, self._results)
        for pair, result in zip(self.names, self._results.distanceResults, strict=True):
            if result.min_distance < 0.0:
                raise InputError(
                    f"'{pair[0]}' and '{pair[1]}' of '{self.robot.name}' are {-result.min_distance:.3g} m in each "
                    "other; start elsewhere, or put the pair in `ignored` if its shapes always overlap"
                )


class _Nearest(NamedTuple):
    """Where pairs are near: of each the pair, the distance, the normal from first to second, a point on either."""

    pair: NDArray[np.int64]
    distance: Floats
    normal: Floats
    first: Floats
    second: Floats

    @classmethod
    def of(cls, found: list[tuple[int, float, Floats, Floats, Floats]]) -> _Nearest:
        """Collect them."""
        pair, *others = zip(*found, strict=True)
        return cls(np.array(pair, dtype=np.int64), *(np.array(values) for values in others))


def _numbers(result: coal.DistanceResult) -> tuple[float, Floats, Floats, Floats]:
    """Return distance, normal and nearest points of Coal's result; later ones do not change them."""
    return (
        result.min_distance,
        np.array(result.normal),
        np.array(result.getNearestPoint1()),
        np.array(result.getNearestPoint2()),
    )


@dataclass(frozen=True)
class _Candidates:
    """Corners of boxes and ends of cylinders and capsules, one entry for each pair that one belongs to."""

    pair: NDArray[np.int64]
    sign: Floats  # 1.0 where it is on the pair's first shape, -1.0 on the second
    own: NDArray[np.int64]  # the shape that it is on
    other: NDArray[np.int64]
    point: Floats  # (c, 3) in that shape's frame
    radius: Floats  # of the rim about it, from which the point that faces the other is taken
    centre: Floats  # (c, 3) of a box about the other, in the other's frame
    half: Floats  # (c, 3) half its edges

    @classmethod
    def of(cls, geometry: pin.GeometryModel) -> _Candidates:
        """Collect those of all collision pairs."""
        shapes = [shape.geometry for shape in geometry.geometryObjects]
        boxes = []
        for shape in shapes:
            shape.computeLocalAABB()
            low, high = shape.aabb_local.min_, shape.aabb_local.max_
            boxes.append((0.5 * (low + high), 0.5 * (high - low)))
        found = []
        for i, pair in enumerate(geometry.collisionPairs):
            for own, other, sign in ((pair.first, pair.second, 1.0), (pair.second, pair.first, -1.0)):
                points, radius = _corners(shapes[own])
                found += [(i, sign, own, other, point, radius, *boxes[other]) for point in points]
        columns = list(zip(*found, strict=True)) if found else [()] * 8
        pair, own, other = (np.array(columns[c], dtype=np.int64) for c in (0, 2, 3))
        point, centre, half = (np.array(columns[c], dtype=float).reshape(-1, 3) for c in (4, 6, 7))
        return cls(pair, np.array(columns[1]), own, other, point, np.array(columns[5]), centre, half)


def _corners(shape: Any) -> tuple[Floats, float]:
    """Return corners (c, 3) of a box, or the centres of a cylinder's or a capsule's ends and its radius."""
    if isinstance(shape, coal.Box):
        return np.array(list(product((-1.0, 1.0), repeat=3))) * shape.halfSide, 0.0
    if isinstance(shape, coal.Cylinder | coal.Capsule):
        return np.array([[0.0, 0.0, shape.halfLength], [0.0, 0.0, -shape.halfLength]]), shape.radius
    return np.empty((0, 3)), 0.0


def _rates(J: Floats, normals: Floats, points: Floats, carried: Floats) -> Floats:
    """Return how fast points (c, 3) go along normals (c, 3) per joint rate (c, n), J (6, n) being at the origin."""
    return (normals @ J[:3] + np.cross(points, normals) @ J[3:]) * carried


def _geometry(robot: Robot) -> pin.GeometryModel:
    root = parse_urdf(robot.urdf, robot.name)
    text = flat_collisions(root) if has_many_fixed_links(root) else pinocchio_text(root, shapes="collision")
    said: list[str] = []
    try:
        with parser_heard(said):
            geometry = pin.buildGeomFromUrdfString(robot.model, text, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        why = "; ".join([*said, " ".join(str(error).split())])
        raise ModelError(
            f"robot '{robot.name}': a collision shape cannot be read; give its mesh a full path, or name the folder of "
            f"its package in ROS_PACKAGE_PATH: {why}"
        ) from error
    for shape in geometry.geometryObjects:
        if hasattr(shape.geometry, "buildConvexRepresentation"):
            shape.geometry.buildConvexRepresentation(False)
            shape.geometry = shape.geometry.convex
    return geometry
