"""The page that compares the evaluations of several runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from spelgen.baselines.names import MODEL
from spelgen.errors import RunError
from spelgen.evaluation.results import Results
from spelgen.evaluation.tables import figures, joined
from spelgen.files import write_text
from spelgen.fitting.run_folder import RunFolder
from spelgen.labels import listed
from spelgen.render.page import render_page
from spelgen.render.plots import growth_panels
from spelgen.render.report_page import Run, open_run

STYLES = ("model", "train", "gravity", "coriolis", "friction", "hold")


def write_runs(folders: Sequence[Path], output: Path) -> Path:
    """Write the page; return its path. Raises RunError for a folder that is not a run, or a run without evaluation."""
    return write_text(output, render_runs(folders))


def render_runs(folders: Sequence[Path]) -> str:
    """Return the page as HTML."""
    runs: dict[str, Run] = {}
    results: dict[str, Results] = {}
    for name, folder in zip(_names(folders), folders, strict=True):
        RunFolder(folder).read_record()  # raises an error if there is no run
        run = open_run(folder)
        if run.results is None:
            raise RunError("a run that is not evaluated", file=folder, do="spelgen evaluate")
        runs[name], results[name] = run, run.results
    growths = {name: (x.traces.growth, MODEL) for name, x in results.items() if x.traces.growth}
    return render_page(
        "runs.html.jinja",
        runs=runs,
        verdict=_verdict(results),
        robots=sorted({run.spec.robot for run in runs.values()}),
        tables=joined(results),
        # more runs than styles repeat the styles
        growth=growth_panels(growths, dict(zip(runs, STYLES * len(runs), strict=False)), runs),
    )


def _names(folders: Sequence[Path]) -> list[str]:
    """Return the shortest distinct ends of the folders' paths; complete paths would disclose home folders."""
    paths = list(map(Path.resolve, folders))
    names: list[str] = []
    for count in range(1, max(len(path.parts) for path in paths) + 1):
        names = ["/".join(path.parts[-count:]) for path in paths]
        if len(set(names)) == len(names):
            break
    return names


def _verdict(runs: Mapping[str, Results]) -> str:
    """Return a sentence that states, for each figure that all runs have, the run with the smallest error."""
    errors: dict[str, list[tuple[float, str, str]]] = {}
    for run, results in runs.items():
        for figure in figures(results):
            errors.setdefault(figure.label, []).append((figure.value, run, figure.text()))
    smallest: dict[str, list[str]] = {}
    for label, of_runs in errors.items():
        if len(of_runs) == len(runs):
            _, name, text = min(of_runs)
            smallest.setdefault(name, []).append(f"{label} ({text})")
    if not smallest:
        return "These runs have no common horizons or logs."
    sentences = [f"{name} has the smallest {listed(labels)}." for name, labels in smallest.items()]
    return " ".join(sentences)
