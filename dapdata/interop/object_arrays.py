"""npz files whose arrays hold Python objects, read as data: numbers, text, lists, tuples, dicts and plain arrays.

Such arrays are pickles, and unpickling runs what a file says. Here nothing is run. The opcodes of the pickle are read one
by one, containers are built from those that make containers, and arrays from their dtype, shape and bytes after these
were compared with each other. An opcode or a name besides those that numpy writes for plain arrays is refused.

Considered and not taken: `pickle.Unpickler` with a `find_class` that admits numpy's names alone. numpy's own
`__setstate__` would still be called with whatever state the file holds.
"""

from __future__ import annotations

import io
import pickletools
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata.errors import FormatError

Array = NDArray[Any]

MAX_BYTES = 128_000_000  # of one array, or of one demo of a chunk, unpacked; RPDiff's largest have 24 MB
MAX_OPCODES = 200_000  # of one pickle; a demo of RPDiff has some hundred
PLAIN = re.compile(r"[<>|=]?([?]|b1|[iuf][1248]|U\d{1,6}|O8?)")  # dtypes: truth values, numbers, text, objects
NUMPY = ("numpy.core.multiarray", "numpy._core.multiarray")
NAMES = {
    **{(module, "_reconstruct"): "array" for module in NUMPY},
    **{(module, "scalar"): "scalar" for module in NUMPY},
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
}
# What the opcodes of a broken or hostile pickle lead to here: nothing else can, since nothing of the file is called.
BROKEN = (ValueError, IndexError, KeyError, TypeError, OverflowError, MemoryError, EOFError, struct.error, AttributeError)


class RefusedError(FormatError):
    """A pickle that holds more than plain data."""


class TooLargeError(FormatError):
    """An array that would take more memory than any of its kind needs."""


def member_names(path: Path) -> dict[str, tuple[int, int]]:
    """{name of each array: (bytes unpacked, checksum)} of an npz file, without reading its arrays.

    Raises:
        FormatError: it is no npz file.
    """
    with _problems(path), zipfile.ZipFile(path) as archive:
        return {
            info.filename.removesuffix(".npy"): (info.file_size, info.CRC)
            for info in archive.infolist()
            if info.filename.endswith(".npy")
        }


def read(path: Path, name: str) -> Any:
    """An array of an npz file: an array of numbers or text, or of an object array the object or the list of objects in it.

    Raises:
        FormatError: no such array, or a damaged one. Its children: TooLargeError; RefusedError, anything but plain data.
    """
    with _problems(path, name), zipfile.ZipFile(path) as archive:
        info = archive.getinfo(f"{name}.npy")
        if info.file_size > MAX_BYTES:
            raise TooLargeError(
                f"{path}: {name}: {info.file_size} bytes, expected {MAX_BYTES} at the most; thin the clouds out"
            )
        return _from_npy(archive.read(info))


@contextmanager
def _problems(path: Path, name: str = "") -> Iterator[None]:
    """Turns what a broken file leads to into a FormatError."""
    try:
        yield
    except FormatError:
        raise
    except (*BROKEN, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, OSError) as error:
        where = f"{path}: {name}" if name else str(path)
        what = str(error) if isinstance(error, (ValueError, zipfile.BadZipFile)) else type(error).__name__
        kind = RefusedError if isinstance(error, _NotDataError) else FormatError
        raise kind(f"{where}: cannot be read ({what}), expected an npz file of plain arrays") from error


def _from_npy(data: bytes) -> Any:
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = header(file)
    if dtype.kind != "O":
        return _array(shape, _dtype(dtype.str), is_fortran, data[file.tell() :])
    return unpickle(data[file.tell() :])


def _array(shape: tuple[int, ...], dtype: np.dtype[Any], is_fortran: bool, data: bytes) -> Array:
    """The array, which shares the memory of its bytes."""
    if len(data) != prod(shape) * dtype.itemsize:
        raise ValueError(f"{len(data)} bytes for shape {shape} of {dtype}")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if is_fortran else "C")


def _dtype(text: str) -> np.dtype[Any]:
    if not PLAIN.fullmatch(text):
        raise ValueError(f"an array of '{text[:40]}'")
    return np.dtype(text)


# The opcodes -----------------------------------------------------------------------------------------------


class _NotDataError(ValueError):
    """What a pickle asks for beyond plain data."""


class _Name:
    """One of the names that a pickle may ask for."""

    def __init__(self, known: str) -> None:
        self.known = known


class _Unfinished:
    """An array or a dtype between its making and its state."""

    def __init__(self, dtype: np.dtype[Any] | None = None) -> None:
        self.dtype = dtype
        self.memo: int | None = None


class _Machine:
    """The stack and the memo of a pickle that is being read."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []  # where lists of arguments begin on the stack
        self.memo: dict[int, Any] = {}

    def to_mark(self) -> list[Any]:
        """Takes what lies above the last mark, and the mark."""
        return self.take(len(self.stack) - self.marks.pop())

    def take(self, count: int) -> list[Any]:
        """Takes the last few."""
        start = len(self.stack) - count
        if start < (self.marks[-1] if self.marks else 0):
            raise ValueError("a pickle that ends too soon")
        items = self.stack[start:]
        del self.stack[start:]
        return items

    def keep(self, index: int) -> None:
        """Notes the last one for later."""
        self.memo[index] = self.stack[-1]
        if isinstance(self.stack[-1], _Unfinished):
            self.stack[-1].memo = index

    def name(self, module: str, name: str) -> None:
        known = NAMES.get((module, name)) if isinstance(module, str) and isinstance(name, str) else None
        if known is None:
            raise _NotDataError(f"a pickle that asks for {str(module)[:40]}.{str(name)[:40]}; it is refused, nothing was run")
        self.stack.append(_Name(known))

    def reduce(self) -> None:
        """A call, of which only those are known that numpy writes."""
        called, arguments = self.take(2)
        known = called.known if isinstance(called, _Name) and isinstance(arguments, tuple) else ""
        if known == "array" and len(arguments) == 3 and arguments[1:] == ((0,), b"b"):
            self.stack.append(_Unfinished())
        elif known == "dtype" and len(arguments) == 3 and arguments[1:] == (False, True):
            self.stack.append(_Unfinished(_dtype(arguments[0])))
        elif known == "scalar" and len(arguments) == 2:
            self.stack.append(_array((), _finished(arguments[0]), False, arguments[1])[()])
        else:
            raise _NotDataError("a pickle that makes something other than arrays; it is refused, nothing was run")

    def build(self) -> None:
        """The state of an array or a dtype."""
        made, state = self.take(2)
        if not isinstance(made, _Unfinished):
            raise _NotDataError("a pickle that sets the state of something other than an array; it is refused, nothing was run")
        if made.dtype is not None:
            version, order, *rest = state
            if version != 3 or order not in ("<", ">", "|", "=") or any(part is not None for part in rest[:3]):
                raise ValueError("an array of records")
            value: Any = _Unfinished(made.dtype.newbyteorder(order))
        else:
            _, shape, dtype, is_fortran, data = state
            dtype = _finished(dtype)
            if not all(type(length) is int and length >= 0 for length in shape):
                raise ValueError(f"an array of shape {shape}")
            if dtype.kind == "O":
                if not isinstance(data, list) or len(data) != prod(shape):
                    raise ValueError(f"objects that do not fit into shape {shape}")
                value = data if shape else data[0]
            else:
                value = _array(shape, dtype, bool(is_fortran), data)
        self.stack.append(value)
        if made.memo is not None:
            self.memo[made.memo] = value


def _finished(dtype: Any) -> np.dtype[Any]:
    if not isinstance(dtype, _Unfinished) or dtype.dtype is None:
        raise ValueError("an array without a dtype")
    return dtype.dtype


def _set_items(items: list[Any], target: Any) -> None:
    if type(target) is not dict or len(items) % 2:
        raise ValueError("keys for something that is no dict")
    target.update(zip(items[::2], items[1::2]))


def _extend(items: list[Any], target: Any) -> None:
    if type(target) is not list:
        raise ValueError("items for something that is no list")
    target.extend(items)


Step = Callable[[_Machine, Any], None]


def _pushing(value: Any) -> Step:
    return lambda machine, _: machine.stack.append(value)


def _push_argument(machine: _Machine, argument: Any) -> None:
    machine.stack.append(argument)


def _nothing(machine: _Machine, argument: Any) -> None:
    pass


OPCODES: dict[str, Step] = {
    **dict.fromkeys(("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"), _push_argument),
    **dict.fromkeys(("UNICODE", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"), _push_argument),
    **dict.fromkeys(("SHORT_BINBYTES", "BINBYTES", "BINBYTES8"), _push_argument),
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), _nothing),
    "NONE": _pushing(None),
    "NEWTRUE": _pushing(True),
    "NEWFALSE": _pushing(False),
    "MARK": lambda machine, _: machine.marks.append(len(machine.stack)),
    "EMPTY_LIST": lambda machine, _: machine.stack.append([]),
    "EMPTY_DICT": lambda machine, _: machine.stack.append({}),
    "EMPTY_TUPLE": lambda machine, _: machine.stack.append(()),
    "LIST": lambda machine, _: machine.stack.append(machine.to_mark()),
    "TUPLE": lambda machine, _: machine.stack.append(tuple(machine.to_mark())),
    "TUPLE1": lambda machine, _: machine.stack.append(tuple(machine.take(1))),
    "TUPLE2": lambda machine, _: machine.stack.append(tuple(machine.take(2))),
    "TUPLE3": lambda machine, _: machine.stack.append(tuple(machine.take(3))),
    "APPEND": lambda machine, _: _extend(items=machine.take(1), target=machine.stack[-1]),
    "APPENDS": lambda machine, _: _extend(items=machine.to_mark(), target=machine.stack[-1]),
    "SETITEM": lambda machine, _: _set_items(items=machine.take(2), target=machine.stack[-1]),
    "SETITEMS": lambda machine, _: _set_items(items=machine.to_mark(), target=machine.stack[-1]),
    "BINPUT": lambda machine, index: machine.keep(index),
    "LONG_BINPUT": lambda machine, index: machine.keep(index),
    "PUT": lambda machine, index: machine.keep(index),
    "MEMOIZE": lambda machine, _: machine.keep(len(machine.memo)),
    "BINGET": lambda machine, index: machine.stack.append(machine.memo[index]),
    "LONG_BINGET": lambda machine, index: machine.stack.append(machine.memo[index]),
    "GET": lambda machine, index: machine.stack.append(machine.memo[index]),
    "GLOBAL": lambda machine, words: machine.name(*words.split(" ", 1)),
    "STACK_GLOBAL": lambda machine, _: machine.name(*machine.take(2)),
    "REDUCE": lambda machine, _: machine.reduce(),
    "BUILD": lambda machine, _: machine.build(),
}


def unpickle(data: bytes) -> Any:
    """What a pickle of plain data holds; nothing of it is run.

    Raises:
        ValueError or another of BROKEN: it is damaged, or holds anything else.
    """
    machine = _Machine()
    for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        if count >= MAX_OPCODES:
            raise ValueError(f"a pickle of more than {MAX_OPCODES} steps")
        step = OPCODES.get(opcode.name)
        if step is None:
            raise _NotDataError(f"a pickle with the step {opcode.name}; it is refused, nothing was run")
        step(machine, argument)
    (value,) = machine.stack
    if isinstance(value, (_Unfinished, _Name)):
        raise ValueError("a pickle that holds no data")
    return value


# Writing ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Boxed:
    """A value that is written as an object array of no dimensions."""

    value: Any


def write(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes an npz file, the same bytes for the same values; what is no array becomes an object array of no dimensions.

    What is written reads back with `read`, and with `numpy.load(..., allow_pickle=True)` of any numpy since 1.17: numpy 2
    itself writes names into its pickles that numpy before 1.26 does not have.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, value in arrays.items():
            file = io.BytesIO()
            if isinstance(value, np.ndarray):
                np.lib.format.write_array(file, value, allow_pickle=False)
            else:
                header = {"descr": "|O", "fortran_order": False, "shape": ()}
                np.lib.format.write_array_header_1_0(file, header)
                file.write(b"\x80\x03" + b"".join(_pickled(value if isinstance(value, Boxed) else Boxed(value))) + b".")
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), file.getvalue(), zipfile.ZIP_DEFLATED)


def _pickled(value: Any) -> Iterator[bytes]:
    """The steps, of protocol 3, that make a value of plain data."""
    if value is None:
        yield b"N"
    elif value is True or value is False:
        yield b"\x88" if value else b"\x89"
    elif isinstance(value, int):
        yield struct.pack("<ci", b"J", value)
    elif isinstance(value, float):
        yield struct.pack(">cd", b"G", value)
    elif isinstance(value, str):
        yield struct.pack("<cI", b"X", len(value.encode())) + value.encode()
    elif isinstance(value, bytes):
        yield struct.pack("<cI", b"B", len(value)) + value
    elif isinstance(value, (list, tuple)):
        opening, closing = (b"](", b"e") if isinstance(value, list) else (b"(", b"t")
        yield opening
        for item in value:
            yield from _pickled(item)
        yield closing
    elif isinstance(value, dict):
        yield b"}("
        for key, item in value.items():
            yield from _pickled(key)
            yield from _pickled(item)
        yield b"u"
    elif isinstance(value, np.ndarray):
        yield from _array_of(value.shape, value.dtype, value.tobytes())
    elif isinstance(value, Boxed):
        yield from _array_of((), np.dtype(object), [value.value])
    else:
        raise TypeError(f"{type(value).__name__}: expected plain data")


def _array_of(shape: tuple[int, ...], dtype: np.dtype[Any], data: Any) -> Iterator[bytes]:
    """The call and the state that numpy itself writes for an array."""
    yield b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n"
    yield from (*_pickled((0,)), *_pickled(b"b"), b"tR(", *_pickled(1), *_pickled(shape))
    yield b"cnumpy\ndtype\n"
    yield from (*_pickled((dtype.str.lstrip("<>|="), False, True)), b"R")
    size = (dtype.itemsize, dtype.alignment, 8) if dtype.kind == "U" else (-1, -1, 63 if dtype.kind == "O" else 0)
    yield from (*_pickled((3, dtype.str[0], None, None, None, *size)), b"b")
    yield from (*_pickled(False), *_pickled(data), b"tb")
