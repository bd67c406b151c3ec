"""Training: learns, resumes to the bit, writes whole files, refuses what does not belong."""

import json
import re
import shutil

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from safetensors.torch import load_file  # noqa: E402
from training_samples import RULE, TINY, make_sample  # noqa: E402

from dapdata import loading, rng, tasks  # noqa: E402
from dapdata.errors import CheckpointError, UsageError  # noqa: E402
from dapdata.records import Rejected  # noqa: E402
from daptrain import checkpoint, loop  # noqa: E402
from daptrain.prepare import prepare  # noqa: E402

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def material() -> loop.Material:
    train, val = ([prepare(make_sample(seed, 0.03), RULE, TINY) for seed in seeds] for seeds in ((0, 1, 2), (3, 4)))
    return loop.Material(train, val, RULE, 7, "shelf")


@pytest.fixture(scope="module")
def one_scene() -> loop.Material:
    """One demo with one goal: what a network must be able to learn by heart."""
    example = prepare(make_sample(0, 0.03), RULE, TINY.model_copy(update={"goals": "demonstrated"}))
    return loop.Material([example], [example], RULE, 7, "shelf")


def trained(material, run, name, steps, **changes):
    run.mkdir(exist_ok=True)
    return loop.fit(name, material, run, TINY.model_copy(update=changes), "dap", loop.Budget(steps=steps), CPU)


def metrics(run, key):
    return [entry[key] for entry in loop.read_metrics(run) if key in entry]


@pytest.mark.parametrize("changes", [{}, {"prediction": "eps", "score_radii": [], "object_condition": False}])
def test_net_1_learns_one_scene_by_heart(one_scene, tmp_path, changes):
    trained(one_scene, tmp_path, "affordance", 120, yaw_jitter_deg=0.0, mirror=False, scenes_per_step=4, **changes)
    assert metrics(tmp_path, "loss")[-1] < 0.5 * metrics(tmp_path, "loss")[0]
    assert max(metrics(tmp_path, "val_iou")) > 0.6


def test_net_2_learns_one_scene_by_heart(one_scene, tmp_path):
    trained(one_scene, tmp_path, "pose", 150, yaw_jitter_deg=0.0, crops_per_step=4)
    assert metrics(tmp_path, "val_moved_mm")[-1] < 15
    assert metrics(tmp_path, "val_turned_deg")[-1] < 25


@pytest.mark.parametrize("name", ["affordance", "pose"])
def test_a_run_that_was_stopped_and_resumed_ends_with_the_same_bits(material, tmp_path, name):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    trained(material, whole, name, 25)
    parts.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)  # a state at each line of the log
        step = loop.train_step

        def killed(network, optimizer, material, config, at, *rest):
            if at == 23:
                raise KeyboardInterrupt
            return step(network, optimizer, material, config, at, *rest)

        patch.setattr(loop, "train_step", killed)
        with pytest.raises(KeyboardInterrupt):
            trained(material, parts, name, 25)
    assert checkpoint.load_state(parts, *fresh(name, material)).step == 20
    trained(material, parts, name, 25)
    for file in (f"{name}.safetensors", f"{name}.last.safetensors"):
        assert (whole / file).read_bytes() == (parts / file).read_bytes()
    assert metrics(whole, "loss") == metrics(parts, "loss")


def budgets(steps):
    return {name: loop.Budget(steps=steps) for name in ("affordance", "pose")}


def test_side_by_side_gives_the_bits_of_one_after_the_other(material, tmp_path):
    for workers in (1, 2):
        (tmp_path / str(workers)).mkdir()
        loop.fit_all(budgets(4), material, tmp_path / str(workers), TINY, "dap", CPU, workers)
    for name in ("affordance.last.safetensors", "pose.last.safetensors"):
        assert (tmp_path / "1" / name).read_bytes() == (tmp_path / "2" / name).read_bytes()


def test_when_one_network_fails_the_other_saves_and_stops(material, tmp_path, monkeypatch):
    step = loop.train_step

    def fails(network, *rest):
        if network.name == "pose":
            raise RuntimeError("no more memory")
        return step(network, *rest)

    monkeypatch.setattr(loop, "train_step", fails)
    with pytest.raises(RuntimeError, match="no more memory"):
        loop.fit_all(budgets(10_000), material, tmp_path, TINY, "dap", CPU, 2)
    assert 0 < checkpoint.load_state(tmp_path, *fresh("affordance", material)).step < 10_000


def fresh(name, material):
    network = loop.build(name, TINY, "dap", material)
    average = {key: value.detach().clone() for key, value in network.named_parameters()}
    return network, torch.optim.AdamW(network.parameters()), average


def test_the_seed_decides_the_first_weights_and_leaves_torchs_own_generator(material):
    torch.manual_seed(123)
    before = torch.random.get_rng_state()
    one, same = (loop.build("pose", TINY, "dap", material).state_dict() for _ in range(2))
    assert all(torch.equal(one[key], same[key]) for key in one)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_more_steps_go_on_where_the_run_stood(material, tmp_path):
    trained(material, tmp_path, "pose", 3)
    assert trained(material, tmp_path, "pose", 6).step == 6
    assert metrics(tmp_path, "step") == sorted(metrics(tmp_path, "step"))


def test_a_spent_budget_trains_no_further(material, tmp_path):
    trained(material, tmp_path, "pose", 3)
    before = (tmp_path / "pose.last.safetensors").read_bytes()
    assert trained(material, tmp_path, "pose", 3).step == 3
    assert (tmp_path / "pose.last.safetensors").read_bytes() == before


def test_minutes_end_the_training_in_time(material, tmp_path):
    budget = loop.Budget(seconds=2.0)
    loop.fit("pose", material, tmp_path, TINY, "dap", budget, CPU)
    assert 2.0 <= budget.spent() < 15.0
    rates = metrics(tmp_path, "rate")
    assert rates[-1] < 0.5 * max(rates)  # a slow step may be the last one


def test_time_that_runs_out_between_two_steps_still_leaves_weights(material, tmp_path, monkeypatch):
    shares = iter([0.0, 0.99])
    monkeypatch.setattr(loop.Budget, "share", lambda budget, step: next(shares, 1.0))
    progress = loop.fit("pose", material, tmp_path, TINY, "dap", loop.Budget(seconds=60.0), CPU)
    assert progress.step == 2
    assert {"pose.safetensors", "pose.last.safetensors"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("seconds", [0.0, -3.0])
def test_a_budget_that_preparation_used_up_still_makes_one_step(material, tmp_path, seconds):
    assert loop.fit("pose", material, tmp_path, TINY, "dap", loop.Budget(seconds=seconds), CPU).step == 1
    assert {"pose.safetensors", "pose.last.safetensors"} <= {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("budget", [{"minutes": 0}, {"minutes": -1}, {"minutes": np.nan}, {"minutes": np.inf}, {"steps": 0}])
def test_a_budget_that_is_none_is_refused_before_anything_is_written(tiny_dataset, tmp_path, budget):
    with pytest.raises(UsageError, match=f"{next(iter(budget))}: got"):
        loop.train(tiny_dataset, tmp_path / "run", **budget)
    assert not (tmp_path / "run").exists()


def test_a_budget_is_known_to_be_spent(material, tmp_path):
    assert not checkpoint.is_spent(tmp_path, "pose", 3, None)
    loop.fit("pose", material, tmp_path, TINY, "dap", loop.Budget(steps=3, minutes=2.0), CPU)
    assert checkpoint.is_spent(tmp_path, "pose", 3, None)
    assert checkpoint.is_spent(tmp_path, "pose", None, 2.0)
    assert not checkpoint.is_spent(tmp_path, "pose", 4, None)
    assert not checkpoint.is_spent(tmp_path, "pose", None, 2.5)


# Fewer demos -----------------------------------------------------------------------------------------------------


def learned_from(monkeypatch, dataset, run, **changes):
    """The demos that networks are trained on, without training them."""
    seen = []
    monkeypatch.setattr(loop, "fit_all", lambda budgets, material, *rest, **options: seen.append(material))
    monkeypatch.setattr(loop, "draw_curves", lambda run: None)
    loop.train(dataset, run, steps=1, device="cpu", config=TINY.model_copy(update=changes))
    return seen[0]


def test_fewer_demos_are_a_part_of_more_and_validation_stays(tiny_dataset, tmp_path, monkeypatch):
    found = [learned_from(monkeypatch, tiny_dataset, tmp_path / str(n), demos=n) for n in (1, 2, None)]
    clouds = [[example.inputs.container_points for example in material.train] for material in found]
    assert [len(part) for part in clouds] == [1, 2, 3]
    for part in clouds:
        assert all(np.array_equal(a, b) for a, b in zip(part, clouds[-1]))
    assert len({len(material.val) for material in found}) == 1


def test_a_training_has_a_seed_of_its_own_and_else_the_recipes(tiny_dataset, tmp_path, monkeypatch):
    recipes, given = (learned_from(monkeypatch, tiny_dataset, tmp_path / str(seed), seed=seed).seed for seed in (None, 3))
    assert (recipes, given) == (loading.open(tiny_dataset).recipe["seed"], 3)


@pytest.mark.parametrize("task", tasks.names())
def test_the_first_demos_of_a_split_are_like_the_others(task):
    """Demos come in the order of their numbers, and neither container nor object follows from the number."""
    scenes = [tasks.load(task).sample_scene(tasks.load(task).Params(), rng.stream(0, "scene", demo)) for demo in range(40)]
    scenes = [scene for scene in scenes if not isinstance(scene, Rejected)]
    for name in ("container_instance", "object_instance"):
        instances = [getattr(scene, name) for scene in scenes]
        assert len(set(instances)) == len(scenes) > 20
        assert 0.25 < np.mean(np.diff(np.array(instances, float)) > 0) < 0.75


def test_more_demos_than_there_are_are_refused_before_anything_is_written(tiny_dataset, tmp_path):
    with pytest.raises(UsageError, match=r"train\.demos: got 4, the train split of .* holds 3"):
        loop.train(tiny_dataset, tmp_path / "run", steps=1, device="cpu", config=TINY.model_copy(update={"demos": 4}))
    assert not (tmp_path / "run").exists()


def test_a_run_on_other_demos_is_another_run(run):
    other = described()
    other["train"] = {**other["train"], "demos": 2}
    refused(lambda: checkpoint.start_run(run, other), "train.demos None, now it is 2")


def test_a_run_leaves_weights_metrics_and_curves(material, tmp_path):
    trained(material, tmp_path, "affordance", 3)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "affordance.safetensors", "affordance.last.safetensors", "affordance.state.safetensors", "metrics.jsonl"
    }  # fmt: skip
    loop.draw_curves(tmp_path)
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


# What does not belong --------------------------------------------------------------------------------------------


def described(**changes):
    recipe = {"label": {"eps_place": 0.03, "kind": "hard"}, "superpoints": {}}
    return checkpoint.describe("data/shelf", "shelf", "d1", recipe, TINY, "dap", "cpu") | changes


@pytest.fixture(scope="module")
def finished(material, tmp_path_factory):
    run = tmp_path_factory.mktemp("finished")
    checkpoint.start_run(run, described())
    for name in ("affordance", "pose"):
        trained(material, run, name, 3)
    return run


@pytest.fixture
def run(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "run")


def refused(call, *says):
    with pytest.raises(CheckpointError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    for text in says:
        assert re.search(text, message), message


def test_the_same_run_is_resumed(run):
    checkpoint.start_run(run, described())


def test_a_run_of_another_task_is_refused_by_name(run):
    refused(lambda: checkpoint.start_run(run, described(task="tray")), "task shelf", "tray", "--run")


def test_a_run_on_other_data_is_refused(run):
    refused(lambda: checkpoint.start_run(run, described(dataset="d2")), "dataset d1", "d2")


def test_a_run_with_another_config_is_refused_by_key(run):
    other = described()
    other["train"] = {**other["train"], "width": 32}
    refused(lambda: checkpoint.start_run(run, other), "train.width 16", "32")


def test_keys_that_do_not_change_what_is_learned_may_change(run):
    other = described()
    other["train"] = {**other["train"], "minutes": 99.0, "sample_steps": 7}
    checkpoint.start_run(run, other)
    assert checkpoint.read_description(run)["train"]["sample_steps"] == 7


def test_a_folder_of_something_else_is_not_written_into(tmp_path):
    (tmp_path / "thesis.txt").write_text("all of it")
    with pytest.raises(UsageError, match="is no run"):
        checkpoint.start_run(tmp_path, described())
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def load(run, name="pose"):
    return checkpoint.load_network(run, name, checkpoint.read_description(run), TINY, CPU)


def rewritten(path, tensors=None, **changes):
    with checkpoint.opened(path) as (_, metadata):
        found = load_file(path)
    path.write_bytes(checkpoint.packed(tensors or found, {**metadata, **changes}))


def test_weights_come_back_as_they_were_saved(run):
    network = load(run)
    saved = load_file(run / "pose.safetensors")
    assert all(torch.equal(value, saved[key]) for key, value in network.state_dict().items())


def test_weights_of_another_network_are_refused(run):
    shutil.copy(run / "affordance.safetensors", run / "pose.safetensors")
    refused(lambda: load(run), "network 'affordance'", "expected 'pose'")


def test_weights_of_another_version_are_refused(run):
    rewritten(run / "pose.safetensors", version=99)
    refused(lambda: load(run), "version '99'", f"expected '{checkpoint.NETS['pose'].version}'")


def test_weights_of_another_task_are_refused(run):
    rewritten(run / "pose.safetensors", task="tray")
    refused(lambda: load(run), "task 'tray'", "expected 'shelf'")


def test_weights_of_another_size_are_refused(run):
    tensors = load_file(run / "pose.safetensors")
    tensors["project_crop.weight"] = torch.zeros(3, 3)
    rewritten(run / "pose.safetensors", tensors)
    refused(lambda: load(run), r"project_crop.weight has shape \(3, 3\)", r"expects \(12, 12\)")


def test_weights_that_are_not_finite_are_refused(run):
    tensors = load_file(run / "pose.safetensors")
    tensors["project_crop.weight"][0, 0] = np.nan
    rewritten(run / "pose.safetensors", tensors)
    refused(lambda: load(run), "not finite")


@pytest.mark.parametrize("content", [b"", b"\x80\x04\x95 a pickle", bytes(range(256)) * 40, b"\xff" * 8 + b"{}"])
def test_a_damaged_file_is_refused(run, content, material):
    (run / "pose.safetensors").write_bytes(content)
    refused(lambda: load(run), "pose.safetensors", "expected safetensors")
    (run / "pose.state.safetensors").write_bytes(content)
    refused(lambda: checkpoint.load_state(run, *fresh("pose", material)), "pose.state.safetensors")


def test_missing_weights_say_how_to_make_them(run):
    (run / "pose.safetensors").unlink()
    refused(lambda: load(run), "dapdata train", "--net pose")


@pytest.mark.parametrize("content", ["", "[]", '{"format": "dapdata-run-0"}', "\x00"])
def test_a_strange_config_is_refused(run, content):
    (run / "config.json").write_text(content)
    refused(lambda: checkpoint.read_description(run), "config.json", "expected")


def test_a_folder_without_a_run_is_refused(tmp_path):
    refused(lambda: checkpoint.read_description(tmp_path), "no config.json", "dapdata train")


def test_metrics_are_lines_of_json(finished):
    entries = [json.loads(line) for line in (finished / "metrics.jsonl").read_text().splitlines()]
    assert {entry["net"] for entry in entries} == {"affordance", "pose"}
    assert all(entry["skipped"] == 0 for entry in entries if "loss" in entry)


def test_a_device_that_is_none_is_refused():
    with pytest.raises(UsageError, match="device: got 'abacus'"):
        loop.pick_device("abacus")
