"""The spine in one command: a recipe becomes shards, two trained networks, and a report whose oracle succeeds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dapdata import cli

pytest.importorskip("torch")
pytest.importorskip("pybullet")


def test_a_recipe_becomes_a_report(
    tiny_recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["run", str(tiny_recipe), "--minutes", "0.4", "--trials", "1", "-k", "2"]
    assert cli.run_app(command) == 0, capsys.readouterr().err
    text = capsys.readouterr().out
    report = json.loads((tmp_path / "runs/tiny/report.json").read_text())
    assert report["judge"]["sound"]
    assert report["success"]["success_top1"]["n"] == 1
    assert {"oracle", "heuristic", "random"} <= report["references"].keys()
    for name in ("report.html", "predictions.npz", "curves.png", "dataset.png", "dataset.html", "container.ply", "object.ply"):
        assert (tmp_path / "runs/tiny" / name).stat().st_size > 100, name
    assert "runs/tiny/report.html" in text

    suggestion = text.split("try next: dapdata ")[1].split()
    assert cli.run_app([*suggestion, "-k", "2", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["placements"]) == 2

    assert cli.run_app(["eval", "--trials", "1", "-k", "2", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["digests"]["predictions"] == report["digests"]["predictions"]

    assert cli.run_app(["eval", "--method", "heuristic", "--trials", "1", "-k", "2"]) == 0
    assert (tmp_path / "runs/heuristic-tiny/report.json").exists()
