"""Many runs at once: each result once, whatever dies; what is left goes on."""

import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest
import torch

from spelgen.arm.configured_arm import load_arm
from spelgen.errors import RunError, SettingsError, SpelgenError
from spelgen.fleet.fleet import run_fleet
from spelgen.fleet.prepare import Preparation, prepare
from spelgen.fleet.ranking import fleet_listings, winners
from spelgen.fleet.schema import FleetRobot, load_fleet
from spelgen.logs.read import read_logs, write_logs
from spelgen.render.fleet_page import write_fleet
from spelgen.simulation.simulate import simulate
from spelgen.tasks import run_here, workers

QUICK = {"presets": ["spel"], "width": 4, "depth": 1, "training": {"epochs": 2, "momentum_steps": 0}}


pytestmark = pytest.mark.usefixtures("short_epochs")


def silent(text):
    """Nobody watches."""


@pytest.fixture(scope="module")
def logs(robots, tmp_path_factory):
    """Logs of two_link: four trajectories for training, four to test."""
    folder = tmp_path_factory.mktemp("two_link")
    arm = load_arm(robots / "two_link.urdf")
    found = simulate(arm, trajectories=8)
    names = [coordinate.name for coordinate in arm.arm.coordinates]
    write_logs(folder / "train.parquet", found.train, names)
    write_logs(folder / "test.parquet", found.test, names)
    return folder


@pytest.fixture
def fleet(robots, logs, tmp_path):
    """Writes FLEET.yaml of arms with these logs, and loads it."""

    def loaded(arms="ab", **changes):
        robot = {"urdf": str(robots / "two_link.urdf"), "data": [str(logs)]}
        path = tmp_path / "fleet.yaml"
        path.write_text(json.dumps({"robots": dict.fromkeys(arms, robot), **QUICK, **changes}))
        return load_fleet(path)

    return loaded


def kill_two(folder: Path, killed: list[int]) -> None:
    """Kills the worker that trains arm a, and tells that of arm b to end, once each has a checkpoint."""
    waiting = {"a": signal.SIGKILL, "b": signal.SIGTERM}
    for _ in range(30_000):  # a machine under load takes minutes to start workers
        for lock in folder.glob("runs/*/*/.lock"):
            try:
                text, arm = lock.read_text(), lock.parts[-3]
            except FileNotFoundError:  # a run ended between two looks
                continue
            if arm in waiting and text.startswith("process") and (lock.parent / "config.json").exists():
                killed.append(int(text.split()[1]))
                os.kill(killed[-1], waiting.pop(arm))
        if not waiting:
            return
        time.sleep(0.01)


def test_ray_runs_again_what_died_and_every_result_is_there_once(fleet, tmp_path):
    pytest.importorskip("ray")
    folder, killed = tmp_path / "out", []
    chosen = fleet(training={"epochs": 12, "patience": 12, "momentum_steps": 0})
    killer = threading.Thread(target=kill_two, args=(folder, killed))
    killer.start()
    with workers(2) as runs:
        found = run_fleet(chosen, folder, runs, silent)
    killer.join()
    assert len(set(killed)) == 2
    assert sorted(x["robot"] for x in found.results) == ["a", "b"]
    assert not found.failures
    assert len(list(folder.glob("runs/*/*/result.json"))) == 2
    a, b = (torch.load(next((folder / "runs" / x).glob("*/model.pt"))) for x in "ab")
    assert all(torch.equal(a[name], b[name]) for name in a)  # the same logs, killed at different times


def test_what_is_done_is_not_done_again_and_what_changed_is(fleet, tmp_path):
    folder = tmp_path / "out"
    first = run_fleet(fleet("a"), folder, run_here, silent)
    files = {x: x.stat().st_mtime_ns for x in folder.glob("runs/*/*/result.json")}
    again = run_fleet(fleet("a"), folder, run_here, silent)
    assert again.results == first.results == json.loads((folder / "fleet.json").read_text())["results"]
    assert files == {x: x.stat().st_mtime_ns for x in folder.glob("runs/*/*/result.json")}
    more = run_fleet(fleet("a", seeds=2), folder, run_here, silent)
    assert [x["seed"] for x in more.results] == [0, 1]
    assert all(files[x] == x.stat().st_mtime_ns for x in files)
    other = run_fleet(fleet("a", width=5), folder, run_here, silent)
    assert {x["parameters"] for x in other.results} != {x["parameters"] for x in first.results}
    (ranked,) = fleet_listings(other)
    assert ranked.rows[-1][0] == "(velocity stays constant)"
    assert {row[0] for row in ranked.rows} >= {"spel", "(URDF)", "(URDF and drives)"}
    page = write_fleet(other, fleet_listings(other), folder / "fleet.html").read_text()
    assert "Smallest error on 1 arm: spel of 1." in page
    assert winners(other) == {"spel": 1}


def test_an_arm_that_fails_is_told_and_the_others_run(fleet, tmp_path):
    chosen = fleet()
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot")
    robots = {"broken": FleetRobot(urdf=broken), "a": chosen.robots["a"]}
    found = run_fleet(chosen.model_copy(update={"robots": robots}), tmp_path / "out", run_here, silent)
    assert [x["robot"] for x in found.results] == ["a"]
    assert str(broken) in found.failures["broken"]
    assert "unexpected" not in found.failures["broken"]
    with pytest.raises(RunError, match="no arm whose logs can be used"):
        run_fleet(
            chosen.model_copy(update={"robots": {"broken": robots["broken"]}}),
            tmp_path / "none",
            run_here,
            silent,
        )


def test_folds_test_every_trajectory_once(logs, robots, tmp_path):
    robot = FleetRobot(urdf=robots / "two_link.urdf", data=(logs,))
    found = prepare(Preparation("a", robot, 4, tmp_path))
    tested = []
    for split in found:
        parts = [
            {x.q.tobytes() for x in read_logs(paths, ["joint1", "joint2"])}
            for paths in (split.train, split.test)
        ]
        assert len(parts[0]) == 6 and len(parts[1]) == 2 and not parts[0] & parts[1]
        tested += parts[1]
    assert len(set(tested)) == 8
    with pytest.raises(SpelgenError, match="9 or more, for as many splits"):
        prepare(Preparation("a", robot, 9, tmp_path))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("presets: [spel]\n", "fleet.yaml:1: robots: got nothing, expected a value"),
        (
            "robots:\n  a: {urdf: none.urdf}\npresets: [spell]\n",
            "fleet.yaml:3: presets.0: unknown preset 'spell'; did you mean 'spel'?\n"
            "fleet.yaml:2: robots.a.urdf: no such file: none.urdf; check the path",
        ),
        (
            "robots:\n  ../a: {urdf: .}\n",
            "fleet.yaml:2: robots.../a: got '../a', expected a name of letters, digits, '.', '_' and '-'",
        ),
    ],
)
def test_what_is_wrong_in_the_file_is_told_with_its_line(text, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("fleet.yaml").write_text(text)
    with pytest.raises(SettingsError if "\n" not in told else SpelgenError) as error:
        load_fleet(Path("fleet.yaml"))
    assert str(error.value) == told
