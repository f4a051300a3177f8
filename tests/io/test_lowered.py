"""Lowered programs on disk: the next process finds those of jaxlfi, and no others are cached."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxlfi
from jaxlfi.bayessim import programs, staged
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators import posterior, training
from jaxlfi.estimators.mdn import ACTIVATIONS
from jaxlfi.estimators.posterior import truncated
from jaxlfi.estimators.stacking import stacked
from jaxlfi.heuristics import Edge
from jaxlfi.io import compile_cache, executables, lowered
from jaxlfi.io.identity import NotKept, constant, environment, written
from tests.small import SETTINGS

STAGES = {"propose_one", "gather_one", "train_one", "conclude_one"}


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """The folder in which lowered programs are cached; it is empty, but what other tests have compiled is there."""
    before = jax.config.jax_compilation_cache_dir
    for path in Path(before).glob("jit_*"):
        (tmp_path / path.name).symlink_to(path)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    monkeypatch.delenv(compile_cache.SWITCH, raising=False)
    lowered._say_once.cache_clear()
    forget()
    yield tmp_path / "lowered"
    jax.config.update("jax_compilation_cache_dir", before)
    forget()


def forget() -> None:
    """Forget all programs, like a new process."""
    programs.forget()
    posterior.sampler.cache_clear()
    jax.clear_caches()


def weights(n: int = 4) -> np.ndarray:
    """Of a small program that contains nothing but jaxlfi."""
    scores = np.linspace(-1, 1, 2 * n, dtype=np.float32).reshape(2, n)
    return np.asarray(executables.call(lowered.Program(stacked, stacked, ()), scores, np.ones(n, np.float32)))


def inferred() -> np.ndarray:
    """Draws of a run with a user's simulator."""
    simulate = lambda key, theta: theta + 0.1 * jax.random.normal(key, (2,))
    box = Support(jnp.array([-2.0, -2.0]), jnp.array([2.0, 2.0]))
    task = jaxlfi.Task(simulate, names=("a", "b"), supports={"ok": box}, feasible=box)
    run = jaxlfi.infer(0, task, jnp.array([0.5, -0.2]), heuristic=Edge(), settings=SETTINGS)
    return np.asarray(run.posterior.sample(1, 5))


def names(folder) -> set[str]:
    return {path.name.rpartition("-")[0] for path in folder.iterdir()} if folder.exists() else set()


def traced(of) -> tuple[set[str], np.ndarray]:
    """The functions that were traced, and the result."""
    seen: set[str] = set()

    def listen(event, seconds, **about):
        if event.endswith("jaxpr_trace_duration"):
            seen.add(about.get("fun_name", ""))

    jax.monitoring.register_event_duration_secs_listener(listen)
    result = of()
    jax.monitoring.unregister_event_duration_listener(listen)
    return seen, result


@pytest.mark.slow  # test_another_process_finds_them has it of a small program
def test_stages_are_traced_once_and_simulators_in_every_process(folder):
    first, expected = traced(inferred)
    assert first >= {*STAGES, "simulate_one"} and names(folder) >= STAGES and "simulate_one" not in names(folder)
    forget()
    again, found = traced(inferred)
    assert "simulate_one" in again and not again & STAGES
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
def test_lowered_programs_do_what_others_do(folder, monkeypatch):
    expected = inferred()
    forget()
    monkeypatch.setenv(compile_cache.SWITCH, "0")
    np.testing.assert_allclose(inferred(), expected, rtol=1e-2, atol=1e-2)


SCRIPT = """
import jax, numpy
jax.config.update("jax_debug_key_reuse", True)
from tests.io import test_lowered
seen, found = test_lowered.traced(test_lowered.inferred)
print(sorted(seen & test_lowered.STAGES), found.tolist())
"""


@pytest.mark.slow
def test_another_process_finds_them(folder, tmp_path):
    """It runs programs that it has not lowered, and they can call LAPACK."""
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    once, again = (
        subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    assert once.stdout.startswith(str(sorted(STAGES))) and again.stdout == "[]" + once.stdout.partition("]")[2]


class Own(Edge):
    """A user's heuristic."""


def test_programs_with_a_users_classes_are_not_cached():
    lowered._tree(jax.tree.structure(Edge()))
    with pytest.raises(NotKept):
        lowered._tree(jax.tree.structure((1, {"heuristic": Own()})))


def test_what_a_program_returns_is_known_without_tracing_it(folder):
    many = posterior.sampler(3)
    mixture = GaussianMixture(jnp.zeros(2), jnp.zeros((2, 1)), jnp.ones((2, 1, 1)))
    box = Support(jnp.array([-1.0]), jnp.array([3.0]))
    arguments = jax.random.key(0), truncated(mixture, mixture, box, Space(("a",), (False,)))
    expected = jax.eval_shape(many.jitted, *arguments)
    assert many.shapes(*arguments) == expected
    forget()
    seen, shapes = traced(lambda: posterior.sampler(3).shapes(*arguments))
    assert shapes == expected and "_draws" not in seen and names(folder) == {"_draws"}


def double(x):
    """Twice x."""
    return 2 * x


def test_weakly_typed_arrays_keep_their_type_in_double_precision(folder):
    with jax.enable_x64(False):
        weak = jax.jit(lambda: jnp.full(2, jnp.inf))()
    program = lowered.Program(double, jnp.square, ())
    with jax.enable_x64(True):
        assert weak.weak_type and jax.dtypes.result_type(weak) == jnp.float64
        assert executables.call(program, weak).dtype == weak.dtype == jnp.float32


@pytest.mark.parametrize("damage", [lambda content: content[:50], lambda content: content[:-9] + b"123456789"])
def test_a_damaged_program_is_traced_anew(folder, damage):
    expected = weights()
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    forget()
    np.testing.assert_array_equal(weights(), expected)
    assert path.read_bytes() == whole


def test_without_a_folder_the_run_goes_on_and_says_so_once(folder):
    folder.write_text("in the way")
    with pytest.warns(UserWarning, match="programs are traced anew in the next process"):
        weights()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        weights(5)


def test_a_switch_turns_it_off(folder, monkeypatch):
    monkeypatch.setenv(compile_cache.SWITCH, "0")
    weights()
    assert not folder.exists()


def test_changed_constants_and_replaced_functions_are_noticed(monkeypatch):
    """A program cached before a function was replaced would be silently wrong."""
    as_it_was = environment(staged.train_one)
    assert environment(staged.train_one) == as_it_was
    with monkeypatch.context() as changed:
        changed.setattr(training, "STEPS_PER_EPOCH", 7)
        assert environment(staged.train_one) != as_it_was
    for change in (
        lambda: monkeypatch.setattr(training, "shuffled", lambda *arguments: arguments),
        lambda: monkeypatch.setattr(GaussianMixture, "sample", lambda *arguments: arguments),
        lambda: monkeypatch.setitem(ACTIVATIONS, "own", lambda x: x),
    ):
        change()
        with pytest.raises(NotKept):
            environment(staged.train_one)
        monkeypatch.undo()
    assert environment(staged.train_one) == as_it_was


PLAIN = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5)
STATIC = st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=3).map(tuple), max_leaves=6)


def same(one, other) -> bool:
    if type(one) is not type(other):
        return False
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return repr(one) == repr(other)  # 0.0 is not -0.0


@given(STATIC, STATIC)
def test_static_values_are_told_apart(one, other):
    assert (written(one) == written(other)) == same(one, other)
    assert written(one) == written(one)


@given(PLAIN)
def test_constants_are_read_back(value):
    assert same(constant(written(value)), value)


def test_values_that_other_processes_cannot_identify():
    nowhere: dict = {}
    exec("def simulate(key, theta): return theta", nowhere)
    for value in (lambda x: x, weights, object(), Own(), np.array([None]), nowhere["simulate"]):
        with pytest.raises(NotKept):
            written(value)
