"""An S3 server on loopback for tests: moto's, with a gate in front where a test may count, refuse or cut requests."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any

ACCESS = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_DEFAULT_REGION": "us-east-1",
    "AWS_CONFIG_FILE": "/dev/null",
    "AWS_SHARED_CREDENTIALS_FILE": "/dev/null",
    "AWS_EC2_METADATA_DISABLED": "true",
}
XML = "<?xml version='1.0'?><Error><Code>{}</Code><Message>{}</Message></Error>"
Refusal = tuple[str, str]  # HTTP status line, S3 code
# Of method and path: a refusal; "cut": the connection ends while the request is read; "lost": after it was done; or None.
Gate = Callable[[str, str], Refusal | str | None]


class Server:
    """The server, and what went through it."""

    def __init__(self) -> None:
        from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
        from werkzeug.serving import make_server

        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        self.app: Any = DomainDispatcherApplication(create_backend_app)
        self.gate: Gate | None = None
        self.heedless = False  # take no notice of conditions, as older stores
        self.requests: list[tuple[str, str]] = []
        self._numbers = count()
        self._server = make_server("127.0.0.1", 0, self._answer, threaded=True)
        self.url = f"http://127.0.0.1:{self._server.port}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def environment(self) -> dict[str, str]:
        """What a client needs to find it."""
        return {**ACCESS, "AWS_ENDPOINT_URL_S3": self.url}

    def bucket(self, name: str | None = None) -> str:
        """The URL of a new bucket."""
        import boto3

        name = name or f"bucket-{next(self._numbers)}"
        access = {"aws_access_key_id": "test", "aws_secret_access_key": "test", "region_name": "us-east-1"}
        boto3.client("s3", endpoint_url=self.url, **access).create_bucket(Bucket=name)
        return f"s3://{name}"

    @contextmanager
    def gated(self, gate: Gate) -> Iterator[None]:
        """Every request passes the gate first."""
        self.gate = gate
        try:
            yield
        finally:
            self.gate = None

    def objects(self, url: str) -> dict[str, bytes]:
        """{name below a URL: bytes} as the server holds them, without a request."""
        from moto.core import DEFAULT_ACCOUNT_ID
        from moto.s3.models import s3_backends

        bucket, _, prefix = url.removeprefix("s3://").partition("/")
        keys = s3_backends[DEFAULT_ACCOUNT_ID]["aws"].buckets[bucket].keys
        return {name.removeprefix(f"{prefix}/"): key.value for name, key in keys.items() if name.startswith(f"{prefix}/")}

    def stop(self) -> None:
        self._server.shutdown()

    def _hang_up(self, environ: dict[str, Any]) -> Iterable[bytes]:
        environ["werkzeug.socket"].shutdown(socket.SHUT_RDWR)
        raise ConnectionAbortedError  # which werkzeug takes without a word

    def _answer(self, environ: dict[str, Any], start_response: Any) -> Iterable[bytes]:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        self.requests.append((method, path))
        verdict = self.gate(method, path) if self.gate else None
        if verdict == "cut":
            environ["wsgi.input"].read(min(100, int(environ.get("CONTENT_LENGTH") or 0)))
            return self._hang_up(environ)
        if verdict == "lost":
            list(self.app(environ, lambda *_: None))
            return self._hang_up(environ)
        if verdict is not None:
            status, code = verdict
            environ["wsgi.input"].read(int(environ.get("CONTENT_LENGTH") or 0))
            start_response(status, [("Content-Type", "application/xml")])
            return [XML.format(code, "refused by a test").encode()]
        if self.heedless:
            environ.pop("HTTP_IF_MATCH", None)
            environ.pop("HTTP_IF_NONE_MATCH", None)
        answer: Iterable[bytes] = self.app(environ, start_response)
        return answer
