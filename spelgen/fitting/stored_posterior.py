"""Posterior that is stored in a checkpoint."""

import copy
from pathlib import Path

import torch
from torch import Tensor

from spelgen.emission.assemble import ArmModel
from spelgen.errors import RunError
from spelgen.fitting.posterior import Posterior
from spelgen.fitting.run_record import Content
from spelgen.fitting.servo.posterior import ServoPosterior
from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.identification.intervals import Interval


def posterior_of(
    model: ArmModel, content: Content | None, delay: float, file: Path | None = None
) -> Posterior:
    """Return the posterior of a fitted model.

    Args:
        model: model with the fitted parameters.
        content: field ``posterior`` of a checkpoint: covariance of the K parameters, (K, K), delay_std [s], and, unless
            the model has position servos, torque_std, (n,) [Nm, N].
        delay: delay of the torques relative to the positions [s].
        file: path of the checkpoint, for error messages.

    Raises RunError if the content is None, or if it belongs to another model.
    """
    if content is None:
        raise RunError(
            "a fit without intervals", file=file,
            expected="rigid bodies fitted to torques or by the objective servo, and not adapted",
            do="fit the preset closed-form or hybrid by the objective torque or servo",
        )  # fmt: skip
    vector = ParameterVector(model)
    count = len(vector.flatten(vector.initial))
    covariance = _tensor(content, "covariance", (count, count))
    torque_std, delay_std = _tensor(content, "torque_std", (model.n,)), content.get("delay_std")
    servos = model.input_quantity == "position"
    if covariance is None or (torque_std is None) != servos or not isinstance(delay_std, float):
        do = "restore it from a copy, or fit again"
        raise RunError("a posterior of another model", file=file, element="posterior", do=do)
    if servos:
        delay = float(model.servo.delay)
    late = Interval("delay of the commands" if servos else "torque delay", delay, delay_std, "s", servos)
    # The posterior keeps a copy of the model, because the caller may change the model.
    model = copy.deepcopy(model).double().cpu().requires_grad_(False)
    std = None if torque_std is None else torque_std.numpy()
    return (ServoPosterior if servos else Posterior)(model, covariance, std, late if delay else None)


def _tensor(content: Content, name: str, shape: tuple[int, ...]) -> Tensor | None:
    """Return the tensor ``name``; None unless it has this shape, is float64, finite and not zero."""
    tensor = content.get(name)
    if isinstance(tensor, Tensor) and tensor.shape == shape and tensor.dtype == torch.float64:
        return tensor if tensor.any() and tensor.isfinite().all() else None
    return None
