"""Many runs at once: each result once, whatever dies; what is left goes on; units of an arm learn from one another."""

import json
import os
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from spelgen.errors import RunError, SettingsError, SpelgenError
from spelgen.fitting.fitted import load_run
from spelgen.fleet import jobs
from spelgen.fleet.fleet import run_fleet, search_options
from spelgen.fleet.jobs import Job
from spelgen.fleet.prepare import Preparation, prepare
from spelgen.fleet.ranking import fleet_listings, winners
from spelgen.fleet.schema import FleetRobot, Search, load_fleet
from spelgen.fleet.tasks import run_here, workers
from spelgen.fleet.units import LEAST_DEVIATION, spread
from spelgen.loaded_arm import load_arm
from spelgen.logs.read import read_logs, write_logs
from spelgen.render.fleet_page import write_fleet
from spelgen.settings.fits import GaussianPrior
from spelgen.simulation.simulate import simulate

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
    assert "Predicts best of 1 arm: spel of 1." in page
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
    for training, testing in found.data:
        parts = [
            {x.q.tobytes() for x in read_logs(paths, ["joint1", "joint2"])} for paths in (training, testing)
        ]
        assert len(parts[0]) == 6 and len(parts[1]) == 2 and not parts[0] & parts[1]
        tested += parts[1]
    assert len(set(tested)) == 8
    with pytest.raises(SpelgenError, match="9 or more, for as many splits"):
        prepare(Preparation("a", robot, 9, tmp_path))


def test_a_search_finds_what_is_best_and_proposes_the_same_when_it_goes_on(tmp_path):
    search = Search(
        over={"learning_rate": {"low": 1e-5, "high": 1.0, "log": True}, "width": [8, 16]}, trials=24
    )
    start = Job(
        robot="a", preset="spel", seed=0, split=0, folder=tmp_path / "spel", urdf=tmp_path, train=(), test=(),
        data="", design="spel",
    )  # fmt: skip
    asked: list[list[Job]] = []

    def run_all(jobs):
        asked.append(list(jobs))
        for job in reversed(jobs):  # workers end in any order
            loss = abs(np.log10(job.training.learning_rate) + 2) + (job.width != 16)
            yield job, RunError("not finite") if loss > 3 else {"validation": loss}

    (best,) = search_options(search, [start], run_all)
    assert best.options["width"] == 16
    assert best.validation < 0.3
    assert best.trials == 24
    once, asked = asked, []
    assert search_options(search, [start], run_all) == (best,)
    assert [[x.key for x in each] for each in asked] == [[x.key for x in each] for each in once]
    assert len({x.folder for each in once for x in each}) == 24


def test_the_spread_of_units_is_the_prior_about_what_they_share():
    common = {"rotors.raw": torch.zeros(2), "bodies.raw": torch.ones(3)}
    units = [{"rotors.raw": torch.full((2,), away), "bodies.raw": torch.ones(3)} for away in (0.1, -0.3, 5.0)]
    prior = spread(units, common, {"rotors.raw": "armature", "bodies.raw": "bodies"})
    assert prior.armature == pytest.approx(0.3)  # the middle one: one odd unit does not count
    assert prior.bodies == LEAST_DEVIATION
    assert prior.shared_armature == prior.shared_friction == 0.0
    assert prior.velocities == GaussianPrior().velocities  # of which there are no weights


def test_units_of_an_arm_share_what_they_know(robots, tmp_path, monkeypatch):
    """Three days of a two_link whose friction grows; of the third there is little, which the others make up for."""

    def torque_alone(job, run):
        score = load_run(job.folder).score(read_logs(job.test, ["joint1", "joint2"]))
        return {"errors": {}, "torque": {"model": 1 - score}}

    monkeypatch.setattr(jobs, "_judged", torque_alone)
    arm, entries = load_arm(robots / "two_link.urdf"), {}
    names = [coordinate.name for coordinate in arm.arm.coordinates]
    for day, viscous in enumerate((0.5, 1.0, 1.5), start=1):
        joint = arm.settings.joints["joint1"].model_copy(update={"viscous": viscous})
        settings = arm.settings.model_copy(update={"joints": {**arm.settings.joints, "joint1": joint}})
        made = simulate(replace(arm, settings=settings), trajectories=8, sample_rate=100.0, seed=day)
        folder = tmp_path / f"day{day}"
        write_logs(folder / "train.parquet", made.train[: 1 if day == 3 else None], names)
        write_logs(folder / "test.parquet", made.test, names)
        entries[f"day{day}"] = {
            "urdf": str(robots / "two_link.urdf"), "data": [str(folder)], "day": f"2026-01-0{day}",
        }  # fmt: skip
    content = {
        "robots": entries,
        "presets": ["closed-form"],
        "shared": True,
        "training": {"objective": "torque"},
    }
    (tmp_path / "fleet.yaml").write_text(json.dumps(content))
    found = run_fleet(load_fleet(tmp_path / "fleet.yaml"), tmp_path / "out", run_here, silent)
    assert not found.failures
    assert len(found.results) == 7
    (units,) = found.units
    assert units.days == ("2026-01-01", "2026-01-02", "2026-01-03")
    viscous = next(x for x in units.quantities if x.name == "viscous")
    assert viscous.values[0][0] < viscous.values[1][0]
    missed = {(x["robot"], x["preset"]): x["torque"]["model"] for x in found.results}
    assert missed["day3", "closed-form, units"] < missed["day3", "closed-form"]


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
            "robots:\n  a: {urdf: .}\nsearch:\n  over: {wdith: [1]}\n",
            "fleet.yaml:4: search.over.wdith: unknown option 'wdith'; did you mean 'width'?",
        ),
        (
            "robots:\n  a: {urdf: .}\nsearch:\n  over:\n    epochs: [1, 0]\n",
            "fleet.yaml:5: search.over.epochs: 0; expected greater than or equal to 1",
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
