"""Draws a homing method: the axis with the switch that is searched, the way, and the home position."""

from __future__ import annotations

from itertools import pairwise

from drive_env.dictionary.homing_methods import PLACES, SKETCHES, TO_INDEX, HomingSketch, method_text

WIDTH, LEVEL, STEP = 300.0, 34.0, 15.0  # width of the picture; distance of the axis from the top; distance between legs
TITLES = {"left": "left limit switch", "home": "home switch", "right": "right limit switch"}


def homing_sketch(method: int, *, is_known: bool) -> str:
    """Return the SVG of a method; "" if only the drive's manual defines it.

    Args:
        method: Number in 6098h.
        is_known: Whether the device is known: for others a negative number may have any meaning.
    """
    sketch = SKETCHES.get(method)
    if sketch is None or (method < 0 and not is_known):
        return ""
    height = LEVEL + STEP * max(len(sketch.way) - 1, 1) + 22.0
    parts = [*_axis(sketch), *_way(sketch)]
    text = f"Homing method {method}: {method_text(method, is_known=is_known)}"
    return (
        f'<svg class="studio-homing" viewBox="-12 0 {WIDTH + 24:g} {height:g}" role="img" aria-label="{text}">'
        f"{''.join(parts)}</svg>"
    )


def _x(place: float) -> float:
    return place * WIDTH / 100.0


def _axis(sketch: HomingSketch) -> list[str]:
    """Draw the axis with its ends, the switch, and the encoder's indices."""
    ends = "".join(f"M{_x(place):g} {LEVEL - 6:g}v12" for place in (0.0, 100.0))
    parts = [f'<path class="axis" d="M0 {LEVEL:g}H{WIDTH:g}{ends}"/>']
    if sketch.switch:
        low, high = (_x(place) for place in PLACES[sketch.switch])
        anchor = {"left": "start", "home": "middle", "right": "end"}[sketch.switch]
        at = {"start": low, "middle": 0.5 * (low + high), "end": high}[anchor]
        parts.append(f'<rect class="switch" x="{low:g}" y="{LEVEL - 14:g}" width="{high - low:g}" height="14"/>')
        parts.append(f'<text x="{at:g}" y="{LEVEL - 19:g}" text-anchor="{anchor}">{TITLES[sketch.switch]}</text>')
    if sketch.has_index:
        first = sketch.way[-1] % TO_INDEX
        places = [first + k * TO_INDEX for k in range(int((100.0 - first) // TO_INDEX) + 1)]
        parts.append(f'<path class="index" d="{"".join(f"M{_x(place):g} {LEVEL:g}v7" for place in places)}"/>')
    return parts


def _way(sketch: HomingSketch) -> list[str]:
    """Draw the legs of the way, one below the other, and the home position."""
    parts, y = [], LEVEL + STEP
    parts.append(f'<circle class="start" cx="{_x(sketch.way[0]):g}" cy="{y:g}" r="3.5"/>')
    for k, (begin, end) in enumerate(pairwise(sketch.way)):
        y = LEVEL + STEP * (k + 1)
        tip = 6.0 if end > begin else -6.0
        down = f"v{STEP:g}" if k + 2 < len(sketch.way) else ""
        parts.append(f'<path class="leg" d="M{_x(begin):g} {y:g}H{_x(end):g}{down}"/>')
        parts.append(f'<path class="tip" d="M{_x(end):g} {y:g}l{-tip:g} -4v8z"/>')
    home = _x(sketch.way[-1])
    anchor = "start" if home < 30.0 else "end" if home > WIDTH - 30.0 else "middle"
    parts.append(f'<path class="home" d="M{home:g} {LEVEL:g}V{y:g}"/>')
    parts.append(f'<text class="home" x="{home:g}" y="{y + 16:g}" text-anchor="{anchor}">home</text>')
    return parts
