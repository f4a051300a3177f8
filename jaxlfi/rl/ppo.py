"""PPO (Schulman et al., 2017) built from Brax's parts, as init / update / train.

The losses, networks and acting are Brax's own. The loop around them is ours: it keeps all that the next update needs in
one pytree, so that an interrupted training continues bit for bit, and trainings with different seeds, domains and
hyperparameters run in parallel under `vmap`. With the same keys, its updates are those of
`brax.training.agents.ppo.train`.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import linen, struct
from jaxtyping import Array, Float, Int

from jaxlfi.io.quiet_imports import quiet_imports
from jaxlfi.rl import deployment, preparation, recurrent
from jaxlfi.rl.domains import Domain
from jaxlfi.rl.environment import Environment
from jaxlfi.rl.episodes import Batch, Ended, Episodes
from jaxlfi.rl.policy import Policy, Unit
from jaxlfi.rl.settings import PPO

try:
    with quiet_imports():
        from brax.training import acting
        from brax.training.agents.ppo import losses, networks
        from brax.training.networks import make_value_network
except ImportError as error:
    raise ImportError("jaxlfi.rl needs Brax: pip install 'jaxlfi[policy]'") from error


class Training(struct.PyTreeNode):
    """The state between two updates.

    Attributes:
        params: parameters of the policy and value networks.
        optimiser: state of Adam.
        episodes: current episodes of the environments.
        key: random key of the updates to come.
        updates: number of updates so far.
    """

    params: losses.PPONetworkParams
    optimiser: Any
    episodes: Episodes
    key: jax.Array
    updates: Int[Array, ""]


class Update(struct.PyTreeNode):
    """Metrics of an update.

    Attributes:
        episodes: number of episodes that ended.
        value: mean return of these episodes; NaN without any.
        length: mean number of steps of these episodes.
        facts: means of the facts that the environment reports about them.
        losses: losses by Brax's names, means over minibatches.
    """

    episodes: Int[Array, ""]
    value: Float[Array, ""]
    length: Float[Array, ""]
    facts: dict[str, Array]
    losses: dict[str, Array]


def policy_networks(environment: Environment, settings: PPO) -> networks.PPONetworks:
    """A Gaussian policy with a state-independent standard deviation, and a value function, both tanh networks.

    Their inputs are observations scaled by the environment's schema. If the value function sees theta, it follows the
    observations, and the policy ignores it. If policies have memory, a recurrent unit precedes the policy's layers
    (`jaxlfi.rl.recurrent`), and the value function sees the memory.
    """
    memory, size = _memory(environment), environment.observations.size
    orthogonal = lambda gain: functools.partial(jax.nn.initializers.orthogonal, gain)
    made = networks.make_ppo_networks(
        size,
        environment.actions.size - memory,
        policy_hidden_layer_sizes=settings.hidden,
        value_hidden_layer_sizes=settings.hidden,
        activation=linen.tanh,
        distribution_type="normal",
        noise_std_type="log",
        init_noise_std=settings.initial_deviation,
        policy_network_kernel_init_fn=orthogonal(2**0.5),
        value_network_kernel_init_fn=orthogonal(2**0.5),
        mean_kernel_init_fn=orthogonal(0.01),
    )
    if memory:
        made = made.replace(policy_network=recurrent.network(size - memory, memory, made.policy_network))
    if not _privileged(settings):
        return made
    act = made.policy_network
    value = make_value_network(
        size + environment.space.dim,
        hidden_layer_sizes=settings.hidden,
        activation=linen.tanh,
        kernel_init=orthogonal(2**0.5)(),
    )
    seeing = dataclasses.replace(act, apply=lambda scaling, params, seen: act.apply(scaling, params, seen[..., :size]))
    return made.replace(policy_network=seeing, value_network=value)


def init(
    key: jax.Array, environment: Environment, settings: PPO, domain: Domain, layers: Sequence[Any] | None = None
) -> Training:
    """The state before the first update: new networks and the first episodes.

    Args:
        key: consumed.
        environment: environment to train in.
        settings: settings of the training.
        domain: points theta, one per environment, unless they are redrawn.
        layers: weights and bias of each layer of the initial policy; by default they are drawn.
    """
    key_policy, key_value, key_episodes, key_updates = jax.random.split(key, 4)
    networks = policy_networks(environment, settings)
    params = losses.PPONetworkParams(
        policy=networks.policy_network.init(key_policy), value=networks.value_network.init(key_value)
    )
    if layers is not None:
        params = params.replace(policy=_with_layers(params.policy, layers))
    return Training(
        params=params,
        optimiser=_optimiser(settings, jnp.asarray(0)).init(params),
        episodes=_batch(environment, settings).reset(key_episodes, domain),
        key=key_updates,
        updates=jnp.asarray(0),
    )


def update(environment: Environment, settings: PPO, training: Training) -> tuple[Training, Update]:
    """One update: episodes with the current policy, then `epochs` passes over their transitions.

    Args:
        environment: environment to train in.
        settings: settings of the training.
        training: state after the previous updates.

    Returns:
        The next state, and metrics of the update.
    """
    key_epochs, key_episodes, key_next = jax.random.split(training.key, 3)
    networks = policy_networks(environment, settings)
    batch = _batch(environment, settings)
    act = _remembering(environment, _acting(networks, training.params), training.params)

    def unroll(carry, _):
        episodes, key = carry
        key, following = jax.random.split(key)
        episodes, data = acting.generate_unroll(
            batch, episodes, act, key, settings.unroll, extra_fields=("truncation", "ended")
        )
        return (episodes, following), data

    unrolls = settings.minibatches * settings.segments // settings.environments
    (episodes, _), data = jax.lax.scan(unroll, (training.episodes, key_episodes), length=unrolls)
    ended = data.extras["state_extras"].pop("ended")
    # [unrolls, steps, environments, ...] -> [segments, steps, ...]
    data = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 1, 2), data)
    data = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), data)

    loss = functools.partial(
        losses.compute_ppo_loss,
        ppo_network=networks,
        entropy_cost=settings.entropy,
        discounting=settings.discount,
        gae_lambda=settings.gae_lambda,
        clipping_epsilon=settings.clipping,
        vf_coefficient=settings.value_weight,
    )
    optimiser = _optimiser(settings, training.updates)

    def minibatch(carry, data):
        state, params, key = carry
        key, key_loss = jax.random.split(key)
        (_, metrics), gradients = jax.value_and_grad(loss, has_aux=True)(params, None, data, key_loss)
        change, state = optimiser.update(gradients, state)
        return (state, optax.apply_updates(params, change), key), metrics

    def one_epoch(carry, _):
        state, params, key = carry
        key, key_order, key_minibatches = jax.random.split(key, 3)
        order = jax.random.permutation(key_order, settings.minibatches * settings.segments)
        shuffled = jax.tree.map(lambda leaf: leaf[order].reshape(settings.minibatches, -1, *leaf.shape[1:]), data)
        (state, params, _), metrics = jax.lax.scan(minibatch, (state, params, key_minibatches), shuffled)
        return (state, params, key), metrics

    first = training.optimiser, training.params, key_epochs
    (state, params, _), metrics = jax.lax.scan(one_epoch, first, length=settings.epochs)
    after = Training(params, state, episodes, key_next, training.updates + 1)
    return after, _summary(ended, jax.tree.map(jnp.mean, metrics))


def train(
    environment: Environment,
    settings: PPO,
    training: Training,
    updates: int,
    count: Int[Array, ""] | int | None = None,
) -> tuple[Training, Update]:
    """Several updates as one scan.

    Args:
        environment: environment to train in.
        settings: settings of the training.
        training: state after the previous updates.
        updates: number of updates.
        count: number of these updates that are made, so that one program serves any number; by default all.

    Returns:
        The state after them, and the metrics of each, stacked along a leading axis; zeros for those that were not made.
    """
    one = functools.partial(update, environment, settings)
    if count is None:
        return jax.lax.scan(lambda state, _: one(state), training, length=updates)
    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(one, training)[1])
    body = lambda state, index: jax.lax.cond(index < count, one, lambda state: (state, nothing), state)
    return jax.lax.scan(body, training, jnp.arange(updates))


def _optimiser(settings: PPO, made: Int[Array, ""]) -> optax.GradientTransformation:
    """Adam at the learning rate after `made` updates, which decays no further after the last one."""
    rate = settings.learning_rate * (1 - settings.annealing * jnp.minimum(made / settings.updates, 1.0))
    return optax.chain(
        optax.clip_by_global_norm(settings.max_gradient_norm),
        optax.adam(rate, eps=settings.adam_epsilon),
    )


def _batch(environment: Environment, settings: PPO) -> Batch:
    return Batch(environment, settings.environments, settings.redrawn, _privileged(settings))


def _memory(environment: Environment) -> int:
    """Number of values that policies remember."""
    return getattr(environment, "memory", 0)


def _remembering(environment: Environment, act: recurrent.Act, params: losses.PPONetworkParams) -> recurrent.Act:
    """Acting whose actions end with the memory, if policies have one."""
    if not (memory := _memory(environment)):
        return act
    return recurrent.remembering(act, params.policy, environment.observations.size - memory, memory)


def _privileged(settings: PPO) -> bool:
    """Whether the value function sees theta."""
    return settings.critic == "theta"


def _acting(ppo_networks: networks.PPONetworks, params: losses.PPONetworkParams):
    return networks.make_inference_fn(ppo_networks)((None, params.policy, params.value))


def _summary(ended: Ended, metrics: dict[str, Array]) -> Update:
    """Means over the episodes that ended in an update."""
    done = ended.done.astype(jnp.float32)
    number = jnp.sum(done)
    mean = lambda values: jnp.where(number > 0, jnp.sum(done * values) / jnp.maximum(number, 1.0), jnp.nan)
    facts = {name: mean(values.astype(jnp.float32)) for name, values in ended.facts.items()}
    return Update(number.astype(int), mean(ended.value), mean(ended.steps.astype(jnp.float32)), facts, metrics)


def deterministic(environment: Environment, settings: PPO, params: losses.PPONetworkParams):
    """The policy without its noise, from an observation to an action, both in their units."""
    policy = networks.make_inference_fn(policy_networks(environment, settings))(
        (None, params.policy, params.value), deterministic=True
    )
    policy = _remembering(environment, policy, params)

    def act(observation: Float[Array, " obs"]) -> Float[Array, " act"]:
        # The key is not used.
        action, _ = policy(environment.observations.to_unit(observation), jax.random.key(0))
        return environment.actions.from_unit(jnp.clip(action, -1.0, 1.0))

    return act


def as_file(environment: Environment, params: losses.PPONetworkParams, **recorded: Any) -> Policy:
    """The policy as a file that needs neither JAX nor Brax.

    Args:
        environment: environment of its training, whose `deployment`, `preparation` and `robot`, a mapping of robot
            settings (`jaxlfi.robots.settings`), are also written.
        params: parameters of its networks.
        recorded: further entries of its schema.
    """
    layers = params.policy["params"]
    every = jax.device_get([functools.reduce(lambda part, name: part[name], path, layers) for path in _paths(layers)])
    schema = {
        "environment": environment.name,
        "observations": dataclasses.asdict(environment.observations),
        "actions": dataclasses.asdict(environment.actions),
        **recorded,
    }
    for key in (deployment.KEY, preparation.KEY):
        if (declared := getattr(environment, key, None)) is not None:
            schema[key] = dataclasses.asdict(declared)
    if robot := getattr(environment, "robot", None):
        schema["robot"] = dict(robot)
    unit = Unit.of_flax(jax.device_get(params.policy[recurrent.UNIT])) if _memory(environment) else None
    return Policy(tuple(layer["kernel"] for layer in every), tuple(layer["bias"] for layer in every), schema, unit)


def _paths(layers: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Paths to the layers of a policy's network, from the first to the last."""
    return [*(("MLP_0", f"hidden_{index}") for index in range(len(layers["MLP_0"]))), ("Dense_0",)]


def _with_layers(policy: Mapping[str, Any], layers: Sequence[Any]) -> dict[str, Any]:
    """The parameters of a policy's network with other layers; the standard deviation of actions is unchanged."""
    inner = dict(policy["params"])
    inner["MLP_0"] = dict(inner["MLP_0"])
    for (*outer, name), (weight, bias) in zip(_paths(inner), layers, strict=True):
        place = inner[outer[0]] if outer else inner
        place[name] = {"kernel": jnp.asarray(weight, jnp.float32), "bias": jnp.asarray(bias, jnp.float32)}
    return {**policy, "params": inner}
