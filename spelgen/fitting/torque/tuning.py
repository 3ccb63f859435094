"""Constants of fits to torques."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from spelgen.settings.fits import Adaptation, GaussianPrior

# [1] Standard deviations of the friction parameters (logarithms, fractions) of one arm from day to day.
DAY_TO_DAY = {
    "sizes": 0.1,
    "velocities": 0.1,
    "fractions": 0.1,
    "shared_sizes": 0.1,
    "shared_velocities": 0.1,
    "shared_fractions": 0.1,
    "shared_friction": 0.3,
}


@dataclass(frozen=True)
class TorqueTuning:
    """Fits of rigid bodies to torques (`fitting.torque`)."""

    # [1] Stride of the samples at 100 Hz: after the filter at 8 Hz every second one contains all information.
    decimation: int = 2
    # [s] Prior mean of the correlation time of torque errors: errors of recorded arms. The samples within it count as
    # one independent error.
    correlation_time: float = 0.2
    # [s] Correlation time of torque errors for the comparison of friction models, which differ at reversals.
    reversal_correlation_time: float = 0.1
    # [1] Weight of the prior mean of the correlation time, as a number of independent errors.
    correlation_weight: float = 30.0
    # [s] Segments from which the correlation time is estimated.
    segment: float = 1.0
    # [1] Largest estimated prior width: masses and armatures are known to a factor of 20, torque offsets to three times
    # the typical friction. Logs that need a wider prior are not of the URDF's arm, or not in Nm.
    max_width: float = 3.0
    # [1] Largest number of outer iterations, which alternate steps with estimates of noise and prior.
    iterations: int = 20
    # [1] Twice the logarithm of a likelihood ratio: strong evidence (Kass and Raftery, J. Am. Stat. Assoc. 90:773,
    # 1995).
    strong_evidence: float = 6.0
    # [1] Largest number of steps before noise and prior are estimated.
    initial_steps: int = 60
    # [1] Largest number of iterations in which the noise is lowered to the least-squares level.
    annealing_iterations: int = 12
    # [1] Noise of these iterations, as a fraction of the torque residual (a low_cost_robot with placeholder
    # inertials: error of M(q) 0.44 -> 0.005).
    annealing_fraction: float = 0.03
    # [1] Noise divided by the noise of the previous iteration, above which the noise has converged.
    noise_converged: float = 0.98
    # [1] Largest number of steps in an outer iteration.
    iteration_steps: int = 5
    # [1] Relative decrease of the cost below which an outer iteration ends.
    min_relative_decrease: float = 1e-4
    # [1] Alternations of rigid bodies and residual terms.
    alternations: int = 3
    # [1] Evenly spread samples of the first outer iterations; the last ones use all samples.
    initial_samples: int = 2**10
    # [1] Largest number of windows of 5 samples from which the scales of the motion are computed.
    max_windows: int = 2**12
    # [1] Largest number of validation windows on which the fitted model is measured.
    validation_windows: int = 2**8
    # [1] Samples for the selection of residual terms.
    residual_samples: int = 2**14
    # [1] Smallest noise, as a fraction of a torque's standard deviation: noise-free samples are fitted to four digits.
    min_noise: float = 1e-4
    # [1] Standard deviations by which the coefficient of friction compensation must differ from zero.
    min_significance: float = 4.0
    # [1] Smallest standard deviation of friction compensation, as a fraction of the torque's: delays of
    # milliseconds have a similar but smaller effect.
    min_compensation: float = 0.05
    # [1] Samples of one block: some 100 MB for seven joints with their derivatives.
    block: int = 2**13
    # [B] Largest size of the regressors: 70,000 samples of six joints; of more samples a subset is used.
    regressor_bytes: float = 4e8
    # [1] Largest step of a body, as a fraction of the distance to physically inconsistent parameters.
    body_step: float = 0.3
    # [1] Relative standard deviation above which logs do not determine an inertia.
    undetermined: float = 0.5
    # [1] Relative standard deviation above which logs do not determine a motor gain: its 95 % interval then reaches
    # 20 % to either side, as the difference of two datasheets does.
    undetermined_gain: float = 0.1
    # [1] nMSE of held-out seconds above which logs do not support the fit at a joint.
    unsupported: float = 0.5
    # [1] Factor of the prior standard deviation of URDF masses above which the URDF is wrong.
    wrong_urdf: float = 5.0
    # [1] Torque residual divided by the inertial torque of a joint, above which the predicted motion is unreliable.
    weak_acceleration: float = 2.0
    # [1] Prior standard deviations of an adapted fit, about the parameters of its source, by adapted part. load: mass
    # known to a factor of twenty (with 10 in place of 3 half a second of motion has an error of 27 times the variance
    # of the torque, UR10e). friction: warmth changes the friction of all joints by tens of per cent, of a single joint
    # less (Bittencourt and Gunnarsson, J. Dyn. Sys. Meas. Control 134:051013, 2012). unit: units of one make also
    # differ by a few per cent in mass.
    priors: Mapping[Adaptation, GaussianPrior] = field(
        default_factory=lambda: {
            "load": GaussianPrior(bodies=3.0),
            "friction": GaussianPrior(**DAY_TO_DAY),
            "unit": GaussianPrior(**DAY_TO_DAY, bodies=0.1, gains=0.1, armature=0.1, shared_armature=0.1),
        }
    )


@dataclass(frozen=True)
class ResidualTuning:
    """Selection of residual terms (`fitting.torque.selection`)."""

    # [1] Contiguous blocks of samples, each held out once.
    folds: int = 10
    # [1] Correlation times that are left out between fitted and held-out samples.
    gap: float = 2.5
    # [1] Standard errors that the mean error reduction over the blocks must exceed: p = 0.01 of Student's t with nine
    # degrees of freedom.
    standard_errors: float = 2.82
    # [1] Standard errors for samples of one recording, whose motion may repeat errors: p = 0.001.
    standard_errors_of_one: float = 4.30
    # [1] Largest torque of position that one recording supports, as a fraction of the joint's torque.
    max_torque_fraction: float = 0.5
    # [1] Gravity torque of a joint, as a fraction of its torque, below which it has no spring to balance it.
    min_load_fraction: float = 0.1
    # [1] Smallest error reduction of a residual term.
    min_reduction: float = 1e-3
    # [1] A later term is preferred to the best one so far only if its residual is below this fraction of the residual
    # of the best one.
    preference_ratio: float = 0.9
    # [1] Samples to which networks are fitted.
    network_samples: int = 2**12
    # [1] Evaluations of the loss after which a network without error reduction is discarded.
    network_probe_evaluations: int = 20
    # [1] Evaluations of the loss of a network.
    network_evaluations: int = 100


TUNING = TorqueTuning()
SELECTION = ResidualTuning()
