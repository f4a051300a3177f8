"""The segmenting network: its shapes, its loss, and its export."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.whip.vision import export, photograph, segmenter, weights
from jaxlfi.envs.whip.vision.segmenter import Batches, Segmenter
from jaxlfi.envs.whip.vision.weights import Weights, WeightsError

SMALL = Segmenter(widths=(8, 12, 16))
SHARP = photograph.Shot(
    defocus=jnp.asarray(0.0),
    motion=jnp.zeros(2),
    gain=jnp.ones(3),
    gamma=jnp.asarray(1.0),
    offset=jnp.asarray(0.0),
    noise=jnp.zeros(2),
    stuck=jnp.asarray(0.0),
)


@pytest.fixture(scope="module")
def small() -> Weights:
    params = jax.jit(lambda: weights.initial(SMALL, jax.random.key(1)))()
    return Weights(SMALL, params, {"seed": 1})


def test_every_pixel_has_logits_of_eight_labels(small):
    logits = jax.jit(SMALL.apply)(small.params, jnp.zeros((2, 64, 96, 3)))
    assert logits.shape == (2, 64, 96, 8)


def test_blocks_of_pixels_are_put_back_where_they_were():
    x = jnp.arange(2 * 8 * 12 * 3.0).reshape(2, 8, 12, 3)
    blocks = segmenter.blocks(x, 4)
    np.testing.assert_array_equal(blocks[1, 0, 2].reshape(4, 4, 3), x[1, :4, 8:12])
    np.testing.assert_array_equal(segmenter.pixels(blocks, 4), x)


def test_it_has_less_than_a_million_weights():
    params = jax.eval_shape(lambda: weights.initial(Segmenter(), jax.random.key(0)))
    assert 1e5 < sum(leaf.size for leaf in jax.tree.leaves(params)) < 1e6


@dataclasses.dataclass(frozen=True)
class Reads:
    """A network that reads the labels off the red channel: logit 9 for the right one."""

    wrong: int = 0

    def apply(self, params, rgb):
        """Logits."""
        return 9.0 * jax.nn.one_hot((jnp.round(rgb[..., 0] * 255 / 30).astype(int) + self.wrong) % 8, 8)


@pytest.mark.slow
def test_parts_of_pictures_and_of_labels_are_the_same_parts(monkeypatch):
    monkeypatch.setattr(photograph, "draw", lambda key: SHARP)
    draw = np.random.default_rng(0)
    labels = draw.integers(0, 8, (3, 64, 64)).astype(np.uint8)
    data = Batches(jnp.asarray(np.repeat(30 * labels[..., None], 3, axis=-1)), jnp.asarray(labels))
    loss = lambda network: segmenter.loss(None, jax.random.key(5), data, module=network, batch=4, crop=32)
    right, wrong = loss(Reads()), loss(Reads(1))
    certain = optax.softmax_cross_entropy_with_integer_labels(9.0 * jax.nn.one_hot(jnp.array([2]), 8), jnp.array([2]))
    assert float(right) == pytest.approx(float(certain[0]), rel=1e-2)
    assert float(wrong) == pytest.approx(float(certain[0]) + 9, rel=1e-4)


@pytest.mark.slow
def test_it_learns_to_tell_two_colours_apart(small, monkeypatch):
    """Left of a line that differs from picture to picture all is red, and labelled 1; right of it blue, and 7."""
    monkeypatch.setattr(photograph, "draw", lambda key: SHARP)
    place = np.array([20, 33, 47, 52])[:, None, None]
    left = np.broadcast_to(np.arange(64) < place, (4, 64, 64))
    rgb = np.where(left[..., None], [200, 30, 30], [30, 60, 220]).astype(np.uint8)
    data = Batches(jnp.asarray(rgb), jnp.asarray(np.where(left, 1, 7).astype(np.uint8)))
    step = jax.jit(jax.value_and_grad(lambda p, key: segmenter.loss(p, key, data, module=SMALL, batch=4, crop=32)))
    params, adam = small.params, optax.adam(5e-3)
    state = adam.init(params)
    for i in range(80):
        _, gradient = step(params, jax.random.key(i))
        updates, state = adam.update(gradient, state)
        params = optax.apply_updates(params, updates)
    found = np.asarray(segmenter.segment(SMALL, params, rgb[0]))
    assert np.mean(found == np.where(left[0], 1, 7)) > 0.85


# --------------------------------------------------------------------------------------------------------- files


def test_weights_come_back(small, tmp_path):
    weights.save(tmp_path / "w.npz", small)
    again = weights.load(tmp_path / "w.npz", "segmenter")
    assert again.module == SMALL and again.about == {"seed": 1}
    jax.tree.map(np.testing.assert_array_equal, again.params, small.params)


def changed(path, name, value):
    """The file with one array changed; None leaves it out."""
    arrays = dict(np.load(path))
    arrays.pop(name) if value is None else arrays.update({name: value})
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.unlink(), "missing or damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-200]), "missing or damaged"),
        (lambda path: changed(path, "header", np.asarray("{")), "missing or damaged"),
        (lambda path: changed(path, "header", None), "missing or damaged"),
        (lambda path: changed(path, "['params']['Conv_0']['bias']", None), "fit their network"),
        (lambda path: changed(path, "['params']['Conv_0']['bias']", np.zeros(5, np.float32)), "fit their network"),
        (lambda path: changed(path, "['params']['Conv_0']['bias']", np.full(8, np.nan, np.float32)), "finite"),
        (lambda path: reheaded(path, version=2), "version 2"),
        (lambda path: reheaded(path, kind="transporter"), "of a transporter"),
        (lambda path: reheaded(path, module={"widths": [8, 12, 16], "depth": 3}), "fit their network"),
    ],
)
def test_weights_that_cannot_be_used_are_refused(small, tmp_path, change, message):
    path = tmp_path / "w.npz"
    weights.save(path, small)
    change(path)
    with pytest.raises(WeightsError, match=message) as error:
        weights.load(path, "segmenter")
    assert "\n" not in str(error.value)


def reheaded(path, **change):
    header = json.loads(str(np.load(path)["header"]))
    changed(path, "header", np.asarray(json.dumps({**header, **change})))


# -------------------------------------------------------------------------------------------------------- exports


def test_onnx_says_the_same(small):
    reference = pytest.importorskip("onnx.reference")
    picture = np.random.default_rng(2).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    graph = export.graph(small, size=64)
    (labels,) = reference.ReferenceEvaluator(graph).run(None, {"picture": picture})
    expected = np.asarray(segmenter.segment(SMALL, small.params, picture))
    assert labels.shape == (64, 64) and len(np.unique(expected)) > 2
    assert np.mean(labels == expected) > 0.999  # two logits may be equal to rounding
    assert json.loads(graph.metadata_props[0].value)["labels"][7] == "dlo"


def test_stablehlo_says_the_same(small, tmp_path):
    pytest.importorskip("flatbuffers")
    picture = np.random.default_rng(2).integers(0, 256, (256, 256, 3)).astype(np.uint8)
    export.save_stablehlo(small, tmp_path / "program.npz")
    arrays = dict(np.load(tmp_path / "program.npz"))
    program = jax.export.deserialize(bytearray(arrays["program"].tobytes()))
    assert program.platforms == ("cpu", "cuda", "tpu") and json.loads(str(arrays["schema"]))["version"] == 1
    labels = np.asarray(program.call(picture))
    assert np.mean(labels == np.asarray(segmenter.segment(SMALL, small.params, picture))) > 0.999
