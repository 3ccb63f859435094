"""Posterior of a fit to positions under position servos: damping, friction, ... are determined only relative to kp."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from spelgen.emission.assemble import ArmModel
from spelgen.fitting.drive_quantities import DriveQuantity, friction_line
from spelgen.fitting.posterior import Posterior, Propagated
from spelgen.identification.intervals import Interval

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

    def _drive_quantities(self) -> tuple[list[DriveQuantity], Callable[[ArmModel], Tensor]]:
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
