"""Constants of the evaluation and of its report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EvaluationTuning:
    """Constants of the evaluation and of the verdict."""

    # [s] that the momentum observer runs before a prediction (measured: 0.2 and 0.3 s are no better, UR10e)
    observed_past: float = 0.1
    # [s] 1 / K of the momentum observer (measured: 0.02 to 0.1 s differ by 3 %, UR10e)
    observer_time_constant: float = 0.05
    most_windows: int = 1000  # that a horizon is judged on, evenly spread
    # of a predictor over a horizon: fewer windows where they are long, but not fewer than the next
    most_predicted_steps: int = 10_000
    fewest_windows: int = 100  # as far as there are so many
    probed_model_windows: int = 64  # of which the former are taken
    # of the torque's variance; convention of this package, as the next two
    explained_for_contacts: float = 0.99
    explained_for_feed_forward: float = 0.95  # likewise
    explained_for_gravity: float = 0.8  # likewise: what gravity and friction alone come to on most logs
    close_prediction: float = 0.1  # of the motion: errors up to it are called a simulation
    rough_prediction: float = 0.3  # of the motion: errors up to it are called a rough simulation
    slow: float = 0.1  # of a joint's largest velocity: below is called near standstill
    uneven: float = 1.4  # ratio of slow and fast errors that is worth a word
    narrow_range: float = 0.5  # of a joint's range: logs that cover less are called narrow
    sampled_positions: int = 100_000  # at which M must be positive definite
    free_steps: int = 10_000  # of 1 ms without input
    started_states: int = 8  # that motion without input starts from
    headline: int = 20  # [words] of a verdict's sentence: it is read at a glance
    # [samples] of the windows that say in which steps a model is integrated, where its fit had none
    model_window: int = 5
    replay_window: float = 1.0  # [s] of replays that start anew again and again


@dataclass(frozen=True)
class TraceTuning:
    """The numbers of curves behind the figures: what a page can show."""

    torque_seconds: float = 10.0  # [s] of torques along a log
    samples: int = 240  # of a curve along a log or a prediction
    log_samples: int = 600  # of a whole log that is replayed
    times: int = 24  # at which the growth of errors is shown


TUNING, TRACES = EvaluationTuning(), TraceTuning()
