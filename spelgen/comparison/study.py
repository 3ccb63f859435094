"""A comparison: one robot's logs, a module for each variant, a run for each seed; interrupted, it goes on.

The simulated robot is known to the models by its kinematics alone, or with inertials that are wrong: they are built
from such a copy of the URDF, and without the sidecar's drives, so that no model starts from the truth that it is judged
by. With kinematics alone all are trained for the same steps, as the robot's settings say; with wrong inertials as
`spelgen train` does by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import yaml
from pydantic import TypeAdapter

from spelgen.comparison.metrics import RunResult
from spelgen.design import Design, Net, Preset, load_design
from spelgen.errors import RunError, SettingsError
from spelgen.files import read_json, write_json, write_text
from spelgen.fitting.window.momentum import TUNING
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.pipeline.generate import generate, require_own_module
from spelgen.pipeline.loaded_arm import LoadedArm, load_arm
from spelgen.settings.comparison import ComparisonSettings
from spelgen.settings.fits import Rollout, fit_config
from spelgen.settings.settings import Settings
from spelgen.simulation.perturbed_urdf import perturbed_urdf
from spelgen.spec import read_facts

SCHEMA = 6


@dataclass(frozen=True)
class Variant:
    """A preset, or a design of one's own, with a kind of network."""

    name: str
    preset: Preset | Design
    net: Net | None = None


VARIANTS = (
    Variant("phnode", "phnode"),
    Variant("spel", "spel"),
    Variant("spel-kan", "spel-kan"),
    Variant("minimal", "minimal"),
    Variant("hybrid", "hybrid"),
    Variant("hybrid-kan", "hybrid", "kan"),
    Variant("closed-form", "closed-form"),
)


def ablation_variants() -> tuple[Variant, ...]:
    """From phnode to hybrid, one change after the other."""
    phnode = load_design("phnode")
    friction = replace(phnode, dissipation="per-joint")
    inputs = replace(friction, input="derived")
    outputs = replace(inputs, mass="derived")
    return (
        Variant("phnode", "phnode"),
        Variant("per-joint-friction", friction),
        Variant("known-inputs", inputs),
        Variant("fewest-outputs", outputs),
        Variant("minimal", "minimal"),
        Variant("hybrid", "hybrid"),
    )


@dataclass(frozen=True)
class Study:
    """The files of a comparison.

    source: the robot's own URDF. logs: train.parquet and test.parquet. kinematics.urdf: what the models are
    built from. modules and runs by variant and seed; each finished run holds result.json. training: None, as
    `spelgen train` does by itself. urdf_error: of the inertials that the models know (see `with_wrong_inertials`);
    None: they know none.
    """

    folder: Path
    source: Path
    robot: str
    settings: ComparisonSettings
    training: Rollout | None
    preprocessing: Preprocessing
    validation_fraction: float
    variants: tuple[Variant, ...]
    urdf_error: float | None

    @property
    def window(self) -> int:
        """Samples predicted together in training."""
        return (self.training or Rollout()).window

    @property
    def decimation(self) -> int:
        """Samples of a log from one sample of a window to the next."""
        return self.preprocessing.decimation or 1

    @property
    def logs(self) -> Path:
        return self.folder / "logs"

    @property
    def urdf(self) -> Path:
        return self.folder / "kinematics.urdf"

    def module(self, variant: Variant) -> Path:
        return self.folder / f"{variant.name.replace('-', '_')}.py"

    def read_logs(self, role: str) -> list[Trajectory]:
        """Return the logs to `train` on or to `test` with."""
        return read_logs([self.logs], read_facts(self.module(self.variants[0])).joints, role=role)

    def run(self, variant: Variant, seed: int) -> Path:
        return self.folder / "runs" / f"{variant.name}-{seed}"

    def result(self, variant: Variant, seed: int) -> Path:
        return self.run(variant, seed) / "result.json"

    def results(self) -> Iterator[RunResult]:
        """Yield the measurements of every finished run."""
        for variant in self.variants:
            for seed in range(self.settings.seeds):
                if self.result(variant, seed).exists():
                    yield RunResult.read(self.result(variant, seed))


def prepare_study(
    robot: Path,
    folder: Path,
    *,
    variants: Sequence[Variant] = VARIANTS,
    seeds: int | None = None,
    steps: int | None = None,
    urdf_error: float | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Simulate the logs and write the modules, or find them as an earlier call left them.

    Raises RunError where the folder holds another comparison, or modules that spelgen does not write so, SettingsError
    where the arm has position servos, and what `load_arm` and `simulate` raise.
    """
    loaded = load_arm(robot)
    if loaded.settings.input == "position":
        raise SettingsError(
            "position servos", file=robot.with_suffix(".yaml"), element="input",
            expected="torques: by these presets are compared",
            do="`spelgen train` fits what servos have to beat beside the model, `spelgen evaluate` compares them",
        )  # fmt: skip
    settings = loaded.settings.comparison
    chosen = {"seeds": seeds or settings.seeds, "steps": steps or settings.steps}
    settings = settings.model_copy(update=chosen)
    training = None
    if urdf_error is None:
        training = _training(loaded.settings, settings)
    study = Study(
        folder=folder,
        source=robot,
        robot=loaded.arm.name,
        settings=settings,
        training=training,
        # simulated states have no noise that a filter would take away
        preprocessing=Preprocessing(**{**loaded.settings.training.preprocessing, "cutoff": 0.0}),
        validation_fraction=loaded.settings.training.validation_fraction,
        variants=tuple(variants),
        urdf_error=urdf_error,
    )
    description = _description(study, loaded)
    path = folder / "study.json"
    if path.exists() and not force:
        if read_json(path, RunError) != description:
            hint = "--force begins anew, -o names another folder"
            raise RunError("a comparison with other settings", file=path, do=hint)
        for variant in study.variants:  # the folder may come from elsewhere
            require_own_module(study.module(variant), study.urdf)
        return study
    for name in ("result.json", "checkpoint.pt"):  # else another comparison's runs would go on
        for old in sorted(folder.glob(f"runs/*/{name}")):
            old.unlink()
    _write_logs(study, loaded, progress)
    _write_modules(study, loaded)
    write_json(path, description)
    return study


def _write_modules(study: Study, loaded: LoadedArm) -> None:
    """Write the URDF that the models know, and a module of each variant."""
    study.urdf.write_bytes(perturbed_urdf(study.source, study.urdf_error, TUNING.seed))
    gravity = yaml.safe_dump({"gravity": list(loaded.settings.gravity)})
    write_text(study.urdf.with_suffix(".yaml"), gravity)
    width, depth = study.settings.width, study.settings.depth
    for variant in study.variants:
        source = generate(study.urdf, variant.preset, net=variant.net, width=width, depth=depth)
        write_text(study.module(variant), source)


def _training(settings: Settings, comparison: ComparisonSettings) -> Rollout:
    """Return how every variant is trained: without the URDF's regularizer, which would tell the answer."""
    epochs = -(-comparison.steps // TUNING.epoch_steps)
    options: dict[str, object] = {
        "urdf_weight": 0.0, "epochs": epochs, "patience": epochs, "momentum_steps": comparison.momentum_steps
    }  # fmt: skip
    if comparison.weight_decay is not None:
        options["weight_decay"] = comparison.weight_decay
    defaults = settings.training.options
    return cast("Rollout", fit_config("rollout", rigid_bodies=False, options=options, defaults=defaults))


def _description(study: Study, loaded: LoadedArm) -> dict[str, object]:
    """Return what must be the same for a comparison to go on; seeds may be added."""
    apart: Any = {"folder": True, "source": True, "settings": {"seeds"}, "variants": {"__all__": {"preset"}}}
    return {
        "schema": SCHEMA,
        "urdf_sha256": loaded.robot.digest,
        "simulation": loaded.settings.simulation.model_dump(mode="json"),
        "tracking": loaded.settings.tracking.model_dump(mode="json"),
        **TypeAdapter(Study).dump_python(study, mode="json", exclude=apart),
    }


def _write_logs(study: Study, loaded: LoadedArm, progress: Callable[[int, int], None] | None) -> None:
    from spelgen.simulation.simulate import simulate

    result = simulate(loaded, progress=progress)
    names = loaded.arm.joint_names
    training = result.train
    if study.settings.first is not None:  # the seconds that are trained on
        training = tuple(x[: int((x.t - x.t[0] < study.settings.first - 1e-9).sum())] for x in training)
    study.logs.mkdir(parents=True, exist_ok=True)
    write_logs(study.logs / "train.parquet", training, names)
    write_logs(study.logs / "test.parquet", result.test, names)
