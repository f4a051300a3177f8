# What type checkers see of the names that are loaded when they are first used.

from jaxlfi import plot as plot
from jaxlfi.bayessim.batch import stack as stack
from jaxlfi.bayessim.presets import METHODS as METHODS
from jaxlfi.bayessim.presets import PAPER as PAPER
from jaxlfi.bayessim.presets import PRESETS as PRESETS
from jaxlfi.bayessim.presets import QUICK as QUICK
from jaxlfi.bayessim.settings import Settings as Settings
from jaxlfi.distributions.belief import Belief as Belief
from jaxlfi.distributions.mixture import GaussianMixture as GaussianMixture
from jaxlfi.distributions.support import Support as Support
from jaxlfi.estimators.base import Estimator as Estimator
from jaxlfi.estimators.flow_estimators import MaskedFlow as MaskedFlow
from jaxlfi.estimators.flow_estimators import SplineFlow as SplineFlow
from jaxlfi.estimators.likelihood_estimators import MixtureLikelihood as MixtureLikelihood
from jaxlfi.estimators.mixture_network import MixtureNetwork as MixtureNetwork
from jaxlfi.estimators.posterior import Posterior as Posterior
from jaxlfi.fields import hyperparameter as hyperparameter
from jaxlfi.fields import option as option
from jaxlfi.heuristics import (
    Centre as Centre,
)
from jaxlfi.heuristics import (
    Choice as Choice,
)
from jaxlfi.heuristics import (
    Edge as Edge,
)
from jaxlfi.heuristics import (
    Fixed as Fixed,
)
from jaxlfi.heuristics import (
    Heuristic as Heuristic,
)
from jaxlfi.heuristics import (
    Matched as Matched,
)
from jaxlfi.heuristics import (
    Mode as Mode,
)
from jaxlfi.heuristics import (
    Truncate as Truncate,
)
from jaxlfi.runs.infer import infer as infer
from jaxlfi.runs.load import load as load
from jaxlfi.runs.run import MisspecificationWarning as MisspecificationWarning
from jaxlfi.runs.run import Run as Run
from jaxlfi.runs.run import SupportWarning as SupportWarning
from jaxlfi.tasks.errors import ExecutorError as ExecutorError
from jaxlfi.tasks.errors import SimulatorError as SimulatorError
from jaxlfi.tasks.gaps import with_gaps as with_gaps
from jaxlfi.tasks.host import HostSimulator as HostSimulator
from jaxlfi.tasks.tailed_uniform import with_tails as with_tails
from jaxlfi.tasks.task import Task as Task
from jaxlfi.tasks.trials import repeated as repeated

__version__: str
__all__: list[str]
