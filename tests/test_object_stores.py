"""Datasets in buckets: the same bytes, whole or absent, for every reader, whatever fails and whoever else writes."""

from __future__ import annotations

import functools
import gc
import http.server
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import make_toy
from forging import forge_arrays
from s3_server import Server
from toy_stages import toy_recipe

import dapdata
from dapdata import buckets, cli, durable, health, manifest, pipeline, remote, reproduce
from dapdata.buckets import Conflict, Folder
from dapdata.errors import CorruptionError, EnvironmentProblem, FormatError, LockedError, QuarantineError, UsageError

pytest.importorskip("s3fs")
pytest.importorskip("moto")

HERE = Path(__file__).parent
TABLE = "toy_stages"
DEMOS, SHARD_SIZE = 4, 2
OURS_ALONE = (".lock", "log.jsonl", ".lease")  # of the machinery; no part of the data
COMMAND = f"""
import sys
from dapdata import pipeline
from toy_stages import toy_recipe
pipeline.generate(toy_recipe({DEMOS}, {SHARD_SIZE}), sys.argv[1], engine="inline", table="toy_stages")
"""


def generate(url: str) -> None:
    pipeline.generate(toy_recipe(DEMOS, SHARD_SIZE), url, engine="inline", table=TABLE)


def label(url: str) -> None:
    pipeline.label(url, engine="inline", table=TABLE)


def verify(url: str) -> None:
    assert health.verify(url).ok


COMMANDS = (generate, label, verify)
REQUESTS: dict[Callable[[str], None], list[tuple[str, str]]] = {}  # that each made for `bucket_toy`


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    """An S3 server, found by this process and those that it starts; its client repeats nothing by itself."""
    server = Server()
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**server.environment(), "AWS_MAX_ATTEMPTS": "1"}.items():
            patch.setenv(name, value)
        patch.setattr(buckets, "FIRST_PAUSE", 0.01)
        yield server
    server.stop()


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of `bucket_toy`, made on this machine. Not to be changed."""
    return make_toy(tmp_path_factory.mktemp("small") / "toy", DEMOS, SHARD_SIZE)


@pytest.fixture(scope="module")
def bucket_toy(server: Server) -> str:
    """A labelled dataset of random arrays in a bucket. Not to be changed."""
    url = f"{server.bucket('my-bucket')}/quickstart"
    for command in COMMANDS:
        server.requests.clear()
        command(url)
        REQUESTS[command] = list(server.requests)
    return url


@pytest.fixture
def memory(small: Path, tmp_path: Path) -> Folder:
    """The same dataset in a store in this process's memory, which a test may damage."""
    folder = Folder(f"memory://{tmp_path.name}/toy")
    folder.upload(small, [name for name in files_of(small) if name not in OURS_ALONE])
    return folder


def files_of(root: Path) -> dict[str, bytes]:
    """What a folder holds."""
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def objects_of(folder: Folder) -> dict[str, bytes]:
    """What a store holds below a folder."""
    tops = folder.children().items()
    names = [name for top, is_folder in tops for name in (folder.sizes(top) if is_folder else [top])]
    return {name: folder.read(name) or b"" for name in names}


def without_machinery(files: dict[str, bytes]) -> dict[str, bytes]:
    return {name: data for name, data in files.items() if name not in OURS_ALONE}


# The same dataset ------------------------------------------------------------------------------------------


def test_a_dataset_made_in_a_bucket_is_byte_for_byte_the_one_made_here(server: Server, bucket_toy: str, small: Path) -> None:
    assert without_machinery(server.objects(bucket_toy)) == without_machinery(files_of(small))
    assert list(Path(os.environ.get("TMPDIR", "/tmp")).glob(f"{remote.SCRATCH}*/copy/stages")) == []


def test_what_is_told_of_it_is_the_same_under_its_own_name(bucket_toy: str, memory: Folder, small: Path) -> None:
    there, here = health.inspect(bucket_toy).to_dict(), health.inspect(small).to_dict()
    assert there == here | {"root": bucket_toy}
    there, here = health.status(bucket_toy).to_dict(), health.status(small).to_dict()
    assert there["root"] == bucket_toy
    assert there["published"] == here["published"]
    assert health.verify(memory.url) == replace(health.verify(small), root=memory.url)


def test_readers_get_the_same_samples(bucket_toy: str, small: Path) -> None:
    there, here = dapdata.open(bucket_toy), dapdata.open(str(small))
    assert repr(there) == f"Dataset(root='{bucket_toy}', split=None)"
    assert len(there) == len(here)
    for one, other in zip(there, here):
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[path], other[path]) for path in one)


def test_torch_loaders_with_two_workers_read_from_a_bucket(bucket_toy: str, small: Path) -> None:
    data = pytest.importorskip("torch").utils.data
    paths = ("container/points", "meta/demo")
    dataset = dapdata.open(bucket_toy)  # this process has talked to the store before it forks
    mapped = data.DataLoader(dataset.torch(paths), batch_size=None, num_workers=2)
    streamed = data.DataLoader(dataset.stream(shuffle=True, paths=paths), batch_size=None, num_workers=2)
    here = {int(sample["meta/demo"]): sample["container/points"] for sample in dapdata.open(small)}
    for loader in (mapped, streamed):
        there = {int(sample["meta/demo"]): sample["container/points"].numpy() for sample in loader}
        assert there.keys() == here.keys()
        assert all(np.array_equal(there[demo], here[demo]) for demo in here)
    child = os.fork()  # that lets go of the dataset, whose tables are its parent's
    if child == 0:
        del dataset, mapped, streamed, loader
        gc.collect()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert len(dataset.index["positives"]) == len(here)


def test_only_what_is_asked_for_is_read(bucket_toy: str, server: Server) -> None:
    server.requests.clear()
    dataset = dapdata.open(bucket_toy)
    assert [path.split("/")[-1] for _, path in server.requests] == ["manifest.json", "index.parquet"]
    server.requests.clear()
    dataset.block(str(dataset.index["shard"][0]), ["pose/T_world_object_goal", "goals/kind"])
    names = sorted(path.split(".zarr/")[1] for _, path in server.requests)
    chunks = ["goals/kind/c/0", "goals/offsets/c/0", "pose/T_world_object_goal/c/0/0/0"]
    described = ["goals/kind/zarr.json", "goals/offsets/zarr.json", "pose/T_world_object_goal/zarr.json", "zarr.json"]
    assert names == sorted(chunks + described)


def test_a_url_may_be_of_any_store_that_fsspec_opens(memory: Folder, small: Path) -> None:
    assert dapdata.open(memory.url).digest == dapdata.open(small).digest == dapdata.open(f"file://{small}").digest
    assert health.verify(memory.url).ok
    with pytest.raises(UsageError, match=r"a URL as a Path"):
        dapdata.open(Path(memory.url))
    with pytest.raises(UsageError, match=r"nothing://.*Protocol not known.*expected a folder or a URL"):
        dapdata.open("nothing://x/y")


@pytest.fixture
def website(small: Path) -> Iterator[str]:
    """The dataset behind a plain web server."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *args: Any) -> None:
            pass

        def list_directory(self, path: Any) -> None:  # type: ignore[override]
            self.send_error(403)

    handler = functools.partial(Quiet, directory=str(small.parent))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as web:
        threading.Thread(target=web.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{web.server_port}/toy"
        web.shutdown()


def test_a_web_server_without_listings_serves_a_dataset(website: str, small: Path) -> None:
    assert np.array_equal(dapdata.open(website)[1]["container/points"], dapdata.open(small)[1]["container/points"])
    assert health.verify(website).ok
    with pytest.raises(UsageError, match=r"writing to http:// is not supported"):
        pipeline.label(website, engine="inline", table=TABLE)
    with pytest.raises(FormatError, match=rf"{website}x: no manifest.json"):
        dapdata.open(f"{website}x")


# Never half visible ----------------------------------------------------------------------------------------


def kill_at(server: Server, url: str, calls: Path, number: int) -> int:
    """Runs the command in a process that is killed when its n-th write arrives, which is not done any more; its exit code."""
    environment = os.environ | {"PYTHONPATH": f"{HERE}:{os.environ.get('PYTHONPATH', '')}", "TOY_CALLS": str(calls)}
    process = subprocess.Popen([sys.executable, "-c", COMMAND, url], env=environment, start_new_session=True)
    seen = 0

    def gate(method: str, path: str) -> str | None:
        nonlocal seen
        seen += method in ("PUT", "POST", "DELETE")
        if seen == number:
            os.killpg(process.pid, signal.SIGKILL)
        return "cut" if seen >= number else None

    with server.gated(gate):
        return process.wait(120)


def test_killed_in_the_middle_it_goes_on_and_makes_nothing_twice(
    server: Server, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, calls = f"{server.bucket()}/toy", tmp_path / "calls"
    assert kill_at(server, url, calls, 120) == -signal.SIGKILL  # of 198; the first unit has 94
    assert server.objects(url).keys() >= {remote.LEASE, "progress.json"}
    with pytest.raises(FormatError, match="run it again to go on"):
        dapdata.open(url)
    assert health.status(url).to_dict()["in_progress"]["done"] == {"demonstrate": 1, "observe": 1}
    calls.unlink()
    monkeypatch.setenv("TOY_CALLS", str(calls))
    pipeline.generate(toy_recipe(DEMOS, SHARD_SIZE), url, engine="inline", table=TABLE)
    assert calls.read_text().split().count("observe") == SHARD_SIZE
    there, here = server.objects(url), files_of(small)
    stages = {name for name in here if name.startswith(("stages/demonstrate", "stages/observe"))}
    assert {name: data for name, data in there.items() if name.startswith("stages")} == {name: here[name] for name in stages}
    assert there.keys() - stages == {"manifest.json", "README.md", "log.jsonl"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
def test_killed_at_any_write_it_ends_with_the_same_bytes(server: Server, small: Path, tmp_path: Path, seed: int) -> None:
    url = f"{server.bucket()}/toy"
    for life, number in enumerate(np.random.default_rng(seed).integers(1, 190, 2)):
        code = kill_at(server, url, tmp_path / "calls", int(number))
        assert code == -signal.SIGKILL or (life, code) == (1, 0)  # the second may have less to do than that
        with suppress(FormatError):
            assert health.verify(url).ok
    make_toy(url, DEMOS, SHARD_SIZE)
    assert without_machinery(server.objects(url)) == without_machinery(files_of(small))


class Crash(BaseException):
    """The process is gone: nothing catches it."""


def test_a_crash_at_any_request_of_a_publication_leaves_a_whole_dataset_or_none(
    memory: Folder, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A preview is added: picture, card and manifest change, and the crash comes before each request in turn."""
    ask, crashes, unpublished = Folder._ask, 0, 0
    for last in range(60):
        done = 0

        def stop(self: Folder, name: str, call: Any, last: int = last) -> Any:
            nonlocal done
            done += 1
            if done > last:
                raise Crash
            return ask(self, name, call)

        monkeypatch.setattr(Folder, "_ask", stop)
        try:
            pipeline.attach(memory.url, {"preview/goals.png": bytes([last])})
        except Crash:
            crashes += 1
        else:
            break
        finally:
            monkeypatch.setattr(Folder, "_ask", ask)
        memory.remove([remote.LEASE])  # its holder is this process, which is still there
        try:
            found = dapdata.open(memory.url)
        except FormatError:
            unpublished += 1
            pipeline.generate(toy_recipe(DEMOS, SHARD_SIZE), memory.url, engine="inline", table=TABLE)
            found = dapdata.open(memory.url)
        assert found.digest == manifest.read(small).content_sha256
        assert {name: sha256(memory.read(name) or b"").hexdigest() for name in found.manifest.files} == found.manifest.files
    assert crashes > 8
    assert unpublished > 2
    assert memory.read("preview/goals.png") == bytes([last])
    assert health.verify(memory.url, quick=True).ok


def test_readers_see_one_publication_or_the_other(memory: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    """The labels change while a reader has the old manifest already and the index not yet."""
    download, changed = Folder.download, False

    def late(self: Folder, names: Any, target: Path) -> None:
        nonlocal changed
        if not changed:
            changed = True
            pipeline.label(memory.url, ["label.eps_place=0.02"], engine="inline", table=TABLE)
        download(self, names, target)

    monkeypatch.setattr(Folder, "download", late)
    found = dapdata.open(memory.url)
    assert found.manifest.recipe["label"]["eps_place"] == 0.02
    assert set(found.index["shard"]) == {shard.path for shard in found.manifest.shards}


def test_a_dataset_that_is_being_published_is_none(memory: Folder) -> None:
    memory.write(manifest.MANIFEST, remote.NOTE + b'"process 1", "at": 1}')
    with pytest.raises(FormatError, match=rf"{memory.url}: no manifest.json"):
        dapdata.open(memory.url)


# One writer at a time --------------------------------------------------------------------------------------


def test_the_second_writer_is_told_who_works(memory: Folder, capsys: pytest.CaptureFixture[str]) -> None:
    with remote.working_copy(memory.url) as root, durable.lock(root):
        before = objects_of(memory)
        assert health.status(memory.url).to_dict()["working"].startswith(f"process {os.getpid()} on ")
        assert cli.run_app(["gc", memory.url]) == 5
        assert f"{memory.url}: in use by process {os.getpid()}" in capsys.readouterr().err
        assert objects_of(memory) == before
    assert health.status(memory.url).to_dict()["working"] is None


@pytest.mark.parametrize("guard", ["lease", "manifest"])
def test_of_two_publishers_one_fails_and_changes_nothing(server: Server, monkeypatch: pytest.MonkeyPatch, guard: str) -> None:
    """One stands still until its lease is gone; another publishes; then the first wants to."""
    url = f"{server.bucket()}/toy"
    pipeline.generate(toy_recipe(1, 1, seed=7), url, engine="inline", table=TABLE)
    if guard == "manifest":  # it must do alone, whatever the clocks
        monkeypatch.setattr(remote.Lease, "renew", lambda self: None)
    with remote.working_copy(url) as root, durable.lock(root):
        Folder(url).remove([remote.LEASE])
        Folder(url).write("manifest.json", server.objects(url)["manifest.json"] + b" ")  # the other
        theirs = server.objects(url)
        with pytest.raises(LockedError, match="run the same command again"):
            manifest.publish(root, manifest.read(root), {"README.md": b"mine"})
    assert without_machinery(server.objects(url)) == without_machinery(theirs)


def lease_of(who: str, machine: str, seconds: float, pid: int) -> bytes:
    return json.dumps({"holder": who, "machine": machine, "until": time.time() + seconds, "pid": pid}).encode()


def test_a_lease_lasts_until_its_end_or_its_holder_dies(memory: Folder) -> None:
    dead = subprocess.Popen(["true"])
    dead.wait()
    for lease in (
        lease_of("a dead process", remote._machine(), 50, dead.pid),
        lease_of("another machine", "far away", -1, 1),
        b"nothing of ours",
    ):
        memory.write(remote.LEASE, lease)
        health.gc(memory.url)
        assert memory.read(remote.LEASE) is None
    memory.write(remote.LEASE, lease_of("process 1 on elsewhere", "far away", 50, 1))
    with pytest.raises(LockedError, match=r"in use by process 1 on elsewhere.*ends in (49|50) s"):
        health.gc(memory.url)
    assert memory.read(remote.LEASE) is not None


def test_a_lease_is_renewed_as_long_as_its_holder_works(memory: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "LEASE_SECONDS", 0.4)
    with remote.working_copy(memory.url) as root, durable.lock(root):
        time.sleep(1.0)
        assert health.status(memory.url).to_dict()["working"]
    assert health.status(memory.url).to_dict()["working"] is None


def test_those_who_share_a_lease_keep_out_who_wants_it_alone_and_the_reverse(memory: Folder) -> None:
    with remote.working_copy(memory.url) as one, remote.working_copy(memory.url) as other:
        with durable.lock(one, shared=True), durable.lock(other, shared=True):
            with pytest.raises(LockedError, match=rf"{memory.url}: in use by process {os.getpid()}"):
                health.gc(memory.url)
            assert health.status(memory.url).to_dict()["working"]
        with durable.lock(one), pytest.raises(LockedError, match="in use by"), durable.lock(other, shared=True):
            raise AssertionError("two writers")
    assert not [name for name in memory.children() if name.startswith(remote.LEASE)]


def test_who_waits_for_a_lease_gets_it_and_renews_it(memory: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "LEASE_SECONDS", 0.4)
    monkeypatch.setattr(remote, "PAUSE", 0.05)
    memory.write(remote.LEASE, lease_of("another machine", "far away", 0.5, 1))
    with remote.working_copy(memory.url) as root, durable.lock(root, patience=30):
        time.sleep(1.0)
        assert health.status(memory.url).to_dict()["working"].startswith(f"process {os.getpid()}")


def test_tasks_share_the_work_on_a_bucket_and_the_last_one_publishes(small: Path, tmp_path: Path) -> None:
    url = f"memory://{tmp_path.name}/shared"
    for task in ("0/2", "1/2"):
        assert Folder(url).read("manifest.json") is None
        pipeline.generate(toy_recipe(DEMOS, SHARD_SIZE), url, units=task, engine="inline", table=TABLE)
    pipeline.label(url, engine="inline", table=TABLE)
    assert without_machinery(objects_of(Folder(url))) == without_machinery(files_of(small))


def test_two_writes_on_one_condition_are_not_both_done(server: Server, memory: Folder) -> None:
    for folder in (memory, Folder(server.bucket())):
        first = folder.write_if("x", b"one", None)
        with pytest.raises(Conflict):
            folder.write_if("x", b"two", None)
        assert folder.write_if("x", b"one", None) == first  # as after an answer that got lost
        second = folder.write_if("x", b"two", first)
        with pytest.raises(Conflict):
            folder.write_if("x", b"three", first)
        assert folder.read_tagged("x") == (b"two", second)
        folder.remove(["x", "y"])
        with pytest.raises(Conflict):
            folder.write_if("x", b"three", second)


def test_a_store_that_takes_no_notice_of_conditions_is_refused(server: Server) -> None:
    url = f"{server.bucket()}/toy"
    server.heedless = True
    try:
        with pytest.raises(EnvironmentProblem, match=r"writes whatever the conditions"):
            pipeline.generate(toy_recipe(1, 1), url, engine="inline", table=TABLE)
    finally:
        server.heedless = False
    assert server.objects(url).keys() <= {remote.LEASE}


# What fails ------------------------------------------------------------------------------------------------


def test_errors_that_pass_are_survived(server: Server, tmp_path: Path) -> None:
    """One request in eight is refused, cut in its middle, or done and not answered."""
    url, rng = f"{server.bucket()}/toy", np.random.default_rng(0)
    faults: list[Any] = [("503 Slow Down", "SlowDown"), ("500 Oh", "InternalError"), "cut", "lost"]
    seen = dict.fromkeys(map(str, faults), 0)

    def gate(method: str, path: str) -> Any:
        if rng.random() > 1 / 8:
            return None
        fault = faults[int(rng.integers(len(faults)))]
        seen[str(fault)] += 1
        return fault

    with server.gated(gate):
        pipeline.generate(toy_recipe(2, 2), url, engine="inline", table=TABLE)
    assert min(seen.values()) > 0
    here = pipeline.generate(toy_recipe(2, 2), tmp_path / "toy", engine="inline", table=TABLE)
    assert without_machinery(server.objects(url)) == without_machinery(files_of(Path(here)))


@pytest.mark.parametrize("fault", ["cut", "lost"])
def test_a_lost_answer_to_a_conditional_write_is_no_conflict(server: Server, fault: str) -> None:
    folder, asked = Folder(f"{server.bucket()}/toy"), 0

    def gate(method: str, path: str) -> str | None:
        nonlocal asked
        asked += 1
        return fault if asked % 2 else None

    with server.gated(gate):
        tag = folder.write_if("x", b"one", None)
        assert folder.write_if("x", b"two", tag)
    assert folder.read("x") == b"two"


def one_line(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """What a command says that fails with exit code 6."""
    capsys.readouterr()
    assert cli.run_app(arguments) == 6
    told = capsys.readouterr()
    lines = [line for line in told.err.splitlines() if "trying again" not in line and not line.startswith("label:")]
    assert told.out == ""
    assert len(lines) == 1, lines
    return lines[0]


def test_what_the_store_refuses_is_one_line_and_leaves_nothing_behind(
    server: Server, bucket_toy: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = server.objects(bucket_toy)
    for command in ("label", "verify", "inspect"):
        assert "s3://no-such-bucket/toy: no such bucket, expected one" in one_line(capsys, [command, "s3://no-such-bucket/toy"])
    denied = ("403 Forbidden", "AccessDenied")
    with server.gated(lambda method, path: denied if method == "PUT" else None):
        assert "access denied (AccessDenied: refused by a test), expected credentials" in one_line(
            capsys, ["label", bucket_toy]
        )
    with server.gated(lambda method, path: denied):
        assert "access denied" in one_line(capsys, ["status", bucket_toy])
    monkeypatch.setattr(buckets, "PATIENCE", 0.1)
    with server.gated(lambda method, path: ("503 Slow Down", "SlowDown")):
        assert "no answer that helps" in one_line(capsys, ["label", bucket_toy])
    assert server.objects(bucket_toy) == before


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"AWS_ACCESS_KEY_ID": None, "AWS_SECRET_ACCESS_KEY": None}, "no credentials (Unable to locate credentials)"),
        ({"AWS_PROFILE": "nobody"}, "no credentials (The config profile (nobody) could not be found)"),
        ({"AWS_ENDPOINT_URL_S3": "http://127.0.0.1:9"}, "no answer that helps (Could not connect to the endpoint URL"),
    ],
    ids=["no credentials", "no profile", "no endpoint"],
)
def test_an_environment_that_does_not_fit_is_one_line(
    server: Server,
    changes: dict[str, str | None],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    import s3fs

    for name, value in changes.items():
        monkeypatch.setenv(name, value) if value is not None else monkeypatch.delenv(name)
    monkeypatch.setattr(buckets, "PATIENCE", 0.1)
    s3fs.S3FileSystem.clear_instance_cache()
    try:
        line = one_line(capsys, ["inspect", "s3://my-bucket/quickstart"])
    finally:
        s3fs.S3FileSystem.clear_instance_cache()
    assert line.startswith("s3://my-bucket/quickstart: ")
    assert said in line


def test_a_missing_extra_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    assert "pip install 'dapdata[s3]'" in one_line(capsys, ["inspect", "s3://my-bucket/toy"])


def test_a_full_disk_is_said_of_the_disk_and_not_of_the_store(memory: Folder, tmp_path: Path) -> None:
    code = """
import resource
from dapdata import buckets, pipeline
from toy_stages import toy_recipe
resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))
try:
    pipeline.generate(toy_recipe(8), "memory://toy", engine="inline", table="toy_stages")
except Exception as error:
    print(type(error).__name__, error.exit_code, error)
"""
    environment = os.environ | {"PYTHONPATH": f"{HERE}:{os.environ.get('PYTHONPATH', '')}", "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.startswith(f"EnvironmentProblem 6 {tmp_path}: disk full")


# Damage ----------------------------------------------------------------------------------------------------


def test_damage_in_a_store_is_found_and_named(memory: Folder, small: Path) -> None:
    found = manifest.read(small)
    one, other = (shard.path for shard in found.shards)
    cached = found.stages["observe"].units[0].path
    flipped, cut, gone = (f"{one}/container/{name}/c/0" for name in ("points", "normals", "view"))
    good = memory.read(f"{flipped}/0") or b""
    memory.write(f"{flipped}/0", good[:9] + bytes([good[9] ^ 1]) + good[10:])
    memory.write(f"{cut}/0", (memory.read(f"{cut}/0") or b"")[:-1])
    memory.remove([gone, f"{other}/zarr.json"])
    memory.write(f"{cached}/extra", b"x")
    memory.write(f"{cached}/../../../../../evil", b"x")
    memory.write("index.parquet", b"")
    memory.write("notes.txt", b"")
    report = health.verify(memory.url)
    expected = {
        f"{one}: container/points/c/0/0: its bytes are not those that were written",
        f"{one}: container/normals/c/0/0: {len(memory.read(f'{cut}/0') or b'')} bytes, expected",
        f"{one}: container/view/c/0: missing",
        f"{other}: missing",
        f"{cached}: extra: not part of the unit",
        f"{cached}: %2E%2E%2F%2E%2E%2F%2E%2E%2F%2E%2E%2F%2E%2E%2Fevil: not part of the unit",
        "index.parquet: its bytes are not those that were written",
        "notes.txt: not part of the dataset",
    }
    assert all(any(line.startswith(start) for line in report.problems) for start in expected), report.problems
    assert len(report.problems) == len(expected)


def test_every_depth_of_verify_looks_into_a_store_as_into_a_folder(memory: Folder, small: Path, tmp_path: Path) -> None:
    for depth in ({"quick": True}, {}, {"deep": True}):
        assert health.verify(memory.url, **depth) == replace(health.verify(small, **depth), root=memory.url)
    assert reproduce.reproduce(memory.url, 1, engine="inline", table=TABLE) == (1, [])
    other = Path(shutil.copytree(small, tmp_path / "toy"))
    unit = manifest.read(other).stages["observe"].units[0].path
    forge_arrays(other, unit, lambda sample: sample.update({"container/normals": -sample["container/normals"]}))
    memory.upload(other, [name for name in files_of(other) if name == "manifest.json" or name.startswith(unit)])
    assert health.verify(memory.url).ok
    (problem,) = {line.partition(": demo ")[2][3:] for line in health.verify(memory.url, deep=True).problems}
    assert problem == "what stage observe made is not what its own unit holds"
    _, problems = reproduce.reproduce(memory.url, 99, engine="inline", table=TABLE)
    assert problems[0].startswith(f"{unit}: made anew, 1 of ")


def test_a_reader_is_told_which_shard_is_damaged(memory: Folder, small: Path) -> None:
    data = dapdata.open(memory.url)
    one, other = (shard.path for shard in data.manifest.shards)
    memory.remove([f"{one}/goals/kind/c/0"])
    with pytest.raises(CorruptionError, match=re.escape(f"{memory.url}/{one}: goals/kind")):
        data.block(one)
    memory.remove([f"{other}/zarr.json"])
    with pytest.raises(CorruptionError, match=re.escape(f"{memory.url}/{other}: missing, expected a shard")):
        data.block(other)


def test_a_damaged_unit_is_not_built_upon(memory: Folder, small: Path) -> None:
    unit = manifest.read(small).stages["observe"].units[0].path
    chunk = f"{unit}/container/points/c/0/0"
    memory.write(chunk, (memory.read(chunk) or b"")[:-1])
    with pytest.raises(CorruptionError, match=rf"{memory.url}/{unit}.*made anew"):
        pipeline.label(memory.url, ["superpoints.count=100"], engine="inline", table=TABLE)
    memory.remove(memory.sizes(unit))
    pipeline.generate(toy_recipe(DEMOS, SHARD_SIZE), memory.url, engine="inline", table=TABLE)
    assert memory.read(chunk) == (small / chunk).read_bytes()


# Around ----------------------------------------------------------------------------------------------------


def test_new_labels_make_new_shards_and_gc_frees_the_old(
    memory: Folder, small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOY_CALLS", str(tmp_path / "calls"))
    plan = pipeline.label(memory.url, ["label.eps_place=0.02"], dry_run=True, table=TABLE)
    assert "label.eps_place 0.03 -> 0.02" in str(plan)
    assert str(plan).startswith(memory.url)
    assert memory.read(remote.LEASE) is None
    pipeline.label(memory.url, ["label.eps_place=0.02"], engine="inline", table=TABLE)
    assert set((tmp_path / "calls").read_text().split()) == {"label"}
    old = [shard.path for shard in manifest.read(small).shards]
    assert "2 units" in "".join(health.verify(memory.url, quick=True).notes)
    freed = health.gc(memory.url).to_dict()
    assert freed["removed"] == old
    assert freed["bytes"] == sum(shard.bytes for shard in manifest.read(small).shards)
    assert not any(memory.sizes(path) for path in old)
    assert len(dapdata.open(memory.url)[0]) > 40


def test_fresh_begins_anew_and_other_peoples_folders_are_left_alone(memory: Folder, tmp_path: Path) -> None:
    recipe = toy_recipe(2, 2)
    pipeline.generate(recipe, memory.url, fresh=True, engine="inline", table=TABLE)
    here = Path(pipeline.generate(recipe, tmp_path / "toy", engine="inline", table=TABLE))
    assert without_machinery(objects_of(memory)) == without_machinery(files_of(here))
    other = Folder(f"{memory.url}-other")
    other.write("thesis.tex", b"x")
    with pytest.raises(FormatError, match=rf"{other.url}: a folder with other files"):
        pipeline.generate(recipe, other.url, engine="inline", table=TABLE)
    assert objects_of(other) == {"thesis.tex": b"x"}


def test_a_unit_that_was_made_elsewhere_meanwhile_is_taken_as_it_is(memory: Folder, small: Path) -> None:
    """The twin of durable.commit's rule: what is there stays, and equal results are no error."""
    with remote.working_copy(memory.url, files=()) as root:
        unit = manifest.read(small).shards[0].path
        (root / unit).mkdir(parents=True)
        (root / unit / "zarr.json").write_bytes(b"another version's bytes")
        copy = remote._copy(root)
        assert copy is not None
        assert not copy.commit(root / unit)
        assert files_of(root / unit) == files_of(small / unit)


def test_what_killed_processes_left_on_this_machine_is_removed(
    memory: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    old, young = (tmp_path / f"{remote.SCRATCH}{name}" for name in ("old", "young"))
    for left in (old, young):
        left.mkdir()
        (left / remote.ALIVE).touch()
    os.utime(old / remote.ALIVE, (0, 0))
    with remote.working_copy(memory.url):
        assert not old.exists()
        (mine,) = set(tmp_path.iterdir()) - {young}
        os.utime(mine / remote.ALIVE, (0, 0))
        with remote.working_copy(memory.url):
            assert mine.exists()
    assert list(tmp_path.iterdir()) == [young]


@pytest.mark.slow
def test_a_unit_that_dies_is_replayed_from_the_store(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    url = f"{server.bucket()}/toy"
    monkeypatch.setenv("TOY_FAULT", "abort:2")
    with pytest.raises(QuarantineError, match=f"{url}: 1 of 2 units failed") as caught:
        pipeline.generate(toy_recipe(DEMOS, SHARD_SIZE), url, workers=2, table=TABLE)
    assert health.status(url).to_dict()["quarantined"] == ["00001.json"]
    command = str(caught.value).split("replay with: ")[1].split()
    assert command[-1] == f"{url}/quarantine/00001.json"
    environment = os.environ | {"PYTHONPATH": f"{HERE}:{os.environ.get('PYTHONPATH', '')}", "TOY_FAULT": "none:-1"}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert '"stage": "observe"' in done.stdout
    assert health.status(url).to_dict()["in_progress"]["done"] == {"demonstrate": 2, "observe": 2}


@pytest.mark.slow
def test_workers_share_nothing_but_the_store(server: Server, small: Path) -> None:
    url = f"{server.bucket()}/toy"
    make_toy(url, DEMOS, SHARD_SIZE, workers=2, engine="local")
    assert without_machinery(server.objects(url)) == without_machinery(files_of(small))


# The page --------------------------------------------------------------------------------------------------

PAGE = (HERE.parent / "docs/object_stores.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


def test_the_snippets_of_the_page_run_on_a_bucket(bucket_toy: str, small: Path) -> None:
    with_dapdata, with_zarr = blocks("python")
    left: dict[str, Any] = {}
    exec(compile(with_dapdata, "docs", "exec"), left)
    train = dapdata.open(small, split="train")
    assert len(left["train"]) == len(left["tensors"]) == len(train)
    assert np.array_equal(left["points"], train[0]["container/points"])
    exec(compile(with_zarr, "docs", "exec"), left)
    assert np.array_equal(left["score"], dapdata.open(small)[0]["container_superpoints/affordance"])


@pytest.mark.slow
def test_the_commands_of_the_page_run_on_a_bucket(
    server: Server, bucket_toy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those that make something only say what they would make: the dataset here is of toys."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "recipes").symlink_to(HERE.parent / "recipes")
    before = without_machinery(server.objects(bucket_toy))
    for line in blocks("sh")[0].splitlines()[1:]:
        name, *words = shlex.split(line)
        assert name == "dapdata"
        makes = ["--dry-run"] if words[0] in ("generate", "label") else []
        assert cli.run_app([*words, *makes]) == 0, line
        assert capsys.readouterr().out
    assert without_machinery(server.objects(bucket_toy)) == before
    assert {path.name for path in tmp_path.glob("quickstart.*")} == {"quickstart.png", "quickstart.html"}


def test_the_page_counts_the_requests_of_a_unit(server: Server, bucket_toy: str, small: Path) -> None:
    table = dict(re.findall(r"^\| `(generate|label|verify)` \| (\d+ \| \d+)", PAGE, re.MULTILINE))

    def each(requests: list[tuple[str, str]]) -> str:
        of_units = [method for method, path in requests if "/stages/" in path or "/shards/" in path]
        count = {method: of_units.count(method) / (DEMOS / SHARD_SIZE) for method in ("PUT", "GET")}
        assert len(of_units) == of_units.count("PUT") + of_units.count("GET")
        assert len(requests) - len(of_units) - 4 * DEMOS / SHARD_SIZE < 50  # and the listings of units
        return f"{count['PUT']:.0f} | {count['GET']:.0f}"

    asked = {command.__name__: requests for command, requests in REQUESTS.items()}
    assert {name: each(requests) for name, requests in asked.items()} == table
    files = len(files_of(small / manifest.read(small).shards[0].path))
    assert f"| reading a shard, all arrays | 0 | {files} |" in PAGE


def test_a_public_dataset_is_read_without_credentials(bucket_toy: str) -> None:
    import s3fs

    for name in ("manifest.json", "index.parquet"):
        s3fs.S3FileSystem().chmod(f"{bucket_toy}/{name}", "public-read")
    (line,) = re.findall(r"^export (FSSPEC_S3_ANON)=(\w+)", PAGE, re.MULTILINE)
    keys = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")
    environment = {name: value for name, value in os.environ.items() if name not in keys} | {line[0]: line[1]}
    code = f"import dapdata; print(dapdata.open({bucket_toy!r}).task)"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "can_cabinet\n"
