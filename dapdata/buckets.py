"""Folders of object stores: the only door to fsspec, and to s3fs behind it.

A store knows objects by name, and neither folders nor renames nor locks. What it does have is used here: an object is
written whole or not at all, and on S3 a write can be made to depend on what was there before (If-None-Match, If-Match),
which is all that two writers need to notice each other. Requests that fail for a reason that may pass are repeated;
whatever else goes wrong becomes one line that says what to do.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

from dapdata.errors import DapdataError, EnvironmentProblem, MissingExtraError, UsageError, require

AT_ONCE = 16  # requests under way at the same time
PATIENCE = 40.0  # s: how long a request is repeated before it is given up
FIRST_PAUSE = 0.5  # s before the first repetition, then twice as long each time
S3 = ("s3", "s3a")
WRITABLE = (*S3, "memory")  # whose writes can be made to depend on what is there
LISTLESS = ("http", "https")  # that know no listing of their names
PASSING = {408, 409, 429, 500, 502, 503, 504}  # HTTP answers that may be others a moment later
NETWORK = {"ConnectionError", "HTTPClientError", "TimeoutError", "OSError", "ClientConnectionError", "ClientPayloadError"}
CREDENTIALS = ("Credential", "Token", "Profile")  # in the names of botocore's complaints about them

log = logging.getLogger(__name__)
Result = TypeVar("Result")
_memory = threading.Lock()  # makes compare-and-write on memory:// one step


def is_url(place: str | Path) -> bool:
    """Whether a place is a folder of a store, and not one of this machine."""
    return "://" in str(place) and not str(place).startswith("file://")


def is_inside(name: str) -> bool:
    """Whether a name is a path that stays below the folder that it is relative to: stores have names that do not."""
    return not any(part in ("", ".", "..") for part in name.split("/")) and "\0" not in name


class Conflict(Exception):  # noqa: N818 - no error of the user's: whoever meets it says what it means
    """A conditional write that found something else than it expected; nothing was written."""


@dataclass(frozen=True)
class Folder:
    """A folder of an object store, by its URL. Names are relative to it, with slashes."""

    url: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "url", self.url.rstrip("/"))

    @property
    def protocol(self) -> str:
        """What the URL begins with; of a chain such as simplecache::s3:// the last."""
        return self.url.split("://")[0].split("::")[-1]

    @property
    def has_listing(self) -> bool:
        """Whether the store can say which names there are."""
        return self.protocol not in LISTLESS

    def require_writable(self) -> None:
        """Raises a UsageError if two writers could overwrite one another here unnoticed."""
        if self.protocol not in WRITABLE or "::" in self.url:
            raise UsageError(
                f"{self.url}: writing to {self.url.split('://')[0]}:// is not supported, because its writes do not depend on "
                "what is there, expected s3://bucket/folder; generate into a folder and copy it, manifest.json last"
            )

    # Reading -----------------------------------------------------------------------------------------------

    def read(self, name: str) -> bytes | None:
        """An object's bytes; None if there is none of that name."""
        with suppress(FileNotFoundError):
            return bytes(self._ask(name, lambda fs, path: fs.cat_file(path)))
        return None

    def read_tagged(self, name: str) -> tuple[bytes, str] | None:
        """An object's bytes, and the tag that tells them from later ones.

        The tag is asked for first: if the object changes in between, a write that depends on the tag is refused.
        """
        with suppress(FileNotFoundError):
            tag = self._ask(name, self._tag)
            data = self.read(name)
            return None if data is None else (data, tag)
        return None

    def download(self, names: Iterable[str], target: Path) -> None:
        """Brings objects to the same names below a folder; a name that isn't there, or would leave it, is left out."""

        def fetch(name: str) -> None:
            data = self.read(name)
            if data is not None:
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                (target / name).write_bytes(data)

        _each(fetch, filter(is_inside, names))

    def children(self, name: str = "") -> dict[str, bool]:
        """{name: whether it is a folder} of what is right below a name."""
        found: list[tuple[str, Mapping[str, Any]]] = []
        with suppress(FileNotFoundError, NotADirectoryError):
            found = self._ask(name, lambda fs, path: [(path, entry) for entry in fs.ls(path, detail=True)])
        pairs = ((_below(path, entry["name"]), entry["type"] == "directory") for path, entry in found)
        return {child: is_folder for child, is_folder in pairs if child and "/" not in child}

    def sizes(self, name: str) -> dict[str, int]:
        """{name: bytes} of every object below a name, at any depth."""
        found: tuple[str, Mapping[str, Any]] = ("", {})
        with suppress(FileNotFoundError):
            found = self._ask(name, lambda fs, path: (path, fs.find(path, detail=True)))
        sizes = {_below(found[0], path): int(entry["size"] or 0) for path, entry in found[1].items()}
        return {f"{name}/{path}": size for path, size in sizes.items() if path and not path.endswith("/")}

    # Writing -----------------------------------------------------------------------------------------------

    def write(self, name: str, data: bytes) -> None:
        """Writes an object, whatever was there."""
        self._ask(name, lambda fs, path: fs.pipe_file(path, data))

    def write_if(self, name: str, data: bytes, tag: str | None) -> str:
        """Writes an object if it still has this tag, or if there still is none for None; returns its new tag.

        Raises:
            Conflict: if something else is there. An object with these very bytes is none: an answer may get lost.
        """
        try:
            return str(self._ask(name, lambda fs, path: self._write_if(fs, path, data, tag)))
        except (Conflict, FileNotFoundError):
            found = self.read_tagged(name)
            if found is not None and found[0] == data:
                return found[1]
            raise Conflict(name) from None

    def upload(self, source: Path, names: Iterable[str]) -> None:
        """Writes files below a folder to the same names."""
        _each(lambda name: self._ask(name, lambda fs, path: fs.put_file(str(source / name), path)), names)

    def remove(self, names: Iterable[str]) -> None:
        """Removes objects; a name that isn't there is fine."""

        def drop(name: str) -> None:
            with suppress(FileNotFoundError):
                self._ask(name, lambda fs, path: fs.rm_file(path))

        _each(drop, names)

    # One request -------------------------------------------------------------------------------------------

    def _ask(self, name: str, call: Callable[[Any, str], Result]) -> Result:
        """The answer to one request, repeated while what goes wrong may pass.

        Raises:
            FileNotFoundError: if there is no such object; a missing bucket is an EnvironmentProblem.
            Conflict: see write_if.
            EnvironmentProblem: for whatever else the store or the network refuses.
        """
        fs, root = _filesystem(self.url)
        path = f"{root.rstrip('/')}/{name}" if name else root
        until, pause = time.monotonic() + PATIENCE, FIRST_PAUSE
        while True:
            try:
                return call(fs, path)
            except (Conflict, DapdataError):
                raise
            except Exception as error:
                if isinstance(error, FileNotFoundError) and _code(error) != "NoSuchBucket":
                    raise
                if not _may_pass(error) or time.monotonic() + pause > until:
                    raise _problem(self.url, error) from error
                log.warning("%s: %s; trying again", self.url, _words(error))
            time.sleep(pause)
            pause *= 2

    def _tag(self, fs: Any, path: str) -> str:
        if self.protocol in S3:
            bucket, key, _ = fs.split_path(path)
            return str(fs.call_s3("head_object", Bucket=bucket, Key=key)["ETag"])
        return sha256(fs.cat_file(path)).hexdigest()

    def _write_if(self, fs: Any, path: str, data: bytes, tag: str | None) -> str:
        if self.protocol in S3:
            bucket, key, _ = fs.split_path(path)
            condition = {"IfNoneMatch": "*"} if tag is None else {"IfMatch": tag}
            with _conflicts():
                return str(fs.call_s3("put_object", Bucket=bucket, Key=key, Body=data, **condition)["ETag"])
        with _memory:
            if (self._tag(fs, path) if fs.exists(path) else None) != tag:
                raise Conflict(path)
            fs.pipe_file(path, data)
            return self._tag(fs, path)


def _filesystem(url: str) -> tuple[Any, str]:
    """fsspec's file system for a URL and the path in it; fsspec keeps one a process, also after a fork."""
    import fsspec

    protocol = url.split("://")[0]
    if protocol in S3:
        require("s3fs", "s3")
        for chatty in ("botocore", "aiobotocore"):  # they tell where credentials were found, each time
            logging.getLogger(chatty).setLevel(logging.WARNING)
    # What others write must be seen at once; and one request for one object.
    options = {"use_listings_cache": False, "max_concurrency": 1} if protocol in S3 else {}
    try:
        fs, path = fsspec.core.url_to_fs(url, **options)
    except ImportError as error:
        raise MissingExtraError(f"{url}: {error}, expected the package that reads {protocol}://; install it") from error
    except ValueError as error:
        raise UsageError(f"{url}: {error}, expected a folder or a URL such as s3://bucket/folder") from error
    if protocol in S3:
        fs.retries = 1  # botocore repeats, and so does _ask: a third time between them only makes it slow to give up
    return fs, str(path)


def _each(call: Callable[[str], Any], names: Iterable[str]) -> None:
    """Calls a function for each name, several at a time; the first error stops those that have not begun."""
    todo = list(names)
    if len(todo) < 2:
        for name in todo:
            call(name)
        return
    with ThreadPoolExecutor(min(AT_ONCE, len(todo))) as pool:
        for _ in pool.map(call, todo):
            pass


def _below(path: str, name: str) -> str:
    return str(name).removeprefix(path).lstrip("/") if str(name).startswith(path) else ""


# What went wrong -------------------------------------------------------------------------------------------


@contextmanager
def _conflicts() -> Iterator[None]:
    """Tells an unmet condition from other refusals."""
    try:
        yield
    except OSError as error:
        if _status(error) == 412 or _code(error) == "PreconditionFailed":
            raise Conflict from error
        raise


def _response(error: BaseException) -> Mapping[str, Any]:
    """What S3 answered, as botocore tells it; {} if it did not."""
    for one in (error, error.__cause__):
        found = getattr(one, "response", None)
        if isinstance(found, Mapping):
            return found
    return {}


def _code(error: BaseException) -> str:
    """S3's word for what is wrong, such as "NoSuchBucket", or ""."""
    return str(_response(error).get("Error", {}).get("Code", ""))


def _status(error: BaseException) -> int | None:
    """The HTTP status, where there is one."""
    found = _response(error).get("ResponseMetadata", {}).get("HTTPStatusCode", getattr(error, "status", None))
    return found if isinstance(found, int) else None


def _may_pass(error: BaseException) -> bool:
    """Whether the same request may succeed a moment later."""
    status = _status(error)
    if status is not None:
        return status in PASSING
    lasting = (FileNotFoundError, PermissionError, FileExistsError, NotADirectoryError, IsADirectoryError)
    return not isinstance(error, lasting) and any(kind.__name__ in NETWORK for kind in type(error).__mro__)


def _words(error: BaseException) -> str:
    """What the store or its client says, on one line."""
    said = " ".join(str(error).split()).rstrip(".")
    return said or type(error).__name__


def _problem(url: str, error: BaseException) -> EnvironmentProblem:
    """The line for a refusal: what was found, what was expected, what to do."""
    words, code = _words(error), _code(error)
    if code == "NoSuchBucket":
        return EnvironmentProblem(f"{url}: no such bucket, expected one that exists; make it first, or correct the URL")
    if any(word in type(error).__name__ for word in CREDENTIALS):
        return EnvironmentProblem(
            f"{url}: no credentials ({words}), expected some for this store; set AWS_ACCESS_KEY_ID and "
            "AWS_SECRET_ACCESS_KEY, or AWS_PROFILE, or FSSPEC_S3_ANON=true for a public bucket"
        )
    if isinstance(error, PermissionError) or _status(error) in (401, 403):
        return EnvironmentProblem(
            f"{url}: access denied ({f'{code}: ' if code else ''}{words}), expected credentials that may read, list and, "
            "to generate or label, write and delete there; use others, or have these allowed"
        )
    if code == "NotImplemented" or isinstance(error, NotImplementedError):
        return EnvironmentProblem(
            f"{url}: the store cannot do this ({words}), expected one with conditional writes; generate into a folder and "
            "copy it, manifest.json last"
        )
    return EnvironmentProblem(
        f"{url}: no answer that helps ({words}), expected the store to do what it was asked; what was committed is safe: "
        "check the URL, the endpoint and the network, then run the same command again"
    )
