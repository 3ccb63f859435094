"""Posterior of a fit to positions under position servos: its content in a checkpoint, and its intervals.

Damping, friction and other quantities are determined only relative to kp.
"""

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from spelgen.emission.assemble import ArmModel
from spelgen.fitting.drive_quantities import DriveQuantity, ModelFunction, friction_line
from spelgen.fitting.posterior import Posterior, Propagated
from spelgen.fitting.run_record import Content
from spelgen.fitting.servo.parameters import DELAY
from spelgen.fitting.servo.problem import ServoProblem
from spelgen.fitting.servo.report import ServoSolution
from spelgen.fitting.servo.tuning import TUNING
from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.identification.intervals import QUANTILE, Interval

SERVO_UNITS = {
    "kp": "{0.torque}/{0.position}",
    "kd/kp": "s",
    "lag": "s",
    "armature/kp": "s²",
    "coulomb/kp": "{0.position}",
    "dead zone": "{0.position}",
    "static error": "{0.position}",
    "offset/kp": "{0.position}",
}
"""Unit of each quantity of position servos.

lag: kd/kp plus the delay of the commands. dead zone: half its width. static error: coulomb/kp plus this half width.
"""
SUMS = {"lag": ("kd/kp", "delay"), "static error": ("coulomb/kp", "dead zone")}
"""Sums of two quantities that logs of servos may determine better than either of the two."""


def posterior_content(problem: ServoProblem, solution: ServoSolution) -> Content:
    """Return the posterior of a servo fit for the checkpoint: `covariance` (K, K), and `delay_std` of the delay [s].

    K is the number of parameters of the model (`ParameterVector`). The fit estimates fewer parameters
    (`ServoParameters`), with coordinates of the bodies in place of the inertial parameters. The covariance of the fit
    is converted to the model's parameters by the Jacobian. It is scaled such that 1.96 standard deviations are half the
    width of the 95 % interval of the fit, which is wider than a normal one (`ServoSolution.quantile`). Three variances
    are increased, since the fit underestimates them:

    - kd, armature and friction: the variance due to errors of the friction model is added
      (`ServoTuning.model_deviation`).
    - bodies: the prior covariance is added for directions orthogonal to `ParameterMap.directions`, which are not
      fitted.
    - common factor of gains, masses, friction and offsets, if no kp is known: only effort limits [Nm, N] determine this
      factor, and the limits in URDFs are often wrong. The variance of the logarithm of the factor is therefore
      increased until the mean variance of log kp is at least `ServoTuning.bodies`^2, the prior variance of the
      logarithm of a mass.
    """
    parameters, model = problem.parameters, problem.rollouts.model
    vector, directions = ParameterVector(model), parameters.directions
    (p, n), count = parameters.prior_mean.joints.shape, len(solution.covariance)
    units = torch.eye(count).double()
    # `slopes` are the derivatives (k, K) of the K parameters of the model with respect to the k fitted parameters.
    slopes = {name: torch.zeros(count, x.numel()).double() for name, x in vector.initial.items()}
    of_joints = parameters.named(units[:, : p * n].view(count, p, n))
    slopes |= {name: x.reshape(count, -1) for name, x in of_joints.items()}
    slopes[vector.bodies] = units[:, p * n : -1] @ directions.mT
    slopes[DELAY] = units[:, -1:]
    slope = torch.cat(list(slopes.values()), dim=1)
    scale, bodies = solution.quantile / QUANTILE, vector.mask("bodies")
    forms = (scale * TUNING.model_deviation) ** 2 * vector.mask("damping", "armature", "sizes")
    covariance = scale**2 * slope.mT @ solution.covariance @ slope + forms.diag()
    unfitted = TUNING.bodies**2 * torch.eye(len(directions)).double() - directions @ directions.mT
    covariance[bodies[:, None] & bodies] += unfitted.flatten()
    if model.servo.trained.all():
        factor = _common_factor(vector)
        missing = TUNING.bodies**2 - covariance.diagonal()[vector.mask("stiffness")].mean()
        covariance += missing.clamp(min=0) * factor.outer(factor)
    return {"covariance": covariance, "delay_std": scale * float(solution.covariance[-1, -1].sqrt())}


def _common_factor(vector: ParameterVector) -> Tensor:
    """Return the derivative (K,) of the parameters with respect to the logarithm of a common factor of all torques.

    Positions under servos do not depend on this factor of gains, masses, friction and torque offsets. The
    parameters of gains, masses and friction are logarithms and have the derivative 1. The parameter of a torque offset
    is proportional to the factor: its derivative is its value.
    """
    logarithms = vector.mask("stiffness", "damping", "armature", "sizes", "effects").double()
    derivatives = vector.unflatten(logarithms)
    derivatives[vector.bodies][:, -1] = 1.0  # log(mass), with derivative 1 by log(factor)
    for name in vector.names("offset"):
        derivatives[name].copy_(vector.initial[name])
    return logarithms


class ServoPosterior(Posterior):
    """Posterior of a model with position servos.

    Positions under servos determine masses and friction only relative to the gains kp. Unless a kp is known, base
    parameters are therefore ratios to kp of one joint, `scale_joint`.
    """

    @property
    def scale_joint(self) -> str | None:
        """Name of the joint whose kp divides the base parameters; None if a kp is known.

        Of all joints, the ratios (base parameter / kp) of this joint have the smallest median relative standard
        deviation. If a kp is known, the base parameters themselves are determined and not divided.
        """
        return None if self._scale_index is None else self.model.joint_names[self._scale_index]

    @cached_property
    def base_parameters(self) -> tuple[Interval, ...]:
        """95 % intervals of the base parameters; if no kp is known, of their ratios to the kp of one joint.

        This joint is `scale_joint`.
        """
        if self._scale_index is None:
            return super().base_parameters
        values, roots = self._ratios(self._scale_index)
        rows = zip(self._base[0], values.tolist(), roots.norm(dim=1).tolist(), strict=True)
        return tuple(Interval(f"{name}/kp", value, std, "") for name, value, std in rows)

    @property
    def base_units(self) -> str:
        """Units of the base parameters for the title of a table, with "; ratios to kp of <joint>" if no kp is known."""
        units = super().base_units
        return units if self.scale_joint is None else f"{units}; ratios to kp of {self.scale_joint}"

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Names of the quantities that logs determine only in combinations, or not at all.

        A mass or first moment is listed if it is not itself one of the base parameters. A pair of quantities (`SUMS`)
        is listed if the standard deviation of their sum is smaller than the standard deviation of either quantity. If
        no kp is known, the common factor of all torques and inertias is listed, too.
        """
        pairs, delays = [], (self.delay,) * self.model.n
        for name, (first, second) in SUMS.items():
            second_terms = delays if second == "delay" else self.drives[second]
            for total, term, second_term in zip(
                self.drives[name], self.drives[first], second_terms, strict=True
            ):
                # A sum has a smaller error than both terms only if their errors have a correlation below -1/2: the logs
                # then determine the sum, but not the terms.
                if second_term is not None and total.std < min(term.std, second_term.std):
                    pairs.append(f"{first} and {second} of {total.name}")
        common = [] if self._scale_index is None else ["a common factor of kp and all masses"]
        return (*super().unidentifiable, *pairs, *common)

    def _drive_quantities(self) -> tuple[list[DriveQuantity], ModelFunction]:
        """Return the quantities of the servos that have intervals, and the function that returns their values.

        The quantities are kp, kd/kp, lag (kd/kp plus the delay), armature/kp, coulomb/kp, dead zone (half its width),
        static error (coulomb/kp plus this half width) and offset/kp, with the units `SERVO_UNITS`. The function returns
        (8, n) for a model.
        """
        line, joints = friction_line(self.model), tuple(range(self.model.n))
        quantities = [
            DriveQuantity(name, unit, name != "offset/kp", joints) for name, unit in SERVO_UNITS.items()
        ]

        def ratios(model: ArmModel) -> Tensor:
            """Return the eight quantities of n joints, (8, n), in the order and the units of `SERVO_UNITS`.

            The quantities are kp, kd/kp, lag, armature/kp, coulomb/kp, dead zone, static error and offset/kp.
            """
            servo, kp = model.servo, model.servo.kp()
            damping, dry = servo.kd() / kp, line(model)[1] / kp
            return torch.stack([
                kp, damping, damping + servo.delay, model.armature / kp, dry, servo.dead_zone,
                dry + servo.dead_zone, model.torque_offset / kp,
            ])  # fmt: skip

        return quantities, ratios

    @cached_property
    def _scale_index(self) -> int | None:
        """Index (0 to n - 1) of `scale_joint`, the joint whose kp divides the base parameters; None if a kp is known.

        If no kp is known, positions determine only the ratios of base parameters to kp.
        """
        if not self.model.servo.trained.all():
            return None
        ratios = map(self._ratios, range(self.model.n))
        return int(np.argmin([float((root.norm(dim=1) / value.abs()).median()) for value, root in ratios]))

    @cached_property
    def _stiffness(self) -> Propagated:
        """kp of all n servos, (n,) [Nm/rad, N/m], with a square root (n, k) of their covariance (see `Propagated`)."""
        return self.propagate(lambda model: model.servo.kp())

    def _ratios(self, joint: int) -> Propagated:
        """Return r ratios (base parameter / kp of a joint), (r,), and a square root (r, k) of their covariance.

        joint: index of the joint. The unit of a ratio is the unit of the base parameter divided by the unit of kp. k is
        the rank of the covariance of the fitted parameters (see `Propagated`).
        """
        values, (kp, kp_root) = self._base_values, self._stiffness
        ratio = values.value / kp[joint]
        return Propagated(ratio, (values.root - ratio.outer(kp_root[joint])) / kp[joint])
