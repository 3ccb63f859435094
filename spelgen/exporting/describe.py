"""A torch model and its arm -> its description: facts of the arm, values of the model; no text of the module."""

from __future__ import annotations

import copy
import keyword
import re
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from spelgen.errors import RunError
from spelgen.exporting.description import (
    Bound,
    Bristles,
    Encoding,
    FrictionLaw,
    FrictionNetwork,
    Functions,
    Learned,
    Servos,
    TrainedModel,
)
from spelgen.exporting.tip_chain import tip_chain
from spelgen.loaded_arm import LoadedArm

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel


def describe(model: EmittedModel, loaded: LoadedArm) -> TrainedModel:
    """The numbers of a trained model of this arm. Raises RunError for a preset that has no such description."""
    exact: Any = copy.deepcopy(model).double().cpu().requires_grad_(False)
    dynamics, preset, n = exact.dynamics, model.facts.options.preset, model.n
    rigid = hasattr(exact, "inertial_parameters")
    with torch.no_grad():
        prepared = dynamics.prepare()
        learned = None if rigid else _learned(dynamics, prepared, preset)
        tip_link, tip, end = tip_chain(loaded)
        gains = _array(prepared.input)
        return TrainedModel(
            name=identifier(loaded.arm.name),
            robot=loaded.arm.name,
            preset=preset,
            coordinates=loaded.arm.coordinates,
            identifiers=tuple(model.joint_names),
            gravity=np.array(loaded.arm.gravity, dtype=float),
            bodies=loaded.arm.bodies,
            inertias=_array(exact.inertial_parameters) if rigid else None,
            rotors=_array(prepared.armature) if rigid else np.zeros((n, n)),
            motors=_array(dynamics.motors) if rigid else np.eye(n),
            learned=learned,
            friction=_friction(dynamics, prepared, preset),
            bristles=_bristles(dynamics, prepared),
            inputs=np.diag(gains) if gains.ndim == 1 else gains,
            actuated=_array(dynamics.input.actuated),
            torque_offset=_array(exact.torque_offset) if rigid else np.zeros(n),
            friction_compensation=_array(dynamics.friction_compensation()) if rigid else np.zeros(n),
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


def _array(value: torch.Tensor) -> np.ndarray:
    found: np.ndarray = value.detach().double().numpy().copy()
    return found


def _friction(dynamics: Any, prepared: Any, preset: str) -> FrictionLaw | FrictionNetwork:
    constants = prepared.friction
    if hasattr(constants, "coulomb"):
        return FrictionLaw(**{name: _array(getattr(constants, name)) for name in FrictionLaw.__annotations__})
    if hasattr(constants, "smoothing"):
        names = [name for name in FrictionNetwork.__annotations__ if name != "nominal"]
        values = {name: _array(getattr(constants, name)) for name in names}
        return FrictionNetwork(**values, nominal=_array(dynamics.friction.nominal))
    raise _foreign(preset, "a full friction matrix")


def _bristles(dynamics: Any, prepared: Any) -> Bristles | None:
    fractions = getattr(prepared.friction, "bristle_fractions", None)
    if fractions is None or not fractions.shape[-1]:
        return None
    return Bristles(_array(dynamics.friction.bristles.reach), _array(fractions))


def servos_of(model: Any) -> Servos | None:
    """The position servos of a model, None where it has none."""
    if not hasattr(model, "servo"):
        return None
    kp, kd, limit = (_array(x) for x in model.servo.prepare())
    return Servos(kp, kd, limit, float(model.servo.delay))


def _learned(dynamics: Any, prepared: Any, preset: str) -> Learned:
    n, mass = dynamics.n, prepared.mass
    if isinstance(mass, torch.Tensor):  # M does not depend on q
        functions, bound = Functions((), (_array(mass).ravel(),), None), None
    elif hasattr(dynamics.mass, "bound") and hasattr(mass, "series"):
        functions = _functions(mass.layers, mass.series, preset)
        bound = Bound(*(_array(getattr(dynamics.mass.bound, name)) for name in Bound.__annotations__))
    else:
        raise _foreign(preset, "a dense mass matrix")
    potential = None
    if prepared.potential is not None:
        energy = prepared.potential.energy
        series = None if energy is None else energy.unsqueeze(0)
        potential = _functions(prepared.potential.layers, series, preset)
    features = dynamics.fourier
    encoding = Encoding(
        prismatic=dynamics.encoding.prismatic,
        center=_array(dynamics.encoding.center),
        reach=_array(dynamics.encoding.reach),
        frequencies=np.zeros((0, n)) if features is None else _array(features.frequencies).T,
        powers=np.zeros((0, n)) if features is None else _array(features.powers),
    )
    return Learned(encoding, functions, potential, bound)


def _functions(layers: Any, series: torch.Tensor | None, preset: str) -> Functions:
    if type(layers).__name__ != "MLPLayers":
        raise _foreign(preset, "Kolmogorov-Arnold networks")
    weights, biases = (tuple(map(_array, each)) for each in (layers.weights, layers.biases))
    return Functions(weights, biases, None if series is None else _array(series))


def _foreign(preset: str, what: str) -> RunError:
    return RunError(
        f"the preset {preset}, which has {what}",
        expected="closed-form, or minimal with tanh networks",
        do="--to torch, mjcf and urdf take every preset",
    )
