"""What `--help` says of our classes and commands, none of which it imports; by tests/own_fields.py."""

from dataclasses import Field
from math import inf
from typing import Any

from jaxlfi.fields import Declared, described, hyperparameter, option

ESTIMATOR: dict[str, Field[Any]] = {
    "learning_rate": hyperparameter(default=1e-05, help="learning rate of Adam", above=0.0),
    "weight_decay": hyperparameter(default=0.0, help="decoupled weight decay", low=0.0),
    "clip_norm": hyperparameter(default=inf, help="gradients are clipped to this norm; inf: no clipping", high=inf,
        above=0.0),
    "components": option(default=4, help="number K of Gaussians in each network's mixture", low=1, high=1000000),
    "ensemble_size": option(default=1, help="number of networks in the ensemble", low=1, high=1000000),
    "epochs": option(default=1000, help="passes over the data per round", low=0),
    "steps": option(default=0, help="gradient steps per round, instead of epochs", low=0),
    "batch_size": option(default=100, help="simulations per minibatch", low=1),
    "schedule": option(default="constant", help="learning-rate schedule within a round",
        choices=("constant", "cosine")),
    "validation": option(default=0.0, help="fraction of the data held out for validation, to select the best weights",
        low=0.0, high=0.9),
    "patience": option(default=0,
        help="epochs without a better validation loss before training stops; 0: no early stopping", low=0),
    "warm_start": option(default=True, help="start each round from the last round's weights instead of new ones"),
    "loss": option(default="likelihood", help="training loss; atomic and combined need no correction for the proposals",
        choices=("likelihood", "atomic", "combined")),
    "normaliser": option(default="zscore", help="how summaries are normalised", choices=("none", "zscore", "asinh")),
    "embedding": option(default="none",
        help="network that extracts features from long summaries, trained jointly with the density",
        choices=("none", "mlp", "series", "trials")),
    "features": option(default=16, help="number of features that the embedding extracts", low=1),
    "reduction": option(default="none",
        help="which networks see predictions of regressions: none, all (regression), half, or most",
        choices=("none", "regression", "half", "most")),
    "regressor": option(default="linear",
        help="what predicts parameters for a reduction: linear regressions, or kernel ridge regressions",
        choices=("linear", "kernel")),
    "short_summary": option(default=16, help="length of a summary up to which networks with a reduction see it as well",
        low=0),
    "record_size": option(default=0,
        help="numbers per record of the summary (channels of a series, length of a trial); 0: as the task says", low=0),
}  # fmt: skip
MASKED_FLOW: dict[str, Field[Any]] = ESTIMATOR | {
    "hidden": option(default=(50, 50), help="units per hidden layer", low=1),
    "activation": option(default="tanh", help="activation function", choices=("relu", "tanh", "silu")),
    "transforms": option(default=5, help="number of transforms per flow", low=1),
}  # fmt: skip
SPLINE_FLOW: dict[str, Field[Any]] = ESTIMATOR | {
    "hidden": option(default=(50, 50), help="units per hidden layer", low=1),
    "activation": option(default="tanh", help="activation function", choices=("relu", "tanh", "silu")),
    "transforms": option(default=5, help="number of transforms per flow", low=1),
    "bins": option(default=10, help="number of pieces per spline", low=1, high=999),
    "tail_bound": option(default=5.0, help="half-width of the splines' range, in standard deviations", low=0.1),
    "regression": option(default=0, help="number of networks that start from a ridge regression on the summaries",
        low=0),
}  # fmt: skip
MIXTURE_LIKELIHOOD: dict[str, Field[Any]] = ESTIMATOR | {
    "noise_floor": hyperparameter(default=0.03, help="noise added to the summaries before training a likelihood",
        low=0.0, high=1.0),
    "particles": option(default=1000, help="SMC particles (likelihood methods)", low=10),
    "hidden": option(default=(50, 50), help="units per hidden layer", low=1),
    "activation": option(default="tanh", help="activation function", choices=("relu", "tanh", "silu")),
}  # fmt: skip
MIXTURE_NETWORK: dict[str, Field[Any]] = ESTIMATOR | {
    "hidden": option(default=(1024, 1024, 1024), help="units per hidden layer", low=1),
    "activation": option(default="tanh", help="activation function", choices=("relu", "tanh", "silu")),
    "parameters": option(default="feasible", help="how parameters are scaled: by Phi, or to unit variance",
        choices=("feasible", "zscore")),
    "prune": hyperparameter(default=0.0,
        help="mixture components with less weight are dropped, unless other networks confirm them", low=0.0, high=0.5),
}  # fmt: skip
CENTRE: dict[str, Field[Any]] = {}
EDGE: dict[str, Field[Any]] = {
    "zone_fraction": hyperparameter(default=0.1,
        help="width of the zone along a bound, as a fraction of the support's width", symbol="delta", low=0, high=1),
    "mass_threshold": hyperparameter(default=0.12, help="posterior mass in the zone above which the bound moves",
        symbol="tau", low=0, high=1),
    "expansion": hyperparameter(default=0.2, help="how far a bound moves, as a fraction of the support's width",
        symbol="eta", low=0),
    "zone_width": hyperparameter(default=0.0,
        help="width of the zone along a bound, in the parameter's units, added to the fraction", symbol="delta", low=0),
    "tail": hyperparameter(default=1.0, help="fraction of the mass beyond the bound that counts as in the zone", low=0,
        high=1),
    "uninformed_factor": hyperparameter(default=2.5,
        help="how many times the threshold is for a posterior as wide as a uniform one", low=1),
}  # fmt: skip
FIXED: dict[str, Field[Any]] = {}
MODE: dict[str, Field[Any]] = {
    "shift_threshold": hyperparameter(default=0.01, help="how far a mode must have moved since the last round",
        symbol="nu_TH", low=0),
    "proximity": hyperparameter(default=0.4,
        help="how near a bound a mode must be, as a fraction of the support's width", symbol="rho", low=0, high=1),
    "mass_threshold": hyperparameter(default=0.05,
        help="total weight of the modes moving towards a bound, above which the bound moves", symbol="tau", low=0,
        high=1),
    "expansion": hyperparameter(default=0.2, help="how far a bound moves, as a fraction of the support's width",
        symbol="eta", low=0),
}  # fmt: skip
TRUNCATE: dict[str, Field[Any]] = {
    "quantile": hyperparameter(default=0.001, help="posterior mass left beyond each bound", low=0, below=0.5),
}  # fmt: skip
PPO: dict[str, Field[Any]] = {
    "learning_rate": hyperparameter(default=0.0003, help="learning rate of Adam", low=0),
    "annealing": hyperparameter(default=0.0,
        help="fraction by which the learning rate decays, linearly, until the last update", low=0, high=1),
    "discount": hyperparameter(default=0.99, help="discount factor", symbol="gamma", low=0, high=1),
    "gae_lambda": hyperparameter(default=0.95, help="decay of the generalised advantage estimate", symbol="lambda",
        low=0, high=1),
    "entropy": hyperparameter(default=0.0, help="entropy bonus: weight of the policy's entropy in the loss", low=0),
    "clipping": hyperparameter(default=0.2, help="PPO clipping range of the probability ratio", symbol="epsilon",
        above=0),
    "value_weight": hyperparameter(default=0.5, help="weight of the value function's loss", low=0),
    "max_gradient_norm": hyperparameter(default=0.5,
        help="largest norm of a gradient, to which longer ones are clipped", above=0),
    "adam_epsilon": hyperparameter(default=1e-05, help="epsilon of Adam", above=0),
    "initial_deviation": hyperparameter(default=1.0,
        help="initial standard deviation of the actions, as a fraction of their limit", above=0),
    "environments": option(default=12, help="number of environments stepped in parallel, each with its own theta",
        low=1),
    "unroll": option(default=16, help="steps per trajectory segment", low=1),
    "segments": option(default=1, help="trajectory segments per minibatch", low=1),
    "minibatches": option(default=1536, help="minibatches per update", low=1),
    "epochs": option(default=10, help="epochs per update", low=1),
    "total_steps": option(default=60000, help="total environment steps, rounded up to whole updates", low=1),
    "hidden": option(default=(64, 64), help="widths of the hidden layers of both networks", low=1),
    "critic": option(default="observations",
        help="input of the value function: the observations, or theta as well; the policy never sees theta",
        choices=("observations", "theta")),
    "redrawn": option(default=False,
        help="draw a new theta for every episode (in the paper each environment keeps its own)"),
}  # fmt: skip
SETTINGS: dict[str, Field[Any]] = {
    "rounds": option(default=10, help="largest number of inference rounds, N_LFI", low=1, high=100000),
    "min_rounds": option(default=0,
        help="smallest number of rounds; the run then ends once its posterior has settled; 0: always run all rounds",
        low=0, high=100000),
    "simulations_per_round": option(default=100, help="largest number of valid simulations added per round", low=1,
        high=100000000),
    "simulation_budget": option(default=125,
        help="largest number of simulations attempted per round, failures included", low=1, high=100000000),
    "correction": option(default="none", help="how to correct for proposals that are not the prior",
        choices=("none", "paper", "quotient", "pooled", "importance")),
    "restriction": option(default="clip", help="how proposals are kept in the support",
        choices=("clip", "reject", "mixed", "prior")),
    "defensive": hyperparameter(default=0.0, help="fraction of proposals drawn from the prior over the support",
        low=0.0, high=1.0),
    "inflation": hyperparameter(default=1.0, help="width of the proposals, relative to the posterior", low=1.0,
        high=100.0),
    "predictive": option(default=True,
        help="simulate 20 draws of each round's posterior and compare them with the observation"),
}  # fmt: skip

FIELDS: dict[str, dict[str, Declared]] = {
    "jaxlfi.estimators.base:Estimator": described(ESTIMATOR),
    "jaxlfi.estimators.flow_estimators:MaskedFlow": described(MASKED_FLOW),
    "jaxlfi.estimators.flow_estimators:SplineFlow": described(SPLINE_FLOW),
    "jaxlfi.estimators.likelihood_estimators:MixtureLikelihood": described(MIXTURE_LIKELIHOOD),
    "jaxlfi.estimators.mixture_network:MixtureNetwork": described(MIXTURE_NETWORK),
    "jaxlfi.heuristics.centre:Centre": described(CENTRE),
    "jaxlfi.heuristics.edge:Edge": described(EDGE),
    "jaxlfi.heuristics.fixed:Fixed": described(FIXED),
    "jaxlfi.heuristics.mode:Mode": described(MODE),
    "jaxlfi.heuristics.truncate:Truncate": described(TRUNCATE),
    "jaxlfi.rl.settings:PPO": described(PPO),
    "jaxlfi.bayessim.settings:Settings": described(SETTINGS),
}
"""Fields by the class that declares them, as "module:Class", and by their own name."""
PRESETS: dict[str, dict[str, Any]] = {
    "quick": {"rounds": 20, "min_rounds": 10, "simulations_per_round": 100, "simulation_budget": 125,
        "correction": "pooled", "restriction": "mixed", "defensive": 0.0, "inflation": 2.0, "predictive": True,
        "learning_rate": 0.003, "weight_decay": 0.0, "clip_norm": inf, "components": 4, "ensemble_size": 4,
        "epochs": 100, "steps": 0, "batch_size": 100, "schedule": "cosine", "validation": 0.1, "patience": 0,
        "warm_start": False, "loss": "likelihood", "normaliser": "asinh", "embedding": "none", "features": 16,
        "reduction": "most", "regressor": "linear", "short_summary": 9, "record_size": 0, "hidden": (64, 64),
        "activation": "tanh", "parameters": "zscore", "prune": 0.1},
    "paper": {"rounds": 10, "min_rounds": 0, "simulations_per_round": 100, "simulation_budget": 125,
        "correction": "none", "restriction": "clip", "defensive": 0.0, "inflation": 1.0, "predictive": True,
        "learning_rate": 1e-05, "weight_decay": 0.0, "clip_norm": inf, "components": 4, "ensemble_size": 1,
        "epochs": 1000, "steps": 0, "batch_size": 100, "schedule": "constant", "validation": 0.0, "patience": 0,
        "warm_start": True, "loss": "likelihood", "normaliser": "zscore", "embedding": "none", "features": 16,
        "reduction": "none", "regressor": "linear", "short_summary": 16, "record_size": 0, "hidden": (1024, 1024, 1024),
        "activation": "tanh", "parameters": "feasible", "prune": 0.0},
}  # fmt: skip
"""Settings of a run by the preset and the name, its estimator's among them."""
POLICIES: dict[str, dict[str, Any]] = {
    "quick": {"learning_rate": 0.0005, "annealing": 0.0, "discount": 0.99, "gae_lambda": 0.95, "entropy": 0.01,
        "clipping": 0.2, "value_weight": 0.5, "max_gradient_norm": 0.5, "adam_epsilon": 1e-05, "initial_deviation": 1.0,
        "environments": 12, "unroll": 16, "segments": 1, "minibatches": 12, "epochs": 10, "total_steps": 60000,
        "hidden": (64, 64), "critic": "observations", "redrawn": False},
    "paper": {"learning_rate": 0.0003, "annealing": 0.0, "discount": 0.99, "gae_lambda": 0.95, "entropy": 0.0,
        "clipping": 0.2, "value_weight": 0.5, "max_gradient_norm": 0.5, "adam_epsilon": 1e-05, "initial_deviation": 1.0,
        "environments": 12, "unroll": 16, "segments": 1, "minibatches": 1536, "epochs": 10, "total_steps": 60000,
        "hidden": (64, 64), "critic": "observations", "redrawn": False},
}  # fmt: skip
"""Settings of a training of policies, likewise."""
HELP = {
    "jaxlfi.cli.control:main": "run a policy on a robot",
    "jaxlfi.cli.design:main": "recommend the next experiment",
    "jaxlfi.cli.evaluate:main": "evaluate saved policies on other domains",
    "jaxlfi.cli.export:main": "convert a policy to a single file for a robot's computer",
    "jaxlfi.envs.mujoco.cli:main": "inspect recordings of a MuJoCo model, film and refine its posterior",
    "jaxlfi.cli.r2s2r:main": "run the full Real2Sim2Real loop on a machine or a reference object",
    "jaxlfi.cli.train:main": "train policies by PPO on domains, such as a posterior",
    "jaxlfi.envs.whip.cli:main": "the whipping task: render, plan, deploy, control, record, train vision",
}
"""What our commands do, by what their entry points lead to."""
