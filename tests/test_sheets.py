"""Sheets of pictures show names in any script."""

import warnings
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from matplotlib import font_manager

from dora.affordance.views.fonts import families
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
