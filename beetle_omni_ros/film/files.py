"""Writes frames as a GIF with one palette, or as an MP4."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from beetle_omni_ros.robot.schema import ParameterError

COLOURS = 255               # of the palette; one more is transparent, for unchanged pixels
SAMPLES, PIXELS = 24, 6000  # frames, and pixels of each, that determine the palette
STILL = 8                   # smaller changes of a pixel are ignored
GIF_FPS, MP4_FPS = 12.5, 25.0
FORMATS = {'.gif': GIF_FPS, '.mp4': MP4_FPS}


def write_film(path: Path, frames: Iterable[Image.Image], fps: float) -> None:
    """
    Write frames of equal size as a .gif, which repeats, or as an .mp4.

    Raises:
        ParameterError: the file cannot be written, or the MP4 encoder is not installed.

    """
    try:
        if path.suffix == '.gif':
            _gif(path, list(frames), fps)
        else:
            _mp4(path, frames, fps)
    except OSError as error:
        raise ParameterError(f'{path}: cannot write the film ({error})') from None


def _gif(path, frames, fps):
    palette = _palette(frames)
    shown, pages = None, []
    for frame in frames:
        now = np.asarray(frame).astype(np.int16)
        if shown is None:
            shown = now.copy()
        changed = np.abs(now - shown).max(axis=2) >= STILL
        shown[changed] = now[changed]
        page = np.asarray(Image.fromarray(shown.astype(np.uint8)).quantize(
            palette=palette, dither=Image.Dither.NONE))
        pages.append(page)
    images = []
    for k, page in enumerate(pages):
        indices = page if k == 0 else np.where(page == pages[k - 1], COLOURS, page)
        image = Image.fromarray(indices.astype(np.uint8), mode='P')
        image.putpalette(palette.getpalette()[:3 * COLOURS] + [255, 255, 255])
        images.append(image)
    images[0].save(path, save_all=True, append_images=images[1:], loop=0, optimize=False,
                   duration=round(1000 / fps / 10) * 10, disposal=1, transparency=COLOURS)


def _palette(frames):
    """Palette mostly for the moving pixels, because the background has few colours."""
    random = np.random.default_rng(0)
    chosen = frames[::max(1, len(frames) // SAMPLES)]
    stack = np.stack([np.asarray(frame).reshape(-1, 3) for frame in chosen])
    still = np.median(stack, axis=0)
    parts = []
    for pixels in stack:
        moved = np.flatnonzero(np.abs(pixels - still).max(axis=1) > 2 * STILL)
        for among, count in ((moved, PIXELS), (np.arange(len(pixels)), PIXELS)):
            if len(among):
                parts.append(pixels[random.choice(among, count)])
    sample = Image.fromarray(np.concatenate(parts)[None].astype(np.uint8))
    return sample.quantize(COLOURS, method=Image.Quantize.MEDIANCUT, kmeans=2)


def _mp4(path, frames, fps):
    try:
        import imageio_ffmpeg
    except ModuleNotFoundError:
        raise ParameterError(f"{path}: MP4 needs pip install 'beetle_omni_ros[film]'; "
                             'a .gif needs nothing') from None
    writer = None
    for frame in frames:
        if writer is None:
            writer = imageio_ffmpeg.write_frames(
                str(path), frame.size, fps=fps, quality=None, macro_block_size=2,
                codec='libx264', pix_fmt_out='yuv420p',
                output_params=['-crf', '21', '-preset', 'slow', '-movflags', '+faststart'])
            writer.send(None)
        writer.send(np.ascontiguousarray(frame))
    if writer is not None:
        writer.close()
