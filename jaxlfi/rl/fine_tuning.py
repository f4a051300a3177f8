"""Fine-tuning: training that starts from an earlier policy with the same signals and actions."""

import dataclasses

import numpy as np

from jaxlfi.rl.environment import Environment
from jaxlfi.rl.policy import Policy
from jaxlfi.rl.settings import PPO


def started(policy: Policy, environment: Environment, settings: PPO) -> Policy:
    """The policy from which a training starts: the earlier one, converted to the environment's own scaling.

    If the scaling differs, for example because of other limits, the first and the last layer absorb the difference, so
    that actions are the same within the limits of both.

    Args:
        policy: earlier policy; the environment that it was trained in may have had another name.
        environment: environment to train in.
        settings: settings of the training.

    Raises:
        ValueError: for a policy with other signals or actions, or with other hidden layers than the settings', and for
            a policy or an environment with memory, in one line.
    """
    if policy.memory or getattr(environment, "memory", 0):
        raise ValueError("start: expected a policy and a task without memory, which has to be learnt anew")
    try:
        policy.require(None, environment.observations, environment.actions)
    except ValueError as error:
        raise ValueError(f"start: {error}") from error
    hidden = tuple(len(bias) for bias in policy.biases[:-1])
    if hidden != tuple(settings.hidden):
        raise ValueError(
            f"start: expected a policy with the settings' hidden layers, {_widths(settings.hidden)}, got one with "
            f"{_widths(hidden)}: --hidden {_widths(hidden)}"
        )
    weights, biases = ([np.asarray(array, float) for array in arrays] for arrays in (policy.weights, policy.biases))
    (centre, scale), (own_centre, own_scale) = _scaling(policy.observed), _scaling(vars(environment.observations))
    biases[0] = biases[0] + ((own_centre - centre) / scale) @ weights[0]
    weights[0] = (own_scale / scale)[:, None] * weights[0]
    (centre, scale), (own_centre, own_scale) = _scaling(policy.acted), _scaling(vars(environment.actions))
    weights[-1] = weights[-1] * (scale / own_scale)
    biases[-1] = (biases[-1] * scale + centre - own_centre) / own_scale
    single = lambda arrays: tuple(array.astype(np.float32) for array in arrays)
    signals = {what: dataclasses.asdict(getattr(environment, what)) for what in ("observations", "actions")}
    return Policy(single(weights), single(biases), {**policy.schema, **signals})


def _scaling(signals) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(signals["centre"], float), np.asarray(signals["scale"], float)


def _widths(hidden) -> str:
    return " ".join(map(str, hidden))
