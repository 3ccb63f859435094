"""A comparison: one robot's logs, a module for each variant, a run for each seed; interrupted, it goes on.

The simulated robot is known to the models by its kinematics alone: they are built from a copy of the URDF without
inertials, and without the sidecar's drives, so that no model starts from the truth that it is judged by.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import yaml
from lxml import etree

from spelgen import pipeline
from spelgen.design import Net, Preset
from spelgen.errors import RunError
from spelgen.files import write_json, write_text
from spelgen.fitting.config import Rollout, fit_config
from spelgen.fitting.loop import EPOCH_STEPS
from spelgen.loaded_arm import LoadedArm, load_arm
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import Trajectory, write_logs
from spelgen.settings.comparison import ComparisonSettings
from spelgen.settings.settings import Settings
from spelgen.structure.nominal import working_range
from spelgen.trust import require_own_module

SCHEMA = 3


@dataclass(frozen=True)
class Variant:
    """A preset with a kind of network."""

    name: str
    preset: Preset
    net: Net | None = None


VARIANTS = (
    Variant("phnode", "phnode"),
    Variant("spel", "spel"),
    Variant("spel-kan", "spel-kan"),
    Variant("minimal", "minimal"),
    Variant("minimal-kan", "minimal", "kan"),
    Variant("closed-form", "closed-form"),
)


@dataclass(frozen=True)
class Study:
    """The files of a comparison.

    source: the robot's own URDF. logs: train.parquet and test.parquet. kinematics.urdf: what the models are
    built from. modules and runs by variant and seed; each finished run holds result.json. low, high: range of
    q [rad; m] in which M is looked at.
    """

    folder: Path
    source: Path
    robot: str
    settings: ComparisonSettings
    training: Rollout
    preprocessing: Preprocessing
    validation_fraction: float
    variants: tuple[Variant, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def logs(self) -> Path:
        return self.folder / "logs"

    @property
    def urdf(self) -> Path:
        return self.folder / "kinematics.urdf"

    def module(self, variant: Variant) -> Path:
        return self.folder / f"{variant.name.replace('-', '_')}.py"

    def run(self, variant: Variant, seed: int) -> Path:
        return self.folder / "runs" / f"{variant.name}-{seed}"

    def result(self, variant: Variant, seed: int) -> Path:
        return self.run(variant, seed) / "result.json"

    def results(self) -> Iterator[dict[str, Any]]:
        """What was measured of every finished run."""
        for variant in self.variants:
            for seed in range(self.settings.seeds):
                if self.result(variant, seed).exists():
                    yield json.loads(self.result(variant, seed).read_text(encoding="utf-8"))


def prepare_study(
    robot: Path,
    folder: Path,
    *,
    variants: Sequence[Variant] = VARIANTS,
    seeds: int | None = None,
    steps: int | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Simulate the logs and write the modules, or find them as an earlier call left them.

    Raises RunError where the folder holds another comparison, or modules that spelgen does not write so, and what
    `load_arm` and `simulate` raise.
    """
    loaded = load_arm(robot)
    chosen = {name: value for name, value in {"seeds": seeds, "steps": steps}.items() if value is not None}
    settings = loaded.settings.comparison.model_copy(update=chosen)
    ranges = [working_range(coordinate) for coordinate in loaded.arm.coordinates]
    study = Study(
        folder=folder,
        source=robot,
        robot=loaded.arm.name,
        settings=settings,
        training=_training(loaded.settings, settings),
        preprocessing=Preprocessing(**{**loaded.settings.training.preprocessing, "cutoff": 0.0}),
        validation_fraction=loaded.settings.training.validation_fraction,
        variants=tuple(variants),
        low=tuple(low for low, _ in ranges),
        high=tuple(high for _, high in ranges),
    )
    description = _description(study, loaded)
    if _known(folder, description, force=force):
        for variant in study.variants:  # the folder may come from elsewhere
            require_own_module(study.module(variant), study.urdf)
        return study
    _write_logs(study, loaded, progress)
    study.urdf.write_bytes(_without_inertials(robot))
    gravity = yaml.safe_dump({"gravity": list(loaded.settings.gravity)})
    write_text(study.urdf.with_suffix(".yaml"), gravity)
    for variant in variants:
        source = pipeline.generate(
            study.urdf, preset=variant.preset, net=variant.net, width=settings.width, depth=settings.depth
        )
        write_text(study.module(variant), source)
    write_json(folder / "study.json", description)
    return study


def _training(settings: Settings, comparison: ComparisonSettings) -> Rollout:
    """How every variant is trained: without the URDF's regularizer, which would tell the answer."""
    epochs = -(-comparison.steps // EPOCH_STEPS)
    options: dict[str, Any] = {"urdf_weight": 0.0, "epochs": epochs, "patience": epochs}
    options["momentum_steps"] = comparison.momentum_steps
    if comparison.weight_decay is not None:
        options["weight_decay"] = comparison.weight_decay
    defaults = settings.training.options
    return cast("Rollout", fit_config("rollout", rigid_bodies=False, options=options, defaults=defaults))


def _description(study: Study, loaded: LoadedArm) -> dict[str, Any]:
    """What must be the same for a comparison to go on."""
    return {
        "schema": SCHEMA,
        "robot": study.robot,
        "urdf_sha256": loaded.robot.digest,
        "simulation": loaded.settings.simulation.model_dump(mode="json"),
        "tracking": loaded.settings.tracking.model_dump(mode="json"),
        "comparison": study.settings.model_dump(mode="json"),
        "training": study.training.model_dump(mode="json"),
        "preprocessing": asdict(study.preprocessing),
        "variants": [variant.name for variant in study.variants],
    }


def _known(folder: Path, description: dict[str, Any], *, force: bool) -> bool:
    """Whether the folder holds this very comparison; RunError if it holds another that may not be replaced."""
    path = folder / "study.json"
    if path.exists() and not force:
        if json.loads(path.read_text(encoding="utf-8")) == json.loads(json.dumps(description)):
            return True
        raise RunError(
            "a comparison with other settings", file=path, do="--force begins anew, -o names another folder"
        )
    for name in ("result.json", "checkpoint.pt"):  # else another comparison's runs would go on
        for old in sorted(folder.glob(f"runs/*/{name}")):
            old.unlink()
    folder.mkdir(parents=True, exist_ok=True)
    return False


def _write_logs(study: Study, loaded: LoadedArm, progress: Callable[[int, int], None] | None) -> None:
    from spelgen.simulation.simulate import simulate

    result = simulate(loaded, progress=progress)
    names = [coordinate.name for coordinate in loaded.arm.coordinates]
    first = study.settings.first
    study.logs.mkdir(parents=True, exist_ok=True)
    write_logs(study.logs / "train.parquet", [_beginning(x, first) for x in result.train], names)
    write_logs(study.logs / "test.parquet", result.test, names)


def _beginning(trajectory: Trajectory, seconds: float | None) -> Trajectory:
    """The samples before so many seconds."""
    if seconds is None:
        return trajectory
    elapsed = trajectory.t - trajectory.t[0]
    return trajectory[: int((elapsed < seconds - 1e-9).sum())]


def _without_inertials(robot: Path) -> bytes:
    """The URDF with nothing but kinematics and limits; it was read before, so it is known to be harmless."""
    tree = etree.fromstring(
        robot.read_bytes(), etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True)
    )
    for name in ("inertial", "dynamics", "visual", "collision"):
        for element in tree.findall(f".//{name}"):
            element.getparent().remove(element)
    return etree.tostring(tree, xml_declaration=True, encoding="utf-8")
