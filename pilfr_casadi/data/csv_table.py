"""Numbers out of a CSV file: the columns asked for as arrays, or one sentence with file, column and line.

A file is read at once by NumPy. Only when that fails is it walked cell by cell, to say which cell is the culprit.
Commas, semicolons and tabs separate; a byte-order mark, Windows line ends, quoted cells and blank lines are accepted.
Lines are counted as an editor does, so the header is line 1.
"""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._base import LARGEST, InputError, usable

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab"}


@dataclass(frozen=True)
class CsvTable:
    """The text of a CSV file and its header, not yet turned into numbers.

    Attributes
    ----------
    path : Path
        Where it came from, for messages.
    names : tuple of str
        Header, without surrounding blanks.
    delimiter : str
        What separates the cells.
    lines : list of str
        Everything below the header, without line ends.
    first_line : int
        Number of the first of these lines in the file.
    """

    path: Path
    names: tuple[str, ...]
    delimiter: str
    lines: list[str]
    first_line: int

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Return the named columns as numbers, (M, len(names)).

        Raises
        ------
        InputError
            For a cell that is empty, not a number, not finite or too large, and for a row of the wrong length.
        """
        where = [self.names.index(name) for name in names]
        numbers = self._fast(where)
        if numbers is None or not usable(numbers).all():
            numbers = self._cell_by_cell(where)
        return numbers

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column as they are written."""
        where = self.names.index(name)
        return [_cells(text, self.delimiter, str(self.path))[where] for text in self.lines if text.strip()]

    def line_of_row(self, row: int) -> int:
        """Return the line number in the file of the data row `row`, counted from 0."""
        filled = [i for i, line in enumerate(self.lines) if line.strip()]
        return self.first_line + filled[row]

    def _fast(self, where: Sequence[int]) -> np.ndarray | None:
        width = len(self.names) - 1
        if any('"' in line or line.count(self.delimiter) != width for line in self.lines if line.strip()):
            return None
        try:
            return np.loadtxt(self.lines, delimiter=self.delimiter, usecols=where, ndmin=2, comments=None)
        except ValueError:
            return None

    def _cell_by_cell(self, where: Sequence[int]) -> np.ndarray:
        rows = []
        for line, text in enumerate(self.lines, self.first_line):
            if not text.strip():
                continue
            cells = _cells(text, self.delimiter, f"{self.path}: line {line}")
            if len(cells) != len(self.names):
                raise InputError(
                    f"{self.path}: line {line} has {len(cells)} cell(s) but the header names {len(self.names)}; "
                    f"give every line one cell for each column, separated by {DELIMITERS[self.delimiter]}s."
                )
            rows.append([self._value(cells[i], self.names[i], line) for i in where])
        return np.array(rows)

    def _value(self, cell: str, column: str, line: int) -> float:
        place = f"{self.path}: column {column!r}, line {line}"
        value = _number(cell)
        if value is None:
            if not cell.strip():
                raise InputError(f"{place} is empty; fill in a number or cut out that piece.")
            hint = "write a number there"
            if cell.count(",") == 1 and cell.replace(",", "").strip(" +-").isdigit():
                hint = "write decimals with a point"
            raise InputError(f"{place} reads {cell.strip()[:40]!r}, which is not a number; {hint}.")
        if not usable(np.array(value)):
            raise InputError(
                f"{place} is {cell.strip()}; only finite numbers up to {LARGEST:g} can be used: repair or cut out that "
                "piece, or give it in another unit."
            )
        return value


def read_table(path: str | Path, score: Callable[[Sequence[str]], int]) -> CsvTable:
    """Open a CSV file and read its header.

    Parameters
    ----------
    path : str or Path
        The file.
    score : callable
        How many of the wanted columns a header has; decides what separates the cells.

    Raises
    ------
    InputError
        When the file cannot be read as text, or has no header or no data.
    """
    path = Path(path)
    lines = _text(path).split("\n")
    top = next((i for i, line in enumerate(lines) if line.strip()), None)
    if top is None:
        raise InputError(f"{path} is empty; give a CSV file with a header row and one row for each sample.")
    headers = {d: _cells(lines[top], d, f"{path}: line {top + 1}") for d in DELIMITERS}
    delimiter = max(DELIMITERS, key=lambda d: (score(headers[d]), len(headers[d]), d == ","))
    names = headers[delimiter]
    if all(_number(name) is not None for name in names):
        raise InputError(
            f"{path} has no header row: line {top + 1} reads {lines[top].strip()[:60]!r}; name the columns there."
        )
    below = lines[top + 1 :]
    if not any(line.strip() for line in below):
        raise InputError(f"{path} has a header but no data below it; give one row for each sample.")
    return CsvTable(path, names, delimiter, below, top + 2)


def existing_file(path: str | Path) -> Path:
    """Return the path if it is a file.

    Raises
    ------
    InputError
        When there is nothing, or a directory.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path} is a directory; give the file inside it.")
    if not path.exists():
        raise InputError(f"there is no file {path}; check the name and the folder.")
    return path


def _text(path: Path) -> str:
    try:
        raw = existing_file(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check its permissions.") from None
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path} is UTF-16 text; save it as UTF-8.")
    odd = sum(raw[:65536].count(bytes([b])) for b in range(32) if b not in (9, 10, 12, 13))
    if odd:
        raise InputError(
            f"{path} is not text (it holds binary data); give a CSV file, or name it .mat or .npz if it is one."
        )
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")  # a degree sign or a micro from an older instrument
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _cells(line: str, delimiter: str, place: str) -> tuple[str, ...]:
    try:
        return tuple(cell.strip() for cell in next(csv.reader([line], delimiter=delimiter)))
    except csv.Error as error:
        raise InputError(f"{place} is not a row of a CSV file ({error}); give one row for each sample.") from None


def _number(cell: str) -> float | None:
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
