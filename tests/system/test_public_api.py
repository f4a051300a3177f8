"""The names that `jaxlfi` gives, and how each of them is called: what other people's code relies on.

After a change that is meant, `python tests/system/test_public_api.py` writes the record anew.
"""

import dataclasses
import inspect
import json
from pathlib import Path

import jaxlfi

RECORD = Path(__file__).with_suffix(".json")


def signature(value: object) -> str:
    """Parameters by name, kind and whether they can be left out; annotations and defaults are for the reader."""
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):
        return ""
    marks = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
    parts = [marks.get(one.kind, "") + one.name + "=" * (one.default is not one.empty) for one in parameters]
    keywords = [place for place, one in enumerate(parameters) if one.kind is one.KEYWORD_ONLY]
    if keywords:
        parts.insert(keywords[0], "*")
    return f"({', '.join(parts)})"


def members(kind: type) -> dict[str, str]:
    """Public methods and fields of a class of ours, its bases' included."""
    found = (
        dict.fromkeys((field.name for field in dataclasses.fields(kind)), "field")
        if dataclasses.is_dataclass(kind)
        else {}
    )
    for owner in kind.__mro__:
        if owner.__module__.startswith("jaxlfi."):
            for name, value in vars(owner).items():
                callable_ = value.__func__ if isinstance(value, classmethod | staticmethod) else value
                if not name.startswith("_") and name not in found:
                    found[name] = signature(callable_) if callable(callable_) else "value"
    return dict(sorted(found.items()))


def public() -> dict[str, dict[str, str]]:
    """Every public name: its own signature under "", and those of its members."""
    found = {}
    for name in jaxlfi.__all__:
        value = getattr(jaxlfi, name)
        found[name] = {"": signature(value)} | (members(value) if isinstance(value, type) else {})
    plots = {name: value for name, value in vars(jaxlfi.plot).items() if inspect.isfunction(value)}
    found["plot"] = {name: signature(value) for name, value in plots.items() if not name.startswith("_")}
    return found


def test_public_names_are_called_as_they_were():
    """What is new is in nobody's way."""
    now = {(name, member): how for name, found in public().items() for member, how in found.items()}
    recorded = json.loads(RECORD.read_text())
    before = {(name, member): how for name, found in recorded.items() for member, how in found.items()}
    assert {place: now.get(place) for place in before} == before


if __name__ == "__main__":
    RECORD.write_text(json.dumps(public(), indent=1) + "\n")
