"""The command as a user types it, in a process of its own where a signal comes from outside or a warning is told."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

import ssm_decouple as ssm
from ssm_decouple.cli import app

COMMAND = [sys.executable, "-c", "from ssm_decouple.cli import main; main()"]


@pytest.fixture
def short_case(write):
    text = ssm.cases()["case1"].read_text().replace("duration = 150", "duration = 2")
    return write(text, "short.toml")


def test_help_teaches():
    shown = CliRunner().invoke(app, ["--help"])
    assert shown.exit_code == 0
    for word in ("run", "compare", "models", "check", "plot", "cases", "Exit status"):
        assert word in shown.output
    for command in ("run", "compare"):
        assert "Examples:" in CliRunner().invoke(app, [command, "--help"]).output
    assert CliRunner().invoke(app, ["--version"]).output.strip() == ssm.__version__


def test_run_writes_the_motion_and_the_figures(call, tmp_path):
    done = call("run", "case1", "--no-progress", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "converged, 102 s" in done.stdout
    names = {path.name for path in (tmp_path / "results" / "case1").iterdir()}
    assert "selective.nc" in names
    assert {"selective_joints.pdf", "selective_base.png", "selective_configuration.pdf"} <= names
    motion = ssm.load_motion(tmp_path / "results" / "case1" / "selective.nc")
    assert motion.attrs["final_error"] < 1e-3
    drawn = call("plot", tmp_path / "results" / "case1" / "selective.nc", "--output", tmp_path / "again")
    assert drawn.returncode == 0
    assert len(drawn.stdout.splitlines()) == 10
    assert len(list((tmp_path / "again").iterdir())) == 10


def test_a_case_that_does_not_arrive_has_its_own_status(call, tmp_path):
    done = call("run", "case1", "--protect", "all", "--no-figures", "-o", tmp_path, "--json")
    assert done.returncode == 3
    (row,) = json.loads(done.stdout)["rows"]
    assert (row["outcome"], row["law"], row["k"]) == ("stalled", "reactionless", 3)
    (told,) = done.stderr.splitlines()  # it chatters at its singularity
    assert told.startswith("warning: the commanded rates reverse from sample to sample from 10")


def test_compare_prints_one_table_and_says_why(call, tmp_path):
    done = call("compare", "case1", "--no-figures", "-o", tmp_path)
    assert done.returncode == 0
    assert "reactionless, undamped" in done.stdout
    assert "stalled at 52.9 s" in done.stdout
    assert "Smallest singular value of J_gt N_sub" in done.stdout
    assert (tmp_path / "comparison.csv").read_text().count("\n") == 5
    assert {path.name for path in (tmp_path / "case1").iterdir()} == {
        "none.nc",
        "selective.nc",
        "reactionless.nc",
        "reactionless_undamped.nc",
    }


def test_options_reach_the_simulation(call, short_case, tmp_path):
    done = call(
        "run",
        short_case,
        "--dt",
        "0.5",
        "--protect",
        "0.5,0,0.866@inertial",
        "--damping",
        "0",
        "--no-figures",
        "--json",
        "-o",
        tmp_path,
    )
    motion = ssm.load_motion(json.loads(done.stdout)["files"][0])
    law = json.loads(motion.attrs["law"])
    assert motion.sizes["time"] == 5
    assert (law["frame"], law["damping"], law["k"]) == ("inertial", 0.0, 1)
    (row,) = json.loads(done.stdout)["rows"]
    assert row["w_sub_max_rad_s"] < 1e-18  # about the axes asked for, not the case's own
    assert json.loads(done.stdout)["files"][0].endswith("protect_0.5_0_0.866@inertial.nc")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--dt", "0.5"), "dt is 0.1 there, 0.5 here"),
        (("--damping", "0"), "law.damping is 0.0001 there, 0.0 here"),
        (("--dynamic",), "method is explicit there, dynamic here"),
    ],
)
def test_a_motion_of_other_settings_is_not_replaced(call, short_case, tmp_path, words, says):
    place = tmp_path / "out" / "short" / "selective.nc"
    usual = ("run", short_case, "--no-figures", "--no-progress", "-o", tmp_path / "out")
    assert call(*usual).returncode == 3
    first = place.read_bytes()
    again = call(*usual)
    assert (again.returncode, again.stderr, place.read_bytes()) == (3, "", first)  # the same, as often as one likes
    for command in ("run", "compare"):
        done = call(command, *usual[1:], *words)
        assert done.returncode == 1
        assert says in done.stderr
        assert "--force replaces it, or choose another --output" in done.stderr
        assert place.read_bytes() == first
    done = call(*usual, *words, "--force")
    assert done.returncode == 3
    assert f"replaced {place}, which held something else" in done.stderr
    assert place.read_bytes() != first


def test_what_an_edited_case_replaces_is_told(call, short_case, tmp_path):
    usual = ("run", short_case, "-o", tmp_path / "out")
    assert call(*usual).stderr.splitlines()[1:] == []
    short_case.write_text(short_case.read_text().replace("duration = 2", "duration = 3"))
    assert "selective.nc, " in (told := call(*usual).stderr)
    assert "and 8 more files, which held something else" in told


def test_a_file_that_is_no_motion_is_not_replaced(call, short_case, tmp_path):
    place = tmp_path / "out" / "short" / "selective.nc"
    place.parent.mkdir(parents=True)
    place.write_text("thesis")
    done = call("run", short_case, "--no-figures", "-o", tmp_path / "out")
    assert done.returncode == 1
    assert "is not a netCDF file" in done.stderr
    assert place.read_text() == "thesis"


def test_a_full_disk_is_told_in_one_line(short_case, tmp_path):
    """On a file system of its own: HDF5, which wrote there once, ended the process when it closed its file."""
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode:
        pytest.skip("no file systems of one's own here")
    (tmp_path / "disk").mkdir()
    mount = 'mount -t tmpfs -o size=32k none disk && exec "$@"'
    words = ["unshare", "-rm", "sh", "-c", mount, "sh", *COMMAND, "run", str(short_case), "-o", "disk", "--no-figures"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == "error: cannot write 'disk/short/selective.nc': No space left on device"


def test_models_cases_and_check(call):
    assert json.loads(call("models", "--json").stdout)["ets_vii"]["joints"] == 6
    assert "ets_vii_flight" in call("models").stdout
    assert json.loads(call("cases", "--json").stdout)["case2"]["toml"].endswith("case2.toml")
    assert "Turned solar array" in call("cases").stdout
    good = call("check", "ets_vii")
    assert good.returncode == 0
    assert "nothing suspicious" in good.stdout
    assert json.loads(call("check", "ets_vii", "--json").stdout)["mass"] == pytest.approx(2690.4)


def test_check_of_an_impossible_robot(call, write):
    text = ssm.models()["ets_vii"].read_text().replace('<mass value="35"/>', '<mass value="-35"/>')
    done = call("check", write(text))
    assert done.returncode == 1
    assert "impossible  link link_1: mass -35 kg" in done.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run", "case9"), "error: 'case9' is neither a file nor one of the cases case1"),
        (("run", "case1", "--protect", "yow"), "error: unknown protection 'yow'"),
        (("run", "case1", "--protect", "0,0,2"), "has length 2; did you mean (0, 0, 1)?"),
        (("run", "case1", "--dt", "0"), "error: case 'case1': dt is 0.0; it must be a positive time, s"),
        (("run", "case1", "--dt", "200"), "error: case 'case1': dt is 200 s, longer than the duration of 150 s"),
        (("run", "case1", "--damping", "-1"), "error: case 'case1': damping is -1.0"),
        (("run", "case1", "case1"), "error: two cases are called case1"),
        (("check", "nothing.urdf"), "error: 'nothing.urdf' is neither a file nor a robot"),
        (("plot", "nothing.nc"), "error: no motion at 'nothing.nc': not a file"),
    ],
)
def test_bad_input_is_one_line_and_status_1(call, tmp_path, words, says):
    done = call(*words, cwd=tmp_path)
    assert done.returncode == 1
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.rglob("*.nc"))


def test_an_output_that_cannot_be_written(call, tmp_path):
    (tmp_path / "taken").write_text("")
    done = call("run", "case1", "--output", tmp_path / "taken")
    assert done.returncode == 1
    assert "error: cannot write to the folder" in done.stderr
    assert "choose another with --output" in done.stderr


def test_wrong_usage_is_status_2(call):
    assert call("run").returncode == 2
    assert call("fly").returncode == 2


def test_a_target_out_of_reach_warns_and_runs(write, tmp_path):
    text = ssm.cases()["case1"].read_text().replace("[-1.8, -0.3, 1.2]", "[-1.8, -0.3, 9.0]").replace("150  #", "2  #")
    words = [*COMMAND, "run", write(text, "far.toml"), "--no-figures", "-o", tmp_path]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 3
    assert "warning: the target (-1.8, -0.3, 9) m is 5.14 m beyond the arm's reach" in done.stderr


def test_ctrl_c_keeps_what_is_done(short_case, write, tmp_path):
    endless = write(short_case.read_text().replace("duration = 2 ", "duration = 5e4 "), "endless.toml")
    words = [*COMMAND, "run", str(short_case), str(endless), "--no-figures", "-o", str(tmp_path / "out")]
    process = subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background jobs ignore it
    )
    deadline = time.monotonic() + 60
    while not (tmp_path / "out" / "short" / "selective.nc").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(3.0)
    os.kill(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "interrupted: 1 finished motions are kept" in err
    assert "short" in out
    partial = ssm.load_motion(tmp_path / "out" / "interrupted.nc")
    assert partial.attrs["outcome"] in ("running", "converged", "stalled")
    assert 2 < partial.time.values[-1] < 5e4
    assert not list(Path(tmp_path).rglob("*.part*"))


def test_the_equations_of_motion_from_the_command_line(call, short_case, tmp_path):
    done = call("run", short_case, "--dynamic", "--no-figures", "-o", tmp_path, "--json")
    assert done.returncode == 3, done.stderr
    motion = ssm.load_motion(tmp_path / "short" / "selective.nc")
    assert motion.attrs["method"] == "dynamic"
    assert motion.attrs["energy_error"] < 1e-9
    assert float(abs(motion.joint_torques).max()) > 0


@pytest.mark.parametrize(
    ("study", "more", "columns", "per_case"),
    [
        ("bending", [], "symmetric_mm", {"bending.pdf", "bending_none.nc", "bending_bending_modes.nc"}),
        ("pointing", ["--step", "0.01"], "peak_arcsec", {"pointing.png", "pointing_selective_planned.nc"}),
    ],
)
def test_a_study_writes_its_table_figures_and_motions(call, short_case, tmp_path, study, more, columns, per_case):
    done = call("study", study, short_case, "-o", tmp_path, *more)
    assert done.returncode == 0, done.stderr
    assert columns in (tmp_path / f"{study}.csv").read_text().splitlines()[0]
    assert per_case <= {path.name for path in (tmp_path / "short").iterdir()}
    assert "files in" in done.stdout


def test_the_robustness_study(call, short_case, tmp_path):
    words = ("study", "robustness", short_case, "-o", tmp_path, "--runs", "2", "--levels", "1,5", "--json")
    done = call(*words)
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert [(row["level"], row["feedback_gain"], row["runs"]) for row in rows] == [
        (0.01, 0.0, 2),
        (0.01, 1.0, 2),
        (0.05, 0.0, 2),
        (0.05, 1.0, 2),
    ]
    assert {path.name for path in tmp_path.iterdir()} >= {"robustness.csv", "effects.csv", "robustness.pdf"}


def test_numbers_that_cannot_be_read(call, short_case, tmp_path):
    done = call("study", "pointing", short_case, "-o", tmp_path, "--boresight", "up")
    assert done.returncode == 1
    assert "--boresight is 'up'; give numbers with commas between them" in done.stderr


def test_drives_that_are_too_weak_are_told_with_their_times(call, write, tmp_path):
    """Joints of 1 N m cannot start as the law asks; the motion goes on and the times are told."""
    urdf = ssm.load_robot("ets_vii").urdf.replace('effort="100"', 'effort="1"')
    assert urdf != ssm.load_robot("ets_vii").urdf
    write(urdf, "weak.urdf")
    text = ssm.cases()["case1"].read_text().replace("duration = 150", "duration = 20")
    path = write(text.replace('robot = "ets_vii"', 'robot = "weak.urdf"'), "weak.toml")
    done = call("run", path, "--dynamic", "--no-figures", "-o", tmp_path / "out")
    assert done.returncode == 3, done.stderr
    assert "weak, selective: drives at their torque limits for" in done.stdout
    assert "0.0 to " in done.stdout


def test_a_case_that_a_study_refuses_stops_it_before_it_starts(call, short_case, write, tmp_path):
    bare = write(short_case.read_text().replace("axes = [[0, 0, 1]]", 'axes = "none"'), "bare.toml")
    assert 'axes = "none"' in bare.read_text()
    done = call("study", "robustness", short_case, bare, "-o", tmp_path / "out", "--runs", "1", "--levels", "5")
    assert done.returncode == 1
    assert "case 'bare' needs a protection of rotation" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_part_that_the_robot_does_not_have_cannot_be_turned(call, short_case, write, tmp_path):
    path = write(short_case.read_text() + "\n[spacecraft]\nturned_deg = { wing_lft = 30 }\n", "typo.toml")
    done = call("run", path, "--no-figures", cwd=tmp_path)
    assert done.returncode == 1
    assert "unknown part 'wing_lft'; did you mean 'wing_left'?" in done.stderr
