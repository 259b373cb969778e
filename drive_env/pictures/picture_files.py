"""Frames to files: a GIF, WebP or animated PNG through Pillow, an MP4 through ffmpeg, or a folder of PNGs."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from mechanics.arrays import Image

Writer = Callable[[Path, Iterator[Image], float], None]

ANIMATIONS = {".gif": "GIF", ".webp": "WEBP", ".apng": "PNG", ".png": "PNG"}
VIDEO = ".mp4"
PALETTE_COLORS = 256


class PictureFileError(ValueError):
    """A film cannot be written; the message is one line with the reason and the remedy."""


def check_out(path: str | Path) -> Path:
    """Return the path of a film, after checking that it can be written.

    Raises:
        PictureFileError: If the ending is unknown, ffmpeg is missing, or the folder is not empty or does not exist.
    """
    out = Path(path)
    ending = out.suffix.lower()
    if ending and ending not in (*ANIMATIONS, VIDEO):
        endings = ", ".join((*ANIMATIONS, VIDEO))
        raise PictureFileError(
            f"{out}: no film ends in {ending}; use one of {endings}, or a name without ending for a folder of PNGs"
        )
    if ending == VIDEO and shutil.which("ffmpeg") is None:
        raise PictureFileError(
            f"{out}: an MP4 needs the program ffmpeg, which is not on PATH; install it, or use .webp"
        )
    if ending == ".webp":
        from PIL import features

        if not features.check("webp"):
            raise PictureFileError(f"{out}: this Pillow cannot write WebP; use .gif or .apng")
    if ending and out.is_dir():
        raise PictureFileError(f"{out} is a folder; give a name that is free")
    if not ending and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise PictureFileError(f"{out} exists already; give a folder that is new or empty")
    if not out.absolute().parent.is_dir():
        raise PictureFileError(f"the folder {out.parent} does not exist; create it")
    return out


def write_film(out: str | Path, frames: Iterable[Image], frame_time: float) -> None:
    """Write frames, uint8 of shape (height, width, 3), each shown for `frame_time` [s].

    The film gets its name when it is complete; an interrupted one leaves no file.

    Raises:
        PictureFileError: As check_out, and if ffmpeg fails.
    """
    path = check_out(out)
    stream = iter(frames)
    with tempfile.TemporaryDirectory(dir=path.absolute().parent, prefix=".film-") as folder:
        part = Path(folder) / path.name
        if not path.suffix:
            _write_folder(part, stream)
            if path.is_dir():
                path.rmdir()  # Windows puts nothing in its place
        elif path.suffix.lower() == VIDEO:
            _write_video(part, stream, frame_time)
        else:
            _write_animation(part, stream, frame_time)
        part.replace(path)


def milliseconds(count: int, frame_time: float, step: int = 1) -> list[int]:
    """Return how long each frame is shown [ms], in whole steps [ms] that add up to the true time."""
    edges = np.rint(np.arange(count + 1) * frame_time * 1e3 / step) * step
    return [max(int(d), step) for d in np.diff(edges)]


def _write_animation(path: Path, frames: Iterator[Image], frame_time: float) -> None:
    from PIL import Image as Pillow

    kind = ANIMATIONS[path.suffix.lower()]
    pictures: list[Any] = [Pillow.fromarray(frame) for frame in frames]
    if not pictures:
        raise PictureFileError("the film has no frames; record more time")
    options: dict[str, Any] = {"duration": milliseconds(len(pictures), frame_time, 10 if kind == "GIF" else 1)}
    if kind == "GIF":
        pictures = _with_one_palette(pictures)
        options |= {"loop": 0, "optimize": False}
    elif kind == "WEBP":
        options |= {"loop": 0, "quality": 80, "method": 3}
    else:
        options |= {"loop": 0}
    pictures[0].save(path, format=kind, save_all=True, append_images=pictures[1:], **options)


def _with_one_palette(pictures: list[Any]) -> list[Any]:
    """Return the pictures in the colours of the first, middle and last: one palette, so that nothing flickers."""
    from PIL import Image as Pillow

    samples = [np.asarray(pictures[k]) for k in (0, len(pictures) // 2, len(pictures) - 1)]
    palette = Pillow.fromarray(np.concatenate(samples)).quantize(PALETTE_COLORS, method=Pillow.Quantize.MEDIANCUT)
    return [picture.quantize(palette=palette, dither=Pillow.Dither.NONE) for picture in pictures]


def _write_folder(folder: Path, frames: Iterator[Image]) -> None:
    from PIL import Image as Pillow

    folder.mkdir()
    for k, frame in enumerate(frames):
        Pillow.fromarray(frame).save(folder / f"frame_{k:05d}.png")


def _write_video(path: Path, frames: Iterator[Image], frame_time: float) -> None:
    first = next(frames, None)
    if first is None:
        raise PictureFileError("the film has no frames; record more time")
    height, width = first.shape[:2]
    command = ["ffmpeg", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
               "-r", f"{1.0 / frame_time:.6f}", "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart",
               str(path)]  # fmt: skip
    with tempfile.TemporaryFile() as messages:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=messages)
        assert process.stdin is not None
        try:
            for frame in chain((first,), frames):
                process.stdin.write(np.ascontiguousarray(frame).tobytes())
            process.stdin.close()
        except BrokenPipeError:
            pass  # ffmpeg ended early; its message says why
        except BaseException:
            process.kill()
            process.wait()
            raise
        if process.wait() != 0 or not path.exists():
            messages.seek(0)
            text = messages.read().decode(errors="replace").strip().splitlines() or [os.strerror(0)]
            raise PictureFileError(f"ffmpeg could not write the film: {text[-1]}; use .webp instead")
