"""What a URDF says, read a second time: by the DOM, with homogeneous matrices, one link after the other."""

from __future__ import annotations

import re
from xml.dom import minidom

import numpy as np
from scipy.spatial.transform import Rotation

NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(inf|infinity)", re.IGNORECASE)
MOVING = ("revolute", "continuous", "prismatic")


def number(text: str) -> float:
    assert NUMBER.fullmatch(text.strip()), text
    return float(text)


def numbers(text: str) -> np.ndarray:
    return np.array([number(word) for word in text.split()])


def children(element, tag: str) -> list:
    return [node for node in element.childNodes if node.nodeType == node.ELEMENT_NODE and node.localName == tag]


def child(element, tag: str):
    found = children(element, tag)
    assert len(found) <= 1, f"{len(found)} <{tag}>"
    return found[0] if found else None


def value(element, tag: str, key: str, default: float | None = None) -> float:
    found = child(element, tag)
    if found is None or not found.hasAttribute(key):
        assert default is not None, f"no {tag} {key}"
        return default
    return number(found.getAttribute(key))


def pose(element) -> np.ndarray:
    """Return the homogeneous matrix of an element's <origin>."""
    T, origin = np.eye(4), child(element, "origin")
    if origin is not None:
        if origin.hasAttribute("xyz"):
            T[:3, 3] = numbers(origin.getAttribute("xyz"))
        if origin.hasAttribute("rpy"):
            T[:3, :3] = Rotation.from_euler("xyz", numbers(origin.getAttribute("rpy"))).as_matrix()
        if origin.hasAttribute("quat_xyzw"):
            T[:3, :3] = Rotation.from_quat(numbers(origin.getAttribute("quat_xyzw"))).as_matrix()
    return T


class Said:
    """Bodies and moving joints of URDF text; `world` links above a floating joint left out."""

    def __init__(self, text: str) -> None:
        without = re.sub(r"^\ufeff?(<\?xml[^>]*\?>)?", "", text)  # text has no encoding of its own
        robot = minidom.parseString(without.encode()).documentElement
        self.links = {link.getAttribute("name"): link for link in children(robot, "link")}
        self.above = {child(joint, "child").getAttribute("link"): joint for joint in children(robot, "joint")}
        roots = [name for name in self.links if name not in self.above]
        floating = [name for name, joint in self.above.items() if joint.getAttribute("type") == "floating"]
        self.root = floating[0] if floating else roots[0]
        self.joints: dict[str, dict] = {}
        self.bodies: dict[str | None, list] = {None: []}  # by the joint that moves them: masses, centres, inertias
        self.frames: dict[str, tuple[str | None, np.ndarray]] = {}
        self._walk(self.root, None, np.eye(4))

    def _walk(self, root: str, body: str | None, place: np.ndarray) -> None:
        waiting = [(root, body, place)]
        while waiting:
            name, body, T = waiting.pop()
            self.frames[name] = (body, T)
            inertial = child(self.links[name], "inertial")
            if inertial is not None:
                self.bodies[body].append(self._weigh(inertial, T))
            for below, joint in self.above.items():
                if child(joint, "parent").getAttribute("link") == name:
                    waiting.append((below, *self._step(joint, body, T @ pose(joint))))

    def _step(self, joint, body: str | None, T: np.ndarray) -> tuple[str | None, np.ndarray]:
        kind, name = joint.getAttribute("type"), joint.getAttribute("name")
        if kind not in MOVING:
            return body, T
        axis = child(joint, "axis")
        direction = np.array([1.0, 0, 0]) if axis is None else numbers(axis.getAttribute("xyz"))
        direction = direction / np.abs(direction).max()
        limit = child(joint, "limit")
        ends = [] if limit is None else [key for key in ("lower", "upper") if limit.hasAttribute(key)]
        free = kind == "continuous" or not ends
        self.joints[name] = {
            "kind": kind,
            "holder": body,
            "place": T,
            "axis": direction / np.linalg.norm(direction),
            "lower": -np.inf if free else value(joint, "limit", "lower", 0.0),
            "upper": np.inf if free else value(joint, "limit", "upper", 0.0),
            "velocity": value(joint, "limit", "velocity", np.inf),
            "effort": value(joint, "limit", "effort", np.inf),
        }
        self.bodies[name] = []
        return name, np.eye(4)

    def _weigh(self, inertial, T: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        xx, xy, xz, yy, yz, zz = (value(inertial, "inertia", f"i{k}") for k in ("xx", "xy", "xz", "yy", "yz", "zz"))
        placed = T @ pose(inertial)
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        R = placed[:3, :3]
        return value(inertial, "mass", "value"), placed[:3, 3], R @ tensor @ R.T

    def body(self, joint: str | None) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass, centre and inertia about it of all that a joint moves, in its frame; None is the base."""
        parts = self.bodies[joint]
        mass = sum(part[0] for part in parts)
        if mass == 0:
            return 0.0, np.zeros(3), sum((part[2] for part in parts), np.zeros((3, 3)))
        centre = sum(part[0] * part[1] for part in parts) / mass
        inertia = np.zeros((3, 3))
        for own, at, tensor in parts:
            arm = at - centre
            inertia += tensor + own * (arm @ arm * np.eye(3) - np.outer(arm, arm))
        return mass, centre, inertia


def assert_holds(robot, text: str, rtol: float = 1e-12) -> None:
    """Assert that a robot's model is what the text says."""
    said, model = Said(text), robot.model
    assert set(model.names[2:]) == set(said.joints)
    index = {None: 1} | {name: i + 2 for i, name in enumerate(model.names[2:])}
    size = 1.0 + max((np.abs(T[:3, 3]).max() for _, T in said.frames.values()), default=0.0)
    for name, i in index.items():
        mass, centre, inertia = said.body(name)
        held = model.inertias[i]
        assert held.mass == _near(mass, rtol * mass), f"mass at {name}"
        if mass > 0:
            assert np.abs(held.lever - centre).max() <= rtol * (size + np.abs(centre).max()), f"centre at {name}"
            scale = np.abs(inertia).max() + mass * size**2 * 1e-2 + sum(np.abs(p[2]).max() for p in said.bodies[name])
            assert np.abs(held.inertia - inertia).max() <= rtol * scale, f"inertia at {name}"
    for name, joint in said.joints.items():
        i = index[name]
        assert model.parents[i] == index[joint["holder"]], f"parent of {name}"
        place, moving = model.jointPlacements[i].homogeneous, model.joints[i]
        assert np.abs(place[:3, :3] - joint["place"][:3, :3]).max() <= rtol, f"rotation of {name}"
        assert np.abs(place[:3, 3] - joint["place"][:3, 3]).max() <= rtol * size, f"position of {name}"
        motion = np.ravel(moving.createData().S)
        axis = motion[:3] if joint["kind"] == "prismatic" else motion[3:]
        assert np.abs(axis - joint["axis"]).max() <= rtol, f"axis of {name}"
        assert abs(np.linalg.norm(motion) - 1) <= rtol
        assert (moving.nq == 2) == (joint["kind"] == "continuous")
        place = robot.joint_index(name)
        assert tuple(robot.position_limits[place]) == (_cut(joint["lower"]), _cut(joint["upper"])), f"limits of {name}"
        rate = _cut(joint["velocity"])
        assert robot.rate_limits[place] == (rate if rate > 0 else np.inf), f"rate of {name}"
        assert _cut(model.effortLimit[moving.idx_v]) == _cut(joint["effort"]), f"effort of {name}"
    for name, (body, T) in said.frames.items():
        frame = model.frames[robot.frame_id(name)]
        assert frame.parentJoint == index[body], f"frame {name}"
        assert np.abs(frame.placement.homogeneous - T).max() <= rtol * size, f"frame {name}"


def _cut(limit: float) -> float:
    return float(limit) if abs(limit) < 1e300 else float(np.copysign(np.inf, limit))


def _near(wanted: float, tolerance: float):
    import pytest

    return pytest.approx(wanted, rel=0, abs=tolerance)
