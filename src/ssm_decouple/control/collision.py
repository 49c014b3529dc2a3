"""Clearances between bodies: their distances by Coal, and how fast joint rates change them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.errors import InputError, ModelError, as_not_negative, as_positive
from ssm_decouple.model.robot import Robot

Floats = NDArray[np.float64]
Pair = tuple[str, str]
# Coal's default of 1e-6 leaves the normal, and so the rates, three digits. Of how deep bodies are in each other it is
# left: there a smaller one fails.
TOLERANCE = 1e-8
NEARLY = 0.1
NEARLY_PARALLEL_BELOW = 0.5
POINT = coal.Sphere(0.0)
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


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
        as_not_negative("distance", self.distance)
        if self.horizon is not None and not as_positive("horizon", self.horizon) > self.distance:
            raise InputError(f"horizon is {self.horizon} m; it must be beyond the distance {self.distance} m")
        for pair in (*(self.pairs or ()), *self.ignored):
            if isinstance(pair, str) or len(pair) != 2 or not all(isinstance(name, str) for name in pair):
                raise InputError(f"{pair!r} is no pair of link names, such as ('bus', 'link_3')")


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
                        f"link '{name}' of the pair {tuple(pair)} has no collision shape in '{robot.name}'; those with one: "
                        f"{', '.join(dict.fromkeys(links))}"
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
        self._data = robot.model.createData()
        self._results = self._geometry.createData()
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
        shapes, parents = self._geometry.geometryObjects, self.robot.model.parents
        wanted = None if self.clearance.pairs is None else {frozenset(pair) for pair in self.clearance.pairs}
        ignored = {frozenset(pair) for pair in self.clearance.ignored}
        for second in range(len(shapes)):
            for first in range(second):
                pair, (a, b) = (
                    frozenset((links[first], links[second])),
                    (
                        shapes[first].parentJoint,
                        shapes[second].parentJoint,
                    ),
                )
                if a == b or pair in ignored:
                    continue
                if pair in wanted if wanted is not None else a not in (b, parents[b]) and b != parents[a]:
                    yield first, second

    def __call__(self, q: Floats) -> tuple[Floats, Floats]:
        """Return the rates of the distances per joint rate (c, n) and the distances (c,), m.

        A distance is negative where bodies are in each other: how deep.

        Args:
            q: Configuration (nq,).
        """
        model, geometry, results = self.robot.model, self._geometry, self._results
        J = pin.computeJointJacobians(model, self._data, q)[:, 6:]
        pin.updateGeometryPlacements(model, self._data, geometry, results)
        pin.computeDistances(geometry, results)
        found = results.distanceResults
        distances = np.array([result.min_distance for result in found])
        normals = np.array([result.normal for result in found])
        first = np.array([result.getNearestPoint1() for result in found])
        second = np.array([result.getNearestPoint2() for result in found])
        sides = [np.arange(len(found))]
        ends = self._ends(distances, normals)
        if ends:
            sides.append(np.array([end[0] for end in ends]))
            distances = np.r_[distances, [end[1] for end in ends]]
            normals, first, second = (
                np.vstack([values, [end[i] for end in ends]]) for i, values in ((2, normals), (3, first), (4, second))
            )
        pairs = np.concatenate(sides)
        rows = _rates(J, normals, second, self._carry_second[pairs]) - _rates(
            J, normals, first, self._carry_first[pairs]
        )
        if self.clearance.horizon is not None:
            near = distances < self.clearance.horizon
            return np.ascontiguousarray(rows[near]), distances[near]
        return rows, distances

    def _ends(self, distances: Floats, normals: Floats) -> list[tuple[int, float, Floats, Floats, Floats]]:
        """Return where else pairs are nearly as near: of each the pair, the distance, the normal and two points."""
        found, shapes, placements = [], self._geometry.geometryObjects, self._results.oMg
        for i, pair in enumerate(self._geometry.collisionPairs):
            if not 0.0 < distances[i] < NEARLY_PARALLEL_BELOW:
                continue
            for own, other, normal in ((pair.first, pair.second, normals[i]), (pair.second, pair.first, -normals[i])):
                for point in _facing(shapes[own].geometry, placements[own], normal):
                    if normal @ point < (normal @ placements[own].translation) - 1e9:
                        continue
                    self._result.clear()
                    at = coal.Transform3s(np.eye(3), point)
                    there = coal.Transform3s(placements[other].rotation, placements[other].translation)
                    distance = coal.distance(POINT, at, shapes[other].geometry, there, self._request, self._result)
                    if distance > distances[i] + NEARLY or distance <= 0.0:
                        continue
                    near, far = self._result.getNearestPoint1(), self._result.getNearestPoint2()
                    if own == pair.first:
                        found.append((i, distance, self._result.normal.copy(), near.copy(), far.copy()))
                    else:
                        found.append((i, distance, -self._result.normal, far.copy(), near.copy()))
        return found

    def refuse_overlaps(self, q: Floats) -> None:
        """Raise if two bodies are in each other at q.

        Raises:
            InputError: the message names them and says how deep.
        """
        pin.updateGeometryPlacements(self.robot.model, self._data, self._geometry, self._results, self.robot.checked(q))
        pin.computeDistances(self._geometry, self._results)
        for pair, result in zip(self.names, self._results.distanceResults, strict=True):
            if result.min_distance < 0.0:
                raise InputError(
                    f"'{pair[0]}' and '{pair[1]}' of '{self.robot.name}' are {-result.min_distance:.3g} m in each other; "
                    "start elsewhere, or put the pair in `ignored` if its shapes always overlap"
                )


def _facing(shape: object, placement: pin.SE3, normal: Floats) -> Floats:
    """Return the corners (c, 3) of a box, or the ends of a cylinder, that face along the normal."""
    R = placement.rotation
    towards = R.T @ normal
    if isinstance(shape, coal.Box):
        signs = CORNERS[CORNERS @ (shape.halfSide * towards) > 0.0] if True else CORNERS
        corners = signs * shape.halfSide
    elif isinstance(shape, coal.Cylinder):
        across = np.array([towards[0], towards[1], 0.0])
        length = np.linalg.norm(across)
        across *= shape.radius / length if length > 1e-9 else 0.0
        corners = np.array([across + [0.0, 0.0, shape.halfLength], across - [0.0, 0.0, shape.halfLength]])
    else:
        return np.empty((0, 3))
    return corners @ R.T + placement.translation


def _rates(J: Floats, normals: Floats, points: Floats, carried: Floats) -> Floats:
    """Return how fast points (c, 3) go along normals (c, 3) per joint rate (c, n), J (6, n) being at the origin."""
    return (normals @ J[:3] + np.cross(points, normals) @ J[3:]) * carried


def _geometry(robot: Robot) -> pin.GeometryModel:
    try:
        geometry = pin.buildGeomFromUrdfString(robot.model, robot.urdf, pin.GeometryType.COLLISION)
    except (ValueError, RuntimeError) as error:
        raise ModelError(
            f"robot '{robot.name}': a collision shape cannot be read: {error}; a mesh needs its full path, or its package "
            "in ROS_PACKAGE_PATH"
        ) from error
    for shape in geometry.geometryObjects:
        if hasattr(shape.geometry, "buildConvexRepresentation"):
            shape.geometry.buildConvexRepresentation(False)
            shape.geometry = shape.geometry.convex
    return geometry
