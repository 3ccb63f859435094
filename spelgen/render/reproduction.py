"""What a run lies in and how it is made again."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from rich.filesize import decimal

from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.preprocessing import Preprocessing
from spelgen.render.plots import Record
from spelgen.settings.fits import CONFIGS
from spelgen.settings.training import TrainingSettings
from spelgen.spec import Facts, Options

HASHED = 1_000_000_000  # bytes of the largest file whose digest is computed, in some seconds


def files(folder: Path) -> list[tuple[str, str, str]]:
    """Return name, size and SHA-256 of every file of the folder but pages and what is being written."""
    entries = []
    for path in sorted(folder.iterdir()):
        # pages are made from the folder and so are no part of what is reproduced
        if path.is_file() and not path.name.startswith(".") and path.suffix != ".html":
            size, digest = path.stat().st_size, "not computed of a file above 1 GB"
            if size <= HASHED:
                with path.open("rb") as content:
                    digest = hashlib.file_digest(content, "sha256").hexdigest()
            entries.append((path.name, decimal(size), digest))
    return entries


def commands(run: RunFolder, facts: Facts, record: Record | None) -> list[str]:
    """Return what makes a run again, from its config.json; the logs' place is not known to the run."""
    # the module may name a folder of another machine before its URDF, the run calls it robot.urdf
    name = Path(facts.urdf).name
    urdf = shlex.quote(name)
    lines = []
    if run.urdf.exists():  # under the name that the module knows it by
        lines.append(f"cp RUN/{run.urdf.name} {urdf}")
        if run.settings.exists():
            lines.append(f"cp RUN/{run.settings.name} {shlex.quote(str(Path(name).with_suffix('.yaml')))}")
    build = f"spelgen build {urdf}"
    for key, value in _changed(asdict(facts.options), asdict(Options())).items():
        words = ",".join(value) if isinstance(value, (list, tuple)) else str(value)
        build += f" --{key.replace('_', '-')} {shlex.quote(words)}"
    lines.append(f"{build} -o module.py")
    if record:
        defaults = CONFIGS[record["objective"]]().model_dump(mode="json") | asdict(Preprocessing())
        defaults |= TrainingSettings().model_dump(include={"validation_fraction", "seed"})
        options = {"validation_fraction": record["validation_fraction"], "seed": record["seed"]}
        train = (
            f"spelgen train module.py --robot {urdf} --data LOGS -o RUN2 --objective {record['objective']}"
        )
        for key, value in _changed(options | record["config"] | record["preprocessing"], defaults).items():
            train += f" --set {shlex.quote(f'{key}={value}')}"
        lines.append(train)
    return [*lines, "spelgen evaluate RUN2 --data LOGS", "spelgen report RUN2"]


def _changed(options: Mapping[str, object], defaults: Mapping[str, object]) -> dict[str, object]:
    """Return the options that are set to something else than by default."""
    changed = {}
    for key, value in options.items():
        if value is not None and value != defaults.get(key) and not isinstance(value, Mapping):
            changed[key] = value
    return changed
