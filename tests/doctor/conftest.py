# SPDX-License-Identifier: Apache-2.0
"""Boards that the doctor opens, for several test files."""

import pytest

import ohmskin
from bench_board import Bench


@pytest.fixture
def benches(monkeypatch: pytest.MonkeyPatch) -> list[Bench]:
    """The boards that the doctor opens, in simulated time."""
    opened: list[Bench] = []

    def connect(url: str, **_: object) -> Bench:
        opened.append(Bench(url))
        return opened[-1]

    monkeypatch.setattr(ohmskin, "open", connect)
    return opened
