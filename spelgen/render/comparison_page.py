"""HTML page of a comparison of presets on arms: the result as a sentence and a table, then curves."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from spelgen.comparison.arms import ArmInputs
from spelgen.comparison.figures import SimulatedFigures
from spelgen.comparison.study import Study
from spelgen.comparison.tables import ArmResults, comparison_sentence
from spelgen.evaluation.plain import array
from spelgen.evaluation.rollout import true_mass
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import counted, named_joints
from spelgen.render.charts import Chart, Line, line_chart
from spelgen.render.plots import Panel, mass_panels, trajectory_panels
from spelgen.templates import render_page

STYLES = ("c1", "c2", "c3", "gravity", "c4", "c5", "c6")


@dataclass(frozen=True)
class SimulatedCurves:
    """Charts of the runs on a simulated arm: validation losses, predictions, and entries of M.

    The charts show only the first run of each preset, as lines of several seeds would overlap.
    """

    losses: Chart
    prediction: list[Panel]
    mass: list[Panel]


def write_comparison(study: Study, sections: Sequence[ArmResults]) -> Path:
    """Write comparison.html, the page about a comparison of presets, into the study's folder; return its path.

    sections: results of the runs on each arm.
    """
    curves = {}
    jobs = {job.arm: job for job in study.jobs}
    for section in sections:
        inputs = jobs[section.name].inputs
        if inputs.truth is not None:
            curves[section.name] = _curves(study, section, inputs, inputs.truth)
    text = render_page(
        "comparison.html.jinja",
        title=f"{', '.join(jobs)}: presets compared",
        sentence=comparison_sentence(sections),
        runs=counted(len(study.results), "run"),
        sections=sections,
        protocols={name: job.protocol for name, job in jobs.items() if name in curves},
        widths={name: job.width for name, job in jobs.items()},
        curves=curves,
        failures=study.failures,
    )
    return write_text(study.folder / "comparison.html", text)


def _curves(study: Study, section: ArmResults, inputs: ArmInputs, truth: Path) -> SimulatedCurves:
    """Return the charts of one simulated arm in a comparison of presets.

    Args:
        study: jobs and results of the comparison.
        section: results of the runs on this arm.
        inputs: files of the arm.
        truth: URDF with the true parameters of the simulated arm.
    """
    first: dict[str, SimulatedFigures] = {}
    for result in section.results:
        if result.simulated is not None:
            first.setdefault(result.preset, result.simulated)
    # Each preset has one style in all charts of the page.
    styles = dict(zip(first, STYLES, strict=False))
    # Jobs are reversed, so that the dictionary keeps the first run of each preset.
    folders = {job.preset: job.folder for job in reversed(study.jobs) if job.arm == section.name}
    arm = inputs.load().chain
    examples = {name: figures.example for name, figures in first.items() if figures.example is not None}
    prediction, mass = [], []
    if examples:
        prediction = trajectory_panels(examples, styles, named_joints(arm.joint_names, arm.joint_types))
        learned = {name: figures.mass for name, figures in first.items() if figures.mass is not None}
        # All presets are evaluated on the same test logs, so the measured motion of the first example is the motion of
        # every example.
        along = next(iter(examples.values()))
        true = true_mass(truth, torch.from_numpy(along.q), arm.joint_names).numpy()
        # Only the lower triangle of M is shown, since M is symmetric.
        rows, columns = np.tril_indices(len(arm.joint_types))
        entries = {name: m[:, rows, columns].T for name, m in {"true": true, **learned}.items()}
        mass = mass_panels(along.t, entries, {"true": "truth", **styles}, arm.joint_types, width=400)
    return SimulatedCurves(_losses(folders, styles), prediction, mass)


def _losses(folders: Mapping[str, Path], styles: Mapping[str, str]) -> Chart:
    """Return the chart of the best validation loss of each preset over the training steps.

    folders: {preset: run folder}. styles: {preset: CSS class}.
    """
    lines = []
    for name, style in styles.items():
        records = RunFolder(folders[name]).read_metrics()
        # A preset whose run failed has no metrics, and so no line in the chart.
        if records:
            steps, losses = array([(record["step"], record["best"]) for record in records]).T
            lines.append(Line(name, steps, losses, style))
    title = "Best validation loss by step"
    return line_chart(lines, title, "training step", "loss", log=True, width=560, height=250)
