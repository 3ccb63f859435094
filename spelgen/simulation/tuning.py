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
    # [1] Largest number of integrator steps while the torque is constant. An integration that needs more is stopped
    # with an error.
    most_steps: int = 100_000
    # [1] Factor of both tolerances of the integration in the protocol "tracking". Integration errors of about 1e-11 rad
    # are then still far below the resolution of the encoders.
    seen_loosening: float = 100.0
    # [1] Default fraction of a joint's position range and speed limit that a simulated motion uses.
    used_range: float = 0.7
    # [1] Integral gain of the PID controllers, divided by inertia * omega^3, with the natural frequency omega. A joint
    # without friction would be unstable with a value of 2 or more.
    integral_gain: float = 0.2
    # [Hz] Default rate of the controllers, approximate: it is rounded to a divisor of the sample rate.
    control_rate: float = 125.0

    # Constants of simulated arms under position servos.

    # [s] Largest integrator step of an arm under position servos.
    servo_step: float = 1e-3
    # [1] Number of Gauss-Seidel iterations over the joints for the impulses of dry friction.
    friction_sweeps: int = 4
    # [1] Counts of an encoder per revolution: 12 bits.
    encoder_counts: int = 4096
    # [Nm] Torque limit of a servo whose URDF joint states no effort limit.
    servo_effort: float = 5.0
    # [s] Ratio kd / kp of all simulated servos.
    servo_lag: float = 0.05
    # [rad, m] Largest amplitude of a command about the middle of a joint's range.
    command_amplitude: float = 0.6
    # [s] Time between jumps of the commanded positions.
    command_interval: float = 2.0
    # [Hz] Lowest frequency of the sines in the commanded positions.
    min_command_frequency: float = 0.05
    # [Hz] Highest frequency of the sines in the commanded positions: servos of hobby arms track no faster motion.
    max_command_frequency: float = 1.2


@dataclass(frozen=True)
class AsBuiltTuning:
    """Random differences of a simulated arm from its URDF. A pair of numbers is the range of a uniform distribution."""

    # [1] Relative standard deviation of masses and inertias. Also the standard deviation of each coordinate of a centre
    # of mass, divided by the radius of gyration.
    inertial_error: float = 0.3
    # [kg] Links of at most this mass are placeholders and stay unchanged.
    massless: float = 1e-9
    # [1] In a physically inconsistent inertia tensor, principal second moments of mass below this fraction of the
    # largest one are raised to this fraction.
    min_spread: float = 0.01
    # [1] Coulomb friction, divided by the typical rigid-body torque of the joint.
    coulomb: tuple[float, float] = (0.04, 0.12)
    # [1] Largest relative difference between the Coulomb friction in one direction and the mean of both directions.
    asymmetry: float = 0.1
    # [1] Viscous friction torque at the typical speed of the joint, divided by Coulomb friction.
    viscous: tuple[float, float] = (0.3, 1.0)
    # [1] Armature, divided by the mean diagonal entry of M.
    armature: tuple[float, float] = (0.02, 0.2)
    # [1/s] Typical acceleration of a joint divided by its typical speed. The typical rigid-body torque contains the
    # inertia torque at this acceleration.
    acceleration: float = 2.0
    # [1] Number of random positions at which torques and M are computed to scale friction and armature.
    positions: int = 50
    # [1] Fraction of the joint ranges that contains the random `positions`.
    range_fraction: float = 0.7
    # [rad] Largest break-away displacement of the friction elements of a joint.
    presliding: float = 0.03
    # [1] Largest break-away displacement divided by the smallest one, of the friction elements of a joint.
    presliding_span: float = 150.0
    # [1] Number of friction elements per joint.
    elements: int = 5
    # [1] Standard deviation of the white torque noise, divided by the standard deviation of the torque.
    torque_noise: float = 0.02
    # [rad, m] Resolution of the encoders: 19 bits per revolution.
    resolution: float = 1.2e-5
    # [s] Duration of a simulated recording.
    duration: float = 15.0
    # [Hz] Sample rate of a simulated recording.
    sample_rate: float = 200.0


TUNING, AS_BUILT = SimulationTuning(), AsBuiltTuning()
