"""Simulators that are programs: what they are called with, and what is read from them."""

import dataclasses
import importlib.util
import io
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.tasks.command import Command, read
from jaxlfi.tasks.executors import one_by_one, workers
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.worker import REASONS, Request, simulated

EXAMPLE = Path(__file__).parents[2] / "examples" / "command"
THETA = np.array([0.1, -2.5], np.float32)
AS_OBSERVED = " (the observation has shape [2])"


@pytest.mark.parametrize(
    ("template", "words"),
    [
        ("true {theta} {seed}", ["0.100000001", "-2.5", "7"]),
        ("true --theta={theta} --seed={seed}", ["--theta=0.100000001,-2.5", "--seed=7"]),
        ("true -k {stiffness} 'a b' -d{damping}", ["-k", "0.100000001", "a b", "-d-2.5"]),
        ("true '; rm {theta}'", ["; rm 0.100000001,-2.5"]),
    ],
)
def test_values_are_words_of_their_own_and_no_shell_reads_them(template, words):
    command = Command(template, ["stiffness", "damping"])
    assert command.words(THETA, 7) == ["true", *words]
    assert np.float32("0.100000001") == THETA[0]  # no digit is lost


@pytest.mark.parametrize(
    ("template", "message"),
    [
        ("", "expected an executable program as its first word, got ''"),
        ("no-such-program {theta}", "expected an executable program as its first word"),
        ("./no-such-program {theta}", "expected an executable program as its first word"),
        ("true '{theta}", "expected words as in a shell"),
        ("true {seed}", r"expected {theta} or each of \['stiffness', 'damping'\] in braces"),
        ("true {stiffness}", "expected {theta} or each of"),
        ("true {theta} {speed}", "expected {theta} or each of"),
    ],
)
def test_templates_that_cannot_work_are_refused(template, message):
    with pytest.raises(ValueError, match=f"^command: {message}"):
        Command(template, ["stiffness", "damping"])


def test_outputs_are_npy_or_json_and_nothing_is_unpickled():
    buffer = io.BytesIO()
    np.save(buffer, np.arange(6.0).reshape(3, 2))
    assert read(buffer.getvalue()).shape == (3, 2)
    assert read(b"[1, 2.5, NaN]").shape == (3,)
    trajectory, outcome = read(b'{"trajectory": [[1, 2]], "outcome": 3}')
    assert trajectory.shape == (1, 2) and outcome == 3
    assert read(b'{"trajectory": [1]}')[1] == 0
    pickled = io.BytesIO()
    np.save(pickled, np.array([{}], object), allow_pickle=True)
    with pytest.raises(ValueError, match="allow_pickle=False"):
        read(pickled.getvalue())
    for output in (b"", b"hello", b'{"x": 1}', b"[[1], [1, 2]]", b"\xff\x00"):
        with pytest.raises(ValueError, match=r"^standard output: expected lines of as many numbers each, \.npy"):
            read(output)


@pytest.mark.parametrize(
    ("output", "expected"),
    [
        (b"0.5\n-1e-3\nnan\n", [0.5, -1e-3, np.nan]),
        (b"0.5 1 2\n", [0.5, 1.0, 2.0]),
        (b"0,0.5\r\n0.1,0.7\r\n\r\n", [[0.0, 0.5], [0.1, 0.7]]),
        (b"1\t2\n3\t4\n5\t6", [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
        (b"# made by sim\nx\n0.5\n0.7\n", [0.5, 0.7]),
        (b"x, y\n1, 2\n3, 4\n", [[1.0, 2.0], [3.0, 4.0]]),
        (b"time,x\n0,1\n1,3\n", [1.0, 3.0]),
        (b"Time (s),x,y\n0,1,2\n1,3,4\n", [[1.0, 2.0], [3.0, 4.0]]),
        (b"  t   x\n0.0 5\n0.5 6\n", [5.0, 6.0]),
        (b"t x\n1 5\n1 6\n", [[1.0, 5.0], [1.0, 6.0]]),  # a time does not stand still
        (b"time\n0\n1\n", [0.0, 1.0]),
    ],
)
def test_outputs_may_be_lines_of_numbers(output, expected):
    np.testing.assert_array_equal(read(output), expected)


def test_lines_of_different_lengths_and_words_among_numbers_are_refused():
    for output in (b"1 2\n3\n", b"time,2\n0,1\n", b"time,x\nstarted\n0,1\n", b"time,x\n", b"0,1\ntime,x\n"):
        with pytest.raises(ValueError, match="lines of as many numbers each"):
            read(output)


@pytest.mark.parametrize(
    ("code", "reason", "message"),
    [
        ("print('[1, 2]')", None, ""),
        ("print('[1, 2, 3]')", "wrong_shape", f"expected numbers of shape [2], got int64 of shape [3]{AS_OBSERVED}"),
        ("""print('["a", "b"]')""", "wrong_shape", f"expected numbers of shape [2], got <U1 of shape [2]{AS_OBSERVED}"),
        ("print('hello')", "error", "ValueError: standard output: expected lines of as many numbers each"),
        ("import sys; sys.exit('no mesh')", "error", "exit status 1: no mesh"),
        ("import os; os.kill(os.getpid(), 11)", "crash", "ended by SIGSEGV: nothing on standard error"),
    ],
)
def test_every_way_to_fail_has_its_reason(code, reason, message):
    command = Command(f"{sys.executable} -c {shlex.quote(code)} {{theta}} {{seed}}", ["a"])
    answer = simulated(command, Request([0, 0], 0, [0.5], [2]))
    assert answer.outcome == (0 if reason is None else -1 - REASONS.index(reason))
    assert message in answer.message


@pytest.fixture(scope="module")
def spring():
    """The module of the example."""
    spec = importlib.util.spec_from_file_location("spring_example", EXAMPLE / "spring.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_example_in_c(spring, tmp_path):
    program = tmp_path / "a folder" / "spring"  # a space is no end of a word
    program.parent.mkdir()
    subprocess.run(["cc", "-O2", "-Wall", "-Werror", "-o", program, EXAMPLE / "spring.c", "-lm"], check=True)
    task = spring.task(str(program))
    theta = jnp.tile(task.space.to_inference(spring.TRUTH), (6, 1))
    trajectories, _, failure = simulate_batch(jax.random.key(0), task, theta, (40,))
    assert not failure.any() and len({trajectory.tobytes() for trajectory in trajectories}) == 6  # a seed each
    times = 0.25 * np.arange(1, 41)
    decay, beat = spring.TRUTH[1] / 2, np.sqrt(spring.TRUTH[0] - spring.TRUTH[1] ** 2 / 4)
    exact = np.exp(-decay * times) * (np.cos(beat * times) + decay / beat * np.sin(beat * times))
    np.testing.assert_allclose(trajectories.mean(0), exact, atol=0.05)
    with workers(2) as executor:
        again, _, _ = simulate_batch(jax.random.key(0), one_by_one(task, executor), theta, (40,))
    np.testing.assert_array_equal(again, trajectories)
    said = subprocess.run([program], capture_output=True, text=True, check=False)
    assert said.returncode == 2 and said.stderr == "expected --theta STIFFNESS DAMPING --seed SEED\n"


def test_a_script_that_hangs_is_ended(tmp_path):
    script = tmp_path / "sim.py"
    script.write_text(
        textwrap.dedent("""
        import json, random, sys, time
        *theta, seed = map(float, sys.argv[1:])
        if theta[0] > 0.5:
            time.sleep(1000)
        random.seed(seed)
        print(json.dumps({"trajectory": [t + random.gauss(0, 0.1) for t in theta], "outcome": 0}))
        """)
    )
    box = jaxlfi.Support([0.0, 0.0], [1.0, 1.0])
    task = jaxlfi.Task.from_command(
        f"{sys.executable} {script} {{theta}} {{seed}}", ["a", "b"], {"box": box}, box, timeout=2.0, name="script"
    )
    trajectories, _, failure = simulate_batch(
        jax.random.key(0), task, jnp.array([[0.2, 0.7], [0.8, 0.1], [0.3, 0.3]]), (2,)
    )
    assert [0 if code == 0 else task.reasons[code - 1] for code in failure] == [0, "timeout", 0]
    np.testing.assert_allclose(trajectories[[0, 2]], [[0.2, 0.7], [0.3, 0.3]], atol=0.5)
    assert task == dataclasses.replace(task) and task.name == "script"
