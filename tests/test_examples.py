from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
PRINTS = {
    "case1": "converged at 102.0 s, 0.90 mm left",
    "case2": "converged at 137.2 s, 5.25 mm left",
    "case3": "case3 | selective | 2 | converged, 97 s | 0.70",
    "bending": "protected: bending modes   tip   0.001",
    "control_loop": "memory held after a step: 0 bytes more than before",
    "own_axis": "of 40 directions can be protected",
    "own_robot": "yaw       converged",
    "pointing": "selective              at most    1.31",
    "robustness": "5 % off, plant 2",
    "tumbling_target": "feed-forward                              at most   0.182 mm",
    "two_arms": "pose      yaw        100.0 (43.9 to 100.0)    0.0 ( 0.0 to  56.1)         3",
}
CHATTERS = ("bending", "case1", "own_axis", "two_arms")  # some of their motions do, at a singularity, and say so
WORDS = {"control_loop": ["1"]}  # seconds


def test_every_example_is_tried():
    assert {path.stem for path in EXAMPLES.glob("*.py")} == PRINTS.keys()


@pytest.mark.parametrize("name", PRINTS)
def test_example(name, tmp_path):
    words = [sys.executable, EXAMPLES / f"{name}.py", *WORDS.get(name, [])]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    assert PRINTS[name] in done.stdout
    told = [line for line in done.stderr.splitlines() if "Warning" in line]
    if name in CHATTERS:
        assert told
        assert all("the commanded rates reverse from sample to sample" in line for line in told)
    else:
        assert done.stderr == ""


def test_own_robot_takes_another_urdf(tmp_path):
    import ssm_decouple as ssm

    words = [sys.executable, EXAMPLES / "own_robot.py", ssm.example_robot("kinova_description/robots/kinova.urdf")]
    done = subprocess.run([*words, "j2s6s200_end_effector"], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "none      converged" in done.stdout
