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


class MixtureHead(struct.PyTreeNode):
    """A mixture as the network puts it out, by the Cholesky factors of its *precisions*.

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
        # Written as a sum of products: a batched matrix product of 4 x 4 matrices is slower by far on CPU.
        whitened = jnp.sum(self.whitening * offset[..., None, :], axis=-1)
        log_det = jnp.sum(jnp.log(jnp.diagonal(self.whitening, axis1=-2, axis2=-1)), axis=-1)
        component = log_det - 0.5 * jnp.sum(whitened**2, axis=-1) - 0.5 * theta.shape[-1] * np.log(2 * np.pi)
        return jax.nn.logsumexp(jax.nn.log_softmax(self.logits) + component, axis=-1)

    def mixture(self) -> GaussianMixture:
        """The same mixture by covariance factors."""
        dim = self.means.shape[-1]
        eye = jnp.broadcast_to(jnp.eye(dim), self.whitening.shape)
        scale_tril = solve_triangular(self.whitening, eye, lower=True)
        return GaussianMixture(self.logits, self.means, jnp.tril(scale_tril))


class Dense(nn.Module):
    """An affine layer whose kernel lies [out, in].

    The gradient of such a kernel is a product that comes out as the kernel lies, also under vmap. That of a kernel
    [in, out] (Flax's own layer) is transposed after the product, entry by entry, once for each of Adam's passes over
    it: on CPU that took three quarters of a step of 3 x 1024 units.

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
    """

    components: int
    dim: int
    hidden: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, x: Float[Array, "*batch obs"]) -> MixtureHead:
        """The mixture for each summary vector."""
        activation = ACTIVATIONS[self.activation]
        for units in self.hidden:
            x = activation(Dense(units)(x))
        components, dim = self.components, self.dim
        below = dim * (dim - 1) // 2
        out = Dense(components * (1 + 2 * dim + below))(x)
        logits, means, log_diagonal, lower = jnp.split(
            out, np.cumsum([components, components * dim, components * dim]), axis=-1
        )
        shape = (*x.shape[:-1], components)
        # The start, a diagonal of e^1, is a standard deviation of 0.37 in [-1, 1]; the least one is e^-7.
        diagonal = jnp.exp(jnp.clip(log_diagonal.reshape(*shape, dim) + 1.0, -7.0, 7.0))
        whitening = lower_triangular(diagonal, lower.reshape(*shape, below))
        return MixtureHead(logits, means.reshape(*shape, dim), whitening)


@jax.custom_vjp
def lower_triangular(diagonal: Float[Array, "*batch dim"], below: Float[Array, "*batch off"]) -> Array:
    """A lower-triangular matrix from its diagonal and its entries below it, row by row.

    Every entry has one place in the matrix, so that gradients are read from there. JAX would add them up one after
    another, zeros too, which takes most of a training step of 32 parameters.
    """
    dim = diagonal.shape[-1]
    index = np.zeros((dim, dim), np.int32)  # into [0, diagonal, below]
    index[np.diag_indices(dim)] = 1 + np.arange(dim)
    index[np.tril_indices(dim, -1)] = 1 + dim + np.arange(below.shape[-1])
    entries = jnp.concatenate([jnp.zeros_like(diagonal[..., :1]), diagonal, below], axis=-1)
    return entries[..., index]


def _entries(_: None, matrix: Float[Array, "*batch dim dim"]) -> tuple[Array, Array]:
    rows, columns = np.tril_indices(matrix.shape[-1], -1)
    return jnp.diagonal(matrix, axis1=-2, axis2=-1), matrix[..., rows, columns]


lower_triangular.defvjp(lambda diagonal, below: (lower_triangular(diagonal, below), None), _entries)
