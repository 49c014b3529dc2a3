"""`ssm-decouple campaign ..` as a user types it."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.campaign import Campaign
from ssm_decouple.studies.store import Store

COMMAND = [sys.executable, "-c", "from ssm_decouple.cli import main; main()"]
TEXT = """
title = "Small"
seed = 1
samples = 4
chunk = 2
cases = ["short.toml"]
protections = ["none", "case"]
[target]
position = { uniform = 0.1 }
"""


@pytest.fixture
def campaign_file(write):
    write(ssm.cases()["case1"].read_text().replace("duration = 150", "duration = 2"), "short.toml")
    return write(TEXT, "campaign.toml")


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_run_status_summary_and_rerun(call, campaign_file, tmp_path):
    done = call("campaign", "run", campaign_file, "-o", "s", "--workers", "1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "8 samples are in s; next: ssm-decouple campaign summary s\n"
    assert done.stderr.splitlines()[0] == "0 of 8 samples"
    assert "8 of 8 samples, " in done.stderr
    assert "0:00:00 left" in done.stderr
    told = call("campaign", "status", "s", cwd=tmp_path)
    assert "8 of 8 samples are there, 0 are left, 0 failed" in told.stdout
    status = json.loads(call("campaign", "status", "s", "--json", cwd=tmp_path).stdout)
    assert (status["done"], status["left"], status["protections"]) == (8, 0, ["none", "case"])

    table = call("campaign", "summary", "s", "--csv", "s.csv", cwd=tmp_path)
    assert "arrived (%)" in table.stdout
    assert "0.0 (0.0 to 49.0)" in table.stdout  # Wilson's interval of 0 in 4
    rows = json.loads(call("campaign", "summary", "s", "--json", cwd=tmp_path).stdout)
    assert [(row["case"], row["protection"], row["running"]) for row in rows] == [
        ("short", "none", 4),
        ("short", "case", 4),
    ]
    assert rows[0]["median_time_s"] is None
    with (tmp_path / "s.csv").open() as file:
        assert [float(row["median_left_m"]) for row in csv.DictReader(file)] == [row["median_left_m"] for row in rows]

    again = call("campaign", "rerun", "s", "5", "-o", "out", cwd=tmp_path)
    assert "sample 5: short, protection 'case', draw 1" in again.stdout
    assert "computed again as it was: the same bits" in again.stdout
    motion = ssm.load_motion(tmp_path / "out" / "sample_5.nc")
    assert motion.target_position.values[0].tolist() == Store.open(tmp_path / "s").row(5)["target"].tolist()
    told = json.loads(call("campaign", "rerun", "s", "5", "-o", "out", "--json", cwd=tmp_path).stdout)
    assert told["same_bits"] is True
    assert told["rows"]["final_error"]["computed"] == motion.attrs["final_error"]
    assert told["rows"]["final_error"]["stored"] == pytest.approx(motion.attrs["final_error"], rel=1e-9)


def test_a_row_that_was_tampered_with_is_told(call, campaign_file, tmp_path):
    import zarr

    Campaign.load(campaign_file).run(tmp_path / "s")
    array = zarr.open_group(tmp_path / "s", mode="r+")["final_error"]
    array[5] = float(array[5]) * (1 + 1e-15)
    told = json.loads(call("campaign", "rerun", tmp_path / "s", "5", "-o", tmp_path, "--json").stdout)
    assert told["same_bits"] is False
    assert "other bits" in call("campaign", "rerun", tmp_path / "s", "5", "-o", tmp_path).stdout


def test_damage_is_listed_refused_and_mended(call, campaign_file, tmp_path):
    words = ("campaign", "run", campaign_file, "-o", "s", "--workers", "1", "--no-progress")
    assert call(*words, cwd=tmp_path).returncode == 0
    before = tree(tmp_path / "s")
    assert "8 of 8 samples are there, all as they were written" in call("campaign", "verify", "s", cwd=tmp_path).stdout
    (tmp_path / "s" / "outcome" / "c" / "1").unlink()
    damaged = (tmp_path / "s" / "target" / "c" / "3" / "0").read_bytes()[:-5]
    (tmp_path / "s" / "target" / "c" / "3" / "0").write_bytes(damaged)
    listed = ["chunk 1 (samples 2 to 3): outcome/c/1 is lost", "chunk 3 (samples 6 to 7): target/c/3/0 is damaged"]
    told = call("campaign", "verify", "s", cwd=tmp_path)
    assert told.returncode == 1
    assert told.stdout.splitlines()[:2] == [f"damaged: {line}" for line in listed]
    assert json.loads(call("campaign", "verify", "s", "--json", cwd=tmp_path).stdout)["damaged"] == listed
    status = json.loads(call("campaign", "status", "s", "--json", cwd=tmp_path).stdout)
    assert (status["done"], status["left"], status["damaged"]) == (4, 4, listed)
    for command in ("summary", "plot"):
        done = call("campaign", command, "s", cwd=tmp_path)
        assert done.returncode == 1
        assert f"'s' is damaged: {listed[0]}, and 1 more" in done.stderr
    done = call(*words, "--resume", cwd=tmp_path)
    assert done.stderr.splitlines() == [f"damaged, and made again: {line}" for line in listed]
    assert tree(tmp_path / "s") == before


def test_a_sample_that_failed_is_rerun(call, campaign_file, tmp_path, monkeypatch):
    short = campaign_file.with_name("short.toml")
    short.write_text(short.read_text().replace("dt = 0.1", 'dt = 0.1\nmethod = "dynamic"'))
    campaign_file.write_text(TEXT + "[dynamic]\nfeedback_gain = { choice = [20] }\n")
    monkeypatch.setattr(os, "cpu_count", lambda: 1)  # as many processes as that, where no number is given
    assert call("campaign", "run", campaign_file, "-o", tmp_path / "s").returncode == 0
    told = json.loads(call("campaign", "rerun", tmp_path / "s", "0", "-o", tmp_path / "out", "--json").stdout)
    assert (told["same_bits"], told["motion"]) == (True, None)
    assert told["rows"]["error"]["stored"] == told["rows"]["error"]["computed"] != ""
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run", "nothing.toml", "-o", "s"), "cannot read the campaign 'nothing.toml': No such file or directory"),
        (("run", "campaign.toml", "-o", "campaign.toml"), "'campaign.toml' is a file"),
        (("run", "campaign.toml", "-o", "s", "--workers", "0"), "workers is 0; give at least 1"),
        (
            ("run", "campaign.toml", "-o", "s", "--workers", "2", "--scheduler", "tcp://127.0.0.1:9"),
            "give --workers for processes here or --scheduler for a cluster, not both",
        ),
        (("status", "s"), "'s' is no campaign's store; 'ssm-decouple campaign run FILE --output' makes one"),
        (("summary", "."), "'.' holds something that is no campaign's store"),
    ],
)
def test_bad_input_is_one_line_and_status_1(call, campaign_file, tmp_path, words, says):
    done = call("campaign", *words, "--no-progress" if words[0] == "run" else "--json", cwd=campaign_file.parent)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert says in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_what_is_there_is_not_begun_anew(call, campaign_file, tmp_path):
    words = ("campaign", "run", campaign_file, "-o", tmp_path / "s", "--workers", "1", "--no-progress")
    assert call(*words).returncode == 0
    before = tree(tmp_path / "s")
    done = call(*words)
    assert done.returncode == 1
    assert "holds 8 of 8 samples of the campaign 'Small'; --resume goes on with it" in done.stderr
    assert call(*words, "--resume").returncode == 0
    assert tree(tmp_path / "s") == before
    assert "there is no sample 8" in call("campaign", "rerun", tmp_path / "s", "8").stderr


def test_ctrl_c_keeps_what_is_done(campaign_file, tmp_path):
    campaign_file.write_text(TEXT.replace("samples = 4", "samples = 400"))
    words = [*COMMAND, "campaign", "run", str(campaign_file), "-o", str(tmp_path / "s"), "--workers", "2"]
    process = subprocess.Popen(
        words,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    deadline = time.monotonic() + 60
    while not (tmp_path / "s" / "done" / "c").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does it: to all of them
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    *_, last = err.splitlines()
    assert last.startswith("interrupted: ")
    assert "of 800 samples are kept in" in last
    assert last.endswith("--resume goes on")
    assert "Traceback" not in err
    kept = Store.open(tmp_path / "s")
    assert 0 < kept.status().done < 800
    chunk = int(np.flatnonzero(kept.finished())[0])
    rows = kept.campaign.rows(range(*kept.campaign.span(chunk)))
    assert rows["final_error"][1] == kept.row(2 * chunk + 1)["final_error"]


def test_help_teaches(call):
    shown = call("campaign", "run", "--help").stdout
    assert "--resume" in shown
    assert "Examples:" in shown
    assert all(word in call("campaign", "--help").stdout for word in ("run", "status", "verify", "summary", "rerun"))


def test_the_example_is_a_campaign():
    campaign = Campaign.load(Path(__file__).parents[1] / "examples" / "campaign.toml")
    assert campaign.size == 1200
    assert all(campaign._engine_of(case, word) for case in campaign.cases for word in campaign.protections)
    found = campaign.rows([0, 1199])
    assert set(found["outcome"]) <= {"converged", "stalled", "running"}
