"""The protected subspace U_c: the directions in which the base must not move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import InputError, as_floats, as_kind, as_text, shown
from ssm_decouple.settled import Settled, fixed_array

if TYPE_CHECKING:
    from ssm_decouple.momentum.coupling import Coupling

Floats = NDArray[np.float64]

AXES = {"roll": (1.0, 0.0, 0.0), "pitch": (0.0, 1.0, 0.0), "yaw": (0.0, 0.0, 1.0)}
NAMES = ("none", *AXES, "all")
TWIST = ("x", "y", "z", *AXES)  # the rows of a base twist
TOLERANCE = 1e-3  # how far from orthonormal the given axes may be
DEPENDENT = 1e-9  # singular value, against the largest, below which unit vectors count as dependent


class Protection(Settled):
    """The protected subspace: no base motion along the columns of U_c (paper, eq. 5, and its like for the whole twist).

    Columns of three numbers are directions about which the base must not turn, as in the paper. Columns of six act on
    the base twist [linear; angular] of the base origin. They may mix m/s and rad/s, so that "orthonormal" has no
    meaning in physics for them; the null space of J_sub depends on their span alone, not on the basis.

    Args:
        axes: A direction (3,), columns (3, k) with k up to 3, a twist (6,), columns (6, k) with k up to 6, or a name:
            "none" (k = 0), "roll", "pitch", "yaw", several joined by "+", or "all" (k = 3, reactionless). They must be
            orthonormal within 1e-3; they are made orthonormal to machine precision by the smallest possible change.
        frame: The axes in which the directions stay fixed: "base" (the paper's), "inertial", or any frame of the robot,
            such as an antenna on a joint of its own. They turn the linear and the angular part alike; what must not
            move is the base, and the point its origin, in all of them.

    Attributes:
        U_c: Orthonormal columns (3, k) or (6, k), as given, read-only.
        U_twist: The same on the whole base twist (6, k), read-only: of rotations, U_c below three rows of zeros.
        k: Number of protected directions.
        frame: As given.
        correction: Largest angle, rad, between a given direction and the one used. Scaling to unit length turns
            nothing, so a single direction has 0.

    Raises:
        InputError: a zero, non-unit, non-finite or dependent direction, too many, or an unknown name.

    Example:
        >>> Protection([0.5, 0, 0.866]).describe()
        'k = 1, base axes: (0.500011, 0, 0.866019), 30.0007 deg from yaw'
    """

    def __init__(self, axes: ArrayLike | str, frame: str = "base") -> None:
        if not (isinstance(frame, str) and frame.strip()):
            raise InputError(f"frame is 'base', 'inertial' or the name of a frame of the robot, not {shown(frame)}")
        given = _named(axes) if isinstance(axes, str) else _columns(axes)
        _refuse_far_from_orthonormal(given)
        self.frame: str = frame
        self.U_c: Floats = fixed_array(_nearest_orthonormal(given))
        self.k: int = self.U_c.shape[1]
        self.U_twist: Floats = fixed_array(np.vstack([np.zeros((6 - len(self.U_c), self.k)), self.U_c]))
        self.correction: float = max(map(_angle, given.T, self.U_c.T), default=0.0)

    @classmethod
    def boresight(cls, direction: ArrayLike, frame: str = "base") -> Protection:
        """Protect a line of sight: the two directions across it, so that the base may only turn about it.

        Args:
            direction: Where the instrument looks (3,), any length.
            frame: The axes in which it is fixed.

        Raises:
            InputError: the direction is zero or not finite.
        """
        line = as_floats("boresight", direction)
        length = float(np.linalg.norm(line)) if line.shape == (3,) else 0.0
        if not (np.isfinite(length) and length > 0):
            raise InputError(f"a boresight needs 3 finite numbers that are not all zero, not {shown(direction)}")
        across = np.linalg.svd(line[None] / length)[2][1:]
        return cls(across.T, frame)

    @classmethod
    def from_modes(cls, participation: ArrayLike, frame: str = "base") -> Protection:
        """Protect what excites flexible appendages: the span of their modes' participation vectors.

        Mode j is excited by participation_j . (base acceleration), so a base twist that stays orthogonal to every
        vector excites none. The vectors are scaled to unit length, and an orthonormal basis of their span is taken by
        singular value decomposition. It mixes m/s and rad/s, and so do `Command.protected_rate` and its like: the null
        space, and with it the motion, does not depend on the choice of basis, those numbers do.

        Args:
            participation: One vector (6,) or columns (6, m): [linear; angular], about the base origin in base axes,
                of any length. Vectors that depend on the others (within 1e-9 once of unit length) and vectors of
                zeros, whose mode the base cannot excite, add nothing.
            frame: The axes in which they stay fixed: "base" for appendages.

        Raises:
            InputError: not of this shape, not finite, or nothing but zeros.
        """
        try:
            given = as_floats("participation", participation)
        except InputError:
            raise InputError(
                f"participation vectors cannot be read as numbers: {shown(participation)}; give modes.participation"
            ) from None
        columns = given[:, None] if given.ndim == 1 else given
        if columns.ndim != 2 or columns.shape[0] != 6:
            raise InputError(
                f"participation has shape {given.shape}, it needs (6,) or (6, m): a column [linear; angular] a mode"
            )
        if not np.all(np.isfinite(columns)):
            raise InputError(f"participation is not finite: {shown(given.tolist())}")
        largest = np.abs(columns).max(axis=0, initial=0.0)
        if not np.any(largest > 0):
            raise InputError("participation is all zeros: the base excites no such mode; use 'none' to protect nothing")
        columns = columns[:, largest > 0] / largest[largest > 0]
        basis, singular, _ = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), full_matrices=False)
        return cls(basis[:, singular > DEPENDENT * singular[0]], frame)

    @classmethod
    def parse(cls, text: str) -> Protection:
        """Read a protection from one word: a name, or numbers such as "0.5,0,0.866" or "1,0,0;0,0,1".

        Give three numbers a direction or six a twist. Put ";" between directions and "@inertial" or "@" and the name of
        a frame of the robot behind them where they are not fixed in base axes.

        Raises:
            InputError: as for the class, or the text cannot be read.
        """
        body, at, frame = as_text("protection", text, f"give {_HELP}").strip().partition("@")
        if (at and not frame.strip()) or "@" in frame:
            raise InputError(f"cannot read the protection '{text}': behind one '@' stands the name of a frame")
        if any(letter.isalpha() for letter in body.replace("e", "").replace("nan", "").replace("inf", "")):
            return cls(body, frame or "base")
        try:
            rows = [[float(word) for word in row.split(",")] for row in body.split(";")]
            columns = np.array(rows).T
        except ValueError:
            raise InputError(f"cannot read the protection {shown(text)}: {_HELP}") from None
        return cls(columns, frame or "base")

    def __repr__(self) -> str:
        return f"Protection({self.U_c.T.tolist()}, frame={self.frame!r})"

    def describe(self) -> str:
        """Say k, the frame and each direction with its angle from the nearest base axis."""
        if self.k == 0:
            return "k = 0: nothing is protected"
        words = []
        for column in self.U_c.T:
            listed = ", ".join(f"{0.0 if abs(x) < 1e-15 else x:.6g}" for x in column)
            name, angle = _nearest_axis(column)
            words.append(
                f"({listed}), {name}" if angle < 1e-12 else f"({listed}), {np.rad2deg(angle):.4f} deg from {name}"
            )
        turned = f"; turned by up to {np.rad2deg(self.correction):.2g} deg" if self.correction > 1e-12 else ""
        return f"k = {self.k}, {self.frame} axes: {'; '.join(words)}{turned}"

    def U_c_in(self, coupling: Coupling) -> Floats:
        """Return U_c, (3, k) or (6, k) as it was given, in the axes of the coupling's matrices.

        Raises:
            InputError: it is no coupling.
        """
        if self.frame == _checked_coupling(coupling).frame:
            return self.U_c
        R = coupling.rotation_of(self.frame)
        return np.vstack([R @ part for part in np.split(self.U_c, len(self.U_c) // 3)])

    def J_sub(self, coupling: Coupling) -> Floats:
        """Return the sub-coupling matrix (k, n): U_c^T J_rc, rad/s per joint rate (paper, eq. 7), or U_c^T J_base."""
        return self.U_c_in(coupling).T @ self._map(coupling)

    def null_space_basis(self, coupling: Coupling) -> Floats:
        """Return orthonormal columns Z (n, n - rank J_sub) that span null(J_sub)."""
        J_sub = self.J_sub(coupling)
        n = J_sub.shape[1]
        if self.k == 0:
            return np.eye(n)
        _, singular, rows = np.linalg.svd(J_sub)
        # Below the rounding of J_rc or J_base a row is no constraint.
        rank = int(np.sum(singular > 16 * np.finfo(float).eps * np.linalg.norm(self._map(coupling))))
        return rows[rank:].T

    def N_sub(self, coupling: Coupling) -> Floats:
        """Return the projector N_sub = I - J_sub^+ J_sub on null(J_sub) (n, n)."""
        Z = self.null_space_basis(coupling)
        return Z @ Z.T

    def _map(self, coupling: Coupling) -> Floats:
        return coupling.J_rc if len(self.U_c) == 3 else coupling.J_base


def _checked_coupling(coupling: Coupling) -> Coupling:
    from ssm_decouple.momentum.coupling import Coupling

    return as_kind("coupling", coupling, Coupling, "give what robot.coupling(q) returns")


def checked_protection(protection: Protection) -> Protection:
    """Return a protection.

    Raises:
        InputError: it is none; the message says how one is made.
    """
    known = isinstance(protection, str) and all(word in NAMES for word in protection.split("+"))
    such = protection if known else "yaw"
    return as_kind("protection", protection, Protection, f"give a Protection: Protection('{such}')")


_HELP = (
    f"a name ({', '.join(NAMES)}, or several joined by '+') or numbers, '0.5,0,0.866' or '1,0,0;0,0,1', three a "
    "rotation or six a twist"
)


def _named(name: str) -> Floats:
    if name == "none":
        return np.zeros((3, 0))
    if name == "all":
        return np.eye(3)
    words = name.split("+")
    unknown = [word for word in words if word not in AXES]
    if unknown:
        raise InputError(f"unknown protection '{name}': give {_HELP}")
    return np.array([AXES[word] for word in words]).T


def _columns(axes: ArrayLike) -> Floats:
    try:
        given = as_floats("U_c", axes)
    except InputError:
        raise InputError(f"U_c cannot be read as numbers: {shown(axes)}; give {_HELP}") from None
    columns = given[:, None] if given.ndim == 1 else given
    rows, k = columns.shape if columns.ndim == 2 else (0, 0)
    if rows not in (3, 6) or (rows, k) == (3, 6):
        hint = "; its transpose would do: directions are columns" if k in (3, 6) else ""
        raise InputError(
            f"U_c has shape {given.shape}, it needs (3,) or (3, k) with k up to 3 for rotations, (6,) or (6, k) with k "
            f"up to 6 for twists{hint}"
        )
    if k > rows:
        raise InputError(
            f"U_c has k = {k} directions; {'space' if rows == 3 else 'a twist'} has {rows}: keep an orthonormal basis "
            "of their span"
        )
    return columns


def _refuse_far_from_orthonormal(columns: Floats) -> None:
    for i, column in enumerate(columns.T, 1):
        if not np.all(np.isfinite(column)):
            raise InputError(f"direction {i} of U_c, {column.tolist()}, is not finite")
        length = float(np.linalg.norm(column))
        if length == 0:
            raise InputError(f"direction {i} of U_c is zero; drop it, or use 'none' to protect nothing")
        if abs(length - 1) > TOLERANCE:
            unit = ", ".join(f"{x:.6g}" for x in column / length)
            raise InputError(
                f"direction {i} of U_c, {column.tolist()}, has length {length:.6g}; did you mean ({unit})?"
            )
    for i in range(columns.shape[1]):
        for j in range(i + 1, columns.shape[1]):
            dot = float(columns[:, i] @ columns[:, j])
            if abs(dot) > 1 - TOLERANCE:
                raise InputError(f"directions {i + 1} and {j + 1} of U_c are the same; drop one")
            if abs(dot) > TOLERANCE:
                angle = np.rad2deg(np.arccos(np.clip(dot, -1, 1)))
                raise InputError(
                    f"directions {i + 1} and {j + 1} of U_c stand at {angle:.4g} deg; make them orthogonal, for "
                    "example with numpy.linalg.qr: the protected subspace stays the same"
                )


def _nearest_orthonormal(columns: Floats) -> Floats:
    if columns.shape[1] == 1:
        return columns / np.linalg.norm(columns)
    if np.array_equal(columns.T @ columns, np.eye(columns.shape[1])):
        return columns.copy()
    left, _, right = np.linalg.svd(columns, full_matrices=False)
    nearest: Floats = left @ right
    # One Newton step of the polar decomposition takes out what the rounding of the SVD left.
    return 0.5 * nearest @ (3.0 * np.eye(nearest.shape[1]) - nearest.T @ nearest)


def _angle(given: Floats, used: Floats) -> float:
    across = np.outer(given, used)
    return float(np.arctan2(np.linalg.norm(across - across.T) / np.sqrt(2), given @ used))


def _nearest_axis(direction: Floats) -> tuple[str, float]:
    names = TWIST[-len(direction) :]
    best = int(np.argmax(np.abs(direction)))
    across = np.linalg.norm(np.delete(direction, best))
    return names[best], float(np.arctan2(across, abs(direction[best])))
