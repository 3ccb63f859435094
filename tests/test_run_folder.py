"""Run folders: no file is executed, one training at a time, and no kill corrupts them."""

import functools
import json
import math
import os
import re
import resource
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from emitted import printed_without_structure
from process_kill import killed
from time_bounds import in_time
from typer.testing import CliRunner

import spelgen
from spelgen.cli.main import app
from spelgen.emission.specify import generate
from spelgen.errors import ModuleError, RunError
from spelgen.evaluation.evaluate import evaluate
from spelgen.exporting.export import export
from spelgen.fitting import momentum_objective
from spelgen.fitting.dataset import Validation
from spelgen.fitting.fit import RunOptions
from spelgen.fitting.fitted import load_run
from spelgen.fitting.process import locked
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.train import train
from spelgen.fitting.tuning import FittingTuning
from spelgen.logs.read import write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.render.report_page import render_report
from spelgen.settings.fits import Rollout

JOINTS = ("joint1", "joint2")
QUICK = Rollout(epochs=3, momentum_steps=0, optimizer="adamw", batch=32, urdf_weight=0.0, stride=3)


def motions(count: int = 4, samples: int = 25) -> list[Trajectory]:
    random = np.random.default_rng(0)
    t = np.arange(samples) / 25.0
    found = []
    for k in range(count):
        phase = random.uniform(0, 6, 2)
        q, qd = np.sin(2 * t[:, None] + phase), 2 * np.cos(2 * t[:, None] + phase)
        found.append(Trajectory(t, q, qd, random.normal(size=(samples, 2)), f"motion_{k}"))
    return found


@pytest.fixture(scope="module", autouse=True)
def short_epochs():
    """Limit epochs to two steps: files and times of writing do not depend on the number of steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(momentum_objective, "TUNING", FittingTuning(epoch_steps=2))
        yield


@pytest.fixture(scope="module")
def start(robots, tmp_path_factory) -> Path:
    """Return a folder with a module, its URDF and a log."""
    folder = tmp_path_factory.mktemp("start")
    (folder / "arm.urdf").write_bytes((robots / "two_link.urdf").read_bytes())
    (folder / "module.py").write_text(generate(folder / "arm.urdf", width=8, depth=1))
    write_logs(folder / "train.parquet", motions(), JOINTS)
    return folder


def trained(start: Path, folder: Path, **options) -> Path:
    train(start / "module.py", [start / "train.parquet"], folder, QUICK, **options)
    return folder


# ---- no file of a run is executed


USES = {
    "load": lambda run, log: load_run(run),
    "evaluate": lambda run, log: evaluate(run, motions()),
    "export": lambda run, log: export(run),
    "resume": lambda run, log: train("", [log], run, options=RunOptions(resume=True)),
    "adapt": lambda run, log: train(None, [log], run.parent / "more", QUICK, source=run),
    "report": lambda run, log: render_report(run),
}


@pytest.mark.parametrize("use", USES)
def test_a_module_in_a_run_folder_is_neither_read_nor_executed(plain, start, tmp_path, use):
    """A module in a run folder with a valid specification is neither read nor executed."""
    run, mark = copied(plain, tmp_path / "run"), tmp_path / "mark"
    (run / "module.py").write_text(f"open({str(mark)!r}, 'w').close()\n")
    if use == "export":  # an export needs the URDF
        (run / "robot.urdf").write_bytes((start / "arm.urdf").read_bytes())
    USES[use](run, start / "train.parquet")
    assert not mark.exists()


@pytest.mark.parametrize("use", USES)
def test_a_run_of_an_earlier_version_is_refused_with_a_remedy(plain, start, tmp_path, use):
    """A run of an earlier version, which has no specification, is refused with the advice to train again."""
    run, mark = copied(plain, tmp_path / "run"), tmp_path / "mark"
    (run / "spec.json").unlink()
    (run / "module.py").write_text(f"open({str(mark)!r}, 'w').close()\n")
    with pytest.raises(RunError) as caught:
        USES[use](run, start / "train.parquet")
    assert str(caught.value) == (
        f"{run}: got a run of an earlier version of spelgen, expected a run with spec.json; "
        "build the module again with `spelgen build`, and train it again with `spelgen train`"
    )
    assert not mark.exists()


def test_a_run_is_loaded_without_symbolic_algebra(plain):
    code = "import spelgen\nprint(spelgen.load_run(sys.argv[1]).model.n)"
    assert printed_without_structure(code, plain) == "2\n"


# ---- one training at a time


def test_a_second_training_names_the_holder_of_the_folder(start, tmp_path):
    with locked(tmp_path / "run"):
        with pytest.raises(RunError) as caught:
            trained(start, tmp_path / "run")
        assert re.fullmatch(
            rf"{tmp_path}/run: process {os.getpid()} on \S+, since [-0-9]+ [:0-9]+, trains in this folder; "
            "wait for it, or -o another",
            str(caught.value),
        )
    assert not (tmp_path / "run").exists()  # the refused training has created no folder
    trained(start, tmp_path / "run")
    assert not list((tmp_path / "run").glob(".*"))


# ---- a kill at any time leaves a valid folder


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "model.pt", weights_only=True)


def test_a_training_killed_between_any_two_writes_loses_nothing(start, tmp_path):
    """A training that is killed just before or after any of its writes gives equal weights when it is resumed."""
    whole = weights(trained(start, tmp_path / "whole", urdf=start / "arm.urdf"))
    kills, write, resumed = 0, 1, set()
    run = tmp_path / "run"
    while True:
        there = (run / "config.json").exists()
        resumed.add(there)
        training = functools.partial(
            trained, start, run, urdf=start / "arm.urdf", options=RunOptions(resume=there)
        )
        if not killed(training, write, before=bool(write % 2)):
            break
        kills, write = kills + 1, write + 1
    assert kills >= 6
    assert resumed == {True, False}
    assert all(torch.equal(whole[name], x) for name, x in weights(run).items())
    assert [line["epoch"] for line in RunFolder(run).read_metrics()] == [1, 2, 3]


def test_an_interruption_before_the_first_checkpoint_leaves_no_run(start, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Validation, "measure", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            trained(start, tmp_path / "run")
    trained(start, tmp_path / "run")


def test_an_interruption_before_the_record_leaves_no_files(start, tmp_path, monkeypatch):
    """A run folder has all files of a run or none: weights without config.json would be no run."""
    with monkeypatch.context() as patch:
        patch.setattr("spelgen.fitting.fit.write_json", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            trained(start, tmp_path / "run")
    assert not list((tmp_path / "run").glob("*.*"))
    trained(start, tmp_path / "run")


def test_a_full_disk_is_reported_with_the_file(start, tmp_path):
    """If the disk is full, the error names the file, and the run is unchanged.

    The test simulates the full disk by a limit of 2000 bytes per file, above which a write fails in the same way.
    """
    run = trained(start, tmp_path / "run")
    before = weights(run)
    command = ["train", start / "module.py", "--data", start, "-o", run, "--resume", "--set", "epochs=9"]
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
    try:
        told = CliRunner().invoke(app, list(map(str, command)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert told.exit_code == 1
    assert told.stderr.splitlines()[-1] == f"{run}/model.pt: file too large"
    assert all(torch.equal(before[name], x) for name, x in weights(run).items())
    assert trained(start, run, options=RunOptions(resume=True))


# ---- damaged and foreign files


CHANGES = {
    "lost key": (lambda x: x.pop("seed"), "config.json: seed: Field required"),
    "other type": (lambda x: x.update(training=3), "config.json: training: Input should be a valid list"),
    "objective": (lambda x: x.update(objective="x"), "config.json: objective: Input should be 'torque', 'momentum'"),
    "substeps": (lambda x: x["config"].update(substeps=10**9), "config.json: config: substeps: got 1000000000"),
    "option": (lambda x: x["config"].update(lunch=1), "config.json: config: unknown option 'lunch'"),
    "mapping": (lambda x: x.update(mapping={"units": 1}), "config.json: mapping.units: Input should be a valid"),
    "cutoff": (lambda x: x["preprocessing"].update(cutoff=-1), "config.json: cutoff: got -1"),
}  # fmt: skip


@pytest.fixture(scope="module")
def plain(start, tmp_path_factory) -> Path:
    return trained(start, tmp_path_factory.mktemp("plain") / "run")


@pytest.mark.parametrize("case", CHANGES)
def test_an_invalid_config_is_reported(plain, tmp_path, case):
    change, message = CHANGES[case]
    record = json.loads((plain / "config.json").read_text())
    change(record)
    (tmp_path / "run").mkdir()
    for path in plain.iterdir():
        (tmp_path / "run" / path.name).write_bytes(path.read_bytes())
    (tmp_path / "run" / "config.json").write_text(json.dumps(record))
    with pytest.raises(RunError) as caught:
        load_run(tmp_path / "run")
    assert str(caught.value).startswith(f"{tmp_path}/run/{message}")


@pytest.mark.parametrize("name", ["config.json", "spec.json", "model.pt", "checkpoint.pt", "metrics.jsonl"])
@pytest.mark.parametrize("what", [b"", b"[]", b"\xff\xfe", b"[" * 100_000, None])
def test_broken_files_and_pipes_are_reported(plain, tmp_path, name, what):
    for path in plain.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / name).unlink()
    if what is None:
        os.mkfifo(tmp_path / name)
    else:
        (tmp_path / name).write_bytes(what)
    if name == "metrics.jsonl" and what not in (None, b"[]"):
        load_run(tmp_path)  # an incomplete last line of metrics.jsonl is omitted
    else:
        with pytest.raises(spelgen.SpelgenError, match=r"\S"):
            load_run(tmp_path)


def test_a_checkpoint_without_a_number_is_reported(plain, tmp_path):
    for path in plain.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    state = torch.load(plain / "checkpoint.pt", weights_only=True)
    torch.save(state | {"substeps": 10**9}, tmp_path / "checkpoint.pt")
    with pytest.raises(
        RunError, match=r"checkpoint\.pt: substeps: Input should be less than or equal to 1000"
    ):
        load_run(tmp_path)


def copied(plain: Path, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for path in plain.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def not_a_number(state):
    next(iter(state.values())).view(-1)[0] = torch.nan
    return state


def repeated(state):
    """Return a state whose first tensor has a shape of 4 TB, but the storage of one number."""
    return state | {next(iter(state)): torch.zeros(1).expand(10**12)}


@pytest.mark.parametrize("change", [not_a_number, repeated])
@pytest.mark.parametrize(
    "use",
    [
        lambda run, log: evaluate(run, motions()),
        lambda run, log: export(run),
        lambda run, log: train(None, [log], run.parent / "more", QUICK, source=run),
    ],
)
def test_weights_that_are_no_numbers_are_reported(plain, start, tmp_path, change, use):
    run = copied(plain, tmp_path)
    torch.save(change(weights(run)), run / "model.pt")
    with pytest.raises(RunError, match=r"model\.pt: .*(got no finite numbers|weights of another model)"):
        use(run, start / "train.parquet")


def test_a_run_whose_weights_are_no_numbers_is_not_resumed(plain, start, tmp_path):
    run = copied(plain, tmp_path)
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    not_a_number(state["best_weights"])
    torch.save(state, run / "checkpoint.pt")
    with pytest.raises(RunError, match=r"checkpoint\.pt: .*: got no finite numbers"):
        train("", [start / "train.parquet"], run, options=RunOptions(resume=True))


def test_weights_that_unpack_to_gigabytes_are_reported(plain, tmp_path):
    run = copied(plain, tmp_path)
    with zipfile.ZipFile(run / "model.pt", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("model/data/0", bytes(600_000_000))
    with pytest.raises(RunError, match=r"model\.pt: got unreadable \(ValueError\)"):
        load_run(run)


SPECS = {
    "gigabytes of weights": (
        lambda x: x["options"].update(width=10**9), "1 hidden layers of 1000000000 units, expected",
    ),
    "a number for joints": (lambda x: x.update(joints=3), "Input should be a valid tuple"),
    "a number for a name": (lambda x: x["options"].update(tip=5), "options.tip Input should be a valid string"),
    "a list for a design": (lambda x: x.update(design=[1]), "got no specification of a model"),
    "text for a number": (lambda x: x["joints"][0].update(speed="x"), "joints.0.speed Input should be a valid number"),
    "no number": (lambda x: x["joints"][0].update(speed=math.nan), "NaN is no number of a specification"),
    "infinity": (lambda x: x.update(margin=math.inf), "Infinity is no number of a specification"),
    "an index beyond": (lambda x: x["links"][1].update(joint=2), "indices contradict each other"),
    "a negative index": (lambda x: x["outputs"][0].update(joints=[-1]), "indices contradict each other"),
    "a loop of links": (lambda x: x["links"][0].update(parent=1), "indices contradict each other"),
    "equal names": (lambda x: x["joints"][1].update(name="joint1"), "indices contradict each other"),
    "an unknown key": (lambda x: x.update(call="exec"), "keys or values of other types"),
    "an unknown key inside": (lambda x: x["joints"][0].update(call="exec"), "keys or values of other types"),
    "a key less": (lambda x: x.pop("gravity"), "gravity"),
    "another format": (lambda x: x.update(format=8), "got a specification of format 8, expected 9, of this version"),
    "no format": (lambda x: x.pop("format"), "got a specification of format None, expected 9, of this version"),
    "a negative mass": (lambda x: x["links"][0].update(mass=-1.0), "a specification of no model"),
    "another design": (lambda x: x["design"].update(mass="exec"), "Input should be 'derived'"),
    "a contradiction": (lambda x: x["design"].update(memory="none", net="kan"), r"net: kan"),
}  # fmt: skip


@pytest.mark.parametrize("case", SPECS)
def test_a_specification_of_another_content_is_refused(plain, tmp_path, case):
    """A changed specification is refused by each reader, in one line that names the defect; no model is assembled."""
    change, message = SPECS[case]
    run = copied(plain, tmp_path)
    content = json.loads((run / "spec.json").read_text())
    change(content)
    (run / "spec.json").write_text(json.dumps(content))
    for use in (load_run, render_report):
        with pytest.raises(ModuleError, match=message) as caught:
            use(run)
        assert "\n" not in str(caught.value)


def test_a_huge_file_is_not_read(plain, start, tmp_path):
    run = copied(plain, tmp_path)
    with (run / "notes.bin").open("wb") as file:
        file.truncate(40 * 10**9)  # the file is sparse, and occupies no disk space
    begin = time.process_time()
    render_report(run)
    assert in_time(time.process_time() - begin, 10)
    for name in ("config.json", "metrics.jsonl", "spec.json"):
        huge = copied(plain, tmp_path / f"run_{name}")
        with (huge / name).open("wb") as file:
            file.truncate(40 * 10**9)
        with pytest.raises(spelgen.SpelgenError, match=r"got a file of 40000000000 bytes, expected at most"):
            load_run(huge)
