"""What can go wrong because of the caller, the disk or the machine, and the exit code of each.

DapdataError
├── UsageError (ValueError)           2   a command or call that makes no sense
│   ├── RecipeError                   2   a recipe value that is unknown, mistyped or out of range
│   ├── FormatError                   2   no dataset, a dataset of another version, a foreign file
│   └── CheckpointError               2   weights of another task or another network
├── CorruptionError (OSError)         3   bytes that are not what the manifest says; a judge that fails its oracle
├── QuarantineError (RuntimeError)    4   units that failed more often than they may
├── LockedError (OSError)             5   another process works on the dataset, or published it meanwhile
└── EnvironmentProblem (RuntimeError) 6   disk full, no permission, a store or cluster that refuses
    └── MissingExtraError (ImportError) 6 an optional package is not installed

Every message has four parts: where, what was found, what was expected, what to do.
A demonstration that did not work out is no error but a `records.Rejected`.
"""

from __future__ import annotations

import importlib
from difflib import get_close_matches
from types import ModuleType


class DapdataError(Exception):
    """Base of all errors that are meant for the user: one line, no traceback."""

    exit_code = 1


class UsageError(DapdataError, ValueError):
    """A command or call that makes no sense."""

    exit_code = 2


class RecipeError(UsageError):
    """A recipe that cannot be run; the message names file, line, key, value and range."""


class FormatError(UsageError):
    """A folder or file that is not what it should be, or of another format version."""


class CheckpointError(UsageError):
    """Weights that do not belong to this network, task or version."""


class CorruptionError(DapdataError, OSError):
    """Bytes on disk that are not what the manifest says."""

    exit_code = 3


class QuarantineError(DapdataError, RuntimeError):
    """Units that failed more often than they may; the message says how to replay them."""

    exit_code = 4


class LockedError(DapdataError, OSError):
    """Another process works on this dataset."""

    exit_code = 5


class EnvironmentProblem(DapdataError, RuntimeError):
    """The machine or the store, not the input, is at fault: disk full, no permission, no bucket, package missing."""

    exit_code = 6


class MissingExtraError(EnvironmentProblem, ImportError):
    """An optional package is not installed."""


def require(module: str, extra: str) -> ModuleType:
    """The imported module, or a MissingExtraError that names the command to run.

    Args:
        module: Import name, such as "pybullet".
        extra: The extra of this package that brings it, such as "sim".
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        where = " (on Python 3.11: PyBullet has no wheels for later ones)" if module == "pybullet" else ""
        raise MissingExtraError(
            f"{module}: could not be imported ({error}), needed for this command; run: pip install 'dapdata[{extra}]'{where}"
        ) from error


def nearest(name: str, known: list[str]) -> str:
    """A hint such as "did you mean 'eps_place'?", or the list of known names."""
    return hint(name, known).removeprefix("; ") or f"known: {', '.join(sorted(known))}"


def hint(name: str, known: list[str]) -> str:
    """ "; did you mean 'eps_place'?", or nothing where no known name is near: for messages that list them already."""
    close = get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else ""
