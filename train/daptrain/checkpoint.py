"""A run folder: what was trained on what, weights, state to resume. Safetensors and JSON, nothing is ever unpickled.

- `config.json`: task, dataset, recipe, train config, versions; written first.
- `<net>.safetensors`: the averaged weights that did best on the val split: what inference loads.
- `<net>.last.safetensors`: the averaged weights at the end.
- `<net>.state.safetensors`: weights, their average and AdamW's moments, to resume.
- `metrics.jsonl`, `curves.png`.

Every file is written beside its name, fsynced and renamed, so that a killed run leaves the old one or the new one.
A run may come from anywhere: shapes are compared with the network's before anything is allocated.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor

from dapdata import durable
from dapdata.config import AT_INFERENCE, TrainConfig
from dapdata.errors import CheckpointError, DapdataError, UsageError
from daptrain.affordance import AffordanceNet
from daptrain.pose import PoseNet

Net = AffordanceNet | PoseNet
NetName = Literal["affordance", "pose"]
Method = Literal["dap", "cap"]

FORMAT = "dapdata-run-1"
CONFIG = "config.json"
MAX_CONFIG = 10_000_000  # bytes
MOMENTS = ("exp_avg", "exp_avg_sq")  # of AdamW
SHORT = {torch.float32: "F32", torch.float64: "F64", torch.int64: "I64", torch.bool: "BOOL"}  # types in safetensors' words
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


PROGRESS = TypeAdapter(Progress)


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


def check_run(run: Path, description: dict[str, Any]) -> None:
    """Refuses a folder that holds something else than a run which was trained on the same. Writes nothing.

    Raises:
        CheckpointError: the folder holds another run; the message says what differs.
        UsageError: it holds no run.
    """
    if (run / CONFIG).exists():
        there = read_description(run)
        for what in ("task", "method", "networks", "dataset"):
            if there[what] != description[what]:
                raise CheckpointError(
                    f"{run}: was trained with {what} {there[what]}, now it is {description[what]}; "
                    "give another folder with --run, or delete this one"
                )
        for key, value in description["train"].items():
            if key not in FREE_KEYS and there["train"].get(key) != value:
                raise CheckpointError(
                    f"{run}: was trained with train.{key} {there['train'].get(key)}, now it is {value}; "
                    "give another folder with --run, or delete this one"
                )
    elif durable.is_occupied(run):
        raise UsageError(f"{run}: is there and is no run, expected an empty or a new folder; give another one with --run")


def start_run(run: Path, description: dict[str, Any]) -> None:
    """Makes the run folder, or makes sure that the one that is there was trained on the same; raises as `check_run`."""
    check_run(run, description)
    write_whole(run / CONFIG, (json.dumps(description, indent=2) + "\n").encode())


def read_description(run: Path) -> dict[str, Any]:
    """config.json of a run.

    Raises:
        CheckpointError: no run, or one of another format.
    """
    path = run / CONFIG
    try:
        description = durable.read_json(path, MAX_CONFIG)
        found = description.get("format") if isinstance(description, dict) else None
        if found != FORMAT:
            raise CheckpointError(f"{path}: got format {found!r:.80}, expected '{FORMAT}'; train again with this version")
        for name, kind in {"task": str, "dataset": str, "networks": dict, "train": dict, "recipe": dict}.items():
            if not isinstance(description.get(name), kind):
                raise ValueError(f"{name}: got {type(description.get(name)).__name__}, expected {kind.__name__}")
        if description.get("method") not in get_args(Method):
            raise ValueError(f"method: got {description.get('method')!r:.80}, expected one of {', '.join(get_args(Method))}")
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{run}: no config.json in there, expected a run folder; train one first with `dapdata train`"
        ) from error
    except (OSError, ValueError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{path}: {error}, expected JSON as `dapdata train` writes it; train again") from error
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
    with opened(path) as (file, metadata):
        wanted = {"network": name, "version": NETS[name].version, "task": description["task"], "method": description["method"]}
        for key, value in wanted.items():
            if metadata.get(key) != value:
                raise CheckpointError(
                    f"{path}: has weights of {key} '{str(metadata.get(key))[:80]}', expected '{value}'; train again"
                )
        with torch.device("meta"):  # a config may ask for any width: nothing is allocated before the file has as many numbers
            outline = NETS[name](config, description["method"])
        check_shapes(file, outline.state_dict(), path)
        network = NETS[name](config, description["method"])
        load_tensors_into(network, {key: file.get_tensor(key) for key in file.keys()}, path)  # noqa: SIM118
    return network.to(device).eval()


def check_shapes(file: Any, expected: Mapping[str, Tensor], path: Path) -> None:
    """Refuses a safetensors file with other names, other shapes or other types than expected; reads its header alone."""
    shapes = {key: (tuple(value.shape), SHORT[value.dtype]) for key, value in expected.items()}
    pieces = {key: file.get_slice(key) for key in file.keys()}  # noqa: SIM118
    found = {key: (tuple(piece.get_shape()), piece.get_dtype()) for key, piece in pieces.items()}
    if wrong := sorted(key for key in shapes.keys() | found.keys() if shapes.get(key) != found.get(key)):
        key = wrong[0]
        raise CheckpointError(
            f"{path}: {key[:80]} has shape {_words(found.get(key))}, this network's config expects {_words(shapes.get(key))}"
            f" ({len(wrong)} of {len(shapes)} arrays differ); train again"
        )


def _words(shape: tuple[tuple[int, ...], str] | None) -> str:
    return "none" if shape is None else f"{shape[0]} of {shape[1]}"


def load_tensors_into(network: Net, tensors: dict[str, Tensor], path: Path) -> None:
    """Sets a network's weights, which have its shapes; refuses numbers that are not finite."""
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
    with opened(path) as (file, metadata):
        found = (metadata.get("network"), metadata.get("version"))
        if found != (expected := (network.name, network.version)):
            raise CheckpointError(
                f"{path}: has the state of {found!r:.80}, expected {expected}; give another folder with --run"
            )
        progress = _progress(metadata, path)
        # There are no moments before the first step that counted.
        has_moments = any(key.startswith("optimizer/") for key in file.keys())  # noqa: SIM118
        check_shapes(file, _outline(network, has_moments), path)
        weights = {key: file.get_tensor(f"weights/{key}") for key in network.state_dict()}
        load_tensors_into(network, weights, path)
        for key, value in network.named_parameters():
            average[key].copy_(file.get_tensor(f"average/{key}"))
            if has_moments:
                optimizer.state[value] = {
                    moment: file.get_tensor(f"optimizer/{key}/{moment}").to("cpu" if moment == "step" else value.device)
                    for moment in ("step", *MOMENTS)
                }
    return progress


def _outline(network: Net, has_moments: bool) -> dict[str, Tensor]:
    """Every array of a network's state, by name: only their shapes and types mean something."""
    arrays = {f"weights/{key}": value for key, value in network.state_dict().items()}
    for key, value in network.named_parameters():
        arrays[f"average/{key}"] = value
        if has_moments:
            arrays |= {f"optimizer/{key}/{moment}": value for moment in MOMENTS}
            arrays[f"optimizer/{key}/step"] = torch.zeros(())
    return arrays


def _progress(metadata: Mapping[str, Any], path: Path) -> Progress:
    """Where a state stands, as its metadata say."""
    try:
        return PROGRESS.validate_python(metadata["progress"])
    except (KeyError, ValidationError) as error:
        raise CheckpointError(f"{path}: has no progress, expected a state written by this version; delete the run") from error


def packed(tensors: dict[str, Tensor], metadata: dict[str, Any]) -> bytes:
    """A safetensors file, the same bytes for the same content: the format keeps several metadata entries in no order."""
    return bytes(to_bytes(tensors, {"dapdata": json.dumps(metadata, sort_keys=True)}))


def is_spent(run: Path, name: str, steps: int | None, minutes: float | None) -> bool:
    """Whether a network was trained already with a budget like this or a larger one."""
    path = run / f"{name}.state.safetensors"
    if not path.exists() or not (run / f"{name}.last.safetensors").exists():
        return False
    with opened(path) as (_, metadata):
        progress = _progress(metadata, path)
    return (steps is not None and progress.step >= steps) or (minutes is not None and progress.minutes >= minutes)


@contextmanager
def opened(path: Path) -> Iterator[tuple[Any, dict[str, Any]]]:
    """A safetensors file that `packed` made, and its metadata.

    Raises:
        CheckpointError: if it is none, also when an array cannot be read from it.
    """
    try:
        if not path.is_file():
            raise ValueError("no plain file")
        with safe_open(path, framework="pt") as file:
            yield file, dict(json.loads((file.metadata() or {}).get("dapdata", "{}")))
    except (SafetensorError, OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        if isinstance(error, DapdataError):
            raise
        raise CheckpointError(
            f"{path}: {str(error)[:160]!r}, expected safetensors as `dapdata train` writes them; train again"
        ) from error


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file beside its name, fsyncs it and renames it: others see the old content or the new.

    Raises:
        EnvironmentProblem: if the disk is full; what was there before still is.
    """
    with durable.disk_problems(path.parent, len(content)):
        durable.replace_file(path, content)
