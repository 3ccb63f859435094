"""A comparison -> one self-contained HTML page: tables, losses while training, predictions and M against the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from spelgen.comparison.study import Study
from spelgen.comparison.truth import example_positions, true_mass
from spelgen.emission.loading import load_module
from spelgen.evaluation.tables import Table
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import entry_name
from spelgen.render.charts import Line, line_chart
from spelgen.render.page import render_page
from spelgen.render.plots import QUANTITIES, UNITS, Panel, inertia_unit

STYLES = ("c1", "c2", "c3", "c4", "c5", "c6")


def write_comparison(study: Study, tables: Sequence[Table]) -> Path:
    """Write comparison.html into the study's folder; return its path."""
    results = [result for result in study.results() if result["seed"] == 0]
    names = [result["variant"] for result in results]
    styles = dict(zip(names, STYLES, strict=False))
    joint_types = load_module(study.module(study.variants[0])).joint_types
    text = render_page(
        "comparison.html.jinja",
        study=study,
        tables=tables,
        key=[(style, name) for name, style in styles.items()],
        verdict=_verdict(tables),
        losses=_losses(study, styles),
        panels=_panels(results, styles, joint_types),
        entries=_entries(study, results, styles, joint_types),
    )
    return write_text(study.folder / "comparison.html", text)


def _verdict(tables: Sequence[Table]) -> str:
    """Which model is best in most rows of the tables."""
    wins: dict[str, int] = {}
    rows = 0
    for table in tables:
        for row in table.rows:
            best = [name for name, cell in zip(table.columns, row.cells, strict=True) if cell.best]
            rows += bool(best)
            for name in best:
                wins[name] = wins.get(name, 0) + 1
    if not wins:
        return "Nothing was compared."
    most = max(wins, key=wins.__getitem__)
    return f"{most} is the best in {wins[most]} of {rows} rows."


def _losses(study: Study, styles: Mapping[str, str]) -> Markup:
    """Validation loss of the first seed's runs by training step."""
    lines = []
    for variant in study.variants:
        records = RunFolder(study.run(variant, 0)).read_metrics()
        if variant.name not in styles or not records:
            continue
        steps = [record["step"] for record in records]
        lines.append(Line(variant.name, steps, [record["best"] for record in records], styles[variant.name]))
    return line_chart(
        lines, "Best validation loss by step", "training step", "loss", log=True, width=560, height=250
    )


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
        name = entry_name(i, j)
        unit = inertia_unit(joint_types[i], joint_types[j])
        chart = line_chart(lines, name, "t [s]", f"{name} [{unit}]", height=170)
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
            charts.append(line_chart(lines, title, "t [s]", f"{name} [{unit}]", height=170))
        panels.append(Panel(joint["name"], tuple(charts)))
    return panels
