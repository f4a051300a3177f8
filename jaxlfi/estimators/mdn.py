"""The mixture density neural network q_phi(theta | x) (Bishop 1994), with full covariances."""

from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture

ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"relu": nn.relu, "tanh": nn.tanh, "silu": nn.silu}
"""Activations by name."""
REGRESSION = "regression"
"""Name of the parameters of the means' linear term in x."""
START = 1.0
"""Initial logarithm of the diagonal of U: a standard deviation of 0.37 in [-1, 1]."""
NEAR = 0.1
"""Factor of the last layer's random kernel in a network that starts from a regression."""


class MixtureHead(struct.PyTreeNode):
    """A mixture as output by the network, parametrised by the Cholesky factors of its *precisions*.

    With precision U^T U, the log-density of a component needs a product with U and the logarithms of its diagonal: no
    triangular solve and no factorisation in the training loop. U^{-1} is the Cholesky factor of the covariance.

    Attributes:
        logits: unnormalised log-weights, shape [..., K].
        means: shape [..., K, D].
        whitening: lower-triangular U with positive diagonal, shape [..., K, D, D].
    """

    logits: Float[Array, "*batch comp"]
    means: Float[Array, "*batch comp dim"]
    whitening: Float[Array, "*batch comp dim dim"]

    def log_prob(self, theta: Float[Array, "*batch dim"]) -> Float[Array, "*batch"]:
        """Log-density at theta, one theta for each mixture of the batch."""
        offset = theta[..., None, :] - self.means
        # Written as a sum of products: a batched product of 4 x 4 matrices is far slower on CPU.
        whitened = jnp.sum(self.whitening * offset[..., None, :], axis=-1)
        log_det = jnp.sum(jnp.log(jnp.diagonal(self.whitening, axis1=-2, axis2=-1)), axis=-1)
        component = log_det - 0.5 * jnp.sum(whitened**2, axis=-1) - 0.5 * theta.shape[-1] * np.log(2 * np.pi)
        return jax.nn.logsumexp(jax.nn.log_softmax(self.logits) + component, axis=-1)

    def mixture(self) -> GaussianMixture:
        """The same mixture with Cholesky factors of covariances."""
        dim = self.means.shape[-1]
        eye = jnp.broadcast_to(jnp.eye(dim), self.whitening.shape)
        scale_tril = solve_triangular(self.whitening, eye, lower=True)
        return GaussianMixture(self.logits, self.means, jnp.tril(scale_tril))


class Dense(nn.Module):
    """An affine layer whose kernel has the layout [out, in].

    The gradient of such a kernel is a product in the same layout, also under vmap. That of a kernel [in, out] (Flax's
    own layer) is transposed after the product, entry by entry, once for each of Adam's passes over it: on CPU this took
    three quarters of a step of 3 x 1024 units.

    Attributes:
        units: length of the output.
    """

    units: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch in"]) -> Float[Array, "*batch out"]:
        """The product of x and the transposed kernel, plus the bias."""
        initial = nn.initializers.lecun_normal(in_axis=-1, out_axis=-2)
        kernel = self.param("kernel", initial, (self.units, x.shape[-1]))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.units,))
        return jax.lax.dot_general(x, kernel, (((x.ndim - 1,), (1,)), ((), ()))) + bias


class MDN(nn.Module):
    """A multilayer perceptron from normalised summaries to a mixture over theta scaled to [-1, 1]^D.

    Attributes:
        components: K.
        dim: D.
        hidden: units of each hidden layer.
        activation: name in `ACTIVATIONS`.
        linear: whether the means have a term that is linear in x, the same for all components. Its parameters are
            `REGRESSION`, which `around` initialises.
    """

    components: int
    dim: int
    hidden: tuple[int, ...]
    activation: str
    linear: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "*batch obs"]) -> MixtureHead:
        """The mixture for each summary vector."""
        activation, components, dim = ACTIVATIONS[self.activation], self.components, self.dim
        shift = jnp.zeros(dim)
        if self.linear:
            shift = x @ self.param(REGRESSION, nn.initializers.zeros_init(), (dim, x.shape[-1])).T
        for units in self.hidden:
            x = activation(Dense(units)(x))
        below = dim * (dim - 1) // 2
        out = Dense(components * (1 + 2 * dim + below))(x)
        logits, means, log_diagonal, lower = jnp.split(
            out, np.cumsum([components, components * dim, components * dim]), axis=-1
        )
        shape = (*x.shape[:-1], components)
        # The least standard deviation in [-1, 1] is e^-7.
        diagonal = jnp.exp(jnp.clip(log_diagonal.reshape(*shape, dim) + START, -7.0, 7.0))
        whitening = lower_triangular(diagonal, lower.reshape(*shape, below))
        return MixtureHead(logits, means.reshape(*shape, dim) + shift[..., None, :], whitening)


def around(
    params: dict,
    components: int,
    coefficients: Float[Array, "dim obs"],
    intercept: Float[Array, " dim"],
    whitening: Float[Array, "dim dim"],
) -> dict:
    """Fresh parameters of an `MDN` with a linear term, changed so that it starts near one Gaussian around a regression.

    Its components differ by a tenth of their usual differences; without any, all would learn the same.

    Args:
        params: the network's fresh weights, by layer.
        components: K.
        coefficients: W of the Gaussian's mean, W x + b.
        intercept: b.
        whitening: lower-triangular U of its precision U^T U.
    """
    dim = len(intercept)
    log_diagonal, below = jnp.log(jnp.diagonal(whitening)) - START, whitening[np.tril_indices(dim, -1)]
    each = [jnp.zeros(1), intercept, log_diagonal, below]
    output = f"Dense_{sum(name.startswith('Dense_') for name in params) - 1}"
    changed = {
        "kernel": NEAR * params[output]["kernel"],
        "bias": jnp.concatenate([jnp.tile(part, components) for part in each]),
    }
    return params | {output: changed, REGRESSION: coefficients}


@jax.custom_vjp
def lower_triangular(diagonal: Float[Array, "*batch dim"], below: Float[Array, "*batch off"]) -> Array:
    """A lower-triangular matrix from its diagonal and the entries below it, row by row.

    Every entry has one place in the matrix, from which its gradient is read. JAX would add up gradients one after
    another, including zeros, which takes most of a training step with 32 parameters. A row is a slice of the entries
    whose excess is masked: looking up places one by one would take most of a step with 64.
    """
    dim = diagonal.shape[-1]
    starts = np.arange(dim) * (np.arange(dim) - 1) // 2
    padded = jnp.pad(below, [(0, 0)] * (below.ndim - 1) + [(0, dim)])
    rows = jnp.stack([padded[..., start : start + dim] for start in starts.tolist()], axis=-2)
    matrix = jnp.where(np.tril(np.ones((dim, dim), bool), -1), rows, 0.0)
    return jnp.where(np.eye(dim, dtype=bool), diagonal[..., None], matrix)


def _entries(_: None, matrix: Float[Array, "*batch dim dim"]) -> tuple[Array, Array]:
    rows, columns = np.tril_indices(matrix.shape[-1], -1)
    return jnp.diagonal(matrix, axis1=-2, axis2=-1), matrix[..., rows, columns]


lower_triangular.defvjp(lambda diagonal, below: (lower_triangular(diagonal, below), None), _entries)
