"""ModelSpec -> the source text of the emitted module. Pure: the same spec gives the same bytes.

Text from a URDF reaches the module as identifiers and as JSON strings inside its raw docstring and its raw facts, never
as code.
"""

from __future__ import annotations

from spelgen.emission import docstring, tailored
from spelgen.emission.bundle import bundle
from spelgen.spec import ModelSpec, facts_json
from spelgen.templates import render

Value = tuple[str, str, str]
"""A property of the model: its name, what it is, and the expression that gives it."""


def emit(spec: ModelSpec) -> str:
    """The Python source of the module that ``spec`` describes; it needs torch alone."""
    part_types, parts = tailored.parts(spec)
    arm = render(
        "arm.py.jinja",
        mass_entries=tailored.mass_entries(spec),
        mass_about=docstring.mass_entries(spec),
        part_types=part_types,
        parts=parts,
    )
    model = render(
        "model.py.jinja",
        attributes=tailored.attributes(spec),
        class_summary=docstring.class_summary(spec),
        bases=tailored.bases(spec),
        servo=tailored.servo(spec),
        values=_values(spec),
    )
    imports, runtime = bundle(f"{arm}\n{model}", tailored.kinds(spec))
    return render(
        "module.py.jinja",
        title=docstring.title(spec),
        summary=docstring.summary(spec),
        picture=docstring.picture(spec),
        joint_table=docstring.joint_table(spec),
        imports=imports,
        facts=facts_json(spec),
        arm=arm.strip(),
        model=model.rstrip(),
        runtime=runtime,
    )


def _values(spec: ModelSpec) -> list[Value]:
    """Properties of the model beside those of its base: what was trained, in units."""
    if spec.servos:
        return list(_SERVO)
    values: list[Value] = []
    if spec.design.mass == "derived":
        values.append(_ARMATURE)
    if spec.design.dissipation == "per-joint":
        values.append(_VISCOUS)
    return values


_SERVO: tuple[Value, ...] = (
    ("kp", "Position gains of the servos, (n,) [Nm/rad, N/m].", "self.servo.kp()"),
    ("kd", "Velocity gains of the servos, (n,) [Nm s/rad, N s/m].", "self.servo.kd()"),
    ("delay", "Delay of the commands [s].", "self.servo.delay"),
)
_ARMATURE: Value = (
    "armature",
    "Armature, the drives' part of M's diagonal, (n,) [kg m^2, kg].",
    "self.mass.armature()",
)
_VISCOUS: Value = (
    "viscous",
    "Friction torque by velocity, (n,) [Nm s/rad, N s/m].",
    "self.friction.viscous()",
)
