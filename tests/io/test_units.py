"""Units as people write them, against their definitions."""

import numpy as np
import pytest

from jaxlfi.io.units import looks_like, parse

DEGREE = np.pi / 180


@pytest.mark.parametrize(
    ("texts", "factor", "name"),
    [
        (("rad", "radians", "Rad"), 1.0, "rad"),
        (("deg", "°", "º", "degrees", "Deg", "DEGREES"), DEGREE, "rad"),
        (("rev", "turns", "revolutions"), 2 * np.pi, "rad"),
        (("mrad", "milliradians"), 1e-3, "rad"),
        (("deg/s", "°/s", "deg/sec", "deg s^-1", "deg·s⁻¹", "degrees per second", "dps"), DEGREE, "rad/s"),
        (("rpm", "RPM", "rev/min", "r/min"), 2 * np.pi / 60, "rad/s"),
        (("m/s^2", "m/s2", "m/s²", "m s-2", "m/s/s", "m.s-2", "m/(s^2)"), 1.0, "m/s^2"),
        (("g",), 9.80665, "m/s^2"),
        (("mm", "millimetres", "millimeter"), 1e-3, "m"),
        (("cm",), 1e-2, "m"),
        (("µm", "μm", "um"), 1e-6, "m"),
        (("in", "inches"), 0.0254, "m"),
        (("km/h",), 1 / 3.6, "m/s"),
        (("N m", "Nm", "N*m", "N·m", "N-m", "kg m^2/s^2"), 1.0, "N m"),
        (("mN m", "mNm", "Nmm", "mN-m"), 1e-3, "N m"),
        (("Ncm", "N cm"), 1e-2, "N m"),
        (("kN",), 1e3, "N"),
        (("kgf",), 9.80665, "N"),
        (("g cm^2",), 1e-7, "kg m^2"),
        (("s", "sec", "seconds"), 1.0, "s"),
        (("ms", "msec", "milliseconds"), 1e-3, "s"),
        (("us", "µs", "usec", "microseconds"), 1e-6, "s"),
        (("ns", "nsec"), 1e-9, "s"),
        (("min", "minutes"), 60.0, "s"),
        (("h", "hours"), 3600.0, "s"),
        (("mV",), 1e-3, "V"),
        (("kg m^2/A/s^3",), 1.0, "kg m^2/A s^3"),
        (("counts", "ticks"), 1.0, "count"),
        (("%", "percent"), 0.01, "1"),
        (("1", "rad/rad"), 1.0, "1"),
        (("", "-", "none"), 1.0, ""),
    ],
)
def test_units_are_converted_however_they_are_written(texts, factor, name):
    for text in texts:
        unit = parse(text)
        assert unit.name == name, text
        np.testing.assert_allclose(unit.factor, factor, rtol=1e-12, err_msg=text)
        assert unit.offset == 0 and parse(unit.name) == (1.0, unit.name, 0.0)


def test_temperatures_begin_elsewhere():
    for text, freezing in (("°C", 0.0), ("degC", 0.0), ("deg F", 32.0), ("K", 273.15)):
        unit = parse(text)
        np.testing.assert_allclose(unit.factor * freezing + unit.offset, 273.15)
        assert unit.name == "K"


@pytest.mark.parametrize("text", ["furlong", "S", "left", "m/", "/s", "m^", "rad_s", "--", "MS", "deg]"])
def test_what_is_no_unit_is_one_line(text):
    with pytest.raises(ValueError, match="expected a unit such as rad, deg/s, mm, N m or ms, got") as caught:
        parse(text)
    assert "\n" not in str(caught.value)


def test_what_a_number_of_seconds_looks_like():
    assert [looks_like(0.01 / size, 0.02) for size in (1, 1e-3, 1e-6, 1e-9, 60)] == ["s", "ms", "us", "ns", "min"]
