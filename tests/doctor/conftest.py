# SPDX-License-Identifier: Apache-2.0
"""Boards that the doctor opens, for several test files."""

import pytest

import ohmskin
from ohmskin.emulate.driver import SteppedSkin
from stepped import stepped


@pytest.fixture
def benches(monkeypatch: pytest.MonkeyPatch) -> list[SteppedSkin]:
    """The boards that the doctor opens, in stepped time."""
    opened: list[SteppedSkin] = []

    def connect(url: str, **_: object) -> SteppedSkin:
        opened.append(stepped(url))
        return opened[-1]

    monkeypatch.setattr(ohmskin, "open", connect)
    return opened
