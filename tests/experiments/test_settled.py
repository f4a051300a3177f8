"""The study of settled outcomes: its objects, tables of made-up episodes, and what is kept between two commands."""

import numpy as np
import pytest

pytest.importorskip("brax")
pytest.importorskip("mujoco")

from experiments import arms, chance
from experiments.policies import actions
from experiments.settled import __main__ as study
from experiments.settled import domains, films, report, training
from experiments.settled.domains import OBJECTS
from jaxlfi.envs.whip.environment import ACTIONS
from jaxlfi.io import files

OWN = {"oracle": 0.9, "posterior": 0.8, "fixed": 0.8}
RATES = OWN | {"guess": 0.3, "wide": 0.4, "history": 0.4, "constant": 0.0, "random": 0.1}


def made_up(rates=RATES):
    """Episodes of which so many end as wanted, on later objects fewer; those that do return 2."""
    rng, found = np.random.default_rng(0), {}
    for arm, rate in rates.items():
        for place, dlo in enumerate(OBJECTS):
            shape = (1 if arm in report.OWN else 3, training.PLACES)
            clean = rng.uniform(size=shape) < rate - 0.01 * place
            facts = {"value": 2.0 * clean, "displaced": 1 + clean, report.PRIMARY: clean}
            found |= {f"{arm}/{dlo}/{what}": facts.get(what, np.zeros(shape, bool)) for what in training.KEPT}
    return found


def test_objects_are_drawn_from_all_that_is_possible():
    truths = domains.truths()
    assert truths.shape == (12, 2) and truths[0] == pytest.approx([103.7, 41563], rel=1e-3)
    assert np.all((truths >= [50, 500]) & (truths <= [350, 5e5]))
    assert np.flatnonzero(report.inside()).tolist() == [4, 10]  # 246 mm and 3.9 kPa, 208 mm and 9.8 kPa


def test_tables_say_which_arm_is_ahead():
    episodes = made_up()
    rows = {row["trained on"]: row for row in report.table(episodes)}
    assert list(rows) == list(report.ARMS)
    clean = np.stack([episodes[f"posterior/{dlo}/{report.PRIMARY}"] for dlo in OBJECTS])
    assert rows["posterior"]["the top cube alone"].startswith(f"{clean.mean():.2f} [")
    assert rows["posterior"]["settled return"].startswith(f"{2 * clean.mean():.2f} [")
    contrasts = {row["against"]: row for row in report.contrasts(episodes)}
    assert set(contrasts) == {"oracle", "fixed", "guess", "wide", "history"}
    assert float(contrasts["guess"]["more often by"].split()[0]) == pytest.approx(0.5, abs=0.1)
    assert contrasts["guess"]["p, Holm"] == "0.002"  # five times 2 / 4001
    assert float(contrasts["fixed"]["p, Holm"]) > 0.05


def test_objects_are_shown_with_what_their_policies_were_trained_on():
    episodes, points = made_up(), np.tile([[200.0, 1e4], [210.0, 1.26e5]], (12, 1, 1))
    rows = report.by_object(episodes, {"posterior/trained": points})
    assert len(rows) == 12 and rows[0]["E, kPa"] == "42" and rows[4]["in the guess"] == "yes"
    assert rows[3]["trained on"] == "200 to 210 mm, 10 to 130 kPa"
    assert rows[3]["wide"] == f"{episodes[f'wide/{OBJECTS[3]}/{report.PRIMARY}'].mean():.2f}"


def test_arms_that_were_not_run_are_left_out():
    episodes = made_up({name: RATES[name] for name in ("posterior", "guess")})
    assert [row["trained on"] for row in report.table(episodes)] == ["posterior", "guess"]
    assert [row["against"] for row in report.contrasts(episodes)] == ["guess"]


def test_arms_without_knowledge_are_the_same_policies_on_all_objects():
    found = report.arms(made_up())
    assert {name for name, arm in found.items() if not arm.shared} == set(report.OWN)
    assert found["wide"].values.shape == (12, 3, 16) and found["oracle"].values.shape == (12, 1, 16)


def test_a_constant_policy_acts_alike_whatever_it_sees():
    policy = training.constant(np.array([0.045, -0.015]))
    for seen in np.random.default_rng(1).normal(size=(3, 28)):
        np.testing.assert_allclose(policy(seen), [0.045, -0.015], atol=1e-7)


def test_chance_is_within_the_limits_of_actions_and_one_function_of_what_is_seen():
    import jax
    import jax.numpy as jnp

    keys = jax.random.key_data(jax.random.split(jax.random.key(0), 2))
    seen = jax.random.normal(jax.random.key(1), (200, 4))
    acted = jax.vmap(chance.policy(ACTIONS, keys[0]))(seen)
    assert np.all(np.abs(acted) <= 0.06) and np.abs(acted.mean(axis=0)).max() < 0.01
    assert len(np.unique(acted)) == acted.size
    np.testing.assert_array_equal(acted, jax.vmap(chance.policy(ACTIONS, keys[0]))(seen))
    assert not jnp.any(acted == jax.vmap(chance.policy(ACTIONS, keys[1]))(seen))


def test_what_is_done_is_kept_and_arms_are_made_in_order(tmp_path, monkeypatch):
    made, episodes = [], made_up()

    def trainings(out, arms, seeds, settings, points):
        made.append(arms)
        files.write_arrays(out / "curves.npz", {"value": np.arange(12.0).reshape(2, 6)})
        files.write_sealed(out / "domains.npz", {"trained": np.arange(6.0)[:, None, None] * np.ones((6, 12, 2))})
        return out

    own = lambda name: {key: row for key, row in episodes.items() if key.startswith(f"{name}/")}
    monkeypatch.setattr(study, "trainings", trainings)
    monkeypatch.setattr(training, "trained", lambda folder: ["guess"] * 3 + ["wide"] * 3)
    monkeypatch.setattr(training, "arm", lambda folder, name: own(name))
    monkeypatch.setattr(training, "floors", lambda: own("constant") | own("random"))
    study.part(tmp_path, "guess").parent.mkdir()
    study.make(tmp_path, ["guess"], training.SETTINGS)
    study.make(tmp_path, ["wide", "guess", "floors"], training.SETTINGS)
    assert made == [("guess", "wide")] * 2
    study.gather(tmp_path, training.SETTINGS)
    kept_arrays = files.read_arrays(tmp_path / "episodes.npz")
    assert {name.split("/")[0] for name in kept_arrays} == {"guess", "wide", "constant", "random"}
    learning = files.read_arrays(tmp_path / "learning.npz")
    np.testing.assert_array_equal(learning["wide/curve"], [[3, 4, 5], [9, 10, 11]])
    np.testing.assert_array_equal(learning["wide/trained"][:, 0, 0], [3, 4, 5])
    study.make(tmp_path, ["wide", "guess", "floors"], training.SETTINGS)
    study.gather(tmp_path, training.SETTINGS)
    assert len(made) == 2 and set(files.read_arrays(tmp_path / "episodes.npz")) == set(kept_arrays)


def test_a_second_seed_is_added_to_the_first(tmp_path, monkeypatch):
    made, episodes = [], made_up({"oracle": 0.5})
    learning = lambda seed: {"oracle/curve": np.full((2, 12), seed), "oracle/trained": np.full((12, 12, 2), seed)}
    monkeypatch.setattr(study, "trainings", lambda out, arms, seeds, settings, points: made.append(seeds) or seeds[0])
    monkeypatch.setattr(training, "arm", lambda seed, name: {key: row + seed for key, row in episodes.items()})
    monkeypatch.setattr(training, "learning", lambda seed, name: learning(seed))
    study.part(tmp_path, "oracle").parent.mkdir()
    study.make(tmp_path, ["oracle"], training.SETTINGS)
    study.gather(tmp_path, training.SETTINGS)
    assert not study.part(tmp_path, "oracle").exists()
    study.make(tmp_path, ["oracle"], training.SETTINGS, own_seeds=2)
    study.gather(tmp_path, training.SETTINGS)
    assert made == [(0,), (1,)]
    kept = files.read_arrays(tmp_path / "episodes.npz")["oracle/object-03/steps"]
    np.testing.assert_array_equal(kept, [np.zeros(16), np.ones(16)])
    learnt = files.read_arrays(tmp_path / "learning.npz")
    np.testing.assert_array_equal(learnt["oracle/curve"], np.repeat([[0, 1]] * 2, 12, axis=1))
    np.testing.assert_array_equal(learnt["oracle/trained"][:, 0, 0], np.repeat([0, 1], 12))
    assert study.training_folder(tmp_path, ("oracle",), (1,)).name == "oracle-1"


def test_films_show_the_best_and_the_median_policy():
    episodes = {key: np.zeros_like(row) for key, row in made_up().items()}
    for arm, seed, rate, value in (("guess", 1, 0.5, 0), ("wide", 2, 0.25, 1), ("oracle", 0, 0.25, 0)):
        episodes[f"{arm}/{OBJECTS[3]}/{report.PRIMARY}"][seed, : int(16 * rate)] = True
        episodes[f"{arm}/{OBJECTS[3]}/value"][seed] = value
    shown = films.shown(episodes)
    assert shown["best"][3] == ("guess", 1)
    for arm, seeds in (("posterior", [0]), ("guess", [0, 2]), ("wide", [0])):  # now half of the eight are clean
        for seed in seeds:
            episodes[f"{arm}/{OBJECTS[3]}/{report.PRIMARY}"][seed, :1] = True
            episodes[f"{arm}/{OBJECTS[3]}/value"][seed] = seed
    # guess 1, wide 2, oracle; then one of sixteen: guess 2, and wide, posterior and guess 0 by name
    assert films.shown(episodes)["median"][3] == ("wide", 0)


def test_a_later_pass_trains_on_the_same_points(tmp_path):
    points = np.random.default_rng(3).uniform(1, 2, (12, 12, 2)).astype(np.float32)
    files.write_arrays(tmp_path / "learning.npz", {"posterior/trained": points})
    draws = domains.drawn(tmp_path, "posterior")
    assert list(draws) == [f"posterior-{name}" for name in OBJECTS]
    np.testing.assert_array_equal(draws["posterior-object-05"](None, 12).theta, points[5])
    np.testing.assert_array_equal(draws["posterior-object-05"](None, 30).theta[24:], points[5][:6])


def test_a_folder_with_other_settings_is_refused(tmp_path, monkeypatch, capsys):
    arms.write_config(tmp_path, "experiments.settled", training.SETTINGS)
    monkeypatch.setattr("sys.argv", ["settled", "--out", str(tmp_path), "--steps", "60000"])
    with pytest.raises(SystemExit):
        study.main()
    assert "other settings; give another --out" in capsys.readouterr().err


@pytest.mark.slow
def test_the_whole_study_in_small(tmp_path, monkeypatch):
    """All arms that need no inference, with hardly any training; a second command trains nothing."""
    import jax

    small = training.SETTINGS.replace(
        total_steps=8, environments=2, unroll=2, segments=1, minibatches=2, epochs=1, hidden=(4,)
    )
    monkeypatch.setattr(training, "SETTINGS", small)
    for name, value in {"PLACES": 2, "TRIED": 1, "AGAIN": 1, "SEEDS": 1}.items():
        monkeypatch.setattr(training, name, value)
    monkeypatch.setattr(actions, "STEPS", 3)
    training._deployed.cache_clear()
    made = ["guess", "wide", "oracle", "floors"]
    study.part(tmp_path, "guess").parent.mkdir()
    with jax.debug_key_reuse(False):  # Brax uses keys in its own way
        study.make(tmp_path, made, small)
    labels, end = films.play(training.policies(tmp_path / "runs" / "trainings", "oracle-object-03")[0], (200, 1e4))
    assert labels.shape == (4 * (16 + 11) + 1, 120, 120) and 0 < end <= 64
    assert set(np.unique(labels[0])) == set(range(8)) and not np.array_equal(labels[0], labels[end])
    monkeypatch.setattr(training, "learn", None)
    study.make(tmp_path, made, small)
    study.gather(tmp_path, small)
    episodes = files.read_arrays(tmp_path / "episodes.npz")
    assert episodes["oracle/object-03/settled_clean"].shape == (1, 2)
    assert np.isfinite(episodes["constant/object-00/value"]).all()
    learning = files.read_arrays(tmp_path / "learning.npz")
    assert learning["oracle/curve"].shape == (2, 12) and learning["guess/trained"].shape == (1, 2, 2)
    for name in OBJECTS:
        episodes = dict(episodes) | {
            key.replace("oracle", "posterior"): row for key, row in episodes.items() if key.startswith(f"oracle/{name}")
        }
    files.write_arrays(tmp_path / "episodes.npz", episodes)
    report.write(tmp_path)
    assert "| random |" in (tmp_path / "table.md").read_text() and (tmp_path / "outcomes.png").stat().st_size > 10_000
    training._deployed.cache_clear()
