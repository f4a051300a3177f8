"""What `--help` says of our classes and commands, none of which it imports; by tests/own_fields.py."""

from math import inf

from jaxlfi.fields import Declared, described, hyperparameter, option

ESTIMATOR = {
    "learning_rate": hyperparameter(default=1e-05, help="Adam's step size", above=0.0),
    "weight_decay": hyperparameter(default=0.0, help="decoupled weight decay", low=0.0),
    "clip_norm": hyperparameter(inf, help="norm the gradients are clipped to; inf: not clipped", high=inf, above=0.0),
    "components": option(default=4, help="Gaussians K in each network's mixture", low=1, high=1000000),
    "ensemble_size": option(default=1, help="networks in the ensemble", low=1, high=1000000),
    "epochs": option(default=1000, help="full passes over the data each round", low=0),
    "steps": option(default=0, help="gradient steps each round, in place of epochs", low=0),
    "batch_size": option(default=100, help="simulations in a minibatch", low=1),
    "schedule": option(default="constant", help="of the learning rate within a round", choices=("constant", "cosine")),
    "validation": option(default=0.0, help="fraction held out to choose the best weights by", low=0.0, high=0.9),
    "patience": option(
        default=0, help="epochs without a better validation loss before training stops; 0: no limit", low=0
    ),
    "warm_start": option(default=True, help="train on from the last round's weights, or start anew"),
    "loss": option(
        "likelihood",
        help="likelihood; atomic, combined: no correction for the proposals needed",
        choices=("likelihood", "atomic", "combined"),
    ),
    "normaliser": option(default="zscore", help="how summaries are normalised", choices=("none", "zscore", "asinh")),
    "embedding": option(
        "none",
        help="network that makes features of long summaries, trained with the other",
        choices=("none", "mlp", "series", "trials"),
    ),
    "features": option(default=16, help="numbers that the embedding makes of a summary", low=1),
    "reduction": option(
        "none",
        help="the networks see what regressions predict; or half of them",
        choices=("none", "regression", "half"),
    ),
    "record_size": option(
        0, help="numbers of a record (channels of a series, length of a trial) in the summary; 0: the task's", low=0
    ),
}
MASKED_FLOW = ESTIMATOR | {
    "hidden": option(default=(50, 50), help="units of each hidden layer", low=1),
    "activation": option(default="tanh", help="relu, tanh or silu", choices=("relu", "tanh", "silu")),
    "transforms": option(default=5, help="transforms of a flow", low=1),
}
SPLINE_FLOW = ESTIMATOR | {
    "hidden": option(default=(50, 50), help="units of each hidden layer", low=1),
    "activation": option(default="tanh", help="relu, tanh or silu", choices=("relu", "tanh", "silu")),
    "transforms": option(default=5, help="transforms of a flow", low=1),
    "bins": option(default=10, help="pieces of each spline", low=1, high=999),
    "tail_bound": option(default=5.0, help="half the splines' range, in standard deviations", low=0.1),
    "regression": option(default=0, help="networks that start from a ridge regression on the summaries", low=0),
}
MIXTURE_LIKELIHOOD = ESTIMATOR | {
    "noise_floor": hyperparameter(
        default=0.03, help="noise added to normalised summaries, of a likelihood", low=0.0, high=1.0
    ),
    "particles": option(default=1000, help="draws that a likelihood's posterior is found by", low=10),
    "hidden": option(default=(50, 50), help="units of each hidden layer", low=1),
    "activation": option(default="tanh", help="relu, tanh or silu", choices=("relu", "tanh", "silu")),
}
MIXTURE_NETWORK = ESTIMATOR | {
    "hidden": option(default=(1024, 1024, 1024), help="units of each hidden layer", low=1),
    "activation": option(default="tanh", help="relu, tanh or silu", choices=("relu", "tanh", "silu")),
    "parameters": option(default="feasible", help="what parameters are scaled by", choices=("feasible", "zscore")),
    "prune": hyperparameter(default=0.0, help="components of less weight than this are dropped", low=0.0, high=0.5),
}
CENTRE = {}
EDGE = {
    "zone_fraction": hyperparameter(
        0.1, help="the zone along a bound, as a fraction of the support's width", symbol="delta", low=0, high=1
    ),
    "mass_threshold": hyperparameter(
        0.12, help="posterior mass in the zone above which its bound moves", symbol="tau", low=0, high=1
    ),
    "expansion": hyperparameter(
        0.2, help="how far a bound moves, as a fraction of the support's width", symbol="eta", low=0
    ),
    "zone_width": hyperparameter(default=0.0, help="an absolute width added to the zone", symbol="delta", low=0),
    "tail": hyperparameter(default=1.0, help="fraction of the mass beyond the bound that counts", low=0, high=1),
}
FIXED = {}
MODE = {
    "shift_threshold": hyperparameter(
        0.01, help="how far a mode must have moved since the last round", symbol="nu_TH", low=0
    ),
    "proximity": hyperparameter(
        0.4, help="how near a bound a mode must be, as a fraction of the support's width", symbol="rho", low=0, high=1
    ),
    "mass_threshold": hyperparameter(
        0.05, help="weight of the modes moving towards a bound above which it moves", symbol="tau", low=0, high=1
    ),
    "expansion": hyperparameter(
        0.2, help="how far a bound moves, as a fraction of the support's width", symbol="eta", low=0
    ),
}
TRUNCATE = {
    "quantile": hyperparameter(default=0.001, help="posterior mass given up beyond each bound", low=0, below=0.5),
}
PPO = {
    "learning_rate": hyperparameter(default=0.0003, help="of Adam", low=0),
    "annealing": hyperparameter(
        0.0, help="fraction of the learning rate that is taken off, evenly, until the last update", low=0, high=1
    ),
    "discount": hyperparameter(default=0.99, help="of a reward one step later", symbol="gamma", low=0, high=1),
    "gae_lambda": hyperparameter(
        default=0.95, help="of the generalised advantage estimate", symbol="lambda", low=0, high=1
    ),
    "entropy": hyperparameter(default=0.0, help="weight of the policy's entropy in the loss", low=0),
    "clipping": hyperparameter(default=0.2, help="of the ratio of probabilities", symbol="epsilon", above=0),
    "value_weight": hyperparameter(default=0.5, help="weight of the value function's loss", low=0),
    "max_gradient_norm": hyperparameter(default=0.5, help="length that gradients are shortened to", above=0),
    "adam_epsilon": hyperparameter(default=1e-05, help="in the denominator of Adam", above=0),
    "initial_deviation": hyperparameter(
        1.0, help="standard deviation of the first policy's actions, as a fraction of their limit", above=0
    ),
    "environments": option(default=12, help="environments side by side, each with its own theta", low=1),
    "unroll": option(default=16, help="steps of a trajectory segment", low=1),
    "segments": option(default=1, help="trajectory segments in a minibatch", low=1),
    "minibatches": option(default=1536, help="minibatches of an update's transitions", low=1),
    "epochs": option(default=10, help="epochs over an update's transitions", low=1),
    "total_steps": option(default=60000, help="steps of all environments together, rounded up to whole updates", low=1),
    "hidden": option(default=(64, 64), help="widths of the hidden layers of both networks", low=1),
    "redrawn": option(
        False, help="draw theta anew for every episode; else each environment keeps its own, as in the paper"
    ),
}
SETTINGS = {
    "rounds": option(default=10, help="inference rounds, N_LFI, at most", low=1, high=100000),
    "min_rounds": option(
        0, help="rounds after which a run ends once its posterior has settled; 0: it makes all", low=0, high=100000
    ),
    "simulations_per_round": option(default=100, help="simulations added each round, at most", low=1, high=100000000),
    "simulation_budget": option(
        125, help="simulations attempted each round, at most, failures included", low=1, high=100000000
    ),
    "correction": option(
        "none", help="from the network to the posterior", choices=("none", "paper", "quotient", "pooled", "importance")
    ),
    "restriction": option(
        default="clip", help="how proposals are kept in the support", choices=("clip", "reject", "mixed")
    ),
    "defensive": hyperparameter(
        0.0, help="fraction of proposals drawn from the prior over the support", low=0.0, high=1.0
    ),
    "inflation": hyperparameter(
        1.0, help="how many times as wide as the posterior proposals are drawn", low=1.0, high=100.0
    ),
    "predictive": option(
        default=True, help="simulate 20 draws of each round's posterior, to compare with the observation"
    ),
}

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
HELP = {
    "jaxlfi.cli.evaluate:main": "evaluate saved policies on other domains",
    "jaxlfi.cli.export:main": "write a policy as one file for a robot's computer",
    "jaxlfi.envs.mujoco.cli:main": "film and refine the posterior of a MuJoCo model",
    "jaxlfi.envs.whip.r2s2r:main": "run the full Real2Sim2Real loop on a reference object",
    "jaxlfi.cli.train:main": "train policies by PPO on domains, such as a posterior",
    "jaxlfi.envs.whip.cli:main": "whipping: render, plan, deploy, control, record, see",
}
"""What our commands do, by what their entry points lead to."""
