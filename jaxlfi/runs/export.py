"""Export: a finished run as ArviZ InferenceData, for its plots and summaries."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.io import files as atomic
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.load import posterior_samples, read_run


class MissingLibrary(ValueError):
    """A library that an export needs and that is not installed."""


def to_inference_data(folder: Path | str, n: int = 1000, seed: int = 0) -> Any:
    """A run's posterior, its observation and what the posterior simulates, as `arviz.InferenceData`.

    Groups: `posterior`, n draws in natural units, a variable for each parameter; `observed_data`, the observed
    trajectory; `posterior_predictive`, trajectories of the posterior draws that the run itself simulated at its end
    (fewer than n, and other draws than those of `posterior`), without the failed ones.

    Args:
        folder: of one finished run.
        n: number of draws.
        seed: of the draws.

    Raises:
        MissingLibrary: where ArviZ is not installed.
        ValueError: for a folder that holds no finished run, or fewer than one draw.
    """
    arviz = _arviz()
    folder = Path(folder)
    draws, names, _ = posterior_samples(folder, n, seed)
    config = read_run(folder).config
    try:
        seen = atomic.read_arrays(folder / "observation.npz")
        history = atomic.read_arrays(folder / "history.npz")
        observed, times, channels = seen["trajectory"], seen["times"], seen["channels"]
        simulated, error = history["final_trajectory"], history["sample_trajectory_error"][-1]
    except (ValueError, KeyError) as lacking:
        raise run_store.StoreError(f"{folder}: expected a whole run, got: {lacking}") from lacking
    dims = ["time", "channel"][: observed.ndim]
    labels = channels if len(channels) == observed.shape[-1] else np.arange(observed.shape[-1])
    coords = {"time": times, "channel": labels}
    data = arviz.from_dict(
        posterior={name: draws[None, :, d] for d, name in enumerate(names)},
        observed_data={"trajectory": observed},
        posterior_predictive={"trajectory": simulated[np.isfinite(error)][None]},
        dims={"trajectory": dims},
        coords={name: coords[name] for name in dims},
    )
    for name, unit in zip(names, config["units"], strict=True):
        data.posterior[name].attrs["units"] = unit
    told = {"task": config["task"], "configuration": config["configuration"] or "", "seed": str(config["seed"])}
    data.posterior.attrs.update(told)
    return data


def write_netcdf(path: Path, folder: Path, n: int, seed: int = 0) -> None:
    """Write what `to_inference_data` makes of a run to a netCDF file, whole or not at all.

    Raises:
        MissingLibrary: where ArviZ is not installed.
    """
    beside = path.with_name(path.name + ".part")
    try:
        to_inference_data(folder, n, seed).to_netcdf(str(beside))
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def _arviz() -> Any:
    try:
        import arviz
    except ImportError as error:
        raise MissingLibrary(
            "InferenceData: expected ArviZ to be installed, found none: pip install 'jaxlfi[arviz]'"
        ) from error
    return arviz
