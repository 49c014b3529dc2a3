"""Joints that move no inertia, and roots without mass: harmless to motions of given rates, impossible under torques."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import scipy.linalg
from numpy.typing import NDArray

from ssm_decouple.errors import ModelError
from ssm_decouple.model.urdf import Finding

Floats = NDArray[np.float64]

# Below this share of what a joint carries, its own inertia is rounding.
NEARLY = 1e-12


def massless_root(model: pin.Model) -> list[Finding]:
    """Say so where joints move all the mass that there is, and the root link has none."""
    if model.njoints == 2 or model.inertias[1].mass > 0:
        return []
    message = (
        "the root link has no mass: put the arm on a bus with compose, or give it an <inertial>; a dynamic simulation "
        "is refused"
    )
    return [Finding("suspicious", f"link {_moved(model, 1)}", message)]


def massless_joints(model: pin.Model, data: pin.Data | None = None) -> list[Finding]:
    """Say which joints carry links without inertia about their axis, or without mass along it.

    Args:
        model: With a free-flyer root.
        data: To compute on; None makes one.
    """
    data = pin.Data(model) if data is None else data
    pin.crba(model, data, pin.neutral(model), pin.Convention.LOCAL)
    found = []
    for joint in range(2, model.njoints):
        if not _own(model, data, joint) > NEARLY * _carried(model, data, joint):
            message = (
                f"moves '{_moved(model, joint)}' without {_lacking(model, joint)}: a dynamic simulation is refused, "
                "motions of given joint rates are not"
            )
            found.append(Finding("suspicious", f"joint {model.names[joint]}", message))
    return found


def refuse_singular_mass_matrix(model: pin.Model, q: Floats, name: str, free: NDArray[np.int64] | None = None) -> None:
    """Refuse a robot whose mass matrix is singular at a configuration, so that torques do not determine its motion.

    The rows are eliminated from the tips to the base, as in the articulated-body algorithm (Featherstone, Rigid Body
    Dynamics Algorithms, 2008, section 7.3): what remains of a joint's diagonal entry is the inertia that its drive
    feels while all beyond it gives way.

    Args:
        model: With a free-flyer root.
        q: Configuration (nq,).
        name: What messages call it.
        free: The velocities, the base's six first, that forces determine; None is all of them.

    Raises:
        ModelError: it is, up to rounding; the message names the joint and its link, or the root link.
    """
    data = pin.Data(model)
    upper = np.triu(pin.crba(model, data, q, pin.Convention.LOCAL))
    places = np.arange(model.nv) if free is None else np.asarray(free)
    M = (upper + np.triu(upper, 1).T)[np.ix_(places, places)]
    whole = M[:6, :6].copy()
    joints = {int(model.joints[joint].idx_v): joint for joint in range(2, model.njoints)}
    for row in range(len(M) - 1, 5, -1):
        joint = joints[int(places[row])]
        if not M[row, row] > NEARLY * _carried(model, data, joint):
            raise ModelError(
                f"'{name}' cannot be simulated dynamically: joint '{model.names[joint]}' moves "
                f"'{_moved(model, joint)}' without {_lacking(model, joint)}, so any torque makes it infinitely fast; "
                f"give the link an <inertial>, or fix the joint with robot.with_locked({{'{model.names[joint]}': 0.0}})"
            )
        M[:row, :row] -= np.outer(M[:row, row], M[row, :row] / M[row, row])
    smallest = float(scipy.linalg.eigh(M[:6, :6], whole, eigvals_only=True)[0])
    if not smallest > NEARLY:
        raise ModelError(
            f"'{name}' cannot be simulated dynamically: its root link '{_moved(model, 1)}' has no inertia of its own "
            "that holds it where its joints turn; give the root link an <inertial>, or put the arm on a bus with "
            "compose"
        )


def _own(model: pin.Model, data: pin.Data, joint: int) -> float:
    """Return the inertia of all that a joint carries about its axis, or the mass along it."""
    S = np.ravel(model.joints[joint].createData().S)
    return float(S @ data.Ycrb[joint].matrix() @ S)


def _carried(model: pin.Model, data: pin.Data, joint: int) -> float:
    """Return what such an inertia or mass is measured by: the inertia of the same bodies about any axis there."""
    body = data.Ycrb[joint]
    if _slides(model, joint):
        return float(body.mass)
    return float(np.trace(body.inertia) + body.mass * body.lever @ body.lever)


def _slides(model: pin.Model, joint: int) -> bool:
    return not np.any(np.ravel(model.joints[joint].createData().S)[3:])


def _lacking(model: pin.Model, joint: int) -> str:
    return "mass" if _slides(model, joint) else "inertia about its axis"


def _moved(model: pin.Model, joint: int) -> str:
    """Return the link that a joint moves, of the root joint the root link."""
    return next(f.name for f in model.frames if f.parentJoint == joint and f.type == pin.FrameType.BODY)
