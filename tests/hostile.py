"""Things that nobody should have to read: bombs, lies, links and noise, and what becomes of whoever reads them.

Run as a script it reads what it is told to, in a process of its own, and says as JSON what each came to, how much memory
that took, and what was touched that should not have been.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import struct
import sys
import traceback
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from forging import forge_file, forge_index, forge_manifest, forge_root

from dapdata import clouds, health, loading, manifest, pipeline, predictions, recipe
from dapdata.errors import DapdataError

HUGE = 10**12
ROWS = np.concatenate([np.random.default_rng(0).normal(size=(40, 3)), np.tile([0.0, 0.0, 1.0], (40, 1))], axis=1)
PLY = "ply\nformat {} 1.0\nelement vertex {}\n" + "".join(f"property float {n}\n" for n in clouds.FIELDS) + "end_header\n"
PCD = "FIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\n{}POINTS {}\nDATA {}\n"


class Trap:
    """Leaves a mark where it is unpickled."""

    def __reduce__(self) -> Any:
        return (os.mkdir, ("sprung",))


# Good ones, to be spoilt -------------------------------------------------------------------------------------


def good_ply() -> bytes:
    return PLY.format("binary_little_endian", len(ROWS)).encode() + ROWS.astype("<f4").tobytes()


def good_pcd() -> bytes:
    return PCD.format("", len(ROWS), "binary").encode() + ROWS.astype("<f4").tobytes()


def npy(array: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def npz(compressed: bool = False, **arrays: Any) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **arrays)
    return file.getvalue()


def good_cloud_npz() -> bytes:
    return npz(points=ROWS[:, :3], normals=ROWS[:, 3:])


def placements(**changes: Any) -> dict[str, Any]:
    n = 4
    good = {
        "demo": np.arange(n),
        "rank": np.zeros(n, int),
        "T_world_object": np.tile(np.eye(4), (n, 1, 1)),
        "score": np.zeros(n),
    }
    return good | changes


def lying_npy(shape: str, body: bytes = b"", descr: str = "<f8") -> bytes:
    """An npy file whose header promises more than it has."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + body


def zipped(**members: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return file.getvalue()


def zip_bomb(header: bytes, size: int) -> bytes:
    """A member that unpacks to zeros without end."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("points", "normals"):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(header)
                for _ in range(size // 10**7):
                    member.write(bytes(10**7))
    return file.getvalue()


def safetensors(header: dict[str, Any], body: bytes = b"", length: int | None = None) -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + body


def deep(levels: int) -> str:
    return "[" * levels + "]" * levels


# Fixed cases: by kind, what is put where, and what must be said of it -----------------------------------------

Make = Callable[[Path], object]


def at(*path: str | int, value: Any) -> Callable[[dict[str, Any]], None]:
    """Sets one value of a tree."""

    def change(tree: Any) -> None:
        for part in path[:-1]:
            tree = tree[part]
        tree[path[-1]] = value

    return change


def shard(root: Path) -> str:
    return manifest.read(root).shards[0].path


def in_manifest(*path: str | int, value: Any) -> Make:
    return lambda root: forge_manifest(root, at(*path, value=value))


def in_record(*path: str | int, value: Any) -> Make:
    return lambda root: forge_root(root, shard(root), at("attributes", "dapdata", *path, value=value))


def in_array(name: str, *path: str | int, value: Any) -> Make:
    def change(root: Path) -> None:
        tree = json.loads((root / shard(root) / name / "zarr.json").read_text())
        at(*path, value=value)(tree)
        forge_file(root, shard(root), f"{name}/zarr.json", json.dumps(tree).encode())

    return change


def linked(name: str) -> Make:
    """Moves something of the dataset to a folder outside, and links it from its place; `SHARD` is the first shard."""

    def change(root: Path) -> None:
        path = root / name.replace("SHARD", shard(root))
        target = root.parent / "outside" / path.name
        target.parent.mkdir(exist_ok=True)
        shutil.move(path, target)
        path.symlink_to(target)

    return change


def piped(name: str) -> Make:
    def change(root: Path) -> None:
        path = root / name.replace("SHARD", shard(root))
        path.unlink()
        os.mkfifo(path)

    return change


def text_of(name: str, text: str | bytes) -> Make:
    return lambda root: (root / name).write_bytes(text.encode() if isinstance(text, str) else text)


def sparse(name: str, size: int) -> Make:
    return lambda root: os.truncate(root / name, size)


def same_rows(count: int) -> Make:
    """An index in which one row is there so many times."""
    return lambda root: forge_index(root, lambda rows: rows.extend(rows[:1] * count))


DATASETS: dict[str, tuple[Make, str]] = {
    "a shard above the dataset": (in_manifest("shards", 0, "path", value="../outside"), "inside of the dataset"),
    "a shard at an absolute path": (in_manifest("shards", 0, "path", value="/etc"), "inside of the dataset"),
    "a unit above the dataset": (in_manifest("stages", "observe", "units", 0, "path", value="stages/../../x"), "inside of the"),
    "a file above the dataset": (in_manifest("files", value={"../x": "0" * 64}), "inside of the dataset"),
    "a name that steers a terminal": (in_manifest("shards", 0, "path", value="a\x1b[2Jb"), "inside of the dataset"),
    "a unit's file above the unit": (in_record("files", "../../x", value={"sha256": "0", "bytes": 1}), "outside of the"),
    "a unit's file at an absolute path": (in_record("files", "/etc/x", value={"sha256": "0", "bytes": 1}), "outside of the"),
    "a record that is none": (in_record("files", value=[1]), "cannot be read as a unit"),
    "rows that are none": (in_record("rows", value=[{"demo": -1}]), "cannot be read as a unit"),
    "a linked folder of shards": (linked("shards"), "shards"),
    "a linked shard": (linked("SHARD"), "missing|not part"),
    "a linked group": (linked("SHARD/container"), "container"),
    "a linked chunk": (linked("SHARD/meta/demo/c/0"), "meta/demo"),
    "a linked manifest": (linked("manifest.json"), "no plain file"),
    "a linked index": (linked("index.parquet"), "index.parquet"),
    "a pipe for a chunk": (piped("SHARD/meta/demo/c/0"), "meta/demo"),
    "a pipe for a manifest": (piped("manifest.json"), "no manifest.json"),
    "a pipe for an index": (piped("index.parquet"), "index.parquet"),
    "10^12 rows": (in_array("meta/demo", "shape", value=[HUGE]), "meta/demo"),
    "10^12 rows in a chunk": (in_array("meta/demo", "chunk_grid", "configuration", "chunk_shape", value=[HUGE]), "meta/demo"),
    "rows of another shape": (in_array("object/points", "shape", value=[3, 10**6]), "object/points"),
    "another type": (in_array("meta/demo", "data_type", value="string"), "meta/demo|zarr.json"),
    "codecs that are none": (in_array("meta/demo", "codecs", value=[{"name": "os.system"}]), "meta/demo|zarr.json"),
    "chunks under other names": (
        in_array("meta/demo", "chunk_key_encoding", value={"name": "v2", "configuration": {"separator": "."}}), "meta/demo",
    ),
    "rows of the index without end": (same_rows(10**5), "index.parquet"),
    "an index that is none": (text_of("index.parquet", b"PAR1" + b"\xff" * 200 + b"PAR1"), "index.parquet"),
    "a manifest without end": (sparse("manifest.json", 300_000_000), "bytes, expected at most"),
    "a manifest of brackets": (text_of("manifest.json", deep(100_000)), "nested too deeply"),
    "a manifest with NaN": (text_of("manifest.json", '{"format": NaN}'), "NaN, expected numbers that are finite"),
    "a manifest of noise": (text_of("manifest.json", bytes(range(256)) * 9), "manifest.json"),
    "stages in a circle": (in_manifest("stages", "demonstrate", "spec", "needs", value=["label"]), "stages"),
    "10^12 demos": (in_manifest("recipe", "demos", value=HUGE), "not those of a recipe"),
    "a recipe that is none": (in_manifest("recipe", value={"name": 3}), "recipe"),
    "somebody's picture": (text_of("secret.png", b"x"), "secret.png: not part of the dataset"),
}  # fmt: skip

CLOUDS: dict[str, tuple[str, bytes | Callable[[Path], object], str]] = {
    "10^12 points": ("a.ply", PLY.format("ascii", HUGE).encode(), "expected a whole number of at most"),
    "more points than bytes": ("a.ply", PLY.format("binary_big_endian", 5_000_000).encode(), "the file is cut off"),
    "lines that end early": ("a.ply", PLY.format("ascii", 5_000_000).encode() + b"1 2 3 0 0 1\n", "the file is cut off"),
    "a word without end": ("a.ply", PLY.format("ascii", 1).encode() + b"1" * 10**6 + b" 2 3 0 0 1\n", "more than 64 letters"),
    "a header without end": ("a.ply", b"ply\n" + b"comment\n" * 10**5, "has no header"),
    "an empty header": ("a.ply", b"\n\nend_header\n\n", "is no ply|has no header"),
    "numbers that are none": ("a.ply", PLY.format("ascii", 1).encode() + b"nan 2 3 0 0 1\n", "has NaN"),
    "numbers that are huge": ("a.ply", PLY.format("ascii", 1).encode() + b"1e300 2 3 0 0 1\n", "huge numbers"),
    "fields of many numbers": ("a.pcd", PCD.format("COUNT 3 1 1 1 1 1\n", 2, "binary").encode() + bytes(64), "expected 1 for"),
    "10^12 points in a pcd": ("a.pcd", PCD.format("", HUGE, "binary").encode(), "expected a whole number of at most"),
    "a member of 10^12 rows": ("a.npz", zipped(points=lying_npy("(1000000000000, 3)"), normals=npy(ROWS[:, 3:])), "cut short"),
    "a member of negative rows": ("a.npz", zipped(points=lying_npy("(-3, 3)"), normals=npy(ROWS[:, 3:])), "cut short"),
    "a zip bomb": ("a.npz", zip_bomb(lying_npy("(6000000, 3)"), 150_000_000), "expected at most"),
    "a pickle in an npz": ("a.npz", npz(points=np.array([Trap()]), normals=ROWS), "unpickled"),
    "a pickle in an npy": ("a.npy", npy(np.array([Trap()])), "unpickled"),
    "10^12 rows in an npy": ("a.npy", lying_npy("(1000000000000, 6)"), "cut short"),
    "a header that is code": ("a.npy", lying_npy("__import__('os').mkdir('sprung')"), "is no npy file"),
    "a pipe": ("a.ply", lambda p: os.mkfifo(p), "no plain file"),
    "a device": ("a.npy", lambda p: p.symlink_to("/dev/zero"), "no plain file"),
    "a folder": ("a.pcd", lambda p: p.mkdir(), "no plain file"),
    "5 million points of nothing": (
        "a.ply", lambda p: (p.write_bytes(PLY.format("binary_little_endian", 5_000_000).encode()), os.truncate(p, 130_000_000)),
        "normals of length 0",
    ),
}  # fmt: skip

RECIPES: dict[str, tuple[bytes | Callable[[Path], object], str]] = {
    "an alias bomb": (b"a: &a [1,1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a]\nc: [*b,*b,*b,*b,*b,*b,*b]\n", "anchors and aliases"),
    "a recipe without end": (lambda p: (p.touch(), os.truncate(p, 10**10)), "has more than 256000 bytes|not YAML"),
    "brackets": (b"a: " + b"[" * 100_000, "nested deeper than"),
    "a tag that calls": (b"a: !!python/object/apply:os.mkdir [sprung]\n", "the tag .* is not read"),
    "noise": (bytes(range(128, 256)) * 20, "not UTF-8"),
    "a folder": (lambda p: p.mkdir(), "a folder"),
    "numbers without end": (b"scene: {task: can_cabinet}\nseed: " + b"9" * 10**5, "seed"),
}

PREDICTIONS: dict[str, tuple[Callable[[], bytes] | Callable[[Path], object], str]] = {
    "a pickle": (lambda: npz(**placements(score=np.array([Trap()] * 4))), "unpickled"),
    "10^12 rows": (lambda: zipped(**{n: lying_npy("(1000000000000,)") for n in placements()}), "cut short"),
    "names that climb": (lambda: zipped(**{"../../demo": npy(np.arange(3))}), "expected arrays demo"),
    "NaN": (lambda: npz(**placements(T_world_object=np.full((4, 4, 4), np.nan))), "row 0: T_world_object: not a rigid pose"),
    "no zip": (lambda: pickle.dumps({"demo": 1}), "cannot be read as npz"),
}


# Reading -----------------------------------------------------------------------------------------------------


def read_dataset(root: Path) -> list[str]:
    """Everything that reads a dataset; what was said of it."""
    told: list[str] = []
    readers: tuple[Callable[[], Any], ...] = (
        lambda: [dict(sample) for sample in loading.open(root)],
        lambda: health.verify(root, quick=True).raise_if_damaged(),
        lambda: health.verify(root, deep=True).raise_if_damaged(),
        lambda: json.dumps(health.status(root).to_dict()),
        lambda: json.dumps(health.inspect(root).to_dict()),
        lambda: health.gc(root, dry_run=True),
        lambda: pipeline.label(root, ["label.eps_place=0.02"], dry_run=True, table="toy_stages"),
    )
    for reader in readers:
        try:
            reader()
            told.append("")
        except DapdataError as error:
            told.append(f"{error.exit_code} {error}")
    return told


def read_run(run: Path) -> Any:
    from daptrain import checkpoint
    from daptrain.infer import Predictor
    from daptrain.loop import build

    predictor = Predictor.load(run, "cpu")
    for network in (predictor.affordance, predictor.pose):
        import torch

        optimizer = torch.optim.AdamW(network.parameters())
        checkpoint.load_state(run, network, optimizer, {k: v.detach().clone() for k, v in network.named_parameters()})
        checkpoint.is_spent(run, network.name, 5, None)
    return build


READERS: dict[str, Callable[[Path], Any]] = {
    "cloud": clouds.read_cloud,
    "recipe": recipe.load,
    "predictions": predictions.read,
    "dataset": read_dataset,
    "run": read_run,
}


def outcome(kind: str, path: Path) -> list[str]:
    """What reading came to: for each reader "<exit code> <message>", or "" if it read; a traceback starts with "!"."""
    try:
        found = READERS[kind](path)
        return found if kind == "dataset" else [""]
    except DapdataError as error:
        return [f"{error.exit_code} {error}"]
    except Exception:
        return ["!" + traceback.format_exc()]


def peak_mb() -> int:
    """The most memory that this process has had. (What getrusage says begins with the parent's.)"""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) // 1024


FORBIDDEN = ("pickle.find_class", "os.system", "subprocess.Popen", "os.exec", "os.posix_spawn")


def main() -> None:
    """Reads the things named on stdin: {"warm": [[kind, path]], "read": [[kind, path]], "outside": folder}."""
    asked = json.load(sys.stdin)
    touched: list[str] = []
    armed = strict = False
    outside = os.path.realpath(asked["outside"])

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if not armed:
            return
        if event in FORBIDDEN or (strict and event == "exec"):
            touched.append(f"{event} {arguments[0] if arguments else ''}")
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            if path.startswith(outside):
                touched.append(f"{event} {path}")

    warm = [outcome(kind, Path(path)) for kind, path in asked["warm"]]
    sys.addaudithook(watch)
    armed = strict = True
    again = [outcome(kind, Path(path)) for kind, path in asked["warm"]]
    strict = False
    read, peaks = [], []
    for kind, path in asked["read"]:
        read.append(outcome(kind, Path(path)))
        peaks.append(peak_mb())
    armed = False
    print(json.dumps({"warm": warm, "again": again, "read": read, "touched": touched, "peak_mb": peaks}))


if __name__ == "__main__":
    main()
