"""Differences between exports and the torch module at 10,000 states, and the time of one call of each export.

    python benchmarks/deploy.py [--parity] [--latency]

Needs the extras deploy and simulate and a C compiler. The presets are closed-form and hybrid, which can be exported to
C. A random normal number is added to every parameter, so that every part of the model has an effect. Differences are
printed for six arms of robots/, times on one core for the UR10e. Times are also measured for hybrid without selected
residual terms, since most fits select none.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pinocchio as pin
import torch

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.pinocchio_arm import pinocchio_model
from spelgen.emission.build import build
from spelgen.exporting.c_export import called_by_c, compile_library, compiler
from spelgen.exporting.c_source import c_functions, write_c
from spelgen.exporting.casadi_export import called_by_state, casadi_functions
from spelgen.exporting.describe import Trained, TrainedModel
from spelgen.exporting.mjcf_export import check_mjcf, mjcf_text
from spelgen.exporting.model_expressions import expression_functions
from spelgen.exporting.onnx_export import called_by_onnx, onnx_model, onnx_session
from spelgen.exporting.parity import ENTRY_POINTS, PROGRAMS, Called, Parity, check_parity
from spelgen.exporting.rigid_body_projection import rigid_body_projection

ROBOTS = Path(__file__).parents[1] / "robots"
ARMS = ("two_link", "rpr", "scara", "six_dof", "ur10e", "panda")
PRESETS = ("closed-form", "hybrid")
RESIDUALS = "residuals."
STATES = 10_000
ENTRIES = {name: entry for name, entry in ENTRY_POINTS.items() if name != "servo_torque"}
CALLS = 50  # calls between two readings of the clock, whose resolution is tens of nanoseconds
FLAGS = ("-O2",)


def trained(robot: str, preset: str, size: float = 0.05, *, residuals: bool = True) -> Trained:
    """Return a model to whose parameters random normal numbers with standard deviation ``size`` are added.

    Without ``residuals`` the parameters of residual terms are unchanged.
    """
    arm = load_arm(ROBOTS / f"{robot}.urdf")
    model, random = build(arm, preset), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if residuals or not name.startswith(RESIDUALS):
                parameter += size * torch.randn(parameter.shape, dtype=torch.float64, generator=random)
    return Trained(model.requires_grad_(False), arm)


def parity() -> None:
    """Print per export the largest difference from the torch module at `STATES` states, relative to the largest value.

    The models have random parameters (`trained`).
    """
    names = list(ENTRIES)
    print(f"{'':24s}{'C double':>12s}{'C float':>12s}{'CasADi':>12s}{'ONNX':>12s}{'MuJoCo':>12s}")
    for robot in ARMS:
        for preset in PRESETS:
            each = trained(robot, preset)
            model = each.described

            def worst(
                called: Called, asked: list[str] = names, each: Trained = each, dtype: type = np.float64
            ) -> float:
                return _largest(check_parity(called, each, asked, np.inf, states=STATES, dtype=dtype))

            with tempfile.TemporaryDirectory() as folder:
                kinds = (("", np.float64), (f"-D{model.name.upper()}_FLOAT", np.float32))
                c = [worst(library(model, Path(folder), flag, kind), dtype=kind) for flag, kind in kinds]
            undifferentiated = {name: entry for name, entry in ENTRIES.items() if "derivatives" not in name}
            casadi = worst(called_by_state(casadi_functions(model, undifferentiated)), list(undifferentiated))
            prepared = each.model.prepared()
            files = {name: onnx_model(prepared, name) for name in PROGRAMS}
            onnx = worst(called_by_onnx(files), list(PROGRAMS))
            projection = rigid_body_projection(each.model, each.arm)
            mujoco = _largest(check_mjcf(mjcf_text(projection)[0], projection, states=STATES))
            print(
                f"{robot:12s}{preset:12s}" + "".join(f"{x:12.1e}" for x in (*c, casadi, onnx, mujoco)),
                flush=True,
            )


def _largest(found: Parity) -> float:
    """Return the largest relative difference over all entry points, except entry points of the tip."""
    # the tip's pose and Jacobian are omitted: they depend only on the URDF's geometry, not on the fitted parameters
    return max(value for name, value in found.differences.items() if not name.startswith("tip_"))


def library(model: TrainedModel, folder: Path, flag: str, kind: type) -> Called:
    """Compile the C code of a model in ``folder``; return a function that calls the compiled entry points.

    flag: compiler flag that selects single precision; "": double precision. kind: NumPy type of the same precision.
    """
    program, own_folder = compiler(), folder / kind.__name__
    assert program is not None
    own_folder.mkdir()
    functions = c_functions(model, ENTRIES)
    compiled = compile_library(write_c(model, functions, own_folder), program, *([flag] * bool(flag)))
    return called_by_c(compiled, functions, kind)


TIMED = r"""
#include "{name}.h"
{include}
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double states[1024][3][{n}], samples[4000], z[{nz} + 1], z2[{nz} + 1];
static double a[{square}], b[{square}], out[{square}], w[20000], sum;
static long long iw[1000];

static double now(void)
{{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1e9 + t.tv_nsec;
}}

static int order(const void *one, const void *other)
{{
    double x = *(const double *)one, y = *(const double *)other;
    return (x > y) - (x < y);
}}

#define RUN(label, call)                                                                  \
    for (r = 0; r < 4000; r++) {{                                                           \
        double t = now();                                                                 \
        for (k = 0; k < {calls}; k++) {{                                                      \
            double *q = states[(r * {calls} + k) & 1023][0], *qd = q + {n}, *x = qd + {n};      \
            (void)q, (void)qd, (void)x;                                                   \
            call;                                                                         \
            sum += out[0];                                                                \
        }}                                                                                 \
        samples[r] = (now() - t) / {calls};                                                 \
    }}                                                                                     \
    qsort(samples, 4000, sizeof(double), order);                                          \
    printf("  %-44s %8.3f %8.3f\n", label, samples[2000] / 1e3, samples[3960] / 1e3);

int main(void)
{{
    int i, j, k, r;
    (void)iw, (void)w, (void)a, (void)b, (void)z, (void)z2;
    for (i = 0; i < 1024; i++)
        for (j = 0; j < 3; j++)
            for (k = 0; k < {n}; k++)
                states[i][j][k] = (rand() / (double)RAND_MAX * 2 - 1) * (j == 2 ? 10 : 2);
{runs}
    return sum == 0.123;
}}
"""


def latency(robot: str = "ur10e") -> None:
    """Print the median and the 99th percentile of the time of one call [us], per export, on one core."""
    print(f"{robot}, one call on one core; {compiler()} {' '.join(FLAGS)}{'':20s} median      p99  [us]")
    for preset, each in (
        ("closed-form", trained(robot, "closed-form")),
        ("hybrid", trained(robot, "hybrid", residuals=False)),
        ("hybrid with all residuals", trained(robot, "hybrid")),
    ):
        model = each.described
        print(f"{preset}, C")
        time_c(model, beside_casadi=preset == "closed-form")
        if preset == "closed-form":
            law = model.friction
            torques = ("viscous", "saturation", "coulomb", "stribeck", "load_dependence", "bristle_fractions")
            none = law._replace(**{name: 0 * getattr(law, name) for name in torques})
            print(f"{preset}, C, rigid bodies alone")
            time_c(replace(model, friction=none), beside_casadi=True)
        prepared = each.model.prepared()
        q, qd, tau = 0.3 * torch.ones(3, model.n, dtype=torch.float64)
        batch = [x.expand(1024, -1).contiguous() for x in (q, qd, tau)]
        print(f"{preset}, torch")
        with torch.inference_mode():
            show("prepared forward_dynamics", lambda: prepared.forward_dynamics(q, qd, tau))  # noqa: B023
            show("prepared inverse_dynamics", lambda: prepared.inverse_dynamics(q, qd, tau))  # noqa: B023
            show("prepared forward_dynamics, 1024 states", lambda: prepared.forward_dynamics(*batch))  # noqa: B023
            compiled = prepared.compile()
            show("compiled forward_dynamics", lambda: compiled.forward_dynamics(q, qd, tau))  # noqa: B023
        print(f"{preset}, ONNX Runtime")
        given = {"q": q, "qd": qd, "tau": tau, "qdd": tau}
        for name in ("forward_dynamics", "inverse_dynamics"):
            session = onnx_session(onnx_model(prepared, name))
            wanted = [x.name for x in session.get_inputs()]
            states = {key: given[key].numpy()[None] for key in wanted if key in given}
            if "z" in wanted:
                states["z"] = np.zeros((1, model.memory))
            show(name, lambda: session.run(None, states))  # noqa: B023
    print("Pinocchio, Python")
    arm = load_arm(ROBOTS / f"{robot}.urdf")
    rigid = pinocchio_model(arm.chain, arm.settings)
    data, x = rigid.createData(), np.full(rigid.nv, 0.3)
    show("rnea", lambda: pin.rnea(rigid, data, x, x, x))
    show("aba", lambda: pin.aba(rigid, data, x, x, x))
    show("crba", lambda: pin.crba(rigid, data, x))


def time_c(model: TrainedModel, *, beside_casadi: bool) -> None:
    """Compile a program that times the C of the model and CasADi's C of the same expressions, and show its output."""
    name, runs, include, sources = model.name, [], "", [f"{model.name}.c", "timed.c"]
    given = {"q": "q", "qd": "qd", "qdd": "x", "tau": "x", "z": "z", "dq": "qd"}
    for entry in ENTRIES.values():
        arguments = [*(given[each] for each in entry.inputs), *("out", "a", "b")[: len(entry.outputs)]]
        if entry.name.startswith("friction_"):
            arguments[-1] = "z2"
        runs.append(f'RUN("{entry.name}", {name}_{entry.name}({", ".join(arguments)}));')
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        if beside_casadi:
            functions = expression_functions(model, ENTRIES)
            for entry in list(ENTRIES.values())[:2]:
                function = functions[entry.name]
                (place / f"{entry.name}_casadi.c").write_text(_generated(function))
                include += f"int {entry.name}(const double **, double **, long long *, double *, int);\n"
                arguments = ", ".join(f"arg[{k}] = {given[each]}" for k, each in enumerate(entry.inputs))
                call = f"({arguments}, res[0] = out, {entry.name}(arg, res, iw, w, 0))"
                runs.append(
                    f'{{ const double *arg[20]; double *res[20]; RUN("CasADi\'s C of {entry.name}", {call}); }}'
                )
                sources.append(f"{entry.name}_casadi.c")
        write_c(model, c_functions(model, ENTRIES), place)
        text = TIMED.format(
            name=name, include=include, n=model.n, nz=model.memory, square=max(6 * model.n, model.n**2, 16),
            calls=CALLS, runs="\n".join(runs),
        )  # fmt: skip
        (place / "timed.c").write_text(text)
        program = compiler()
        assert program is not None
        subprocess.run([program, "-std=gnu99", *FLAGS, *sources, "-o", "timed", "-lm"], cwd=place, check=True)
        print(
            subprocess.run(["./timed"], cwd=place, capture_output=True, text=True, check=True).stdout, end=""
        )


def _generated(function: ca.Function) -> str:
    generator = ca.CodeGenerator(function.name())
    generator.add(function)
    text: str = generator.dump()
    return text


def show(name: str, call: Callable[[], object], repeats: int = 2000) -> None:
    """Print the median and the 99th percentile of the time of a call [us]."""
    for _ in range(50):
        call()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    print(f"  {name:44s} {np.median(seconds) * 1e6:8.2f} {np.percentile(seconds, 99) * 1e6:8.2f}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parity", action="store_true")
    parser.add_argument("--latency", action="store_true")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    everything = not (chosen.parity or chosen.latency)
    if chosen.parity or everything:
        parity()
    if chosen.latency or everything:
        latency()
