"""Each extension that docs/extending.md describes works when it is added at the stated places."""

import inspect
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import spelgen
import spelgen.exporting
from spelgen import design
from spelgen.arm.configured_arm import load_arm
from spelgen.baselines import registry
from spelgen.emission import specify
from spelgen.emission.assemble import load_module
from spelgen.errors import RunError
from spelgen.exporting import exported
from spelgen.log_checks.check_logs import check_logs
from spelgen.logs import checks, formats
from spelgen.logs.read import read_logs
from spelgen.logs.tables import LogFormat
from spelgen.logs.trajectory import Trajectory

ROOT = Path(__file__).parents[1]
JOINTS = ["joint1", "joint2"]


def places(thing: str) -> list[str]:
    """Return the source files that docs/extending.md names for an extension.

    thing: name of the extension in the first column of the page's table, such as "a baseline".
    """
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith(f"| {thing} |"))
    return re.findall(r"`(spelgen/[\w/]+\.(?:py|yaml))`", row.split("|")[2])


def stands_in(thing: str, module) -> bool:
    """Return True if docs/extending.md names the file of `module`, and at most one other file, for an extension.

    The page states that each extension is a change in one place or two. thing: name of the extension in the page.
    """
    named = places(thing)
    return str(Path(inspect.getfile(module)).relative_to(ROOT)) in named and len(named) <= 2


@pytest.fixture
def log():
    t = np.arange(400) / 100
    q = np.stack([np.sin(t), np.cos(2 * t)], axis=1)
    qd = np.stack([np.cos(t), -2 * np.sin(2 * t)], axis=1)
    return Trajectory(t=t, q=q, qd=qd, tau=np.cos(3 * q))


def test_a_preset(robots, tmp_path, monkeypatch):
    assert stands_in("a preset", design)
    presets = tmp_path / "presets"
    shutil.copytree(design.PRESETS, presets)
    text = (presets / "minimal.yaml").read_text(encoding="utf-8")
    (presets / "toy.yaml").write_text(text.replace("dissipation: per-joint", "dissipation: dense-n"))
    monkeypatch.setattr(design, "PRESETS", presets)
    for module in (design, specify):
        monkeypatch.setattr(module, "PRESET_NAMES", (*design.PRESET_NAMES, "toy"))
    path = tmp_path / "toy.py"
    path.write_text(specify.generate(robots / "two_link.urdf", "toy"), encoding="utf-8")
    model = load_module(path)
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter)
    q = torch.zeros(1, 2, dtype=torch.float64)
    assert model.spec.options.preset == "toy"
    # the dissipation couples joints 1 and 2, which friction per joint would not do
    assert model.dissipation(q, q)[0, 0, 1] != 0


def test_a_log_format(tmp_path, monkeypatch, log):
    assert stands_in("a log format", formats)

    def read(path, joints, mapping):
        path.with_suffix(".csv").write_text(path.read_text().replace(";", ","))
        return formats.CSV.read(path.with_suffix(".csv"), joints, mapping)

    monkeypatch.setattr(formats, "FORMATS", [*formats.FORMATS, LogFormat(read, suffixes=(".toy",))])
    spelgen.write_logs(tmp_path / "log.csv", [log], JOINTS)
    text = (tmp_path / "log.csv").read_text()
    (tmp_path / "log.csv").unlink()
    (tmp_path / "log.toy").write_text(text.replace(",", ";"))
    (read_back,) = read_logs([tmp_path / "log.toy"], JOINTS)
    np.testing.assert_allclose(read_back.q, log.q)


def test_a_baseline(robots, monkeypatch, log):
    assert stands_in("a baseline", registry)

    def still(windows):
        later = windows.dt.shape[1]
        q = windows.q[:, :1].expand(-1, later, -1)
        return q, 0 * q

    def stands_still(arm):
        return {"stands still": still}

    monkeypatch.setattr(registry, "BASELINES", (*registry.BASELINES, stands_still))
    results = spelgen.evaluate(spelgen.build(load_arm(robots / "two_link.urdf"), "spel", width=4), log)
    error = results.horizons[-1].errors["stands still"].mean_relative_rms
    # errors are relative to the displacement, so the prediction of no motion has the error 1
    assert error == pytest.approx(1, rel=0.2)
    assert "stands still" in results.text()


def test_an_export(robots, tmp_path, monkeypatch):
    assert stands_in("an export", exported)
    (tmp_path / "toy_export.py").write_text(
        "from spelgen.exporting.exported import Exported\n"
        "def export_toy(trained):\n"
        "    return Exported('toy', 'two_link', {'names.txt': ' '.join(trained.model.joint_names).encode()}, ())\n"
    )
    monkeypatch.setattr(spelgen.exporting, "__path__", [*spelgen.exporting.__path__, str(tmp_path)])
    arm = load_arm(robots / "two_link.urdf")
    model = spelgen.build(arm, "closed-form")
    with pytest.raises(RunError, match="the format 'toy'"):
        spelgen.export(model, "toy", arm=arm)
    monkeypatch.setitem(exported.EXPORTERS, "toy", exported.Exporter("for a toy"))
    spelgen.export(model, "toy", tmp_path / "out", arm=arm)
    assert (tmp_path / "out" / "names.txt").read_text() == "joint1 joint2"
    del sys.modules["spelgen.exporting.toy_export"]


def test_a_check_of_logs(robots, monkeypatch, log):
    assert stands_in("a check of logs", checks)

    def find_left(signals):
        return "is always left of its zero" if (signals.q < 0).all() else None

    monkeypatch.setattr(checks, "CHECKS", [*checks.CHECKS, checks.Check("left", "warning", find_left)])
    arm = load_arm(robots / "two_link.urdf")
    assert "left" not in [x.code for x in check_logs([log], arm).findings]
    report = check_logs([Trajectory(t=log.t, q=log.q - 2, qd=log.qd, tau=log.tau)], arm)
    assert "is always left of its zero" in " ".join(report.text().split())
