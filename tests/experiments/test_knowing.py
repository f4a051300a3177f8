"""The puck's motion against small steps, its episodes, and the tables of made-up distances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("brax")

from experiments.knowing import __main__ as study
from experiments.knowing import domains, report, training
from experiments.knowing.domains import OBJECTS
from experiments.knowing.slide import GRAVITY, INTERVAL, LINE, STEPS, Slide, trajectory
from jaxlfi.diagnostics.contrasts import Arm
from jaxlfi.io import files
from jaxlfi.rl.environment import Environment

SMALL = 1e-5


def small_steps(mass, friction, forces, line=np.inf):
    """Positions and velocities after each force, and where the puck stops, by steps of 10 microseconds.

    Beyond the line no force acts.
    """
    position, velocity, found, released = 0.0, 0.0, [(0.0, 0.0)], False
    for force in [*forces, *[0.0] * 200]:
        for _ in range(round(INTERVAL / SMALL)):
            released |= position >= line
            push = 0.0 if released else force
            if velocity == 0.0 and push <= friction * mass * GRAVITY:
                break
            velocity = max(velocity + SMALL * (push / mass - friction * GRAVITY), 0.0)
            position += SMALL * velocity
        found.append((position, velocity))
        if len(found) > len(forces) and velocity == 0.0:
            break
    return np.array(found), position


@pytest.mark.parametrize(("mass", "friction"), [(0.9, 0.3), (1.7, 0.35), (0.4, 0.1)])
def test_motion_under_forces(mass, friction):
    """Pushed, stopped by friction, at rest under a force too weak, and pushed again."""
    forces = np.array([8.0, 8.0, 0.0, 0.0, 0.0, 0.0, 0.3, 14.0, 2.0])
    expected, _ = small_steps(mass, friction, forces)
    found = trajectory(jnp.array([mass, friction]), jnp.asarray(forces))
    np.testing.assert_allclose(found, expected[: len(forces) + 1], atol=2e-3)


@pytest.mark.parametrize(
    ("mass", "friction", "force"), [(0.9, 0.3, 9.0), (0.4, 0.1, 5.0), (1.7, 0.35, 24.0), (1.5, 0.5, 5.0)]
)
def test_an_episode_is_rewarded_by_how_far_from_the_mark_the_puck_stops(mass, friction, force):
    """The line is passed within an interval; the last puck is not moved at all, until its time is up."""
    env = Slide()
    _, stop = small_steps(mass, friction, [force] * STEPS, line=LINE)
    state = jax.jit(env.reset)(jax.random.key(0), jnp.array([mass, friction]))
    step, rewards = jax.jit(env.step), []
    while not bool(state.terminated):
        state = step(state, jnp.array([force]))
        rewards.append(float(state.reward))
    assert not any(rewards[:-1])
    np.testing.assert_allclose(rewards[-1], -abs(stop - float(state.inner.mark)), atol=3e-3)
    assert (len(rewards) == STEPS) == (force == 5.0 and mass == 1.5) and bool(state.facts["released"]) == (stop > LINE)


def test_a_history_is_the_last_states_and_forces():
    env = Slide(3)
    assert isinstance(env, Environment) and env.observations.size == 3 * 2 + 2 + 1
    state = env.reset(jax.random.key(1), jnp.array([1.0, 0.2]))
    seen = [np.asarray(state.observation)]
    for force in (6.0, 11.0):
        state = env.step(state, jnp.array([force]))
        seen.append(np.asarray(state.observation))
    np.testing.assert_allclose(seen[2][2:4], seen[1][:2])
    np.testing.assert_allclose(seen[2][4:6], seen[0][:2])
    np.testing.assert_allclose(seen[2][6:8], [11.0, 6.0])
    np.testing.assert_allclose([one[-1] for one in seen], state.inner.mark)
    assert Slide().observations.size == 3


def test_tables_say_which_arm_is_nearer():
    """Made-up distances in m: the posterior misses by 2 cm, the wide box by 12, more on later objects."""
    shape = (4, 16)
    noise = np.random.default_rng(0)
    episodes = {}
    for name in report.ARMS:
        for place, dlo in enumerate(OBJECTS):
            off = {"posterior": 0.02, "oracle": 0.02}.get(name, 0.1 + 0.01 * place)
            episodes[f"{name}/{dlo}"] = -off + 0.001 * noise.normal(size=shape)
    found = report.arms(episodes)
    rows = {row["trained on"]: row for row in report.table(found)}
    assert rows["posterior"]["all"].startswith("2.0 [") and rows["wide box"]["all"].startswith("11.5 [")
    assert rows["wide box"]["light"].startswith("13.0 (")
    contrasts = {row["against"]: row for row in report.contrasts(found)}
    assert contrasts["wide box"]["nearer to the mark by, cm"].startswith("9.5 [")
    assert contrasts["wide box"]["A"] == "1.00" and contrasts["wide box"]["p, Holm"] == "0.005"  # 10 times 2 / 4001
    assert float(contrasts["oracle"]["nearer to the mark by, cm"].split()[0]) == pytest.approx(0.0, abs=0.11)
    assert found["history"].shared and not found["SimOpt"].shared and isinstance(found["ADR"], Arm)


def test_a_study_that_was_stopped_goes_on_with_the_next_part(tmp_path, monkeypatch):
    made = []

    def part(name, fails=False):
        def make(out, seeds):
            made.append(name)
            if fails:
                raise KeyboardInterrupt
            return {f"{name}/inside": np.full((seeds, 2), float(len(made)))}

        return make

    monkeypatch.setattr(study, "PARTS", {"first": part("first"), "second": part("second", fails=True)})
    with pytest.raises(KeyboardInterrupt):
        study.played(tmp_path, 3)
    monkeypatch.setattr(study, "PARTS", {"first": part("first"), "second": part("second")})
    found = study.played(tmp_path, 3)
    assert made == ["first", "second", "second"]
    assert found["first/inside"].shape == (3, 2) and (found["first/inside"] == 1.0).all()


@pytest.mark.slow
def test_the_whole_study_in_small(tmp_path, monkeypatch):
    """All parts with hardly any training, on made-up domains: every arm has returns on every object, and tables."""
    small = training.SETTINGS.replace(
        total_steps=160, environments=4, unroll=20, segments=2, minibatches=2, epochs=1, hidden=(4,)
    )
    for name, value in {"SETTINGS": small, "CHUNK": 2, "EVERY": 1, "PROBES": 4, "EPISODES": 3}.items():
        monkeypatch.setattr(training, name, value)
    pool = np.random.default_rng(0).uniform([0.5, 0.2], [1.5, 0.5], (domains.POOL, 2)).astype(np.float32)
    own = {f"{arm}/{dlo}": pool for arm in domains.OWN for dlo in OBJECTS}
    files.write_arrays(tmp_path / "domains.npz", {"guess": pool, "wide box": pool} | own)
    with jax.debug_key_reuse(False):  # Brax uses keys in its own way
        found = study.played(tmp_path, 2)
    assert {name.partition("/")[0] for name in found} == {*report.ARMS, "ADR ranges"}
    shapes = {name: values.shape for name, values in found.items() if name.startswith(("random", "history", "oracle"))}
    assert set(shapes.values()) == {(2, 3)}
    files.write_arrays(tmp_path / "episodes.npz", found)
    report.write(tmp_path)
    assert "| random |" in (tmp_path / "table.md").read_text() and (tmp_path / "returns.png").stat().st_size > 10_000
