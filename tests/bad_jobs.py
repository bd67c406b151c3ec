"""What jobs of the engines' tests do: each kind of mischief that a unit may come to. Imports nothing that takes time."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import time
from pathlib import Path

MEMORY = 0.3e9  # bytes: a child has 20 MB
SIGKILL = "killed by SIGKILL (by hand, or by the kernel when memory ran out)"
KINDS = {  # what a job does: how its end is told
    "kill": SIGKILL,
    "segfault": "killed by SIGSEGV",
    "abort": "killed by SIGABRT",
    "hang": "no answer in 1 s",
    "raise": "ValueError: no such luck",
    "leave": "exited with code 0",
    "memory": "GB of memory, expected at most 0.3 GB for each worker",
    "closed pipe": "closed the socket that its answer was to come through",
}


def behave(text: str) -> str:
    """What a job asks for; runs in the worker."""
    job = json.loads(text)
    do = job["do"]
    if do == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif do == "segfault":
        ctypes.string_at(0)
    elif do == "abort":
        os.abort()
    elif do == "leave":
        os._exit(0)
    elif do == "hang":
        ctypes.PyDLL(None).sleep(1000)  # and no Python runs meanwhile, in any thread
    elif do == "raise":
        print("a word on stderr", file=sys.stderr)
        raise ValueError("no such luck")
    elif do == "memory":
        eaten = []
        while True:
            eaten.append(b"x" * 10**7)
    elif do == "closed pipe":
        os.closerange(3, 1000)
    elif do == "forking child":
        if os.fork() == 0:
            Path(job["note"]).write_text(str(os.getpid()))
            time.sleep(1000)
    elif do == "note and hang":
        Path(job["note"]).write_text(str(os.getpid()))
        time.sleep(1000)
    elif do == "copy of itself":
        os.fork()  # and both go on
    elif do == "user":
        return json.dumps({"error": ["LockedError", "in use by process 1"]})
    return json.dumps({"number": job["number"], "threads": os.environ["OMP_NUM_THREADS"], "process": os.getpid()})
