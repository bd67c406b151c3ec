"""The Parquet tables beside a manifest: `index.parquet` with one row a demo, `units.parquet` with one row a unit.

Ten million demos are rows here and nowhere objects: tables are written as their rows come, columns are read when they
are first asked for, and equal words are one object.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISREG
from typing import Any

import numpy as np

from dapdata.errors import CorruptionError, FormatError
from dapdata.records import Array

GROUP_ROWS = 1 << 17  # rows in a Parquet row group: what a writer holds in memory
ROW_BYTES = 32  # that a row of either table takes at least: a digest
MAX_COLUMNS, MAX_WORD, MAX_INFLATION = 100, 1000, 100  # more columns, longer words, larger columns are a bomb's


class Writer:
    """Writes a Parquet file from rows as they come; integers are int64, words are strings. Without rows, no file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: Any = None
        self._pieces: list[Any] = []
        self._rows = 0

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Takes further rows, all with the columns of the first one."""
        import pyarrow as pa

        if rows:
            self.add_table(pa.Table.from_pylist(list(rows), schema=self._pieces[0].schema if self._pieces else None))

    def add_table(self, table: Any) -> None:
        """Takes further rows as a pyarrow table."""
        self._pieces.append(table)
        self._rows += len(table)
        if self._rows >= GROUP_ROWS:
            self._write(self._rows // GROUP_ROWS * GROUP_ROWS)

    def end_group(self) -> None:
        """Writes what it has, so that what comes next stands in row groups of its own."""
        self._write(self._rows)

    def _write(self, count: int) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not count:
            return
        whole = pa.concat_tables(self._pieces).combine_chunks()
        if self._file is None:
            self._file = pq.ParquetWriter(self._path, whole.schema, compression="zstd")
        self._file.write_table(whole[:count], row_group_size=GROUP_ROWS)
        self._pieces, self._rows = [whole[count:]], self._rows - count

    def close(self) -> None:
        """Writes the rest."""
        self.end_group()
        if self._file is not None:
            self._file.close()


@contextmanager
def writer(path: Path) -> Iterator[Writer]:
    """A Writer that is closed on the way out."""
    made = Writer(path)
    try:
        yield made
    finally:
        made.close()


def insert_words(source: Path, target: Path, name: str, words: Array, at: int) -> None:
    """Writes a table again with one more column of words, in place `at`."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    start = 0
    with writer(target) as made, pq.ParquetFile(source) as file:
        for group in range(file.num_row_groups):
            table = file.read_row_group(group)
            column = pa.array(words[start : start + len(table)], pa.string())
            made.add_table(table.add_column(at, name, column))
            start += len(table)


class Index(Mapping[str, Array]):
    """The columns of `index.parquet` as arrays of one length, each read when it is first asked for.

    Integers are int64; words are arrays of `str` objects, in which equal words are one object.
    """

    def __init__(self, path: Path, chosen: Array | None = None) -> None:
        """
        Args:
            path: The file.
            chosen: (R,) numbers of the rows to look at; all by default.

        Raises:
            CorruptionError: if it is missing or no Parquet file.
        """
        with _explained(path):
            about, self._stamp = _measured(path), stamp(path)
            schema = about.schema.to_arrow_schema()
        self.path, self._chosen, self._all = path, chosen, about.num_rows
        self.numbers = tuple(field.name for field in schema if str(field.type) == "int64")  # columns of integers
        self._names = tuple(schema.names)
        self._held: dict[str, Array] = {}

    def only(self, chosen: Array) -> Index:
        """The same, with only some of these rows."""
        return Index(self.path, chosen if self._chosen is None else self._chosen[chosen])

    @property
    def rows(self) -> int:
        """How many rows there are, without reading any."""
        return self._all if self._chosen is None else len(self._chosen)

    def __getitem__(self, name: str) -> Array:
        """One column, which is kept."""
        if name not in self._held:
            self._held[name] = self.read(name)
        return self._held[name]

    def read(self, name: str) -> Array:
        """One column, which is not kept."""
        if name not in self._names:
            raise KeyError(name)
        if name in self.numbers:
            return self._of_mine(self._column(name).to_numpy())
        codes, words = self.codes(name)
        return np.array(words, dtype=object)[codes]

    def codes(self, name: str) -> tuple[Array, list[str]]:
        """A column of words as (R,) codes and the words that they count, in the order in which the file has them."""
        column = self._column(name).unify_dictionaries().combine_chunks()
        with _explained(self.path):
            words = [str(word) for word in column.dictionary.to_pylist()]
            if max(map(len, words), default=0) > MAX_WORD:
                raise ValueError(f"column {name}: words of more than {MAX_WORD} characters")
        return self._of_mine(column.indices.to_numpy()), words

    def stream(self, names: Sequence[str]) -> Iterator[tuple[Any, ...]]:
        """The rows of the file one after the other, with some of the columns; nothing is kept."""
        import pyarrow.parquet as pq

        with _explained(self.path), pq.ParquetFile(self.path) as file:
            for batch in file.iter_batches(batch_size=GROUP_ROWS, columns=list(names)):
                yield from zip(*(batch.column(name).to_pylist() for name in names))

    def _column(self, name: str) -> Any:
        """A column of the file, as pyarrow has it; words as dictionaries."""
        import pyarrow.parquet as pq

        with _explained(self.path):
            if stamp(self.path) != self._stamp:
                raise FormatError(f"{self.path}: written anew since it was opened, expected the same; open the dataset again")
            words = [] if name in self.numbers else [name]
            column = pq.read_table(self.path, columns=[name], read_dictionary=words).column(name)
            if len(column) != self._all or column.null_count:
                raise ValueError(f"column {name}: {len(column) - column.null_count} values, expected {self._all}")
            return column

    def _of_mine(self, column: Array) -> Array:
        return column if self._chosen is None else column[self._chosen]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getstate__(self) -> dict[str, Any]:
        """Worker processes read their columns themselves."""
        return {**self.__dict__, "_held": {}}


def read(path: Path, name: str, value: str, columns: Sequence[str] | None = None) -> dict[str, list[Any]]:
    """The columns, all by default, of the rows in which a column of words has one value.

    Raises:
        CorruptionError: if the file is missing or no Parquet file.
    """
    import pyarrow.parquet as pq

    with _explained(path):
        _measured(path)
        wanted = None if columns is None else list(columns)
        found: dict[str, list[Any]] = pq.read_table(path, columns=wanted, filters=[(name, "=", value)]).to_pydict()
        return found


def _measured(path: Path) -> Any:
    """A Parquet file's metadata; a ValueError if it says that there is more in the file than its bytes can hold."""
    import pyarrow.parquet as pq

    if not S_ISREG(path.lstat().st_mode):
        raise ValueError("no plain file")
    about, size = pq.read_metadata(path), path.stat().st_size
    unpacked = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
    if about.num_rows * ROW_BYTES > size or about.num_columns > MAX_COLUMNS or unpacked > MAX_INFLATION * size:
        raise ValueError(
            f"{about.num_rows} rows of {about.num_columns} columns in {size} bytes, expected rows of a digest each"
        )
    return about


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """What Parquet has to complain of is damage."""
    import pyarrow as pa

    try:
        yield
    except (CorruptionError, FormatError):
        raise
    except (OSError, ValueError, pa.ArrowException) as error:
        raise CorruptionError(f"{path}: cannot be read ({error}); run `dapdata verify {path.parent}`") from error


def stamp(path: Path) -> tuple[int, int, int]:
    """What changes when a file is replaced."""
    about = os.stat(path)
    return about.st_ino, about.st_size, about.st_mtime_ns
