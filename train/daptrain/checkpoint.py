"""A run folder: what was trained on what, weights, state to resume. Safetensors and JSON, nothing is ever unpickled.

- `config.json`: task, dataset, recipe, train config, versions; written first.
- `<net>.safetensors`: the averaged weights that did best on the val split: what inference loads.
- `<net>.last.safetensors`: the averaged weights at the end.
- `<net>.state.safetensors`: weights, their average and AdamW's moments, to resume.
- `metrics.jsonl`, `curves.png`.

Every file is written beside its name, fsynced and renamed, so that a killed run leaves the old one or the new one.
"""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor

from dapdata.config import AT_INFERENCE, TrainConfig
from dapdata.errors import CheckpointError, UsageError
from daptrain.affordance import AffordanceNet
from daptrain.pose import PoseNet

Net = AffordanceNet | PoseNet
NetName = Literal["affordance", "pose"]
Method = Literal["dap", "cap"]

FORMAT = "dapdata-run-1"
NETS: dict[str, type[AffordanceNet] | type[PoseNet]] = {"affordance": AffordanceNet, "pose": PoseNet}
WORST = -1e9  # score before the first validation
# Keys that do not change what is learned: a run may go on, or be used, with other values.
FREE_KEYS = {"preset", "minutes", "affordance_share", *AT_INFERENCE} - {"crop_margin"}


@dataclass
class Progress:
    """Where the training of one network stands; saved with its state."""

    step: int = 0
    seconds: float = 0.0  # wall clock of all sessions
    best: float = WORST
    best_step: int = 0
    minutes: float = 0.0  # largest budget of minutes that was used up


def describe(
    data: str, task: str, digest: str, recipe: dict[str, Any], config: TrainConfig, method: str, device: str
) -> dict[str, Any]:
    """What config.json says of a run; `data` is where the dataset lay, `dataset` its digest."""
    return {
        "format": FORMAT,
        "task": task,
        "method": method,
        "networks": {name: network.version for name, network in NETS.items()},
        "dataset": digest,
        "data": data,
        "train": config.model_dump(mode="json"),
        "recipe": recipe,
        "device": device,
        "versions": {
            "python": platform.python_version(),
            **{package: version(package) for package in ("torch", "numpy", "safetensors")},
        },
    }


def start_run(run: Path, description: dict[str, Any]) -> None:
    """Makes the run folder, or makes sure that the one that is there was trained on the same.

    Raises:
        CheckpointError: the folder holds another run; the message says what differs.
    """
    if (run / "config.json").exists():
        there = read_description(run)
        for what in ("task", "method", "networks", "dataset"):
            if there.get(what) != description[what]:
                raise CheckpointError(
                    f"{run}: was trained with {what} {there.get(what)}, now it is {description[what]}; "
                    "give another folder with --run, or delete this one"
                )
        before = there.get("train", {})
        for key, value in description["train"].items():
            if key not in FREE_KEYS and before.get(key) != value:
                raise CheckpointError(
                    f"{run}: was trained with train.{key} {before.get(key)}, now it is {value}; "
                    "give another folder with --run, or delete this one"
                )
    elif run.is_file() or (run.is_dir() and any(run.iterdir())):
        raise UsageError(f"{run}: is there and is no run, expected an empty or a new folder; give another one with --run")
    run.mkdir(parents=True, exist_ok=True)
    write_whole(run / "config.json", (json.dumps(description, indent=2) + "\n").encode())


def read_description(run: Path) -> dict[str, Any]:
    """config.json of a run.

    Raises:
        CheckpointError: no run, or one of another format.
    """
    try:
        description = json.loads((run / "config.json").read_bytes())
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{run}: no config.json in there, expected a run folder; train one first with `dapdata train`"
        ) from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{run}/config.json: {error}, expected JSON as `dapdata train` writes it") from error
    found = description.get("format") if isinstance(description, dict) else None
    if found != FORMAT:
        raise CheckpointError(f"{run}/config.json: got format {found!r}, expected '{FORMAT}'; train again with this version")
    return dict(description)


def save_weights(path: Path, network: Net, task: str) -> None:
    """Writes a network's weights with the task and the network they belong to."""
    metadata = {"network": network.name, "version": network.version, "task": task, "method": network.method}
    tensors = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    write_whole(path, packed(tensors, metadata))


def load_network(run: Path, name: str, description: dict[str, Any], config: TrainConfig, device: torch.device) -> Net:
    """A network with the best weights of a run.

    Raises:
        CheckpointError: no weights, or those of another network, task or shape.
    """
    path = run / f"{name}.safetensors"
    if not path.exists():
        raise CheckpointError(f"{path}: not there; train it first: dapdata train --run {run} --net {name}")
    tensors, metadata = read_tensors(path)
    network = NETS[name](config, description["method"])
    wanted = {"network": name, "version": network.version, "task": description["task"], "method": network.method}
    for key, value in wanted.items():
        if metadata.get(key) != value:
            raise CheckpointError(f"{path}: has weights of {key} '{metadata.get(key)}', expected '{value}'; train again")
    load_tensors_into(network, tensors, path)
    return network.to(device).eval()


def load_tensors_into(network: Net, tensors: dict[str, Tensor], path: Path) -> None:
    """Sets a network's weights; refuses other names, other shapes and numbers that are not finite."""
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    found = {key: tuple(value.shape) for key, value in tensors.items()}
    if wrong := sorted(key for key in expected.keys() | found.keys() if expected.get(key) != found.get(key)):
        key = wrong[0]
        raise CheckpointError(
            f"{path}: {key} has shape {found.get(key)}, this network's config expects {expected.get(key)}"
            f" ({len(wrong)} of {len(expected)} arrays differ); train again"
        )
    if bad := [key for key, value in tensors.items() if not value.isfinite().all()]:
        raise CheckpointError(f"{path}: {bad[0]} has numbers that are not finite; train again")
    network.load_state_dict(tensors)


def save_state(
    run: Path, network: Net, optimizer: torch.optim.Optimizer, average: dict[str, Tensor], progress: Progress
) -> None:
    """Writes all that is needed to resume as one file."""
    tensors = {f"weights/{key}": value.detach() for key, value in network.state_dict().items()}
    tensors |= {f"average/{key}": value for key, value in average.items()}
    for key, value in network.named_parameters():
        tensors |= {f"optimizer/{key}/{moment}": x for moment, x in optimizer.state[value].items()}
    metadata = {"network": network.name, "version": network.version, "progress": asdict(progress)}
    content = packed({key: value.cpu().contiguous() for key, value in tensors.items()}, metadata)
    write_whole(run / f"{network.name}.state.safetensors", content)


def load_state(run: Path, network: Net, optimizer: torch.optim.Optimizer, average: dict[str, Tensor]) -> Progress:
    """Sets everything to where `save_state` left it; a fresh Progress when there is nothing to resume.

    Raises:
        CheckpointError: the state is damaged or of another network.
    """
    path = run / f"{network.name}.state.safetensors"
    if not path.exists():
        return Progress()
    tensors, metadata = read_tensors(path)
    if (found := (metadata.get("network"), metadata.get("version"))) != (expected := (network.name, network.version)):
        raise CheckpointError(f"{path}: has the state of {found}, expected {expected}; give another folder with --run")
    try:
        progress = Progress(**metadata["progress"])
        weights = {key.removeprefix("weights/"): x for key, x in tensors.items() if key.startswith("weights/")}
        load_tensors_into(network, weights, path)
        has_moments = any(key.startswith("optimizer/") for key in tensors)  # none before the first step that counted
        for key, value in network.named_parameters():
            average[key].copy_(tensors[f"average/{key}"])
            if not has_moments:
                continue
            optimizer.state[value] = {
                moment: tensors[f"optimizer/{key}/{moment}"].to("cpu" if moment == "step" else value.device)
                for moment in ("step", "exp_avg", "exp_avg_sq")
            }
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{path}: {error!r}, expected a state written by this version; delete the run folder") from error
    return progress


def packed(tensors: dict[str, Tensor], metadata: dict[str, Any]) -> bytes:
    """A safetensors file, the same bytes for the same content: the format keeps several metadata entries in no order."""
    return bytes(to_bytes(tensors, {"dapdata": json.dumps(metadata, sort_keys=True)}))


def is_spent(run: Path, name: str, steps: int | None, minutes: float | None) -> bool:
    """Whether a network was trained already with a budget like this or a larger one."""
    path = run / f"{name}.state.safetensors"
    if not path.exists() or not (run / f"{name}.last.safetensors").exists():
        return False
    progress = Progress(**read_tensors(path)[1].get("progress", {}))
    return (steps is not None and progress.step >= steps) or (minutes is not None and progress.minutes >= minutes)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """All arrays and the metadata of a safetensors file that `packed` made."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = json.loads((file.metadata() or {}).get("dapdata", "{}"))
            return {key: file.get_tensor(key) for key in file.keys()}, dict(metadata)  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        raise CheckpointError(f"{path}: {error}, expected safetensors as `dapdata train` writes them; train again") from error


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file beside its name, fsyncs it and renames it: others see the old content or the new."""
    beside = path.with_name(path.name + ".part")
    with beside.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
