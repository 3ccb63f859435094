"""Constants of the evaluation and of its report."""

from dataclasses import dataclass


@dataclass(frozen=True)
class EvaluationTuning:
    """Measurements of an evaluation, and thresholds of its verdict."""

    # [s] Time that the momentum observer runs before a prediction; 0.2 and 0.3 s are no better on the UR10e of
    # `benchmarks/arms.py`.
    observed_past: float = 0.1
    # [s] 1 / K of the momentum observer; 0.02 to 0.1 s differ by 3 % on the UR10e of `benchmarks/arms.py`.
    observer_time_constant: float = 0.05
    # [1] Largest number of windows per horizon, evenly spread.
    most_windows: int = 1000
    # [1] Largest number of predicted steps per predictor and horizon: long horizons have fewer windows.
    most_predicted_steps: int = 10_000
    # [1] Smallest number of windows of a long horizon, as far as the logs have as many.
    fewest_windows: int = 100
    # [1] Number of test windows on which the number of integration steps is chosen.
    probed_model_windows: int = 64
    # [1] Explained fraction of the torque variance that contact detection requires; a convention of this package.
    explained_for_contacts: float = 0.99
    # [1] Explained fraction of the torque variance that feed-forward control requires.
    explained_for_feed_forward: float = 0.95
    # [1] Explained fraction that gravity compensation requires: gravity and friction explain about as much on most
    # logs.
    explained_for_gravity: float = 0.8
    # [1] Error relative to the motion up to which a prediction is called a simulation.
    close_prediction: float = 0.1
    # [1] Error relative to the motion up to which a prediction is called a rough simulation.
    rough_prediction: float = 0.3
    # [1] Fraction of a joint's largest velocity below which it is called near standstill.
    slow: float = 0.1
    # [1] Ratio of the errors of slow and fast motion from which on it is reported.
    uneven: float = 1.4
    # [1] Fraction of a joint's range below which the range of the logs is called narrow.
    narrow_range: float = 0.5
    # [1] Positions of the test logs at which M is compared with the true one.
    mass_positions: int = 500
    # [1] Random positions at which M must be positive definite.
    sampled_positions: int = 100_000
    # [1] Number of steps of 1 ms of the motion without input.
    free_steps: int = 10_000
    # [1] Initial states of the motion without input.
    started_states: int = 8
    # [1] Largest number of words of the first sentence of a verdict.
    headline: int = 20
    # [1] Length of the windows on which the number of integration steps is chosen, for a model not fitted to windows.
    model_window: int = 5
    # [s] Length of replays that are restarted from the measured state.
    replay_window: float = 1.0

    # Resolution of the curves of a report.

    # [s] Time along a log over which torques are drawn.
    torque_seconds: float = 10.0
    # [1] Samples of a curve along a log or a prediction.
    curve_samples: int = 240
    # [1] Samples of the curve of a log that is replayed as a whole.
    log_samples: int = 600
    # [1] Times at which the growth of errors is drawn.
    curve_times: int = 24


TUNING = EvaluationTuning()
