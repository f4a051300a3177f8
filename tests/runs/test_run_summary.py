"""The answer of a run, stated: intervals against quantiles, and each sentence where it holds and where it does not."""

import dataclasses
import json
import math
import re

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import jaxlfi
from jaxlfi.distributions.space import Space
from jaxlfi.figures.collection import open_collection
from jaxlfi.figures.page import render
from jaxlfi.io.run_summary import FOLDER, NAME, RunSummary
from jaxlfi.runs.summarise import summarised
from tests.small import SETTINGS, gaussian

SPACE = Space(("mass", "stiffness"), (False, True))
GUESS, PHI = jaxlfi.Support([1.0, 0.0], [3.0, 2.0]), jaxlfi.Support([0.0, -2.0], [6.0, 4.0])
RNG = np.random.default_rng(0)
NARROW = np.stack([RNG.normal(2.0, 0.1, 4000), np.exp(RNG.normal(1.0, 0.1, 4000))], axis=1)


def of(draws=NARROW, guess=GUESS, last=GUESS, space=SPACE, truth=None, units=("kg", "N/m")) -> RunSummary:
    return summarised(draws, space, units, (guess, last, PHI), truth, "EDGE")


def test_intervals_are_those_of_the_draws_in_natural_units():
    mass, stiffness = of().parameters
    assert (mass.name, mass.unit, mass.verdict, stiffness.verdict) == ("mass", "kg", "identified", "identified")
    normal, log_normal = stats.norm(2.0, 0.1), stats.lognorm(0.1, scale=math.e)
    np.testing.assert_allclose([mass.median, stiffness.median], [2.0, math.e], rtol=0.005)
    np.testing.assert_allclose(mass.central_50, normal.ppf([0.25, 0.75]), atol=0.01)
    np.testing.assert_allclose(mass.central_90, normal.ppf([0.05, 0.95]), atol=0.015)
    np.testing.assert_allclose(stiffness.central_90, log_normal.ppf([0.05, 0.95]), rtol=0.02)
    # In natural units for both: 0.9 of a guess 2 wide, and what 0.9 of one of two logarithms is.
    np.testing.assert_allclose(mass.narrower, 0.9 * 2 / (3.29 * 0.1), rtol=0.05)
    width = np.diff(log_normal.ppf([0.05, 0.95]))
    np.testing.assert_allclose(stiffness.narrower, np.diff(np.exp([0.1, 1.9])) / width, rtol=0.05)
    np.testing.assert_allclose(mass.narrower_than_phi, 0.9 * 6 / (3.29 * 0.1), rtol=0.05)
    np.testing.assert_allclose(stiffness.narrower_than_phi, np.diff(np.exp([-1.7, 3.7])) / width, rtol=0.05)
    assert mass.leans == stiffness.leans == () and of().sentences == of().next_steps == ()


def test_an_interval_that_is_no_narrower_is_called_wider():
    wide = np.stack([RNG.uniform(0.0, 6.0, 4000), NARROW[:, 1]], axis=1)
    (row, _), known = of(wide, last=PHI).table()[1], of(wide, last=PHI).parameters[0]
    assert known.narrower == pytest.approx(1 / 3, rel=0.05) and row[4] == "3.0 times wider" and row[5] == "as wide"


def test_digits_are_as_many_as_another_set_of_draws_would_give():
    rng = np.random.default_rng(1)
    for sd, decimals in ((0.1, 2), (20.0, 0), (3000.0, -2)):
        space, box = Space(("a",), (False,)), jaxlfi.Support([-1e5], [1e5])
        found = [
            summarised(rng.normal(288.0, sd, (1000, 1)), space, None, (box, box, box), None, "EDGE").parameters[0]
            for _ in range(20)
        ]
        assert {one.decimals for one in found} == {decimals}
        error = np.std([one.central_90[0] for one in found])
        assert 0.3 * 10**-decimals < error < 3.2 * 10**-decimals  # the last digit shown is the first that is not sure
    assert found[0].shown(12345.0) == "12300"


def test_parameters_of_any_unit_keep_their_digits():
    """A capacitance of some picofarads, and a pressure known to a pascal."""
    for middle, sd, shown in ((4.7e-12, 1e-13, "4.70e-12"), (101325.0, 1.0, "101325.0"), (5e15, 1e14, "5.00e+15")):
        box = jaxlfi.Support([0.5 * middle], [2 * middle])
        draws = RNG.normal(middle, sd, (1000, 1)).astype(np.float32)
        (one,) = summarised(draws, Space(("a",), (False,)), None, (box, box, box), None, "EDGE").parameters
        assert one.shown(middle) == shown


@given(st.floats(-1e9, 1e9, allow_nan=False), st.integers(-6, 9))
def test_numbers_are_shown_to_within_half_of_the_last_digit(value, decimals):
    one = dataclasses.replace(of().parameters[0], decimals=decimals)
    shown = float(one.shown(value))
    assert abs(shown - value) <= 0.5001 * max(10.0**-decimals, 1e-6 * abs(value)) or abs(value) >= 1e6
    assert one.shown(math.nan) == "-"


def value_in(sentence: str) -> tuple[list[float], str]:
    """Median and interval of "= 1.0 [0.9, 1.1]" in a sentence, and the sentence with "= _" in its place."""
    found = re.search(r"= ([\d.-]+) \[([\d.-]+), ([\d.-]+)\]", sentence)
    assert found, sentence
    return list(map(float, found.groups())), sentence.replace(found[0], "= _")


def said(summary: RunSummary, words: str) -> bool:
    return any(words in sentence for sentence in summary.sentences)


def test_a_wrong_first_guess_is_said_and_a_right_one_is_not():
    beyond = np.stack([RNG.normal(4.0, 0.1, 4000), NARROW[:, 1]], axis=1)
    wider = jaxlfi.Support([1.0, 0.0], [5.5, 2.0])
    (sentence,) = of(beyond, last=wider).sentences
    assert sentence == (
        "The first guess of 1 to 3 kg for mass was wrong: EDGE moved its upper bound to 5.5 kg, and all of the "
        "posterior is outside the guess."
    )
    (sentence,) = of(last=wider).sentences
    assert sentence == ("EDGE moved the upper bound of mass to 5.5 kg; all of the posterior is within the first guess.")
    assert not said(of(beyond, guess=wider, last=wider), "guess")
    (sentence,) = of(last=jaxlfi.Support([0.5, 0.0], [5.5, 2.0])).sentences
    assert sentence.startswith("EDGE moved the lower bound of mass to 0.5 kg and its upper bound to 5.5 kg; all of")
    mostly = np.stack([np.where(RNG.uniform(size=4000) < 0.74, 4.0, 2.0) + RNG.normal(0.0, 0.1, 4000), NARROW[:, 1]], 1)
    (share,) = re.findall(r"and ([\d.]+) % of the posterior is outside the guess", of(mostly, last=wider).sentences[0])
    assert float(share) == pytest.approx(74, abs=3)


def test_what_is_not_constrained_is_said():
    flat = np.stack([NARROW[:, 0], np.exp(RNG.uniform(0.0, 2.0, 4000))], axis=1)
    found = of(flat)
    assert found.sentences == (
        "The observation does not constrain stiffness: its posterior is about as wide as its box.",
    )
    (step,) = found.next_steps
    assert step.startswith("Another experiment, in which stiffness matters: let the simulator return")
    assert [one.verdict for one in found.parameters] == ["identified", "not at all"]
    half = np.stack([NARROW[:, 0], np.exp(RNG.normal(1.0, 0.4, 4000).clip(0, 2))], axis=1)
    assert [one.verdict for one in of(half).parameters] == ["identified", "weakly"] and not said(of(half), "constrain")
    shrunk = jaxlfi.Support([1.8, 0.8], [2.2, 1.2])  # as `Truncate` leaves it: as wide as the posterior
    assert [one.verdict for one in of(last=shrunk).parameters] == ["identified"] * 2


def test_a_box_that_widens_for_want_of_information_is_no_evidence():
    """EDGE moves bounds to Phi where a posterior is as wide as its box: most of it is then outside of the guess."""
    flat = np.stack([RNG.uniform(0.0, 6.0, 4000), NARROW[:, 1]], axis=1)
    (sentence,) = of(flat, last=jaxlfi.Support([0.0, 0.0], [6.0, 2.0])).sentences
    assert sentence == (
        "The observation does not constrain mass: EDGE moved its box from 1 to 3 kg out to 0 to 6 kg, all of the "
        "feasible domain, which says nothing against the first guess."
    )
    assert not said(of(flat, last=jaxlfi.Support([0.0, 0.0], [5.0, 2.0])), "feasible domain")
    known = np.stack([RNG.normal(4.0, 0.1, 4000), NARROW[:, 1]], axis=1)
    assert not said(of(known, last=jaxlfi.Support([0.0, 0.0], [6.0, 2.0])), "says nothing against")


def test_a_posterior_that_leans_on_a_bound_is_said():
    leaning = np.stack([3.0 - RNG.exponential(0.2, 4000).clip(0, 1.9), NARROW[:, 1]], axis=1)
    found = of(leaning)
    assert found.parameters[0].leans == ("upper",)
    assert found.sentences == (
        "The posterior of mass leans on the box's upper bound, 3 kg: values beyond it were never tried.",
    )
    at_phi = summarised(leaning, SPACE, None, (GUESS, GUESS, GUESS), None, "EDGE")
    assert said(at_phi, "leans on the feasible domain's upper bound, 3:")
    assert at_phi.next_steps == ("A wider Phi, if mass can be above 3: the task's `feasible`.",)
    assert found.next_steps == () and found.table()[0][-1] == "leans on" and found.table()[1][0][-1] == "upper"


@pytest.mark.parametrize("sign", [1, -1])
def test_parameters_not_separately_identifiable_are_named_with_their_combination(sign):
    shared, own = RNG.uniform(-1.0, 1.0, 4000), RNG.normal(0.0, 0.03, 4000)
    both, box = Space(("mass", "stiffness"), (True, True)), jaxlfi.Support([-1.0, -1.0], [1.0, 1.0])
    logs = np.stack([shared, (sign * shared + own).clip(-1, 1)], axis=1)
    found = summarised(np.exp(logs), both, None, (box, box, box), None, "EDGE")
    assert [one.verdict for one in found.parameters] == ["not at all"] * 2
    known, unknown = ("mass / stiffness", "mass * stiffness")[::sign]
    correlation = f"{sign}.00" if sign < 0 else "1.00"
    (sentence,) = found.sentences
    (middle, low, high), rest = value_in(sentence)
    assert rest == (
        f"mass and stiffness are not separately identifiable (correlation {correlation}): only {known} = _ is well "
        f"determined; {unknown} is not."
    )
    exact = np.exp(np.array([0.0, -1.0, 1.0]) * 1.6449 * 0.03)  # of a log-normal combination
    np.testing.assert_allclose([middle, low, high], exact, atol=0.015)
    (step,) = found.next_steps
    assert step.startswith("Another experiment, in which mass and stiffness act in different ways: let")
    free = np.exp(RNG.uniform(-1.0, 1.0, (4000, 2)))
    assert not said(summarised(free, both, None, (box, box, box), None, "EDGE"), "separately")


def test_a_combination_of_three_is_found_where_no_two_are_correlated_much():
    names, box = ("a", "b", "c"), jaxlfi.Support([-2.0] * 3, [2.0] * 3)
    space, logs = Space(names, (True,) * 3), RNG.uniform(-1.0, 1.0, (4000, 3))
    logs[:, 2] = -logs[:, 0] - logs[:, 1] + RNG.normal(0.0, 0.03, 4000)
    assert np.abs(np.corrcoef(logs.T)[np.triu_indices(3, 1)]).max() < 0.8
    found = summarised(np.exp(logs), space, None, (box, box, box), None, "EDGE")
    assert said(found, "a, b and c are not separately identifiable: only a * b * c = 1.0")
    assert sum("separately" in sentence for sentence in found.sentences) == 1
    logs[:, 2] = RNG.normal(0.0, 0.03, 4000)
    assert not said(summarised(np.exp(logs), space, None, (box, box, box), None, "EDGE"), "separately")


def test_parameters_that_are_known_but_trade_off_are_said_to_do_so():
    shared, own = RNG.normal(0.0, 0.15, 4000), RNG.normal(0.0, 0.01, 4000)
    linear = Space(("mass", "stiffness"), (False, False))
    draws = np.stack([1.0 + 2 * shared, 0.1 + shared + own], axis=1)  # some negative: no product
    found = of(draws, guess=PHI, last=jaxlfi.Support([-9.0, -9.0], [9.0, 9.0]), space=linear)
    assert [one.verdict for one in found.parameters] == ["identified"] * 2
    sentence = next(one for one in found.sentences if "trade off" in one)
    assert sentence.startswith("mass and stiffness trade off against each other (correlation 1.00): mass - ")
    (middle, low, high), rest = value_in(sentence)
    assert " * stiffness = _ varies " in rest and not said(found, "separately")
    np.testing.assert_allclose([middle, low, high], 0.8 + 2 * 0.01 * 1.6449 * np.array([0.0, -1.0, 1.0]), atol=0.011)
    assert not any("different ways" in step for step in found.next_steps)
    apart = np.stack([1.0 + 2 * shared, 0.1 + RNG.normal(0.0, 0.15, 4000)], axis=1)
    assert not said(of(apart, guess=PHI, last=PHI, space=linear), "trade off")


def test_a_data_frame_has_the_numbers():
    pandas = pytest.importorskip("pandas")
    frame = of().to_pandas()
    assert isinstance(frame, pandas.DataFrame) and list(frame.index) == ["mass", "stiffness"]
    assert frame.loc["mass", "median"] == of().parameters[0].median


def test_forms_agree_and_come_back_from_a_file(tmp_path):
    found = of(truth=np.array([2.05, 2.6]), last=jaxlfi.Support([1.0, 0.0], [5.5, 2.0]))
    found = dataclasses.replace(found, next_steps=("Do this.", "Then that."))
    (tmp_path / NAME).write_text(json.dumps(found.to_dict()))
    assert RunSummary.read(tmp_path) == found and RunSummary.read(tmp_path / "none") is None
    lines = str(found).splitlines()
    assert lines[0].split()[0] == "parameter" and lines[0].endswith("truth")
    assert lines[-3:] == ["Next:", "- Do this.", "- Then that."]
    assert lines[-4] == found.sentences[-1] and "<li>Then that.</li>" in found.to_html()
    assert lines[1].startswith("mass") and "kg" in lines[1] and lines[1].endswith("2.05")
    assert found.to_html().count("<tr>") == 3 and found.sentences[0] in found.to_html()
    assert "&lt;b&gt;" in of(units=("<b>", "")).to_html()
    (tmp_path / NAME).write_text('{"parameters": [1]}')
    with pytest.raises(ValueError, match=r"summary.json: expected the summary of a run"):
        RunSummary.read(tmp_path)


def test_next_steps_of_a_saved_run_name_its_folder():
    found = RunSummary(
        (), (), ("Check: `run.save(FOLDER)`, then `jaxlfi diagnose FOLDER`.", "Look: `jaxlfi report FOLDER`.")
    )
    assert found.at("runs/a").next_steps == ("Check: `jaxlfi diagnose runs/a`.", "Look: `jaxlfi report runs/a`.")


def test_a_run_states_what_its_folder_and_page_state(tmp_path):
    run = jaxlfi.infer(jax.random.key(0), gaussian(), np.array([0.8, -0.6], np.float32), settings=SETTINGS)
    found = run.summary()
    draws = np.asarray(run.draws())
    np.testing.assert_allclose([one.median for one in found.parameters], np.median(draws, axis=0), rtol=1e-5)
    folder = run.save(tmp_path / "run")
    found = found.at(FOLDER)
    assert RunSummary.read(folder) == found
    page = render(open_collection(folder), [])
    assert found.to_html() in page and page.index("<h2>Answer</h2>") < page.index("<h2>Results</h2>")
    (folder / NAME).unlink()  # as a folder of earlier versions
    assert "<h2>Answer</h2>" not in render(open_collection(folder), [])
