"""The table `robot` of a task's file, as policies carry it: checked against the model, with units of its signals."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxlfi.envs.mujoco import measured
from jaxlfi.envs.mujoco.model_task import compile_spec, specification
from jaxlfi.rl.preparation import Preparation
from jaxlfi.robots import driving, settings


def carried(table: Mapping[str, Any], model: str | Path, preparation: Preparation) -> dict[str, Any]:
    """A table `robot` with the units of signals that policies do not see.

    Args:
        table: of the file.
        model: of the task.
        preparation: of its policies.

    Raises:
        ValueError: for signals and actuators that the model does not have, and limits that are loosened, in one line.
    """
    found = settings.of_table(table)
    try:
        driving.limits_within(preparation, found)
        driving.terminations_within(preparation, found)
        spec = specification(model)
        measured.add_sensors(spec, found.further)
        compiled = compile_spec(spec)
        measured.places(compiled, found.further)
    except ValueError as error:
        raise ValueError(f"robot: {str(error).removeprefix('measured: ')}") from error
    own = {name: measured.unit(compiled, name).removeprefix("1") for name in found.further}
    known = {one.name for one in preparation.signals}
    return {
        **table,
        "units": {name: unit for name, unit in own.items() if unit and name not in known} | dict(found.units),
    }
