"""The shape of the code, read from its syntax: who imports whom, one door per library, no unsafe reading."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DAPDATA = sorted((ROOT / "dapdata").rglob("*.py"))
DAPTRAIN = sorted((ROOT / "train/daptrain").rglob("*.py"))

# A module imports only from lines above its own. Modules of a package may import their siblings in observe, which is one
# stage, in engines, which is one interface, in interop, and in tasks/mixed.py, which is made of the other tasks.
LINES = (
    ("errors", "rng", "poses", "config"),
    ("records", "strict_yaml", "durable", "npz", "console"),
    ("solids", "registration", "keys", "slic", "split", "matching", "tables", "buckets", "sense", "clouds"),
    ("meshes", "tabletop"),
    ("tasks",),
    ("simulate", "observe", "cluster", "labels"),
    ("recipe", "store", "stages", "engines", "manifest", "card", "report", "predictions"),
    ("croissant", "remote"),
    ("plan", "units", "slurm"),
    ("pipeline",),
    ("loading", "draw", "schemas", "plots", "reproduce"),
    ("metrics", "audit", "pictures", "page"),
    ("viewer", "live", "health"),
    ("show", "bench", "doctor", "interop"),
    ("imports",),
    ("cli",),
    ("__main__",),
)
LINE = {module: number for number, modules in enumerate(LINES) for module in modules}
DOMAIN = frozenset(("solids", "meshes", "tabletop", "tasks", "simulate", "observe", "cluster", "labels"))
MUST_NOT_KNOW = {
    **dict.fromkeys(("store", "stages", "engines", "manifest", "buckets", "remote"), DOMAIN),
    **dict.fromkeys(
        ("loading", "metrics", "card", "croissant", "show", "interop"), frozenset(("pipeline", "engines", "tasks"))
    ),
}
DAPTRAIN_MAY_KNOW = {
    "loading", "metrics", "records", "poses", "simulate", "errors", "rng", "config", "solids", "meshes", "report",
    "predictions", "pictures", "draw", "page", "plots", "viewer", "matching", "clouds", "console", "durable",
    "cluster",  # a user's own cloud must be partitioned as the training clouds were
}  # fmt: skip
DOORS = {
    "pybullet": {"simulate"},
    "zarr": {"store"},
    "open3d": {"meshes"},
    "typer": {"cli"},
    "trimesh": {"solids", "meshes"},
    "ray": {"engines"},
    "grpc": {"engines"},
    "torch": {"loading", "daptrain"},
    "yaml": {"strict_yaml"},
    "plotly": {"plots"},
    "rerun": {"live"},
    "fsspec": {"buckets"},
    "s3fs": {"buckets"},
}
HEAVY = (
    "pybullet",
    "numba",
    "open3d",
    "trimesh",
    "torch",
    "scipy",
    "matplotlib",
    "zarr",
    "pyarrow",
    "pandas",
    "rich",
    "plotly",
    "rerun",
    "fsspec",
    "s3fs",
)
QUATERNION_WORDS = ("quat", "getEulerFromQuaternion", "as_quat")


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def module_of(path: Path) -> str:
    """`labels` for dapdata/labels.py, `tasks` for dapdata/tasks/can_cabinet.py, `daptrain` for all of train/daptrain."""
    if ROOT / "train" in path.parents:
        return "daptrain"
    inside = path.relative_to(ROOT / "dapdata")
    return inside.parts[0].removesuffix(".py")


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Every module that a file imports, anywhere in it, as (dotted name, line); relative imports are not used."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: relative import"
            names = [alias.name for alias in node.names]
            if node.module in ("dapdata", "dapdata.tasks", "daptrain"):
                yield from ((f"{node.module}.{name}", node.lineno) for name in names)
            else:
                yield str(node.module), node.lineno
        elif isinstance(node, ast.Call) and called(node) in ("require", "errors.require", "import_module"):
            yield from ((str(name.value), node.lineno) for name in node.args[:1] if isinstance(name, ast.Constant))


def called(node: ast.Call) -> str:
    """The dotted name of what is called, as written."""
    return ast.unparse(node.func)


def calls(path: Path) -> Iterator[tuple[ast.Call, str]]:
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Call):
            yield node, called(node)


@pytest.mark.parametrize("path", [p for p in DAPDATA if p.parent == ROOT / "dapdata"], ids=lambda p: p.name)
def test_every_module_has_a_line(path: Path) -> None:
    assert path.name == "__init__.py" or module_of(path) in LINE


@pytest.mark.parametrize("path", DAPDATA, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_file_imports_only_from_lines_above_its_own(path: Path) -> None:
    own = module_of(path)
    if own == "__init__":  # the public names, imported when asked for
        return
    wrong = []
    for name, line in imports(path):
        package, _, rest = name.partition(".")
        other = rest.split(".")[0]
        if package == "daptrain":
            wrong += [f"{path}:{line}: {name}"] if own not in ("cli",) else []
        among_siblings = own == other and (own in ("observe", "engines", "interop") or path.stem == "mixed")
        if package != "dapdata" or other not in LINE or among_siblings:
            continue
        if LINE[other] >= LINE[own] or other in MUST_NOT_KNOW.get(own, ()):
            wrong.append(f"{path}:{line}: {own} imports {other}")
    assert not wrong


@pytest.mark.parametrize("path", DAPTRAIN, ids=lambda p: str(p.relative_to(ROOT)))
def test_daptrain_knows_only_what_a_customer_may(path: Path) -> None:
    known = {name.split(".")[1] for name, _ in imports(path) if name.startswith("dapdata.")}
    assert known - DAPTRAIN_MAY_KNOW - {"open"} == set()


@pytest.mark.parametrize("library", DOORS)
def test_each_library_has_one_door(library: str) -> None:
    users = {module_of(path) for path in [*DAPDATA, *DAPTRAIN] for name, _ in imports(path) if name.split(".")[0] == library}
    assert users <= DOORS[library]


def test_only_rng_makes_generators() -> None:
    makers = ("default_rng", "Generator", "SeedSequence", "RandomState", "PCG64", "Philox", "seed")
    found = [
        f"{path}:{node.lineno}: {name}"
        for path in [*DAPDATA, *DAPTRAIN]
        if path.name != "rng.py"
        for node, name in calls(path)
        if name.startswith(("np.random.", "numpy.random.", "random.")) and name.split(".")[-1] in makers
    ]
    assert not found
    assert not [path for path in [*DAPDATA, *DAPTRAIN] if any(name == "random" for name, _ in imports(path))]


UNSAFE_MODULES = ("pickle", "dill", "marshal", "shelve")
UNSAFE_CALLS = ("eval", "exec", "compile", "torch.load", "torch.save", "yaml.load", "yaml.unsafe_load", "yaml.full_load")


def test_nothing_read_can_run_code() -> None:
    found = []
    for path in [*DAPDATA, *DAPTRAIN]:
        found += [f"{path}:{line}: {name}" for name, line in imports(path) if name.split(".")[0] in UNSAFE_MODULES]
        for node, name in calls(path):
            options = {option.arg: ast.unparse(option.value) for option in node.keywords}
            unsafe = name in UNSAFE_CALLS
            unsafe |= name in ("np.load", "numpy.load") and options.get("allow_pickle") != "False"
            found += [f"{path}:{node.lineno}: {name}"] if unsafe else []
    assert not found


def test_quaternions_live_in_simulate_alone() -> None:
    found = [
        f"{path}:{node.lineno}"
        for path in [*DAPDATA, *DAPTRAIN]
        if module_of(path) != "simulate"
        for node in ast.walk(tree_of(path))
        for name in (getattr(node, part, None) for part in ("id", "attr", "arg", "name"))
        if isinstance(name, str) and any(word in name for word in QUATERNION_WORDS)
    ]
    assert not found


def test_no_file_is_a_drawer_for_odds_and_ends() -> None:
    assert not {path.stem for path in [*DAPDATA, *DAPTRAIN]} & {"utils", "util", "common", "helpers", "misc"}


def test_importing_the_package_recipes_and_commands_loads_nothing_heavy() -> None:
    code = "import sys, dapdata, dapdata.recipe, dapdata.cli, daptrain; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {name.split(".")[0] for name in loaded} & set(HEAVY)


def test_starting_the_command_does_not_even_load_numpy() -> None:
    code = "import sys, dapdata.cli; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {name.split(".")[0] for name in loaded} & {*HEAVY, "numpy", "pydantic", "yaml"}
