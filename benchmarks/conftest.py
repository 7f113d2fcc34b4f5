"""Fixtures for pytest-benchmark: `measure`, probes of the peak, and the table at the end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import record
from measuring import Measure, Measured
from peak import Peak

PEAK = Peak()
DONE: list[Measured] = []


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--record", type=Path, help="folder to write benchmarks.json and .md into")


@pytest.fixture(scope="module", autouse=True)
def probes() -> Iterator[None]:
    """Measure the peak before and after each file."""
    PEAK.probe()
    yield
    PEAK.probe()


@pytest.fixture
def measure(benchmark: Any, request: pytest.FixtureRequest) -> Measure:
    marker = request.node.get_closest_marker("benchmark")
    timer = marker.kwargs.get("timer") if marker else None
    return Measure(benchmark, timer or time.process_time, DONE)


def pytest_terminal_summary(terminalreporter: Any, exitstatus: int, config: pytest.Config) -> None:
    if not DONE:
        return
    terminalreporter.write_line(record.table(record.rows(DONE, PEAK.best)))
    folder = config.getoption("record")
    if folder is not None and exitstatus == 0:  # never an incomplete table
        record.write(folder, DONE, PEAK, "make bench")
        terminalreporter.write_line(f"written to {folder}/benchmarks.md and .json")
