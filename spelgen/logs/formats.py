"""Hold the formats of logs. A new one is a file like `csv_files.py`, and its name in FORMATS."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spelgen.logs.bags import BAG
from spelgen.logs.csv_files import CSV
from spelgen.logs.lerobot import LEROBOT
from spelgen.logs.npz import NPZ
from spelgen.logs.parquet_files import PARQUET
from spelgen.logs.tables import LogFormat, LogTable
from spelgen.settings.log_mapping import LogMapping

FORMATS: list[LogFormat] = [PARQUET, CSV, NPZ, BAG, LEROBOT]


def format_of(path: Path) -> LogFormat | None:
    """Return the format of a file or folder; None of what is no log, such as a pipe that might never end."""
    is_folder, is_file = path.is_dir(), path.is_file()
    for log_format in FORMATS:
        if is_folder and log_format.is_folder is not None and log_format.is_folder(path):
            return log_format
        if is_file and path.suffix in log_format.suffixes:
            return log_format
    return None


def read_tables(path: Path, joints: Sequence[str], mapping: LogMapping) -> list[LogTable]:
    """Return the tables of a log. Raises LogError, where columns are missing too."""
    log_format = format_of(path)
    assert log_format is not None, "log_files gives logs alone"
    return log_format.read(path, joints, mapping)


def describe_formats() -> str:
    """Return what may be a log, as messages say it."""
    suffixes: list[str] = []
    folders: list[str] = []
    for log_format in FORMATS:
        suffixes += log_format.suffixes
        if log_format.folder:
            folders.append(log_format.folder)
    return f"{', '.join(suffixes)}, the folder of {' or of '.join(folders)}"
