"""Ranked placements from two raw clouds: superpoints, sampled regions, correspondences, refinement, ranking.

Nothing here sees ground truth. The superpoints are made by `dapdata.cluster`, the one stage that inference shares with
the data engine: a user's own cloud must be partitioned as the training clouds were.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ValidationError

from dapdata import poses
from dapdata.cluster import SuperpointsConfig, means, partition
from dapdata.config import AT_INFERENCE, TrainConfig
from dapdata.errors import CheckpointError, UsageError, hint
from dapdata.records import Placement
from daptrain import affordance, pose, refine
from daptrain.affordance import AffordanceNet
from daptrain.checkpoint import load_network, read_description
from daptrain.fit import ObjectFit
from daptrain.loop import pick_device
from daptrain.pose import PoseNet
from daptrain.prepare import Inputs, crop, one_region, prepare_inputs, region_reach

Array = NDArray[Any]

SMALLEST_CLOUD = 20  # points: no frame can be fitted to fewer
WIDEST_CLOUD = 10.0  # m: no furniture is wider, but a scan in millimetres is


@dataclass(frozen=True)
class Proposal:
    """One candidate on its way: its region and the pose that net 2 gave it."""

    score: Array  # (S,) f4 in [-1, 1], sampled
    T_world_box: Array  # (4, 4) f8, NaN where there is none
    residual: float  # m, how badly net 2's targets agree with a rigid motion; NaN where there is no pose
    status: str  # "ok", "no_region", or why Kabsch gave no pose


@dataclass(frozen=True)
class Predictor:
    """Both networks of a run, ready to place objects."""

    task: str
    method: Literal["dap", "cap"]
    config: TrainConfig
    superpoints: SuperpointsConfig
    eps_place: float  # m, that the scores were labelled with
    affordance: AffordanceNet
    pose: PoseNet
    device: torch.device

    @classmethod
    def load(
        cls, run: str | Path, device: str = "auto", task: str | None = None, changes: Mapping[str, Any] | None = None
    ) -> Predictor:
        """The networks of a run folder.

        Args:
            run: Folder that `train` wrote.
            device: "auto", "cpu", "cuda", ...
            task: Refuse a run that was trained on another task.
            changes: Other values for some of config.AT_INFERENCE, by key.

        Raises:
            CheckpointError: no run, weights of another task or network version, damaged files.
            UsageError: a change of a key that is fixed in training, or to a value that it cannot have.
        """
        run, where = Path(run), pick_device(device)
        description = read_description(run)
        if task is not None and description["task"] != task:
            raise CheckpointError(
                f"{run}: was trained on task {description['task']}, the data are of task {task}; "
                "give the run of this task, or train one"
            )
        try:
            trained = TrainConfig.model_validate(description["train"])
            superpoints = SuperpointsConfig.model_validate(description["recipe"]["superpoints"])
            eps_place = float(description["recipe"]["label"]["eps_place"])
        except (KeyError, TypeError, ValueError) as error:
            raise CheckpointError(f"{run}/config.json: {str(error).splitlines()[0]}; train again with this version") from error
        config = changed(trained, changes or {})
        networks = [load_network(run, name, description, config, where) for name in ("affordance", "pose")]
        first, second = networks
        assert isinstance(first, AffordanceNet)
        assert isinstance(second, PoseNet)
        return cls(description["task"], description["method"], config, superpoints, eps_place, first, second, where)

    def predict(
        self,
        container_points: Array,
        container_normals: Array,
        object_points: Array,
        object_normals: Array,
        k: int,
        rng: np.random.Generator,
        *,
        T_world_object: Array | None = None,
    ) -> list[Placement]:
        """k placements, best first; those that failed come last, with their status.

        Args:
            container_points: (N, 3) observed points of the container and what stands in it, world frame, z up, m.
            container_normals: (N, 3) unit, towards the sensor.
            object_points: (M, 3) observed points of the object where it is now, world frame, m.
            object_normals: (M, 3).
            k: How many candidates are drawn.
            T_world_object: (4, 4) the object's pose now, in whichever frame the caller gives it. Default: the world's
                frame itself, so that a placement is the motion that carries the observed object to its place.

        Raises:
            UsageError: clouds that are too small, not finite, or whose points and normals do not match.
        """
        for name, points, normals in (
            ("container", container_points, container_normals),
            ("object", object_points, object_normals),
        ):
            check_cloud(name, points, normals)
        inputs, box = self.prepare(container_points, container_normals, object_points, object_normals, rng)
        proposals = self.propose(inputs, k, rng)
        T_world_box, scores = self.finish(proposals, container_points, container_normals, box)
        motion = T_world_box @ poses.inverse(inputs.T_world_box)
        start = np.eye(4) if T_world_object is None else T_world_object
        placements = [
            Placement(motion[i] @ start, float(scores[i]), "ok")
            if p.status == "ok"
            else Placement(np.full((4, 4), np.nan), -np.inf, p.status)
            for i, p in enumerate(proposals)
        ]
        return sorted(placements, key=lambda placement: -placement.score)

    def prepare(
        self,
        container_points: Array,
        container_normals: Array,
        object_points: Array,
        object_normals: Array,
        rng: np.random.Generator,
    ) -> tuple[Inputs, ObjectFit]:
        """The clouds as the networks see them, and the fit of the object."""
        label = partition(container_points, container_normals, self.superpoints.count, self.superpoints)
        centres, normals, _ = means(container_points, container_normals, label)
        clouds = (container_points, container_normals, label, centres, normals, object_points, object_normals)
        return prepare_inputs(*clouds, self.config, rng)

    def propose(self, inputs: Inputs, k: int, rng: np.random.Generator, drawn: int = 0) -> list[Proposal]:
        """k candidates, unrefined, in the order drawn: all regions at once, then all poses at once.

        Args:
            inputs: From `prepare`.
            k: How many.
            rng: Of the draws.
            drawn: Candidates of this scene that there are already; these k come after them.
        """
        scores = self.regions(inputs, k, rng, drawn)
        regions = [self._cropped(inputs, score) for score in scores]
        crops = [
            None if region is None else crop(inputs, score, region, self.config.crop_margin, self.config, rng)
            for score, region in zip(scores, regions)
        ]
        found = [i for i, piece in enumerate(crops) if piece is not None]
        proposals = [Proposal(score, np.full((4, 4), np.nan), np.nan, "no_region") for score in scores]
        if found:
            pieces = [piece for piece in crops if piece is not None]
            batch = pose.collate(pieces, np.repeat(inputs.extents[None], len(pieces), axis=0), self.device)
            solved = pose.solve(self.pose, batch)
            for i, piece, solution in zip(found, pieces, solved):
                proposals[i] = replace(
                    proposals[i],
                    T_world_box=inputs.T_world_front @ poses.pose(translation=piece.centre) @ solution.T_crop_box,
                    residual=solution.residual,
                    status=solution.status,
                )
        return proposals

    def regions(self, inputs: Inputs, k: int, rng: np.random.Generator, drawn: int = 0) -> list[Array]:
        """k scores (S,) in [-1, 1]: samples of net 1, or with `cap` what `cap_crop` makes of its one classification.

        Of the peaks, the first `drawn` are left out; where there are no more of them, scores are -1 throughout.
        """
        batch = affordance.collate([inputs], np.zeros(1), np.zeros(1, bool), self.device)
        if self.method == "dap":
            return list(affordance.sample(self.affordance, batch, k, self.config.sample_steps, rng)[0])
        score = affordance.sample(self.affordance, batch, 1, 1, rng)[0, 0]
        if self.config.cap_crop == "whole":
            return [affordance.positives(score)] * k
        reach = region_reach(inputs.extents, self.eps_place)
        if self.config.cap_crop == "peak":
            return affordance.peaks(score, inputs.superpoints, 1, reach) * k
        found = affordance.peaks(score, inputs.superpoints, drawn + k, reach)[drawn:]
        return found + [np.full_like(score, -1.0)] * (k - len(found))

    def _cropped(self, inputs: Inputs, score: Array) -> Array | None:
        """(S,) bool, the superpoints around which net 2's crop is taken for a score; None when it names none."""
        if self.method == "cap" and self.config.cap_crop == "whole":  # over however many modes
            return score > 0 if (score > 0).any() else None
        return one_region(inputs, score, self.eps_place)

    def finish(
        self, proposals: list[Proposal], container_points: Array, container_normals: Array, box: ObjectFit
    ) -> tuple[Array, Array]:
        """(K, 4, 4) T_world_box and (K,) scores, larger is better, after refinement, hover and ranking, as the config says.

        With an empty ranking all scores are equal: the order drawn is kept. Without a pose the score is -inf.

        Args:
            proposals: From `propose`.
            container_points: (N, 3) observed, world frame, m.
            container_normals: (N, 3) unit, towards the sensor.
            box: The object's fit, from `prepare`.
        """
        T_world_box = np.stack([p.T_world_box for p in proposals])
        steps, criteria = self.config.refine, self.config.ranking
        counted = criteria == ["collision"]
        if steps or not counted:
            scene = refine.observed_scene(container_points, container_normals)
            T_world_box = refine.refine(T_world_box, scene, box, steps)
        T_world_box[:, 2, 3] += self.config.hover
        if counted:
            return T_world_box, refine.rank_collision_count(T_world_box, container_points, box)
        residual = np.array([p.residual for p in proposals])
        return T_world_box, refine.rank(T_world_box, scene, box, residual, criteria)


def changed(config: TrainConfig, changes: Mapping[str, Any]) -> TrainConfig:
    """The config of a run with other values for keys that act at inference, checked.

    Raises:
        UsageError: a key that is fixed in training, or a value that it cannot have.
    """
    for name in changes:
        if name not in TrainConfig.model_fields:
            raise UsageError(
                f"train.{name}: is no key, expected one of {', '.join(AT_INFERENCE)}{hint(name, list(AT_INFERENCE))}"
            )
        if name not in AT_INFERENCE:
            raise UsageError(
                f"train.{name}: is fixed in training, expected one of {', '.join(AT_INFERENCE)}, which act at inference; "
                f"train again with it: dapdata train DATASET --set train.{name}=VALUE"
            )
    try:
        return TrainConfig.model_validate(config.model_dump() | dict(changes))
    except ValidationError as error:
        first = error.errors()[0]
        where = "train" + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        if first["type"] == "value_error":
            raise UsageError(f"{where}: {first['ctx']['error']}") from error
        raise UsageError(
            f"{where}: got {first['input']!r}, expected {first['msg'].removeprefix('Input should be ')}; see docs/recipes.md"
        ) from error


def check_cloud(name: str, points: Array, normals: Array) -> None:
    """Refuses a cloud that nothing can be fitted to."""
    if points.ndim != 2 or points.shape[1:] != (3,) or normals.shape != points.shape:
        raise UsageError(f"{name} cloud: got points {points.shape} and normals {normals.shape}, expected both (N, 3)")
    if len(points) < SMALLEST_CLOUD:
        raise UsageError(f"{name} cloud: got {len(points)} points, expected at least {SMALLEST_CLOUD}; is it in sight?")
    if not (np.isfinite(points).all() and np.isfinite(normals).all()):
        raise UsageError(f"{name} cloud: has NaN or infinite numbers, expected finite metres; remove those points")
    if (width := float(np.ptp(points, axis=0).max())) > WIDEST_CLOUD:
        raise UsageError(
            f"{name} cloud: is {width:.0f} m across, expected at most {WIDEST_CLOUD:.0f} m; points are in metres, "
            "are these millimetres?"
        )
