"""A comparison -> one self-contained HTML page: tables, losses while training, predictions and M against the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from spelgen.comparison.metrics import RunResult
from spelgen.comparison.study import Study
from spelgen.evaluation.drawn_motions import PredictedMotion
from spelgen.evaluation.plain import array
from spelgen.evaluation.tables import Table
from spelgen.evaluation.truth import true_mass
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import named_joints
from spelgen.render.charts import Chart, Line, line_chart
from spelgen.render.page import render_page
from spelgen.render.plots import Panel, mass_panels, trajectory_panels
from spelgen.spec import read_facts

STYLES = ("c1", "c2", "c3", "gravity", "c4", "c5", "c6")


def write_comparison(study: Study, tables: Sequence[Table]) -> Path:
    """Write comparison.html into the study's folder; return its path."""
    # one seed stands for all: the lines of several would cover one another
    results = [result for result in study.results() if result.seed == 0]
    styles = dict(zip([result.variant for result in results], STYLES, strict=False))
    facts = read_facts(study.module(study.variants[0]))
    examples = {result.variant: result.example for result in results if result.example is not None}
    panels, entries = [], []
    if examples:
        panels = trajectory_panels(examples, styles, named_joints(facts.joints, facts.joint_types))
        entries = _mass_panels(study, examples, results, styles, facts.joint_types)
    text = render_page(
        "comparison.html.jinja",
        study=study,
        tables=tables,
        losses=_losses(study, styles),
        panels=panels,
        entries=entries,
    )
    return write_text(study.folder / "comparison.html", text)


def _losses(study: Study, styles: Mapping[str, str]) -> Chart:
    """Return the validation loss of the first seed's runs by training step."""
    lines = []
    for variant in study.variants:
        records = RunFolder(study.run(variant, 0)).read_metrics()
        if variant.name in styles and records:
            steps, losses = array([(record["step"], record["best"]) for record in records]).T
            lines.append(Line(variant.name, steps, losses, styles[variant.name]))
    title = "Best validation loss by step"
    return line_chart(lines, title, "training step", "loss", log=True, width=560, height=250)


def _mass_panels(
    study: Study,
    examples: Mapping[str, PredictedMotion],
    results: Sequence[RunResult],
    styles: Mapping[str, str],
    joint_types: Sequence[str],
) -> list[Panel]:
    """Return M's lower triangle along the first example: the true robot's, and what every variant learned."""
    # the logs are the same for all, and so is their first motion
    along = next(iter(examples.values()))
    masses = {"true": true_mass(study.source, torch.from_numpy(along.q)).numpy()}
    for result in results:
        if result.variant in examples:
            masses[result.variant] = array(result.mass)
    rows, columns = np.tril_indices(len(joint_types))
    entries = {name: mass[:, rows, columns].T for name, mass in masses.items()}
    return mass_panels(along.t, entries, {"true": "truth", **styles}, joint_types, width=400)
