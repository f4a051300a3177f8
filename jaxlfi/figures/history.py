"""History: the saved arrays of one inference run, as the figures use them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.figures import density, statistics
from jaxlfi.io import files

AXES = {
    "theta": ("rounds", "simulations", "parameters"),
    "logits": ("rounds", "components"),
    "counted": ("rounds", "simulations"),
    "kept": ("rounds", "simulations"),
    "failure": ("rounds", "simulations"),
    "proposal_low": ("rounds", "parameters"),
    "proposal_high": ("rounds", "parameters"),
    "support_low": ("rounds", "parameters"),
    "support_high": ("rounds", "parameters"),
    "means": ("rounds", "components", "parameters"),
    "scale_tril": ("rounds", "components", "parameters", "parameters"),
}
"""Arrays of history.npz that a run must have to be drawn, and their axes."""
OPTIONAL_AXES = {
    "sample_theta_error": ("rounds", "samples", "parameters"),
    "sample_trajectory_error": ("rounds", "samples"),
    "attempted": ("rounds",),
    "failed": ("rounds", "reasons"),
    "seconds": ("rounds",),
}
"""Arrays that a run may lack, and their axes; the numbers of samples and of reasons are free."""
NUMBERS = (
    *AXES, *OPTIONAL_AXES, "loss", "validation_loss", "final_trajectory", "final_x", "trajectory", "times", "x",
    "truth", "round", "draws", "log",
)  # fmt: skip
"""Arrays of a run's files that figures compute with, which must be numeric. Other arrays may be texts."""


@dataclasses.dataclass(frozen=True)
class History:
    """One run; R rounds of A simulations, D parameters, K components, E networks, P epochs, N posterior samples.

    Parameters are in inference space. Data that a run lacks (a truth, simulations from the posterior) are NaN or None.
    """

    folder: Path  # folder it was read from
    configuration: str  # name of the run's configuration, "misspecified+edge"
    seed: int
    config: Mapping[str, Any]  # config.json
    names: tuple[str, ...]  # names of the parameters in inference space, "ln k" for a logarithm
    units: tuple[str, ...]  # units of the parameters
    theta: np.ndarray  # proposals, [R, A, D]
    counted: np.ndarray  # simulations up to the last one needed, [R, A]
    kept: np.ndarray  # whether each was added to the dataset, [R, A]
    failure: np.ndarray  # 0, or the code of the reason for failure, [R, A]
    proposal_low: np.ndarray  # bounds of the support that each round drew from, [R, D]
    proposal_high: np.ndarray
    support_low: np.ndarray  # bounds after each round's adaptation, [R, D]
    support_high: np.ndarray
    logits: np.ndarray  # posterior mixture of each round, [R, K]
    means: np.ndarray  # its means, [R, K, D]
    scale_tril: np.ndarray  # its Cholesky factors, [R, K, D, D]
    loss: np.ndarray | None  # training loss of each epoch, [R, E, P]
    validation_loss: np.ndarray | None  # the same on held-out simulations
    theta_error: np.ndarray | None  # |theta - theta_gt| of posterior samples after each round, [R, N, D]
    trajectory_error: np.ndarray | None  # distance of their trajectories from the observed one, [R, N]; NaN: failed
    attempted: np.ndarray  # number of simulations of each round, [R]
    failed: np.ndarray  # number of failures of each round, [R]
    seconds: np.ndarray  # duration of each round, [R]
    final_trajectory: np.ndarray | None  # simulations of the last posterior's samples, [N, T, C]
    final_x: np.ndarray | None  # their summaries, [N, S]; NaN: failed
    draws: np.ndarray | None  # draws of the last posterior, [n, D]
    observed: np.ndarray | None  # the observed trajectory, [T, C]
    x: np.ndarray | None  # its summary, [S]
    x_scale: np.ndarray | None  # standard deviations of the first round's summaries, [S] (`robust_sd`)
    summaries: tuple[str, ...]  # names of the summary's elements
    truth: np.ndarray  # theta_gt, [D], NaN where unknown
    times: np.ndarray | None  # times of the observed trajectory's rows, [T]
    record_label: str  # name of the trajectory's row axis, "time"
    channels: tuple[str, ...]  # names of the trajectory's columns
    channel_noise: np.ndarray  # standard deviations of their measurement noise, [C]; 0 where unknown
    feasible_low: np.ndarray | None  # limits Phi, [D]
    feasible_high: np.ndarray | None
    polished: bool = False  # whether `draws` are from a polished posterior, stored beside the unpolished one

    @property
    def rounds(self) -> int:
        """Number of rounds R."""
        return self.theta.shape[0]

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        return self.theta.shape[-1]

    @property
    def weighted_means(self) -> np.ndarray:
        """Weighted mean of each round's mixture, shape [R, D]."""
        return density.weighted_mean(self.logits, self.means)

    @property
    def accumulated_means(self) -> np.ndarray:
        """Mean parameters of all simulations kept up to each round, shape [R, D]; NaN before the first one."""
        kept = self.kept[..., None]
        total = np.cumsum(np.where(kept, self.theta, 0.0).sum(1), axis=0)
        count = np.cumsum(self.kept.sum(1))[:, None]
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    @property
    def supports(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds from Theta_0 to the last adaptation, two arrays of shape [R + 1, D]."""
        low = np.concatenate([self.proposal_low[:1], self.support_low])
        return low, np.concatenate([self.proposal_high[:1], self.support_high])

    @property
    def adapts(self) -> bool:
        """Whether any bound moved."""
        return any(not np.allclose(bound, bound[:1]) for bound in self.supports)

    @property
    def predictions(self) -> np.ndarray | None:
        """Simulations of the last posterior's samples that did not fail, shape [n, T, C], or None."""
        if self.final_trajectory is None:
            return None
        valid = np.isfinite(self.final_trajectory).all((1, 2))
        if self.trajectory_error is not None and self.trajectory_error.shape[1] == len(valid):
            valid &= np.isfinite(self.trajectory_error[-1])
        return self.final_trajectory[valid] if valid.any() else None

    @property
    def measured_widths(self) -> str | None:
        """The verdict of the diagnostics in the run's folder on its widths, in words; None without diagnostics."""
        try:
            return str(files.read_json(self.folder / "diagnostics" / "diagnostics.json")["line"])
        except (ValueError, KeyError, TypeError):
            return None

    @property
    def final_theta_error(self) -> float:
        """Last round's |theta - theta_gt|, summed over parameters and averaged over samples."""
        return float("nan") if self.theta_error is None else float(self.theta_error[-1].sum(-1).mean())

    @property
    def final_trajectory_error(self) -> float:
        """Last round's distance from the observed trajectory, averaged over samples that did not fail."""
        return float("nan") if self.trajectory_error is None else float(statistics.mean(self.trajectory_error[-1]))

    @property
    def success_rate(self) -> float:
        """Fraction of all simulations that did not fail."""
        attempted = self.attempted.sum()
        return float(1 - self.failed.sum() / attempted) if attempted else float("nan")


def load(folder: Path | str, configuration: str | None = None) -> History:
    """Read one run's folder.

    Args:
        folder: folder with config.json of format "jaxlfi-run" and history.npz; observation.npz, posterior.npz and
            dataset.npz are read if they exist.
        configuration: name of the run's configuration; by default that in config.json, or else made from support and
            heuristic.

    Raises:
        ValueError: for a folder that is missing, of another kind or damaged.
    """
    folder = Path(folder)
    config = read_config(folder)
    if config["format"] != "jaxlfi-run":
        raise ValueError(f"{folder}: expected config.json of format 'jaxlfi-run', got {config['format']!r}")
    arrays = read_arrays(folder / "history.npz", tuple(AXES), NUMBERS)
    others = [folder / f"{name}.npz" for name in ("observation", "posterior", "dataset")]
    observation, posterior, dataset = (read_arrays(path, numbers=NUMBERS) if path.exists() else {} for path in others)
    _check_shapes(folder / "history.npz", arrays)
    rounds, _, dim = arrays["theta"].shape
    trajectory = _trajectory(observation.get("trajectory"))
    times = _times(observation.get("times"), trajectory)
    columns = 0 if trajectory is None else trajectory.shape[1]
    x = observation.get("x")
    if x is not None and x.ndim != 1:
        raise ValueError(f"{folder / 'observation.npz'}: expected x of one dimension, got shape {x.shape}")
    obs = 0 if x is None else len(x)
    counted, failure = arrays["counted"].astype(bool), arrays["failure"]
    return History(
        folder=folder,
        configuration=configuration or _configuration(config),
        seed=config["seed"] if isinstance(config.get("seed"), int) else 0,
        config=config,
        names=_texts(observation.get("names"), config.get("names"), dim, "theta {}"),
        units=_texts(None, config.get("units"), dim, ""),
        counted=counted,
        kept=arrays["kept"].astype(bool),
        failure=failure,
        loss=_optional(arrays, "loss"),
        validation_loss=_optional(arrays, "validation_loss"),
        theta_error=_optional(arrays, "sample_theta_error"),
        trajectory_error=_optional(arrays, "sample_trajectory_error"),
        attempted=np.asarray(arrays.get("attempted", counted.sum(1))),
        failed=_failed(arrays, counted, failure),
        seconds=np.broadcast_to(np.asarray(arrays.get("seconds", np.nan), float), (rounds,)),
        final_trajectory=_samples(_optional(arrays, "final_trajectory")),
        final_x=_rows(_optional(arrays, "final_x"), obs),
        draws=_in_inference_space(folder / "posterior.npz", posterior, dim),
        observed=trajectory,
        x=x,
        x_scale=_x_scale(dataset, obs),
        summaries=_texts(observation.get("summaries"), None, obs, "x_{}"),
        truth=_vector(observation.get("truth"), dim),
        times=times,
        record_label=_record_label(observation, times),
        channels=_texts(observation.get("channels"), None, columns, "x{}"),
        channel_noise=np.nan_to_num(_vector(observation.get("channel_noise"), columns)),
        feasible_low=_limits(config, "low", dim),
        feasible_high=_limits(config, "high", dim),
        polished="unpolished_logits" in posterior,
        **{name: arrays[name] for name in AXES if name not in ("counted", "kept", "failure")},
    )


def read_config(folder: Path) -> dict[str, Any]:
    """config.json of a folder, with its "format".

    Raises:
        ValueError: if it is missing, or was not written by jaxlfi.
    """
    path = folder / "config.json"
    if not path.is_file():
        raise ValueError(f"{folder}: expected a folder with config.json, as `jaxlfi infer --out` writes, found none")
    config = files.read_json(path)
    if not isinstance(config, dict) or not isinstance(config.get("format"), str):
        raise ValueError(f"{path}: expected a JSON object with a 'format' that starts with 'jaxlfi-'")
    return config


def read_arrays(path: Path, required: Sequence[str] = (), numbers: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """All arrays of an npz file.

    Args:
        path: path of the file.
        required: names of arrays that it must have.
        numbers: names of arrays that must not be texts if they exist.

    Raises:
        ValueError: if it is missing, damaged, lacks a required array or has texts in place of numbers.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected the file, found none (has the run ended a round?)")
    arrays = files.read_arrays(path)
    if texts := [name for name in numbers if name in arrays and arrays[name].dtype.kind in "SU"]:
        raise ValueError(f"{path}: expected numbers, got texts as {', '.join(texts)}")
    if missing := [name for name in required if name not in arrays]:
        raise ValueError(f"{path}: expected the arrays {', '.join(required)}; missing {', '.join(missing)}")
    return arrays


def robust_sd(x: np.ndarray) -> np.ndarray:
    """Half the distance from the 16th to the 84th percentile of each column, the standard deviation for a normal one.

    Args:
        x: values, shape [N, S], N >= 1.
    """
    low, high = np.quantile(x, [0.16, 0.84], axis=0)
    return (high - low) / 2


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Refuse arrays that disagree in the number of rounds, simulations, parameters or components."""
    if arrays["theta"].ndim != 3 or arrays["logits"].ndim != 2 or arrays["theta"].shape[0] < 1:
        raise ValueError(
            f"{path}: expected theta [rounds, simulations, parameters] and logits [rounds, components] of at "
            f"least one round, got {arrays['theta'].shape} and {arrays['logits'].shape}"
        )
    lengths = dict(zip(AXES["theta"], arrays["theta"].shape, strict=True)) | {"components": arrays["logits"].shape[1]}
    for name, axes in (AXES | OPTIONAL_AXES).items():
        expected = tuple(lengths.get(axis, axis) for axis in axes)
        got = arrays[name].shape if name in arrays else expected
        if len(got) != len(axes) or any(lengths.get(axis, own) != own for axis, own in zip(axes, got, strict=True)):
            raise ValueError(f"{path}: expected {name} of shape {expected}, got {got}".replace("'", ""))
    for name in ("proposal", "support"):
        low, high = arrays[f"{name}_low"], arrays[f"{name}_high"]
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()):
            raise ValueError(f"{path}: expected finite bounds with {name}_low below {name}_high, got others")


def _optional(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray | None:
    """The array of that name if it has any finite value, or else None."""
    array = arrays.get(name)
    return array if array is not None and array.size and np.isfinite(array).any() else None


def _failed(arrays: Mapping[str, np.ndarray], counted: np.ndarray, failure: np.ndarray) -> np.ndarray:
    if "failed" not in arrays:
        return (counted & (failure != 0)).sum(1)
    return np.asarray(arrays["failed"]).reshape(counted.shape[0], -1).sum(1)


def _trajectory(array: np.ndarray | None) -> np.ndarray | None:
    """A trajectory as [T, C]."""
    return None if array is None or not array.size else np.asarray(array, float).reshape(array.shape[0], -1)


def _samples(array: np.ndarray | None) -> np.ndarray | None:
    """Trajectories as [N, T, C]."""
    return None if array is None or array.ndim < 2 else array.reshape(*array.shape[:2], -1)


def _rows(array: np.ndarray | None, columns: int) -> np.ndarray | None:
    """Vectors as [N, columns], or None."""
    return array if array is not None and array.ndim == 2 and array.shape[1] == columns and len(array) else None


def _x_scale(dataset: Mapping[str, np.ndarray], obs: int) -> np.ndarray | None:
    """Standard deviations of the summaries of the first round that has any."""
    if not {"x", "round"} <= dataset.keys() or not dataset["round"].size or dataset["round"].ndim != 1:
        return None
    if dataset["x"].shape != (dataset["round"].size, obs):
        return None
    return robust_sd(dataset["x"][dataset["round"] == dataset["round"].min()])


def _in_inference_space(path: Path, posterior: Mapping[str, np.ndarray], dim: int) -> np.ndarray | None:
    """The draws in posterior.npz: natural units in the file, logarithms where its `log` is true."""
    draws, log = _rows(posterior.get("draws"), dim), posterior.get("log", np.zeros(dim, bool))
    if log.shape != (dim,):
        raise ValueError(f"{path}: expected log of shape {(dim,)}, got {log.shape}")
    if draws is None or not log.any():
        return draws
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(log, np.log(np.where(log, draws, 1.0)), draws)


def _record_label(observation: Mapping[str, np.ndarray], times: np.ndarray | None) -> str:
    """The saved label, or else "time", or "record" if the times are row numbers."""
    if "record_label" in observation:
        return str(observation["record_label"])
    return "record" if times is None or np.array_equal(times, np.arange(len(times))) else "time"


def _times(array: np.ndarray | None, trajectory: np.ndarray | None) -> np.ndarray | None:
    if trajectory is None:
        return None
    return array if array is not None and array.shape == trajectory.shape[:1] else np.arange(len(trajectory))


def _texts(first: Any, second: Any, length: int, default: str) -> tuple[str, ...]:
    """The first of two lists of texts that has the right length, or numbered defaults."""
    for given in (first, second):
        texts = given.tolist() if isinstance(given, np.ndarray) else given
        if isinstance(texts, list) and len(texts) == length and length:
            return tuple(str(text) for text in texts)
    return tuple(default.format(i + 1) for i in range(length))


def _vector(values: np.ndarray | None, length: int) -> np.ndarray:
    """The values as a vector of this length; NaN if they are missing or have another shape."""
    return np.asarray(values if values is not None and values.shape == (length,) else np.full(length, np.nan), float)


def _limits(config: Mapping[str, Any], side: str, dim: int) -> np.ndarray | None:
    limits = config.get(f"feasible_{side}")
    try:
        array = np.asarray([] if limits is None else limits, float)
    except (ValueError, TypeError) as error:
        raise ValueError(f"feasible_{side}: expected {dim} numbers in config.json, got {limits!r}") from error
    return array if array.shape == (dim,) else None


def heuristic_name(description: Any) -> str:
    """The name of a heuristic in config.json; for a wrapped one, the name of the rule inside."""
    inner = description.get("hyperparameters") if isinstance(description, Mapping) else None
    if isinstance(inner, Mapping) and isinstance(inner.get("rule"), Mapping):
        return heuristic_name(inner["rule"])
    return _name(description, "none")


def _name(value: Any, default: str) -> str:
    """A name given as text or as {"name": ...}."""
    if isinstance(value, Mapping):
        value = value.get("name")
    return value if isinstance(value, str) and value else default


def _configuration(config: Mapping[str, Any]) -> str:
    if isinstance(config.get("configuration"), str) and config["configuration"]:
        return config["configuration"]
    support, heuristic = _name(config.get("support"), "support"), heuristic_name(config.get("heuristic"))
    return support if heuristic in ("none", "fixed") else f"{support}+{heuristic}"
