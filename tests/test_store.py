"""Units on disk: what goes in comes out, nothing wrong goes in, and commits survive a power cut."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import toy_stages
import zarr

from dapdata import durable, rng, store
from dapdata.errors import CorruptionError, EnvironmentProblem
from dapdata.records import Demo, to_sample


def demo_sample(number: int) -> store.Sample:
    """The arrays of a random Demo."""
    for attempt in range(50):
        sections = {"scene": None, "placement": toy_stages.toy_recipe().placement}
        made = toy_stages.demonstrate({}, sections, lambda purpose, a=attempt: rng.stream(1, purpose, number, a))
        if isinstance(made, Demo):
            return to_sample(made)
    raise AssertionError("no demo")


def write(root: Path, samples: list[store.Sample]) -> Path:
    folder = root / "unit"
    folder.mkdir(parents=True)
    rows = [{"demo": i, "sha256": store.demo_digest(sample)} for i, sample in enumerate(samples)]
    store.write_unit(folder, [Demo], samples, {"rows": rows, "key": "k"})
    return folder


def test_what_is_written_is_read_back_bit_for_bit(tmp_path: Path) -> None:
    samples = [demo_sample(i) for i in range(4)]
    folder = write(tmp_path, samples)
    block = store.read_block(folder)
    for number, sample in enumerate(samples):
        back = block.sample(number)
        assert back.keys() == sample.keys()
        for path, array in sample.items():
            assert back[path].dtype == array.dtype
            np.testing.assert_array_equal(back[path], array)
        assert store.demo_digest(back) == store.demo_digest(sample)
    assert list(store.damaged_files(folder, store.read_record(folder))) == []


def test_a_unit_without_demos_can_be_written_and_read(tmp_path: Path) -> None:
    block = store.read_block(write(tmp_path, []))
    assert block.demos == 0
    assert block.arrays["goals/T_world_object"].shape == (0, 4, 4)
    assert block.arrays["goals/offsets"].tolist() == [0]


def test_every_array_says_what_it_is(tmp_path: Path) -> None:
    group = zarr.open_group(write(tmp_path, [demo_sample(0)]), mode="r")
    for path, column in store.COLUMNS.items():
        if path not in group:
            continue
        about = group[path].attrs
        assert about["unit"] == column.metadata["unit"]
        assert about["frame"] == column.metadata["frame"]
        assert about["description"]
        assert group[path].metadata.dimension_names[0] == column.metadata["dims"][0]


def test_strangers_who_list_a_unit_see_no_warning(tmp_path: Path) -> None:
    folder = write(tmp_path, [demo_sample(0)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        names = [name for name, _ in zarr.open_group(folder, mode="r").members(max_depth=None)]
    assert "pose/T_world_container" in names


def test_plain_zarr_refuses_a_flipped_byte_in_any_chunk(tmp_path: Path) -> None:
    folder = write(tmp_path, [demo_sample(i) for i in range(3)])
    group = zarr.open_group(folder, mode="r")
    for path in ("goals/T_world_object", "scene/size", "meta/demo"):
        chunk = next((folder / path / "c").rglob("*0"))
        chunk = chunk if chunk.is_file() else next(p for p in (folder / path / "c").rglob("*") if p.is_file())
        good = chunk.read_bytes()
        for at in (0, len(good) // 2, len(good) - 1):
            chunk.write_bytes(good[:at] + bytes([good[at] ^ 4]) + good[at + 1 :])
            with pytest.raises(Exception, match=r"."):
                group[path][...]
        chunk.write_bytes(good)


def test_a_missing_chunk_is_an_error_and_not_fill_values(tmp_path: Path) -> None:
    folder = write(tmp_path, [demo_sample(0)])
    next(p for p in (folder / "goals/kind/c").rglob("*") if p.is_file()).unlink()
    with pytest.raises(CorruptionError, match=r"goals/kind"):
        store.read_block(folder)


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("goals/T_world_object", np.nan, "not finite"),
        ("pose/T_world_container", 2.0, "rigid"),
        ("rejected_goals/reason", 200, "code 200"),
    ],
)
def test_values_that_cannot_be_true_are_refused(path: str, value: float, named: str) -> None:
    sample = next(s for s in map(demo_sample, range(20)) if len(s["rejected_goals/reason"]))
    broken = sample | {path: np.full_like(sample[path], value)}
    assert list(store.problems(sample)) == []
    assert any(path in problem and named in problem for problem in store.problems(broken))


def test_rows_of_one_group_must_agree() -> None:
    sample = demo_sample(0)
    sample["goals/kind"] = np.zeros(len(sample["goals/kind"]) + 1, np.uint8)
    assert any("goals/kind" in problem and "rows" in problem for problem in store.problems(sample))


def test_superpoint_numbers_must_be_rows() -> None:
    sample = {
        "container/superpoint": np.array([0, 1, 5], np.int32),
        "container_superpoints/size": np.array([1, 1, 1], np.int32),
    }
    assert any("container/superpoint" in problem for problem in store.problems(sample))


def test_a_full_disk_says_what_is_needed(tmp_path: Path) -> None:
    with pytest.raises(EnvironmentProblem, match=r"disk full.*12 MB"), durable.disk_problems(tmp_path, 12_000_000):
        raise OSError(28, "No space left on device")
