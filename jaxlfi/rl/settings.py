"""Settings of PPO, and presets."""

from jaxtyping import Array, Float

from jaxlfi.fields import Checked, hyperparameter, option

Number = Float[Array, "*batch"] | float


class PPO(Checked):
    """Settings of a training.

    An update uses `minibatches` times `segments` trajectory segments, each of `unroll` steps of one environment.
    Minibatches consist of whole segments, as in Brax; other implementations shuffle single transitions.

    Raises:
        ValueError: for values out of range, and segments that cannot be divided among the environments.
    """

    learning_rate: Number = hyperparameter(default=3e-4, help="learning rate of Adam", low=0)
    annealing: Number = hyperparameter(
        default=0.0,
        help="fraction by which the learning rate decays, linearly, until the last update",
        low=0,
        high=1,
    )
    discount: Number = hyperparameter(default=0.99, help="discount factor", symbol="gamma", low=0, high=1)
    gae_lambda: Number = hyperparameter(
        default=0.95, help="decay of the generalised advantage estimate", symbol="lambda", low=0, high=1
    )
    entropy: Number = hyperparameter(
        default=0.0, help="entropy bonus: weight of the policy's entropy in the loss", low=0
    )
    clipping: Number = hyperparameter(
        default=0.2, help="PPO clipping range of the probability ratio", symbol="epsilon", above=0
    )
    value_weight: Number = hyperparameter(default=0.5, help="weight of the value function's loss", low=0)
    max_gradient_norm: Number = hyperparameter(
        default=0.5, help="largest norm of a gradient, to which longer ones are clipped", above=0
    )
    adam_epsilon: Number = hyperparameter(default=1e-5, help="epsilon of Adam", above=0)
    initial_deviation: Number = hyperparameter(
        default=1.0, help="initial standard deviation of the actions, as a fraction of their limit", above=0
    )
    environments: int = option(
        default=12, help="number of environments stepped in parallel, each with its own theta", low=1
    )
    unroll: int = option(default=16, help="steps per trajectory segment", low=1)
    segments: int = option(default=1, help="trajectory segments per minibatch", low=1)
    minibatches: int = option(default=1536, help="minibatches per update", low=1)
    epochs: int = option(default=10, help="epochs per update", low=1)
    total_steps: int = option(default=60_000, help="total environment steps, rounded up to whole updates", low=1)
    hidden: tuple[int, ...] = option(default=(64, 64), help="widths of the hidden layers of both networks", low=1)
    critic: str = option(
        default="observations",
        choices=("observations", "theta"),
        help="input of the value function: the observations, or theta as well; the policy never sees theta",
    )
    redrawn: bool = option(
        default=False,
        help="draw a new theta for every episode (in the paper each environment keeps its own)",
    )

    def __post_init__(self):
        super().__post_init__()
        if self.minibatches * self.segments % self.environments:
            raise ValueError(
                f"minibatches: expected minibatches x segments to be a multiple of the {self.environments} "
                f"environments, got {self.minibatches} x {self.segments}"
            )

    @property
    def steps_per_update(self) -> int:
        """Number of environment steps per update."""
        return self.minibatches * self.segments * self.unroll

    @property
    def updates(self) -> int:
        """Number of updates in a training."""
        return -(-self.total_steps // self.steps_per_update)


PAPER = PPO()
"""Section VI-H: 12 environments, 60,000 steps, minibatches of 16 transitions, otherwise PPO's defaults.

These are the defaults of Stable-Baselines3: 2,048 steps of each environment per update, which are 1,536 segments of 16,
and hence three updates (73,728 steps). Its minibatches are 16 shuffled transitions; here they are the 16 of one
segment.
"""

QUICK = PPO(learning_rate=5e-4, entropy=0.01, minibatches=12)
"""One update per 192 steps: an episode of each environment. Chosen by `experiments.policy_settings`."""

PRESETS: dict[str, PPO] = {"quick": QUICK, "paper": PAPER}
"""Presets by name."""
