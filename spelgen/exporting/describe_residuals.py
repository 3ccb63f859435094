"""What a torch model has beside rigid bodies, as plain numbers; what is zero is left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from spelgen.dynamics.protocol import has_residuals
from spelgen.errors import RunError
from spelgen.exporting.description import Encoding, Harmonics, Network, Residuals, Splines

_NO_SPLINES = Splines((), np.zeros(0), np.zeros(0), np.zeros((0, 4)))
_NOTHING = Residuals(Encoding(False, np.zeros(0), np.zeros(0)), None, None, _NO_SPLINES, (), _NO_SPLINES)


def unsupported(what: str) -> RunError:
    """The error of a model that has no description."""
    return RunError(
        what,
        expected="closed-form, or hybrid with tanh networks",
        do="--to torch, mjcf and urdf take every preset",
    )


def residuals(dynamics: Any, prepared: Any) -> Residuals:
    """What the dynamics have beside rigid bodies. Raises RunError for Kolmogorov-Arnold networks that are not zero."""
    if not has_residuals(dynamics):
        return _NOTHING
    encoding, functions = dynamics.encoding, dynamics.joint_functions
    scale = functions.scale.unsqueeze(-1)
    return Residuals(
        encoding=Encoding(encoding.prismatic, array(encoding.center), array(encoding.reach)),
        mass=_mass(prepared.residual.mass),
        potential=_potential(prepared.residual.potential),
        torque=_splines(functions, scale * functions.raw_torque_splines),
        ripple=_ripple(functions, scale * functions.raw_torque_ripple),
        friction=_splines(functions, functions.friction_logarithms()),
    )


def constant_residual(dynamics: Any, prepared: Any) -> np.ndarray:
    """What the residual of M adds at all positions, (n, n)."""
    if not has_residuals(dynamics):
        return np.zeros((dynamics.n, dynamics.n))
    return array(prepared.residual.mass.constant).reshape(dynamics.n, dynamics.n)


def array(value: torch.Tensor) -> np.ndarray:
    """The numbers of a tensor."""
    found: np.ndarray = value.detach().double().numpy().copy()
    return found


def _mass(prepared: Any) -> Network | None:
    """y to tanh(y) @ functions: a layer more, for tanh x is 2 sigmoid(2 x) - 1."""
    layers = prepared.layers
    if layers is None or not _learned(layers):
        return None
    network, functions = _network(layers), array(prepared.functions)
    chosen = (network.weights[-1] != 0).any(axis=1) | (network.biases[-1] != 0)
    weights = (*network.weights[:-1], 2 * network.weights[-1][chosen], 2 * functions[chosen].T)
    biases = (*network.biases[:-1], 2 * network.biases[-1][chosen], -functions[chosen].sum(axis=0))
    return Network(weights, biases)


def _potential(layers: Any) -> Network | None:
    return None if layers is None or not _learned(layers) else _network(layers)


def _learned(layers: Any) -> bool:
    """Whether a network gives anything."""
    return bool(layers.weights[-1].any() or layers.biases[-1].any())


def _network(layers: Any) -> Network:
    if type(layers).__name__ != "MLPLayers":
        raise unsupported("Kolmogorov-Arnold networks beside rigid bodies")
    return Network(tuple(map(array, layers.weights)), tuple(map(array, layers.biases)))


def _splines(functions: Any, weights: torch.Tensor) -> Splines:
    joints = [joint for joint, row in enumerate(weights) if row.any()]
    return Splines(
        joints=tuple(joints),
        center=array(functions.middles[joints].mean(dim=-1)),
        spacing=array(functions.spacing[joints, 0]),
        weights=array(weights[joints]),
    )


def _ripple(functions: Any, weights: torch.Tensor) -> tuple[Harmonics, ...]:
    """By joint the multiples of a turn, then, where they stand for themselves, those of a turn of the motor."""
    found: list[Harmonics] = []
    cosines, sines = (array(half) for half in (weights * functions.revolute).chunk(2, dim=-1))
    for joint, frequencies in enumerate(array(functions.frequencies)):
        turns = np.arange(1, len(frequencies) + 1)
        own = int(np.argmin(frequencies == turns)) or len(turns)  # how many follow one another from one on
        for part in (slice(0, own), slice(own, None)):
            used = np.flatnonzero(cosines[joint, part] + 1j * sines[joint, part])
            if used.size:
                last = slice(0, used[-1] + 1)
                found.append(
                    Harmonics(
                        joint,
                        float(frequencies[part][0]),
                        cosines[joint, part][last],
                        sines[joint, part][last],
                    )
                )
    return tuple(found)
