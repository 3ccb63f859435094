"""A trained model as plain numbers: the one description that every exporter reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Body, Coordinate


@dataclass(frozen=True, eq=False)
class TipJoint:
    """A joint on the way to the tip: origin (4, 4), then a turn or a slide by row @ q + offset about ``axis``."""

    origin: np.ndarray
    kind: str
    axis: np.ndarray
    row: np.ndarray
    offset: float


@dataclass(frozen=True, eq=False)
class FrictionLaw:
    """The constants of ``runtime.friction_laws``, (n,) each, in their units."""

    viscous: np.ndarray
    saturation: np.ndarray
    saturation_velocity: np.ndarray
    coulomb: np.ndarray
    stribeck: np.ndarray
    stribeck_velocity: np.ndarray
    coulomb_smoothing_velocity: np.ndarray
    load_dependence: np.ndarray


@dataclass(frozen=True, eq=False)
class Bristles:
    """Friction's memory: ``count`` elements a joint, each with a reach [rad, m] and its fraction of dry friction;
    (n, count).
    """

    reach: np.ndarray
    fractions: np.ndarray

    @property
    def count(self) -> int:
        """Elements of a joint."""
        return int(self.reach.shape[1])


@dataclass(frozen=True, eq=False)
class FrictionNetwork:
    """The weights of ``runtime.joint_friction`` made ready: see ``FrictionLayers``; nominal is (n,) [Nm, N]."""

    weight: np.ndarray
    bias: np.ndarray
    out: np.ndarray
    offset: np.ndarray
    viscous: np.ndarray
    smoothing: np.ndarray
    nominal: np.ndarray


@dataclass(frozen=True, eq=False)
class Functions:
    """Learned functions of q: layers of sigmoids of the encoding, the last one linear, plus a Fourier series.

    weights: by layer, (units, units below). series: what takes the Fourier features to the rows, (rows, 2 K).
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]
    series: np.ndarray | None

    @property
    def reached(self) -> np.ndarray:
        """The rows that the network changes, (rows,)."""
        found = np.zeros(len(self.biases[-1]), dtype=bool)
        return found if not self.weights else found | (self.weights[-1] != 0).any(axis=1)


@dataclass(frozen=True, eq=False)
class Encoding:
    """cos q, sin q and, where some joint is prismatic, (q - center) / reach; the Fourier features' keys, by joint."""

    prismatic: bool
    center: np.ndarray
    reach: np.ndarray
    frequencies: np.ndarray
    powers: np.ndarray


@dataclass(frozen=True, eq=False)
class Bound:
    """``runtime.regularisation``: center, least and unit, (n, n)."""

    center: np.ndarray
    least: np.ndarray
    unit: np.ndarray


@dataclass(frozen=True, eq=False)
class Learned:
    """What networks and Fourier series give: M's rows (n n) and V."""

    encoding: Encoding
    mass: Functions
    potential: Functions | None
    bound: Bound | None


@dataclass(frozen=True, eq=False)
class Servos:
    """``runtime.position_servo``: kp, kd and limit, (n,), the last infinite where nothing limits; delay [s]."""

    kp: np.ndarray
    kd: np.ndarray
    limit: np.ndarray
    delay: float


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A trained arm of n joints. Units: rad and Nm, or m and N.

    name: for code. inertias: (bodies, 10) about the joints' frames, None where M and V are learned functions. rotors:
    what these add to M, (n, n), where it is not among these. motors: (n, n), the drives' speeds by the joints', which
    friction follows. inputs: G, (n, n); actuated: (n,), 0 for a passive joint. friction_compensation: (n,) what the
    drives add by velocity.
    """

    name: str
    robot: str
    preset: str
    coordinates: tuple[Coordinate, ...]
    identifiers: tuple[str, ...]
    gravity: np.ndarray
    bodies: tuple[Body, ...]
    inertias: np.ndarray | None
    rotors: np.ndarray
    motors: np.ndarray
    learned: Learned | None
    friction: FrictionLaw | FrictionNetwork
    bristles: Bristles | None
    inputs: np.ndarray
    actuated: np.ndarray
    torque_offset: np.ndarray
    friction_compensation: np.ndarray
    tip_link: str
    tip: tuple[TipJoint, ...]
    tip_end: np.ndarray
    servos: Servos | None = None

    @property
    def n(self) -> int:
        """How many joints."""
        return len(self.coordinates)

    @property
    def memory(self) -> int:
        """Numbers of friction's memory."""
        return self.n * self.bristles.count if self.bristles else 0
