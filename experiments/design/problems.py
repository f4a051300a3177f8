"""The problems of the study, by name."""

import functools
from collections.abc import Mapping

from experiments.design import arms, importance, laplace, machines, tempered
from experiments.design.comparison import Problem, again_and_random
from jaxlfi.envs.lotka_volterra import designed

PROBLEMS: Mapping[str, Problem] = {
    "arm": Problem(functools.partial(arms.arm, False), importance.posterior, again_and_random, rated=96),
    "load": Problem(functools.partial(arms.arm, True), importance.posterior, again_and_random, rated=96),
    "times": Problem(designed.times, tempered.posterior, again_and_random),
    "starts": Problem(designed.starts, tempered.posterior, again_and_random),
    "furuta": Problem(machines.furuta, laplace.posterior, machines.experts_and_random, experiments=3, rated=16),
    "belt": Problem(machines.belt, machines.belt_posterior, machines.experts_and_random, experiments=3, rated=16),
}
