"""Export of a finished run as ArviZ InferenceData, for ArviZ's plots and summaries."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.bayessim.keys import key_of
from jaxlfi.io import files as atomic
from jaxlfi.io.workfolder import StoreError
from jaxlfi.runs.folder import read_config
from jaxlfi.runs.load import load


class MissingLibrary(ValueError):
    """A library that an export needs is not installed."""


def to_inference_data(folder: Path | str, n: int = 1000, seed: int = 0) -> Any:
    """A run's posterior, observation and posterior predictive simulations, as `arviz.InferenceData`.

    Groups: `posterior`, n draws in natural units, one variable for each parameter; `observed_data`, the observed
    trajectory; `posterior_predictive`, trajectories that the run simulated from posterior draws at its end (fewer than
    n, and from other draws than those in `posterior`), without failed ones, if there are any.

    Args:
        folder: folder of one finished run.
        n: number of draws.
        seed: seed of the draws.

    Raises:
        MissingLibrary: if ArviZ is not installed.
        ValueError: for a folder that holds no finished run, or fewer than one draw.
    """
    arviz = _arviz()
    run = load(folder)
    draws = np.asarray(run.posterior.sample(key_of(seed), n))
    names, observed = run.space.names, np.asarray(run.observed)
    try:
        seen = atomic.read_arrays(Path(folder) / "observation.npz")
        times, channels = seen["times"], seen["channels"]
    except (ValueError, KeyError) as lacking:
        raise StoreError(f"{folder}: expected a complete run, got: {lacking}") from lacking
    config = read_config(Path(folder))
    dims = ["time", "channel"][: observed.ndim]
    labels = channels if len(channels) == observed.shape[-1] else np.arange(observed.shape[-1])
    coords = {"time": times, "channel": labels}
    groups: dict[str, dict[str, Any]] = {"observed_data": {"trajectory": observed}}
    valid = np.isfinite(run.history["sample_trajectory_error"][-1])
    if valid.any():
        groups["posterior_predictive"] = {"trajectory": run.history["final_trajectory"][valid][None]}
    data = arviz.from_dict(
        posterior={name: draws[None, :, d] for d, name in enumerate(names)},
        dims={"trajectory": dims},
        coords={name: coords[name] for name in dims},
        **groups,
    )
    for name, unit in zip(names, config["units"], strict=True):
        data.posterior[name].attrs["units"] = unit
    origin = {"task": config["task_name"], "configuration": config["configuration"], "seed": str(config["seed"])}
    data.posterior.attrs.update(origin)
    return data


def write_netcdf(path: Path, folder: Path, n: int, seed: int = 0) -> None:
    """Write the result of `to_inference_data` to a netCDF file, whole or not at all.

    Raises:
        MissingLibrary: if ArviZ is not installed.
    """
    part = path.with_name(path.name + ".part")
    try:
        to_inference_data(folder, n, seed).to_netcdf(str(part))
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def _arviz() -> Any:
    try:
        import arviz
    except ImportError as error:
        raise MissingLibrary(
            "InferenceData: expected ArviZ to be installed, found none: pip install 'jaxlfi[arviz]'"
        ) from error
    return arviz
