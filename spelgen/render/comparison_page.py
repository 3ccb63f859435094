"""A comparison -> one self-contained HTML page: tables, losses while training, predictions and M against the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from spelgen import __version__
from spelgen.comparison.study import Study
from spelgen.comparison.truth import example_positions, true_mass
from spelgen.emission.loading import load_module
from spelgen.evaluation.tables import Table
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.render.charts import Line, line_chart
from spelgen.render.learned import INERTIA_UNITS, entry_index
from spelgen.render.plots import QUANTITIES, UNITS
from spelgen.templates import render

STYLES = ("c1", "c2", "c3", "c4", "c5")


@dataclass(frozen=True)
class Panel:
    """Charts that belong together: a joint's, or that of an entry of M."""

    name: str
    charts: tuple[Markup, ...]


def write_comparison(study: Study, tables: Sequence[Table]) -> Path:
    """Write comparison.html into the study's folder; return its path."""
    results = [result for result in study.results() if result["seed"] == 0]
    names = [result["variant"] for result in results]
    styles = dict(zip(names, STYLES, strict=False))
    joint_types = load_module(study.module(study.variants[0])).joint_types
    text = render(
        "comparison.html.jinja",
        version=__version__,
        study=study,
        tables=tables,
        styles=styles,
        losses=_losses(study, styles),
        panels=_panels(results, styles, joint_types),
        entries=_entries(study, results, styles, joint_types),
    )
    return write_text(study.folder / "comparison.html", text)


def _losses(study: Study, styles: Mapping[str, str]) -> Markup:
    """Validation loss of the first seed's runs by training step."""
    lines = []
    for variant in study.variants:
        records = RunFolder(study.run(variant, 0)).read_metrics()
        if variant.name not in styles or not records:
            continue
        steps = [record["step"] for record in records]
        lines.append(Line(variant.name, steps, [record["best"] for record in records], styles[variant.name]))
    return line_chart(lines, "Best validation loss by step", "training step", "loss", log=True, width=860)


def _entries(
    study: Study,
    results: Sequence[Mapping[str, Any]],
    styles: Mapping[str, str],
    joint_types: Sequence[str],
) -> list[Panel]:
    """M's lower triangle along the first example: the true robot's, and what every variant learned."""
    shown = [result for result in results if result["examples"]]
    if not shown:
        return []
    example = shown[0]["examples"][0]
    true = true_mass(study.source, example_positions(example)).tolist()
    panels = []
    for i, j in [(row, column) for row in range(len(joint_types)) for column in range(row + 1)]:
        lines = [Line("true", example["t"], [each[i][j] for each in true], "truth")]
        for result in shown:
            learned = [each[i][j] for each in result["mass"]["along"]]
            lines.append(Line(result["variant"], example["t"], learned, styles[result["variant"]]))
        name = f"M{entry_index(i, j)}"
        unit = INERTIA_UNITS.get(f"{joint_types[i]} {joint_types[j]}", "kg m")
        chart = line_chart(lines, name, "t [s]", f"{name} [{unit}]", width=330, height=190)
        panels.append(Panel(name, (chart,)))
    return panels


def _panels(
    results: Sequence[Mapping[str, Any]], styles: Mapping[str, str], joint_types: Sequence[str]
) -> list[Panel]:
    """The first test trajectory of the results: what was measured, and what every variant predicts."""
    examples = {result["variant"]: result["examples"][0] for result in results if result["examples"]}
    if not examples:
        return []
    t = next(iter(examples.values()))["t"]
    joints = next(iter(examples.values()))["joints"]
    panels = []
    for k, (joint, kind) in enumerate(zip(joints, joint_types, strict=True)):
        charts = []
        for what, unit in zip(QUANTITIES, UNITS[kind], strict=True):
            lines = [Line("measured", t, joint[f"{what}_true"], "truth")]
            lines += [
                Line(name, t, example["joints"][k][f"{what}_pred"], styles[name])
                for name, example in examples.items()
            ]
            name = QUANTITIES[what]
            title = f"{name} of {joint['name']}"
            charts.append(line_chart(lines, title, "t [s]", f"{name} [{unit}]", width=330, height=190))
        panels.append(Panel(joint["name"], tuple(charts)))
    return panels
