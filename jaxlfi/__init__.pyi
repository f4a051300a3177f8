# The public names, each with the module it lives in: what type checkers see, and what `jaxlfi/__init__.py` loads from.

from jaxlfi import plot as plot
from jaxlfi.bayessim.batch import stack as stack
from jaxlfi.bayessim.presets import METHODS as METHODS, PAPER as PAPER, PRESETS as PRESETS, QUICK as QUICK
from jaxlfi.bayessim.presets import settings_for as settings_for
from jaxlfi.bayessim.settings import Settings as Settings
from jaxlfi.distributions.belief import Belief as Belief
from jaxlfi.distributions.mixture import GaussianMixture as GaussianMixture
from jaxlfi.distributions.support import Support as Support
from jaxlfi.estimators.base import Estimator as Estimator
from jaxlfi.estimators.flow_estimators import MaskedFlow as MaskedFlow, SplineFlow as SplineFlow
from jaxlfi.estimators.likelihood_estimators import MixtureLikelihood as MixtureLikelihood
from jaxlfi.estimators.mixture_network import MixtureNetwork as MixtureNetwork
from jaxlfi.estimators.posterior import Posterior as Posterior
from jaxlfi.fields import hyperparameter as hyperparameter, option as option
from jaxlfi.heuristics import Centre as Centre, Choice as Choice, Edge as Edge, Fixed as Fixed
from jaxlfi.heuristics import Heuristic as Heuristic, Matched as Matched, Mode as Mode, Truncate as Truncate
from jaxlfi.runs.infer import infer as infer
from jaxlfi.runs.load import load as load
from jaxlfi.runs.resume import resume as resume
from jaxlfi.runs.run import MisspecificationWarning as MisspecificationWarning
from jaxlfi.runs.run import Run as Run, SupportWarning as SupportWarning
from jaxlfi.tasks.errors import ExecutorError as ExecutorError, SimulatorError as SimulatorError
from jaxlfi.tasks.errors import SimulatorWarning as SimulatorWarning
from jaxlfi.tasks.gaps import with_gaps as with_gaps
from jaxlfi.tasks.host import HostSimulator as HostSimulator
from jaxlfi.tasks.tailed_uniform import with_tails as with_tails
from jaxlfi.tasks.task import Task as Task
from jaxlfi.tasks.trials import repeated as repeated

__version__: str
__all__: list[str]
