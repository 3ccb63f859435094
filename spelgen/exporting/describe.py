"""A torch model and its arm -> its description: facts of the arm, values of the model; no text of the module."""

from __future__ import annotations

import copy
import keyword
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from spelgen.dynamics.protocol import has_rigid_bodies, has_servos
from spelgen.exporting.describe_residuals import array, constant_residual, residuals, unsupported
from spelgen.exporting.description import Bristles, FrictionLaw, Servos, TrainedModel
from spelgen.exporting.tip_chain import tip_chain
from spelgen.loaded_arm import LoadedArm

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


def describe(model: EmittedModel, loaded: LoadedArm) -> TrainedModel:
    """The numbers of a trained model of this arm. Raises RunError for a preset that has no such description."""
    exact: Any = copy.deepcopy(model).double().cpu().requires_grad_(False)
    dynamics, preset = exact, model.facts.options.preset
    if not has_rigid_bodies(exact):
        raise unsupported(f"the preset {preset}, which is not of rigid bodies")
    with torch.no_grad():
        prepared = dynamics.prepare()
        tip_link, tip, end = tip_chain(loaded)
        gains = array(prepared.input)
        return TrainedModel(
            name=identifier(loaded.arm.name),
            robot=loaded.arm.name,
            preset=preset,
            coordinates=loaded.arm.coordinates,
            identifiers=tuple(model.joint_names),
            gravity=np.array(loaded.arm.gravity, dtype=float),
            bodies=loaded.arm.bodies,
            inertias=array(exact.inertial_parameters),
            constant_mass=array(prepared.armature) + constant_residual(dynamics, prepared),
            motors=array(dynamics.motors),
            residuals=residuals(dynamics, prepared),
            friction=_friction(prepared.friction),
            bristles=_bristles(dynamics, prepared),
            inputs=np.diag(gains) if gains.ndim == 1 else gains,
            actuated=array(dynamics.input.actuated),
            torque_offset=array(exact.torque_offset),
            friction_compensation=array(dynamics.friction_compensation),
            tip_link=tip_link,
            tip=tip,
            tip_end=end,
            servos=servos_of(exact),
        )


def identifier(text: str) -> str:
    """ASCII letters, digits and underscores of a text: a name that any language takes."""
    plain = re.sub(r"[^0-9a-z]+", "_", text.lower()).strip("_")[:40]
    bad = not plain or plain[0].isdigit() or keyword.iskeyword(plain)
    return f"arm_{plain}".rstrip("_") if bad else plain


def _friction(constants: Any) -> FrictionLaw:
    return FrictionLaw(**{name: array(getattr(constants, name)) for name in FrictionLaw.__annotations__})


def _bristles(dynamics: Any, prepared: Any) -> Bristles | None:
    fractions = getattr(prepared.friction, "bristle_fractions", None)
    if fractions is None or not fractions.shape[-1]:
        return None
    return Bristles(array(dynamics.friction.bristles.reach), array(fractions))


def servos_of(model: Any) -> Servos | None:
    """The position servos of a model, None where it has none."""
    if not has_servos(model):
        return None
    kp, kd, limit, dead_zone = (array(x) for x in model.servo.prepare())
    return Servos(kp, kd, limit, dead_zone, float(model.servo.delay))
