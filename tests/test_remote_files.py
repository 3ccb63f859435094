"""Logs and run folders at fsspec addresses behave like those on the local disk."""

import json
import zipfile
from pathlib import Path

import fsspec
import pytest
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.emission.specify import make_spec
from spelgen.errors import LogError, SpelgenError
from spelgen.files import local
from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.read import read_logs, write_logs
from spelgen.simulation.simulate import simulate

JOINTS = ("joint1", "joint2")


@pytest.fixture
def memory():
    """Return an empty file system in memory."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    return system


def test_a_run_and_its_logs_may_be_remote(robots, tmp_path, memory):
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
        "--set",
        "progress=false",
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
    assert (
        json.loads(memory.cat("/runs/first/config.json"))
        == RunFolder("memory://runs/first").read_record().to_dict()
    )


def test_local_removal_removes_the_remote_file(robots, memory):
    memory.pipe("/old/run/config.json", b"{}")
    run = RunFolder("memory://old/run")
    assert run.config.read_text() == "{}"
    spec = make_spec(robots / "two_link.urdf", "closed-form")
    with run.started(spec, None, force=True):
        pass
    assert memory.find("/old/run") == ["/old/run/spec.json"]
    assert run.read_spec() == spec


def test_addresses_without_files_are_refused(memory, tmp_path):
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
        SpelgenError, match=r"^zip://logs::.*evil\.zip: got the key '.*was_here', expected only keys in"
    ):
        local(f"zip://logs::{tmp_path}/evil.zip")
    memory.pipe("/bucket/logs/../../x.csv", b"t")
    memory.store["/bucket/logs/a/../../../y.csv"] = memory.store.popitem()[1]
    with pytest.raises(
        SpelgenError, match=r"^memory://bucket: got the key '.*y\.csv', expected only keys inside"
    ):
        local("memory://bucket")
    with pytest.raises(
        SpelgenError, match=r"^memory://data/\.\.: got the key '\.\.', expected only keys inside"
    ):
        local("memory://data/..")
    assert not Path("/tmp/spelgen_was_here").exists()
