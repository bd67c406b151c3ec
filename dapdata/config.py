"""Strict recipe sections: the base class of all, and the sections whose stage lives outside of `dapdata`'s spine.

A section is a frozen pydantic model in which unknown keys are errors and every key has a default, a unit, a
range and a sentence. Each stage's section stands above the stage that uses it; `recipe.py` puts them together.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator


class Section(BaseModel):
    """Base of every recipe section: unknown keys, NaN and infinity are refused, values cannot be changed later."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True, strict=True)


class SceneConfig(Section):
    """Base of a task's parameters: `class Params(SceneConfig)` with `task: Literal["<module name>"]`."""

    stages: ClassVar[str] = "dapdata.pipeline"  # module that holds STAGES, what makes a dataset of such scenes
    remedy: ClassVar[str] = "change cameras, noise or superpoints in the recipe"  # when all demos are rejected
    task: str = Field(description="name of a task, see `dapdata init`")


def key(default: Any, description: str, *, unit: str = "", **limits: Any) -> Any:
    """A recipe key: its default, its sentence, its unit, and limits such as ge, le, gt, lt, min_length."""
    extra: Any = {"unit": unit} if unit else None
    return Field(default=default, description=f"{description}{f' [{unit}]' if unit else ''}", json_schema_extra=extra, **limits)


Number = TypeVar("Number", int, float)


def _pair(value: Any) -> Any:
    """YAML and JSON know lists only."""
    return tuple(value) if isinstance(value, list) else value


def _ordered(ends: tuple[Number, Number]) -> tuple[Number, Number]:
    """The two ends, or an error if the first is the larger one."""
    if ends[0] > ends[1]:
        raise ValueError(f"got [{ends[0]}, {ends[1]}], expected [lowest, highest]")
    return ends


# Ranges [lowest, highest] that a value is drawn from, both ends included.
_Length = Annotated[float, Field(ge=0, le=2)]
_Size = Annotated[float, Field(ge=0.001, le=2)]
_Factor = Annotated[float, Field(ge=0, le=10)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Signed = Annotated[float, Field(ge=-10, le=10)]
_Count = Annotated[int, Field(ge=0, le=1000)]
_PositiveCount = Annotated[int, Field(ge=1, le=20)]
_Degrees = Annotated[float, Field(ge=-180, le=180)]
LengthRange = Annotated[tuple[_Length, _Length], BeforeValidator(_pair), AfterValidator(_ordered)]
SizeRange = Annotated[tuple[_Size, _Size], BeforeValidator(_pair), AfterValidator(_ordered)]
FactorRange = Annotated[tuple[_Factor, _Factor], BeforeValidator(_pair), AfterValidator(_ordered)]
ShareRange = Annotated[tuple[_Share, _Share], BeforeValidator(_pair), AfterValidator(_ordered)]
CoordinateRange = Annotated[tuple[_Signed, _Signed], BeforeValidator(_pair), AfterValidator(_ordered)]
CountRange = Annotated[tuple[_Count, _Count], BeforeValidator(_pair), AfterValidator(_ordered)]
PositiveCountRange = Annotated[tuple[_PositiveCount, _PositiveCount], BeforeValidator(_pair), AfterValidator(_ordered)]
DegreesRange = Annotated[tuple[_Degrees, _Degrees], BeforeValidator(_pair), AfterValidator(_ordered)]


class RpdiffConfig(SceneConfig):
    """Demos in RPDiff's layout, that are read instead of drawn."""

    stages: ClassVar[str] = "dapdata.imports"
    remedy: ClassVar[str] = "docs/import_rpdiff.md tells what is behind each reason"
    task: Literal["rpdiff"] = "rpdiff"
    source: str = key("", "file or folder of the demos, as it was named when they were imported")
    source_sha256: str = key("", "of the names, sizes and checksums of all that its files hold; another one is refused")
    meshes: str | None = key(None, "folder of the meshes and slots; null: none, so that nothing can be settled or judged")
    meshes_sha256: str | None = key(None, "of the names and contents of its files")
    table_height: float = key(1.0, "z of the table top in the source; it becomes z = 0", unit="m", ge=-10, le=10)
    opening: Literal["auto", "+x", "-x", "+y", "-y", "+z"] = key(
        "auto",
        "axis of the container's frame out of its opening; auto: +x, or +z if the demonstrated goal is reached from there",
    )
    hanging: Literal["auto", "yes", "no"] = key(
        "auto", "whether objects hang, on pegs along which they come; auto: by the name of the container, such as rack or hook"
    )
    symmetry: Literal["auto", "none", "box", "revolution"] = key(
        "auto", "of the objects; auto: by the shape of the mesh, or without one by the name: books are boxes, cans are round"
    )
    max_tilt_deg: float | None = key(
        None, "largest angle from upright that counts as placed; null: 15, or any for objects without symmetry", ge=0, le=180
    )
    drop_seconds: float = key(
        1.5, "physics after which a commanded pose or a slot is a candidate, as in the source", unit="s", ge=0.1, le=10
    )
    half_pixel: bool = key(
        True, "clouds that were projected from the corners of their pixels are moved to the centres; off: left as they are"
    )


class ScansConfig(SceneConfig):
    """Demonstrations that were scanned before and after, that are read instead of drawn."""

    stages: ClassVar[str] = "dapdata.imports"
    remedy: ClassVar[str] = "docs/import_scans.md tells what is behind each reason"
    task: Literal["scans"] = "scans"
    source: str = key("", "folder of the demonstrations, as it was named when they were imported")
    source_sha256: str = key("", "of the names, sizes and samples of its files; another one is refused")
    min_explained: float = key(
        0.9, "share of the object's points after that its points before must explain, moved; larger: fewer, surer", ge=0.1, le=1
    )
    min_overlap: float = key(
        0.4, "share of the object's points before that its points after must explain; larger: fewer, surer", ge=0.05, le=1
    )
    min_container: float = key(0.7, "share of the container's points after that those before must explain", ge=0.1, le=1)
    align: bool = key(True, "camera poses are corrected where views overlap; needs K of cameras and the view of each point")
    check_table: bool = key(True, "a cloud whose foot is much wider than all above is refused: it holds the table")


IMPORTED: dict[str, type[SceneConfig]] = {"rpdiff": RpdiffConfig, "scans": ScansConfig}  # by what takes a task's place


class SplitConfig(Section):
    """How demos are shared out; by container and object instance, so that no instance is in two splits."""

    val: float = key(0.1, "share of the demos on which choices are made", ge=0, le=0.5)
    test: float = key(0.1, "share of the demos that are looked at once; 1: a benchmark's scenes, none to train on", ge=0, le=1)

    @model_validator(mode="after")
    def check_shares(self) -> SplitConfig:
        """No demo is in two splits."""
        if self.val + self.test > 1:
            raise ValueError(f"test: got {self.test} beside val {self.val}, expected no more than 1 together; lower one")
        return self


# What `preset: paper` changes: the method as published, on the same networks. A key written in the recipe wins.
PAPER: dict[str, Any] = {
    "goals": "demonstrated",
    "prediction": "eps",
    "score_radii": [],
    "object_condition": False,
    "residual": False,
    "sample_steps": 100,
    "cap_crop": "whole",
    "refine": [],
    "ranking": ["collision"],
}

# Keys that inference reads: `dapdata eval --set train.KEY=VALUE` changes them without training again. Only `crop_margin`
# acts in training as well, with anything from none of it to twice as much.
AT_INFERENCE = ("sample_steps", "crop_margin", "cap_crop", "refine", "hover", "ranking")
FAST = {"sample_steps": 3}  # of `dapdata eval --fast`: a fifth of the time, for some success (docs/accuracy.md)

# STEPS and CRITERIA of daptrain.refine, which must not be imported here; a test compares them.
Step = Literal["gravity", "yaw", "settle", "search", "spread"]
Criterion = Literal["inside", "path", "support", "balance", "residual"]


class TrainConfig(Section):
    """The two networks and how they are trained."""

    preset: Literal["default", "paper"] = key(
        "default", "`paper`: eps prediction of one goal per demo, no refinement, ranking by collision count, as published"
    )
    minutes: float = key(30.0, "wall-clock budget of both networks together", unit="min", gt=0, le=100_000)
    demos: int | None = key(None, "train on the first so many demos of the train split; null: on all", ge=1, le=10_000_000)
    seed: int | None = key(
        None, "of the first weights and of all draws in training; null: the recipe's `seed`", ge=0, le=2**32 - 1
    )
    affordance_share: float = key(
        0.5,
        "share of the minutes that net 1 gets where the networks are trained one after the other (GPU, single core)",
        gt=0,
        lt=1,
    )
    goals: Literal["all", "demonstrated"] = key("all", "`all`: every valid goal is a target, not only the demonstrated one")
    yaw: Literal["front", "any"] = key(
        "front", "`front`: containers are turned to face one way, by fitted geometry; `any`: trained at every yaw instead"
    )
    yaw_jitter_deg: float = key(3.0, "containers are turned by up to this in training (front only)", unit="deg", ge=0, le=45)
    mirror: bool = key(True, "net 1 also trains on mirror images of the containers")
    prediction: Literal["x0", "eps"] = key("x0", "net 1 predicts the clean score (cross-entropy) or the noise (squared error)")
    score_radii: list[float] = key(
        [0.04, 0.08, 0.14], "net 1 also sees the noisy score smoothed over these radii", unit="m", max_length=8
    )
    object_condition: bool = key(True, "net 1 sees the object's extents, an extension of the paper's p(score | container)")
    diffusion_steps: int = key(100, "T, steps of the diffusion", ge=2, le=10_000)
    sample_steps: int = key(20, "steps of the sampler, at most T", ge=1, le=10_000)
    width: int = key(64, "channels of net 1's tokens", ge=8, le=2048)
    point_width: int = key(48, "channels of net 1's backbone", ge=8, le=2048)
    pose_width: int = key(48, "channels of net 2", ge=8, le=2048)
    layers: int = key(2, "Point-DiT blocks of net 1, attention blocks of net 2", ge=1, le=64)
    point_layers: int = key(2, "backbone blocks", ge=1, le=64)
    heads: int = key(2, "attention heads of a Point-DiT block; must divide width", ge=1, le=64)
    groups: int = key(6, "channel groups of vector attention; must divide point_width and pose_width", ge=1, le=64)
    neighbours: int = key(16, "points that a point attends to within its cloud", ge=2, le=256)
    cross_neighbours: int = key(16, "points that a point attends to in the other cloud", ge=2, le=1024)
    container_points: int = key(4096, "raw points kept of a container", ge=64, le=1_000_000)
    crop_points: int = key(192, "raw points that net 2 sees around a region", ge=16, le=100_000)
    object_points: int = key(96, "points that net 2 sees of an object", ge=16, le=100_000)
    crop_margin: float = key(0.03, "space around the region that is cropped along", unit="m", ge=0, le=1)
    eps_corr: float = key(
        0.02, "raw points closer than this to the placed object correspond; finer than label.eps_corr", unit="m", gt=0, le=0.2
    )
    residual: bool = key(True, "net 2 also predicts where each object point ends up, an extension of the paper")
    residual_weight: float = key(1.0, "weight of that prediction's loss", ge=0, le=1000)
    scenes_per_step: int = key(4, "scenes in a training step of net 1", ge=1, le=4096)
    levels_per_scene: int = key(4, "noise levels that each of them is trained at, for one encoding", ge=1, le=4096)
    crops_per_step: int = key(8, "crops in a training step of net 2", ge=1, le=4096)
    learning_rate: float = key(2e-3, "peak of the cosine schedule", gt=0, le=1)
    warmup_steps: int = key(50, "steps of linear warm-up", ge=0, le=1_000_000)
    weight_decay: float = key(0.01, "of AdamW", ge=0, le=10)
    clip: float = key(1.0, "largest norm of a gradient", gt=0, le=1e6)
    ema: float = key(0.998, "decay of the averaged weights, which are the ones that are kept", ge=0, lt=1)
    validate_every: int = key(200, "steps between validations", ge=1, le=10_000_000)
    cap_crop: Literal["whole", "peak", "peaks"] = key(
        "peaks",
        "what net 2 sees of the one map of `--method cap`: `whole`: all that is classified positive, as published; `peak`: the "
        "region of the best peak, for each candidate; `peaks`: the region of a peak of its own for each",
    )
    refine: list[Step] = key(
        list(get_args(Step)), "what is done to candidates on the observed cloud, in this order however listed; []: nothing"
    )
    hover: float = key(
        0.0,
        "candidates are raised by this, after refinement: for who lets go of the object without lifting it over its support "
        "on the way in, as the rpdiff protocol does",
        unit="m",
        ge=0,
        le=0.05,
    )
    ranking: list[Literal[Criterion, "collision"]] = key(
        list(get_args(Criterion)),
        "what candidates are ranked by; [collision], alone: container points inside the object's box, as published; "
        "[]: as drawn",
    )

    @model_validator(mode="before")
    @classmethod
    def fill_preset(cls, values: Any) -> Any:
        """Keys that are not written take the preset's values."""
        if isinstance(values, dict) and values.get("preset") == "paper":
            return {**PAPER, **values}
        return values

    @model_validator(mode="after")
    def check_divisors(self) -> TrainConfig:
        """Channels are shared out evenly among heads and groups."""
        for divisor, widths in (("heads", ("width",)), ("groups", ("point_width", "pose_width"))):
            for width in widths:
                if getattr(self, width) % getattr(self, divisor):
                    raise ValueError(
                        f"{divisor}: got {getattr(self, divisor)}, expected a divisor of {width} ({getattr(self, width)})"
                    )
        return self

    @field_validator("refine", "ranking")
    @classmethod
    def check_names(cls, names: list[str]) -> list[str]:
        """Each name once; the collision count is a ranking of its own."""
        if len(set(names)) < len(names):
            raise ValueError(f"got [{', '.join(names)}], expected each name at most once; leave out the repeated one")
        if "collision" in names and len(names) > 1:
            raise ValueError(
                f"got [{', '.join(names)}], expected collision to stand alone: it counts points, the others are mm of depth; "
                "write [collision], or leave it out"
            )
        return names


class EvalConfig(Section):
    """How predictions are made and judged."""

    trials: int = key(100, "demos of the split that are judged", ge=1)
    k: int = key(8, "candidates per demo that are ranked and judged", ge=1, le=1024)
    draws: int | None = key(None, "candidates per demo that the modes are counted on, at least k; null: k", ge=1, le=1024)
    protocol: Literal["strict", "rpdiff", "shown"] = key("strict", "rules of the judge, see docs/metrics.md")

    @model_validator(mode="after")
    def check_draws(self) -> EvalConfig:
        """What is judged was drawn."""
        if self.draws is not None and self.draws < self.k:
            raise ValueError(f"draws: got {self.draws}, expected at least k ({self.k}), or null for as many")
        return self
