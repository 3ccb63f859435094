"""Constants of simulated logs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SimulationTuning:
    """Accuracy of simulated motion, and controllers of simulated arms."""

    # [1] Relative tolerance of the integration: as accurate as double precision allows.
    rtol: float = 1e-13
    # [rad, rad/s] Absolute tolerance of the integration.
    atol: float = 1e-14
    # [1] Fewest rows of a file with a motion.
    min_samples: int = 20
    # [1] Steps of the integrator while a torque is constant; an integration that needs more does not end.
    most_steps: int = 100_000
    # [1] Factor on the tolerances of simulations with encoders: 1e-11 is below their resolution.
    seen_loosening: float = 100.0
    # [1] Fraction of a joint's range and of its speed limit that motion uses by default.
    used_range: float = 0.7
    # [1] Integral gain of the PID: a tenth of the gain at which a joint without friction is unstable.
    integral_gain: float = 0.2
    # [Hz] Approximate rate of the controllers by default.
    control_rate: float = 125.0

    # Arms under position servos.

    # [s] Largest step of the integration.
    servo_step: float = 1e-3
    # [1] Gauss-Seidel iterations over the joints, for dry friction.
    friction_sweeps: int = 4
    # [1] Counts of an encoder per revolution: 12 bits.
    encoder_counts: int = 4096
    # [Nm] Torque limit of a servo without an effort limit.
    servo_effort: float = 5.0
    # [s] Ratio kd / kp of an unspecified servo.
    servo_lag: float = 0.05
    # [rad, m] Largest amplitude of a command about the middle of a joint's range.
    command_amplitude: float = 0.6
    # [s] Time between jumps of the commands.
    command_interval: float = 2.0
    # [Hz] Lowest frequency of the commands' sines.
    min_command_frequency: float = 0.05
    # [Hz] Highest frequency of the commands' sines: servos of hobby arms track no faster motion.
    max_command_frequency: float = 1.2


@dataclass(frozen=True)
class AsBuiltTuning:
    """How far an arm as built differs from its URDF; pairs are the bounds of uniform distributions."""

    # Relative standard deviation of masses, inertias and, by the radius of gyration, centres of mass.
    inertial_error: float = 0.3
    # Links of at most this mass [kg] are placeholders and stay unchanged.
    massless: float = 1e-9
    # Smallest principal second moment of mass, relative to the largest, that replaces a negative one.
    min_spread: float = 0.01
    # Coulomb friction, relative to the rigid-body torque of moderate motion, and its asymmetry between directions.
    coulomb: tuple[float, float] = (0.04, 0.12)
    asymmetry: float = 0.1
    # Viscous friction at moderate speed, relative to Coulomb friction.
    viscous: tuple[float, float] = (0.3, 1.0)
    # Armature, relative to the mean diagonal entry of M.
    armature: tuple[float, float] = (0.02, 0.2)
    # Angular frequency [rad/s] of moderate motion: its acceleration is this number times its speed.
    acceleration: float = 2.0
    # Random positions, and the fraction of the joint ranges they cover, from which magnitudes are computed.
    positions: int = 50
    range_fraction: float = 0.7
    # Presliding of gears [rad]: largest breakaway displacement, ratio of largest to smallest, number of elements.
    presliding: float = 0.03
    presliding_span: float = 150.0
    elements: int = 5
    # White noise of the torque sensors, relative to the standard deviation of the torque.
    torque_noise: float = 0.02
    # Encoders of 19 bits [rad; m].
    resolution: float = 1.2e-5
    # Duration [s] and sample rate [Hz] of a recording.
    duration: float = 15.0
    sample_rate: float = 200.0


TUNING, AS_BUILT = SimulationTuning(), AsBuiltTuning()
