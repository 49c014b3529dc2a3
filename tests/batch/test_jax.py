"""The engine on JAX against the compiled one, and its slopes against central differences."""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_robots import random_robot, random_state
from test_matrices import planar_arm

import ssm_decouple as ssm
from ssm_decouple.batch import Batch, JaxBatch

FOLDED = np.deg2rad([150.0, -20, -10, 0, 0, 0])
TARGET = np.array([-1.8, -0.3, 1.2])
TWISTS = ssm.Protection(np.linalg.qr(np.random.default_rng(4).normal(size=(6, 6)))[0][:, :2])


@pytest.fixture(scope="module", autouse=True)
def compiled_quickly():
    """Compile without the passes that take long: the numbers are the same, the speed does not matter here."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="module")
def tree():
    """A branched robot with revolute, continuous and prismatic joints."""
    robot = random_robot(1, joints=6)
    assert {joint.shortname() for joint in robot.model.joints[2:]} >= {"JointModelRevoluteUnaligned"}
    return robot


@pytest.fixture(scope="module")
def engine(tree):
    """The engine on JAX, compiled once for all tests."""
    return JaxBatch(tree, device="cpu", chunk=8)


@pytest.fixture(scope="module")
def law(tree):
    return ssm.SelectiveLaw(tree, ssm.Protection("yaw"), gain=0.3, rate_limit=0.3, joint_weights=[1, 2, 1, 3, 1, 1])


def test_matrices_are_those_of_the_compiled_engine(tree, engine, rng):
    """More rows than fit into a block, in no order of k, and some that are not finite."""
    protections = [TWISTS, "none", ssm.Protection(TWISTS.U_c[:, ::-1])]
    joints = rng.uniform(-4, 4, (600, 6))
    joints[[3, 599], [0, 5]] = np.nan, np.inf
    told: list[float] = []
    found, wanted = engine.matrices(joints, protections, told.append), Batch(tree).matrices(joints, protections)
    assert told == [512 / 600, 1.0]
    for name in ("values", "smallest_singular_values", "manipulability"):
        scale = max(1.0, np.nanmax(np.abs(getattr(wanted, name))))
        assert np.array_equal(np.isnan(getattr(found, name)), np.isnan(getattr(wanted, name))), name
        assert np.nanmax(np.abs(getattr(found, name) - getattr(wanted, name))) < 1e-14 * scale, name
    assert engine.matrices(np.empty((0, 6)), protections).smallest_singular_values.shape == (0, 3)


def test_coupling_factors_are_those_of_the_compiled_engine(tree, engine, rng):
    joints = rng.uniform(-4, 4, (40, 6))
    joints[7, 1] = np.nan
    found, wanted = (each.coupling_factors(joints, ["yaw"]) for each in (engine, Batch(tree)))
    assert found == pytest.approx(wanted, rel=1e-12, nan_ok=True)


def test_steps_are_those_of_the_compiled_engine(tree, engine, law, rng):
    starts = np.array([random_state(tree, rng) for _ in range(40)])
    targets = rng.uniform(-3, 3, (40, 3))
    targets[5, 1] = np.nan
    found, wanted = engine.step(law, starts, targets), Batch(tree).step(law, starts, targets)
    clear = ~(wanted.smallest_singular_value < 1e-3)
    assert clear.sum() > 30
    assert (wanted.rate_scale < 1).any()
    assert np.isnan(found.values[5]).all()
    assert found.values[clear] == pytest.approx(wanted.values[clear], abs=1e-12, nan_ok=True)
    assert np.nanmax(np.abs(found.protected_rate)) < 1e-16


def test_motions_are_those_of_the_compiled_engine(tree, engine, law, rng):
    starts = np.array([random_state(tree, rng) for _ in range(11)])
    targets = np.array([tree.frame_pose(q).translation for q in starts]) + rng.uniform(-0.3, 0.3, (11, 3))
    targets[4] = np.inf
    found, wanted = (each.motions(law, starts, targets, 3.05, 0.1) for each in (engine, Batch(tree)))
    assert found.outcome.tolist() == wanted.outcome.tolist()
    assert found.outcome[4] == "undefined"
    clear = ~(wanted.smallest_singular_value < 0.02)
    for name in ("outcome_time", "final_error", "joint_travel", "peak_rate", "base_rotation", "configuration"):
        found_, wanted_ = getattr(found, name)[clear], getattr(wanted, name)[clear]
        assert found_ == pytest.approx(wanted_, abs=1e-12, nan_ok=True), name
    assert np.nanmax(found.protected_rate) < 1e-16
    assert found.smallest_singular_value[clear] == pytest.approx(
        wanted.smallest_singular_value[clear], abs=1e-12, nan_ok=True
    )


def test_the_setting_of_the_program_around_is_left(engine):
    engine.coupling_factors(np.zeros((1, 6)), ["yaw"])
    assert jnp.zeros(1).dtype == np.float32


def differences(function, at, step=1e-5):
    """Return the central differences of a function by each number of `at`."""
    ways = step * np.eye(at.size)
    return np.array([(function(at + way) - function(at - way)) / (2 * step) for way in ways])


def test_slopes_of_a_motion_are_right(ets_vii):
    """200 steps, at the rate limit all the way, and damped on a part of it."""
    settings = {"rate_limit": 0.08, "damping": 1e-2, "damping_threshold": 0.3}
    fast = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), gain=0.1, **settings)
    traced = JaxBatch(ets_vii).traced(ssm.SelectiveLaw(ets_vii, fast.protection, **settings))

    def errors(given):
        motion = traced.motion(given[:, :6], given[:, 6:9], 20.0, 0.1, gain=given[:, 9])
        left = motion.command.end_effector_error[:, -1]
        values = jnp.sqrt(jnp.sum(left * left, axis=1))
        return values.sum(), (values, motion)

    given, step = np.array([*FOLDED, *TARGET, 0.1]), 1e-5
    with jax.enable_x64(True):  # the middle and all steps aside go in one batch
        rows = given + step * np.vstack([np.zeros(10), np.eye(10), -np.eye(10)])
        slopes, (values, motion) = jax.jit(jax.grad(errors, has_aux=True))(rows)
        damping, scale = np.asarray(motion.command.damping[0]), np.asarray(motion.command.rate_scale[0])
    assert (damping > 0).any()
    assert (damping == 0).any()
    assert (scale < 1).any()
    wanted = (np.asarray(values)[1:11] - np.asarray(values)[11:]) / (2 * step)
    assert np.abs(wanted[[0, 6, 9]]).min() > 0.1
    assert np.asarray(slopes)[0] == pytest.approx(wanted, rel=1e-7, abs=1e-8)
    known = ssm.simulate(fast, ets_vii.configuration(FOLDED), TARGET, 20.0, 0.1)
    assert float(values[0]) == pytest.approx(known.final_error, abs=1e-12)


def test_slopes_of_a_command_at_a_singularity_are_right():
    """A planar arm has lost a direction everywhere; the damping keeps the law smooth."""
    robot = planar_arm()
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), rate_limit=np.inf)
    traced, straight = JaxBatch(robot).traced(law), np.array([0.3, 0.5, 0.7, 0.0])
    with jax.enable_x64(True):
        both = jax.jit(jax.jacfwd(lambda at: (traced.command(at, TARGET).joint_rates,) * 2, has_aux=True))
        found = np.asarray(both(straight)[0])
        wanted = differences(lambda at: np.asarray(both(at)[1]), straight, 1e-6).T
    assert law(robot.configuration(straight), TARGET).smallest_singular_value < 1e-15
    assert np.isfinite(found).all()
    assert found == pytest.approx(wanted, abs=1e-6 * np.abs(wanted).max())


def test_batches_of_any_axes(tree, engine, law, rng):
    traced, joints = engine.traced(law), rng.uniform(-2, 2, (2, 3, 6))
    with jax.enable_x64(True):
        found, matrices = jax.jit(lambda at: (traced.command(at, TARGET), traced.matrices(at)))(joints)
        J_rc = matrices.J_base[..., 3:, :]
    assert found.joint_rates.shape == (2, 3, 6)
    assert found.rate_scale.shape == (2, 3)
    wanted = engine.step(law, joints.reshape(6, 6), TARGET).joint_rates
    assert np.asarray(found.joint_rates).reshape(6, 6) == pytest.approx(wanted, abs=1e-12)
    assert np.asarray(J_rc)[1, 2] == pytest.approx(tree.coupling(tree.configuration(joints[1, 2])).J_rc, abs=1e-13)


def test_what_makes_no_sense_is_refused(tree, engine, law, monkeypatch):
    with pytest.raises(ssm.InputError, match=r"JAX has no device 'gpux'; it has cpu"):
        JaxBatch(tree, device="gpux")
    with pytest.raises(ssm.InputError, match="chunk is 0"):
        JaxBatch(tree, chunk=0)
    with pytest.raises(ssm.InputError, match="the law has momentum on board"):
        engine.traced(ssm.SelectiveLaw(tree, law.protection, momentum=[0, 0, 0, 0, 0, 1.0]))
    with pytest.raises(ssm.InputError, match="joints are of type float32; the law needs 64 bits"):
        engine.traced(law).command(jnp.zeros(6), jnp.zeros(3))
    with pytest.raises(ssm.InputError, match=r"shape \(2, 5\)"):
        engine.matrices(np.zeros((2, 5)))
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(ssm.InputError, match=r"pip install 'ssm-decouple\[jax\]'"):
        JaxBatch(tree)
