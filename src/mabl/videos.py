"""Films of episodes: GIF by Pillow, MP4 with the extra `video`."""

import warnings
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from PIL import Image

from mabl.errors import UserError


def write(path: Path, frames: Iterable[np.ndarray], frames_per_second: float) -> None:
    """Write frames, uint8 `[height, width, 3]`, as they come; an older film stays until then.

    Raises UserError for frames of different sizes and for what the encoder cannot do.
    """
    writer = writer_for(path)
    if path.is_dir():
        raise UserError(f"{path} is a folder: give the name of a file")
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"unfinished-{path.name}")
    try:
        unfinished.write_bytes(b"")  # says what forbids it, as encoders do not
        writer(unfinished, _alike(iter(frames)), frames_per_second)
        if not unfinished.stat().st_size:
            raise UserError(f"{path} could not be written: ffmpeg gave nothing")
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _alike(frames: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for frame in frames:
        shape = shape or frame.shape
        if frame.shape != shape:
            raise UserError(
                f"a film's pictures are {shape}, and then {frame.shape}: keep their size"
            )
        yield frame


def writer_for(path: Path) -> Callable[[Path, Iterator[np.ndarray], float], None]:
    """How a film of that name is written.

    Raises UserError for an ending that is neither .gif nor .mp4, and for .mp4 without the extra.
    """
    if path.suffix == ".gif":
        return _write_gif
    if path.suffix != ".mp4":
        raise UserError(f"{path} ends in neither .mp4 nor .gif: give one that does")
    if not can_write_mp4():
        raise UserError("videos as .mp4 need an extra: pip install 'mabl[video]', or give a .gif")
    return _write_mp4


def can_write_mp4() -> bool:
    """Whether the extra is there."""
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):  # RuntimeError: none for this machine
        return False
    return True


def _write_gif(path: Path, frames: Iterator[np.ndarray], frames_per_second: float) -> None:
    images = (Image.fromarray(frame) for frame in frames)
    # GIFs count in hundredths of a second, and few programs play them faster than 50 a second.
    milliseconds = max(20, round(100 / frames_per_second) * 10)
    next(images).save(
        path, save_all=True, append_images=images, duration=milliseconds, loop=0, optimize=False
    )


def _write_mp4(path: Path, frames: Iterator[np.ndarray], frames_per_second: float) -> None:
    import imageio_ffmpeg

    first = _even(next(frames))
    height, width, _ = first.shape
    film = imageio_ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=frames_per_second,  # pyright: ignore[reportArgumentType]
        macro_block_size=2,
    )
    with warnings.catch_warnings():  # JAX's, of a process that does nothing before it is ffmpeg
        warnings.filterwarnings("ignore", r"os\.fork\(\) was called", RuntimeWarning)
        film.send(None)
    try:
        for frame in chain([first], map(_even, frames)):
            film.send(np.ascontiguousarray(frame))
    except OSError as error:
        raise UserError(f"ffmpeg gave up: {error}") from error
    finally:
        film.close()


def _even(frame: np.ndarray) -> np.ndarray:
    """With a black line below and on the right where the size is odd, as the format asks."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)))
