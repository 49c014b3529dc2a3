"""Numbers that would never end or never fit are refused before they cost time or memory, and long work hears Ctrl-C."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import ssm_decouple as ssm
from ssm_decouple.batch.engine import Batch
from ssm_decouple.cli.commands import app
from ssm_decouple.errors import MOST_BYTES, as_whole, refuse_more_than_fits
from ssm_decouple.simulation import dynamic
from ssm_decouple.studies.campaign import Campaign
from ssm_decouple.studies.robustness import Robustness
from ssm_decouple.studies.targets import random_starts, random_targets
from ssm_decouple.studies.workspace import Workspace, joint_slice

START = np.deg2rad([150, -20, -10, 0, 0, 0])
TARGET = [-1.8, -0.3, 1.2]


def simulated(duration: float = 1.0, dt: float = 0.1, method="explicit", **changes):
    robot = ssm.load_robot("ets_vii")
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), **changes)
    return ssm.simulate(law, robot.configuration(START), TARGET, duration, dt, method)


def tumbling(**changes) -> ssm.TumblingTarget:
    known = {"inertia": np.diag([1.0, 2.0, 2.5]), "attitude": np.eye(3), "position": TARGET}
    return ssm.TumblingTarget(**(known | {"angular_velocity": [0.1, 0.2, 0.3]} | changes))


def wing(segments: int) -> ssm.Appendage:
    return ssm.Appendage("wing", [0, 1.45, 0], [0, 1, 0], [1, 0, 0], 6.5, 2.4, 50.0, 0.15, 0.005, segments)


DOORS = {
    "samples": lambda: simulated(5e6, 0.1),
    "samples, held": lambda: simulated(1e7, 1e-1, "held"),
    "samples, dynamic": lambda: simulated(5e6, 0.1, ssm.Dynamic(step=0.01)),
    "samples without end": lambda: simulated(1e300, 1e-300),
    "physics step": lambda: simulated(0.5, 0.1, ssm.Dynamic(step=1e-9)),
    "physics step next to zero": lambda: simulated(0.5, 0.1, ssm.Dynamic(step=5e-324)),
    "physics step, prescribed": lambda: simulated(0.5, 0.1, ssm.Dynamic(step=1e-12, servo=None)),
    "physics over a long time": lambda: simulated(1e6, 10.0, ssm.Dynamic(step=1e-3)),
    "servo period": lambda: simulated(0.5, 0.1, ssm.Dynamic(servo=ssm.Servo(period=1e-11))),
    "servo period next to zero": lambda: simulated(0.5, 0.1, ssm.Dynamic(servo=ssm.Servo(period=5e-324))),
    "tumbling for long": lambda: tumbling()(1e12),
    "tumbling fast": lambda: tumbling(angular_velocity=[1e12, 0, 1e10])(1.0),
    "tumbling pose": lambda: tumbling().pose(1e9),
    "tumbling twist": lambda: tumbling().twist(1e9),
    "segments": lambda: wing(10**9),
    "threads": lambda: Batch(ssm.load_robot("ets_vii"), threads=10**9),
    "motions of a batch": lambda: batch_motions(1e8, 1.0),
    "starts": lambda: random_starts(ssm.load_robot("ets_vii"), 10**12),
    "targets": lambda: random_targets(ssm.load_robot("ets_vii"), ssm.load_robot("ets_vii").configuration(), 10**12),
    "slice": lambda: joint_slice(ssm.load_robot("ets_vii"), START, ("joint_1", "joint_2"), points=10**7),
    "workspace": lambda: Workspace(ssm.load_robot("ets_vii"), samples=10**12),
    "workspace of more than a float": lambda: Workspace(ssm.load_robot("ets_vii"), samples=10**400),
    "campaign": lambda: campaign(samples=10**12),
    "chunk": lambda: campaign(chunk=10**9),
    "chunks": lambda: campaign(samples=10**8, chunk=1),
    "robustness": lambda: Robustness(ssm.load_case("case1"), runs=10**12),
    "workers": lambda: Robustness(ssm.load_case("case1"), workers=10**9),
}


def batch_motions(duration: float, dt: float):
    robot = ssm.load_robot("ets_vii")
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"))
    return Batch(robot).motions(law, START, TARGET, duration, dt)


def campaign(**changes) -> Campaign:
    lines = {"seed": 1, "samples": 10, "chunk": 5} | changes
    text = "".join(f"{key} = {value}\n" for key, value in lines.items())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "campaign.toml"
        path.write_text(f'{text}cases = ["case1"]\n[target]\nposition = {{ ball = 0.1 }}\n')
        return Campaign.load(path)


@pytest.mark.parametrize("door", DOORS)
def test_absurd_numbers_are_refused_at_once(door):
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ssm.InputError, match=r"at most|more than|needs|less"):
        DOORS[door]()
    assert time.monotonic() - started < 60  # a hang, not a measurement
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


@pytest.mark.parametrize(
    "words",
    [
        ["compare", "case1", "--targets", "1000000000000"],
        ["run", "case1", "--dt", "1e-9"],
        ["run", "case1", "--dynamic", "--dt", "1e-7"],
        ["study", "workspace", "ets_vii", "--samples", "1000000000000"],
        ["study", "robustness", "case1", "--runs", "1000000000000"],
        ["study", "robustness", "case1", "--workers", "1000000000"],
        ["study", "pointing", "case3", "--step", "1e-12"],
    ],
    ids=lambda words: " ".join(words[:1] + words[2:]),
)
def test_absurd_options_are_refused_at_once(words, tmp_path):
    done = CliRunner().invoke(app, [*words, "--output", str(tmp_path), "--no-progress"])
    assert isinstance(done.exception, ssm.DecoupleError), done.output


def test_it_holds_within_a_small_memory(tmp_path):
    """With 3 GB of address space: what is refused is refused before memory is asked for."""
    code = """
        import resource, sys
        resource.setrlimit(resource.RLIMIT_AS, (3 * 2**30, 3 * 2**30))
        import numpy as np, ssm_decouple as ssm
        robot = ssm.load_robot("ets_vii")
        law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"))
        q = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
        for method in ("explicit", ssm.Dynamic()):
            try:
                ssm.simulate(law, q, [-1.8, -0.3, 1.2], 5e6, 0.1, method)
            except ssm.InputError as error:
                print("refused", error)
    """
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.stdout.count("refused") == 2, done.stderr


def test_what_is_told(ets_vii):
    with pytest.raises(
        ssm.InputError, match=r"1e-09 s makes 5e\+08 physics steps of 0.5 s, 1e\+08 at most: use 5e-09 s"
    ):
        simulated(0.5, 0.1, ssm.Dynamic(step=1e-9))
    with pytest.raises(ssm.InputError, match=r"record of 5e\+06 s in steps of 0.1 s would take .* GiB .* longer dt"):
        simulated(5e6, 0.1)
    with pytest.raises(ssm.InputError, match=r"time is 1e\+12 s: the target's tumble takes .* steps"):
        tumbling()(1e12)


def test_a_body_that_does_not_turn_may_be_asked_for_any_time():
    position, _ = tumbling(angular_velocity=[0, 0, 0])(1e12)
    np.testing.assert_allclose(position, TARGET)


@pytest.mark.parametrize("bad", [0, -1, 1.5, True, "3", None, np.nan])
def test_counts_are_whole_numbers(bad):
    with pytest.raises(ssm.InputError, match=r"count is .*; give a whole number from 1"):
        as_whole("count", bad, 1, "give a whole number from 1", 10)


def test_counts_and_bytes():
    assert as_whole("count", np.int32(10), most=10) == 10
    for large in (11, 10**40, 10**5000):
        with pytest.raises(ssm.InputError, match="10 at most"):
            as_whole("count", large, most=10)
    refuse_more_than_fits("it", MOST_BYTES, "mend")
    for size in (MOST_BYTES + 1, np.inf, np.nan):
        with pytest.raises(ssm.InputError, match=r"it would take .* at most; mend"):
            refuse_more_than_fits("it", size, "mend")


# Ctrl-C.


def test_calls_of_compiled_steps_are_short(ets_vii):
    motion = dynamic.DynamicMotion(
        ssm.Dynamic(), ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw")), ets_vii.configuration()
    )
    assert motion._steps_at_once * (6 + ets_vii.n_joints) ** 2 <= dynamic.STEP_WORK


@pytest.mark.filterwarnings("ignore:drives at their torque limits")
def test_pieces_of_a_hold_change_nothing(ets_vii, monkeypatch):
    """One call or many: the same numbers, bit for bit."""
    physics = ssm.Dynamic(
        step=0.002, servo=ssm.Servo(period=0.02, torque_limits=1.0), load=ssm.Load((0.1, 0, 0), start=0.3)
    )
    found = []
    for work in (10**9, 60 * 12**2):  # all 250 steps of a sample, and 60 at a time
        monkeypatch.setattr(dynamic, "STEP_WORK", work)
        found.append(simulated(2.0, 0.5, physics))
    assert found[0].drop_attrs(deep=False).identical(found[1].drop_attrs(deep=False))


@pytest.mark.parametrize("servo", ["ssm.Servo()", "None"])
def test_a_long_sample_hears_ctrl_c_and_keeps_the_motion(servo):
    """Two samples of 400 s in steps of 10 microseconds: minutes of compiled steps."""
    code = f"""
        import signal, threading, os
        import numpy as np, ssm_decouple as ssm
        signal.signal(signal.SIGINT, signal.default_int_handler)
        robot = ssm.load_robot("ets_vii")
        law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"))
        q, target = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0])), [-1.8, -0.3, 1.2]
        ssm.simulate(law, q, target, 0.2, 0.1, ssm.Dynamic(servo={servo}))  # compiles
        threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
        try:
            ssm.simulate(law, q, target, 800.0, 400.0, ssm.Dynamic(step=1e-5, servo={servo}))
        except ssm.SimulationInterrupted as stopped:
            print("kept", stopped.motion.sizes["time"])
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.stdout == "kept 1\n", done.stderr


def test_a_film_without_end_is_refused():
    from ssm_decouple.viewing.viewer.export import _times

    with pytest.raises(ssm.InputError, match=r"film of .* pictures, 100,000 at most: use a speed of"):
        _times(150.0, 1e-12, 25)
    assert len(_times(150.0, 10.0, 25)) == 376
