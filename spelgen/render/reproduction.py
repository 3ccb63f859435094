"""What a run lies in and how it is made again."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.preprocessing import Preprocessing
from spelgen.settings.fits import CONFIGS
from spelgen.spec import Facts, Options


@dataclass(frozen=True)
class File:
    """A file of the run folder."""

    name: str
    size: str
    sha256: str


def files(folder: Path) -> list[File]:
    """Every file of the folder but pages and what is being written."""
    paths = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    return [
        File(path.name, _size(path.stat().st_size), hashlib.sha256(path.read_bytes()).hexdigest())
        for path in paths
        if path.suffix != ".html"
    ]


def commands(run: RunFolder, facts: Facts, record: Mapping[str, Any] | None) -> list[str]:
    """What makes a run again, from its config.json; the logs' place is not known to the run."""
    built = _flags(asdict(facts.options), asdict(Options()))
    urdf, found = shlex.quote(facts.urdf), []
    if run.urdf.exists():  # under the name that the module knows it by
        copies = [(run.urdf.name, facts.urdf)]
        if run.settings.exists():
            copies.append((run.settings.name, str(Path(facts.urdf).with_suffix(".yaml"))))
        found += [f"cp RUN/{before} {shlex.quote(after)}" for before, after in copies]
    found.append(f"spelgen build {urdf}{built} -o module.py")
    if record:
        usual = CONFIGS[record["objective"]]().model_dump(mode="json") | asdict(Preprocessing())
        usual |= {"validation_fraction": 0.25, "seed": 0}
        options = {name: record[name] for name in ("validation_fraction", "seed")}
        options |= record["config"] | record["preprocessing"]
        command = (
            f"spelgen train module.py --robot {urdf} --data LOGS -o RUN2 --objective {record['objective']}"
        )
        for key, value in _changed(options, usual).items():
            command += f" --set {shlex.quote(f'{key}={value}')}"
        found.append(command)
    return [*found, "spelgen evaluate RUN2 --data LOGS", "spelgen report RUN2"]


def _flags(chosen: Mapping[str, Any], usual: Mapping[str, Any]) -> str:
    """The command-line flags of what differs from the default."""
    text = ""
    for key, value in _changed(chosen, usual).items():
        words = ",".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
        text += f" --{key.replace('_', '-')} {shlex.quote(words)}"
    return text


def _changed(options: Mapping[str, Any], usual: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that are set to something else than usual."""
    changed = {}
    for key, value in options.items():
        if value is not None and value != usual.get(key) and not isinstance(value, Mapping):
            changed[key] = value
    return changed


def _size(count: int) -> str:
    return (
        f"{count} B" if count < 1000 else f"{count / 1000:.1f} kB" if count < 1e6 else f"{count / 1e6:.1f} MB"
    )
