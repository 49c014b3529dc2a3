"""`ssm-decouple compare CASES --targets N`, in this process."""

from __future__ import annotations

import csv
import json

import pytest

import ssm_decouple as ssm
from ssm_decouple.batch import Batch


@pytest.fixture
def brief(write):
    text = ssm.cases()["case1"].read_text().replace("duration = 150", "duration = 40").replace("dt = 0.1", "dt = 0.5")
    return write(text, "brief.toml")


def test_it_prints_tables_and_writes_rows_and_a_sheet(call, brief, tmp_path, monkeypatch):
    drawn = []

    def save(figure, folder, name):  # the package's own lays the sheet out, which takes longer than all else here
        drawn.append((len(figure.axes), folder, name))
        return [folder / f"{name}.pdf"]

    monkeypatch.setattr("ssm_decouple.viewing.style.save", save)
    done = call("compare", brief, "--targets", "12", "--seed", "3", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    for word in ("95 % interval", "selective / reactionless", "what holds the stalled motions", "2 files in"):
        assert word in done.stdout
    with (tmp_path / "out" / "targets.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["law"] for row in rows] == ["none", "selective", "reactionless", "reactionless, undamped"]
    assert {row["targets"] for row in rows} == {"12"}
    assert drawn == [(8, tmp_path / "out" / "brief", "targets")]  # four maps, their colours, three panels


def test_the_seed_and_the_step_decide(call, brief, tmp_path):
    def left(*more):
        done = call("compare", brief, "--targets", "5", "--json", "--no-figures", "-o", tmp_path, *more)
        return [row["left_median_mm"] for row in json.loads(done.stdout)["rows"]]

    assert left("--seed", "1") == left("--seed", "1")
    assert left("--seed", "1") != left("--seed", "2")
    assert left("--seed", "1", "--dt", "1") != left("--seed", "1")


def test_ctrl_c_keeps_the_laws_that_are_done(call, brief, tmp_path, monkeypatch):
    plain, calls = Batch.motions, []

    def motions(self, *arguments):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return plain(self, *arguments)

    monkeypatch.setattr(Batch, "motions", motions)
    done = call("compare", brief, "--targets", "4", "--no-figures", "-o", tmp_path)
    assert done.returncode == 130
    assert "interrupted: what was finished before is kept" in done.stderr
    assert (tmp_path / "targets.csv").read_text().count("\n") == 3


@pytest.mark.parametrize(
    ("old", "new", "more", "says"),
    [
        ("", "", ("--targets", "0"), "error: case 'brief': 0 targets are no study; give a whole number from 1"),
        ("", "", ("--targets", "3", "--seed", "-2"), "error: case 'brief': seed is -2"),
        ("", "", ("--targets", "3", "--dynamic"), "the case asks for method = "),
        ("gain = 0.05", "gain = 0.05\nhold_nodes = 2", ("--targets", "3"), "law 'none': the law has hold_nodes"),
        ("[law]", "[law]\nacceleration_limit_deg = 1", ("--targets", "3"), "the law has an acceleration_limit"),
        ("axes = [[0, 0, 1]]", 'axes = "yaw"\nframe = "inertial"', ("--targets", "3"), "law 'selective': the law has"),
    ],
)
def test_what_the_engine_does_not_do_is_one_line(call, brief, tmp_path, old, new, more, says):
    text = brief.read_text()
    assert old in text
    brief.write_text(text.replace(old, new, 1) if old else text)
    done = call("compare", brief, *more, "-o", tmp_path / "out")
    assert done.returncode == 1
    assert says in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.rglob("*.csv"))
