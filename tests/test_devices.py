"""Training and sampling on any device: no tensor in the wrong place, and on a GPU bfloat16 only where it does no harm."""

from contextlib import nullcontext

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from elsewhere import ELSEWHERE, elsewhere  # noqa: E402
from safetensors.torch import load_file  # noqa: E402
from training_samples import RULE, TINY, make_sample  # noqa: E402

from daptrain import affordance, layers, loop, pose  # noqa: E402
from daptrain.prepare import pose_item, prepare, reference_rotation  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore:for .* copying from a non-meta parameter")  # it is copied all the same
CPU = torch.device("cpu")
DEVICES = [ELSEWHERE, *([torch.device("cuda")] if torch.cuda.is_available() else [])]
PUBLISHED = TINY.model_copy(
    update={"prediction": "eps", "score_radii": [], "object_condition": False, "residual": False, "goals": "demonstrated"}
)
NAMES = ("affordance", "pose")
KINDS = [("affordance", TINY, "dap"), ("affordance", PUBLISHED, "dap"), ("affordance", TINY, "cap")]
KINDS += [("pose", TINY, "dap"), ("pose", PUBLISHED, "dap")]


def on(device: torch.device):
    """What must hold for a device to be used."""
    return elsewhere() if device == ELSEWHERE else nullcontext()


@pytest.fixture(scope="module")
def material() -> loop.Material:
    train, val = ([prepare(make_sample(seed, 0.03), RULE, TINY) for seed in seeds] for seeds in ((0, 1), (2,)))
    return loop.Material(train, val, RULE, 7, "shelf")


def fitted(material, run, name, device, config=TINY, method="dap"):
    """The losses of each step and the figures of each validation, of training in two sessions: the second resumes."""
    run.mkdir(exist_ok=True)
    with on(device):
        for steps in (1, 2):
            loop.fit(name, material, run, config, method, loop.Budget(steps=steps), device)
    assert {path.name for path in run.iterdir()} >= {f"{name}{kind}.safetensors" for kind in ("", ".last", ".state")}
    figures = [
        {key: value for key, value in entry.items() if key not in ("net", "seconds")} for entry in loop.read_metrics(run)
    ]
    assert len(figures) == 4
    return figures


@pytest.mark.parametrize("device", DEVICES, ids=str)
@pytest.mark.parametrize(("name", "config", "method"), KINDS, ids=["net1", "net1-paper", "net1-cap", "net2", "net2-paper"])
def test_training_validating_and_resuming_work_as_on_the_cpu(material, tmp_path, name, config, method, device):
    here, there = (fitted(material, tmp_path / where.type, name, where, config, method) for where in (CPU, device))
    tolerance, figures = 1e-4, here[0].keys() | here[1].keys()  # another kernel may add up in another order
    if device.type == "cuda":
        tolerance, figures = 0.1, {"step", "loss"}  # bfloat16: what follows from the weights' first steps may differ
    for a, b in zip(here, there):
        assert {k: b[k] for k in b.keys() & figures} == pytest.approx({k: a[k] for k in a.keys() & figures}, rel=tolerance)


@pytest.mark.parametrize("device", DEVICES, ids=str)
@pytest.mark.parametrize("config", [TINY, PUBLISHED], ids=["ours", "paper"])
def test_sampling_and_solving_give_the_same_as_on_the_cpu(material, config, device):
    (here, there) = (drawn(material, config, where) for where in (CPU, device))
    tolerance = 0.05 if device.type == "cuda" else 1e-4
    for a, b in zip(here, there):
        np.testing.assert_allclose(a, b, atol=tolerance)


def drawn(material, config, device):
    """Sampled scores (1, 3, S) and solved poses (2, 4, 4) from networks of the same first weights."""
    example, rng = material.train[0], np.random.default_rng(0)
    with on(device):
        first, second = (loop.build(name, config, "dap", material).to(device).eval() for name in NAMES)
        batch = affordance.collate([example.inputs], np.zeros(1), np.zeros(1, bool), device)
        scores = affordance.sample(first, batch, 3, 5, rng)
        reference = reference_rotation(material.train)
        items = [pose_item(example, reference, RULE, config, np.random.default_rng(seed)) for seed in range(2)]
        crops = pose.collate([piece for piece, _ in items], np.stack([example.inputs.extents] * 2), device)
        solved = pose.solve(second, crops)
    return scores, np.stack([solution.T_crop_box for solution in solved])


@pytest.mark.parametrize("name", NAMES)
def test_a_tensor_made_on_the_cpu_among_others_is_found(material, tmp_path, name, monkeypatch):
    """The tests above can fail: this is what they are for."""

    def careless(features, index):
        B, N, C = features.shape
        rows = (index + N * torch.arange(B)[:, None, None]).flatten()
        return features.reshape(B * N, C).index_select(0, rows).view(*index.shape, C)

    assert (careless(torch.ones(2, 3, 4), torch.zeros(2, 3, 1, dtype=torch.long)) == 1).all()
    monkeypatch.setattr(layers, "gather", careless)
    with pytest.raises(RuntimeError, match="on the CPU among others elsewhere"):
        fitted(material, tmp_path, name, ELSEWHERE)


# bfloat16 ------------------------------------------------------------------------------------------------------


def losses(material, name, config=TINY):
    """The loss of the first step and its gradients, by name."""
    network, rng = loop.build(name, config, "dap", material), np.random.default_rng(3)
    if name == "affordance":
        loss, _ = loop.affordance_loss(network, material, config, rng, CPU)
    else:
        loss, _ = loop.pose_loss(network, material, config, 1.0, rng, CPU)
    loss.backward()
    return loss.detach(), {key: value.grad for key, value in network.named_parameters() if value.grad is not None}


@pytest.mark.parametrize("name", NAMES)
def test_bfloat16_changes_a_loss_little_and_leaves_it_and_its_gradients_in_float32(material, name, monkeypatch):
    exact, _ = losses(material, name)
    monkeypatch.setattr(layers, "HALVED", "cpu")
    halved, gradients = losses(material, name)
    assert halved.dtype == torch.float32
    assert halved != exact, "bfloat16 was not used at all"
    assert float(halved) == pytest.approx(float(exact), rel=0.02)
    assert all(g.dtype == torch.float32 and g.isfinite().all() for g in gradients.values())


def test_in_bfloat16_positions_neighbours_softmax_and_solutions_stay_in_float32(material, monkeypatch):
    seen: dict[str, list[torch.Tensor]] = {"offset": [], "softmax": [], "phase": []}
    neighbours, softmax, cos = layers.neighbours, torch.Tensor.softmax, torch.Tensor.cos

    def record(what, call):
        def recorded(*args, **kwargs):
            out = call(*args, **kwargs)
            seen[what].append(out.offset if what == "offset" else out)
            return out

        return recorded

    monkeypatch.setattr(pose, "neighbours", record("offset", neighbours))
    monkeypatch.setattr(torch.Tensor, "softmax", record("softmax", softmax))
    monkeypatch.setattr(torch.Tensor, "cos", record("phase", cos))
    exact = {}
    for name in NAMES:
        losses(material, name)
    exact = {what: list(tensors) for what, tensors in seen.items()}
    for tensors in seen.values():
        tensors.clear()
    monkeypatch.setattr(layers, "HALVED", "cpu")
    for name in NAMES:
        losses(material, name)
    assert all(t.dtype == torch.float32 for tensors in seen.values() for t in tensors)
    for what in ("offset", "phase"):  # computed from positions alone: the same to the bit
        assert len(seen[what]) == len(exact[what]) > 0
        assert all(torch.equal(a, b) for a, b in zip(seen[what], exact[what]))


def test_a_cpu_computes_in_float32_throughout(material):
    with layers.halved(CPU):
        assert not torch.is_autocast_enabled("cpu")
        assert (torch.ones(2, 2) @ torch.ones(2, 2)).dtype == torch.float32


def test_weights_are_kept_in_float32(material, tmp_path, monkeypatch):
    monkeypatch.setattr(layers, "HALVED", "cpu")
    fitted(material, tmp_path, "pose", CPU)
    tensors = load_file(tmp_path / "pose.last.safetensors")
    assert {value.dtype for value in tensors.values()} == {torch.float32}
