"""The documentation does what it says: its snippets run, its commands exist, its links lead somewhere, its pages are fresh."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import dapdata
from dapdata import keys, recipe, tasks

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "train/README.md", *sorted((ROOT / "docs").glob("*.md"))]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TRAIN_README = (ROOT / "train/README.md").read_text(encoding="utf-8")
ADD_A_TASK = (ROOT / "docs/add_a_task.md").read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


@pytest.fixture
def beside_data(tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A working directory in which the datasets that the pages name are the tiny one."""
    (tmp_path / "data").mkdir()
    for name in ("quickstart", "can_cabinet"):
        (tmp_path / "data" / name).symlink_to(tiny_dataset)
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("beside_data")
def test_the_readme_reads_a_shard_with_zarr_and_numpy_alone() -> None:
    (snippet,) = [block for block in blocks(README, "python") if "zarr" in block]
    assert sum(bool(line) for line in snippet.splitlines()) <= 6
    check = "assert xyz.shape == (len(score), 3) and len(score) > 100 and abs(score).max() <= 1\n"
    check += "import sys; assert not {'dapdata', 'torch', 'pybullet'} & {*sys.modules}"
    subprocess.run([sys.executable, "-c", snippet + check], check=True)


@pytest.mark.usefixtures("beside_data")
def test_the_readme_reads_a_dataset_with_torch() -> None:
    pytest.importorskip("torch")
    (snippet,) = [block for block in blocks(README, "python") if ".torch()" in block]
    scope: dict[str, object] = {}
    exec(compile(snippet, "README.md", "exec"), scope)
    assert scope["points"].shape[1] == 3  # type: ignore[attr-defined]
    assert scope["goals"].shape[1:] == (4, 4)  # type: ignore[attr-defined]
    assert scope["affordance"].ndim == 1  # type: ignore[attr-defined]


@pytest.mark.usefixtures("beside_data")
def test_the_readme_of_the_networks_reads_a_dataset_for_ones_own() -> None:
    pytest.importorskip("torch")
    (snippet,) = [block for block in blocks(TRAIN_README, "python") if "DataLoader" in block]
    scope: dict[str, object] = {"dapdata": dapdata}  # imported by the page's first snippet
    exec(compile(snippet, "train/README.md", "exec"), scope)
    assert "container/points" in scope["batch"]  # type: ignore[operator]


def test_the_recipe_of_the_readme_loads(tmp_path: Path) -> None:
    for text in blocks(README, "yaml"):
        (tmp_path / "x.yaml").write_text(text)
        recipe.load(tmp_path / "x.yaml")


def test_the_error_of_the_readme_is_the_one_that_is_printed(tmp_path: Path) -> None:
    (shown,) = re.findall(r"^recipes/x\.yaml:17: (.*)$", README, re.MULTILINE)
    with pytest.raises(ValueError, match=re.escape(shown)):
        recipe.from_resolved({"scene": {"task": "can_cabinet"}}, ["label.eps_place=30"])


def test_every_default_in_the_glossary_is_the_default() -> None:
    schema = recipe.recipe_class("can_cabinet").model_json_schema()
    rows = re.findall(r"^\| \S+ \| `([a-z_.]+)` \| (\S+) \| ([0-9.]+) \|", README, re.MULTILINE)
    assert len(rows) >= 4
    for name, unit, default in rows:
        body = keys.at(schema, tuple(name.split(".")))
        assert body["default"] == float(default), name
        assert body.get("unit", "1") == unit, name


def commands(text: str) -> set[str]:
    """Each `dapdata ...` that a page tells people to run, up to the end of its line or code."""
    return set(re.findall(r"(?:^|`|/)dapdata ([a-z]+[^`\n#|]*)", text, re.MULTILINE))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_command_and_option_that_a_page_names_exists(page: Path) -> None:
    import typer.main

    from dapdata import cli

    known = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
    for line in commands(page.read_text(encoding="utf-8")):
        name, *words = shlex.split(line)
        command = known[name]
        while words and words[0] in getattr(command, "commands", ()):
            command = command.commands[words.pop(0)]
        options = {option for parameter in command.params for option in [*parameter.opts, *parameter.secondary_opts]}
        assert {word for word in words if re.fullmatch(r"-{1,2}[a-z][a-z-]*", word)} <= options | {"--help"}, line


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_link_leads_to_a_file(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)\)", text):
        assert target.startswith("https://") or (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_every_recipe_key_that_a_page_names_exists(page: Path) -> None:
    schemas = [recipe.recipe_class(task).model_json_schema() for task in (*tasks.names(), *recipe.IMPORTED)]
    known = {".".join(map(str, path)) for schema in schemas for path, _ in keys.walk(schema)}
    sections = set(recipe.Recipe.model_fields) - {"name", "seed", "demos", "shard_size"}
    for name in re.findall(r"`([a-z]+\.(?!glb|urdf|json)[a-z_]+)`", page.read_text(encoding="utf-8")):
        assert name.split(".")[0] not in sections or name in known, name


def test_every_error_class_is_explained() -> None:
    from dapdata import errors

    page = (ROOT / "docs/errors.md").read_text(encoding="utf-8")
    for cls in vars(errors).values():
        if isinstance(cls, type) and issubclass(cls, errors.DapdataError) and cls is not errors.DapdataError:
            assert f"| `{cls.__name__}` | {cls.exit_code} |" in page
            assert f"| {cls.exit_code} |" in README


def test_generated_pages_are_fresh() -> None:
    pages = runpy.run_path(str(ROOT / "docs/make.py"))["pages"]()
    stale = [str(path.relative_to(ROOT)) for path, text in pages.items() if not path.exists() or path.read_text() != text]
    assert not stale, "run `make schemas`"


def test_the_task_of_the_documentation_works_without_touching_another_file(tmp_path: Path) -> None:
    """In a process of its own: the module is found because it is in the folder of tasks, and for no other reason."""
    (tmp_path / "tasks").mkdir()
    (code,) = blocks(ADD_A_TASK, "python")
    (text,) = blocks(ADD_A_TASK, "yaml")
    (tmp_path / "tasks/jar_shelf.py").write_text(code)
    (tmp_path / "jar_shelf.yaml").write_text(text)
    script = """
import sys
from dapdata import tasks
tasks.__path__.append("tasks")
from dapdata import health, pipeline, recipe
root = pipeline.generate(recipe.load("jar_shelf.yaml", ["demos=3", "cameras.width=160", "cameras.height=120"]), engine="inline")
pipeline.label(root, engine="inline")
about = health.inspect(root).to_dict()
assert about["task"] == "jar_shelf" and about["demos_in_shards"] == 3, about
assert about["per_demo"]["goals"]["max"] == 3, about
"""
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


def test_the_task_of_the_documentation_passes_the_tests_of_every_task(tmp_path: Path) -> None:
    for name in ("dapdata", "recipes", "tests", "schemas", "pyproject.toml"):
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, tmp_path)
    (tmp_path / "dapdata/tasks/jar_shelf.py").write_text(*blocks(ADD_A_TASK, "python"))
    (tmp_path / "recipes/jar_shelf.yaml").write_text(*blocks(ADD_A_TASK, "yaml"))
    command = [sys.executable, "-m", "pytest", "tests/test_tasks.py", "tests/test_recipe.py", "-k", "jar_shelf"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
