"""Films of policies: one palette, one size, the moments in which something happens; without a driver one sentence."""

import io
from pathlib import Path

import numpy as np
import pytest
from pictures import run_without_driver
from PIL import Image, ImageSequence

from dora.agents.config import RunConfig
from dora.agents.evaluation.play import write_film
from dora.commands import run
from dora.errors import InputError
from dora.files import film_is_whole
from dora.policies.films import MOMENTS, RATE, SIDE, Episode, _small, as_gif, strip
from dora.tools.stage_pictures import GAP


def moving(count: int, rate: float) -> Episode:
    """A white square that moves in the first half of an episode and rests in the second."""
    frames = []
    for k in range(count):
        frame = np.zeros((SIDE, SIDE, 3), np.uint8)
        at = 2 * min(k, count // 2)
        frame[50:90, at : at + 40] = 255
        frames.append(frame)
    return Episode(frames, rate, True)


def test_a_film_has_the_pictures_of_all_episodes_at_its_rate():
    film = Image.open(io.BytesIO(as_gif([moving(40, 2 * RATE), moving(20, 2 * RATE)])))
    frames, durations = [], []
    for frame in ImageSequence.Iterator(film):  # equal ones in a row are one that lasts
        frames.append(np.asarray(frame.convert("RGB")))
        durations.append(frame.info["duration"])
    assert sum(durations) == 30 * 1000 / RATE
    assert frames[0].shape == (SIDE, SIDE, 3)
    assert frames[5][60, 2 * 10 + 20].min() > 200
    assert frames[5][60, 150].max() < 50


@pytest.mark.parametrize(("rate", "kept"), [(20, 40), (40, 20), (50, 40)])
def test_a_gif_takes_as_long_as_the_episode_and_begins_again(tmp_path: Path, rate: int, kept: int):
    """Its frames last multiples of 10 ms: of 40 pictures a second it has every second one."""
    frames = [np.full((16, 16, 3), 5 * k, np.uint8) for k in range(40)]
    write_film(tmp_path / "a.gif", [frames], rate)
    film = Image.open(tmp_path / "a.gif")
    lasting = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
    assert (len(lasting), sum(lasting), film.info["loop"]) == (kept, 40 * 1000 / rate, 0)


def test_a_film_may_have_a_colon_in_its_relative_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """FFmpeg would take what stands before it as a protocol."""
    monkeypatch.chdir(tmp_path)
    write_film(Path("run:1", "a:b.mp4"), [[np.zeros((16, 16, 3), np.uint8)] * 4], 20)
    assert film_is_whole(tmp_path / "run:1" / "a:b.mp4", 4, 20)


def test_a_strip_shows_the_moments_in_which_something_happens():
    episode = moving(100, RATE)
    picture = strip(episode)
    assert picture.shape == (SIDE, MOMENTS * SIDE + (MOMENTS - 1) * GAP, 3)
    parts = [picture[:, k * (SIDE + GAP) : k * (SIDE + GAP) + SIDE] for k in range(MOMENTS)]
    np.testing.assert_array_equal(parts[0], episode.pictures[0])
    np.testing.assert_array_equal(parts[-1], episode.pictures[-1])
    places = [int(part[60].any(-1).argmax()) for part in parts]
    assert np.diff(places).min() >= 2 * 5  # it moves between any two, though it rests half of the time


def test_a_picture_of_any_shape_becomes_a_square_of_its_middle():
    wide = np.zeros((300, 500, 3), np.uint8)
    wide[:, 100:400] = 255
    assert _small(wide).shape == (SIDE, SIDE, 3)
    assert _small(wide).min() == 255


def test_without_a_driver_films_end_in_one_sentence(tmp_path):
    out = tmp_path / "films"
    program = (
        f"import sys; from dora.policies.films import main; sys.argv[1:] = ['--out', {str(out)!r}]; sys.exit(main())"
    )
    result = run_without_driver(program)
    assert result.returncode == 2
    assert "No film: SAPIEN finds no Vulkan driver here" in result.stderr
    assert "Traceback" not in result.stderr
    assert not out.exists()


def test_a_film_that_cannot_be_made_is_told_once_and_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def refuse(*args: object) -> None:
        (tmp_path / "video").mkdir()
        raise InputError("nothing can be rendered: there is no driver.")

    monkeypatch.setattr(run, "record", refuse)
    config = RunConfig("DoraCube-v1", "ppo", "none")
    assert not run.film(None, config, tmp_path / "video" / "zero.mp4")
    assert capsys.readouterr().err == "No video: nothing can be rendered: there is no driver.\n"
    assert not (tmp_path / "video").exists()
