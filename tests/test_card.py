"""The card and the Croissant description say what the dataset is, and nothing else; what they tell people to run runs."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from fnmatch import fnmatch
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import make_toy
from toy_stages import toy_recipe

from dapdata import card, croissant, health, loading, manifest, pipeline, recipe, records


def card_of(root: Path) -> str:
    return (root / manifest.CARD).read_text(encoding="utf-8")


def header(text: str) -> dict[str, Any]:
    return dict(yaml.safe_load(text.split("---\n")[1]))


def block(text: str, language: str) -> str:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)[0]


def table(text: str, section: str) -> list[list[str]]:
    """The cells of the first table of a section, without its head."""
    (part,) = re.findall(rf"^## {section}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    rows = re.findall(r"^\| (.*) \|$", part, re.MULTILINE)
    return [row.split(" | ") for row in rows[2:]]


def description(root: Path) -> dict[str, Any]:
    return dict(json.loads((root / manifest.CROISSANT).read_bytes()))


# The card --------------------------------------------------------------------------------------------------


def test_the_loader_of_the_card_runs_in_the_datasets_folder_and_has_five_lines(tiny: Path) -> None:
    snippet = block(card_of(tiny), "python")
    assert len(snippet.splitlines()) == 5
    check = "import sys\nassert xyz.shape == (len(score), 3) and len(score) > 100 and 'dapdata' not in sys.modules\n"
    subprocess.run([sys.executable, "-c", snippet + check], cwd=tiny, check=True, env=os.environ)


def test_the_recipe_of_the_card_is_the_datasets(tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "again.yaml").write_text(block(card_of(tiny), "json"))
    assert recipe.resolve(recipe.load(tmp_path / "again.yaml")) == manifest.read(tiny).recipe


@pytest.mark.slow
def test_the_recipe_of_the_card_makes_the_dataset_again(tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "again.yaml").write_text(block(card_of(tiny), "json"))
    again = pipeline.generate(tmp_path / "again.yaml", tmp_path / "again", engine="inline")
    assert isinstance(again, Path)
    pipeline.label(again, engine="inline")
    assert manifest.read(again).content_sha256 == manifest.read(tiny).content_sha256
    assert card_of(again) == card_of(tiny)
    assert description(again) == description(tiny)


def test_the_header_is_what_the_hub_reads(tiny: Path) -> None:
    found = header(card_of(tiny))
    assert (found["license"], found["task_categories"], found["size_categories"]) == ("cc0-1.0", ["robotics"], ["n<1K"])
    assert (tiny / found["configs"][0]["data_files"]).is_file()
    assert found["pretty_name"] == "tiny"


def test_the_card_counts_what_the_index_counts(tiny: Path) -> None:
    about = manifest.read(tiny)
    for name, demos, containers, things, *shared in table(card_of(tiny), "Splits"):
        entry = about.splits[name]
        assert [int(demos), int(containers), int(things)] == [
            entry.demos,
            len(entry.container_instances),
            len(entry.object_instances),
        ]
        assert shared == ["0", "0"]
    index = manifest.read_index(tiny)
    for name, mean in table(card_of(tiny), "What a demo holds"):
        assert float(mean) == pytest.approx(index[name.replace(" ", "_")].mean(), abs=0.05)
    told = {(reason, int(count)) for _, reason, count in table(card_of(tiny), "What was rejected")}
    rejects = about.rejects
    assert told == {*rejects.attempts.items(), *rejects.demos.items(), *rejects.goals.items()}


def test_a_leak_between_splits_shows_in_the_card(tiny: Path) -> None:
    index = {name: column.copy() for name, column in manifest.read_index(tiny).items()}
    train, test = (np.flatnonzero(index["split"] == name)[0] for name in ("train", "test"))
    index["object_instance"][test] = index["object_instance"][train]
    text = card.render(manifest.read(tiny).model_dump(mode="json"), {}, 5, index, [])
    assert {row[0]: row[4:] for row in table(text, "Splits")} == {"train": ["0", "1"], "val": ["0", "0"], "test": ["0", "1"]}


def test_the_card_names_every_array_with_its_unit_and_frame(tiny: Path) -> None:
    told = {row[0]: row[3:5] for row in table(card_of(tiny), "Arrays")}
    assert told == {f"`{c.metadata['path']}`": [c.metadata["unit"], c.metadata["frame"]] for c in records.columns()}
    assert "`p_a = T_a_b @ p_b`" in card_of(tiny)


def test_every_stage_has_a_word_in_the_card() -> None:
    imported = card.origin({"recipe": {"scene": {"source": "demos"}}})
    for about in (card.DRAWN, imported):
        assert {**card.DOES, **about.does}.keys() == {stage.name for stage in pipeline.STAGES}


def test_an_unlabelled_dataset_says_what_to_run(tmp_path: Path) -> None:
    root = pipeline.generate(toy_recipe(), tmp_path / "toy", engine="inline", table="toy_stages")
    assert isinstance(root, Path)
    assert "run `dapdata label` on this folder" in card_of(root)
    assert "configs" not in header(card_of(root))
    assert not (root / manifest.CROISSANT).exists()
    assert health.verify(root).ok


def test_card_and_description_belong_to_the_dataset_and_come_back_the_same(toy_copy: Path) -> None:
    files = {name: (toy_copy / name).read_bytes() for name in (manifest.CARD, manifest.CROISSANT)}
    for name, data in files.items():
        (toy_copy / name).write_bytes(data[:-9])
        assert health.verify(toy_copy, quick=True).problems == (f"{name}: its bytes are not those that were written",)
        (toy_copy / name).write_bytes(data)
    for name in files:
        (toy_copy / name).unlink()
    make_toy(toy_copy)
    assert {name: (toy_copy / name).read_bytes() for name in files} == files
    assert health.verify(toy_copy).ok


def test_a_copy_without_the_cached_stages_is_whole_and_says_what_it_cannot(toy_copy: Path) -> None:
    shutil.rmtree(toy_copy / "stages/observe")
    assert not health.verify(toy_copy, quick=True).ok  # a part of the cache is damage, none of it a choice
    shutil.rmtree(toy_copy / "stages")
    found = health.verify(toy_copy)
    assert found.ok
    assert "cannot be labelled again" in found.notes[0]
    (toy_copy / manifest.read(toy_copy).shards[0].path / "zarr.json").unlink()
    assert not health.verify(toy_copy).ok


# Croissant -------------------------------------------------------------------------------------------------


def test_the_description_names_the_files_that_are_there(tiny: Path) -> None:
    index, shards = description(tiny)["distribution"]
    data = (tiny / index["contentUrl"]).read_bytes()
    assert index["sha256"] == sha256(data).hexdigest()
    assert index["contentSize"] == f"{len(data)} B"
    for entry in manifest.read(tiny).shards:
        assert any(fnmatch(f"{entry.path}/zarr.json", pattern) for pattern in shards["includes"])


def test_the_description_has_a_field_for_every_column_and_a_record_for_every_array(tiny: Path) -> None:
    demos, arrays = description(tiny)["recordSet"]
    assert [field["source"]["extract"]["column"] for field in demos["field"]] == list(manifest.read_index(tiny))
    assert [record["arrays/path"] for record in arrays["data"]] == [c.metadata["path"] for c in records.columns()]
    assert set(croissant.SENTENCES) <= set(manifest.read_index(tiny))


@pytest.mark.slow
def test_mlcroissant_finds_no_fault_and_reads_the_records(tiny: Path, caplog: pytest.LogCaptureFixture) -> None:
    mlcroissant = pytest.importorskip("mlcroissant", reason="needs the extra interop: `make test-all` installs it")
    found = mlcroissant.Dataset(tiny / manifest.CROISSANT)  # raises if there is an error
    warnings = re.findall(r"^  -  (.*)$", caplog.text, re.MULTILINE)
    assert [w for w in warnings if "datePublished" not in w] == []
    index = manifest.read_index(tiny)
    rows = list(found.records("demos"))
    for name, column in index.items():
        read = [row[f"demos/{name}"] for row in rows]
        assert [value.decode() if isinstance(value, bytes) else value for value in read] == column.tolist()
    assert len(list(found.records("arrays"))) == len(list(records.columns()))
    assert found.metadata.name == loading.open(tiny).manifest.name
