"""Constants of the simulation of logs."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SimulationTuning:
    """Constants of the integration of motion, and of the controllers of simulated arms."""

    # [1] Relative tolerance of the integration, close to the limit of double precision.
    rtol: float = 1e-13
    # [rad, rad/s] Absolute tolerance of the integration.
    atol: float = 1e-14
    # [1] Smallest number of rows of a file with a motion.
    min_samples: int = 20
    # [1] Largest number of integrator steps while the torque is constant; more would mean that it does not converge.
    most_steps: int = 100_000
    # [1] Factor of both tolerances in simulations with encoders: errors of 1e-11 are below the encoder resolution.
    seen_loosening: float = 100.0
    # [1] Default fraction of a joint's range and speed limit that simulated motion uses.
    used_range: float = 0.7
    # [1] Integral gain of the PID, in units of inertia * omega^3; a joint without friction is unstable from 2.
    integral_gain: float = 0.2
    # [Hz] Default rate of the controllers, approximate: it is rounded to a divisor of the sample rate.
    control_rate: float = 125.0

    # Constants of simulated arms under position servos.

    # [s] Largest integrator step of an arm under position servos.
    servo_step: float = 1e-3
    # [1] Gauss-Seidel iterations over the joints for the impulses of dry friction.
    friction_sweeps: int = 4
    # [1] Counts of an encoder per revolution: 12 bits.
    encoder_counts: int = 4096
    # [Nm] Torque limit of a servo whose URDF joint states no effort limit.
    servo_effort: float = 5.0
    # [s] Ratio kd / kp of all simulated servos.
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
    """Differences of an arm as built from its URDF; a pair of numbers is the range of a uniform distribution."""

    # Standard deviation of masses and inertias (relative) and of centres of mass (divided by the radius of gyration).
    inertial_error: float = 0.3
    # Links of at most this mass [kg] are placeholders and stay unchanged.
    massless: float = 1e-9
    # If a body has a negative principal second moment of mass, its moments are clipped to at least this fraction of
    # the largest one.
    min_spread: float = 0.01
    # Coulomb friction, divided by the rigid-body torque of moderate motion.
    coulomb: tuple[float, float] = (0.04, 0.12)
    # Largest relative difference of Coulomb friction in one direction from the mean of both directions.
    asymmetry: float = 0.1
    # Viscous friction torque at moderate speed, divided by Coulomb friction.
    viscous: tuple[float, float] = (0.3, 1.0)
    # Armature, divided by the mean diagonal entry of M.
    armature: tuple[float, float] = (0.02, 0.2)
    # Angular frequency [rad/s] of moderate motion: the acceleration is this number times the speed.
    acceleration: float = 2.0
    # Number of random positions at which torques and M are computed to scale friction and armature.
    positions: int = 50
    # Fraction of the joint ranges from which the random `positions` are drawn.
    range_fraction: float = 0.7
    # Largest breakaway displacement [rad] of the friction elements of a gear.
    presliding: float = 0.03
    # Ratio of the largest to the smallest breakaway displacement.
    presliding_span: float = 150.0
    # Number of friction elements per joint.
    elements: int = 5
    # White noise of the torque sensors, relative to the standard deviation of the torque.
    torque_noise: float = 0.02
    # Resolution of the encoders [rad; m]: 19 bits per revolution.
    resolution: float = 1.2e-5
    # Duration of a recording [s].
    duration: float = 15.0
    # Sample rate of a recording [Hz].
    sample_rate: float = 200.0


TUNING, AS_BUILT = SimulationTuning(), AsBuiltTuning()
