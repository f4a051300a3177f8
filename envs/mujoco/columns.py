"""Columns of a recording: which are controls, and which were measured.

| column | what |
|---|---|
| `motor` | the control of the actuator `motor`; where there is none, what the sensor `motor` measures |
| `actuator/motor`, `sensor/motor` | that of the actuator and that of the sensor, where both have one name |
| `actuator/0`, `sensor/0` | of the first actuator and sensor of the model, which need no name |
| `action/motor`, `observation.state/motor` | the same two of a LeRobot data set, where both have one name |
"""

import dataclasses
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from jaxlfi.envs.mujoco.logs import Log

INDEXED = re.compile(r"(?P<sensor>.+)\[(?P<index>\d+)\]")
ROUNDING = 1e-5
"""How far beyond its range a control counts as at its end, as a fraction of the range: recordings are rounded."""


class ControlWarning(UserWarning):
    """A recorded control does not act as recorded, or may not be a control."""


def sensor_names(names: Sequence[str]) -> list[str]:
    """Names of all sensors: their own, or their numbers."""
    return [name or f"sensor/{i}" for i, name in enumerate(names)]


def control_names(actuators: Sequence[str], sensors: Sequence[str]) -> list[str]:
    """Names of all controls: the actuators' own, or "actuator/" and the name or number where that is ambiguous.

    Args:
        actuators: names of the model's actuators, "" of those without.
        sensors: names of its sensors.

    Example:
        >>> control_names(["hip", "knee", ""], ["hip"])
        ['actuator/hip', 'knee', 'actuator/2']
    """
    return [name if name and name not in sensors else f"actuator/{name or i}" for i, name in enumerate(actuators)]


def controls_of(model: mujoco.MjModel) -> list[str]:
    """Names of a compiled model's controls.

    Raises:
        ValueError: for actuators with several controls, such as one of an orientation.
    """
    require_one_control_each(model)
    return control_names(
        [model.actuator(i).name for i in range(model.nu)], [model.sensor(i).name for i in range(model.nsensor)]
    )


def require_one_control_each(model: mujoco.MjModel) -> None:
    """Refuse actuators with several controls, as actuators and controls would be numbered differently.

    Raises:
        ValueError: naming one.
    """
    for i in range(model.nactuator):
        if (count := int(model.actuator_ctrlnum[i])) != 1:
            name = model.actuator(i).name or str(i)
            raise ValueError(f"model: expected actuators of one control each, got {count} of actuator {name}")


def signal_name(name: str, sensors: Sequence[str]) -> str:
    """The name of a measured signal, without "sensor/" before it unless that is needed.

    Args:
        name: of a column, or as a user gives it.
        sensors: names of the model's sensors, "" of those without.
    """
    match = INDEXED.fullmatch(name)
    own, index = (name, "") if match is None or name in sensors else (match["sensor"], f"[{match['index']}]")
    rest = own.removeprefix("sensor/").removeprefix("observation.state/")
    if own in sensors or rest == own:
        return name
    if rest in sensors:
        return rest + index
    if rest.isdecimal() and int(rest) < len(sensors):
        return sensor_names(sensors)[int(rest)] + index
    return name


def by_signal(given: Mapping[str, Any] | None, sensors: Sequence[str], what: str) -> dict[str, Any]:
    """Values given for signals, by the signals' names (`signal_name`).

    Raises:
        ValueError: for two values of one signal.
    """
    found = {signal_name(name, sensors): value for name, value in (given or {}).items()}
    if len(found) < len(given or {}):
        raise ValueError(f"{what}: expected one of each signal, got {', '.join(given or {})}")
    return found


def arranged(log: Log, actuators: Sequence[str], sensors: Sequence[str]) -> Log:
    """A recording whose columns have the names of controls (`control_names`) and signals (`signal_name`).

    A column whose name an actuator and a sensor share is the control, unless another column is.

    Args:
        log: the recording.
        actuators: names of the model's actuators, "" of those without.
        sensors: names of its sensors.

    Raises:
        ValueError: for two columns of one control or signal, in one line.
    """
    called_as = called(list(log.signals), log.name, actuators, sensors)
    if all(column == own for column, own in called_as.items()):
        return log
    return dataclasses.replace(
        log,
        signals={called_as[column]: values for column, values in log.signals.items()},
        units={called_as.get(column, column): unit for column, unit in log.units.items()},
    )


def called(names: Sequence[str], where: str, actuators: Sequence[str], sensors: Sequence[str]) -> dict[str, str]:
    """Names of controls and signals (`control_names`, `signal_name`) by the names of their columns.

    Args:
        names: of the columns.
        where: source of the columns, for messages.
        actuators: names of the model's actuators, "" of those without.
        sensors: names of its sensors.

    Raises:
        ValueError: for two columns of one control or signal, in one line.
    """
    found: dict[str, str] = {}
    for i, (name, key) in enumerate(zip(actuators, control_names(actuators, sensors), strict=True)):
        explicit = [column for column in (f"actuator/{name}", f"actuator/{i}", f"action/{name}") if column in names]
        plain = [name] if name in names and (name not in sensors or not explicit) else []
        found |= dict.fromkeys([*explicit, *plain], key)
        if name and name in sensors and plain and f"sensor/{name}" not in names:
            warnings.warn(
                f"{where}: {name} is taken as the control of the actuator of that name; call the measurements of the "
                f"sensor of that name sensor/{name}",
                ControlWarning,
                stacklevel=4,
            )
    found |= {column: signal_name(column, sensors) for column in names if column not in found}
    for key in found.values():
        if len(several := [column for column, own in found.items() if own == key]) > 1:
            raise ValueError(f"{where}: expected one column of {key}, got {' and '.join(several)}")
    return found


def require_measured(log: Log, measured: Sequence[str], actuators: Sequence[str]) -> None:
    """Refuse signals for which a recording has only the control of the same name.

    Raises:
        ValueError: naming one, in one line.
    """
    for name in measured:
        if name in actuators and name not in log.signals:
            raise ValueError(
                f"measured: expected a column of {log.name} that the sensor {name} measures, as sensor/{name}; got "
                f"the control of the actuator {name} only"
            )


def warn_of_clamped(log: Log, model: mujoco.MjModel, inferred: Sequence[str] = ()) -> None:
    """Warn how many samples of each control are beyond the actuator's range, where MuJoCo clamps them.

    Args:
        log: a recording with the model's controls.
        model: as compiled.
        inferred: names of the inferred parameters; an inferred range is not checked.
    """
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        return
    for i, name in enumerate(controls_of(model)):
        element = f"actuator/{name.removeprefix('actuator/')}/ctrlrange"
        if (
            name not in log.signals
            or not model.actuator_ctrllimited[i]
            or any(one.startswith(element) for one in inferred)
        ):
            continue
        low, high = model.actuator_ctrlrange[i]
        _, values = log.samples(name)
        beyond = (values < low - ROUNDING * (high - low)) | (values > high + ROUNDING * (high - low))
        if beyond.any():
            warnings.warn(
                f"{log.name}: {name}: {100 * np.mean(beyond):.3g} % of its samples are beyond the actuator's "
                f"ctrlrange, {low:.4g} to {high:.4g}, where MuJoCo clamps them: they go from {values.min():.4g} to "
                f"{values.max():.4g}",
                ControlWarning,
                stacklevel=4,
            )
