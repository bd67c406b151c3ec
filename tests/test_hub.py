"""The pages on exports and hubs: their snippets read what is told, as far as that can be tried without a network."""

from __future__ import annotations

import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
from fsspec.implementations.local import LocalFileSystem

from dapdata import cli, loading, pictures
from dapdata.interop import parquet, webdataset

ROOT = Path(__file__).parents[1]
EXPORT = (ROOT / "docs/export.md").read_text(encoding="utf-8")
HUB = (ROOT / "docs/hub.md").read_text(encoding="utf-8")
NEEDS_INTEROP = "needs the extra interop: `make test-all` installs it"


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def snippet(text: str, word: str) -> str:
    """The one block of Python with a word in it."""
    (found,) = [block for block in blocks(text, "python") if word in block]
    return found


def executed(code: str) -> dict[str, Any]:
    """The names that a snippet leaves behind."""
    scope: dict[str, Any] = {}
    exec(compile(code, "docs", "exec"), scope)
    return scope


@pytest.fixture(scope="module")
def exported(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the commands of the page on exports were run, on the tiny dataset."""
    root = tmp_path_factory.mktemp("page")
    (root / "data").mkdir()
    (root / "data/quickstart").symlink_to(tiny)
    (commands,) = blocks(EXPORT, "sh")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setattr(pictures, "preview", lambda *_: np.zeros((2, 2, 3), np.uint8))  # drawing takes the longest
        for line in commands.splitlines():
            assert cli.run_app(shlex.split(line)[1:]) == 0
    return root


@pytest.fixture
def in_the_page(exported: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(exported)
    return exported


@pytest.fixture
def sample(tiny: Path) -> dict[str, Any]:
    """The first demo for training."""
    return loading.open(tiny, "train")[0]


# The page on exports ---------------------------------------------------------------------------------------


def lines_of_the_table() -> dict[str, str]:
    return dict(re.findall(r"^\| `(\w+)` \| .* \| `([^|]*)` \|$", EXPORT, re.MULTILINE))


@pytest.mark.usefixtures("in_the_page")
@pytest.mark.parametrize(
    ("format", "module"),
    [
        ("webdataset", "webdataset as wds"),
        ("pointcept", "numpy as np"),
        ("scenes", "trimesh"),
        ("rpdiff", "numpy as np"),
        pytest.param("parquet", "datasets", marks=pytest.mark.slow),
    ],
)
def test_the_line_of_the_table_reads_the_export(format: str, module: str, sample: dict[str, Any]) -> None:
    pytest.importorskip(module.split()[0], reason=NEEDS_INTEROP)
    assert set(lines_of_the_table()) == {"webdataset", "parquet", "pointcept", "scenes", "rpdiff"}
    found = executed(f"import {module}\nfound = {lines_of_the_table()[format]}")["found"]
    count, others = (len(sample[f"{body}/points"]) for body in ("container", "object"))
    if format == "webdataset":
        assert len(found["container.points.npy"]) == count
    elif format == "parquet":
        assert len(found["container/points"]) == count
    elif format == "pointcept":
        assert len(found) == count + others
    elif format == "rpdiff":
        assert len(found["multi_obj_start_pcd"].item()["child"]) == others
    else:
        assert len([name for name in found.graph.nodes_geometry if name.startswith("goal_")]) == len(sample["goals/kind"])


@pytest.mark.usefixtures("in_the_page")
def test_the_snippet_for_webdataset_runs(sample: dict[str, Any]) -> None:
    pytest.importorskip("webdataset", reason="needs the extra dev")
    left = executed(snippet(EXPORT, "import webdataset"))
    assert left["points"].shape[1] == 3
    assert left["goal"].shape == (4, 4)


@pytest.mark.slow
@pytest.mark.usefixtures("in_the_page")
def test_the_snippets_for_parquet_run(sample: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("datasets", "pandas"):
        pytest.importorskip(module, reason=NEEDS_INTEROP)
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", str(tmp_path))
    left = executed(snippet(EXPORT, "load_dataset"))
    assert np.array_equal(left["points"], sample["container/points"])
    assert np.array_equal(left["goals"], sample["goals/T_world_object"])
    assert np.array_equal(executed(snippet(EXPORT, "pandas"))["points"], sample["container/points"])


@pytest.mark.usefixtures("in_the_page")
def test_the_snippet_for_scenes_runs(sample: dict[str, Any]) -> None:
    left = executed(snippet(EXPORT, "import trimesh"))
    np.testing.assert_allclose(left["T_world_object"], sample["goals/T_world_object"][0], atol=1e-12)


@pytest.mark.usefixtures("in_the_page")
def test_the_snippet_for_a_simulator_runs() -> None:
    pybullet = pytest.importorskip("pybullet")
    left = executed(snippet(EXPORT, "import pybullet"))
    assert pybullet.getNumBodies(physicsClientId=left["client"]) == 2
    pybullet.disconnect(left["client"])


def test_the_cards_of_exports_have_loaders_that_run(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for format, name in (("webdataset", "points"), ("scenes", "T_world_object")):
        monkeypatch.chdir(exported / "exports" / format)
        card = Path("README.md").read_text(encoding="utf-8")
        pytest.importorskip({"scenes": "trimesh"}.get(format, format))
        assert name in executed(blocks(card, "python")[0])


@pytest.mark.slow
def test_the_card_of_the_parquet_export_has_a_loader_that_runs(
    exported: Path, sample: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("datasets", reason=NEEDS_INTEROP)
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", str(tmp_path))
    monkeypatch.chdir(exported / "exports/parquet")
    left = executed(blocks(Path("README.md").read_text(encoding="utf-8"), "python")[0])
    assert np.array_equal(left["points"], sample["container/points"])


# The page on hubs ------------------------------------------------------------------------------------------


class Bucket(LocalFileSystem):
    """A file system of fsspec that zarr does not know by name: folders of this machine as bucket:///path."""

    protocol = "bucket"

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix("bucket://")))


def test_shards_stream_from_a_file_system_of_fsspec(tiny: Path) -> None:
    fsspec.register_implementation("bucket", Bucket, clobber=True)
    code = snippet(HUB, "import fsspec")
    assert '"hf://datasets/you/quickstart"' in code
    left = executed(code.replace("hf://datasets/you/quickstart", f"bucket://{tiny}"))
    assert np.array_equal(left["score"], loading.open(tiny)[0]["container_superpoints/affordance"])


@pytest.fixture
def served(tiny: Path, tmp_path: Path) -> Iterator[str]:
    """The URL of a web server on this machine with tar files in it."""
    webdataset.export(tiny, tmp_path / "tars", shard_size=2)

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            """Says nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "tars"))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


@pytest.mark.skipif(shutil.which("curl") is None, reason="webdataset reads URLs through curl, which is not here")
def test_tar_files_stream_from_a_web_server(served: str, tiny: Path) -> None:
    pytest.importorskip("webdataset", reason="needs the extra dev")
    code = re.sub(r"https://huggingface\.co/\S*/main", served, snippet(HUB, "import webdataset"))
    assert f"{served}/train-{{000000..000001}}.tar" in code
    left = executed(code + "count = len(list(wds.WebDataset(url, shardshuffle=False)))")
    train = loading.open(tiny, "train")
    assert left["count"] == len(train)
    assert np.array_equal(left["points"], train[len(train) - 1]["container/points"])


@pytest.mark.slow
def test_rows_stream_through_datasets(
    tiny: Path, tmp_path: Path, sample: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("datasets", reason=NEEDS_INTEROP)
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", str(tmp_path / "cache"))
    parquet.export(tiny, tmp_path / "you/quickstart-parquet", previews=False)
    monkeypatch.chdir(tmp_path)
    left = executed(snippet(HUB, "streaming=True"))
    assert np.array_equal(left["points"], sample["container/points"])


@pytest.mark.slow
def test_croissant_gives_the_index(in_the_page: Path, tiny: Path) -> None:
    pytest.importorskip("mlcroissant", reason=NEEDS_INTEROP)
    left = executed(snippet(HUB, "mlcroissant"))
    assert [row["demos/demo"] for row in left["rows"]] == loading.open(tiny).index["demo"].tolist()


@pytest.mark.slow
def test_the_hubs_program_knows_every_command_and_option_of_the_page() -> None:
    pytest.importorskip("huggingface_hub", reason=NEEDS_INTEROP)
    program = Path(sys.executable).with_name("hf")
    lines = [line for block in blocks(HUB, "sh") for line in block.splitlines() if line.startswith("hf ")]
    assert len(lines) == 5
    for line in lines:
        words = shlex.split(line)[1:]
        command = words[: 3 if words[0] == "repos" else 1]
        done = subprocess.run(
            [program, *command, "--help"], capture_output=True, text=True, check=True, env=os.environ | {"HF_HUB_OFFLINE": "1"}
        )
        assert {word for word in words if word.startswith("--")} <= set(re.findall(r"--[a-z-]+", done.stdout)), line


def test_the_protocols_that_the_page_names_are_known_to_fsspec() -> None:
    known = importlib.import_module("fsspec.registry").known_implementations
    assert {url.split(":")[0] for url in re.findall(r"`(\w+:)//", HUB)} <= set(known)
