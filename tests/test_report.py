"""The report is one complete HTML page for any content of a run folder."""

import json
import math
import re
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from html_page import Page
from typer.testing import CliRunner

from spelgen.arm.configured_arm import load_arm
from spelgen.cli.main import app
from spelgen.design import PRESETS
from spelgen.emission.build import build
from spelgen.emission.specify import make_spec
from spelgen.emission.text import description
from spelgen.errors import RunError
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import result_tables
from spelgen.evaluation.verdict import verdict
from spelgen.fitting.run_folder import RunFolder
from spelgen.render.report_page import render_report, write_report
from spelgen.render.run_facts import commands
from spelgen.settings.fits import Rollout


def errors(share, tip=None):
    return {"q": [share, 0.02, None], "qd": [0.1, 0.2, 0.3], "q_relative_rms": [share] * 3,
            "qd_relative_rms": [share] * 3, "mean_relative_rms": share, "tip_mm": tip}  # fmt: skip


def traces(name):
    t = [0.05 * k for k in range(21)]
    wave = [[math.sin(3 * x)] * 3 for x in t]
    near = [[y[0] + 0.05 * x] * 3 for x, y in zip(t, wave, strict=True)]
    both, one = {"model": wave, "URDF": near}, [row[0] for row in wave]
    entries = [one] * 4 + [[0.0] * len(one), one]  # the entries of M, of which M32 is always zero
    grown = {"low": [0.1, 0.1], "median": [0.2, 0.3], "high": [0.4, None]}
    covered = {"low": -1.0, "high": 1.0, "counts": [1] * 24}
    return {
        "coverage": {"seconds": 1.0, "q": [covered] * 3, "qd": [covered] * 3},
        "growth": {"seconds": [0.1, 1.0], "windows": 9, "relative": {"model": grown, "URDF": grown}},
        "trajectories": [{"which": "typical", "trajectory": name, "start": 0.0, "error": 0.1, "t": t, "q": wave,
                          "qd": wave, "predicted_q": near, "predicted_qd": [[None] * 3, *near[1:]]}],
        "torques": [{"which": "typical", "trajectory": name, "t": t, "q": wave, "qd": wave, "measured": near,
                     "predicted": both,
                     "parts": dict.fromkeys(("inertia", "Coriolis", "gravity", "friction"), wave)}],
        "mass": {"trajectory": name, "t": t, "by": {"model": entries}},
        "friction": {"qd": [[-1, 0, 1]] * 3, "by": {"model": [[-2, 0, 2]] * 3}},
    }  # fmt: skip


def validation(epoch):
    return 2.0 * 0.8**epoch + 0.01 * epoch


EVALUATION = {
    "schema": 2,
    "robot": "rpr",
    "joints": ["joint1", "joint2", "joint3"],
    "trajectories": ["traj_00", "traj_02"],
    "cutoff": 8.0,
    "substeps": 4,
    "parameters": 5948,
    "horizons": [
        {"name": "1 step", "steps": 1, "seconds": 0.05, "windows": 40,
         "errors": {"model": errors(0.004), "velocity stays constant": errors(0.6), "URDF": errors(0.003)}},
        {"name": "1 s", "steps": 20, "seconds": 1.0, "windows": 2,
         "errors": {"model": errors(0.0123, 0.8), "velocity stays constant": errors(1.0, 26.0),
                    "URDF": errors(None)}},
    ],
    "torque": {"model": {"nmse": {}, "mean_nmse": 0.01, "rmse": [1.0, 2.0, 3.0]}},
    "joint_types": ["revolute", "prismatic", "revolute"],
    "diagnostics": [{"severity": "info", "code": "x", "where": "logs", "line": None,
                     "message": "<b>said</b>"}],
    "traces": traces("traj_00"),
}  # fmt: skip
EVALUATION["assessment"] = asdict(verdict(Results.from_dict(EVALUATION)))


def write_model(folder: Path, model) -> None:
    """Write the files spec.json and model.pt of a run folder."""
    (folder / "spec.json").write_text(model.spec.to_json(), encoding="utf-8")
    torch.save(model.state_dict(), folder / "model.pt")


def write_progress(folder: Path, best_epoch: int) -> None:
    """Write the file checkpoint.pt of a run of 30 epochs."""
    progress = {"epoch": 30, "step": 600, "best_loss": 0.3, "seconds": 75.0, "substeps": 4}
    torch.save({**progress, "best_epoch": best_epoch, "best_weights": {}}, folder / "checkpoint.pt")


@pytest.fixture
def run(robots, tmp_path) -> Path:
    """Return a run folder with all files of a run, written without a training."""
    folder = tmp_path / "run"
    folder.mkdir()
    write_model(folder, build(robots / "rpr.urdf"))
    config = {
        "schema": 2, "robot": "rpr", "preset": "hybrid", "joints": ["joint1", "joint2", "joint3"],
        "objective": "rollout", "config": Rollout(epochs=30).record(rigid_bodies=False), "data_digest": "d" * 64,
        "preprocessing": {"cutoff": 8.0, "decimation": 1}, "validation_fraction": 0.25, "seed": 7,
        "training": ["traj_01", "traj_03"],
        "validation": ["traj_05"], "training_windows": 34, "validation_windows": 17,
        "scales": {"q": [1, 1, 1], "qd": [1, 1, 1]}, "mapping": {},
    }  # fmt: skip
    (folder / "config.json").write_text(json.dumps(config))
    lines = [
        {"epoch": k, "step": 20 * k, "loss": 2.0 * 0.8**k, "validation": validation(k),
         "best": min(map(validation, range(1, k + 1))), "learning_rate": 1e-3, "substeps": 4, "rollbacks": 0,
         "seconds": 2.5 * k}
        for k in range(1, 31)
    ]  # fmt: skip
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "evaluation.json").write_text(json.dumps(EVALUATION))
    write_progress(folder, best_epoch=30)
    return folder


def test_page_is_complete_and_self_contained(run):
    path = write_report(run)
    assert path == run / "report.html"
    page = Page(path.read_text(encoding="utf-8"))
    assert not {"img", "iframe", "object", "base"} & set(page.tags)
    assert all(link.startswith("#") or link == "data:," for link in page.links)
    assert "url(" not in path.read_text(encoding="utf-8")
    charts = path.read_text(encoding="utf-8").count('<svg class="chart"')
    loss, growth, torques, states, friction, coverage = 1, 1, 9, 12, 3, 6
    mass = 5  # number of entries of M that are not always zero
    assert charts == loss + growth + torques + states + mass + friction + coverage
    assert "default-src 'none'" in path.read_text(encoding="utf-8")


def test_same_folder_gives_same_bytes(run):
    write_report(run)
    assert write_report(run, run.parent / "again.html").read_bytes() == (run / "report.html").read_bytes()


def test_numbers_are_those_of_the_run(run):
    text = " ".join(" ".join(Page(render_report(run)).text).split())
    assert "0.0123" in text and "0.8 mm" in text
    assert "Good enough for feed-forward control, contact detection" in text
    assert "simulation 1 s ahead; worst at joint1" in text
    assert "The model explains 99 % of the variance of the torques and is off by 1.23 % of the motion" in text
    assert "But URDF is better than the model after 1 step." in text
    assert "34 for training, 17 for validation" in text
    assert description(RunFolder(run).read_spec()) in text
    assert "import torch" not in text, "the description of the model, and not the example of its module"
    assert "--objective rollout --set seed=7 --set epochs=30 --set cutoff=8.0 --set decimation=1" in text
    assert "2,000 steps on the momentum" in text and "rk4, 4 steps between samples" in text
    assert "spelgen build rpr.urdf -o module.py spelgen train module.py --data LOGS" in text


def test_a_trajectory_of_which_a_part_validates_counts_once(run):
    config = json.loads((run / "config.json").read_text())
    for validation, said in (
        (["a (last part)"], "trained on 1 trajectory,"),
        (["b"], "trained on 2 trajectories,"),
    ):
        (run / "config.json").write_text(json.dumps(config | {"training": ["a"], "validation": validation}))
        assert said in render_report(run)


def test_a_run_of_a_custom_preset_names_the_file_that_it_needs(run, robots, tmp_path):
    preset = tmp_path / "mine.yaml"
    preset.write_text((PRESETS / "minimal.yaml").read_text())
    spec = make_spec(load_arm(robots / "rpr.urdf", joints=["joint1", "joint2"]), preset)
    first = commands(RunFolder(run), spec, RunFolder(run).read_record())[0]
    assert first == "spelgen build rpr.urdf --preset mine.yaml --joints joint1,joint2 -o module.py"


def test_long_trainings_are_reported_in_minutes_and_hours(run):
    lines = (run / "metrics.jsonl").read_text().splitlines()
    for seconds, said in ((150, "2.5 min"), (9000, "2.5 h")):
        last = json.loads(lines[-1]) | {"seconds": seconds}
        (run / "metrics.jsonl").write_text("\n".join([*lines[:-1], json.dumps(last)]))
        assert f"30 epochs, 600 steps, {said}" in render_report(run)


def test_a_run_without_improvement_is_reported(run):
    write_progress(run, best_epoch=0)
    line = json.loads((run / "metrics.jsonl").read_text().splitlines()[0]) | {"best": 0.001}
    (run / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    assert "the model of the start: no epoch was better, validation loss 0.001" in render_report(run)


def test_best_of_each_row_is_marked(run):
    rows = re.findall(r"<tr><th scope=\"row\">1 step \(0.05 s\)</th>(.*?)</tr>", render_report(run))
    assert re.findall(r'class="n( best)?">', rows[0]) == ["", "", " best"]


def test_structure_is_the_arms(run, robots):
    (run / "robot.urdf").write_bytes((robots / "rpr.urdf").read_bytes())
    kinds = re.findall(r'<td class="(zero|constant|varying)"', render_report(run))
    v, c, z = "varying", "constant", "zero"
    assert kinds == [v, v, v, v, c, z, v, z, c]


def test_learned_constants_are_those_of_the_weights(run):
    state = torch.load(run / "model.pt", weights_only=True)
    state["raw_armature"] += math.log(3.0)
    torch.save(state, run / "model.pt")
    page = render_report(run)
    for start in RunFolder(run).untrained_model().armature.tolist():
        assert f"{3 * start:.3g} " in page


@pytest.mark.parametrize("lacking, said", [
    ("evaluation.json", "Not evaluated yet"),
    ("metrics.jsonl", "No epoch is finished"),
])  # fmt: skip
def test_missing_parts_are_reported(run, lacking, said):
    assert said not in render_report(run)
    (run / lacking).unlink()
    assert said in render_report(run)


def test_a_run_without_weights_has_no_report(run):
    (run / "model.pt").unlink()
    with pytest.raises(RunError, match=r"no model\.pt, expected a run folder; make one with `spelgen train`"):
        render_report(run)


def test_an_incomplete_last_line_of_metrics_is_omitted(run):
    whole = render_report(run).count("epochs, 600 steps")
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"epoch": 31, "st')
    assert render_report(run).count("epochs, 600 steps") == whole == 1


def test_broken_line_of_metrics_is_an_error(run):
    lines = (run / "metrics.jsonl").read_text().splitlines()
    (run / "metrics.jsonl").write_text("\n".join([lines[0], "{", *lines[2:]]))
    with pytest.raises(RunError, match=r"metrics.jsonl:2: broken JSON"):
        render_report(run)


def test_a_folder_without_a_run_is_refused_with_a_remedy(tmp_path):
    with pytest.raises(RunError) as told:
        write_report(tmp_path / "nothing")
    assert str(told.value).endswith(
        "got no such run, expected a folder with config.json; make one with `spelgen train`"
    )
    assert not (tmp_path / "nothing").exists()


def test_names_from_files_are_escaped(run):
    hostile = "<script>alert(1)</script>{{ 7 * 7 }}\"'&"
    text = json.dumps(EVALUATION).replace("traj_00", json.dumps(hostile)[1:-1])
    evaluation = json.loads(text) | {"joints": [hostile, "b", "c"]}
    (run / "evaluation.json").write_text(json.dumps(evaluation))
    text = render_report(run)
    Page(text)
    assert "<b>said</b>" not in text
    assert "{{ 7 * 7 }}" in text


@pytest.mark.parametrize("preset", ["closed-form", "spel", "spel-kan", "phnode"])
def test_a_run_of_any_preset_has_its_page(run, robots, preset):
    write_model(run, build(robots / "rpr.urdf", preset, width=8))
    (run / "robot.urdf").write_bytes((robots / "rpr.urdf").read_bytes())
    (run / "robot.yaml").write_bytes((robots / "rpr.yaml").read_bytes())
    text = render_report(run)
    page = Page(text)
    assert "canvas" in page.tags and len(text) < 2_000_000
    told = " ".join(" ".join(page.text).split())
    assert ("Masses, centres of mass" in told) == (preset == "closed-form")
    assert f"Preset {preset} ," in told
    command = told[told.index(f"spelgen build RUN/robot.urdf --preset {preset} ") :]
    assert "--width 8 -o module.py spelgen train module.py --robot RUN/robot.urdf --data LOGS" in command
    units = {"Nm": "joint1", "N": "joint2"}
    for unit, joint in units.items():
        assert f"Torque of {joint}" in text and f"torque [{unit}]" in text


def test_a_root_mean_square_that_few_starts_dominate_is_stated_beside_the_median(run):
    def note(median):
        changed = json.loads(json.dumps(EVALUATION))
        changed["traces"]["growth"]["relative"]["model"]["median"] = [0.001, median]
        (run / "evaluation.json").write_text(json.dumps(changed))
        return " ".join(Page(render_report(run)).text)

    rms = EVALUATION["horizons"][-1]["errors"]["model"]["mean_relative_rms"]
    assert "After 1 s the median error is" in note(rms / 3)
    assert "few starts dominate" not in note(rms / 1.5)


def test_warnings_about_the_logs_are_in_the_report(run):
    config = json.loads((run / "config.json").read_text())
    config["warnings"] = ["link 'upper_arm': its first moment is 0.30 times the URDF's"]
    (run / "config.json").write_text(json.dumps(config))
    assert "link 'upper_arm': its first moment is 0.30 times" in " ".join(Page(render_report(run)).text)


def test_meshes_are_drawn_where_the_robot_is_named(run, robots, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    (run / "robot.urdf").write_bytes((robots / "rpr.urdf").read_bytes())
    # the mesh has 20480 faces
    trimesh.creation.icosphere(subdivisions=5, radius=0.1).export(tmp_path / "ball.stl")
    shown = '<visual><geometry><mesh filename="ball.stl"/></geometry></visual></link>'
    text = (robots / "rpr.urdf").read_text()
    (tmp_path / "rpr.urdf").write_text(text.replace("</link>", shown))
    plain, drawn = render_report(run), render_report(run, tmp_path / "rpr.urdf")
    assert "links are drawn as tubes" in plain and "links are drawn as tubes" not in drawn
    scene = json.loads(re.search(r'id="scene">(.*?)</script>', drawn)[1])
    assert 200 < sum(len(link["shape"]["faces"]) for link in scene["links"]) <= 4100
    assert len(drawn) < 2_000_000


def test_the_command_prints_the_path_of_the_page(run, tmp_path):
    done = CliRunner().invoke(app, ["report", str(run), "-o", str(tmp_path / "r.html")])
    assert done.exit_code == 0 and done.stdout.splitlines()[-1].endswith(
        "r.html: the report, for any browser"
    )
    refused = CliRunner().invoke(app, ["report", str(run), "-o", str(tmp_path / "r.json")])
    assert refused.exit_code == 2 and "'r.json' has no suffix of a format of this command" in refused.output


def test_the_table_holds_every_figure_once_with_its_unit():
    rows = [
        (table.title, row[0], name.strip(), cell.rstrip(" *"))
        for table in result_tables(Results.from_dict(EVALUATION))
        for row in table.rows
        for name, cell in zip(table.head[1:], row[1:], strict=True)
    ]
    found = {row[:-1]: row[-1] for row in rows}
    assert len(found) == len(rows)
    assert found["Position error after 1 s", "joint2 [m]", "model"] == "0.02"
    assert found["Error of the tip's position [mm]", "1 s", "velocity stays constant"] == "26"
    relative = "Error relative to the motion (0: none, 1: as if the arm had stood still)"
    assert found[relative, "1 s", "URDF"] == "-"
    assert found["Torque error by joint, RMSE", "joint2 [N]", "model"] == "2"
