"""Joint friction: viscous, Coulomb, Stribeck and load-dependent, with hysteresis by Maxwell-slip bristles."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from spelgen.runtime.parts import Row
from spelgen.runtime.rows import Joint, vector

# Initial `coulomb_smoothing_velocity` of ``SlidingFriction`` divided by the typical speed of the joint.
# The smooth sign of the velocity, by which dry friction is multiplied, is 0.7 at the smoothing velocity.
SMOOTHING_VELOCITY = 0.006


class FrictionConstants(NamedTuple):
    """Parameter cache of ``FrictionLaws``: constants >= 0 per joint, (n,), or per bristle, (n, K).

    At joints without friction, the coefficients and torques of friction are 0. ``min_load`` is never 0:
    it is no friction torque, but smooths |gravity torque|.
    """

    viscous: Tensor  # coefficient of the viscous friction, a torque per velocity [Nm s/rad, N s/m]
    saturation: Tensor  # limit of the saturating viscous friction [Nm, N]
    saturation_velocity: Tensor  # velocity scale of the saturating viscous friction [rad/s, m/s]
    coulomb: Tensor  # Coulomb friction [Nm, N]
    stribeck: Tensor  # additional dry friction at low velocity [Nm, N]
    stribeck_velocity: Tensor  # velocity scale of the Stribeck curve [rad/s, m/s]
    load_dependence: Tensor  # dry friction per magnitude of the gravity torque [1]
    stribeck_rounding: Tensor  # r of ``FrictionLaws``: the Stribeck curve is rounded below r v_stribeck [1]
    coulomb_smoothing_velocity: Tensor  # speed at which the smooth sign of velocity is 0.7 [rad/s, m/s]
    min_load: Tensor  # gravity torque below which |gravity torque| is smoothed [Nm, N]
    bristle_fractions: Tensor  # fraction of dry friction per bristle, (n, K); sum 1, or 0 without bristles
    bristle_reach: Tensor  # break-away displacements of the bristles, (n, K) [rad, m]
    memoryless: Tensor  # 1 for a joint without bristles (friction without state), else 0

    def viscosity(self, qd: Tensor) -> Tensor:
        """Return the viscous friction torque divided by the velocity qd, (..., n) [Nm s/rad, N s/m].

        It is viscous + saturation / sqrt(qd^2 + saturation_velocity^2). qd: velocities, (..., n) [rad/s,
        m/s].
        """
        return self.viscous + self.saturation * turning(qd, self.saturation_velocity)

    def dry(self, qd: Tensor, gravity: Tensor) -> Tensor:
        """Return the magnitude of dry friction, (..., n) [Nm, N]: Coulomb, Stribeck and load-dependent terms.

        qd: velocities, (..., n) [rad/s, m/s]. gravity: gravity torques (the load), (..., n) [Nm, N].
        """
        speed = qd.abs() / self.stribeck_velocity
        rounding = self.stribeck_rounding
        # Stribeck curve (1 + x / 8)^-8, an approximation of exp(-x), at v = |qd| / stribeck_velocity. With
        # the rounding r, x = (1 + r) v^2 / (v + r) is close to v^2 for large r and to v for small r.
        slow = 1 / (1 + (1 + rounding) / 8 * speed.square() / (speed + rounding))
        slow = slow.square().square().square()  # Squaring three times takes half the time of ** 8.
        # The load is a smooth approximation of |gravity torque|.
        load = (gravity.square() + self.min_load**2).sqrt()
        return self.coulomb + self.stribeck * slow + self.load_dependence * load

    def torque(
        self, qd: Tensor, gravity: Tensor, z: Tensor | None = None, direction: Tensor | None = None
    ) -> Tensor:
        """Return the friction torque of all joints, (..., n) [Nm, N]; positive at a positive steady velocity.

        Args:
            qd: velocities, (..., n) [rad/s, m/s].
            gravity: gravity torques, on which dry friction depends, (..., n) [Nm, N].
            z: bristle displacements, (..., n, K) [rad, m]. None, if unknown: dry friction of all joints then
                depends on velocity, as at joints without bristles.
            direction: factor of dry friction, from -1 to 1, at joints without bristles, (..., n). None:
                smooth sign of qd.
        """
        if direction is None:
            direction = qd * turning(qd, self.coulomb_smoothing_velocity)
        if z is not None:
            # The torque of bristle k is proportional to its displacement. At the break-away displacement it
            # is the fraction `bristle_fractions[:, k]` of dry friction.
            deflection = (self.bristle_fractions / self.bristle_reach * z).sum(dim=-1)
            direction = deflection + self.memoryless * direction
        return self.viscosity(qd) * qd + self.dry(qd, gravity) * direction

    def stored_energy(self, z: Tensor) -> Tensor:
        """Return the elastic energy of all bristles, (...) [J]; z: displacements, (..., n, K) [rad, m]."""
        # The bristles count as springs of stiffness coulomb * fraction / breakaway: only the Coulomb term
        # of dry friction stores energy. The Stribeck and load terms vary with velocity and load. Their power
        # counts as dissipation, which may be slightly negative when a bristle relaxes.
        stored = self.bristle_fractions * z.square() / self.bristle_reach
        return 0.5 * (self.coulomb * stored.sum(dim=-1)).sum(dim=-1)


class FrictionLaws(nn.Module):
    """Friction of all joints with trained constants.

    Without bristles, it dissipates energy for any values of the parameters. Bristles store energy and return
    it. Their torque is proportional to dry friction, which depends on velocity and load: they can return
    slightly more than they have stored if velocity or load have changed meanwhile.

    The friction torque of a joint with velocity qd is

        viscous qd + saturation s(qd, saturation_velocity) + dry direction,
        dry = coulomb + stribeck / (1 + (1 + r) v^2 / (v + r) / 8)^8 + load_dependence load,

    with v = |qd| / stribeck_velocity, r = stribeck_rounding, load = sqrt(gravity torque^2 + min_load^2) and
    the smooth sign function s(x, width) = x / sqrt(x^2 + width^2). All other names except ``direction`` are
    constants. ``saturation`` is the limit of a friction torque that rises with velocity.

    A joint has K bristles: elements that are elastic up to a break-away displacement and slide beyond it,
    with displacements z, (..., n, K) [rad, m] (Maxwell-slip elements: Lampaert, Al-Bender and Swevers, A
    Generalized Maxwell-Slip Friction Model, 2003). Reversals within the break-away displacement give
    closed hysteresis loops, so that the position of a joint in stiction does not drift under an
    oscillating load. The factor ``direction``, from -1 to 1, is sum_k fraction_k z_k / breakaway_k over
    the bristles of the joint. It is s(qd, coulomb_smoothing_velocity) for a joint without bristles, or if
    z is unknown.

    The trained parameters are logarithms of constants, see ``parameter_groups``, and logits of the bristle
    fractions. For large r the Stribeck term is close to the Gaussian of Armstrong-Helouvry (Control of
    Machines with Friction, 1991); for small r, to the exponential of Bo and Pavelescu (Wear 82:277, 1982),
    but without a corner at rest. Powers replace exponentials: a control loop takes a third of the time.
    """

    # (name, group, unit of the constant, initial value of the constant) of each trained parameter. Fits
    # select parameters by group. Initial values are in units of the joint's typical friction and typical
    # speed. A constant has its initial value if its parameter is zero.
    parameter_groups: tuple[tuple[str, str, str, float], ...] = (
        ("raw_viscous", "sizes", "Nm s/rad, N s/m", 1.0),
        ("raw_saturation", "effects", "Nm, N", 1.0),
        ("raw_saturation_velocity", "velocities", "rad/s, m/s", 0.2),
        ("raw_coulomb", "sizes", "Nm, N", 1.0),
        ("raw_stribeck", "effects", "Nm, N", 0.3),
        ("raw_stribeck_velocity", "velocities", "rad/s, m/s", 0.03),
        ("raw_load_dependence", "load_dependence", "1", 0.03),
        ("raw_bristle_fractions", "fractions", "1", 1.0),
    )

    def __init__(
        self, joints: Sequence[Joint], *, breakaway: Mapping[str, Row], stribeck_rounding: float = 10.0
    ) -> None:
        """Create the friction of the joints, with all constants at their initial values.

        Args:
            joints: joints with their typical friction and typical speed, to which initial values are relative
                (see ``parameter_groups``).
            breakaway: for each joint type, break-away displacements of K bristles, (K,) [rad, m], shortest
                first.
            stribeck_rounding: r of the Stribeck curve (see the class).
        """
        super().__init__()
        self.nominal = nn.Buffer(vector(joint.friction for joint in joints))
        self.speed = nn.Buffer(vector(joint.speed for joint in joints))
        rows = [breakaway[joint.joint_type] for joint in joints]
        self.reach = nn.Buffer(torch.tensor(rows, dtype=torch.float64))  # break-away displacements, (n, K)
        # `memoryless` is a buffer, not a parameter: a fit to torques sets it to 1 at joints without bristles.
        self.memoryless = nn.Buffer(torch.zeros_like(self.speed))
        self.stribeck_rounding = nn.Buffer(torch.full_like(self.speed, stribeck_rounding))
        for name, *_ in FrictionLaws.parameter_groups[:-1]:
            self.register_parameter(name, nn.Parameter(torch.zeros_like(self.speed)))
        self.raw_bristle_fractions = nn.Parameter(torch.zeros_like(self.reach))

    def prepare(self) -> FrictionConstants:
        """Return the parameter cache: friction constants of all joints in SI units."""
        friction, speed, constants = self.nominal, self.speed, []
        units = {
            "Nm s/rad, N s/m": friction / speed, "Nm, N": friction, "rad/s, m/s": speed, "1": friction.sign()
        }  # fmt: skip
        for name, _, unit, initial in FrictionLaws.parameter_groups[:-1]:
            # exp keeps the friction constants positive. Parameters of zero give their initial values.
            constants.append(initial * units[unit] * getattr(self, name).exp())
        # |gravity torque| has no derivative at zero: `load` smooths it below 1 % of typical friction.
        load = 0.01 * torch.where(friction > 0, friction, 1.0)
        fractions = self.raw_bristle_fractions.softmax(dim=-1) * (1 - self.memoryless).unsqueeze(-1)
        # The smooth sign of joints without bristles has a fixed width of 0.1 % of the typical speed
        # (`SlidingFriction` trains the width). With a wider transition, a fit could not distinguish it
        # from the hysteresis of bristles.
        rounding, sharp = self.stribeck_rounding, 0.001 * speed
        return FrictionConstants._make(
            [*constants, rounding, sharp, load, fractions, self.reach, self.memoryless]
        )


def turning(velocity: Tensor, width: Tensor) -> Tensor:
    """Return 1 / sqrt(velocity^2 + width^2), (..., n) [s/rad, s/m].

    The smooth sign of the velocity is the velocity times the result. width: velocity at which the smooth sign
    is 0.7, (n,) [rad/s, m/s].
    """
    return torch.rsqrt(velocity * velocity + width**2)


class SlidingFriction(FrictionLaws):
    """Friction without hysteresis state: dry friction is multiplied by a smooth sign of the velocity.

    The smoothing velocity, at which the smooth sign is 0.7, is trained in addition to the other constants.
    """

    parameter_groups = (("raw_coulomb_smoothing_velocity", "velocities", "rad/s, m/s", SMOOTHING_VELOCITY),)

    def __init__(self, joints: Sequence[Joint]) -> None:
        super().__init__(joints, breakaway={"revolute": (), "prismatic": ()})
        self.memoryless.fill_(1.0)
        self.raw_coulomb_smoothing_velocity = nn.Parameter(torch.zeros_like(self.speed))
        del self.raw_bristle_fractions
        # Without bristles there are no fractions to train: the parameter is replaced by a buffer (n, 0).
        # The array of break-away displacements, `reach`, is reused, since it has this shape.
        self.register_buffer("raw_bristle_fractions", self.reach)

    def prepare(self) -> FrictionConstants:
        """Return the parameter cache: friction constants of all joints in SI units."""
        velocity = SMOOTHING_VELOCITY * self.speed * self.raw_coulomb_smoothing_velocity.exp()
        return super().prepare()._replace(coulomb_smoothing_velocity=velocity)
