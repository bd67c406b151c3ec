"""The pages for whoever starts, loads or compares: their snippets run, their site builds, and no link in it is dead."""

from __future__ import annotations

import json
import os
import re
import runpy
import socket
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest
from test_docs import ROOT, blocks

import dapdata
from dapdata import errors, keys, recipe

DOCS = ROOT / "docs"
LOADING = (DOCS / "loading.md").read_text(encoding="utf-8")
NOTEBOOK = DOCS / "read_shards.ipynb"
ENVIRONMENT = os.environ | {
    "OMP_NUM_THREADS": "1",
    "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "train"), *filter(None, [os.environ.get("PYTHONPATH")])]),
    "MPLBACKEND": "Agg",
}


@pytest.fixture
def beside_data(tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory in which the dataset that the pages name is the tiny one."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data/quickstart").symlink_to(tiny_dataset)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def snippet(*words: str) -> str:
    """The one snippet of loading.md that has all these words."""
    (found,) = [block for block in blocks(LOADING, "python") if all(word in block for word in words)]
    return found


def run(code: str, **variables: str) -> str:
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=ENVIRONMENT | variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


# Loading ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("beside_data")
def test_a_shard_is_read_with_numpy_and_zarr_alone() -> None:
    check = "assert len(demos) == 3 and all(len(p) == len(a) > 10 and abs(a).max() <= 1 for p, a in demos)\n"
    run(snippet("zarr.open_group") + check + "import sys; assert not {'dapdata', 'torch'} & {*sys.modules}")


@pytest.mark.usefixtures("beside_data")
def test_samples_blocks_and_chosen_demos_are_read_without_torch() -> None:
    check = """
assert goal.shape == (4, 4) and len(counts) == len(train) == 3 and len(cloud) > 100
assert [len(s["goals/T_world_object"]) >= 2 for s in samples] == [True] * len(rich) and len(rich) > 0
import sys; assert "torch" not in sys.modules
"""
    run(snippet("train.block") + snippet("rich =") + check)


@pytest.mark.usefixtures("beside_data")
def test_padded_batches_come_from_memory_and_from_a_stream() -> None:
    pytest.importorskip("torch")
    scope: dict[str, Any] = {"train": dapdata.open("data/quickstart", split="train")}  # as in the snippet before
    exec(compile(snippet("collate_fn=collate"), "docs/loading.md", "exec"), scope)
    assert scope["known"].any()
    points, affordance = (scope["batch"][path] for path in scope["PATHS"])
    assert points.shape[:2] == affordance.shape
    assert scope["stream"].state_dict()["epoch"] == 2


@pytest.mark.slow
@pytest.mark.usefixtures("beside_data")
def test_ranks_train_together_on_demos_of_their_own() -> None:
    pytest.importorskip("torch")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        where = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1]), "WORLD_SIZE": "2"}
    code = snippet("DistributedDataParallel") + "\nprint(seen, *[p.sum().item() for p in model.parameters()])"
    ranks = [
        subprocess.Popen(
            [sys.executable, "-c", code], env=ENVIRONMENT | where | {"RANK": rank}, stdout=subprocess.PIPE, text=True
        )
        for rank in "01"
    ]
    out = [rank.communicate(timeout=300)[0].split() for rank in ranks]
    assert out[0] == out[1], "the same steps, and the same weights"
    assert out[0][0] == "2"  # three demos of the train split: one for each rank, in two passes


@pytest.mark.usefixtures("beside_data")
def test_fixed_numbers_of_rows_go_to_jax() -> None:
    if find_spec("jax") is None:
        pytest.skip("jax is not installed; the snippet of docs/loading.md is run where it is: pip install jax")
    run(snippet("import jax") + "\nassert points.shape[1:] == (64, 3) and score.shape[1:] == (64,) and (weights != 0).all()")


# The notebook ----------------------------------------------------------------------------------------------


def cells(kind: str) -> list[str]:
    return ["".join(cell["source"]) for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == kind]


def test_the_notebook_reads_a_shard_and_draws_a_demo(beside_data: Path) -> None:
    pytest.importorskip("matplotlib")
    (beside_data / "docs").mkdir()
    os.chdir(beside_data / "docs")
    check = """
figure.savefig("figure.png")
assert len(placed) == len(goals) >= 1
inside = [((p > container.min(0) - 0.02) & (p < container.max(0) + 0.02)).all(1).mean() for p in placed]
assert min(inside) > 0.9, inside
import sys; assert not {'dapdata', 'torch'} & {*sys.modules}
"""
    out = run("\n".join(cells("code")) + check)
    assert out.startswith("can_cabinet in 2 shards")
    assert (beside_data / "docs/figure.png").stat().st_size > 10_000


def test_the_notebook_is_committed_without_outputs() -> None:
    found = json.loads(NOTEBOOK.read_text())
    assert found["nbformat"] == 4
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in found["cells"] if "outputs" in cell)
    assert len(cells("markdown")) >= 3


# Glossary and errors ---------------------------------------------------------------------------------------


def test_every_default_of_the_glossary_is_the_default() -> None:
    schema = recipe.recipe_class("can_cabinet").model_json_schema()
    page = (DOCS / "glossary.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| \S+ \| `([a-z_.]+)` \| (\S+) \| ([0-9.]+) \|", page, re.MULTILINE)
    assert len(rows) >= 6
    for name, unit, default in rows:
        body = keys.at(schema, tuple(name.split(".")))
        assert (body["default"], body.get("unit", "1")) == (float(default), unit), name


def test_every_array_that_the_glossary_names_is_in_a_shard() -> None:
    from dapdata.records import columns

    page = (DOCS / "glossary.md").read_text(encoding="utf-8")
    paths = {column.metadata["path"] for column in columns()}
    named = set(re.findall(r"`([a-z_]+/[A-Za-z_]+)`", page))
    assert len(named) >= 6
    assert named <= paths


def test_every_exit_code_is_explained() -> None:
    page = (DOCS / "errors.md").read_text(encoding="utf-8")
    codes = {cls.exit_code for cls in vars(errors).values() if isinstance(cls, type) and issubclass(cls, errors.DapdataError)}
    explained = {int(code) for code in re.findall(r"^\| (\d+) \| [a-z]", page, re.MULTILINE)}
    assert explained == codes | {0, 130}


# The site --------------------------------------------------------------------------------------------------


class Links(HTMLParser):
    """What a page of the site leads to or shows."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.names: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.found.append(unquote(value))
            if name in ("id", "name") and value:
                self.names.add(value)


def dead_links(site: Path) -> Iterator[str]:
    parsed = {}
    for page in site.rglob("*.html"):
        parsed[page.resolve()] = links = Links()
        links.feed(page.read_text(encoding="utf-8"))
    for page, links in parsed.items():
        for link in links.found:
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            if re.match(r"[a-z]+:|//", link) or page.name == "404.html":
                continue
            if not target.exists():
                yield f"{page.relative_to(site)}: {link}"
            elif (
                anchor
                and target in parsed
                and anchor not in parsed[target].names | {"__codelineno"}
                and "codelineno" not in anchor
            ):
                yield f"{page.relative_to(site)}: no {anchor} in {path}"


def build(to: Path, source: Path = ROOT) -> subprocess.CompletedProcess[str]:
    if find_spec("material") is None:
        pytest.skip("mkdocs-material is not installed; `make docs` installs it: pip install 'dapdata[docs]'")
    command = [sys.executable, str(source / "docs/build_site.py"), "--to", str(to)]
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_the_site_builds_without_a_dead_link(tmp_path: Path) -> None:
    done = build(tmp_path / "site")
    assert done.returncode == 0, done.stderr
    assert list(dead_links((tmp_path / "site").resolve())) == []
    pages = {path.stem for path in DOCS.glob("*.md")}
    assert pages <= {path.stem for path in (tmp_path / "site/docs").glob("*.html")}
    home = (tmp_path / "site/index.html").read_text()
    assert all(f"docs/{page}.html" in home for page in pages), "every page is in the navigation"


@pytest.mark.slow
def test_a_dead_link_fails_the_site(tmp_path: Path) -> None:
    runpy.run_path(str(DOCS / "build_site.py"))["copy_pages"](tmp_path / "source")
    (tmp_path / "source/docs/new.md").write_text("# New\n\n[nowhere](nowhere.md), [no heading](errors.md#nothing-here)\n")
    done = build(tmp_path / "site", tmp_path / "source")
    assert done.returncode == 1
    assert "nowhere.md" in done.stderr
    assert "nothing-here" in done.stderr
