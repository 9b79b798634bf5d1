"""Every result in benchmarks/results says how it was made."""

import csv
import sys
from pathlib import Path

import pytest

from lerobot_uca.protocol.record import COLUMNS

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
CSV_FILES = sorted((BENCHMARKS / "results").glob("*.csv"))
TEXT_FILES = sorted((BENCHMARKS / "results").glob("*.txt"))


def test_no_result_is_larger_than_a_mebibyte():
    """Every clone has them all."""
    sizes = {path: path.stat().st_size for path in (BENCHMARKS / "results").rglob("*") if path.is_file()}
    assert sizes
    assert [path for path, size in sizes.items() if size > 2**20] == []


@pytest.fixture
def common(monkeypatch):
    """The benchmarks' module, as their scripts import it."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    import common

    return common


@pytest.mark.parametrize("path", CSV_FILES, ids=lambda path: path.name)
def test_rows_end_with_their_provenance(path):
    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        assert tuple(rows.fieldnames[-4:]) == COLUMNS
        assert all(row[name] for row in rows for name in COLUMNS)


@pytest.mark.parametrize("path", TEXT_FILES, ids=lambda path: path.name)
def test_texts_begin_with_their_provenance(path):
    first, second = path.read_text().splitlines()[:2]
    assert first.startswith("# command: ")
    assert second.startswith("# commit: ")


def test_written_rows_are_read_back_with_command_commit_and_versions(common, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(BENCHMARKS / "latency.py"), "--policies", "Simple DP3"])
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    with (tmp_path / "rows.csv").open("w", newline="") as file:
        common.write_rows(({"policy": name, "median_ms": "1.00"} for name in ("dp3", "mp1")), file)
    first, second = common.read_rows(tmp_path / "rows.csv")
    assert (first["policy"], second["policy"]) == ("dp3", "mp1")
    assert first["command"] == "OMP_NUM_THREADS=1 python benchmarks/latency.py --policies 'Simple DP3'"
    assert "lerobot 0.6.1" in first["versions"]
    assert first["commit"]
    assert first["cpu"]


def test_a_missing_file_has_no_rows(common, tmp_path):
    assert common.read_rows(tmp_path / "none.csv") == []
