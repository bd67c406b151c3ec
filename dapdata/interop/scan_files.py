"""Scanned demonstrations as they lie on disk: where they are, what each holds, and what is wrong with it.

A demonstration is a folder with clouds of container and object before and after (docs/import_scans.md). Nothing is believed:
a demonstration with a fault is rejected by reason, and counted; REASONS has all of them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from dapdata import clouds, durable, npz
from dapdata.clouds import Points
from dapdata.config import ScansConfig, Section, key
from dapdata.errors import FormatError, UsageError
from dapdata.interop.rpdiff_files import Fault, below, is_inside, natural
from dapdata.poses import pose, rotate, rotation_about, transform
from dapdata.records import Rejected

Array = NDArray[Any]
Vector = tuple[float, float, float]

REASONS = {  # besides those of a cloud that is too small
    "bad_scan_json": "`scan.json` is no JSON, or has a key or a value that is not known",
    "missing_cloud": "a cloud of container or object, before or after, is not there",
    "unreadable": "a file is damaged, cut off, has no x y z or more than 5 million points",
    "bad_labels": "labels that are not one for each point, or views that are no camera's number",
    "empty_mask": "no point is labelled as the container, or none as the object",
    "not_finite": "points or normals with NaN or infinity, other than pixels without depth in a whole row",
    "not_metres": "a container that is not 5 cm to 5 m across, or an object that is not 5 mm to 1 m",
    "bad_camera": "a camera pose that is no rotation and shift, or a mirrored one",
    "wrong_up": "the table is level with another axis than `up`, or the cameras are below it",
    "table_in_cloud": "most of the container or object is a level plane at its foot that reaches beyond the rest: the table",
    "scattered": "more than a fifth of a cloud is far from the rest of it",
    "no_normals": "no normals in the files, and no cameras to turn estimated ones to",
    "normals_inwards": "normals that come with the clouds, and look into the object; there are no cameras to turn them to",
    "start_and_end_swapped": "the object is in the container before and beside it after",
    "not_placed": "the object is not in or at the container after",
    "container_does_not_fit": "the container after is not the one before, moved on the table",
    "does_not_fit": "no motion of the object explains enough of what was seen after, or of what was seen before",
    "ambiguous": "another motion, that brings the object's surface elsewhere, explains what was seen as well",
}
STAGES, BODIES = ("start", "end"), ("container", "object")
LABELS = {"container": 1, "object": 2}  # anything else is neither
SUFFIXES = (".ply", ".pcd", ".npz")
CLOUDS = (*STAGES, *(f"{stage}_{body}" for stage in STAGES for body in BODIES))  # names without suffix
ABOUT = "scan.json"
SPANS = {"container": (0.05, 5.0), "object": (0.005, 1.0)}  # m
ROUGH = 1e-3  # of a rotation in text with few digits
FEW = 100  # points that are neither: fewer tell no table
SAMPLE = 65_536  # bytes at the beginning, middle and end of a file by which another one is known
LEVEL = 0.01  # m: thickness of a table in a scan
FOOT_SHARE, FOOT_WIDER = (0.25, 0.97), 4.0  # shares of points and times the area that make a foot a table
LEVEL_SHARE = 2.0  # times as many of the rest's points lie in one layer across another axis: that one is up


class CameraAbout(Section):
    """A camera that saw the scan, at the start and at the end."""

    T_world_camera: list[list[float]] = key(..., "4x4, in the scan's frame and units; OpenCV axes: x right, y down, z ahead")
    K: list[list[float]] | None = key(None, "3x3 intrinsics, px; with them, and views of points, cameras are aligned")


class About(Section):
    """What `scan.json` may tell: beside the demonstrations for all of them, in one for it alone."""

    units: Literal["m", "mm"] = key("m", "of points and camera positions")
    up: Literal["+x", "-x", "+y", "-y", "+z", "-z"] = key("+z", "axis of the scan that points up")
    table: float | None = key(
        None, "height of the table top along it; null: of the points that are neither, or the lowest ones"
    )
    container: str = key("", "which container it is: demonstrations with the same one are in one split")
    object: str = key("", "which object it is")
    symmetry: Literal["none", "box", "revolution"] = key("none", "of the object: what turns nobody can tell apart")
    axis: Vector | None = key(None, "of a revolution, in the scan's frame at the start; null: up")
    opening: Vector | None = key(None, "out of the container, in the scan's frame at the start; null: up")
    cameras: list[CameraAbout] = key([], "the cameras; `view` of a point is a place in this list", max_length=64)


@dataclass(frozen=True)
class Scan:
    """One demonstration, checked and in our world frame: metres, z up, z = 0 on the table."""

    folder: Path
    about: About
    clouds: Mapping[tuple[str, str], Points]  # by stage and body; points and normals in the world frame
    rest: Points  # what is of neither body in the start: the table, mostly
    axis: Array  # (3,) unit, world
    opening: Array  # (3,) unit, world
    K: Array  # (V, 3, 3) px; NaN where it is not known
    T_world_camera: Array  # (V, 4, 4)


# Where the demonstrations are ------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def find(source: str) -> tuple[tuple[Path, ...], str]:
    """The folders of the demonstrations below a folder, in the order of their names, and a digest of the source.

    The digest is over names, sizes, what `scan.json` files hold, and samples of all other files.

    Raises:
        FormatError: nothing is there, or nothing that could be a demonstration.
    """
    root = Path(source)
    if not root.is_dir():
        raise FormatError(f"{root}: no such folder, expected one with a folder for each demonstration; check the path")
    files = [path for path in sorted(below(root, (*SUFFIXES, ".npy", ".json")), key=natural) if is_inside(path, root)]
    ours = [path for path in files if path.name == ABOUT or (path.suffix.lower() in SUFFIXES and path.stem in CLOUDS)]
    labels = [path for path in files if path.name in {f"{stage}_labels.npy" for stage in STAGES}]
    folders = tuple(dict.fromkeys(path.parent for path in ours if path.name != ABOUT))
    if not folders:
        raise FormatError(
            f"{root}: no folder with start.ply and end.ply (or pcd, npz), expected a folder for each demonstration; "
            "`dapdata init scans DIR` writes an example"
        )
    whole = sha256()
    for path in (*ours, *labels):
        whole.update(durable.canonical([path.relative_to(root).as_posix(), path.stat().st_size]) + _sample(path))
    return folders, whole.hexdigest()


def _sample(path: Path) -> bytes:
    size, parts = path.stat().st_size, []
    with path.open("rb") as file:
        for at in (0, size // 2, max(0, size - SAMPLE)):
            file.seek(at)
            parts.append(file.read(SAMPLE))
    return sha256(b"".join(parts)).digest()


def scene_section(source: str) -> dict[str, Any]:
    """The scene section of a recipe that imports from a source, with the digest of what is there now."""
    return {"task": "scans", "source": source, "source_sha256": find(source)[1]}


def folder_of(config: ScansConfig, demo: int) -> Path:
    """Where demonstration number `demo` is, in the source that was asked for and no other."""
    folders, digest = find(config.source)
    if digest != config.source_sha256:
        raise FormatError(f"{config.source}: has changed since the import began, expected the same files; import it again")
    if demo >= len(folders):
        raise UsageError(f"{config.source}: demo {demo} of {len(folders)}, expected at most {len(folders)}; lower --demos")
    return folders[demo]


def rejected(config: ScansConfig, demo: int, fault: Fault) -> Rejected:
    """What becomes of demonstration number `demo` of the source, with its folder in the detail."""
    return Rejected(fault.reason, f"{folder_of(config, demo).name}: {fault.detail}")


# What a demonstration holds --------------------------------------------------------------------------------


def read(config: ScansConfig, demo: int) -> Scan:
    """Demonstration number `demo` of the source, checked.

    Raises:
        Fault: with the first reason against it.
        FormatError: the source has changed since its digest was taken.
    """
    folder = folder_of(config, demo)
    about = read_about(Path(config.source), folder)
    K, T_scan_camera = _cameras(about)
    raw, rest = _clouds(folder, len(K))
    scale = 0.001 if about.units == "mm" else 1.0
    for (stage, body), cloud in raw.items():
        _check_span(f"{stage}, {body}", cloud.points * scale, SPANS[body], about.units)
    R_world_scan = _rotation_to_up(about.up)
    turn = pose(R_world_scan)
    level = {where: _moved(cloud, turn, scale) for where, cloud in raw.items()}
    rest = _moved(rest, turn, scale)
    table = _table(about, rest.points, level["start", "container"].points) if about.table is None else about.table * scale
    T_world_scan = pose(R_world_scan, (0, 0, -table))
    T_world_camera = np.array([_camera_in_world(T, T_world_scan, scale) for T in T_scan_camera]).reshape(-1, 4, 4)
    down = pose(None, (0, 0, -table))
    turned = {where: _moved(cloud, down) for where, cloud in level.items()}
    _check_up(about, T_world_camera, turned["start", "container"].points)
    if config.check_table:
        for (stage, body), cloud in turned.items():
            _check_no_table(f"{stage}, {body}", cloud.points, about.table is not None or len(rest.points) >= FEW)
    axis, opening = (np.array((0, 0, 1.0)) if v is None else R_world_scan @ _unit(v) for v in (about.axis, about.opening))
    return Scan(folder, about, turned, _moved(rest, down), axis, opening, K, T_world_camera)


def read_about(source: Path, folder: Path) -> About:
    """What the `scan.json` of the source and that of the demonstration tell; the latter wins.

    Raises:
        Fault: either is none.
    """
    told: dict[str, Any] = {}
    for path in dict.fromkeys((source / ABOUT, folder / ABOUT)):
        if path.is_file():
            try:
                found = json.loads(path.read_bytes())
            except (OSError, ValueError, RecursionError) as error:
                raise Fault("bad_scan_json", f"{path.name}: {error}, expected JSON") from error
            if not isinstance(found, dict):
                raise Fault("bad_scan_json", f"{path.name}: {type(found).__name__}, expected an object with keys")
            told |= found
    try:
        about = About.model_validate_json(json.dumps(told))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        known = f"; known keys: {', '.join(About.model_fields)}" if first["type"] == "extra_forbidden" else ""
        raise Fault("bad_scan_json", f"{ABOUT}: {where}: {first['msg'][:1].lower()}{first['msg'][1:]}{known}") from error
    for name in ("axis", "opening"):
        vector = getattr(about, name)
        if vector is not None and not 0 < np.linalg.norm(vector) < np.inf:
            raise Fault("bad_scan_json", f"{ABOUT}: {name}: got {list(vector)}, expected a direction")
    return about


def _unit(vector: Vector) -> Array:
    return np.asarray(np.array(vector) / np.linalg.norm(vector))


def _moved(cloud: Points, T: Array, scale: float = 1.0) -> Points:
    """A cloud scaled, then moved."""
    normals = None if cloud.normals is None else rotate(T, cloud.normals)
    return Points(transform(T, cloud.points * scale), normals, None, cloud.view)


def _rotation_to_up(up: str) -> Array:
    """(3, 3) the smallest turn that brings an axis such as "-y" to z."""
    sign, k = (1 if up[0] == "+" else -1), "xyz".index(up[1])
    if k == 2:
        return np.eye(3) if sign > 0 else rotation_about((1, 0, 0), np.pi).round()
    return rotation_about((0, -1, 0) if k == 0 else (1, 0, 0), sign * np.pi / 2).round()


def _cameras(about: About) -> tuple[Array, Array]:
    """(V, 3, 3) and (V, 4, 4), in the scan's frame and units."""
    K, T = np.full((len(about.cameras), 3, 3), np.nan), np.zeros((len(about.cameras), 4, 4))
    for v, camera in enumerate(about.cameras):
        for name, shape, into in (("T_world_camera", (4, 4), T), ("K", (3, 3), K)):
            value = getattr(camera, name)
            if value is None:
                continue
            if [len(row) for row in value] != [shape[1]] * shape[0] or not np.isfinite(value).all():
                raise Fault("bad_camera", f"cameras.{v}.{name}: expected {shape[0]} rows of {shape[1]} finite numbers")
            into[v] = value
        R = T[v, :3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > ROUGH or np.linalg.det(R) < 0 or (T[v, 3] != (0, 0, 0, 1)).any():
            what = "mirrored (its determinant is negative)" if np.linalg.det(R) < 0 else "no rotation and shift"
            raise Fault("bad_camera", f"cameras.{v}.T_world_camera: is {what}, expected a rigid pose of the camera in the scan")
        left, _, right = np.linalg.svd(R)
        T[v, :3, :3] = left @ right
        if not np.isnan(K[v]).any() and (K[v, [0, 1], [0, 1]] <= 0).any():
            raise Fault("bad_camera", f"cameras.{v}.K: focal lengths {K[v, 0, 0]}, {K[v, 1, 1]}, expected more than 0 px")
    return K, T


def _camera_in_world(T_scan_camera: Array, T_world_scan: Array, scale: float) -> Array:
    return np.asarray(T_world_scan @ pose(T_scan_camera[:3, :3], T_scan_camera[:3, 3] * scale))


def _clouds(folder: Path, cameras: int) -> tuple[dict[tuple[str, str], Points], Points]:
    """The four clouds of a demonstration, and the points of its start that are of neither body, as in the files."""
    found: dict[tuple[str, str], Points] = {}
    rest = Points(np.zeros((0, 3)), None, None, None)
    for stage in STAGES:
        whole = _file(folder, stage)
        if whole is not None:
            cloud = _read(whole)
            label = _labels(folder / f"{stage}_labels.npy", cloud)
            for body in BODIES:
                found[stage, body] = _part(cloud, label == LABELS[body])
            if stage == "start":
                is_rest = ~np.isin(label, [*LABELS.values()]) & np.isfinite(cloud.points).all(axis=1)
                rest = _part(Points(cloud.points, None, None, cloud.view), is_rest)
        for body in BODIES:
            path = _file(folder, f"{stage}_{body}")
            if path is not None:
                found[stage, body] = _read(path)
            if (stage, body) not in found:
                raise Fault("missing_cloud", f"no {stage}.ply and no {stage}_{body}.ply (or pcd, npz), expected one of them")
    for (stage, body), cloud in found.items():
        where = f"{stage}, {body}"
        if not len(cloud.points):
            raise Fault("empty_mask", f"{where}: no points, expected some with label {LABELS[body]}")
        for name, array in (("points", cloud.points), ("normals", cloud.normals)):
            if array is not None and not np.isfinite(array).all():
                bad = int((~np.isfinite(array).all(axis=1)).sum())
                raise Fault("not_finite", f"{where}: {bad} of {len(array)} {name} are not finite; remove them")
        if cloud.view is not None and not (cloud.view.min() >= 0 and cloud.view.max() < max(cameras, 1)):
            raise Fault("bad_labels", f"{where}: views {cloud.view.min()} to {cloud.view.max()}, expected 0 to {cameras - 1}")
    return found, rest


def _file(folder: Path, stem: str) -> Path | None:
    return next((path for suffix in SUFFIXES if (path := folder / f"{stem}{suffix}").is_file()), None)


def _read(path: Path) -> Points:
    try:
        return clouds.read_points(path)
    except FormatError as error:
        raise Fault("unreadable", str(error).replace(str(path), path.name)) from error


def _labels(path: Path, cloud: Points) -> Array:
    """(N,) labels of a cloud, from the file beside it or its own."""
    label = cloud.label
    if path.is_file():
        try:
            with path.open("rb") as file:
                label = npz.read_array(file, path.stat().st_size)
        except npz.BROKEN as error:
            raise Fault("unreadable", f"{path.name}: is no npy file of whole numbers ({error})") from error
    if label is None:
        raise Fault("bad_labels", f"no label of each point and no {path.name}, expected 1 for the container, 2 for the object")
    if label.shape != (len(cloud.points),) or label.dtype.kind not in "iub":
        raise Fault("bad_labels", f"{path.name}: {label.dtype} {label.shape}, expected {len(cloud.points)} whole numbers")
    return np.asarray(label)


def _part(cloud: Points, rows: Array) -> Points:
    normals, label, view = (None if array is None else array[rows] for array in (cloud.normals, cloud.label, cloud.view))
    return Points(cloud.points[rows], normals, label, view)


# Is it plausible -------------------------------------------------------------------------------------------


def _check_span(where: str, points: Array, limits: tuple[float, float], units: str) -> None:
    span = float(np.max(np.quantile(points, 0.98, axis=0) - np.quantile(points, 0.02, axis=0)))
    least, most = limits
    if not least <= span <= most:
        looks = [(unit, factor) for unit, factor in (("mm", 0.001), ("m", 1000)) if least <= span * factor <= most]
        hint = f'; it looks like {looks[0][0]}: set "units": "{looks[0][0]}" in {ABOUT}' if looks else ""
        raise Fault("not_metres", f"{where}: {span:.4g} m across in units of {units}, expected {least} to {most} m{hint}")


def _layer(heights: Array) -> tuple[float, float]:
    """Height and share of the points in the fullest layer of thickness LEVEL."""
    ordered = np.sort(heights)
    inside = np.searchsorted(ordered, ordered + LEVEL, side="right") - np.arange(len(ordered))
    at = int(inside.argmax())
    return float(np.median(ordered[at : at + inside[at]])), inside[at] / len(ordered)


def _table(about: About, rest: Array, container: Array) -> float:
    """Height of the table, m: of the fullest layer of what is neither container nor object, or of the container's foot.

    Args:
        rest: (R, 3), container: (N, 3), m, with z up as told.
    """
    if len(rest) < FEW:
        return float(np.quantile(container[:, 2], 0.01))
    found = [_layer(rest[:, k]) for k in range(3)]
    best = int(np.argmax([share for _, share in found]))
    if best != 2 and found[best][1] > 0.3 and found[best][1] > LEVEL_SHARE * found[2][1]:
        named = "xyz"[int(np.abs(_rotation_to_up(about.up)[best]).argmax())]
        raise Fault(
            "wrong_up",
            f"{found[best][1]:.0%} of the points that are neither lie in one layer across {named}, {found[2][1]:.0%} across "
            f'{about.up[1]}, expected the table across "up"; set "up": "+{named}" or "-{named}" in {ABOUT}',
        )
    return found[2][0]


def _check_up(about: About, T_world_camera: Array, container: Array) -> None:
    if len(T_world_camera):
        above = T_world_camera[:, 2, 3] - float(np.median(container[:, 2]))
        if above.max() < 0:
            raise Fault(
                "wrong_up",
                f"all cameras are {-above.max():.2f} m or more below the container with up {about.up}, expected one above; "
                f'set "up" in {ABOUT}, or give poses of cameras in the scan, not of the scan in cameras',
            )


def _check_no_table(where: str, points: Array, is_known: bool) -> None:
    """Whether the foot of a body is not much wider than all above it, and as high as the table if that is known: a table.

    A stand's foot may be as wide, but what is seen of it is its upper face.
    """
    foot = points[:, 2] < np.quantile(points[:, 2], 0.01) + LEVEL
    if not FOOT_SHARE[0] <= foot.mean() <= FOOT_SHARE[1]:
        return
    if is_known and abs(float(np.median(points[foot, 2]))) > LEVEL / 2:
        return
    below, above = (np.quantile(part[:, :2], (0.02, 0.98), axis=0) for part in (points[foot], points[~foot]))
    wider = float(np.prod(np.ptp(below, axis=0)) / np.prod(np.ptp(above, axis=0)))
    if wider > FOOT_WIDER:
        raise Fault(
            "table_in_cloud",
            f"{where}: {foot.mean():.0%} of the points are within {LEVEL * 100:.0f} cm of its foot, on {wider:.1f} times the "
            "area of the rest, expected no table in the mask; take it out, or --set scene.check_table=false if it is a tray",
        )
