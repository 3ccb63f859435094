"""The names of the API of `spelgen`, for type checkers; `__init__.py` reads the homes of the names from this file."""

from spelgen.arm.configured_arm import Arm as Arm
from spelgen.arm.configured_arm import load_arm as load_arm
from spelgen.certificate.inspection import Inspection as Inspection
from spelgen.certificate.inspection import inspect as inspect
from spelgen.certificate.module_check import check as check
from spelgen.design import Design as Design
from spelgen.dynamics.friction import FrictionModel as FrictionModel
from spelgen.dynamics.tip import tip_kinematics as tip_kinematics
from spelgen.emission.assemble import load_module as load_module
from spelgen.emission.build import build as build
from spelgen.emission.specify import generate as generate
from spelgen.errors import SpelgenError as SpelgenError
from spelgen.evaluation.evaluate import evaluate as evaluate
from spelgen.evaluation.results import Results as Results
from spelgen.evaluation.rollout import rollout as rollout
from spelgen.excitation.design import excite as excite
from spelgen.exporting.export import export as export
from spelgen.fitting.dataset import RunOptions as RunOptions
from spelgen.fitting.fit import fit as fit
from spelgen.fitting.fitted import Fit as Fit
from spelgen.fitting.fitted import load_run as load_run
from spelgen.fitting.posterior import Posterior as Posterior
from spelgen.identification.identification import Identification as Identification
from spelgen.identification.identification import LeastSquares as LeastSquares
from spelgen.identification.identify import identify as identify
from spelgen.identification.intervals import Interval as Interval
from spelgen.live.estimator import Estimator as Estimator
from spelgen.live.estimator import EstimatorState as EstimatorState
from spelgen.log_checks.check_logs import check_logs as check_logs
from spelgen.logs.preprocessing import Preprocessing as Preprocessing
from spelgen.logs.read import read_logs as read_logs
from spelgen.logs.read import write_logs as write_logs
from spelgen.logs.trajectory import Trajectory as Trajectory
from spelgen.settings.fits import GaussianPrior as GaussianPrior
from spelgen.settings.fits import MomentumFit as MomentumFit
from spelgen.settings.fits import Rollout as Rollout
from spelgen.settings.fits import TorqueFit as TorqueFit
from spelgen.simulation.as_built import as_built as as_built
from spelgen.simulation.simulate import simulate as simulate
from spelgen.version import __version__ as __version__

__all__: list[str]
