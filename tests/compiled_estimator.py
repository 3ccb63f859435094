"""The exported C estimator of payload, friction drift and contacts, compiled and run along logs."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from spelgen.arm.configured_arm import Arm
from spelgen.emission.assemble import ArmModel
from spelgen.exporting.c_estimator import CALLED, estimator_c_functions, estimator_texts
from spelgen.exporting.c_export import compile_library
from spelgen.exporting.c_source import c_functions, write_c
from spelgen.exporting.describe import describe
from spelgen.exporting.parity import ENTRY_POINTS
from spelgen.live.estimator import EstimatorState
from spelgen.live.intake import REFUSALS
from spelgen.live.noise import BlockNoise, NoiseLevels
from spelgen.live.payload import Status


def nominal_levels(
    effort: np.ndarray, speed: np.ndarray, coulomb: np.ndarray, noise_ratio: float = 2e-3
) -> NoiseLevels:
    """Return plausible noise levels of an estimator that was not fitted to logs.

    Args:
        effort: (n,) torque limits [Nm, N].
        speed: (n,) velocity limits [rad/s, m/s].
        coulomb: (n,) Coulomb friction [Nm, N].
        noise_ratio: standard deviation of the torque noise relative to the torque limits.
    """
    ones = np.ones(len(effort))
    white = noise_ratio * effort
    noise = BlockNoise(white=white, disturbance=1.5 * white, time_constant=0.7 * ones)
    return NoiseLevels(
        drift=noise, load=noise, observer=white, peak_start=2.5 * ones, peak_scale=0.7 * ones, peak_count=40,
        load_variance=2.25, load_freedom=20, resting=0.6 * coulomb, resting_speed=0.01 * speed, speed=speed,
        encoder=0 * ones, effort=effort, minutes=2.0, point=np.array([0.0, 0.0, 0.1]), delay=0.0,
    )  # fmt: skip


_RUNNER = """
#include "NAME_estimator.h"
#include <string.h>
#include <time.h>
#define N UPPER_N
typedef NAME_real real;

static double now(void)
{
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return at.tv_sec + 1e-9 * at.tv_nsec;
}

size_t size(void) { return sizeof(NAME_estimator); }
size_t saved_size(void) { return UPPER_ESTIMATOR_SAVED; }
void refusals(const NAME_estimator *e, double *counts)
{
    int k;
    for (k = 0; k < UPPER_REASONS; k++)
        counts[k] = (double)e->refused[k];
}

/* rows: external torque, threshold, friction scale, disturbance (N each), tip force (3), refusal, changed, status,
log odds, limit,
 * mass and interval, centre (3), inertia (6), parameters (10), seconds of the step and of the report, motion */
void run(NAME_estimator *e, size_t count, const double *t, const real *q, const real *qd, const real *tau, double *out)
{
    size_t k;
    int j;
    for (k = 0; k < count; k++) {
        NAME_estimate at;
        double *row = out + k * (4 * N + 33), start = now(), middle;
        NAME_estimator_step(e, t[k], q + k * N, qd + k * N, tau + k * N, &at);
        middle = now();
        memcpy(row, at.external_torque, sizeof at.external_torque);
        memcpy(row + N, at.threshold, sizeof at.threshold);
        row += 4 * N;
        memcpy(row, at.tip_force, sizeof at.tip_force);
        row[3] = at.refusal;
        row[4] = at.load_changed;
        row[30] = middle - start;
        if (at.report_due) {
            NAME_payload found;
            middle = now();
            NAME_estimator_report(e, &found);
            row[31] = now() - middle;
        }
        for (j = 0; j < N; j++) {
            row[j - 2 * N] = 1.0 + e->drift[0][j];
            row[j - N] = e->drift[1][j];
        }
        row[5] = e->payload.status;
        row[6] = e->payload.log_odds;
        row[7] = e->payload.limit;
        row[8] = e->payload.mass;
        memcpy(row + 9, e->payload.mass_interval, 2 * sizeof(double));
        memcpy(row + 11, e->payload.center, 3 * sizeof(double));
        memcpy(row + 14, e->payload.inertia, 6 * sizeof(double));
        memcpy(row + 20, e->payload.parameters, 10 * sizeof(double));
        row[32] = e->moved;
    }
}
"""


@dataclass(frozen=True, eq=False)
class Columns:
    """Outputs of the estimator at each sample of a log, (T,) or (T, ...)."""

    external_torque: np.ndarray
    threshold: np.ndarray
    friction_scale: np.ndarray
    disturbance: np.ndarray
    force: np.ndarray
    refusal: np.ndarray
    changed: np.ndarray
    status: np.ndarray
    log_odds: np.ndarray
    limit: np.ndarray
    mass: np.ndarray
    mass_interval: np.ndarray
    center: np.ndarray
    inertia: np.ndarray
    parameters: np.ndarray
    step_seconds: np.ndarray
    report_seconds: np.ndarray
    moved: np.ndarray


def differences(found: Columns, states: Sequence[EstimatorState]) -> dict[str, float]:
    """Return the largest differences between the C and the Python estimator, relative to each quantity's largest value.

    Quantities without a magnitude (status, refusal, change of load) differ by 1 if any sample differs.
    """
    result = {}
    for name in ("external_torque", "threshold", "force", "friction_scale", "disturbance"):
        expected = np.array([getattr(state, name, getattr(state.contact, name, None)) for state in states])
        size = np.abs(found.external_torque if name == "disturbance" else expected).max()
        result[name] = float(np.abs(getattr(found, name) - expected).max() / (size or 1.0))
    for name in ("mass", "mass_interval", "center", "parameters", "log_odds"):
        expected = np.array([getattr(state.payload, name) for state in states])
        size = np.abs(expected).max()
        result[name] = float(np.abs(getattr(found, name) - expected).max() / (size or 1.0))
    statuses, refusals = get_args(Status), [REFUSALS.index(state.refusal) for state in states]
    result["status"] = float(
        (found.status != [statuses.index(state.payload.status) for state in states]).any()
    )
    result["changed"] = float((found.changed != [state.load_changed for state in states]).any())
    return result | {"refusal": float((found.refusal != refusals).any())}


class CompiledEstimator:
    """The C estimator of a model, exported to a temporary folder, compiled and called by ctypes."""

    def __init__(
        self, trained: ArmModel, arm: Arm, levels: NoiseLevels, *flags: str, program: str = "gcc"
    ) -> None:
        model = describe(trained, arm)
        self.n, self.name = model.n, model.name
        self.dtype = np.float32 if any(flag.endswith("_FLOAT") for flag in flags) else np.float64
        functions = c_functions(model, {name: ENTRY_POINTS[name] for name in CALLED})
        self.folder = tempfile.TemporaryDirectory()
        source = write_c(model, [*functions, *estimator_c_functions(model, levels)], Path(self.folder.name))
        for name, text in estimator_texts(model, levels).items():
            Path(self.folder.name, name).write_text(text)
        runner = Path(self.folder.name, "runner.c")
        runner.write_text(_RUNNER.replace("NAME", model.name).replace("UPPER", model.name.upper()))
        sources = [source, source.with_name(f"{model.name}_estimator.c"), runner]
        flags = ("-std=gnu99", "-Wno-unused-parameter", *flags)
        self.library = ctypes.CDLL(str(compile_library(sources, shutil.which(program) or "cc", *flags)))
        self.library.size.restype = self.library.saved_size.restype = ctypes.c_size_t
        self.start()

    def start(self) -> None:
        """Restart the estimator, without any history."""
        self.state = ctypes.create_string_buffer(self.library.size())
        self.library[f"{self.name}_estimator_init"](self.state)

    def run(self, t: np.ndarray, q: np.ndarray, qd: np.ndarray, tau: np.ndarray) -> Columns:
        """Run the estimator along times (T,) and positions, velocities and torques (T, n); return its outputs."""
        out = np.zeros((len(t), 4 * self.n + 33))
        arrays = [
            np.ascontiguousarray(t, float),
            *(np.ascontiguousarray(x, self.dtype) for x in (q, qd, tau)),
            out,
        ]
        pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in arrays]
        self.library.run(self.state, ctypes.c_size_t(len(t)), *pointers)
        n = self.n
        sizes = (n, n, n, n, 3, 1, 1, 1, 1, 1, 1, 2, 3, 6, 10, 1, 1, 1)
        parts = np.split(out, np.cumsum(sizes)[:-1], axis=1)
        return Columns(*(x[:, 0] if size == 1 else x for x, size in zip(parts, sizes, strict=True)))

    def refused(self) -> dict[str, int]:
        """Return the number of samples that the estimator refused, by reason."""
        counts = np.zeros(len(REFUSALS))
        self.library.refusals(self.state, counts.ctypes.data_as(ctypes.c_void_p))
        return dict(zip(REFUSALS, counts.astype(int).tolist(), strict=True))

    def saved(self) -> ctypes.Array[ctypes.c_char]:
        """Return the state of the estimator as the bytes that its C function `..._estimator_save` writes."""
        state = ctypes.create_string_buffer(self.library.saved_size())
        self.library[f"{self.name}_estimator_save"](self.state, state)
        return state

    def restore(self, state: ctypes.Array[ctypes.c_char]) -> bool:
        """Load a state that `saved` returned; return False if the C function refuses the bytes."""
        return bool(self.library[f"{self.name}_estimator_restore"](self.state, state))

    def compensate_external(self, wanted: bool) -> None:
        """Set whether `torque` compensates external torques, the option `compensate_external` of the C struct.

        The option is an int. Only 1 + n doubles precede it in the struct: alarms_per_minute and torque_limit (n).
        """
        ctypes.c_int.from_buffer(self.state, 8 * (1 + self.n)).value = wanted

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, ahead: float) -> np.ndarray:
        """Return the torques (n,) predicted for q, qd and qdd (n,), `ahead` seconds after the last sample."""
        tau = np.zeros(self.n, self.dtype)
        arrays = [np.ascontiguousarray(x, self.dtype) for x in (q, qd, qdd)]
        q_, qd_, qdd_, tau_ = (x.ctypes.data_as(ctypes.c_void_p) for x in (*arrays, tau))
        self.library[f"{self.name}_estimator_torque"](self.state, q_, qd_, qdd_, ctypes.c_double(ahead), tau_)
        return tau
