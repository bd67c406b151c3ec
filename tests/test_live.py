"""`dapdata show --rerun`: what is written is what the arrays say; without rerun, or without a screen, one clear line."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from dapdata import cli, live, loading, show
from dapdata.errors import EnvironmentProblem


def test_without_rerun_it_is_one_line_that_names_the_extra(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.chdir(tmp_path)
    assert cli.run_app(["show", str(tiny), "--rerun"]) == 6
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.strip().splitlines()
    assert "pip install 'dapdata[viz]'" in line
    assert not list(tmp_path.iterdir())


def test_only_an_rrd_file_is_written_with_rerun(tiny: Path, tmp_path: Path) -> None:
    assert cli.run_app(["show", str(tiny), "--rerun", "--out", str(tmp_path / "x.html")]) == 2
    assert not list(tmp_path.iterdir())


def test_a_viewer_that_cannot_be_started_is_the_machines_fault(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Recording:
        def __init__(self, name: str) -> None:
            self.name = name

        def spawn(self) -> None:
            raise RuntimeError("Failed to find Rerun Viewer\nlong story")

    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(RecordingStream=Recording))
    with pytest.raises(EnvironmentProblem, match=r"\(Failed to find Rerun Viewer\), .* --out demos.rrd") as caught:
        live.stream(show.choose(tiny, count=1), "tiny")
    assert caught.value.exit_code == 6


def test_a_file_holds_the_clouds_and_poses_of_each_demo(tiny: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk (extra viz) is not installed")
    chunk = pytest.importorskip("rerun.chunk", reason="this rerun-sdk cannot read its files")
    assert cli.run_app(["show", str(tiny), "--rerun", "--out", str(tmp_path / "new/x.rrd"), "--demo", "1", "--demo", "3"]) == 0
    found: dict[str, dict[int, dict[str, Any]]] = {}
    for piece in chunk.RrdReader(tmp_path / "new/x.rrd").stream():
        batch = piece.to_record_batch()
        names = [name for name in batch.schema.names if name == "demo" or ":" in name]
        for row in batch.select(names).to_pylist() if "demo" in names else ():
            found.setdefault(piece.entity_path, {}).setdefault(row["demo"], {}).update(row)
    dataset = loading.open(tiny)
    for demo in (1, 3):
        sample = dataset[dataset.index["demo"].tolist().index(demo)]
        for body in ("container", "object"):
            points = np.array(found[f"/world/{body}/cloud"][demo]["Points3D:positions"])
            assert np.array_equal(points.astype(np.float32), sample[f"{body}/points"])
        (color,) = found["/world/goals/demonstrated"][demo]["Mesh3D:albedo_factor"]
        assert color >> 24 == round(255 * show.viewer.DEMONSTRATED[0])
        vertices = np.array(found["/world/goals/demonstrated"][demo]["Mesh3D:vertex_positions"])
        middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        assert np.allclose(middle, sample["pose/T_world_object_goal"][:3, 3], atol=2e-3)
        assert len(found["/world/correspondences"][demo]["LineStrips3D:strips"]) == len(sample["correspondence/distance"])
    assert len([path for path in found if path.startswith("/world/cameras/")]) == len(sample["camera/K"])
