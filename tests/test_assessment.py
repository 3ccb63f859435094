"""Each sentence of the assessment in a report agrees with the numbers of the evaluation (relative errors, nMSE)."""

from dataclasses import replace

import pytest

from spelgen.evaluation.results import Results
from spelgen.evaluation.verdict import verdict
from spelgen.labels import share, short_name

JOINTS = ["a", "b"]


def errors(relative, tip=None):
    each = [relative, relative]
    return {"q": each, "qd": each, "q_relative_rms": each, "qd_relative_rms": each, "mean_relative_rms": relative,
            "tip_mm": tip}  # fmt: skip


def evaluation(relative=0.05, nmse=0.004, traces=None, seen=False, **others):
    """Return an evaluation with two horizons, 1 step and 1 s.

    relative: relative error of the model at 1 s. nmse: nMSE of its torque. others: relative errors of other predictors,
    by their names. traces: further traces of the evaluation, such as "coverage", the ranges of the test motion. seen:
    True if the test logs are training logs.
    """
    horizons = []
    for k, (name, factor) in enumerate((("1 step", 0.5), ("1 s", 1.0))):
        by_predictor = {"model": errors(relative * factor)} | {who: errors(x) for who, x in others.items()}
        horizons.append({"name": name, "steps": k + 1, "seconds": 1.0, "windows": 9, "errors": by_predictor})
    torque = {"model": {"nmse": {}, "mean_nmse": nmse, "rmse": [1.0, 1.0], "joint_nmse": [None, nmse]}}
    return results(horizons, torque, traces, seen)


def results(horizons, torque, traces=None, seen=False):
    note = {
        "severity": "warning",
        "code": "tested-on-training-data",
        "where": "logs",
        "line": None,
        "message": "",
    }
    return Results.from_dict(
        {
            "robot": "arm", "joints": JOINTS, "joint_types": ["revolute"] * 2, "trajectories": ["x"], "cutoff": None,
            "substeps": 1, "parameters": 1, "horizons": horizons, "torque": torque,
            "diagnostics": [note] * seen, "traces": {"coverage": {}} | (traces or {}),
        }
    )  # fmt: skip


@pytest.mark.parametrize("relative, nmse, said", [
    (0.05, 0.004, "Good enough for feed-forward control, contact detection and simulation 1 s ahead"),
    (0.2, 0.03, "Good enough for feed-forward control and rough simulation 1 s ahead, not for contact detection"),
    (0.09, 0.03, "and simulation 1 s ahead"),
    (0.7, 0.1, "Good enough for gravity compensation, not for feed-forward control and simulation 1 s ahead"),
    (0.7, 0.5, "Not accurate enough yet"),
    (0.7, None, "Not accurate enough yet"),
])  # fmt: skip
def test_the_assessment_follows_from_the_figures(relative, nmse, said):
    assert said in verdict(evaluation(relative, nmse)).sentence


def test_figures_and_better_baselines_are_reported():
    told = verdict(evaluation(0.05, 0.004, squares=0.03)).because
    assert "explains 99.6 % of the variance" in told and "is off by 5 % of the motion after 1 s" in told
    assert "But squares is better than the model after 1 s." in told


@pytest.mark.parametrize("nmse, worst", [(0.004, "a"), (0.2, "b")])
def test_if_only_motion_fails_its_joint_is_named(nmse, worst):
    judged = evaluation(0.7, nmse)
    missed = judged.horizons[-1].errors
    missed["model"] = replace(missed["model"], q_relative_rms=(1.3, 0.1))
    assert f"; worst at {worst}." in verdict(judged).sentence


def test_the_motion_error_of_the_worst_joint_is_at_least_the_mean():
    judged = evaluation(0.4, 0.0001)
    of_model = judged.horizons[-1].errors["model"]
    differing = {"q_relative_rms": (0.19, 0.21), "qd_relative_rms": (0.83, 0.25), "mean_relative_rms": 0.37}
    judged.horizons[-1].errors["model"] = replace(of_model, **differing)
    told = verdict(judged)
    assert (
        "; worst at a" in told.sentence and "At a the error after 1 s is 51 % of the motion." in told.because
    )


def test_a_prediction_that_diverges_is_stated_and_its_dash_explained():
    judged = evaluation(0.1)
    judged.horizons[-1].errors["model"] = replace(
        judged.horizons[-1].errors["model"],
        q=(None, None), qd=(None, None), q_relative_rms=(None, None), mean_relative_rms=None,
    )  # fmt: skip
    assert "is off by 5 % of the motion after 1 step (diverged after 1 s)" in verdict(judged).because
    assert "-: not finite, since a prediction diverged" in judged.text()
    assert "diverged" not in evaluation(0.1).text()


def test_a_terminal_shows_the_assessment_first():
    judged = verdict(evaluation(0.7))
    results = replace(evaluation(0.7), assessment=judged)
    assert Results.from_dict(results.to_dict()).assessment == judged
    text = results.text()
    assert " ".join(text.split("\n\n")[0].split()) == f"{judged.sentence} {judged.because}"
    assert max(map(len, text.splitlines())) <= 80


def of_torques(by_joint, steps=None):
    mean = sum(by_joint) / len(by_joint)
    judged = results(
        [], {"model": {"nmse": {}, "mean_nmse": mean, "rmse": [1.0, 1.0], "joint_nmse": by_joint}}
    )
    return verdict(replace(judged, torque_steps=steps or {}))


def test_a_good_mean_does_not_hide_a_bad_joint():
    bad, good = of_torques([0.001, 0.2]), of_torques([0.001, 0.004])
    assert bad.sentence == ("Good enough for gravity compensation, not for feed-forward control; worst at b.")
    assert "explains 90 % of the variance of the torques (80 % at b)" in bad.because
    assert "contact detection" in good.sentence


def test_a_joint_that_is_logged_in_coarse_steps_is_not_assessed():
    assert "contact detection; worst at a" in of_torques([0.001, 0.2], {"b": 1.0}).sentence
    assert of_torques([0.3, 0.2], {"b": 1.0, "a": 2.0}).sentence == "Not accurate enough yet."


def test_errors_above_the_whole_are_times_of_it():
    assert share(0.0123, "the motion") == "1.23 % of the motion"
    assert share(13.6, "the motion") == "13.6 times the motion"
    assert (share(0.9964), share(1.0), share(2.0)) == ("99.64 %", "100 %", "200 %")


def test_recommended_recordings_follow_from_the_coverage_of_logs():
    def ranges(high):
        return {"q": [{"low": 0.0, "high": x} for x in (1.0, high)], "qd": [{"low": -1.0, "high": 1.0}] * 2}

    tested = evaluation(traces={"coverage": ranges(2.0)})
    assert "Next, record motion with the positions of b" in verdict(tested, {"coverage": ranges(1.0)}).because
    inside = evaluation(traces={"coverage": ranges(1.0)})
    narrow = verdict(inside, {"coverage": ranges(1.0)}, [(0.0, 1.2), (0.0, 4.0)])
    assert "Next, record wider motion of b." in narrow.because and "25 % of its range" in narrow.because
    assert "record" not in verdict(inside, {"coverage": ranges(1.0)}, [None, None]).because


def test_no_positions_are_recommended_of_a_joint_that_the_dynamics_do_not_depend_on():
    def ranges(high):
        return {"q": [{"low": 0.0, "high": high}] * 2, "qd": [{"low": -1.0, "high": 1.0}] * 2}

    tested = evaluation(traces={"coverage": ranges(2.0)})
    arguments = {"coverage": ranges(1.0)}, [(0.0, 9.0), (0.0, 9.0)]
    because = verdict(tested, *arguments, independent=["a"]).because
    assert "positions of b" in because and "positions of a" not in because
    assert "record" not in verdict(tested, *arguments, independent=["a", "b"]).because


@pytest.mark.parametrize("errors", [(0.05, 0.004), (0.9, 0.2), (0.2, 0.03)])
def test_a_headline_has_twenty_words_at_most(errors):
    full = evaluation(*errors, seen=True)
    assert len(verdict(full).sentence.split()) <= 20


def test_a_test_on_training_logs_is_no_proof():
    told = verdict(evaluation(seen=True)).sentence
    assert told.startswith("Evaluated on training logs: good enough for")


def test_where_a_constant_velocity_is_better_the_model_is_for_torques():
    still = "velocity stays constant"
    better = "A constant velocity predicts better 1 s ahead: there, use the model for torques only."
    assert better in verdict(evaluation(0.9, 0.004, **{still: 0.6})).because
    # With a torque nMSE of 0.4, torques are not accurate either: "use the model for torques only" is omitted.
    assert "better 1 s ahead. " in f"{verdict(evaluation(0.9, 0.4, **{still: 0.6})).because} "
    held = evaluation(0.9, 0.004, **{still: 0.6, "model + observer": 0.2})
    assert "A constant velocity" not in verdict(held).because
    assert "prediction 1 s ahead with a momentum observer" in verdict(held).sentence


def test_errors_larger_than_the_motion_are_reported_as_such():
    assert "is off by 8 times the motion after 1 s" in verdict(evaluation(8.0)).because


def test_an_empty_evaluation_is_reported():
    assert verdict(results([], {})).sentence == "No verdict: no horizon and no torque was evaluated."


def test_a_long_name_keeps_its_beginning():
    assert (
        short_name("a" * 40) == "a" * 33 + "..."
        and short_name("a  b\n") == "a b\\n"
        and short_name("") == '""'
    )
