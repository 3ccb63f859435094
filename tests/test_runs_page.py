"""The pages of several runs and of an identification are complete, and tables have every figure once."""

import json
import re
import shutil

import numpy as np
import pytest
from html_page import Page
from test_report import EVALUATION, run  # noqa: F401  (a fixture)
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.errors import RunError
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import result_tables
from spelgen.identification.identify import identify
from spelgen.logs.trajectory import Trajectory
from spelgen.render.arm_pages import identification_page
from spelgen.render.report_page import render_runs


def test_runs_are_compared_and_the_better_one_of_each_row_is_marked(run, tmp_path):  # noqa: F811
    better = tmp_path / "better"
    shutil.copytree(run, better)
    changed = json.loads(json.dumps(EVALUATION))
    for horizon in changed["horizons"]:
        horizon["errors"]["model"]["mean_relative_rms"] /= 2
    changed["torque"]["model"]["mean_nmse"] = 0.02
    (better / "evaluation.json").write_text(json.dumps(changed))
    page = render_runs([run, better])
    for label, best in (("mean of joints", ["0.01"]), ("1 s", ["0.00615"])):
        cells = re.search(rf'<th scope="row">{label}</th>(.*?)</tr>', page)[1]
        assert re.findall(r'class="n best">([^<]*)<', cells) == best
    result = CliRunner().invoke(app, ["report", str(run), str(better), "-o", str(tmp_path / "both.html")])
    assert result.exit_code == 0 and (tmp_path / "both.html").exists()


def test_servo_runs_are_compared_by_replays(run, tmp_path):  # noqa: F811
    better = tmp_path / "better"
    shutil.copytree(run, better)
    for folder, mean, logs in ((run, 0.008, {"a": 0.008, "b": 0.008}), (better, 0.006, {"b": 0.006})):
        replay = {
            "name": "whole log",
            "errors": {"model": {"trajectories": logs, "mean": mean, "joints": [mean] * 3}},
        }
        changed = EVALUATION | {"horizons": [], "torque": {}, "replays": [replay]}
        (folder / "evaluation.json").write_text(json.dumps(changed))
    text = " ".join(" ".join(Page(render_runs([run, better])).text).split())
    assert "b 8 6 mean of all 8 6" in text and " a 8" not in text


def test_a_run_without_evaluation_cannot_be_compared(run):  # noqa: F811
    (run / "evaluation.json").unlink()
    with pytest.raises(RunError, match=r"not evaluated.*spelgen evaluate"):
        render_runs([run, run])


def test_runs_of_one_name_are_distinguished_by_their_folders(run, tmp_path):  # noqa: F811
    again = tmp_path / "again" / "run"
    shutil.copytree(run, again)
    page = render_runs([run, again])
    assert f"{tmp_path.name}/run" in page and "again/run" in page
    assert str(tmp_path) not in page


def test_the_table_holds_every_figure_once_with_its_unit():
    tables = result_tables(Results.from_dict(EVALUATION))
    rows = [
        (table.title, row.label, *value)
        for table in tables
        for row in table.rows
        for value in row.values.items()
    ]
    found = {tuple(row[:-1]): row[-1] for row in rows}
    assert len(found) == len(rows)
    assert found["Position error after 1 s", "joint2 [m]", "model"] == 0.02
    assert found["Error of the tip's position [mm]", "1 s", "velocity stays constant"] == 26.0
    relative = "Error relative to the motion (0: none, 1: as if the arm had stood still)"
    assert found[relative, "1 s", "URDF"] is None
    assert found["Torque error by joint, RMSE", "joint2 [N]", "model"] == 2.0


def test_the_page_of_an_identification_states_the_same_as_the_text(robots):
    arm = load_arm(robots / "rpr.urdf")
    t = np.arange(600) / 100
    q, qd, tau = (np.stack([f(k) for k in (1, 2, 3)], axis=1) for f in (
        lambda k: np.sin(k * t) / 4, lambda k: k * np.cos(k * t) / 4, lambda k: np.sin(k * t + k)
    ))  # fmt: skip
    found = identify(arm, Trajectory(t=t, q=q, qd=qd, tau=tau))
    shown = Page(identification_page(found, arm))
    text = " ".join(" ".join(shown.text).split())
    for each in found.to_dict()["base_parameters"]:
        assert each["name"] in text and f"{each['value']:.4g}" in text
    assert " ".join(found.quality().split()) in text
