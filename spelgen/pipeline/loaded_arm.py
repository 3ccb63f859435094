"""An arm as its URDF and its sidecar give it, and what can be asked of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.certificate.inspection import Inspection
from spelgen.certificate.verification import Verification
from spelgen.errors import Diagnostic
from spelgen.labels import counted
from spelgen.spec import Facts
from spelgen.structure.base_parameters import BaseParameter, base_parameters
from spelgen.structure.structure import Structure, derive
from spelgen.urdf.robot import Assume

if TYPE_CHECKING:  # SymPy is read in only for formulas
    from spelgen.certificate.formulas import Entry, Formulas


@dataclass(frozen=True, repr=False)
class LoadedArm(ConfiguredArm):
    """An arm with what is derived from it, which is worked out on first use."""

    @property
    def structure(self) -> Structure:
        """Return the structure for any inertial values: by the kinematics alone."""
        return derive(self.arm)

    @cached_property
    def base_parameters(self) -> tuple[BaseParameter, ...]:
        """The combinations of inertial parameters that the motion depends on."""
        return base_parameters(self.arm)

    @property
    def diagnostics(self) -> tuple[Diagnostic, ...]:
        """Return diagnostics of the URDF, the settings, the arm and its inputs."""
        sources = (self.robot, self.arm, self.actuation, self.settings)
        return tuple(item for source in sources for item in source.diagnostics)

    def structure_for(self, assume: Assume) -> Structure:
        """Return the structure for any inertial values, or (``inertials``) for the URDF's own.

        Raises ArmError where these are required and absent.
        """
        return derive(self.arm, assume)

    def inspect(self, assume: Assume = "kinematics") -> Inspection:
        """The structure as people and programs read it. Raises ArmError as ``structure_for`` does."""
        return Inspection(
            self.arm, self.structure_for(assume), self.actuation, self.diagnostics, self.settings.input
        )

    def verify(self, assume: Assume = "kinematics") -> Verification:
        """The structure once more, by numbers and by other programs, Pinocchio among them."""
        from spelgen.certificate.verify import verify

        return verify(self.robot, self.arm, self.structure_for(assume))

    def formulas(
        self, entry: Entry | None = None, assume: Assume = "kinematics", *, longest: int | None = None
    ) -> Formulas:
        """Return M(q) and V(q), or one entry ((row, column) from 1, or "V"), as SymPy expressions.

        They are ``.entries``, ``.mass_matrix`` and ``.potential``, in ``.q`` and ``.base_parameters``. ``longest``:
        terms of what is still written out; None: as many as a person reads.
        """
        return self.inspect(assume).closed_forms(entry, longest=longest)

    def __repr__(self) -> str:
        joints = counted(len(self.arm.coordinates), "joint")
        return f"<LoadedArm {self.arm.name!r}: {joints} of {self.robot.path.name}>"

    def _repr_html_(self) -> str:
        return self.inspect()._repr_html_()


def load_arm(
    path: str | Path,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    angle_tolerance: float = 2e-3,
) -> LoadedArm:
    """Read the URDF at ``path`` and its sidecar, and take the arm from it.

    ``joints`` names the moving joints, or ``tip`` the last link; else the sidecar does, or the longest actuated chain
    is taken.
    Angles within ``angle_tolerance`` [rad] of a special one are that one; at 0 the file's numbers are taken as
    they stand. Raises UrdfError, ArmError or SettingsError.
    """
    return LoadedArm.load(path, joints, tip, angle_tolerance)


def arm_of_module(facts: Facts, urdf: str | Path) -> LoadedArm:
    """Return the arm of an emitted module, taken from its URDF as the module was built from it."""
    options = facts.options
    return load_arm(urdf, options.joints, options.tip, options.angle_tolerance)
