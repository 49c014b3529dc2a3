from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from hypothesis import settings
from random_robots import random_robot

import ssm_decouple as ssm

# The same examples in every run; a new one that fails belongs in the test as an @example.
settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")

# Files whose tests take many seconds each: other programs, whole motions.
LONG = ("test_viewer_browser", "test_examples", "test_notebooks", "test_cli", "test_cli_campaign", "test_jax")

UR5 = "ur_description/urdf/ur5_robot.urdf"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what is long, so that at the end no worker waits for another."""
    items.sort(key=lambda item: item.path.stem not in LONG)


@pytest.fixture(scope="session")
def ets_vii() -> ssm.Robot:
    return ssm.load_robot("ets_vii")


@pytest.fixture(scope="session")
def robots(ets_vii: ssm.Robot) -> dict[str, ssm.Robot]:
    """The shipped arms, a composed one, and random trees."""
    # MuJoCo, one of the oracles, cannot have a link called "world": hence the prefix.
    composed = ssm.compose(
        "ets_vii_bus", ssm.example_robot(UR5), [-0.79, -0.29, 1.0], prefix="arm_", end_effector="tool0"
    )
    known = {"ets_vii": ets_vii, "ets_vii_flight": ssm.load_robot("ets_vii_flight"), "composed": composed}
    return known | {f"random_{seed}": random_robot(seed, joints=3 + seed % 6) for seed in range(8)}


ROBOT_NAMES = ["ets_vii", "ets_vii_flight", "composed", *(f"random_{seed}" for seed in range(8))]


@pytest.fixture(params=ROBOT_NAMES)
def robot(request: pytest.FixtureRequest, robots: dict[str, ssm.Robot]) -> ssm.Robot:
    return robots[request.param]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260723)


@pytest.fixture
def write(tmp_path: Path):
    """Write text to a file in a fresh folder and return its path."""

    def writer(text: str, name: str = "robot.urdf") -> Path:
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return writer


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., CompletedProcess[str]]:
    """Run the command as its entry point does, in this process: a new one imports for two seconds."""
    from ssm_decouple.cli import main

    def caller(*words: object, cwd: Path | None = None) -> CompletedProcess[str]:
        monkeypatch.setattr(sys, "argv", ["ssm-decouple", *map(str, words)])
        capsys.readouterr()
        with monkeypatch.context() as here, warnings.catch_warnings():
            warnings.simplefilter("default")  # a warning is told, not raised as elsewhere in the tests
            here.chdir(cwd or Path.cwd())
            with pytest.raises(SystemExit) as left:
                main()
        out, err = capsys.readouterr()
        return CompletedProcess(sys.argv, int(left.value.code or 0), out, err)

    return caller


@pytest.fixture(scope="module")
def scratch_folder(tmp_path_factory: pytest.TempPathFactory):
    """Run a module's tests in a folder of their own, where what they leave behind harms nothing."""
    before = os.getcwd()
    os.chdir(tmp_path_factory.mktemp("scratch"))
    yield
    os.chdir(before)
