"""Sheets of pictures show names in any script."""

import warnings
from dataclasses import replace
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from matplotlib import font_manager

from dora.affordance.views.fonts import LAST, families
from dora.affordance.views.sheet import Panel, write_sheet


@pytest.mark.parametrize("name", ["handle", "把手", "ручка", "مقبض", "🍺", "_hidden", "$a$", "a\u200bb\n"])
def test_a_sheet_is_drawn_without_a_warning(tmp_path: Path, name: str):
    view = np.full((200, 300, 3), 128, dtype=np.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_sheet([Panel(view, name, {name: (255, 0, 0)})], tmp_path / "sheet.png", 1, {name: (0, 255, 0)}, name)
        write_sheet([Panel(view, "")], tmp_path / "plain.png", 1)
    assert imageio.imread(tmp_path / "sheet.png").shape[0] > imageio.imread(tmp_path / "plain.png").shape[0]


def test_installed_fonts_are_used_for_what_the_own_one_lacks():
    own = families("handle")
    assert families("ручка") == own
    lacking = families("把手")
    assert lacking[: len(own)] == own
    assert len(lacking) == len(own) + 1
    letters = font_manager.get_font(
        font_manager.findfont(font_manager.FontProperties(family=lacking[-1:]))
    ).get_charmap()
    assert {ord("把"), ord("手")} <= set(letters)


def test_a_cached_list_without_the_last_resort_is_completed(monkeypatch: pytest.MonkeyPatch):
    whole = font_manager.fontManager.ttflist
    kept = [entry for entry in whole if entry.fname == font_manager.findfont(font_manager.FontProperties())]
    monkeypatch.setattr(font_manager.fontManager, "ttflist", kept)
    assert families("把")[-1].startswith(LAST)
    assert sum(entry.name.startswith(LAST) for entry in font_manager.fontManager.ttflist) == 1
    assert families("把")[-1].startswith(LAST)
    assert sum(entry.name.startswith(LAST) for entry in font_manager.fontManager.ttflist) == 1


def test_a_name_that_is_not_in_utf_8_is_drawn_as_far_as_it_goes(tmp_path: Path):
    panel = Panel(np.zeros((90, 90, 3), np.uint8), "caf\udce9")
    write_sheet([panel], tmp_path / "sheet.png", 1, {"\udce9": (255, 0, 0)}, name="\udce9\ue000")
    whole = replace(panel, title="caf?")
    write_sheet([whole], tmp_path / "whole.png", 1, {"?": (255, 0, 0)}, name="?\ue000")
    assert (tmp_path / "sheet.png").read_bytes() == (tmp_path / "whole.png").read_bytes()


@pytest.mark.parametrize("content", [None, b"no font"])
def test_a_font_that_is_gone_or_damaged_is_passed_over(
    content: bytes | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = tmp_path / "font.ttf"
    if content is not None:
        path.write_bytes(content)
    gone = replace(font_manager.fontManager.ttflist[0], fname=str(path), name="Aaa Gone")
    monkeypatch.setattr(font_manager.fontManager, "ttflist", [gone, *font_manager.fontManager.ttflist])
    assert "Aaa Gone" not in families("把手")
