"""--to urdf: the arm's own files with what was learned in them, and the friction that no URDF has words for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import yaml

from spelgen.dynamics.protocol import has_friction_state
from spelgen.exporting.describe import servos_of
from spelgen.exporting.exported import Exported
from spelgen.exporting.readme import UNITS, readme
from spelgen.exporting.rigid_body_projection import (
    RigidBodyProjection,
    rigid_body_projection,
    sampled_positions,
)
from spelgen.exporting.trained import Trained
from spelgen.exporting.urdf_file import settings_text, urdf_text
from spelgen.listing import Listing, number

LAW = (
    "viscous qd + saturation tanh(qd / saturation_velocity) + (coulomb + stribeck exp(-(qd / stribeck_velocity)^2) "
    "+ load_dependence |gravity torque|) direction; direction: tanh(qd / coulomb_smoothing_velocity), or of bristles "
    "with z' = qd - |qd| z / bristle_reach the sum of bristle_fractions z / bristle_reach; all of it times a factor "
    "that goes with the joint's position, between the two numbers of position_factor, or one where there are none"
)


SERVO = "clip(kp (u - q) - kd qd, -limit, limit), u commanded `delay` [s] before"


@dataclass(frozen=True, eq=False, repr=False)
class ExportedUrdf(Exported):
    """What was learned as a URDF and the settings beside it, and the rigid bodies that these say."""

    projection: RigidBodyProjection

    @property
    def urdf(self) -> bytes:
        """The URDF."""
        return self.files[".urdf"]

    @property
    def settings(self) -> str:
        """The settings that go beside it."""
        return self.files[".yaml"].decode()

    def _repr_html_(self) -> str:
        rows = tuple((name, number(value)) for name, value in self.projection.base_parameters.items())
        note = "; ".join(self.summary)
        return Listing("Base parameters [kg, m]", ("parameter", "value"), rows, note).html()


def export_urdf(trained: Trained) -> ExportedUrdf:
    """The URDF, its settings, and the friction of a trained model."""
    projection = rigid_body_projection(trained.model, trained.arm)
    summary = projection_summary(projection)
    use = (
        "The .urdf holds inertials, viscous and Coulomb friction, which simulators ignore; the .yaml beside it, which "
        "spelgen reads, rotor inertia and friction in both directions; .friction.yaml the model's own law."
    )
    about = f"{UNITS}; inertials of a body stand with the link that its joint moves."
    name = trained.arm.arm.name
    files = {
        ".urdf": urdf_text(projection),
        ".yaml": settings_text(projection).encode(),
        ".friction.yaml": friction_text(trained, projection).encode(),
        ".README.md": readme(
            f"{name} as a URDF", use, trained.joint_names, about, f"{summary[0]}; {summary[1]}."
        ),
    }
    return ExportedUrdf("urdf", name, files, summary, projection)


def projection_summary(found: RigidBodyProjection) -> tuple[str, str]:
    """How near bodies and friction are to the model's, a sentence each."""
    bodies = "bodies: the model's own"
    if not found.own or found.mass_error or found.gravity_error:
        bodies = (
            f"bodies: {'its own, without what it has beside them' if found.own else 'nearest to the model'}; "
            f"M differs by {found.mass_error:.1%}, gravity by {found.gravity_error:.1%}"
        )
    joints = zip(found.arm.arm.coordinates, found.friction_error, strict=True)
    missed = ", ".join(f"{coordinate.name} {error:.0%}" for coordinate, error in joints)
    return bodies, f"friction as viscous + Coulomb, which misses of the model's: {missed}"


def friction_text(trained: Trained, projection: RigidBodyProjection) -> str:
    """YAML: viscous and Coulomb friction of each joint, and the constants of the model's own law where it has one."""
    friction = trained.model.friction
    law = friction.prepare()
    constants = law._asdict() if hasattr(law, "coulomb") else {}
    if projection.own:
        factor = trained.model.friction_factor(sampled_positions(projection.arm.arm))
        if (factor != 1).any():
            constants["position_factor"] = torch.stack([factor.amin(dim=0), factor.amax(dim=0)], dim=-1)
    if has_friction_state(trained.model):
        constants["bristle_reach"] = friction.bristles.reach
    joints: dict[str, Any] = {}
    servos = servos_of(trained.model)
    for index, name in enumerate(trained.joint_names):
        simple = {
            "viscous": projection.viscous[index],
            "coulomb": [projection.forward[index], projection.backward[index]],
        }
        own = {key: value.detach().double().cpu()[index].tolist() for key, value in constants.items()}
        joints[name] = {"viscous_coulomb": _rounded(simple)} | ({"law": _rounded(own)} if own else {})
        if servos is not None:
            held = {"kp": servos.kp[index], "kd": servos.kd[index], "limit": servos.limit[index]}
            held |= {"dead_zone": servos.dead_zone[index]} if servos.dead_zone[index] else {}
            joints[name]["servo"] = _rounded({key: x for key, x in held.items() if x < float("inf")})
    content = {
        "units": "Nm, Nm s/rad and rad/s of revolute joints; N, N s/m and m/s of prismatic ones",
        "viscous_coulomb": "viscous qd + coulomb[0] where qd > 0, + coulomb[1] where qd < 0",
    }
    return yaml.safe_dump(
        content
        | ({"law": LAW} if constants else {})
        | ({"servo": SERVO, "delay": _rounded(servos.delay)} if servos else {})
        | {"joints": joints},
        sort_keys=False,
        allow_unicode=True,
    )


def _rounded(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: _rounded(value) for key, value in values.items()}
    if isinstance(values, list):
        return [_rounded(value) for value in values]
    return float(f"{values:.12g}")
