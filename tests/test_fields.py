"""Declared fields: values that they refuse, the table of our own fields, and rules of other packages."""

import argparse
import dataclasses
import json
import math
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi import fields, flags
from jaxlfi.bayessim.presets import PRESETS
from jaxlfi.cli import parser as cli
from jaxlfi.cli.own_fields import FIELDS, HELP, POLICIES
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.fields import Checked, hyperparameter, option
from jaxlfi.heuristics import Centre, Choice, Edge, Fixed, Heuristic, Matched, Mode, Truncate
from jaxlfi.heuristics import hyperparameters as rules
from jaxlfi.io.processes import ALONE
from jaxlfi.registry import HEURISTICS, named
from jaxlfi.runs import describe
from tests import own_fields, small

OWN = {"centre": Centre, "edge": Edge, "mode": Mode, "none": Fixed, "truncate": Truncate}


class Everything(Checked):
    """A field of every kind."""

    rate: float = hyperparameter(default=0.1, help="a rate", above=0, below=1)
    norm: float = hyperparameter(default=math.inf, help="a norm", above=0, high=math.inf)
    plain: float = hyperparameter(default=0.0, help="any number")
    count: int = option(default=3, help="how many", low=1)
    fraction: float = option(default=0.0, help="how much", low=0, below=1)
    layers: tuple[int, ...] = option(default=(8,), help="units", low=1)
    kind: str = option(default="a", help="which", choices=("a", "b"))
    word: str = option(default="a", help="anything")
    switch: bool = option(default=True, help="whether")


REFUSED = {
    "at an exclusive limit": ({"rate": 0}, r"rate: expected a number in \(0, 1\), got 0"),
    "at it in single precision": ({"rate": 0.99999999999}, r"rate: expected a number in \(0, 1\), got 0.9+"),
    "not finite": ({"plain": math.inf}, r"plain: expected a number in \(-inf, inf\), got inf"),
    "too large to be finite": ({"plain": 1e39}, r"plain: .*, got 1e\+39"),
    "nan, where infinity is allowed": ({"norm": math.nan}, r"norm: expected a number in \(0, inf\], got nan"),
    "the other infinity": ({"norm": -math.inf}, r"norm: .*, got -inf"),
    "one of an array": ({"rate": np.array([0.5, 2.0])}, r"rate: .*, got \[0.5, 2.0\]"),
    "one of JAX's": ({"rate": jnp.array(2.0)}, r"rate: .*, got 2.0"),
    "a NumPy number": ({"rate": np.float32(2)}, r"rate: .*, got 2.0"),
    "complex": ({"rate": 1j}, r"rate: .*, got 1j"),
    "no whole number": ({"count": 2.5}, r"count: expected a whole number in \[1, inf\), got 2.5"),
    "a truth value": ({"count": True}, r"count: .*, got True"),
    "too few": ({"count": 0}, r"count: .*, got 0"),
    "a wrong element": ({"layers": (8, 0)}, r"layers: expected a whole number in \[1, inf\), got 0"),
    "no tuple": ({"layers": 8}, "layers: expected a tuple, got 8"),
    "no choice": ({"kind": "c"}, "kind: expected one of a, b, got 'c'"),
    "no text": ({"word": 1}, "word: expected text, got 1"),
    "no truth value": ({"switch": 1}, "switch: expected True or False, got 1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_values_are_refused_by_name(case):
    values, message = REFUSED[case]
    with pytest.raises(ValueError, match=f"^{message}$"):
        Everything(**values)


def test_right_values_are_kept_as_they_are():
    values = {"rate": np.float32(0.5), "norm": 10**30, "count": 10**40, "layers": (1, 2), "switch": False}
    assert dataclasses.asdict(Everything(**values)).items() >= values.items()
    assert Everything().replace(fraction=0.25).fraction == 0.25


@pytest.mark.parametrize(
    "leaf",
    [None, object(), True, jax.ShapeDtypeStruct((), jnp.float32), np.array(True), jax.sharding.PartitionSpec()],
)
def test_what_stands_in_a_values_place_is_no_wrong_value(leaf):
    assert Everything(rate=leaf).rate is leaf


def test_traced_values_pass_and_are_leaves():
    made = jax.jit(lambda value: Everything(rate=value, count=5))(7.0)
    assert float(made.rate) == 7.0 and made.count == 5
    assert len(jax.tree.leaves(Everything())) == 3
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(Everything())[0]]
    assert paths == [".rate", ".norm", ".plain"]
    assert jax.tree.structure(Everything()) != jax.tree.structure(Everything(count=4))


def test_flax_leaves_a_checked_class_as_it_is():
    from flax import struct

    assert struct.dataclass(Everything) is Everything


# ------------------------------------------------------------------------------ the table of our own


def test_our_heuristics_are_registered_by_the_names_of_the_paper():
    """After `pip install -e .`, which `make` repeats if pyproject.toml has changed."""
    assert {name: HEURISTICS.load(name) for name in HEURISTICS.names()} == OWN
    assert all(HEURISTICS.name_of(kind) == name for name, kind in OWN.items())


def test_the_table_is_what_our_classes_and_commands_declare():
    """`python -m tests.own_fields` rewrites it."""
    declared = {f"{kind.__module__}:{kind.__qualname__}": fields.declared(kind) for kind in own_fields.kinds()}
    assert {name: list(found.items()) for name, found in FIELDS.items()} == {
        name: list(found.items()) for name, found in declared.items()
    }
    assert own_fields.commands() == HELP
    for name, settings in PRESETS.items():
        of = lambda part: {field: getattr(part, field) for field in fields.declared(part)}
        assert cli.VALUES[name] == of(settings) | of(settings.estimator)
        assert POLICIES[name] == of(own_fields.POLICIES[name])
    assert all(field.info.help for found in FIELDS.values() for field in found.values())


def package(folder, name: str, points: str = "", **modules: str) -> None:
    """A package of these modules on disk, installed by a dist-info folder beside it."""
    (folder / name).mkdir(parents=True)
    for module, text in {"__init__": "", **modules}.items():
        (folder / name / f"{module}.py").write_text(textwrap.dedent(text))
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(textwrap.dedent(points))


@pytest.fixture
def path(tmp_path, monkeypatch):
    """A folder in which packages are found."""
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


# ------------------------------------------------------------------------------ another package's rule

RULE = '''
    """Stretch every bound by its gain."""

    import jax.numpy as jnp

    from jaxlfi.fields import hyperparameter, option
    from jaxlfi.heuristics import Heuristic, adapted, stretch

    class Swell(Heuristic):
        """Both bounds of every parameter move out."""

        gain: float = hyperparameter(default=0.5, help="how far bounds move", symbol="kappa", low=0, high=2)
        expansion: float = hyperparameter(default=0.3, help="another step", symbol="eta", low=0)
        seeds: float = hyperparameter(default=1.0, help="as a flag of the command is called", low=0)
        side: str = option(default="both", help="which bounds", choices=("both", "low"))

        def __call__(self, previous, posterior, feasible):
            left = jnp.ones_like(previous.support.low, bool)
            right = left if self.side == "both" else ~left
            support = stretch(previous.support, feasible, left, right, self.gain)
            return adapted(previous, posterior, support, evidence={})
'''
POINTS = "[jaxlfi.heuristics]\nswell = swelling.rule:Swell\n"


@pytest.fixture
def swelling(path):
    """A package that adds a heuristic in one file."""
    package(path, "swelling", POINTS, rule=RULE)
    return path


def run_help(folder, *words: str, imported: bool) -> str:
    """The output of `--help` in a new process, which must import jax only with the class of a named package."""
    script = (
        "import atexit, sys; heavy = {'jax', 'numpy', 'swelling'}; "
        "atexit.register(lambda: print('imported:', sorted(name for name in sys.modules if name in heavy))); "
        f"sys.path.insert(0, {str(folder)!r}); import jaxlfi.cli.parser as c; c.main(sys.argv[1:])"
    )
    done = subprocess.run([sys.executable, "-c", script, *words, "--help"], capture_output=True, text=True, check=True)
    *shown, last = done.stdout.splitlines()
    assert last == f"imported: {['jax', 'numpy', 'swelling'] if imported else []}"
    return " ".join(" ".join(shown).split())


def test_help_lists_the_flags_of_a_packages_heuristic_that_is_named(swelling):
    text = run_help(swelling, "infer", imported=False)
    assert "--gain" not in text and "none, swell, truncate, or your own as module:Class" in text
    assert "--expansion X [X ...] edge, mode: how far" in text
    text = run_help(swelling, "infer", "--heuristic", "swell", imported=True)
    assert "--gain X [X ...] swell: how far bounds move (kappa; [0, 2]; default: 0.5)" in text
    assert "gain kappa, how far bounds move" in text
    assert "--side NAME swell: which bounds (both, low; default: both)" in text
    assert "edge, mode: how far a bound moves, as a fraction of the support's width; swell: another step (eta; " in text
    assert "default: 0.2 (edge), 0.2 (mode), 0.3 (swell)" in text
    assert "--hyperparameter-seeds X [X ...] swell: as a flag of the command is called" in text


def test_flags_of_a_class_that_is_not_registered_are_found_by_its_name(path):
    package(path, "swelling", rule=RULE)
    assert "swelling.rule:Swell: how far bounds move" in run_help(
        path, "grid", "--heuristic=swelling.rule:Swell", imported=True
    )
    named = run_help(path, "compare", "--configurations", "ok+swelling.rule:Swell", imported=True)
    assert "how far bounds move" in named


@pytest.mark.parametrize(
    "words", ["infer --heuristic nowhere:Rule", "grid --heuristic", "compare --configurations x+y"]
)
def test_help_is_shown_whatever_is_named(words):
    with pytest.raises(SystemExit) as stop:
        cli.main([words.split()[0], "--help", *words.split()[1:]])
    assert stop.value.code == 0


def test_jax_is_started_once_where_a_package_is_imported_for_its_flags(swelling, monkeypatch):
    joins = []
    monkeypatch.setattr(cli.multi_process, "join", lambda arguments: joins.append(arguments) or ALONE)
    arguments = cli.parse("infer x --heuristic swell --gain 0.25 --no-cache --out x".split())
    cli.prepare_jax(arguments)
    assert len(joins) == 1 and arguments.joined is ALONE
    with pytest.raises(SystemExit):
        cli.parse("infer x --heuristic edge --gian 0.25 --out x".split())
    assert len(joins) == 1


def test_arguments_reach_the_rule(swelling):
    words = "infer x --heuristic swell --gain 0.25 1.5 --hyperparameter-seeds 3 --side low --seeds 2 --out x".split()
    arguments = cli.parse(words)
    assert arguments.seeds == 2
    rule = rules.build(HEURISTICS.load(arguments.heuristic), arguments.hyperparameters, dim=2)
    np.testing.assert_array_equal(rule.gain, np.float32([0.25, 1.5]))
    assert (rule.seeds, rule.side, rule.expansion) == (3.0, "low", 0.3)
    assert cli.parse(["infer", "x", "--out", "x"]).hyperparameters == {}


def test_a_package_that_cannot_be_imported_is_named_where_its_flags_are_used(path):
    package(path, "broken", "[jaxlfi.heuristics]\nbroken = broken.rule:Rule\n", rule=RULE)
    words = ["infer", "x", "--gain", "0.25", "--heuristic", "broken", "--out", "x"]
    with pytest.raises(ValueError, match="'Rule'"):
        cli.parse(words)
    (path / "broken" / "rule.py").write_text(textwrap.dedent(RULE.replace("Swell", "Rule")))
    del sys.modules["broken.rule"]
    assert cli.parse(words).hyperparameters == {"gain": [0.25]}


def test_flags_read_values_of_the_type_of_the_default():
    parser = argparse.ArgumentParser()
    families = {"everything": fields.declared(Everything)}
    flags.add(parser.add_argument_group("all"), families, into="settings")
    words = "--rate 0.5 --norm inf --count 5 --layers 3 4 --no-switch --kind b --word no --fraction 0".split()
    given = parser.parse_args(words).settings
    expected = Everything(
        rate=0.5, norm=math.inf, count=5, layers=(3, 4), switch=False, kind="b", word="no", fraction=0.0
    )  # fmt: skip
    assert identical(Everything(**given | {"layers": tuple(given["layers"])}), expected)
    assert "everything: whether (default: yes)" in " ".join(parser.format_help().split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("infer x --tail 1 --gain 1 --heuristic swell --out x", "tail: expected a hyperparameter of swell"),
        ("infer x --gain 3 --heuristic swell --out x", r"gain: expected a number in \[0, 2\], got 3"),
        ("infer x --side up --heuristic swell --out x", "side: expected one of both, low, got 'up'"),
        ("infer x --gain 1 1 1 --heuristic swell --out x", "gain: expected one finite number or 2"),
    ],
)
def test_wrong_arguments_are_refused(swelling, words, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        arguments = cli.parse(words.split())
        kind = HEURISTICS.load(arguments.heuristic)
        rules.refuse_foreign(arguments.hyperparameters, {arguments.heuristic: kind})
        rules.build(kind, arguments.hyperparameters, dim=2)


BAD_REFERENCES = {
    "unknown": ("x", r"heuristic: expected one of \['centre', 'edge', .*\] or module:Class, got 'x'"),
    "no module": ("nowhere.at_all:X", "heuristic: cannot load 'nowhere.at_all:X': ModuleNotFoundError"),
    "no attribute": ("jaxlfi.heuristics:X", "heuristic: cannot load 'jaxlfi.heuristics:X': AttributeError"),
    "no class": ("os:getcwd", "heuristic: expected 'os:getcwd' to be a class derived from Heuristic"),
    "another class": ("jaxlfi:Support", "heuristic: expected 'jaxlfi:Support' to be a class derived from Heuristic"),
    "an abstract class": ("jaxlfi:Heuristic", "heuristic: expected 'jaxlfi:Heuristic' to be a class derived"),
    "a wrapper": (
        "jaxlfi:Matched",
        "heuristic: 'jaxlfi.heuristics.matching:Matched' cannot be made",
    ),
}


@pytest.mark.parametrize("case", BAD_REFERENCES)
def test_bad_references_are_one_line(case):
    reference, message = BAD_REFERENCES[case]
    with pytest.raises(ValueError, match=f"^{message}") as caught:
        rules.build(HEURISTICS.load(reference), {}, dim=2)
    assert "\n" not in str(caught.value)


def test_what_is_no_heuristic_is_refused():
    for wrong, shown in ((Edge, "the class Edge"), ("edge", "'edge'"), (lambda *_: None, "<function")):
        with pytest.raises(ValueError, match=rf"^heuristic: expected an instance such as jaxlfi.Edge\(\), got {shown}"):
            rules.check(wrong, 2)
    for leaf in (np.ones(3), jnp.ones((2, 2))):
        with pytest.raises(ValueError, match="scalars or 2 values, got shape"):
            rules.check(Matched(Edge(expansion=leaf)), 2)
    negative = jax.tree.map(lambda leaf: -leaf, Choice(0, (Fixed(), Edge())))
    with pytest.raises(ValueError, match="zone_fraction: expected a number"):
        rules.check(negative, 2)


def test_hyperparameters_are_seen_and_replaced_through_wrappers():
    rule = Choice(1, (Edge(), Matched(Mode()), Fixed()))
    assert set(rules.all_declared(rule)) == {*rules.all_declared(Edge), *rules.all_declared(Mode)}
    edge, matched, fixed = rules.replaced(rule, {"expansion": 0.7, "proximity": 0.9}).rules
    assert (edge.expansion, matched.rule.expansion, matched.rule.proximity, edge.tail) == (0.7, 0.7, 0.9, 1.0)
    assert fixed is rule.rules[2] or fixed == Fixed()
    with pytest.raises(ValueError, match=r"^gain: expected a hyperparameter of "):
        rules.replaced(rule, {"gain": 1.0})
    with pytest.raises(ValueError, match=r"^proximity: expected a number"):
        rules.replaced(rule, {"proximity": 2.0})


# ------------------------------------------------------------------------------ described and read back


class Nested(Heuristic):
    """A rule with fields of every kind that can be saved."""

    inner: dict[str, Heuristic]
    box: Support
    level: float = hyperparameter(default=math.inf, help="level", high=math.inf)
    weights: np.ndarray = hyperparameter(default=1.0, help="weights")
    counts: np.ndarray = hyperparameter(default=1, help="counts")
    words: tuple = option(default=("nan", "inf"), help="words")
    switch: bool = option(default=False, help="switch")
    number: int = option(default=1, help="number")

    def __call__(self, previous, posterior, feasible):
        """Never called: only the fields are read."""


def identical(a, b) -> bool:
    """Whether values, types and precision are the same."""
    if isinstance(a, np.ndarray | jax.Array) and np.ndim(a):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, np.generic | jax.Array):
        return float(a) == float(b)
    if dataclasses.is_dataclass(a):
        parts = [(getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a)]
        return type(a) is type(b) and all(identical(*pair) for pair in parts)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(identical(a[name], b[name]) for name in a)
    if isinstance(a, tuple):
        return type(b) is tuple and len(a) == len(b) and all(map(identical, a, b))
    return type(a) is type(b) and a == b


DESCRIBED = {
    "none": Fixed(),
    "edge": Edge(expansion=np.array([0.1, 1 / 3], np.float32)),
    "matched": Matched(Mode(proximity=0.3)),
    "choice": Choice(1, (Edge(tail=0), Matched(Mode()), Centre())),
    "a number of JAX": Edge(mass_threshold=jnp.float32(0.1)),
    "nested": Nested(
        {"a": Edge(), "b": Choice(0, (Truncate(0.25),))},
        Support([0.0], [1 / 3]),
        weights=np.array([0.5, 0.1]),
        counts=np.array([1, 2], np.int32),
        switch=True,
        number=10**20,
    ),
}


@pytest.mark.parametrize("name", DESCRIBED)
def test_any_heuristic_survives_its_description(name):
    text = json.dumps(describe.heuristic_to_json(DESCRIBED[name]), allow_nan=False)
    assert identical(DESCRIBED[name], describe.heuristic_from_json(json.loads(text)))


def test_a_description_is_by_registered_names():
    described = describe.heuristic_to_json(Choice(0, (Edge(), Fixed())))
    assert described["name"] == "jaxlfi.heuristics.choice:Choice"
    assert [rule["name"] for rule in described["hyperparameters"]["rules"]] == ["edge", "none"]
    assert described["hyperparameters"]["rules"][0]["hyperparameters"]["mass_threshold"] == 0.12


def test_edge_described_before_its_threshold_rose_has_the_same_one_for_all_posteriors():
    described = describe.heuristic_to_json(Choice(0, (Matched(Edge()), Fixed())))
    edge = described["hyperparameters"]["rules"][0]["hyperparameters"]["rule"]["hyperparameters"]
    assert edge.pop("uninformed_factor") == 2.5
    assert identical(
        describe.heuristic_from_json(described), Choice(0, (Matched(Edge(uninformed_factor=1.0)), Fixed()))
    )


def test_another_packages_rule_survives_its_description(swelling):
    rule = Matched(rules.build(HEURISTICS.load("swell"), {"gain": [0.25, 0.5], "side": "low"}, dim=2))
    described = json.loads(json.dumps(describe.heuristic_to_json(rule)))
    assert described["hyperparameters"]["rule"]["name"] == "swell"
    assert identical(describe.heuristic_from_json(described), rule)


BAD_DESCRIPTIONS = {
    "an old one": {"name": "edge", "matched": False, "hyperparameters": {}},
    "not installed": {"name": "gone", "hyperparameters": {}},
    "no heuristic": {"name": "jaxlfi.estimators.mixture_network:MixtureNetwork", "hyperparameters": {}},
    "unknown values": {"name": "edge", "hyperparameters": {"gain": 1}},
    "wrong values": {"name": "edge", "hyperparameters": {"tail": 2}},
    "missing values": {"name": "jaxlfi.heuristics.matching:Matched", "hyperparameters": {}},
    "text": "edge",
}


@pytest.mark.parametrize("case", BAD_DESCRIPTIONS)
def test_descriptions_of_nothing_that_is_here_are_refused(case):
    with pytest.raises(ValueError, match=r"expected|cannot be made") as caught:
        describe.heuristic_from_json(BAD_DESCRIPTIONS[case])
    assert "\n" not in str(caught.value)


def test_what_cannot_be_written_is_refused_by_name():
    with pytest.raises(ValueError, match=r"^level: expected a value that can be written as JSON, got a function"):
        describe.heuristic_to_json(dataclasses.replace(DESCRIBED["nested"], level=lambda: None))


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_hold_their_estimator_by_name(preset):
    described = json.loads(json.dumps(describe.settings_to_json(PRESETS[preset]), allow_nan=False))
    assert described["estimator"]["name"] == "mdn"
    assert identical(describe.settings_from_json(described), PRESETS[preset])
    assert set(described["estimator"]["hyperparameters"]) == {
        field.name for field in dataclasses.fields(MixtureNetwork)
    }


def test_name_of_a_class_leads_back_to_it():
    assert named("class", HEURISTICS.name_of(jaxlfi.Support)) is jaxlfi.Support


@pytest.mark.slow
def test_a_run_with_a_choice_is_saved_and_says_what_it_was_run_with(tmp_path):
    rule = Choice(1, (Edge(), Matched(Mode(expansion=np.array([0.1, 0.3], np.float32))), Truncate()))
    settings = small.settings(rounds=1, predictive=False)
    run = jaxlfi.infer(jax.random.key(0), small.gaussian(), heuristic=rule, settings=settings)
    config = json.loads((run.save(tmp_path / "run") / "config.json").read_text())
    assert identical(describe.heuristic_from_json(config["heuristic"]), rule)
    assert identical(describe.settings_from_json(config["settings"]), settings)
