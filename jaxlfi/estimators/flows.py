"""Conditional normalising flows q(theta | x): masked autoregressive and neural spline."""

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.linalg import solve_triangular
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from jaxlfi.estimators.mdn import ACTIVATIONS, REGRESSION, Dense

PRECISION = "precision"
"""Name of the parameters of a spline flow's linear map, a factor of the precision that the splines see as identity."""

SPREAD = "spread"
"""Name of the parameters of the term of a spline flow's log-scale that is linear in x."""

LOG_SCALE_BOUND = 3.0
"""Maximum log-scale of one affine transform, in nats. Ten of them map 1e3 to 1e16, whose square float32 can hold."""

MIN_BIN = 1e-3
"""Minimum width of a spline's bin, as a fraction of its range."""

MIN_SLOPE = 1e-3
"""Minimum slope of a spline at a knot."""

_UNIT_SLOPE = float(np.log(np.expm1(1 - MIN_SLOPE)))
"""Raw value of a slope for which softplus and the minimum slope add up to 1."""


class Conditioner(struct.PyTreeNode):
    """A small multilayer perceptron of theta, with the context already in its first layer and its masks applied.

    Attributes:
        context: contribution of x to the first layer, its bias included, shape [..., H].
        kernels: [out, in] kernels of the first layer, the hidden ones and the last.
        biases: biases of all layers but the first.
        activation: name in `ACTIVATIONS`.
    """

    context: Float[Array, "*batch hidden"]
    kernels: tuple[Array, ...]
    biases: tuple[Array, ...]
    activation: str = struct.field(pytree_node=False)

    def hidden(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n hidden"]:
        """The activations before the last layer; axes of theta before those of the context broadcast."""
        activation = ACTIVATIONS[self.activation]
        h = activation(_product(theta, self.kernels[0]) + self.context)
        for kernel, bias in zip(self.kernels[1:-1], self.biases[:-1], strict=True):
            h = activation(_product(h, kernel) + bias)
        return h

    def __call__(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n out"]:
        """The last layer's outputs."""
        return _product(self.hidden(theta), self.kernels[-1]) + self.biases[-1]

    def outputs_first(self, theta: Float[Array, "*n dim"]) -> Float[Array, " out *n"]:
        """The last layer's outputs along the first axis, by a product in the other order, without a transposition."""
        out = jnp.tensordot(self.kernels[-1], self.hidden(theta), axes=((1,), (-1,)))
        return out + self.biases[-1].reshape(-1, *[1] * (out.ndim - 1))


class Affine(struct.PyTreeNode):
    """Shift and scale by x alone: u = (theta - shift) exp(-log_scale).

    Attributes:
        shift: shape [..., D].
        log_scale: within `LOG_SCALE_BOUND` of 0, shape [..., D].
    """

    shift: Float[Array, "*batch dim"]
    log_scale: Float[Array, "*batch dim"]

    def forward(self, theta: Float[Array, "*n dim"]) -> tuple[Float[Array, "*n dim"], Float[Array, "*n"]]:
        """From theta towards the normal base, and the log-determinant of the Jacobian."""
        log_scale = jnp.broadcast_to(self.log_scale, theta.shape)
        return (theta - self.shift) * jnp.exp(-log_scale), -jnp.sum(log_scale, axis=-1)

    def inverse(self, u: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """From the base to theta."""
        return u * jnp.exp(self.log_scale) + self.shift


class Triangular(struct.PyTreeNode):
    """A linear map by a lower-triangular matrix with a positive diagonal, the same for all x.

    Attributes:
        raw: the matrix with the logarithms of its diagonal, shape [D, D]; entries above the diagonal are ignored.
    """

    raw: Float[Array, "dim dim"]

    @property
    def _matrix(self) -> Array:
        return jnp.tril(self.raw, -1) + jnp.diag(jnp.exp(jnp.diagonal(self.raw)))

    def forward(self, theta: Float[Array, "*n dim"]) -> tuple[Float[Array, "*n dim"], Float[Array, "*n"]]:
        """From theta towards the normal base, and the log-determinant of the Jacobian."""
        return theta @ self._matrix.T, jnp.broadcast_to(jnp.trace(self.raw), theta.shape[:-1])

    def inverse(self, u: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """From the base to theta."""
        flat = solve_triangular(self._matrix, u.reshape(-1, u.shape[-1]).T, lower=True)
        return flat.T.reshape(u.shape)


class Autoregressive(struct.PyTreeNode):
    """Shift and scale of each dimension by x and the dimensions before it (Papamakarios et al. 2017).

    Attributes:
        conditioner: 2 D outputs, shifts and then log-scales; those of a dimension depend only on dimensions before it.
    """

    conditioner: Conditioner

    def _affine(self, theta) -> Affine:
        shift, raw = jnp.split(self.conditioner(theta), 2, axis=-1)
        return Affine(shift, _bounded(raw))

    def forward(self, theta: Float[Array, "*n dim"]) -> tuple[Float[Array, "*n dim"], Float[Array, "*n"]]:
        """From theta towards the normal base, and the log-determinant of the Jacobian; one pass."""
        return self._affine(theta).forward(theta)

    def inverse(self, u: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """From the base to theta, in D passes: after each, one more dimension in the order is right."""
        theta = jnp.zeros_like(u)
        for _ in range(u.shape[-1]):
            theta = self._affine(theta).inverse(u)
        return theta


class SplineCoupling(struct.PyTreeNode):
    """Monotonic splines of some dimensions, conditioned on x and the others, which stay (Durkan et al. 2019).

    The splines are rational-quadratic inside [-tail, tail] and the identity outside.

    Attributes:
        conditioner: 3 K - 1 outputs for each changed dimension; they depend only on the dimensions that stay.
        changed: for each dimension, whether it is transformed.
        tail: half the splines' range.
    """

    conditioner: Conditioner
    changed: tuple[bool, ...] = struct.field(pytree_node=False)
    tail: float = struct.field(pytree_node=False)

    def _moved(self, theta, inverse):
        # Column by column: the gradient of a gather is a scatter, which is slow on CPU.
        columns = jnp.stack([theta[..., d] for d, moves in enumerate(self.changed) if moves])
        # Clipped to the splines' range: an outlier must not bend the splines of the others without limit.
        raw = self.conditioner.outputs_first(jnp.clip(theta, -self.tail, self.tail))
        moved, log_slope = spline(columns, raw.reshape(len(columns), -1, *raw.shape[1:]), self.tail, inverse)
        rows = iter(moved)
        both = [next(rows) if moves else theta[..., d] for d, moves in enumerate(self.changed)]
        return jnp.stack(both, axis=-1), jnp.sum(log_slope, axis=0)

    def forward(self, theta: Float[Array, "*n dim"]) -> tuple[Float[Array, "*n dim"], Float[Array, "*n"]]:
        """From theta towards the normal base, and the log-determinant of the Jacobian."""
        return self._moved(theta, inverse=False)

    def inverse(self, u: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """From the base to theta; one pass, as the conditioner sees only the dimensions that stay."""
        return self._moved(u, inverse=True)[0]


class Flow(struct.PyTreeNode):
    """q(theta | x) for one x or a batch of them, the output of a flow network.

    Attributes:
        transforms: invertible maps, in the order from theta to the standard normal base.
        dim: D.
        batch: shape of the batch of x.
    """

    transforms: tuple[Affine | Triangular | Autoregressive | SplineCoupling, ...]
    dim: int = struct.field(pytree_node=False)
    batch: tuple[int, ...] = struct.field(pytree_node=False)

    def forward(self, theta: Float[Array, "*n dim"]) -> tuple[Float[Array, "*n dim"], Float[Array, "*n"]]:
        """From theta to the base, and the log-determinant of the Jacobian."""
        total = jnp.zeros(theta.shape[:-1], theta.dtype)
        for transform in self.transforms:
            theta, log_det = transform.forward(theta)
            total = total + log_det
        return theta, total

    def inverse(self, u: Float[Array, "*n dim"]) -> Float[Array, "*n dim"]:
        """From the base to theta."""
        for transform in reversed(self.transforms):
            u = transform.inverse(u)
        return u

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density at theta: one theta for each x, or several with further axes in front."""
        u, log_det = self.forward(theta)
        return jnp.sum(norm.logpdf(u), axis=-1) + log_det

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n *batch dim"]:
        """`n` independent draws for each x."""
        return self.inverse(jax.random.normal(key, (n, *self.batch, self.dim)))


class MAF(nn.Module):
    """A masked autoregressive flow (Papamakarios, Pavlakou and Murray 2017) over scaled theta, given normalised x.

    The order of the dimensions is reversed from each transform to the next. It starts as a standard normal for all x.
    A density takes one pass, a draw D passes.

    Departs from the paper in two ways: every conditioner has units that see x alone, so that the first dimension in its
    order depends on x, too; and log-scales are softly bounded.

    Attributes:
        dim: D.
        transforms: number of affine autoregressive transforms.
        hidden: units of each hidden layer.
        blocks: number of hidden layers after the first.
        activation: name in `ACTIVATIONS`.

    Raises:
        ValueError: when called, for settings that make no network.
    """

    dim: int
    transforms: int = 5
    hidden: int = 50
    blocks: int = 2
    activation: str = "tanh"

    @nn.compact
    def __call__(self, x: Float[Array, "*batch obs"]) -> Flow:
        """The flow for each summary vector."""
        _check(self)
        transforms = []
        for t in range(self.transforms):
            order = np.arange(self.dim) if t % 2 == 0 else np.arange(self.dim)[::-1]
            # A hidden unit of degree g sees the first g dimensions in the order; a dimension's outputs see hidden
            # units up to the number of dimensions before it. Degree 0 sees the context alone.
            degree = np.arange(self.hidden) % self.dim
            first = order[None, :] < degree[:, None]
            within = degree[None, :] <= degree[:, None]
            last = np.tile(degree[None, :] <= order[:, None], (2, 1))
            masks = (first, *[within] * self.blocks, last)
            transforms.append(Autoregressive(_conditioner(self, f"transform_{t}", x, masks)))
        return Flow(tuple(transforms), self.dim, x.shape[:-1])


class NSF(nn.Module):
    """A neural spline flow of coupling transforms (Durkan et al. 2019) over scaled theta, given normalised x.

    It starts as a standard normal for all x. Densities and draws take one pass each. With D = 1 there is nothing to
    couple to, and every transform is a spline conditioned on x alone.

    Departs from the paper in how dimensions are mixed. Instead of learnt linear maps between splines, the transforms
    divide the dimensions by the binary digits of their numbers, each digit once either way, so that any two dimensions
    are on different sides in some transform. One shift and scale by x and one linear map come first, and bring a narrow
    density to the size of the splines' range. The shift and the log-scale have terms that are linear in x. With these
    and the map (`REGRESSION`, `SPREAD` and `PRECISION` among its parameters) a network can start as the Gaussian around
    a linear regression.

    Attributes:
        dim: D.
        transforms: number of spline couplings.
        hidden: units of each hidden layer.
        blocks: number of hidden layers after the first.
        activation: name in `ACTIVATIONS`.
        bins: number K of pieces of each spline.
        tail: half the splines' range; beyond, they are the identity.

    Raises:
        ValueError: when called, for settings that make no network.
    """

    dim: int
    transforms: int = 5
    hidden: int = 50
    blocks: int = 2
    activation: str = "relu"
    bins: int = 10
    tail: float = 5.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch obs"]) -> Flow:
        """The flow for each summary vector."""
        _check(self)
        precision = self.param(PRECISION, nn.initializers.zeros_init(), (self.dim, self.dim))
        transforms: list[Affine | Triangular | SplineCoupling] = [_affine(self, "affine", x), Triangular(precision)]
        for t in range(self.transforms):
            changed = coupling(self.dim, t)
            first = np.broadcast_to(~changed, (self.hidden, self.dim))
            within = np.ones((self.hidden, self.hidden), bool)
            last = np.ones((int(changed.sum()) * (3 * self.bins - 1), self.hidden), bool)
            conditioner = _conditioner(self, f"transform_{t}", x, (first, *[within] * self.blocks, last))
            transforms.append(SplineCoupling(conditioner, tuple(changed.tolist()), self.tail))
        return Flow(tuple(transforms), self.dim, x.shape[:-1])


def coupling(dim: int, transform: int) -> np.ndarray:
    """Which dimensions a coupling transform changes, boolean [D]: those whose number has 1, or 0, in a binary digit.

    The digit advances with every second transform, and 0 and 1 alternate. 2 ceil(log2 D) transforms change each
    dimension given every other one.
    """
    if dim == 1:
        return np.ones(1, bool)
    digit = (transform // 2) % (dim - 1).bit_length()
    return (np.arange(dim) >> digit) % 2 == transform % 2


def spline(
    x: Float[Array, "*n"], raw: Float[Array, "first knobs *rest"], tail: float, inverse: bool = False
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Monotonic rational-quadratic splines of [-tail, tail] onto itself, the identity outside (Durkan et al. 2019).

    Equivalent to `distrax.RationalQuadraticSpline` with boundary slopes "identity", but with the pieces along the
    second axis, in front of the batch. The innermost loop then runs over the batch and not over ten pieces, and slopes
    are computed only for the chosen piece. Training is seven times faster on CPU, where distrax's spline took two
    thirds of a step.

    Args:
        x: one number for each spline, shape [C, ...].
        raw: K widths and K heights by softmax, then K - 1 slopes between them by softplus, shape [C, 3 K - 1, ...];
            zeros give the identity.
        tail: half the range.
        inverse: whether to map the spline's values to its arguments instead.

    Returns:
        Values and logarithms of the slope, both shaped as x.
    """
    bins = (raw.shape[1] + 1) // 3
    least = 2 * tail * MIN_BIN
    raw_widths, raw_heights, raw_slopes = raw[:, :bins], raw[:, bins : 2 * bins], raw[:, 2 * bins :]
    widths = least + (2 * tail - bins * least) * jax.nn.softmax(raw_widths, axis=1)
    heights = least + (2 * tail - bins * least) * jax.nn.softmax(raw_heights, axis=1)

    # Choosing the piece has no gradient. Its corner is a sum over the chosen entries, which alone have gradients;
    # there are no gathers.
    sizes = jax.lax.stop_gradient(heights if inverse else widths)
    knots = jnp.moveaxis(jnp.tensordot(np.tri(bins - 1, bins, dtype=np.float32), sizes, axes=((1,), (1,))), 0, 1) - tail
    beyond = x[:, None] >= knots
    always = jnp.ones_like(x[:, None], bool)
    complete = jnp.concatenate([beyond, ~always], axis=1)
    chosen = jnp.concatenate([always, beyond], axis=1) & ~complete
    pick = lambda where, values: jnp.sum(jnp.where(where, values, 0.0), axis=1)
    width, height = pick(chosen, widths), pick(chosen, heights)
    left, bottom = pick(complete, widths) - tail, pick(complete, heights) - tail
    # End knots have no raw slope: nothing is picked, and zero means a slope of 1.
    slope_left = jax.nn.softplus(pick(chosen[:, 1:], raw_slopes) + _UNIT_SLOPE) + MIN_SLOPE
    slope_right = jax.nn.softplus(pick(chosen[:, :-1], raw_slopes) + _UNIT_SLOPE) + MIN_SLOPE

    mean_slope = height / width
    bend = slope_left + slope_right - 2 * mean_slope
    # Clipped because x may also lie outside the range, where the result is not used but has a gradient.
    if inverse:
        risen = jnp.clip((x - bottom) / height, 0.0, 1.0)
        linear = slope_left - bend * risen
        quadratic = mean_slope - linear
        root = jnp.sqrt(jnp.maximum(linear**2 + 4 * quadratic * mean_slope * risen, jnp.finfo(x.dtype).tiny))
        # Of the two forms of the root, the one that does not subtract nearly equal numbers.
        positive = linear >= 0
        along = jnp.where(positive, 2 * mean_slope * risen, root - linear)
        along = jnp.clip(along / jnp.where(positive, linear + root, 2 * quadratic), 0.0, 1.0)
        value = left + width * along
    else:
        along = jnp.clip((x - left) / width, 0.0, 1.0)
    between = along * (1 - along)
    denominator = mean_slope + bend * between
    if not inverse:
        value = bottom + height * (mean_slope * along**2 + slope_left * between) / denominator
    rise = slope_right * along**2 + 2 * mean_slope * between + slope_left * (1 - along) ** 2
    log_slope = 2 * jnp.log(mean_slope) + jnp.log(rise) - 2 * jnp.log(denominator)
    inside = jnp.abs(x) < tail
    log_slope = jnp.where(inside, log_slope, 0.0)
    return jnp.where(inside, value, x), -log_slope if inverse else log_slope


def _conditioner(module: nn.Module, name: str, x: Array, masks: Sequence[np.ndarray]) -> Conditioner:
    """A conditioner with masked kernels; its last layer is initialised with zeros, so that it starts at zero."""
    context = Dense(module.hidden, name=f"{name}_context")(x)
    initial = nn.initializers.lecun_normal(in_axis=-1, out_axis=-2)
    zeros = nn.initializers.zeros_init()
    kernels, biases = [], []
    for layer, mask in enumerate(masks):
        start = zeros if layer == len(masks) - 1 else initial
        # Masked entries are parameters without effect: a product with a mask is cheaper than scattering the others.
        kernels.append(module.param(f"{name}_kernel_{layer}", start, mask.shape) * mask)
        if layer:
            biases.append(module.param(f"{name}_bias_{layer}", zeros, mask.shape[:1]))
    return Conditioner(context, tuple(kernels), tuple(biases), module.activation)


def _affine(module: nn.Module, name: str, x: Array) -> Affine:
    """Shift and scale by x alone, from one hidden layer and linear terms; initialised to the identity."""
    zeros = nn.initializers.zeros_init()
    h = ACTIVATIONS[module.activation](Dense(module.hidden, name=f"{name}_context")(x))
    kernel = module.param(f"{name}_kernel", zeros, (2 * module.dim, module.hidden))
    shift, raw = jnp.split(_product(h, kernel) + module.param(f"{name}_bias", zeros, (2 * module.dim,)), 2, axis=-1)
    linear = lambda terms: _product(x, terms[:, :-1]) + terms[:, -1]
    by_x = {name: linear(module.param(name, zeros, (module.dim, x.shape[-1] + 1))) for name in (REGRESSION, SPREAD)}
    return Affine(shift + by_x[REGRESSION], _bounded(raw + by_x[SPREAD]))


def _bounded(raw: Array) -> Array:
    """Raw numbers as log-scales: unchanged near zero, and softly bounded."""
    return LOG_SCALE_BOUND * jnp.tanh(raw / LOG_SCALE_BOUND)


def _product(x: Array, kernel: Array) -> Array:
    """Multiply x by the transposed kernel, whose layout is [out, in] (`jaxlfi.estimators.mdn.Dense`)."""
    return jax.lax.dot_general(x, kernel, (((x.ndim - 1,), (1,)), ((), ())))


def _check(module: nn.Module) -> None:
    """Refuse settings that make no network, by name."""
    for field in ("dim", "transforms"):
        if getattr(module, field) < 1:
            raise ValueError(f"{field}: expected at least 1, got {getattr(module, field)}")
    if module.hidden < module.dim:
        raise ValueError(f"hidden: expected at least as many as the {module.dim} parameters, got {module.hidden}")
    if module.blocks < 0:
        raise ValueError(f"blocks: expected 0 or more, got {module.blocks}")
    if module.activation not in ACTIVATIONS:
        raise ValueError(f"activation: expected one of {sorted(ACTIVATIONS)}, got {module.activation!r}")
    if isinstance(module, NSF):
        if not 1 <= module.bins < 1 / MIN_BIN:
            raise ValueError(f"bins: expected 1 to {round(1 / MIN_BIN) - 1}, got {module.bins}")
        if not module.tail > 0:
            raise ValueError(f"tail: expected a number above 0, got {module.tail}")
