"""The training loop of both networks: one loop, resumable, deterministic on CPU.

All randomness of step i comes from `rng.stream(seed, "train/<net>", i)`, so no generator has to be saved: weights,
their average, AdamW's moments and the number of the step are the whole state. A run of N steps that is killed and
resumed ends with the same bits on CPU as one that is not.

On CPU the two networks are trained side by side, a thread each: their tensors are so small that sharing one tensor's
work among cores gains little, and costs a factor of several when another program wants one of the cores.

With a budget of minutes the learning rate follows the clock instead of the step, so that the schedule ends in time
on any machine; such a run resumes too, but no two of them are alike.
"""

from __future__ import annotations

import copy
import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dapdata import durable
from dapdata import rng as random
from dapdata.config import TrainConfig
from dapdata.errors import FormatError, UsageError
from dapdata.loading import Dataset
from daptrain import affordance, diffusion, pose
from daptrain.affordance import AffordanceNet
from daptrain.checkpoint import (
    NETS,
    Method,
    Net,
    NetName,
    Progress,
    check_run,
    describe,
    is_spent,
    load_state,
    save_state,
    save_weights,
    start_run,
    write_whole,
)
from daptrain.pose import PoseNet
from daptrain.prepare import Crop, Example, LabelRule, pose_item, prepare, random_turn, reference_rotation

PARTS: dict[NetName, Callable[[TrainConfig], float]] = {  # of the minutes, when both networks are trained
    "affordance": lambda config: config.affordance_share,
    "pose": lambda config: 1 - config.affordance_share,
}
SHARED = threading.Lock()  # torch's own generator and metrics.jsonl are used by one thread at a time
LOG_EVERY = 20  # steps between lines of metrics.jsonl; checkpoints fall on these steps too
CHECKPOINT_SECONDS = 20.0
REPORT_SECONDS = 5.0  # between lines of progress where there is no terminal
VALIDATION_SCENES = 32  # demos of the val split that are looked at while training
SAMPLED_SCENES = 16  # of these, the ones that scores are sampled for: that is slow
SAMPLED_STEPS = 10
VALID_IOU = 0.35  # a sampled region that overlaps one goal's region this much counts as valid
LOOK_LEVELS = (0.1, 0.3)  # alpha_bar at which denoised regions are compared: the loss hardly tells good from bad
TIME_POWER = 0.75  # steps are drawn as T u^0.75: more of the noisy ones, where the mode is decided
AVERAGED_SHARE = 0.1  # early on the average spans this share of the steps so far, not the weights' noisy start
RAMP_STEPS = 200  # the residual term of net 2 comes in over so many steps


@dataclass(frozen=True)
class Material:
    """What the networks learn from, in RAM."""

    train: list[Example]
    val: list[Example]
    rule: LabelRule
    seed: int
    task: str  # of the dataset


@dataclass
class Budget:
    """When to stop: after so many steps, or when the clock says so. None: no limit of that kind."""

    steps: int | None = None
    seconds: float | None = None
    minutes: float = 0.0  # what the caller asked for, of which these seconds are a part
    before: float = 0.0  # s spent in earlier sessions
    started: float = field(default_factory=time.monotonic)

    def spent(self) -> float:
        """Seconds spent on this network, in all sessions."""
        return self.before + time.monotonic() - self.started

    def share(self, step: int) -> float:
        """How much of the budget is used up: 0 at the start, 1 and more at the end."""
        by_step = step / self.steps if self.steps else 0.0
        by_clock = self.spent() / max(self.seconds, 1e-9) if self.seconds is not None else 0.0
        return max(by_step, by_clock)


def train(
    dataset: str | Path,
    run: str | Path,
    *,
    net: str = "both",
    minutes: float | None = None,
    steps: int | None = None,
    device: str = "auto",
    config: TrainConfig | None = None,
    method: Method = "dap",
) -> Path:
    """The run folder, after training on a dataset's train split; goes on where an earlier call stopped.

    Args:
        dataset: Dataset folder or URL.
        run: Run folder, made when missing.
        net: "both", "affordance" or "pose".
        minutes: Wall-clock budget of all of it, preparation included; default: the config's, or none with `steps`.
        steps: Optimiser steps of each network.
        device: "auto", "cpu", "cuda", "cuda:1", ...
        config: Default: the train section of the dataset's recipe.
        method: "dap", or "cap": net 1 classifies at once, without diffusion.

    Raises:
        CheckpointError: the run folder holds a run on other data or with another config.
        UsageError: no demo to train on, a bad device, a budget that is none.
        LockedError: another process trains this run.
        EnvironmentProblem: the disk is full; the last checkpoint is there.
    """
    from dapdata.loading import open as open_dataset

    started = time.monotonic()
    whole, train_split, val_split = (open_dataset(dataset, split=split) for split in (None, "train", "val"))
    config = config or whole.section("train", TrainConfig)
    check_budget(minutes, steps)
    minutes = config.minutes if minutes is None and steps is None else minutes
    run, where, task = Path(run), pick_device(device), whole.task
    names: list[NetName] = [name for name in PARTS if net in ("both", name)]
    if not names:
        raise UsageError(f"net: got '{net}', expected both, affordance or pose")
    demos = demos_used(train_split, config)
    description = describe(str(dataset), task, whole.digest, whole.recipe, config, method, str(where)) | {"data": str(dataset)}
    check_run(run, description)
    with durable.disk_problems(run), durable.lock(run):
        start_run(run, description)
        names = [name for name in names if not is_spent(run, name, steps, minutes)]
        if not names:
            say(f"{run}: trained already with this budget; give more --minutes or --steps to go on")
            return run
        material = learned_from(whole, train_split, val_split, demos, config)
        seconds = None if minutes is None else 60 * minutes - (time.monotonic() - started)
        side_by_side = where.type == "cpu" and len(names) > 1 and cores() > 1
        asked = {}
        for name in names:
            part = 1.0 if side_by_side or net != "both" else PARTS[name](config)
            asked[name] = Budget(steps, None if seconds is None else part * seconds, minutes or 0.0)
        fit_all(asked, material, run, config, method, where, workers=len(names) if side_by_side else 1)
        draw_curves(run)
    return run


def learned_from(whole: Dataset, train_split: Dataset, val_split: Dataset, demos: int, config: TrainConfig) -> Material:
    """The first demos of the train split, and those of the val split that are looked at while training."""
    rule = label_rule(whole)
    every_goal = config.model_copy(update={"goals": "all"})  # validation asks whether a sample is any valid goal
    return Material(
        prepared(train_split, demos, rule, config),
        prepared(val_split, min(len(val_split), VALIDATION_SCENES), rule, every_goal),
        rule,
        int(whole.recipe["seed"]) if config.seed is None else config.seed,
        whole.task,
    )


def label_rule(dataset: Dataset) -> LabelRule:
    """How a dataset labelled affordance; a FormatError if its recipe does not say."""
    label = dataset.recipe.get("label")
    if (
        not isinstance(label, dict)
        or not isinstance(label.get("eps_place"), float)
        or label.get("kind") not in ("hard", "soft")
    ):
        raise FormatError(f"{dataset.root}: recipe.label: got {label!r:.80}, expected eps_place and kind; label it again")
    return LabelRule(label["eps_place"], label["kind"])


def fit_all(
    budgets: dict[NetName, Budget],
    material: Material,
    run: Path,
    config: TrainConfig,
    method: Method,
    device: torch.device,
    workers: int = 1,
) -> None:
    """Trains several networks, `workers` at a time. When one of them fails, or on Ctrl-C, the others save and stop."""
    stop = threading.Event()
    with ThreadPoolExecutor(workers) as pool:
        waiting = [
            pool.submit(fit, name, material, run, config, method, budget, device, stop) for name, budget in budgets.items()
        ]
        try:
            for done in as_completed(waiting):
                done.result()
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def check_budget(minutes: float | None, steps: int | None) -> None:
    """Refuses a budget that is none; None is no limit of that kind."""
    if minutes is not None and not 0 < minutes < math.inf:
        raise UsageError(f"minutes: got {minutes}, expected a number above 0")
    if steps is not None and steps < 1:
        raise UsageError(f"steps: got {steps}, expected at least 1")


def demos_used(train_split: Dataset, config: TrainConfig) -> int:
    """How many demos of a train split are learned from: its first ones, so that fewer are a part of more.

    The order is that of the demos' numbers. Each demo is drawn on its own, so the first ones are like all others, and
    those of a short dataset are the first ones of a longer one with the same recipe.
    """
    held = len(train_split)
    if held == 0:
        raise UsageError(
            f"{train_split.root}: the train split holds no demo, expected at least 1; generate more demos, or lower split.test"
        )
    if config.demos is not None and config.demos > held:
        raise UsageError(
            f"train.demos: got {config.demos}, the train split of {train_split.root} holds {held}; ask for at most that many"
        )
    return config.demos or held


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def pick_device(device: str) -> torch.device:
    """The device to compute on; "auto" takes a GPU if there is one. On CPU a network gets half of the cores, at most 4."""
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        where = torch.device(device)
        torch.zeros(1, device=where)
    except (RuntimeError, AssertionError) as error:
        raise UsageError(f"device: got '{device}', expected auto, cpu or a GPU such as cuda:0 ({error})") from error
    if where.type == "cpu" and "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(min(4, max(1, cores() // 2)))
    return where


def prepared(samples: Any, count: int, rule: LabelRule, config: TrainConfig) -> list[Example]:
    """The first `count` demos of a split, ready to train on; with progress, and none left out."""
    return [prepare(samples[i], rule, config) for i in reported(range(count), "prepare")]


# One network ---------------------------------------------------------------------------------------------------


def fit(
    name: NetName,
    material: Material,
    run: Path,
    config: TrainConfig,
    method: Method,
    budget: Budget,
    device: torch.device,
    stop: threading.Event | None = None,
) -> Progress:
    """Trains one network until its budget is spent, but for one step at least, from where the run folder left it.

    Args:
        name: Which network.
        material: What it learns from.
        run: Run folder; exists.
        config: Sizes and optimiser.
        method: "dap" or "cap".
        budget: When to stop; its clock starts now.
        device: Where to compute.
        stop: Save and return early when this is set.
    """
    if not any((example.targets.affordance > 0).any() for example in material.train):
        raise UsageError(f"{run}: no demo of the train split has a container point near its goal; generate more demos")
    network = build(name, config, method, material).to(device)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    average = {key: value.detach().clone() for key, value in network.named_parameters()}
    progress = load_state(run, network, optimizer, average)
    budget.before, budget.started = progress.seconds, time.monotonic()
    keep_metrics(run, name, progress.step)
    logged: list[dict[str, float]] = []
    saved = time.monotonic()
    share = budget.share(progress.step)  # asked for once a step: time that passes in between must not end it half-way
    with progress_bar(name, budget) as show:
        while share < 1 or progress.step == 0:
            rate = learning_rate(config, progress.step, share)
            logged.append(train_step(network, optimizer, material, config, progress.step, rate, device))
            progress.step += 1
            update_average(average, network, min(config.ema, 1 - 1 / (1 + AVERAGED_SHARE * progress.step)))
            progress.seconds = budget.spent()
            share = budget.share(progress.step)
            last = share >= 1
            if stop is not None and stop.is_set() and not last:
                save_state(run, network, optimizer, average, progress)
                return progress
            if not (progress.step % LOG_EVERY == 0 or last):
                continue
            means = {key: float(np.mean([entry[key] for entry in logged])) for key in logged[-1]}
            log(run, {"net": name, "step": progress.step, "seconds": round(progress.seconds, 1), "rate": rate, **means})
            logged = []
            if progress.step % config.validate_every == 0 or last:
                means = validate(averaged(network, average), material, config, device)
                log(run, {"net": name, "step": progress.step, **{f"val_{key}": value for key, value in means.items()}})
                if means["score"] > progress.best:
                    progress.best, progress.best_step = means["score"], progress.step
                    save_weights(run / f"{name}.safetensors", averaged(network, average), material.task)
                saved = -math.inf
            show(progress.step, means)
            if time.monotonic() - saved > CHECKPOINT_SECONDS and not last:
                save_state(run, network, optimizer, average, progress)
                saved = time.monotonic()
    # Before the state: one that has reached its budget says that these are there.
    save_weights(run / f"{name}.last.safetensors", averaged(network, average), material.task)
    progress.minutes = max(progress.minutes, budget.minutes)
    save_state(run, network, optimizer, average, progress)
    return progress


def build(name: NetName, config: TrainConfig, method: Method, material: Material) -> Net:
    """A new network; its first weights follow from the seed."""
    with SHARED, torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(random.stream(material.seed, f"train/{name}/weights", 0).integers(2**62)))
        network = NETS[name](config, method)
    if isinstance(network, PoseNet):
        network.reference.copy_(torch.from_numpy(reference_rotation(material.train)))
    return network


def train_step(
    network: Net,
    optimizer: torch.optim.Optimizer,
    material: Material,
    config: TrainConfig,
    step: int,
    rate: float,
    device: torch.device,
) -> dict[str, float]:
    """One step of the optimiser; returns what is logged of it."""
    for group in optimizer.param_groups:
        group["lr"] = rate
    rng = random.stream(material.seed, f"train/{network.name}", step)
    if isinstance(network, AffordanceNet):
        loss, logged = affordance_loss(network, material, config, rng, device)
    else:
        loss, logged = pose_loss(network, material, config, min(1.0, step / RAMP_STEPS), rng, device)
    optimizer.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    norm = torch.nn.utils.clip_grad_norm_(network.parameters(), config.clip)
    logged["skipped"] = float(not norm.isfinite())  # one bad batch must not end the run, and must not go unseen
    if not logged["skipped"]:
        optimizer.step()
    return logged


def affordance_loss(
    net: AffordanceNet, material: Material, config: TrainConfig, rng: np.random.Generator, device: torch.device
) -> tuple[Tensor, dict[str, float]]:
    """The loss of net 1 on a few scenes, each at several noise levels and each level with one of the scene's goals."""
    examples = pick(material.train, config.scenes_per_step, rng)
    turns = np.array([random_turn(config, rng) for _ in examples])
    mirrored = rng.random(len(examples)) < 0.5 * config.mirror
    batch = affordance.collate([e.inputs for e in examples], turns, mirrored, device)
    shape = (len(examples), config.levels_per_scene, batch.mask.shape[1])
    clean = np.full(shape, -1.0, np.float32)
    for b, example in enumerate(examples):
        goals = example.targets.affordance
        clean[b, :, : goals.shape[1]] = goals[rng.integers(len(goals), size=shape[1])]
    t = (len(net.alpha_bar) * rng.random(shape[:2]) ** TIME_POWER).astype(np.int64)
    noise = rng.standard_normal(shape, dtype=np.float32)
    loss = affordance.loss(net, batch, *(torch.from_numpy(x).to(device) for x in (clean, t, noise)))
    return loss, {"loss": float(loss.detach())}


def pose_loss(
    net: PoseNet, material: Material, config: TrainConfig, ramp: float, rng: np.random.Generator, device: torch.device
) -> tuple[Tensor, dict[str, float]]:
    """The loss of net 2 on a few crops."""
    reference = net.reference.cpu().double().numpy()
    items, extents = list[tuple[Crop, Any]](), []
    while len(items) < config.crops_per_step:
        for example in pick(material.train, config.crops_per_step - len(items), rng):
            if (item := pose_item(example, reference, material.rule, config, rng)) is not None:
                items.append(item)
                extents.append(example.inputs.extents)
    crops = pose.collate([piece for piece, _ in items], np.stack(extents), device)
    goals = torch.from_numpy(np.stack([T for _, T in items])).float().to(device)
    loss, off = pose.loss(net, crops, goals, ramp)
    return loss, {"loss": float(loss.detach()), "off_mm": 1000 * float(off)}


def pick(examples: list[Example], count: int, rng: np.random.Generator) -> list[Example]:
    """`count` examples at random, each at most once if there are enough."""
    return [examples[i] for i in rng.choice(len(examples), count, replace=count > len(examples))]


def learning_rate(config: TrainConfig, step: int, share: float) -> float:
    """Linear warm-up over steps, then half a cosine over the budget, down to 1 % of the peak."""
    warm = min(1.0, (step + 1) / max(config.warmup_steps, 1))
    return config.learning_rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(share, 1.0))))


def update_average(average: dict[str, Tensor], network: Net, decay: float) -> None:
    """Moves the exponential average towards the network's weights."""
    with torch.no_grad():
        for key, value in network.named_parameters():
            average[key].lerp_(value, 1 - decay)


def averaged(network: Net, average: dict[str, Tensor]) -> Net:
    """A copy of the network with the averaged weights."""
    out = copy.deepcopy(network).eval()
    with torch.no_grad():
        for key, value in out.named_parameters():
            value.copy_(average[key])
    return out


# Validation ----------------------------------------------------------------------------------------------------


@torch.no_grad()
def validate(network: Net, material: Material, config: TrainConfig, device: torch.device) -> dict[str, float]:
    """Figures on the val split (on training demos where there is none), always with the same noise.

    `score`, larger is better, decides which weights are kept.
    """
    examples = [e for e in material.val or material.train[:VALIDATION_SCENES] if (e.targets.affordance[0] > 0).any()]
    if not examples:
        return {"score": 0.0}
    rng = random.stream(material.seed, f"validate/{network.name}", 0)
    if isinstance(network, AffordanceNet):
        return validate_affordance(network, examples, rng, device)
    return validate_pose(network, examples, material.rule, config, rng, device)


def validate_affordance(
    net: AffordanceNet, examples: list[Example], rng: np.random.Generator, device: torch.device
) -> dict[str, float]:
    """`iou`: denoised region against the demonstrated one; `valid`: share of samples that are one valid goal's region."""
    batch = affordance.collate([e.inputs for e in examples], np.zeros(len(examples)), np.zeros(len(examples), bool), device)
    S = batch.mask.shape[1]
    clean = np.stack(
        [np.pad(e.targets.affordance[0], (0, S - len(e.inputs.superpoints)), constant_values=-1) for e in examples]
    )
    levels = [int(np.abs(net.alpha_bar.cpu().numpy() - level).argmin()) for level in LOOK_LEVELS]
    t = torch.tensor(levels, device=device).expand(len(examples), -1)
    noise = torch.from_numpy(rng.standard_normal((len(examples), len(levels), S), dtype=np.float32)).to(device)
    target = torch.from_numpy(clean).to(device)[:, None].expand_as(noise)
    noisy = diffusion.add_noise(target, net.alpha_bar[t].float()[..., None], noise)
    if net.method == "cap":
        noisy, t = torch.zeros_like(noisy), torch.zeros_like(t)
    denoised = net.clean(net.encode(batch), noisy, t)
    overlap = np.mean([iou(d, c) for d, c in zip(denoised.flatten(0, 1).cpu().numpy(), target.flatten(0, 1).cpu().numpy())])
    valid = [is_valid(e, s) for e, s in sampled(net, examples[:SAMPLED_SCENES], SAMPLED_STEPS, rng, device)]
    return {"score": float(overlap), "iou": float(overlap), "valid": float(np.mean(valid))}


def sampled(
    net: AffordanceNet, examples: list[Example], steps: int, rng: np.random.Generator, device: torch.device
) -> Iterable[tuple[Example, Any]]:
    """Each example with one sampled score (S,)."""
    batch = affordance.collate([e.inputs for e in examples], np.zeros(len(examples)), np.zeros(len(examples), bool), device)
    scores = affordance.sample(net, batch, 1, steps, rng)[:, 0]
    return [(e, score[: len(e.inputs.superpoints)]) for e, score in zip(examples, scores)]


def is_valid(example: Example, score: Any) -> bool:
    """Whether a sampled score (S,) is the region of one valid goal."""
    return max(iou(score, goal) for goal in example.targets.affordance) > VALID_IOU


def iou(score: Any, label: Any) -> float:
    """Intersection over union of the positive superpoints of two scores (S,)."""
    union = ((score > 0) | (label > 0)).sum()
    return float(((score > 0) & (label > 0)).sum() / union) if union else 0.0


def validate_pose(
    net: PoseNet, examples: list[Example], rule: LabelRule, config: TrainConfig, rng: np.random.Generator, device: torch.device
) -> dict[str, float]:
    """Median errors of the solved poses, with regions as training sees them and one goal a demo."""
    reference = net.reference.cpu().double().numpy()
    items = [(item, e) for e in examples if (item := pose_item(e, reference, rule, config, rng)) is not None]
    if not items:
        return {"score": 0.0}
    extents = np.stack([e.inputs.extents for _, e in items])
    solved = pose.solve(net, pose.collate([piece for (piece, _), _ in items], extents, device))
    T = np.stack([solution.T_crop_box for solution in solved])
    goals = np.stack([goal for (_, goal), _ in items])
    moved = np.linalg.norm(T[:, :3, 3] - goals[:, :3, 3], axis=1)
    cosine = (np.einsum("bij,bij->b", T[:, :3, :3], goals[:, :3, :3]) - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    # Failed solves are NaN: infinitely wrong, not left out.
    moved, turned = (np.nan_to_num(x, nan=np.inf) for x in (moved, turned))
    near = float(np.mean((moved < 0.02) & (turned < 10)))
    error = float(np.mean(np.minimum(moved / 0.02, 3)) + np.mean(np.minimum(turned / 10, 3)))
    return {"score": -error, "near": near, "moved_mm": 1000 * float(np.median(moved)), "turned_deg": float(np.median(turned))}


# What is said and written meanwhile ------------------------------------------------------------------------------


def say(line: str) -> None:
    """A line on stderr."""
    print(line, file=sys.stderr, flush=True)


def reported(items: range, name: str) -> Iterator[int]:
    """The items, with a bar on a terminal and a line every few seconds elsewhere."""
    from tqdm import tqdm

    if sys.stderr.isatty():
        yield from tqdm(items, desc=name, leave=False)
        return
    before = time.monotonic()
    for i in items:
        yield i
        if time.monotonic() - before > REPORT_SECONDS:
            before = time.monotonic()
            say(f"{name}: {i + 1} of {len(items)}")


@contextmanager
def progress_bar(name: NetName, budget: Budget) -> Iterator[Callable[[int, dict[str, float]], None]]:
    """A function to show (step, figures) with: a bar on a terminal, a line every few seconds elsewhere."""
    from tqdm import tqdm

    before = 0.0
    bar = tqdm(
        total=1000, desc=name, bar_format="{desc} {percentage:3.0f}%|{bar}| {elapsed}<{remaining}{postfix}", disable=None
    )

    def show(step: int, figures: dict[str, float]) -> None:
        nonlocal before
        share = min(budget.share(step), 1.0)
        text = ", ".join(f"{key} {value:.3g}" for key, value in figures.items() if key != "skipped")
        bar.set_postfix_str(f"step {step}, {text}", refresh=False)
        bar.update(int(1000 * share) - bar.n)
        if bar.disable and (share >= 1 or time.monotonic() - before > REPORT_SECONDS):
            before = time.monotonic()
            say(f"{name}: {100 * share:.0f} %, step {step}, {budget.spent():.0f} s, {text}")

    with bar:
        yield show


def log(run: Path, entry: dict[str, Any]) -> None:
    """Appends a line to metrics.jsonl."""
    with SHARED, (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps(entry) + "\n")


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """All entries of metrics.jsonl; lines that a kill or a power cut damaged are left out."""
    path, entries = run / "metrics.jsonl", []
    for line in path.read_text(errors="replace").split("\n")[:-1] if path.exists() else ():
        with suppress(ValueError):
            entry = json.loads(line)
            entries += [entry] if isinstance(entry, dict) and {"net", "step"} <= entry.keys() else []
    return entries


def keep_metrics(run: Path, name: str, step: int) -> None:
    """Drops the entries of a network that come after a step: resuming writes them again."""
    with SHARED:
        entries = [e for e in read_metrics(run) if e["net"] != name or e["step"] <= step]
        write_whole(run / "metrics.jsonl", "".join(json.dumps(e) + "\n" for e in entries).encode())


def draw_curves(run: Path) -> None:
    """curves.png: losses and validation figures over steps, a row a network."""
    import io

    from matplotlib.figure import Figure

    entries = read_metrics(run)
    shown = {"affordance": ("loss", "val_iou", "val_valid"), "pose": ("loss", "off_mm", "val_moved_mm", "val_turned_deg")}
    figure = Figure(figsize=(11, 5), layout="constrained")
    axes = figure.subplots(2, 4, squeeze=False)
    for row, (name, keys) in zip(axes, shown.items()):
        for axis, key in zip(row, keys):
            points = [(e["step"], e[key]) for e in entries if e["net"] == name and key in e]
            axis.plot([x for x, _ in points], [y for _, y in points], "." if len(points) < 2 else "-", lw=1.2)
            axis.set_title(f"{name} {key}", fontsize=9)
            axis.set_xlabel("step", fontsize=8)
            axis.tick_params(labelsize=7)
        for axis in row[len(keys) :]:
            axis.set_axis_off()
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=110)
    write_whole(run / "curves.png", image.getvalue())
