"""The constants of a robot as plain arrays, for compiled algebra that walks the tree itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Tree:
    """Bodies and joints of a Pinocchio model, in its order; body 0 is the base, joint i moves body i + 1.

    Attributes:
        parents: The body that holds each joint (n,).
        rotations: From each joint's frame at zero to that of the body that holds it (n, 3, 3).
        translations: Of its origin there (n, 3), m.
        axes: Of each joint, in its own frame (n, 3).
        slides: Which joints are prismatic (n,).
        masses: Of the bodies (n + 1,), kg.
        centres: Their centres of mass in the frame of their joint, of the base in its own (n + 1, 3), m.
        inertias: About the centres of mass, in the same axes (n + 1, 3, 3), kg m2.
    """

    parents: NDArray[np.int64]
    rotations: Floats
    translations: Floats
    axes: Floats
    slides: NDArray[np.bool_]
    masses: Floats
    centres: Floats
    inertias: Floats

    @classmethod
    def of(cls, model: pin.Model) -> Tree:
        """Read a model with a free-flyer root.

        Raises:
            InputError: a joint with more than one degree of freedom, which URDFs do not have.
        """
        joints = list(model.joints)[2:]
        for joint in joints:
            if joint.nv != 1:
                name = model.names[joint.id]
                raise InputError(f"joint '{name}' has {joint.nv} degrees of freedom; only 1 is supported")
        n = len(joints)
        lines = np.array([np.ravel(joint.createData().S) for joint in joints]).reshape(n, 6)
        slides = ~np.any(lines[:, 3:] != 0.0, axis=1)
        placements = [model.jointPlacements[joint.id] for joint in joints]
        bodies = list(model.inertias)[1:]
        return cls(
            parents=np.array([model.parents[joint.id] - 1 for joint in joints], dtype=np.int64),
            rotations=np.array([placement.rotation for placement in placements]).reshape(n, 3, 3),
            translations=np.array([placement.translation for placement in placements]).reshape(n, 3),
            axes=np.where(slides[:, None], lines[:, :3], lines[:, 3:]),
            slides=slides,
            masses=np.array([body.mass for body in bodies]),
            centres=np.array([body.lever for body in bodies]),
            inertias=np.array([body.inertia for body in bodies]),
        )
