"""Logs and runs at addresses that fsspec knows are as those on the disk."""

import json
import os
import socket
import time
import uuid
import zipfile
from pathlib import Path

import fsspec
import pytest
from typer.testing import CliRunner

from spelgen.addresses import local
from spelgen.cli.main import app
from spelgen.errors import LogError, RunError, SpelgenError
from spelgen.fitting import address_lock
from spelgen.fitting.address_lock import AddressLock
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.run_lock import locked
from spelgen.loaded_arm import load_arm
from spelgen.logs.read import read_logs, write_logs
from spelgen.simulation.simulate import simulate

JOINTS = ("joint1", "joint2")


@pytest.fixture
def memory():
    """A file system in memory, empty."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    return system


def test_a_run_and_its_logs_may_be_elsewhere(robots, tmp_path, memory):
    arm = load_arm(robots / "two_link.urdf")
    logs = simulate(arm, trajectories=4)
    write_logs(local("memory://data/train.parquet"), logs.train, JOINTS)
    assert memory.exists("/data/train.parquet")
    module = tmp_path / "module.py"
    options = [
        "--set",
        "epochs=2",
        "--set",
        "momentum_steps=0",
        "--quiet",
        "--robot",
        str(robots / "two_link.urdf"),
    ]
    for words in (
        ["build", str(robots / "two_link.urdf"), "--preset", "spel", "--width", "4", "-o", str(module)],
        ["train", str(module), "--data", "memory://data", "-o", "memory://runs/first", *options],
    ):
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, done.output
    assert "run folder: memory://runs/first\n" in done.output
    again = CliRunner().invoke(app, ["train", "memory://runs/first", "--data", "memory://data", "--resume"])
    assert again.exit_code == 0, again.output
    assert "finished after 2 epochs" in again.output
    assert {"config.json", "model.pt", "checkpoint.pt", "metrics.jsonl"} <= {
        path.rsplit("/", 1)[-1] for path in memory.find("/runs/first")
    }
    assert len(memory.cat("/runs/first/metrics.jsonl").splitlines()) == 2
    assert json.loads(memory.cat("/runs/first/config.json")) == RunFolder("memory://runs/first").read_config()


def test_what_is_removed_here_is_removed_there(memory):
    memory.pipe("/old/run/config.json", b"{}")
    run = RunFolder("memory://old/run")
    assert run.config.read_text() == "{}"
    run.start("source", None, force=True)
    assert memory.find("/old/run") == ["/old/run/module.py"]


def test_addresses_that_lead_nowhere(memory, tmp_path):
    with pytest.raises(LogError, match=r"^memory://none: got no such file or folder, expected a log"):
        read_logs("memory://none", JOINTS)
    with pytest.raises(SpelgenError, match=r"^nowhere://x/y: cannot be reached \(.*nowhere"):
        local("nowhere://x/y")
    assert local(tmp_path / "a:" / "b") == tmp_path / "a:" / "b"
    assert local("C:/x").name == "x"
    assert local(f"file://{tmp_path}/run") == tmp_path / "run" == local(Path(f"file://{tmp_path}/run"))


def test_keys_that_lead_out_of_an_address_are_refused(tmp_path, memory):
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as archive:
        archive.writestr("logs/train.csv", "t")
        archive.writestr("logs/../../../../../../../tmp/spelgen_was_here", "x")
    with pytest.raises(
        SpelgenError, match=r"^zip://logs::.*evil\.zip: got the key '.*was_here', expected keys in"
    ):
        local(f"zip://logs::{tmp_path}/evil.zip")
    memory.pipe("/bucket/logs/../../x.csv", b"t")
    memory.store["/bucket/logs/a/../../../y.csv"] = memory.store.popitem()[1]
    with pytest.raises(SpelgenError, match=r"^memory://bucket: got the key '.*y\.csv', expected keys inside"):
        local("memory://bucket")
    with pytest.raises(SpelgenError, match=r"^memory://data/\.\.: got the key '\.\.', expected keys inside"):
        local("memory://data/..")
    assert not Path("/tmp/spelgen_was_here").exists()


# ---- one training at a time


def holder(**changed) -> bytes:
    """What the lock of another process says, on a machine that is not this one."""
    record = {"process": 7, "host": "elsewhere", "machine": 1, "since": "2026-01-01 00:00:00", "token": "x"}
    return json.dumps(record | {"refreshed": time.time()} | changed).encode()


def test_a_run_elsewhere_belongs_to_one_training(memory):
    folder = local("memory://runs/held")
    with locked(folder):
        told = json.loads(memory.cat("/runs/held/.lock"))
        assert (told["process"], told["host"]) == (os.getpid(), socket.gethostname())
        with pytest.raises(RunError) as caught:
            AddressLock("memory://runs/held")
        assert str(caught.value) == (
            f"memory://runs/held: process {os.getpid()} on {socket.gethostname()}, since {told['since']}, trains in "
            "this folder; wait for it, or -o another; where it is gone, remove .lock there"
        )
    assert not memory.exists("/runs/held/.lock")


@pytest.mark.parametrize(
    ("changed", "gone"),
    [
        ({}, False),
        ({"refreshed": 0.0}, True),
        ({"host": socket.gethostname(), "machine": uuid.getnode(), "process": 2**22 + 1}, True),
        ({"host": socket.gethostname(), "machine": uuid.getnode(), "process": os.getppid()}, False),
    ],
)
def test_a_lock_is_taken_over_once_its_holder_is_gone(memory, changed, gone):
    memory.pipe("/runs/other/.lock", holder(**changed))
    if gone:
        with locked(local("memory://runs/other")) as notes:
            assert notes[0].message.endswith("since 2026-01-01 00:00:00, which is gone, is taken over")
    else:
        with (
            pytest.raises(RunError, match=r"process .* since 2026-01-01 00:00:00, trains in this folder"),
            locked(local("memory://runs/other")),
        ):
            pass
    assert memory.exists("/runs/other/.lock") != gone


def test_whose_lock_was_taken_over_writes_no_more(memory, monkeypatch):
    run = RunFolder("memory://runs/lost")
    with locked(run.path):
        run.save({}, {})
        before = json.loads(memory.cat("/runs/lost/.lock"))["refreshed"]
        monkeypatch.setattr(address_lock, "REFRESH", 0.0)
        run.save({}, {})
        assert json.loads(memory.cat("/runs/lost/.lock"))["refreshed"] > before
        memory.pipe("/runs/lost/.lock", holder())
        memory.rm("/runs/lost/model.pt")
        with pytest.raises(RunError, match="process 7 on elsewhere, since"):
            run.save({}, {})
        assert not memory.exists("/runs/lost/model.pt")
    assert json.loads(memory.cat("/runs/lost/.lock"))["host"] == "elsewhere"  # left to whose it is
