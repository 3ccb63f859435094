"""A trained model for other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spelgen.errors import RunError
from spelgen.exporting.rigid_body_projection import RigidBodyProjection, rigid_body_projection
from spelgen.exporting.urdf_file import settings_text, urdf_text
from spelgen.files import write_bytes, write_text
from spelgen.fitting.fitted import Fit, load_run
from spelgen.listing import Listing, number
from spelgen.loaded_arm import LoadedArm, load_arm


@dataclass(frozen=True, eq=False, repr=False)
class Exported:
    """What was learned as a URDF and the settings beside it, and the rigid bodies that these say."""

    urdf: bytes
    settings: str
    projection: RigidBodyProjection

    def write(self, path: Path | str, *, force: bool = False) -> tuple[Path, Path]:
        """Write FILE.urdf and FILE.yaml; return both paths. Raises RunError for what exists, unless forced."""
        path = Path(path)
        beside = path.with_suffix(".yaml")
        if path == beside:
            raise RunError(f"the name {path.name!r}", expected="FILE.urdf, beside which FILE.yaml is written")
        for each in (path, beside):
            if each.exists() and not force:
                raise RunError("this output exists already", file=each, do="force replaces it")
        return write_bytes(path, self.urdf), write_text(beside, self.settings)

    @property
    def summary(self) -> tuple[str, str]:
        """How near bodies and friction are to the model's, a sentence each."""
        found = self.projection
        bodies = "bodies: the model's own"
        if found.mass_error is not None:
            bodies = (
                f"bodies: nearest to the model; M differs by {found.mass_error:.1%}, "
                f"gravity by {found.gravity_error:.1%}"
            )
        joints = zip(found.arm.arm.coordinates, found.friction_error, strict=True)
        missed = ", ".join(f"{coordinate.name} {error:.0%}" for coordinate, error in joints)
        return bodies, f"friction as viscous + Coulomb, which misses of the model's: {missed}"

    def __repr__(self) -> str:
        return f"<Exported {self.projection.arm.arm.name!r}: {'; '.join(self.summary)}>"

    def _repr_html_(self) -> str:
        rows = tuple((name, number(value)) for name, value in self.projection.base_parameters.items())
        note = "; ".join(self.summary)
        return Listing("Base parameters [kg, m]", ("parameter", "value"), rows, note).html()


def export(
    trained: Any, to: str = "urdf", path: Path | str | None = None, *, arm: Any = None, force: bool = False
) -> Exported:
    """What a fit, the folder of a run or a model has learned, for other tools; written where a path is given.

    ``urdf``: FILE.urdf and FILE.yaml. Bodies of a closed-form model are written as they are; of other models, the
    rigid bodies nearest to them. arm: of ``load_arm`` or the path of a URDF; by default the fit's. Raises RunError
    where no arm is known, or a file exists and ``force`` is not given.
    """
    if to != "urdf":
        raise RunError(f"the format {to!r}", expected="urdf")
    fit = load_run(trained) if isinstance(trained, str | Path) else trained
    model, urdf = (fit.model, fit.urdf) if isinstance(fit, Fit) else (fit, None)
    projection = rigid_body_projection(model, _arm(model, urdf if arm is None else arm))
    found = Exported(urdf_text(projection), settings_text(projection), projection)
    if path is not None:
        found.write(path, force=force)
    return found


def _arm(model: Any, known: Any) -> LoadedArm:
    if isinstance(known, LoadedArm):
        return known
    if known is None:
        raise RunError(
            "no robot.urdf",
            element="export",
            expected="a run of `spelgen train --robot FILE.urdf`, or an arm",
        )
    facts = model.facts
    return load_arm(known, facts.joints, angle_tolerance=facts.options.angle_tolerance)
