"""The cache of compiled programs in Python: on by default, off by a switch, never in the way."""

import gc
import os
import subprocess
import sys
import warnings

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxlfi.io import compile_cache, executables

SETTINGS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """A process without a cache, whose user's folder for caches is empty."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    monkeypatch.delenv(compile_cache.SWITCH, raising=False)
    monkeypatch.setattr(compile_cache, "LEAST_SECONDS", 0.0)
    jax.config.update(SETTINGS[0], None)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def kept(folder) -> set[str]:
    """Programs of `compiled`, and not those of jax's own functions."""
    return {path.name for path in folder.rglob("jit__lambda*-cache")}


def compiled(number: float) -> float:
    """Compile a separate program for each number."""
    return float(executables.compiled(jax.jit(lambda x: jnp.sin(x) * number), (jnp.ones(3),))(jnp.ones(3))[0])


def test_programs_are_kept_and_found(tmp_path):
    first = compiled(3.25)
    there = kept(tmp_path)
    assert len(there) == 1
    jax.clear_caches()
    assert compiled(3.25) == first and kept(tmp_path) == there
    compiled(4.25)
    assert kept(tmp_path) > there


def test_a_folder_of_the_users_own_is_left_as_it_is(tmp_path):
    jax.config.update(SETTINGS[0], str(tmp_path / "own"))
    with compile_cache.used():
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "own")


@pytest.mark.parametrize("off", ["switch", "jax"])
def test_it_can_be_turned_off(tmp_path, monkeypatch, off):
    if off == "switch":
        monkeypatch.setenv(compile_cache.SWITCH, "0")
    jax.config.update("jax_enable_compilation_cache", off != "jax")
    with compile_cache.used():
        assert jax.config.jax_compilation_cache_dir is None and not kept(tmp_path)
    jax.config.update("jax_enable_compilation_cache", True)


def test_functions_of_the_process_are_not_kept(tmp_path):
    compiled(9.25)
    before = kept(tmp_path)
    jax.jit(lambda x: jnp.cos(x) * 9.5)(jnp.ones(3)).block_until_ready()
    assert kept(tmp_path) == before and jax.config.jax_compilation_cache_dir is None


def test_what_xla_logs_of_every_program_is_left_out_and_nothing_else(capfd):
    with compile_cache.used():
        os.write(2, b"E1 cpu_aot_loader.cc:220] " + compile_cache.NOISE[1] + b"-no-gather is not supported\n")
        os.write(2, b"W1 pjrt.cc:642] " + compile_cache.NOISE[0] + b".\nE1 out of memory\n")
    os.write(2, b"afterwards\n")
    assert capfd.readouterr().err == "E1 out of memory\nafterwards\n"


SCRIPT = """
import jax, jax.numpy as jnp
from jaxlfi.io import compile_cache, executables
compile_cache.LEAST_SECONDS = 0.0
f = jax.jit(lambda x: jnp.linalg.cholesky(x @ x.T) + jnp.sin(x))
print(float(executables.call(f, jnp.eye(20)).sum()))
"""


def test_a_second_process_loads_programs_in_silence(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    once, again = (
        subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    assert again.stdout == once.stdout and again.stderr == once.stderr == ""


def test_without_a_folder_the_run_goes_on_and_says_so_once(tmp_path):
    (tmp_path / "caches").write_text("in the way")
    with pytest.warns(UserWarning, match="programs are not kept for the next process"):
        assert compiled(5.25) == pytest.approx(5.25 * 0.8414710)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compiled(6.25)


def test_a_damaged_program_is_compiled_anew(tmp_path):
    compiled(7.25)
    for path in tmp_path.rglob("jit_*-cache"):
        path.write_bytes(path.read_bytes()[:20])
    jax.clear_caches()
    with pytest.warns(UserWarning, match="Error reading persistent compilation cache entry"):
        assert compiled(7.25) == pytest.approx(7.25 * 0.8414710)


def test_programs_are_compiled_as_the_process_asks(monkeypatch):
    """Tests, which want hardly any optimisation, get no more; and the options are some that the compiler knows."""
    assert executables._known(executables.QUICK) is None
    monkeypatch.setattr(jax.config, "read", lambda name: False)
    assert executables._known(executables.THOROUGH) is None
    for options in (executables.QUICK, executables.QUICKEST):
        known = executables._known(options)
        assert known is None if jax.default_backend() != "cpu" or jax.__version_info__ >= (0, 10) else known
        jax.jit(lambda x: x + 1).lower(jnp.ones(2)).compile(compiler_options=known)


def test_cycles_are_seldom_looked_for_while_a_program_is_traced_and_as_before_after_it():
    before, within = gc.get_threshold(), []
    gc.set_threshold(700, 10, 10)
    try:
        executables.compiled(jax.jit(lambda x: within.append(gc.get_threshold()) or x), (jnp.ones(3),))
        with pytest.raises(ZeroDivisionError):
            executables.compiled(jax.jit(lambda x: 1 / 0), (jnp.ones(3),))
        assert within == [executables.SELDOM] and gc.get_threshold() == (700, 10, 10)
    finally:
        gc.set_threshold(*before)
