"""The batch engine on JAX: the same numbers on a processor or a GPU, and functions to differentiate."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssm_decouple.batch.base import Engine, Floats, Judge, Progress, Wanted
from ssm_decouple.control import kernel
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.errors import InputError, as_floats, as_kind, as_whole, shown
from ssm_decouple.model.origin import FAR
from ssm_decouple.model.robot import UNIT, Robot
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.simulation.steps import sample_times

if TYPE_CHECKING:
    import jax

    from ssm_decouple.batch import functions

    Array = jax.Array

ON_PROCESSOR, ON_GPU = 128, 65536  # rows that go through each operation together
CHUNKS = 64  # of them in a block, the unit that travels to the device and back
MOST_CHUNK = 2**20
IN_FLIGHT = 2  # blocks: while one is computed the next is prepared
SAMPLES = 2**26  # of distances to the target in a block: fewer rows where motions are long


class JaxBatch(Engine):
    """`Batch` on JAX: the same functions, arguments and numbers, on the device that JAX finds or is told.

    Everything is of 64 bits, whatever the program around has set: its own setting is left as it is. What `traced`
    returns runs in the program's own tracing, and needs 64 bits switched on there.

    The functions are compiled at the first use, once for each robot and number of protected directions. Rows go through
    in blocks of one size, so that other numbers of rows compile nothing, and memory grows with the results alone.

    Args:
        robot: The robot.
        end_effector: The frame whose translation J_gt is of; None is the robot's end-effector.
        device: "cpu", "gpu", a device of JAX's, or None for the one that JAX takes.
        chunk: How many rows go through each operation together; None is a number that suits the device.

    Raises:
        InputError: JAX is not installed, there is no such device, chunk is no positive whole number, or the robot is
            one that `Batch` refuses.
    """

    def __init__(
        self,
        robot: Robot,
        end_effector: str | None = None,
        device: str | jax.Device | None = None,
        chunk: int | None = None,
    ) -> None:
        super().__init__(robot, end_effector)
        self.device = _device(device)
        usual = ON_PROCESSOR if self.device.platform == "cpu" else ON_GPU
        needs = "give a positive whole number, or None for one that suits the device"
        self.chunk: int = usual if chunk is None else as_whole("chunk", chunk, 1, needs, MOST_CHUNK)
        self._compiled: dict[tuple[Any, ...], Any] = {}

    def __repr__(self) -> str:
        return f"JaxBatch({self.robot!r}, end_effector={self.end_effector!r}, device={self.device}, chunk={self.chunk})"

    def traced(self, law: SelectiveLaw) -> TracedLaw:
        """Return a law as functions of JAX arrays, to be compiled, mapped and differentiated with a program around.

        Args:
            law: As for `step`.

        Raises:
            InputError: another law.
        """
        self._refuse_other_laws(law)
        return TracedLaw(self._arm, _constants_of(law))

    @cached_property
    def _arm(self) -> functions.Arm:
        from ssm_decouple.batch import functions

        return functions.Arm(*self._constants)

    def _evaluate(
        self, joints: NDArray[Any], protections: list[Protection], wanted: Wanted, progress: Progress | None
    ) -> None:
        order, groups = _grouped(protections)
        keep_values, keep_factors = len(wanted.values) > 0, len(wanted.factors) > 0
        # One group a number of directions: these are compiled in, the directions are not.
        key = ("matrices", keep_values, keep_factors, tuple(group.shape for group in groups))
        run = self._program(key, partial(_evaluated, self._arm, keep_values, keep_factors))
        for part, (values, told) in self._blocks(run, groups, [joints], self.chunk, progress):
            if keep_values:
                wanted.values[part] = values
            for array, columns in zip((wanted.smallest, wanted.volumes, wanted.factors), told, strict=True):
                if len(array):
                    array[part, order] = columns

    def _command(self, law: SelectiveLaw, joints: Floats, poses: Floats, targets: Floats, out: Floats) -> None:
        constants = _constants_of(law)
        run = self._program(("command", constants.U.shape), partial(_commanded, self._arm))
        for part, (found,) in self._blocks(run, constants, [joints, poses, targets], self.chunk, None):
            out[part] = found

    def _move(
        self,
        law: SelectiveLaw,
        joints: Floats,
        poses: Floats,
        targets: Floats,
        times: Floats,
        record: Floats,
        judge: Judge,
        progress: Progress | None,
    ) -> None:
        constants, holds = _constants_of(law), np.diff(times, append=times[-1])
        chunk = max(1, min(self.chunk, SAMPLES // (CHUNKS * times.size)))
        run = self._program(("motion", constants.U.shape, times.size, chunk), partial(_travelled, self._arm))
        blocks = self._blocks(run, (constants, holds), [joints, poses, targets], chunk, progress)
        for part, (ends, places, kept, history) in blocks:
            joints[part], poses[part], record[part] = ends, places, kept
            judge(part, history)

    def _program(self, key: tuple[Any, ...], rows: Callable[..., Any]) -> Any:
        """Return rows(constants, *columns) compiled for blocks of rows, chunk after chunk."""
        import jax

        if key not in self._compiled:
            self._compiled[key] = jax.jit(partial(_in_chunks, rows))
        return self._compiled[key]

    def _blocks(
        self, run: Any, constants: Any, inputs: list[NDArray[Any]], chunk: int, progress: Progress | None
    ) -> Iterator[tuple[slice, Any]]:
        """Yield each block's place and what comes of it, with a row for each of its rows."""
        import jax

        count, size = len(inputs[0]), chunk * CHUNKS
        with jax.enable_x64(True):
            fixed = jax.device_put(constants, self.device)
            waiting: deque[tuple[slice, Any]] = deque()
            for start in [*range(0, count, size), *[count] * IN_FLIGHT]:
                if len(waiting) == IN_FLIGHT or (start == count and waiting):
                    part, found = waiting.popleft()
                    rows = part.stop - part.start
                    yield part, jax.tree.map(lambda array, rows=rows: np.asarray(array).reshape(size, -1)[:rows], found)
                    if progress is not None:
                        progress(part.stop / count)
                if start < count:
                    part = slice(start, min(start + size, count))
                    chunks = -(-(part.stop - start) // chunk)
                    sent = jax.device_put([_padded(array[part], chunk) for array in inputs], self.device)
                    waiting.append((part, run(fixed, chunks, *sent)))


class TracedCommand(NamedTuple):
    """What a law commands, as JAX arrays with the axes of the batch first; `Command` says what each is.

    Attributes:
        joint_rates: (.., n), rad/s or m/s.
        base_twist: (.., 6), base axes.
        protected_rate: (.., k).
        end_effector_error: Target minus end-effector (.., 3), m, base axes.
        smallest_singular_value: (..,), m.
        damping: (..,), m2.
        rate_scale: (..,).
    """

    joint_rates: Array
    base_twist: Array
    protected_rate: Array
    end_effector_error: Array
    smallest_singular_value: Array
    damping: Array
    rate_scale: Array


class TracedMotion(NamedTuple):
    """A motion, as JAX arrays with the axes of the batch first, then one of the S samples.

    Attributes:
        joints: Joint positions (.., S, n), rad or m.
        poses: Of the base (.., S, 7): position, m, and quaternion x, y, z, w.
        command: What the law commands at each of them, `TracedCommand` of (.., S, ..).
    """

    joints: Array
    poses: Array
    command: TracedCommand


class TracedLaw:
    """A law and its robot as pure functions of JAX arrays: made by `JaxBatch.traced`.

    Joint positions are (.., n), targets (.., 3), base poses (.., 7): position, m, and quaternion x, y, z, w. Axes in
    front are those of a batch and need not be the same in all; `jax.vmap` is not needed for them, and is slower. All
    can be differentiated, by `jax.grad` and by `jax.jvp`, and so can the gain.

    The slopes are those of the law's own formulas. Where it is damped they stay finite, at singularities too. Where a
    rate stands just at its limit, or the smallest singular value at the threshold, they are those of one side.
    """

    def __init__(self, arm: functions.Arm, law: functions.Law) -> None:
        self._arm, self._law = arm, law

    def matrices(self, joints: Array) -> functions.Matrices:
        """Return the momentum matrices (.., rows, n) and the like, base axes, with the names of `Matrices`."""
        from ssm_decouple.batch import functions

        columns = _last(joints, "joints", self._law.limits.size)
        found = functions.matrices(self._arm, columns)
        return functions.Matrices(*(_front(array, array.ndim - columns.ndim + 1) for array in found))

    def command(
        self, joints: Array, target: Array, pose: Array | None = None, gain: Array | float | None = None
    ) -> TracedCommand:
        """Return what the law commands.

        Args:
            joints: Joint positions (.., n).
            target: Target position (.., 3), m, inertial axes.
            pose: Base pose (.., 7); None is the identity.
            gain: 1/s; None is the law's.

        Raises:
            InputError: arrays that are not of 64 bits.
        """
        from ssm_decouple.batch import functions

        law, (columns, place, point) = self._given(joints, target, pose, gain)
        return _traced(functions.command(self._arm, law, columns, functions.seen_from(place, point)))

    def motion(
        self,
        joints: Array,
        target: Array,
        duration: float,
        dt: float,
        pose: Array | None = None,
        gain: Array | float | None = None,
    ) -> TracedMotion:
        """Return a motion: `simulate(.., method="explicit")` to a target at rest.

        Args:
            joints: Joint positions at the start (.., n).
            target: Target position (.., 3), m, inertial axes.
            duration: Length of the motion, s; a number, not traced.
            dt: Time between samples, s; likewise.
            pose: Base pose at the start (.., 7); None is the identity.
            gain: 1/s; None is the law's.

        Raises:
            InputError: arrays that are not of 64 bits, or times that make no sense.
        """
        import jax

        from ssm_decouple.batch import functions

        times = sample_times(duration, dt)
        holds = jax.numpy.asarray(np.diff(times, append=times[-1]))
        law, (columns, place, point) = self._given(joints, target, pose, gain)
        # Counted from where the base starts, if that is far from the inertial origin.
        far = jax.numpy.max(jax.numpy.abs(place[:3]), axis=0) > FAR
        origin = jax.lax.stop_gradient(jax.numpy.where(far, place[:3], 0.0))
        place, point = place.at[:3].add(-origin), point - origin

        def step(state: Any, hold: Array) -> Any:
            columns, place = state
            told = functions.command(self._arm, law, columns, functions.seen_from(place, point))
            after = columns + hold * told.joint_rates, functions.moved(place, told.base_twist, hold)
            return after, (columns, place, told)

        _, (all_joints, poses, told) = jax.lax.scan(step, (columns, place), holds)
        poses = poses.at[:, :3].add(origin)
        told, all_joints, poses = jax.tree.map(lambda x: jax.numpy.moveaxis(x, 0, -1), (told, all_joints, poses))
        return TracedMotion(_front(all_joints, 1), _front(poses, 1), _traced(told))

    def _given(
        self, joints: Array, target: Array, pose: Array | None, gain: Array | float | None
    ) -> tuple[functions.Law, list[Array]]:
        """Return the law, and joints, pose and target with the axes of the batch last, and the same in all."""
        import jax
        import jax.numpy as jnp

        place = jnp.zeros(7).at[6].set(1.0) if pose is None else pose
        given = ((joints, "joints", self._law.limits.size), (place, "pose", 7), (target, "target", 3))
        arrays = [_last(array, name, size) for array, name, size in given]
        if pose is not None:
            arrays[1] = _unit(arrays[1])
        if gain is not None and not isinstance(gain, jax.Array) and not np.all(as_floats("gain", gain) > 0.0):
            raise InputError(f"gain is {shown(gain)}; it must be a positive number")
        batch = jnp.broadcast_shapes(*(array.shape[1:] for array in arrays))
        spread = [jnp.broadcast_to(_aligned(array, len(batch)), (len(array), *batch)) for array in arrays]
        return self._law if gain is None else self._law._replace(gain=gain), spread


def _unit(pose: Array) -> Array:
    """Return poses (7, ..); refused, or NaN where they are traced, if a quaternion is not of unit length."""
    import jax
    import jax.numpy as jnp

    lengths = jnp.sqrt(jnp.sum(pose[3:] ** 2, axis=0))
    off = jnp.abs(lengths - 1.0) > UNIT
    if not isinstance(off, jax.core.Tracer) and bool(jnp.any(off)):
        raise InputError("a pose has a quaternion that is not of unit length; divide it by its length")
    return jnp.where(off, jnp.nan, pose)


def _last(array: Any, name: str, size: int) -> Array:
    """Return an array (.., size) as (size, ..)."""
    import jax
    import jax.numpy as jnp

    given = jnp.asarray(array if isinstance(array, jax.Array) else as_floats(name, array))
    if given.ndim == 0 or given.shape[-1] != size:
        raise InputError(f"{name} have shape {given.shape}; they need (.., {size})")
    if given.dtype != np.float64:
        raise InputError(
            f"{name} are of type {given.dtype}; the law needs 64 bits: jax.config.update('jax_enable_x64', True), or "
            "with jax.enable_x64(True), and floats"
        )
    return jnp.moveaxis(given, -1, 0)


def _aligned(array: Array, axes: int) -> Array:
    return array.reshape(array.shape[0], *(1,) * (axes - array.ndim + 1), *array.shape[1:])


def _front(array: Array, axes: int) -> Array:
    """Return an array with its first axes at the end."""
    import jax.numpy as jnp

    return jnp.moveaxis(array, range(axes), range(-axes, 0))


def _traced(told: functions.Command) -> TracedCommand:
    return TracedCommand(
        joint_rates=_front(told.joint_rates, 1),
        base_twist=_front(told.base_twist, 1),
        protected_rate=_front(told.protected_rate, 1),
        end_effector_error=_front(told.end_effector_error, 1),
        smallest_singular_value=told.smallest_singular_value,
        damping=told.damping,
        rate_scale=told.rate_scale,
    )


def _device(device: str | jax.Device | None) -> jax.Device:
    try:
        import jax
    except ImportError:
        raise InputError("JaxBatch needs JAX, which is not installed: pip install 'ssm-decouple[jax]'") from None
    if not isinstance(device, str):
        mend = "give 'cpu', 'gpu', a device of JAX's, or None"
        return jax.devices()[0] if device is None else as_kind("device", device, jax.Device, mend)
    try:
        return jax.devices(device)[0]
    except RuntimeError:
        there = ", ".join(f"{each.platform} ({each.device_kind})" for each in jax.devices())
        raise InputError(f"JAX has no device '{device}'; it has {there}") from None


def _constants_of(law: SelectiveLaw) -> functions.Law:
    from ssm_decouple.batch import functions

    U, tasks, columns, parameters = law.constants()
    return functions.Law(
        U=U,
        gain=tasks[0, kernel.GAIN],
        weight=tasks[0, kernel.ROOT_WEIGHT],
        limits=columns[kernel.RATE_LIMIT],
        scale=columns[kernel.SCALE],
        threshold=parameters[kernel.THRESHOLD],
        damping=parameters[kernel.DAMPING_LIMIT],
    )


def _grouped(protections: list[Protection]) -> tuple[list[int], list[Floats]]:
    """Return the protections' directions (P, 6, k), those with the same k together, and where each belongs."""
    counts = [protection.k for protection in protections]
    order = sorted(range(len(counts)), key=counts.__getitem__)
    groups = [
        np.array([protection.U_twist for protection in protections if protection.k == k]) for k in sorted(set(counts))
    ]
    return order, groups


def _padded(rows: NDArray[Any], chunk: int) -> Floats:
    """Return rows as (CHUNKS, chunk, numbers); what is missing at the end is zero."""
    padded = np.zeros((CHUNKS * chunk, rows.shape[1]))
    padded[: len(rows)] = rows
    return padded.reshape(CHUNKS, chunk, rows.shape[1])


def _in_chunks(rows: Callable[..., Any], constants: Any, chunks: Array, *inputs: Array) -> Any:
    """Return what rows(constants, *columns) makes of the first chunks (CHUNKS, chunk, ..); the rest stays zero."""
    import jax

    def columns(i: Array | int) -> list[Array]:
        return [jax.lax.dynamic_index_in_dim(array, i, keepdims=False).T for array in inputs]

    def work(i: Array, out: Any) -> Any:
        found = jax.tree.map(lambda x: x.T, rows(constants, *columns(i)))
        return jax.tree.map(lambda all_, one: jax.lax.dynamic_update_index_in_dim(all_, one, i, 0), out, found)

    shapes = jax.eval_shape(lambda: jax.tree.map(lambda x: x.T, rows(constants, *columns(0))))
    empty = jax.tree.map(lambda one: jax.numpy.zeros((CHUNKS, *one.shape), one.dtype), shapes)
    return jax.lax.fori_loop(0, chunks, work, empty)


def _evaluated(
    arm: functions.Arm, keep_values: bool, keep_factors: bool, groups: list[Array], joints: Array
) -> tuple[Array, list[Array]]:
    """Return `Matrices.values` (12 n + 15, rows), then smallest singular values, volumes and factors (P, rows)."""
    import jax.numpy as jnp

    from ssm_decouple.batch import functions

    found, rows = functions.matrices(arm, joints), joints.shape[1]
    values = jnp.concatenate([array.reshape(-1, rows) for array in found]) if keep_values else jnp.zeros((0, rows))
    if not groups:
        return values, [jnp.zeros((0, rows))] * 3
    if keep_factors:
        return values, [*[jnp.zeros((0, rows))] * 2, functions.coupling_factors(found, groups)]
    return values, [*functions.singular_values(found, groups), jnp.zeros((0, rows))]


def _commanded(arm: functions.Arm, law: functions.Law, joints: Array, poses: Array, targets: Array) -> tuple[Array]:
    """Return commands (law.size, rows) as the law's kernel lays them out, in base axes; NaN where not finite."""
    import jax.numpy as jnp

    from ssm_decouple.batch import functions

    told = functions.command(arm, law, joints, functions.seen_from(poses, targets))
    none, k = jnp.zeros_like(told.damping), len(told.protected_rate)
    results = [none] * kernel.ERRORS
    results[kernel.PROTECTED_RATE : kernel.PROTECTED_RATE + k] = told.protected_rate
    results[kernel.POSITION : kernel.POSITION + 3] = told.end_effector_position
    results[kernel.RATE_SCALE], results[kernel.RANK], results[kernel.RATE_BLEND] = told.rate_scale, told.rank, none + 1
    results += [*told.end_effector_error, told.smallest_singular_value, told.damping]
    bad = jnp.where(jnp.isfinite(jnp.sum(told.joint_rates, axis=0)), 0.0, jnp.nan)
    return (jnp.concatenate([told.base_twist, told.joint_rates, jnp.stack(results)]) + bad,)


def _travelled(
    arm: functions.Arm, constants: Any, joints: Array, poses: Array, targets: Array
) -> tuple[Array, Array, Array, Array]:
    """Return joints, poses, record and distances to the target (samples, rows) of motions."""
    import jax
    import jax.numpy as jnp

    from ssm_decouple.batch import functions

    law, holds = constants

    def step(state: Any, hold: Array) -> Any:
        joints, poses, record = state
        told = functions.command(arm, law, joints, functions.seen_from(poses, targets))
        record = functions.kept(record, told, poses, hold)
        after = joints + hold * told.joint_rates, functions.moved(poses, told.base_twist, hold), record
        return after, jnp.sqrt(jnp.sum(told.end_effector_error**2, axis=0))

    start = joints, poses, functions.start_record(joints, poses)
    (joints, poses, (record, _)), history = jax.lax.scan(step, start, holds)
    return joints, poses, record, history
