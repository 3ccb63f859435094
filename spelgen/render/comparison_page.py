"""HTML page of a comparison of presets on arms: the result as a sentence, and tables."""

from collections.abc import Sequence
from pathlib import Path

from spelgen.comparison.study import Study
from spelgen.comparison.tables import ArmResults, comparison_sentence
from spelgen.files import write_text
from spelgen.labels import counted
from spelgen.templates import render_page


def write_comparison(study: Study, sections: Sequence[ArmResults]) -> Path:
    """Write comparison.html, the page about a comparison of presets, into the study's folder; return its path.

    sections: results of the runs on each arm.
    """
    jobs = {job.arm: job for job in study.jobs}
    text = render_page(
        "comparison.html.jinja",
        title=f"{', '.join(jobs)}: presets compared",
        sentence=comparison_sentence(sections),
        runs=counted(len(study.results), "run"),
        sections=sections,
        jobs=jobs,
        failures=study.failures,
    )
    return write_text(study.folder / "comparison.html", text)
