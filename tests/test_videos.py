"""Films hold the frames that they were given."""

import sys

import numpy as np
import pytest
from PIL import Image

from mabl import videos
from mabl.errors import UserError


def shades(n, height, width):
    """Frames of one grey each, darker to brighter."""
    return [np.full((height, width, 3), 20 * i, np.uint8) for i in range(1, n + 1)]


def test_a_gif_has_all_frames_at_its_pace(tmp_path):
    path = tmp_path / "new" / "film.gif"
    videos.write(path, shades(5, 9, 7), 8.0)
    with Image.open(path) as film:
        assert film.n_frames == 5 and film.size == (7, 9) and film.info["loop"] == 0
        for i in range(5):
            film.seek(i)
            assert film.info["duration"] == 120  # 125, in hundredths of a second
            assert abs(film.convert("RGB").getpixel((3, 3))[0] - 20 * (i + 1)) <= 2


def test_gifs_that_would_be_too_fast_are_slowed_down(tmp_path):
    videos.write(tmp_path / "film.gif", shades(2, 4, 4), 67.0)
    with Image.open(tmp_path / "film.gif") as film:
        assert film.info["duration"] == 20


def test_an_mp4_has_all_frames_whatever_their_size(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "film.mp4"
    videos.write(path, shades(5, 33, 47), 8.0)
    reader = ffmpeg.read_frames(str(path))
    about = next(reader)
    frames = [np.frombuffer(frame, np.uint8).reshape(34, 48, 3) for frame in reader]
    assert about["size"] == (48, 34) and about["fps"] == 8.0 and len(frames) == 5
    for i, frame in enumerate(frames):
        assert abs(int(frame[10, 10, 0]) - 20 * (i + 1)) <= 6


def test_other_endings_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"neither \.mp4 nor \.gif"):
        videos.write(tmp_path / "film.avi", [], 8.0)


def test_without_the_extra_there_are_gifs(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert not videos.can_write_mp4()
    with pytest.raises(UserError, match=r"mabl\[video\].*or give a \.gif"):
        videos.write(tmp_path / "film.mp4", shades(1, 4, 4), 8.0)
    videos.write(tmp_path / "film.gif", shades(1, 4, 4), 8.0)


def test_a_film_that_fails_leaves_the_one_before(tmp_path):
    path = tmp_path / "film.gif"
    videos.write(path, shades(3, 4, 4), 8.0)
    whole = path.read_bytes()
    with pytest.raises(UserError, match=r"pictures are \(4, 4, 3\), and then \(5, 5, 3\)"):
        videos.write(path, [*shades(2, 4, 4), *shades(1, 5, 5)], 8.0)
    assert path.read_bytes() == whole and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("ending", ["gif", "mp4"])
def test_a_folder_is_no_film(tmp_path, ending):
    path = tmp_path / f"film.{ending}"
    path.mkdir()
    with pytest.raises(UserError, match="is a folder"):
        videos.write(path, shades(3, 8, 8), 8.0)
